"""The implicit step: preconditioned conjugate gradients on A dv = b, Newton iterations around it.

A has sliced 3x3 blocks, the bending matrix along the node normals and the rank-one volume term; the
preconditioner is the inverse of the diagonal blocks, or for an organ that has them a cycle on
coarser meshes (`multilevel`). With either PCG stops when sqrt(r^T D^-1 r), D the diagonal blocks,
is `tolerance` times that of b. It starts where a line through the last two steps' solutions leads,
scaled to the least error in the energy norm: from 2562 nodes on that takes 4 to 6 iterations less
than the last solution alone in smooth motion, which takes 4 to 6 less than zero.
"""

from __future__ import annotations

import warp as wp

from . import elastic, simd
from .elastic import Stage
from .types import State, Surface

# A right-hand side below this share of the weight's impulse is at rest: residuals count against it.
REST = 1e-3

# Relative residual at which the response to a change of the contact forces is good enough: it is
# part of the step, whose tolerance holds too where that is looser.
RESPONSE = 0.03

# The first Newton iteration stands where the present velocity leads, but no edge changes by more
# than this share of its length on the way: forces far off would be those of another shape.
AHEAD = 0.1

# Product of A with the vector P of slice s, in ax, ay, az; x, y, z is P there. PN is P along the
# normals and `along` its sum with the area vectors.
PRODUCT = """
#define PRODUCT(P, PN, along) \\
  LOAD(x, y, z, P) \\
  const V md = LD(M, s); \\
  V ax = md * x, ay = md * y, az = md * z; \\
  { \\
    const int row0 = slot[s], width = slot[s + 1] - row0; \\
    const int* node = fan + 8 * (row0 + 2 * s + 1); \\
    const float* k = K + 72 * (size_t)row0; \\
    for (int i = 0; i < width; ++i, node += 8, k += 72) { \\
      NEAR(jx, jy, jz, P, node) \\
      const V dx = jx - x, dy = jy - y, dz = jz - z; \\
      ax += LD(k, 0) * dx + LD(k, 1) * dy + LD(k, 2) * dz; \\
      ay += LD(k, 3) * dx + LD(k, 4) * dy + LD(k, 5) * dz; \\
      az += LD(k, 6) * dx + LD(k, 7) * dy + LD(k, 8) * dz; \\
    } \\
  } \\
  if (bending) { \\
    const int row0 = bend_row[s], width = bend_row[s + 1] - row0; \\
    const int* node = bend_at + 8 * row0; \\
    const float* k = Q + 8 * row0; \\
    V sum = SPLAT(0.0f); \\
    for (int i = 0; i < width; ++i, node += 8, k += 8) sum += LD(k, 0) * GATHER(PN, node, 0); \\
    sum *= g; \\
    ax += sum * LD(N + 24 * s, 0); ay += sum * LD(N + 24 * s, 1); az += sum * LD(N + 24 * s, 2); \\
  } \\
  if (bulk != 0.0f) { \\
    const float c = g * bulk / volume0 / 36.0f * (along); \\
    ax += c * LD(O + 24 * s, 0); ay += c * LD(O + 24 * s, 1); az += c * LD(O + 24 * s, 2); \\
  }
#define PRECONDITION(zx, zy, zz, x, y, z) \\
  { \\
    const float* I = I_ + 48 * s; \\
    const V xx = LD(I, 0), xy = LD(I, 1), xz = LD(I, 2), yy = LD(I, 3), yz = LD(I, 4); \\
    zx = xx * x + xy * y + xz * z; \\
    zy = xy * x + yy * y + yz * z; \\
    zz = xz * x + yz * y + LD(I, 5) * z; \\
  }
#define LOAD(x, y, z, P) \\
  V x = LD((P) + 24 * s, 0), y = LD((P) + 24 * s, 1), z = LD((P) + 24 * s, 2);
#define STORE(P, x, y, z) ST((P) + 24 * s, 0, x); ST((P) + 24 * s, 1, y); ST((P) + 24 * s, 2, z);
#define WITH(P, x, y, z) \\
  (x * LD((P) + 24 * s, 0) + y * LD((P) + 24 * s, 1) + z * LD((P) + 24 * s, 2))
"""

# What PRODUCT and PRECONDITION read, in world `world`.
WORLD = """
  const size_t base = (size_t)world * nslice;
  const float h = step.data[4 * world], g = step.data[4 * world + 1];
  const float* K = block.data + 72 * (size_t)world * nslot;
  const float* M = diag.data + 8 * base;
  const float* I_ = inverse.data + 48 * base;
  const float* O = areavec.data + 24 * base;
  const float* N = normal.data + 24 * base;
  const int* slot = slot_adr.data;
  const int* fan = fan_node.data;
  const int* bend_row = bend_adr.data;
  const int* bend_at = bend_node.data;
  const float* Q = bend_gain.data;
"""

# Impulse of volume and pressure along the area vectors, (push - pull) O: push is the force's, pull
# that of K v with weight gv.
VOLUME = """
  const V zero = SPLAT(0.0f);
  float push = 0.0f, pull = 0.0f;
  if (!response && (bulk != 0.0f || pressure != 0.0f)) {
    V vol = zero, rate = zero;
    FOR_SLICES(s) {
      for (int c = 0; c < 3; ++c) {
        const V o = LD(O + 24 * s, c);
        vol += (LD(rest.data + 24 * s, c) + LD(U + 24 * s, c)) * o;
        rate += LD(W + 24 * s, c) * o;
      }
    }
    GROUP_SUMS(vol, rate, volume, flux)
    volume /= 18.0f;
    if (tid == 0) total.data[2 * world] = volume;
    push = h * (pressure - bulk * (volume - volume0) / volume0) / 6.0f;
    pull = gv * bulk / volume0 / 36.0f * flux;
  }
"""

# How PRODUCT reads neighbours, and what it needs for that of a vector whose slice s is x, y, z.
_VECTORS = """
#define NEAR(x, y, z, P, node) \\
  const V x = GATHER(P, node, 0), y = GATHER(P, node, 1), z = GATHER(P, node, 2);
#define SHOW(x, y, z)
"""
_QUADS = """
#define NEAR(x, y, z, P, node) GATHER_QUADS(x, y, z, P, quad_.data + 96 * base, node)
#define SHOW(x, y, z) PUT_QUADS(quad_.data + 96 * (base + s), x, y, z)
"""

_STAGES = f"""
#define FIRST_ {int(Stage.FIRST)}
#define RESPONSE_ {int(Stage.RESPONSE)}
#define ENOUGH_ {RESPONSE}f
"""


def body(setup: str, precondition: str, scale: str, quads: bool = False) -> str:
  """Returns the native code of the whole solve of one world: launches cost more than iterations.

  The iteration is conjugate gradients with q = A p carried as A z + beta q, as z is what neighbours
  exchange then: two meetings an iteration (Chronopoulos and Gear 1989,
  doi:10.1016/0377-0427(89)90045-9), and no cancellation, since p^T q is summed, not derived.

  Args:
    setup: declarations before the first iteration
    precondition: writes Z, the preconditioned R, and makes it seen by all; sets rz = r^T z and
      `along`, the sum of z with the area vectors, from V rr (r^T D^-1 r) and V zo
    scale: scales zx, zy, zz, which are D^-1 R, before they become Z
    quads: on the CPU, neighbours read Z in `quad_`, see `simd`
  """
  return _STAGES + (_QUADS if quads else _VECTORS) + PRODUCT + simd.group(
    WORLD
    + """
  const float* U = pos.data + 24 * base;
  const float* W = vel.data + 24 * base;
  const float* R0 = rhs.data + 24 * base;
  const float* D0 = warm.data + 24 * base;
  float* X = x_.data + 24 * base;
  float* R = r_.data + 24 * base;
  float* P = p_.data + 24 * base;
  float* AP = q_.data + 24 * base;
  float* Z = z_.data + 24 * base;
  float* ZN = zn_.data + 8 * base;
  const bool first = stage == FIRST_, response = stage == RESPONSE_;
  const float gv = g - (first ? step.data[4 * world + 3] : 1.0f) * h * h;
"""
    + VOLUME
    + setup
    + """
  // Right-hand side, its norm, and the start.
  V bb = zero, zo = zero;
  FOR_SLICES(s) {
    LOAD(bx, by, bz, R0)
    if (push != 0.0f || pull != 0.0f) {
      bx += (push - pull) * LD(O + 24 * s, 0);
      by += (push - pull) * LD(O + 24 * s, 1);
      bz += (push - pull) * LD(O + 24 * s, 2);
    }
    STORE(R, bx, by, bz)
    V zx, zy, zz;
    PRECONDITION(zx, zy, zz, bx, by, bz)
    bb += bx * zx + by * zy + bz * zz;
    LOAD(x, y, z, D0)
    SHOW(x, y, z)
    if (bending) ST(ZN, s, WITH(N, x, y, z));
    if (bulk != 0.0f) zo += WITH(O, x, y, z);
  }
  GROUP_SUMS(bb, zo, norm, along)
  const float floor_ = step.data[4 * world + 2];
  const float whole = response ? status.data[4 * world + 2] : norm;
  float target = tolerance * tolerance * (whole > floor_ ? whole : floor_);
  if (response && target < ENOUGH_ * ENOUGH_ * norm) target = ENOUGH_ * ENOUGH_ * norm;
  float start = 0.0f;
  if (first && norm > target) {
    V db = zero, dq = zero;
    FOR_SLICES(s) {
      PRODUCT(D0, ZN, along)
      STORE(AP, ax, ay, az)
      dq += x * ax + y * ay + z * az;
      db += WITH(R, x, y, z);
    }
    GROUP_SUMS(dq, db, curvature, gain)
    if (curvature > 0.0f) start = gain / curvature;
  }
  V rr = zero;
  zo = zero;
  FOR_SLICES(s) {
    V x = zero, y = zero, z = zero;
    LOAD(rx, ry, rz_, R)
    if (start != 0.0f) {
      x = start * LD(D0 + 24 * s, 0); y = start * LD(D0 + 24 * s, 1);
      z = start * LD(D0 + 24 * s, 2);
      rx -= start * LD(AP + 24 * s, 0); ry -= start * LD(AP + 24 * s, 1);
      rz_ -= start * LD(AP + 24 * s, 2);
      STORE(R, rx, ry, rz_)
    }
    STORE(X, x, y, z)
    V zx, zy, zz;
    PRECONDITION(zx, zy, zz, rx, ry, rz_)
    rr += rx * zx + ry * zy + rz_ * zz;
"""
    + scale
    + """
    STORE(Z, zx, zy, zz)
    SHOW(zx, zy, zz)
    if (bending) ST(ZN, s, WITH(N, zx, zy, zz));
    if (bulk != 0.0f) zo += WITH(O, zx, zy, zz);
  }
  int it = 0;
  float rz = 0.0f, before = 0.0f, residual = 0.0f;
  while (true) {
"""
    + precondition
    + """
    const float beta = before != 0.0f ? rz / before : 0.0f;
    V pq = zero;
    FOR_SLICES(s) {
      PRODUCT(Z, ZN, along)
      V px = x, py = y, pz = z;
      if (beta != 0.0f) {
        ax += beta * LD(AP + 24 * s, 0); ay += beta * LD(AP + 24 * s, 1);
        az += beta * LD(AP + 24 * s, 2);
        px += beta * LD(P + 24 * s, 0); py += beta * LD(P + 24 * s, 1);
        pz += beta * LD(P + 24 * s, 2);
      }
      STORE(AP, ax, ay, az)
      STORE(P, px, py, pz)
      pq += px * ax + py * ay + pz * az;
    }
    const float alpha = rz / group_sum(pq);
    before = rz;
    rr = zo = zero;
    FOR_SLICES(s) {
      float* X1 = X + 24 * s;
      const float* P1 = P + 24 * s;
      for (int c = 0; c < 3; ++c) ST(X1, c, LD(X1, c) + alpha * LD(P1, c));
      LOAD(rx, ry, rz_, R)
      rx -= alpha * LD(AP + 24 * s, 0); ry -= alpha * LD(AP + 24 * s, 1);
      rz_ -= alpha * LD(AP + 24 * s, 2);
      STORE(R, rx, ry, rz_)
      V zx, zy, zz;
      PRECONDITION(zx, zy, zz, rx, ry, rz_)
      rr += rx * zx + ry * zy + rz_ * zz;
"""
    + scale
    + """
      STORE(Z, zx, zy, zz)
      SHOW(zx, zy, zz)
      if (bending) ST(ZN, s, WITH(N, zx, zy, zz));
      if (bulk != 0.0f) zo += WITH(O, zx, zy, zz);
    }
    ++it;
  }
  if (tid != 0) return;
  float* out = status.data + 4 * world;
  out[0] = (first ? 0.0f : out[0]) + (float)it;
  if (first) out[2] = norm;
  if (!response)
    out[1] = out[2] > 0.0f ? sqrtf((residual > 0.0f ? residual : 0.0f) / out[2]) : 0.0f;
  out[3] = (norm < 1e30f && residual < 1e30f && norm >= 0.0f) ? 0.0f : 1.0f;
"""
  )


# With block Jacobi the residual's norm is all there is to sum.
_JACOBI = """
    {
      GROUP_SUMS(rr, zo, fresh, flux)
      rz = residual = fresh;
      along = flux;
    }
    if (!(residual > target) || it >= iterations) break;
"""
_SOLVE = body("", _JACOBI, "", quads=True)


@wp.func_native(_SOLVE)
def _solve_world(
  world: int,
  tid: int,
  nthread: int,
  nslice: int,
  nslot: int,
  stage: int,
  bending: int,
  bulk: float,
  pressure: float,
  volume0: float,
  tolerance: float,
  iterations: int,
  slot_adr: wp.array[int],
  fan_node: wp.array2d[int],
  bend_adr: wp.array[int],
  bend_node: wp.array2d[int],
  bend_gain: wp.array2d[float],
  rest: wp.array3d[float],
  step: wp.array2d[float],
  pos: wp.array4d[float],
  vel: wp.array4d[float],
  warm: wp.array4d[float],
  block: wp.array4d[float],
  diag: wp.array3d[float],
  inverse: wp.array4d[float],
  rhs: wp.array4d[float],
  areavec: wp.array4d[float],
  normal: wp.array4d[float],
  total: wp.array2d[float],
  x_: wp.array4d[float],
  r_: wp.array4d[float],
  p_: wp.array4d[float],
  q_: wp.array4d[float],
  z_: wp.array4d[float],
  zn_: wp.array3d[float],
  quad_: wp.array4d[float],
  partial_: wp.array3d[float],
  status: wp.array2d[float],
): ...


@wp.kernel(enable_backward=False, launch_bounds=simd.BLOCK)
def _solve(
  nthread: int,
  nslice: int,
  nslot: int,
  stage: int,
  bending: int,
  bulk: float,
  pressure: float,
  volume0: float,
  tolerance: float,
  iterations: int,
  # Surface:
  slot_adr: wp.array[int],
  fan_node: wp.array2d[int],
  bend_adr: wp.array[int],
  bend_node: wp.array2d[int],
  bend_gain: wp.array2d[float],
  rest: wp.array3d[float],
  # State in:
  step_in: wp.array2d[float],
  pos_in: wp.array4d[float],
  vel_in: wp.array4d[float],
  dvel_warm_in: wp.array4d[float],
  block_in: wp.array4d[float],
  diag_in: wp.array3d[float],
  inverse_in: wp.array4d[float],
  rhs_in: wp.array4d[float],
  areavec_in: wp.array4d[float],
  normal_in: wp.array4d[float],
  # State out:
  total_out: wp.array2d[float],
  x_out: wp.array4d[float],
  r_out: wp.array4d[float],
  p_out: wp.array4d[float],
  q_out: wp.array4d[float],
  z_out: wp.array4d[float],
  zn_out: wp.array3d[float],
  quad_out: wp.array4d[float],
  partial_out: wp.array3d[float],
  status_out: wp.array2d[float],
):
  world, tid = wp.tid()
  _solve_world(
    world,
    tid,
    nthread,
    nslice,
    nslot,
    stage,
    bending,
    bulk,
    pressure,
    volume0,
    tolerance,
    iterations,
    slot_adr,
    fan_node,
    bend_adr,
    bend_node,
    bend_gain,
    rest,
    step_in,
    pos_in,
    vel_in,
    dvel_warm_in,
    block_in,
    diag_in,
    inverse_in,
    rhs_in,
    areavec_in,
    normal_in,
    total_out,
    x_out,
    r_out,
    p_out,
    q_out,
    z_out,
    zn_out,
    quad_out,
    partial_out,
    status_out,
  )


# Where the first Newton iteration stands: how fast edges change, then how much of h v that allows.
@wp.func_native(
  simd.slices("""
  const float* W = vel.data + 24 * (size_t)world * nslice;
  const int row0 = slot_adr.data[s] + 2 * s + 1, width = slot_adr.data[s + 1] - slot_adr.data[s];
  const int* node = fan_node.data + 8 * row0;
  const float* rest = fan_rest.data + 24 * row0;
  const V x = LD(W + 24 * s, 0), y = LD(W + 24 * s, 1), z = LD(W + 24 * s, 2);
  V most = SPLAT(0.0f);
  for (int i = 0; i < width; ++i, node += 8, rest += 24) {
    const V dx = GATHER(W, node, 0) - x, dy = GATHER(W, node, 1) - y, dz = GATHER(W, node, 2) - z;
    const V rx = LD(rest, 0), ry = LD(rest, 1), rz = LD(rest, 2);
    const V length2 = MAX(rx * rx + ry * ry + rz * rz, SPLAT(1e-30f));
    most = MAX(most, (dx * dx + dy * dy + dz * dz) / length2);
  }
  PUT_MOST(change.data + world, most)
""")
)
def _edge_change_slices(
  world: int,
  tid: int,
  nslice: int,
  slot_adr: wp.array[int],
  fan_node: wp.array2d[int],
  fan_rest: wp.array3d[float],
  vel: wp.array4d[float],
  change: wp.array[float],
): ...


@wp.kernel(enable_backward=False)
def _edge_change(
  nslice: int,
  # Surface:
  slot_adr: wp.array[int],
  fan_node: wp.array2d[int],
  fan_rest: wp.array3d[float],
  # State in:
  vel_in: wp.array4d[float],
  # State out:
  change_out: wp.array[float],
):
  world, tid = wp.tid()
  _edge_change_slices(world, tid, nslice, slot_adr, fan_node, fan_rest, vel_in, change_out)


@wp.func_native(
  simd.slices("""
  const float h = step.data[4 * world], most = h * sqrtf(change.data[world]);
  const float share = most > ahead ? ahead / most : 1.0f;
  const size_t at = 24 * ((size_t)world * nslice + s);
  for (int c = 0; c < 3; ++c) {
    const V v = LD(vel.data + at, c);
    ST(vel_trial.data + at, c, v);
    ST(pos_trial.data + at, c, LD(pos.data + at, c) + share * h * v);
  }
  if (tid == 0) step.data[4 * world + 3] = share;
""")
)
def _predict_slices(
  world: int,
  tid: int,
  nslice: int,
  ahead: float,
  change: wp.array[float],
  pos: wp.array4d[float],
  vel: wp.array4d[float],
  step: wp.array2d[float],
  pos_trial: wp.array4d[float],
  vel_trial: wp.array4d[float],
): ...


@wp.kernel(enable_backward=False)
def _predict(
  nslice: int,
  ahead: float,
  # State in:
  change_in: wp.array[float],
  pos_in: wp.array4d[float],
  vel_in: wp.array4d[float],
  # State out:
  step_out: wp.array2d[float],
  pos_trial_out: wp.array4d[float],
  vel_trial_out: wp.array4d[float],
):
  world, tid = wp.tid()
  _predict_slices(
    world, tid, nslice, ahead, change_in, pos_in, vel_in, step_out, pos_trial_out, vel_trial_out
  )


@wp.func_native(
  simd.slices("""
  const size_t at = 24 * ((size_t)world * nslice + s);
  const float h = step.data[4 * world];
  for (int c = 0; c < 3; ++c) {
    V dv = LD(x.data + at, c);
    if (!first) dv += LD(dvel.data + at, c);
    ST(dvel.data + at, c, dv);
    if (more) {
      const V v = LD(vel.data + at, c) + dv;
      ST(vel_trial.data + at, c, v);
      ST(pos_trial.data + at, c, LD(pos.data + at, c) + h * v);
    }
  }
""")
)
def _newton_slices(
  world: int,
  tid: int,
  nslice: int,
  first: int,
  more: int,
  step: wp.array2d[float],
  pos: wp.array4d[float],
  vel: wp.array4d[float],
  x: wp.array4d[float],
  dvel: wp.array4d[float],
  pos_trial: wp.array4d[float],
  vel_trial: wp.array4d[float],
): ...


@wp.kernel(enable_backward=False)
def _newton_update(
  nslice: int,
  first: int,
  more: int,
  # State in:
  step_in: wp.array2d[float],
  pos_in: wp.array4d[float],
  vel_in: wp.array4d[float],
  x_in: wp.array4d[float],
  # State out:
  dvel_out: wp.array4d[float],
  pos_trial_out: wp.array4d[float],
  vel_trial_out: wp.array4d[float],
):
  world, tid = wp.tid()
  _newton_slices(
    world,
    tid,
    nslice,
    first,
    more,
    step_in,
    pos_in,
    vel_in,
    x_in,
    dvel_out,
    pos_trial_out,
    vel_trial_out,
  )


def solve(s: Surface, d: State, stage: Stage):
  """Solves A x = rhs to the organ's tolerance; writes `x` and `status`.

  Args:
    s: the organ
    d: its state, with A as `elastic.assemble` wrote it
    stage: FIRST, LATER or RESPONSE
  """
  if s.levels is not None:
    multilevel().solve(s, d, stage)
    return
  nthread = simd.group_size(s.device, s.nslice, d.nworld)
  d.partial.zero_()
  wp.launch(
    _solve,
    dim=(d.nworld, nthread),
    block_dim=simd.block(s.device, s.nslice),
    inputs=[
      nthread,
      s.nslice,
      s.nslot,
      int(stage),
      int(s.has_bending),
      s.bulk,
      s.pressure,
      s.volume0,
      s.tolerance,
      s.iterations,
      s.slot_adr,
      s.fan_node,
      s.bend_adr,
      s.bend_node,
      s.bend_gain,
      s.rest,
      d.step,
      d.pos_trial,
      d.vel_trial,
      d.dvel_warm,
      d.block,
      d.diag,
      d.inverse,
      d.rhs,
      d.areavec,
      d.normal,
    ],
    outputs=[d.total, d.x, d.r, d.p, d.q, d.z, d.zn, d.quad, d.partial, d.status],
    device=s.device,
  )


def multilevel():
  """Returns that module, which takes seconds to compile and which most organs do without."""
  from . import multilevel

  return multilevel


def _look_ahead(s: Surface, d: State):
  """Writes where the first iteration stands: `pos_trial`, `vel_trial` and the share in `step`."""
  d.change.zero_()
  size = (d.nworld, simd.threads(s.device, s.nslice))
  wp.launch(
    _edge_change,
    dim=size,
    inputs=[s.nslice, s.slot_adr, s.fan_node, s.fan_rest, d.vel],
    outputs=[d.change],
    device=s.device,
  )
  wp.launch(
    _predict,
    dim=size,
    inputs=[s.nslice, AHEAD, d.change, d.pos, d.vel],
    outputs=[d.step, d.pos_trial, d.vel_trial],
    device=s.device,
  )


def step(s: Surface, d: State):
  """Computes `dvel`, the change of velocity in one implicit step; capturable in a graph.

  Args:
    s: the organ
    d: its state: `step`, `pos`, `vel`, `mass`, `force_ext` and `dvel_warm` are read
  """
  _look_ahead(s, d)
  for it in range(s.newton):
    stage = Stage.FIRST if it == 0 else Stage.LATER
    elastic.assemble(s, d, stage)
    if s.levels is not None:
      multilevel().assemble(s, d)
    solve(s, d, stage)
    wp.launch(
      _newton_update,
      dim=(d.nworld, simd.threads(s.device, s.nslice)),
      block_dim=simd.BLOCK,
      inputs=[s.nslice, int(it == 0), int(it + 1 < s.newton), d.step, d.pos, d.vel, d.x],
      outputs=[d.dvel, d.pos_trial, d.vel_trial],
      device=s.device,
    )
