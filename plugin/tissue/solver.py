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

from . import elastic, product, simd
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

_STAGES = f"""
#define FIRST_ {int(Stage.FIRST)}
#define RESPONSE_ {int(Stage.RESPONSE)}
#define ENOUGH_ {RESPONSE}f
"""


def body(
  setup: str, precondition: str, scale: str, curvature: str = "", quads: bool = False
) -> str:
  """Returns the native code of the whole solve of one world: launches cost more than iterations.

  The iteration is conjugate gradients with all sums of an iteration in one (Chronopoulos and Gear
  1989, doi:10.1016/0377-0427(89)90045-9): q = A p is carried as A z + beta q, and p^T q as
  z^T A z - beta^2 p^T q, which loses no more than a digit as the second is seldom twice the first.

  Args:
    setup: declarations before the first iteration
    precondition: writes Z, the preconditioned R, and makes it seen by all; sets rz = r^T z and
      `along`, the sum of z with the area vectors, from V rr (r^T D^-1 r) and V zo
    scale: scales zx, zy, zz, which are D^-1 R, before they become Z
    curvature: sums V zw, z^T A z less the volume term, to `curvature`; may do what `precondition`
      leaves to it
    quads: neighbours read Z in `quad_`, and on CUDA what no other thread reads stays in registers
      where there is room for it
  """
  return (
    _STAGES
    + product.code(quads)
    + simd.group(
      simd.owned(
        product.WORLD
        + """
  const float* U = pos.data + 24 * base;
  const float* W = vel.data + 24 * base;
  const float* R0 = rhs.data + 24 * base;
  const float* D0 = warm.data + 24 * base;
  OWN_VECTOR(X, x_.data + 24 * base)
  OWN_VECTOR(R, r_.data + 24 * base)
  OWN_VECTOR(P, p_.data + 24 * base)
  OWN_VECTOR(AP, q_.data + 24 * base)
  OWN_VECTOR(AZ, t_.data + 24 * base)
  float* Z = z_.data + 24 * base;
  float* ZN = zn_.data + 8 * base;
  unsigned shown = 0;
  const bool first = stage == FIRST_, response = stage == RESPONSE_;
  const float gv = g - (first ? step.data[4 * world + 3] : 1.0f) * h * h;
"""
        + VOLUME
        + setup
        + """
  // What the volume term adds to a product is this times `along` along the area vectors.
  const float gain_ = bulk != 0.0f ? g * bulk / volume0 / 36.0f : 0.0f;
  // Right-hand side, its norm, and the start.
  V bb = zero, zo = zero;
  NEXT_TURN
  FOR_OWN(k, s) {
    LOAD(bx, by, bz, R0)
    if (push != 0.0f || pull != 0.0f) {
      bx += (push - pull) * LD(O + 24 * s, 0);
      by += (push - pull) * LD(O + 24 * s, 1);
      bz += (push - pull) * LD(O + 24 * s, 2);
    }
    PUT3(R, bx, by, bz)
    V zx, zy, zz;
    PRECONDITION(zx, zy, zz, bx, by, bz)
    bb += bx * zx + by * zy + bz * zz;
    LOAD(x, y, z, D0)
    SHOW(x, y, z)
    if (bending) { SHOW_NORMAL(WITH(N, x, y, z)) }
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
    const float c = gain_ * along;
    FOR_OWN(k, s) {
      PRODUCT(D0, ZN)
      if (c != 0.0f) {
        ax += c * LD(O + 24 * s, 0); ay += c * LD(O + 24 * s, 1); az += c * LD(O + 24 * s, 2);
      }
      PUT3(AP, ax, ay, az)
      dq += x * ax + y * ay + z * az;
      db += x * GET(R, 0) + y * GET(R, 1) + z * GET(R, 2);
    }
    GROUP_SUMS(dq, db, curvature, gain)
    if (curvature > 0.0f) start = gain / curvature;
  }
  V rr = zero;
  zo = zero;
  NEXT_TURN
  FOR_OWN(k, s) {
    V x = zero, y = zero, z = zero;
    V rx = GET(R, 0), ry = GET(R, 1), rz_ = GET(R, 2);
    if (start != 0.0f) {
      x = start * LD(D0 + 24 * s, 0); y = start * LD(D0 + 24 * s, 1);
      z = start * LD(D0 + 24 * s, 2);
      rx -= start * GET(AP, 0); ry -= start * GET(AP, 1); rz_ -= start * GET(AP, 2);
      PUT3(R, rx, ry, rz_)
    }
    PUT3(X, x, y, z)
    PUT3(P, zero, zero, zero)
    PUT3(AP, zero, zero, zero)
    V zx, zy, zz;
    PRECONDITION(zx, zy, zz, rx, ry, rz_)
    rr += rx * zx + ry * zy + rz_ * zz;
"""
        + scale
        + """
    if (!OWN) { STORE(Z, zx, zy, zz) }
    SHOW(zx, zy, zz)
    if (bending) { SHOW_NORMAL(WITH(N, zx, zy, zz)) }
    if (bulk != 0.0f) zo += WITH(O, zx, zy, zz);
  }
  int it = 0;
  float rz = 0.0f, before = 0.0f, bent = 0.0f, residual = 0.0f;  // bent: p^T A p
  while (true) {
"""
        + precondition
        + """
    V zw = zero;
    SHOWN
    FOR_OWN(k, s) {
      PRODUCT(Z, ZN)
      PUT3(AZ, ax, ay, az)
      zw += x * ax + y * ay + z * az;
    }
    float curvature;
"""
        + (curvature or "curvature = group_sum(zw);")
        + """
    const float volume_ = gain_ * along;
    curvature += volume_ * along;
    float beta = before != 0.0f ? rz / before : 0.0f;
    bent = curvature - beta * beta * bent;
    if (!(bent > 0.0f)) {  // rounding has eaten it
      beta = 0.0f;
      bent = curvature;
    }
    const float alpha = rz / bent;
    before = rz;
    rr = zo = zero;
    NEXT_TURN
    FOR_OWN(k, s) {
      V ax = GET(AZ, 0), ay = GET(AZ, 1), az = GET(AZ, 2);
      if (volume_ != 0.0f) {
        ax += volume_ * LD(O + 24 * s, 0); ay += volume_ * LD(O + 24 * s, 1);
        az += volume_ * LD(O + 24 * s, 2);
      }
      SELF(x, y, z, Z)
      ax += beta * GET(AP, 0); ay += beta * GET(AP, 1); az += beta * GET(AP, 2);
      x += beta * GET(P, 0); y += beta * GET(P, 1); z += beta * GET(P, 2);
      PUT3(AP, ax, ay, az)
      PUT3(P, x, y, z)
      PUT3(X, GET(X, 0) + alpha * x, GET(X, 1) + alpha * y, GET(X, 2) + alpha * z)
      const V rx = GET(R, 0) - alpha * ax, ry = GET(R, 1) - alpha * ay;
      const V rz_ = GET(R, 2) - alpha * az;
      PUT3(R, rx, ry, rz_)
      V zx, zy, zz;
      PRECONDITION(zx, zy, zz, rx, ry, rz_)
      rr += rx * zx + ry * zy + rz_ * zz;
"""
        + scale
        + """
      if (!OWN) { STORE(Z, zx, zy, zz) }
      SHOW(zx, zy, zz)
      if (bending) { SHOW_NORMAL(WITH(N, zx, zy, zz)) }
      if (bulk != 0.0f) zo += WITH(O, zx, zy, zz);
    }
    ++it;
  }
  FOR_OWN(k, s) {
    for (int c = 0; c < 3; ++c) ST(X + 24 * s, c, GET(X, c));
  }
  if (tid != 0) return;
  float* out = status.data + 4 * world;
  out[0] = (first ? 0.0f : out[0]) + (float)it;
  if (first) out[2] = norm;
  if (!response)
    out[1] = out[2] > 0.0f ? sqrtf((residual > 0.0f ? residual : 0.0f) / out[2]) : 0.0f;
  out[3] = (norm < 1e30f && residual < 1e30f && norm >= 0.0f) ? 0.0f : 1.0f;
""",
        quads,
      ),
      not quads,
    )
  )


# With block Jacobi the residual's norm is all there is to sum: at no cost on the CPU, and on CUDA
# together with the curvature, after one product more than it takes.
_JACOBI = """
    if (!SUMS_COST) {
      GROUP_SUMS(rr, zo, fresh, flux)
      rz = residual = fresh;
      along = flux;
      if (!(residual > target) || it >= iterations) break;
    }
"""
_JACOBI_CURVATURE = """
    if (SUMS_COST) {
      GROUP_SUMS3(rr, zo, zw, fresh, flux, bend_)
      rz = residual = fresh;
      along = flux;
      curvature = bend_;
      if (!(residual > target) || it >= iterations) break;
    } else {
      curvature = group_sum(zw);
    }
"""
_SOLVE = body("", _JACOBI, "", _JACOBI_CURVATURE, quads=True)


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
  t_: wp.array4d[float],
  partial_: wp.array3d[float],
  status: wp.array2d[float],
): ...


@wp.kernel(enable_backward=False, launch_bounds=(simd.BLOCK, 1))
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
  t_out: wp.array4d[float],
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
    t_out,
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
    outputs=[d.total, d.x, d.r, d.p, d.q, d.z, d.zn, d.quad, d.t, d.partial, d.status],
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
