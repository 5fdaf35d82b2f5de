"""What MuJoCo sees of an organ whose nodes are its degrees of freedom (nodal coupling).

The organ's new velocity v + dv reaches MuJoCo as a force,

    qfrc_passive = Mhat dv / h - f_ext - f_c,

with Mhat the diagonal inertia of the dofs (mass + armature), f_ext what MuJoCo adds to them by
itself in this step and f_c their constraint force of the last step, both of which are also on the
right-hand side of the implicit step. MuJoCo's own step then gives
v + dv + h (f_c_new - f_c) / Mhat: at rest the contact force is exact whatever h is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import warp as wp

from . import mjstruct, solver
from .simd import LANES


@wp.func_native("""
  const double h = timestep.data[0];
  const double damping_ = damping;
  step.data[0] = (float)h;
  step.data[1] = (float)(h * h + h * damping_);
  const bool falls = !(disableflags.data[0] & disable_gravity);
  double g[3] = {0.0, 0.0, 0.0};
  for (int c = 0; c < 3 && falls; ++c)
    for (int k = 0; k < 3; ++k) g[c] += frame.data[3 * k + c] * gravity.data[k];
  double weight = 0.0;
  for (int i = 0; i < nnode; ++i) {
    const int at = (i >> 3) * 24 + (i & 7), adr = dofadr.data[i];
    if (adr < 0) continue;
    const int qadr = qposadr.data[i], body = bodyid.data[i], own = stateadr.data[i];
    const double m = body_mass.data[body];
    mass.data[i] = (float)m;
    weight += m;
    const double* x = xfrc_applied.data + 6 * body;
    for (int c = 0; c < 3; ++c) {
      const double f = m * g[c] + qfrc_applied.data[adr + c] + qfrc_passive.data[adr + c]
        + frame.data[c] * x[0] + frame.data[3 + c] * x[1] + frame.data[6 + c] * x[2];
      const double lagged = f + plugin_state.data[own + c];
      ext.data[3 * i + c] = lagged;
      force_ext.data[at + 8 * c] = (float)lagged;
      pos.data[at + 8 * c] = (float)(qpos.data[qadr + c] - qpos0.data[qadr + c]);
      vel.data[at + 8 * c] = (float)qvel.data[adr + c];
      dvel_warm.data[at + 8 * c] = (float)plugin_state.data[own + nfree + c];
    }
  }
  // Residual floor: with D ~ mass, sqrt(r^T D^-1 r) of this share of the weight's impulse.
  const double rest = rest_share * 9.81 * h;
  step.data[2] = (float)(weight * rest * rest);
""")
def _gather_native(
  nnode: int,
  nfree: int,
  disable_gravity: int,
  damping: float,
  rest_share: float,
  dofadr: wp.array[int],
  qposadr: wp.array[int],
  bodyid: wp.array[int],
  stateadr: wp.array[int],
  frame: wp.array[wp.float64],
  timestep: wp.array[wp.float64],
  gravity: wp.array[wp.float64],
  disableflags: wp.array[int],
  qpos0: wp.array[wp.float64],
  body_mass: wp.array[wp.float64],
  qpos: wp.array[wp.float64],
  qvel: wp.array[wp.float64],
  qfrc_applied: wp.array[wp.float64],
  qfrc_passive: wp.array[wp.float64],
  xfrc_applied: wp.array[wp.float64],
  plugin_state: wp.array[wp.float64],
  step: wp.array2d[float],
  pos: wp.array4d[float],
  vel: wp.array4d[float],
  mass: wp.array3d[float],
  force_ext: wp.array4d[float],
  dvel_warm: wp.array4d[float],
  ext: wp.array[wp.float64],
): ...


@wp.kernel(enable_backward=False)
def _gather(
  nnode: int,
  nfree: int,
  disable_gravity: int,
  damping: float,
  rest_share: float,
  # Where each node is in MuJoCo:
  dofadr: wp.array[int],
  qposadr: wp.array[int],
  bodyid: wp.array[int],
  stateadr: wp.array[int],
  frame: wp.array[wp.float64],
  # Model:
  timestep: wp.array[wp.float64],
  gravity: wp.array[wp.float64],
  disableflags: wp.array[int],
  qpos0: wp.array[wp.float64],
  body_mass: wp.array[wp.float64],
  # Data in:
  qpos_in: wp.array[wp.float64],
  qvel_in: wp.array[wp.float64],
  qfrc_applied_in: wp.array[wp.float64],
  qfrc_passive_in: wp.array[wp.float64],
  xfrc_applied_in: wp.array[wp.float64],
  plugin_state_in: wp.array[wp.float64],
  # State out:
  step_out: wp.array2d[float],
  pos_out: wp.array4d[float],
  vel_out: wp.array4d[float],
  mass_out: wp.array3d[float],
  force_ext_out: wp.array4d[float],
  dvel_warm_out: wp.array4d[float],
  ext_out: wp.array[wp.float64],
):
  _gather_native(
    nnode,
    nfree,
    disable_gravity,
    damping,
    rest_share,
    dofadr,
    qposadr,
    bodyid,
    stateadr,
    frame,
    timestep,
    gravity,
    disableflags,
    qpos0,
    body_mass,
    qpos_in,
    qvel_in,
    qfrc_applied_in,
    qfrc_passive_in,
    xfrc_applied_in,
    plugin_state_in,
    step_out,
    pos_out,
    vel_out,
    mass_out,
    force_ext_out,
    dvel_warm_out,
    ext_out,
  )


@wp.func_native("""
  // A solve that failed holds the organ still for this step instead of spreading the damage.
  const double ok = status.data[3] == 0.0f ? 1.0 : 0.0;
  const double per_h = ok / timestep.data[0];
  for (int i = 0; i < nnode; ++i) {
    const int at = (i >> 3) * 24 + (i & 7), adr = dofadr.data[i];
    if (adr < 0) continue;
    const double m = body_mass.data[bodyid.data[i]];
    for (int c = 0; c < 3; ++c) {
      const double inertia = m + dof_armature.data[adr + c];
      const double dv = (double)dvel.data[at + 8 * c];
      const double f = (ok != 0.0 ? inertia * dv * per_h : 0.0) - ext.data[3 * i + c];
      if (f == f) qfrc_passive.data[adr + c] += f;
    }
  }
""")
def _scatter_native(
  nnode: int,
  dofadr: wp.array[int],
  bodyid: wp.array[int],
  timestep: wp.array[wp.float64],
  body_mass: wp.array[wp.float64],
  dof_armature: wp.array[wp.float64],
  ext: wp.array[wp.float64],
  dvel: wp.array4d[float],
  status: wp.array2d[float],
  qfrc_passive: wp.array[wp.float64],
): ...


@wp.kernel(enable_backward=False)
def _scatter(
  nnode: int,
  dofadr: wp.array[int],
  bodyid: wp.array[int],
  # Model:
  timestep: wp.array[wp.float64],
  body_mass: wp.array[wp.float64],
  dof_armature: wp.array[wp.float64],
  # State in:
  ext_in: wp.array[wp.float64],
  dvel_in: wp.array4d[float],
  status_in: wp.array2d[float],
  # Data out:
  qfrc_passive_out: wp.array[wp.float64],
):
  _scatter_native(
    nnode,
    dofadr,
    bodyid,
    timestep,
    body_mass,
    dof_armature,
    ext_in,
    dvel_in,
    status_in,
    qfrc_passive_out,
  )


@wp.func_native("""
  for (int i = 0; i < nnode; ++i) {
    const int at = (i >> 3) * 24 + (i & 7), adr = dofadr.data[i], own = stateadr.data[i];
    if (adr < 0) continue;
    for (int c = 0; c < 3; ++c) {
      const float dv = dvel.data[at + 8 * c];
      plugin_state.data[own + c] = qfrc_constraint.data[adr + c];
      plugin_state.data[own + nfree + c] = status.data[3] == 0.0f ? (double)dv : 0.0;
    }
  }
""")
def _remember_native(
  nnode: int,
  nfree: int,
  dofadr: wp.array[int],
  stateadr: wp.array[int],
  qfrc_constraint: wp.array[wp.float64],
  dvel: wp.array4d[float],
  status: wp.array2d[float],
  plugin_state: wp.array[wp.float64],
): ...


@wp.kernel(enable_backward=False)
def _remember(
  nnode: int,
  nfree: int,
  dofadr: wp.array[int],
  stateadr: wp.array[int],
  # Data in:
  qfrc_constraint_in: wp.array[wp.float64],
  # State in:
  dvel_in: wp.array4d[float],
  status_in: wp.array2d[float],
  # Data out:
  plugin_state_out: wp.array[wp.float64],
):
  _remember_native(
    nnode, nfree, dofadr, stateadr, qfrc_constraint_in, dvel_in, status_in, plugin_state_out
  )


@dataclasses.dataclass
class Launches:
  """What a coupling launches around the solve.

  Attributes:
    gather: reads MuJoCo's arrays, on the CPU
    scatter: adds the passive force, on the CPU
    advance: steps the plugin state, on the CPU
    place: makes the model fit the plugin state, on the CPU, or None where there is nothing to do
    enter: fills the solver's state, on `side`
    look: looks at the solution, on `side`
    side: the device of these two
  """

  gather: Callable[[], None]
  scatter: Callable[[], None]
  advance: Callable[[], None]
  place: Callable[[], None] | None = None
  enter: Callable[[], None] = lambda: None
  look: Callable[[], None] = lambda: None
  side: Any = "cpu"


def wrap(address: int, size: int, dtype: type = wp.float64) -> wp.array:
  """Returns MuJoCo's own memory as a Warp array."""
  return wp.array(ptr=address, dtype=dtype, shape=(size,), device="cpu")


def option_views(model: int) -> dict[str, wp.array]:
  """Returns views of the options that a step reads."""
  m = mjstruct.Model.from_address(model)
  opt, option = model + mjstruct.Model.opt.offset, type(m.opt)
  return {
    "timestep": wrap(opt + option.timestep.offset, 1),
    "gravity": wrap(opt + option.gravity.offset, 3),
    "disableflags": wrap(opt + option.disableflags.offset, 1, wp.int32),
  }


def mass_addresses(m, dofs: np.ndarray) -> np.ndarray:
  """Returns where the diagonal of each dof lies in mjData.M, the inertia that MuJoCo uses."""
  rowadr = mjstruct.view(m.M_rowadr, m.nv, np.int32)[dofs]
  return rowadr + mjstruct.view(m.M_rownnz, m.nv, np.int32)[dofs] - 1


def launches(w, model: int, instance: int) -> Launches:
  """Returns the launches of nodal coupling for a workspace."""
  m, d = mjstruct.Model.from_address(model), mjstruct.Data.from_address(w.data)
  organ, s, host = w.organ, w.surface, w.host
  vert = s.vert.numpy()
  start = int(mjstruct.view(m.plugin_stateadr, m.nplugin, np.int32)[instance])
  w.views = v = option_views(model) | {
    "dofadr": node_addresses(organ.dofadr, vert),
    "qposadr": node_addresses(organ.qposadr, vert),
    "bodyid": node_addresses(organ.body, vert),
    "stateadr": node_addresses(organ.stateadr, vert),
    "frame": wp.array(organ.frame.ravel(), dtype=wp.float64, device="cpu"),
    "qpos0": wrap(m.qpos0, m.nq),
    "body_mass": wrap(m.body_mass, m.nbody),
    "dof_armature": wrap(m.dof_armature, m.nv),
    "qpos": wrap(d.qpos, m.nq),
    "qvel": wrap(d.qvel, m.nv),
    "qfrc_applied": wrap(d.qfrc_applied, m.nv),
    "qfrc_passive": wrap(d.qfrc_passive, m.nv),
    "qfrc_constraint": wrap(d.qfrc_constraint, m.nv),
    "xfrc_applied": wrap(d.xfrc_applied, 6 * m.nbody),
    "plugin_state": wrap(d.plugin_state + 8 * start, 2 * organ.nfree),
  }

  def gather():
    wp.launch(
      _gather,
      dim=1,
      inputs=[
        s.nnode,
        organ.nfree,
        int(mujoco.mjtDisableBit.mjDSBL_GRAVITY),
        s.damping,
        solver.REST,
        *(v[k] for k in ("dofadr", "qposadr", "bodyid", "stateadr", "frame")),
        *(v[k] for k in ("timestep", "gravity", "disableflags", "qpos0", "body_mass")),
        *(v[k] for k in ("qpos", "qvel", "qfrc_applied", "qfrc_passive", "xfrc_applied")),
        v["plugin_state"],
      ],
      outputs=[
        *(host[k] for k in ("step", "pos", "vel", "mass", "force_ext", "dvel_warm")),
        w.ext,
      ],
      device="cpu",
    )

  def scatter():
    wp.launch(
      _scatter,
      dim=1,
      inputs=[
        s.nnode,
        *(v[k] for k in ("dofadr", "bodyid", "timestep", "body_mass", "dof_armature")),
        w.ext,
        host["dvel"],
        host["status"],
      ],
      outputs=[v["qfrc_passive"]],
      device="cpu",
    )

  def advance():
    wp.launch(
      _remember,
      dim=1,
      inputs=[
        s.nnode,
        organ.nfree,
        v["dofadr"],
        v["stateadr"],
        v["qfrc_constraint"],
        host["dvel"],
        host["status"],
      ],
      outputs=[v["plugin_state"]],
      device="cpu",
    )

  return Launches(gather, scatter, advance)


def node_addresses(values: np.ndarray, vert: np.ndarray) -> wp.array:
  """Returns per-vertex addresses in node order, -1 for padding, as a CPU array."""
  padded = np.where(vert >= 0, values[vert], -1).astype(np.int32)
  return wp.array(padded, dtype=int, device="cpu")


assert LANES == 8  # the native code above addresses slices of eight
