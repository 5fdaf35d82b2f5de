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

from . import device as simd_threads
from . import product, simd
from .types import Stage

# Relative residual at which the response to a change of the contact forces is good enough: it is
# part of the step, whose tolerance holds too where that is looser.
RESPONSE = 0.03

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


@wp.kernel(enable_backward=False, launch_bounds=(512, 1))
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


class Old:
  """Fields of the structs and numbers of a body by the names of old."""

  def __init__(self, *parts, **more):
    self.parts, self.more = parts, more

  def __getattr__(self, name):
    name = {"pos_trial": "disp_trial", "pos": "disp", "x": "sol"}.get(name, name)
    if name in self.more:
      return self.more[name]
    for part in self.parts:
      if name in part._cls.vars:
        return getattr(part, name)
    raise AttributeError(name)


def old(body):
  numbers = {k: body.number(k) for k in ("foundation", "bulk", "pressure", "tolerance")}
  s = Old(body.shape, body.tissue, has_bending=body.has_bending, device=body.device,
          iterations=int(body.number("iterations")), **numbers)
  return s, Old(body.state, body.system, nworld=body.nworld)


def solve(body, stage: Stage):
  """Solves A x = rhs to the organ's tolerance; writes `x` and `status`."""
  if body.levels is not None:
    multilevel().solve(body, stage)
    return
  s, d = old(body)
  nthread = simd_threads.group_size(s.device, s.nslice, d.nworld)
  wp.launch(
    _solve,
    dim=(d.nworld, nthread),
    block_dim=simd_threads.block(s.device, s.nslice),
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


_DIRECT = simd.group(
  """
  const size_t base = (size_t)world * nslice;
  const float h = step.data[4 * world], g = step.data[4 * world + 1], gv = g - h * h;
  const float* O = areavec.data + 24 * base;
  const float* U = pos.data + 24 * base;
  const float* W = vel.data + 24 * base;
  const float* M = mass.data + 8 * base;
  float* X = x_.data + 24 * base;
  float* Z = q_.data + 24 * base;
  const bool response = false;
"""
  + VOLUME
  + """
  V bb = zero;
  FOR_SLICES(s) {
    const V inverse = LD(free_.data, s) / LD(M, s);
    V b[3];
    for (int c = 0; c < 3; ++c) {
      b[c] = LD(rhs.data + 24 * (base + s), c);
      if (push != 0.0f || pull != 0.0f) b[c] += (push - pull) * LD(O + 24 * s, c);
    }
    V d = SPLAT(1.0f);
    if (neumann) {
      const V kf = foundation * LD(area.data, s);
      const int row0 = slot_adr.data[s], width = slot_adr.data[s + 1] - row0;
      const int* node = fan_node.data + 8 * (row0 + 2 * s + 1);
      const float* k = fan_spring.data + 8 * row0;
      V sum = kf;
      for (int c = 0; c < 3; ++c) b[c] -= g * kf * LD(W + 24 * s, c);
      for (int i = 0; i < width; ++i, node += 8, k += 8) {
        sum += LD(k, 0);
        for (int c = 0; c < 3; ++c)
          b[c] += g * LD(k, 0) * (GATHER(W, node, c) - LD(W + 24 * s, c));
      }
      d += g * sum * inverse;
    }
    for (int c = 0; c < 3; ++c) {
      const V y = b[c] * inverse / d;
      bb += b[c] * b[c] * inverse;
      ST(X + 24 * s, c, y);
      ST(Z + 24 * s, c, y);
    }
  }
  const float norm = group_sum(bb);
  if (neumann) {
    FOR_SLICES(s) {
      const V inverse = LD(free_.data, s) / LD(M, s);
      const int row0 = slot_adr.data[s], width = slot_adr.data[s + 1] - row0;
      const int* node = fan_node.data + 8 * (row0 + 2 * s + 1);
      const float* k = fan_spring.data + 8 * row0;
      V sum = foundation * LD(area.data, s);
      V n[3] = {zero, zero, zero};
      for (int i = 0; i < width; ++i, node += 8, k += 8) {
        sum += LD(k, 0);
        for (int c = 0; c < 3; ++c) n[c] += LD(k, 0) * GATHER(Z, node, c);
      }
      // (2 D^-1 - D^-1 W D^-1) y with W = D - N: z + D^-1 N z, z = D^-1 y.
      const V scale = g * inverse / (1.0f + g * sum * inverse);
      for (int c = 0; c < 3; ++c) ST(X + 24 * s, c, LD(Z + 24 * s, c) + scale * n[c]);
    }
  }
  if (tid != 0) return;
  float* out = status.data + 4 * world;
  out[0] = neumann ? 1.0f : 0.0f;
  out[1] = 0.0f;
  out[2] = norm;
  out[3] = norm < 1e30f && norm >= 0.0f ? 0.0f : 1.0f;
"""
)


# What a step of `midpoint` is made of, in place of those of `implicit`; `undo` puts them back. The
# velocity is that of the time of x where the last step changed none.
@wp.func_native(
  simd.group("""
  const V zero = SPLAT(0.0f);
  const float* D = warm.data + 24 * (size_t)world * nslice;
  V sum = zero;
  FOR_SLICES(s)
    for (int c = 0; c < 3; ++c) sum += LD(D + 24 * s, c) * LD(D + 24 * s, c);
  const float part = group_sum(sum) > 0.0f ? 1.0f : 0.5f;
  if (tid != 0) return;
  float* out = step.data + 4 * world;
  if (undo) {
    out[0] /= part;
    out[1] *= 2.0f / part;
    return;
  }
  // Such that the weight of K v on the right-hand side is h damping; see `elastic.Stage`.
  out[3] = (1.0f - 0.5f * out[1] / (out[0] * out[0])) / part;
  out[0] *= part;
  out[1] *= 0.5f * part;
""")
)
def _centre_world(
  world: int,
  tid: int,
  nthread: int,
  nslice: int,
  undo: int,
  warm: wp.array4d[float],
  step: wp.array2d[float],
  partial_: wp.array3d[float],
): ...


@wp.kernel(enable_backward=False, launch_bounds=512)
def _centre(
  nthread: int,
  nslice: int,
  undo: int,
  # State in:
  dvel_warm_in: wp.array4d[float],
  # State out:
  step_out: wp.array2d[float],
  partial_out: wp.array3d[float],
):
  world, tid = wp.tid()
  _centre_world(world, tid, nthread, nslice, undo, dvel_warm_in, step_out, partial_out)


@wp.func_native(_DIRECT)
def _direct_world(
  world: int,
  tid: int,
  nthread: int,
  nslice: int,
  neumann: int,
  foundation: float,
  bulk: float,
  pressure: float,
  volume0: float,
  slot_adr: wp.array[int],
  fan_node: wp.array2d[int],
  fan_spring: wp.array2d[float],
  area: wp.array2d[float],
  free_: wp.array2d[float],
  rest: wp.array3d[float],
  step: wp.array2d[float],
  pos: wp.array4d[float],
  vel: wp.array4d[float],
  mass: wp.array3d[float],
  rhs: wp.array4d[float],
  areavec: wp.array4d[float],
  total: wp.array2d[float],
  x_: wp.array4d[float],
  q_: wp.array4d[float],
  partial_: wp.array3d[float],
  status: wp.array2d[float],
): ...


@wp.kernel(enable_backward=False, launch_bounds=512)
def _direct(
  nthread: int,
  nslice: int,
  neumann: int,
  foundation: float,
  bulk: float,
  pressure: float,
  volume0: float,
  # Surface:
  slot_adr: wp.array[int],
  fan_node: wp.array2d[int],
  fan_spring: wp.array2d[float],
  area: wp.array2d[float],
  free: wp.array2d[float],
  rest: wp.array3d[float],
  # State in:
  step_in: wp.array2d[float],
  pos_in: wp.array4d[float],
  vel_in: wp.array4d[float],
  mass_in: wp.array3d[float],
  rhs_in: wp.array4d[float],
  areavec_in: wp.array4d[float],
  # State out:
  total_out: wp.array2d[float],
  x_out: wp.array4d[float],
  q_out: wp.array4d[float],
  partial_out: wp.array3d[float],
  status_out: wp.array2d[float],
):
  world, tid = wp.tid()
  _direct_world(
    world,
    tid,
    nthread,
    nslice,
    neumann,
    foundation,
    bulk,
    pressure,
    volume0,
    slot_adr,
    fan_node,
    fan_spring,
    area,
    free,
    rest,
    step_in,
    pos_in,
    vel_in,
    mass_in,
    rhs_in,
    areavec_in,
    total_out,
    x_out,
    q_out,
    partial_out,
    status_out,
  )


def direct(nthread, body, stage):
  s, d = old(body)
  wp.launch(
    _direct,
    dim=(d.nworld, nthread),
    block_dim=simd_threads.block(s.device, s.nslice),
    inputs=[
      nthread,
      s.nslice,
      int(stage == Stage.NEUMANN),
      s.foundation,
      s.bulk,
      s.pressure,
      s.volume0,
      s.slot_adr,
      s.fan_node,
      s.fan_spring,
      s.area,
      s.free,
      s.rest,
      d.step,
      d.pos,
      d.vel,
      d.mass,
      d.rhs,
      d.areavec,
    ],
    outputs=[d.total, d.x, d.q, d.partial, d.status],
    device=s.device,
  )


def centre(nthread, body, undo):
  s, d = old(body)
  wp.launch(
    _centre,
    dim=(d.nworld, nthread),
    block_dim=simd_threads.block(s.device, s.nslice),
    inputs=[nthread, s.nslice, undo, d.dvel_warm],
    outputs=[d.step, d.partial],
    device=s.device,
  )
