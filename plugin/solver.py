"""The implicit step: preconditioned conjugate gradients on A dv = b, Newton iterations around it.

A has sliced 3x3 blocks, the bending matrix along the node normals and the rank-one volume term; the
preconditioner is the inverse of the diagonal blocks. PCG stops when the residual in the
preconditioned norm, sqrt(r^T D^-1 r), is `tolerance` times that of b. It starts at the last step's
solution, scaled to the least error in the energy norm.
"""

from __future__ import annotations

import warp as wp

from . import elastic, simd
from .elastic import Stage
from .types import State, Surface

# A right-hand side below this share of the weight's impulse is at rest: residuals count against it.
REST = 1e-3

# Product of A with the vector P of slice s, in ax, ay, az; x, y, z is P there.
_PRODUCT = """
#define PRODUCT(P, PN, along) \\
  const V x = LD(P + 24 * s, 0), y = LD(P + 24 * s, 1), z = LD(P + 24 * s, 2); \\
  const V md = LD(M, s); \\
  V ax = md * x, ay = md * y, az = md * z; \\
  { \\
    const int row0 = slot_adr.data[s], width = slot_adr.data[s + 1] - row0; \\
    const int* node = fan_node.data + 8 * (row0 + 2 * s + 1); \\
    const float* k = K + 72 * (size_t)row0; \\
    for (int i = 0; i < width; ++i, node += 8, k += 72) { \\
      const V dx = GATHER(P, node, 0) - x, dy = GATHER(P, node, 1) - y, \\
        dz = GATHER(P, node, 2) - z; \\
      ax += LD(k, 0) * dx + LD(k, 1) * dy + LD(k, 2) * dz; \\
      ay += LD(k, 3) * dx + LD(k, 4) * dy + LD(k, 5) * dz; \\
      az += LD(k, 6) * dx + LD(k, 7) * dy + LD(k, 8) * dz; \\
    } \\
  } \\
  if (bending) { \\
    const int* node = bend_node.data + 8 * bend_adr.data[s]; \\
    const float* k = bend_gain.data + 8 * bend_adr.data[s]; \\
    const int width = bend_adr.data[s + 1] - bend_adr.data[s]; \\
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
"""

_WORLD = """
  const size_t base = (size_t)world * nslice;
  const float h = step.data[4 * world], g = step.data[4 * world + 1];
  const float* K = block.data + 72 * (size_t)world * nslot;
  const float* M = diag.data + 8 * base;
  const float* I_ = inverse.data + 48 * base;
  const float* O = areavec.data + 24 * base;
  const float* N = normal.data + 24 * base;
"""

# Impulse of volume and pressure along the area vectors, (push - pull) O: push is the force's, pull
# that of K v with weight gv.
VOLUME = """
  const V zero = SPLAT(0.0f);
  float push = 0.0f, pull = 0.0f;
  if (bulk != 0.0f || pressure != 0.0f) {
    V vol = zero, rate = zero;
    FOR_SLICES(s) {
      for (int c = 0; c < 3; ++c) {
        const V o = LD(O + 24 * s, c);
        vol += (LD(rest.data + 24 * s, c) + LD(U + 24 * s, c)) * o;
        rate += LD(W + 24 * s, c) * o;
      }
    }
    const float V1 = group_sum(vol) / 18.0f;
    if (tid == 0) total.data[2 * world] = V1;
    push = h * (pressure - bulk * (V1 - volume0) / volume0) / 6.0f;
    pull = gv * bulk / volume0 / 36.0f * group_sum(rate);
  }
"""

# The whole solve of one world in one call: launches would cost more than the iterations.
_SOLVE = (
  _PRODUCT
  + simd.group(
    _WORLD
    + """
  const float* U = pos.data + 24 * base;
  const float* W = vel.data + 24 * base;
  const float* R0 = rhs.data + 24 * base;
  const float* D0 = warm.data + 24 * base;
  float* X = x_.data + 24 * base;
  float* R = r_.data + 24 * base;
  float* P = p_.data + 24 * base;
  float* Q = q_.data + 24 * base;
  float* PN = pn_.data + 8 * base;
  const float gv = first ? g : g - h * h;
"""
    + VOLUME
    + """
  // Right-hand side, its norm, and the start.
  V bb = zero;
  V along = zero;
  FOR_SLICES(s) {
    V bx = LD(R0 + 24 * s, 0), by = LD(R0 + 24 * s, 1), bz = LD(R0 + 24 * s, 2);
    if (push != 0.0f || pull != 0.0f) {
      bx += (push - pull) * LD(O + 24 * s, 0);
      by += (push - pull) * LD(O + 24 * s, 1);
      bz += (push - pull) * LD(O + 24 * s, 2);
    }
    ST(R + 24 * s, 0, bx); ST(R + 24 * s, 1, by); ST(R + 24 * s, 2, bz);
    V zx, zy, zz;
    PRECONDITION(zx, zy, zz, bx, by, bz)
    bb += bx * zx + by * zy + bz * zz;
    const V x = LD(D0 + 24 * s, 0), y = LD(D0 + 24 * s, 1), z = LD(D0 + 24 * s, 2);
    if (bending) ST(PN, s, x * LD(N + 24 * s, 0) + y * LD(N + 24 * s, 1) + z * LD(N + 24 * s, 2));
    if (bulk != 0.0f)
      along += x * LD(O + 24 * s, 0) + y * LD(O + 24 * s, 1) + z * LD(O + 24 * s, 2);
  }
  const float norm = group_sum(bb);
  const float floor_ = step.data[4 * world + 2];
  const float target = tolerance * tolerance * (norm > floor_ ? norm : floor_);
  int it = 0;
  float rz = norm, start = 0.0f;
  if (first && norm > target) {
    V db = zero, dq = zero;
    const float sum = bulk != 0.0f ? group_sum(along) : 0.0f;
    FOR_SLICES(s) {
      PRODUCT(D0, PN, sum)
      ST(Q + 24 * s, 0, ax); ST(Q + 24 * s, 1, ay); ST(Q + 24 * s, 2, az);
      dq += x * ax + y * ay + z * az;
      db += x * LD(R + 24 * s, 0) + y * LD(R + 24 * s, 1) + z * LD(R + 24 * s, 2);
    }
    const float curvature = group_sum(dq), gain = group_sum(db);
    if (curvature > 0.0f) start = gain / curvature;
  }
  along = zero;
  V rr = zero;
  FOR_SLICES(s) {
    V x = zero, y = zero, z = zero;
    V rx = LD(R + 24 * s, 0), ry = LD(R + 24 * s, 1), rz_ = LD(R + 24 * s, 2);
    if (start != 0.0f) {
      x = start * LD(D0 + 24 * s, 0); y = start * LD(D0 + 24 * s, 1);
      z = start * LD(D0 + 24 * s, 2);
      rx -= start * LD(Q + 24 * s, 0); ry -= start * LD(Q + 24 * s, 1);
      rz_ -= start * LD(Q + 24 * s, 2);
      ST(R + 24 * s, 0, rx); ST(R + 24 * s, 1, ry); ST(R + 24 * s, 2, rz_);
    }
    ST(X + 24 * s, 0, x); ST(X + 24 * s, 1, y); ST(X + 24 * s, 2, z);
    V px, py, pz;
    PRECONDITION(px, py, pz, rx, ry, rz_)
    rr += rx * px + ry * py + rz_ * pz;
    ST(P + 24 * s, 0, px); ST(P + 24 * s, 1, py); ST(P + 24 * s, 2, pz);
    if (bending)
      ST(PN, s, px * LD(N + 24 * s, 0) + py * LD(N + 24 * s, 1) + pz * LD(N + 24 * s, 2));
    if (bulk != 0.0f)
      along += px * LD(O + 24 * s, 0) + py * LD(O + 24 * s, 1) + pz * LD(O + 24 * s, 2);
  }
  rz = group_sum(rr);
  while (rz > target && it < iterations) {
    V pq = zero;
    const float sum = bulk != 0.0f ? group_sum(along) : 0.0f;
    FOR_SLICES(s) {
      PRODUCT(P, PN, sum)
      ST(Q + 24 * s, 0, ax); ST(Q + 24 * s, 1, ay); ST(Q + 24 * s, 2, az);
      pq += x * ax + y * ay + z * az;
    }
    const float alpha = rz / group_sum(pq);
    rr = zero;
    FOR_SLICES(s) {
      float* X1 = X + 24 * s;
      float* R1 = R + 24 * s;
      float* Q1 = Q + 24 * s;
      const float* P1 = P + 24 * s;
      for (int c = 0; c < 3; ++c) ST(X1, c, LD(X1, c) + alpha * LD(P1, c));
      const V rx = LD(R1, 0) - alpha * LD(Q1, 0), ry = LD(R1, 1) - alpha * LD(Q1, 1);
      const V rz_ = LD(R1, 2) - alpha * LD(Q1, 2);
      ST(R1, 0, rx); ST(R1, 1, ry); ST(R1, 2, rz_);
      V zx, zy, zz;
      PRECONDITION(zx, zy, zz, rx, ry, rz_)
      ST(Q1, 0, zx); ST(Q1, 1, zy); ST(Q1, 2, zz);
      rr += rx * zx + ry * zy + rz_ * zz;
    }
    const float fresh = group_sum(rr), beta = fresh / rz;
    rz = fresh;
    ++it;
    if (!(rz > target) || it >= iterations) break;
    along = zero;
    FOR_SLICES(s) {
      const float* Q1 = Q + 24 * s;
      float* P1 = P + 24 * s;
      const V px = LD(Q1, 0) + beta * LD(P1, 0), py = LD(Q1, 1) + beta * LD(P1, 1);
      const V pz = LD(Q1, 2) + beta * LD(P1, 2);
      ST(P1, 0, px); ST(P1, 1, py); ST(P1, 2, pz);
      if (bending)
        ST(PN, s, px * LD(N + 24 * s, 0) + py * LD(N + 24 * s, 1) + pz * LD(N + 24 * s, 2));
      if (bulk != 0.0f)
        along += px * LD(O + 24 * s, 0) + py * LD(O + 24 * s, 1) + pz * LD(O + 24 * s, 2);
    }
    if (bulk == 0.0f) GROUP_SYNC();
  }
  if (tid != 0) return;
  float* out = status.data + 4 * world;
  const float whole = (first ? 0.0f : out[0]) + (float)it;
  out[0] = whole;
  if (first) out[2] = norm;
  out[1] = out[2] > 0.0f ? sqrtf((rz > 0.0f ? rz : 0.0f) / out[2]) : 0.0f;
  out[3] = (norm < 1e30f && rz < 1e30f && norm >= 0.0f) ? 0.0f : 1.0f;
"""
  )
)


@wp.func_native(_SOLVE)
def _solve_world(
  world: int,
  tid: int,
  nthread: int,
  nslice: int,
  nslot: int,
  first: int,
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
  pn_: wp.array3d[float],
  partial_: wp.array3d[float],
  counter_: wp.array[int],
  status: wp.array2d[float],
): ...


@wp.kernel(enable_backward=False, launch_bounds=simd.BLOCK)
def _solve(
  nthread: int,
  nslice: int,
  nslot: int,
  first: int,
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
  pn_out: wp.array3d[float],
  partial_out: wp.array3d[float],
  counter_out: wp.array[int],
  status_out: wp.array2d[float],
):
  world, tid = wp.tid()
  _solve_world(
    world,
    tid,
    nthread,
    nslice,
    nslot,
    first,
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
    pn_out,
    partial_out,
    counter_out,
    status_out,
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


def solve(s: Surface, d: State, first: bool):
  """Solves A x = rhs to the organ's tolerance; writes `x` and `status`."""
  nthread = simd.group_size(s.device, s.nslice, d.nworld)
  d.counter.zero_()
  wp.launch(
    _solve,
    dim=(d.nworld, nthread),
    block_dim=simd.BLOCK,
    inputs=[
      nthread,
      s.nslice,
      s.nslot,
      int(first),
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
    outputs=[d.total, d.x, d.r, d.p, d.q, d.pn, d.partial, d.counter, d.status],
    device=s.device,
  )


def step(s: Surface, d: State):
  """Computes `dvel`, the change of velocity in one implicit step; capturable in a graph.

  Args:
    s: the organ
    d: its state: `step`, `pos`, `vel`, `mass`, `force_ext` and `dvel_warm` are read
  """
  wp.copy(d.pos_trial, d.pos)
  wp.copy(d.vel_trial, d.vel)
  for it in range(s.newton):
    first = it == 0
    elastic.assemble(s, d, Stage.FIRST if first else Stage.LATER)
    solve(s, d, first)
    wp.launch(
      _newton_update,
      dim=(d.nworld, simd.threads(s.device, s.nslice)),
      block_dim=simd.BLOCK,
      inputs=[s.nslice, int(first), int(it + 1 < s.newton), d.step, d.pos, d.vel, d.x],
      outputs=[d.dvel, d.pos_trial, d.vel_trial],
      device=s.device,
    )
