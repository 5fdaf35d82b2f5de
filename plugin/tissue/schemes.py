"""The time stepping schemes by name: the implicit step, one of second order, two to compare with.

`midpoint` is of second order in h. MuJoCo moves x by h v after each step, so that its v is that of
the middle of a step; about the time of x the step is centred, and stable for every h:

    A dv = h (F + f_ext + f_c) - h damping K v,    A = M + (h^2 + h damping) K / 2

(Newmark's family, with beta = 1/2 so that a step's stiffest motions fade with the damping). A step
after which v is yet that of the time of x, the first one, makes half of it. It damps no more than
the tissue does; `implicit` adds h / 2 to the damping. See docs/accuracy.md.

`explicit` is the scheme of the Virtual Training Environment, semi-implicit Euler on the same
forces: dv = M^-1 h (F + f_ext). `neumann` is the thesis scheme (eq. 5.19-5.26): the constant
Hessian H of springs along the edges, and the inverse of W = I - (h^2 + h damping) H / m replaced by
its first-order Neumann polynomial about D = diag W,

    dv = (2 D^-1 - D^-1 W D^-1) (h (F + f_ext) + (h^2 + h damping) H v) / m.
"""

from __future__ import annotations

import warp as wp

from . import elastic, simd, solver
from .elastic import Stage
from .types import State, Surface

# Schemes with a response of their own to contact forces; see `coupling`.
RESPONDING = ("implicit", "midpoint")

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
  + solver.VOLUME
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


@wp.kernel(enable_backward=False, launch_bounds=simd.BLOCK)
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


@wp.kernel(enable_backward=False, launch_bounds=simd.BLOCK)
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


def step(s: Surface, d: State, integrator: str):
  """Computes `dvel`, the change of velocity in one step; capturable in a graph.

  Args:
    s: the organ
    d: its state: `step`, `pos`, `vel`, `mass`, `force_ext` and `dvel_warm` are read
    integrator: `implicit`, `midpoint`, `neumann` or `explicit`
  """
  if integrator == "implicit":
    solver.step(s, d)
    return
  if integrator == "midpoint":
    _midpoint(s, d)
    return
  neumann = integrator == "neumann"
  wp.copy(d.pos_trial, d.pos)
  wp.copy(d.vel_trial, d.vel)
  elastic.assemble(s, d, Stage.NEUMANN if neumann else Stage.EXPLICIT)
  nthread = simd.group_size(s.device, s.nslice, d.nworld)
  wp.launch(
    _direct,
    dim=(d.nworld, nthread),
    block_dim=simd.block(s.device, s.nslice),
    inputs=[
      nthread,
      s.nslice,
      int(neumann),
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
  wp.copy(d.dvel, d.x)


def respond(s: Surface, d: State, integrator: str):
  """Writes to `x` how the impulses in `rhs` [N s] change the velocity in the step just computed.

  Args:
    s: the organ
    d: its state as `step` left it
    integrator: `implicit` or `midpoint`
  """
  if integrator == "midpoint":
    _centre_step(s, d, undo=0)
  solver.solve(s, d, Stage.RESPONSE)
  if integrator == "midpoint":
    _centre_step(s, d, undo=1)


def _centre_step(s: Surface, d: State, undo: int):
  nthread = simd.group_size(s.device, s.nslice, d.nworld)
  wp.launch(
    _centre,
    dim=(d.nworld, nthread),
    block_dim=simd.block(s.device, s.nslice),
    inputs=[nthread, s.nslice, undo, d.dvel_warm],
    outputs=[d.step, d.partial],
    device=s.device,
  )


def _midpoint(s: Surface, d: State):
  wp.copy(d.pos_trial, d.pos)
  wp.copy(d.vel_trial, d.vel)
  _centre_step(s, d, undo=0)
  elastic.assemble(s, d, Stage.FIRST)
  if s.levels is not None:
    solver.multilevel().assemble(s, d)
  solver.solve(s, d, Stage.FIRST)
  _centre_step(s, d, undo=1)
  wp.copy(d.dvel, d.x)
