"""What MuJoCo sees of an organ whose nodes are its degrees of freedom (nodal coupling).

The organ's new velocity v + dv reaches MuJoCo as a force,

    qfrc_passive = Mhat dv / h - f_ext - f_c,

with Mhat the diagonal inertia of the dofs (mass + armature), f_ext what MuJoCo adds to them by
itself in this step and f_c their constraint force of the last step, both of which are also on the
right-hand side of the implicit step. MuJoCo's own step then gives
v + dv + h (f_c_new - f_c) / Mhat: at rest the contact force is exact whatever h is.

Where tissue is stiff for the time step (`inertia.stiffness`) the last term is put right after
MuJoCo's step: it becomes A^-1 h (f_c_new - f_c), the organ's own response, so that the organ has
taken an implicit step under the forces that act in it, and gains no more energy than they give.
Mhat then is a guess of what a tool meets, and follows the organ's answers (`HEAVIER`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue import step
from palpate.tissue.order import LANES

from . import mjstruct

# Of contact forces, the change that says something about the inertia which they meet: its share of
# them, and the share of it that does not cancel; and the most that it may make more in a step.
_CHANGE, _COHERENT, _FASTER = 0.005, 0.7, 2.0

# What a coupling reports, in `Workspace.flags`; see there.
NFLAG = 9
STALE, ASLEEP, MISSED_NODES, MISSED_ELEMENTS = range(4)
PENDING, NEAR, CHANGED, ANSWERED, FORESEEN = range(4, NFLAG)


@wp.func_native("""
  const double h = timestep.data[0];
  const double damping_ = (float)number.data[3];
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
      const double* last = plugin_state.data + own + nfree + c;
      dvel_warm.data[at + 8 * c] = (float)(2.0 * last[0] - last[nfree]);
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
  number: wp.array[wp.float64],
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
  number: wp.array[wp.float64],
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
    number,
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


# How many times their inertia at rest the nodes in contact have: a secant through the
# last change of the contact forces, as in the coupling of fluids and structures (Kuettler and Wall
# 2008, doi:10.1007/s00466-008-0255-5). `acted` is the sum of impulse times the organ's answer,
# `meant` that of impulse times what the dofs' inertia makes of it, `sum` that of the changes,
# `gross` and `whole` those of their sizes and of the forces' sizes. Impulses that cancel say
# nothing about what a tool meets, and it meets no more than one node alone has, `heaviest` times.
HEAVIER = f"""
  auto touched = [](const double* f) {{ return f[0] != 0.0 || f[1] != 0.0 || f[2] != 0.0; }};
  auto heavier = [&](double now, double acted, double meant, const double* sum, double gross,
                     double whole, double heaviest) -> double {{
    if (whole == 0.0) return 1.0;
    const double net = sqrt(sum[0] * sum[0] + sum[1] * sum[1] + sum[2] * sum[2]);
    if (!(acted > 0.0) || gross < {_CHANGE} * whole || net < {_COHERENT} * gross) return now;
    const double seen = now * meant / acted;
    const double most = {_FASTER} * now < heaviest ? {_FASTER} * now : heaviest;
    return seen < 1.0 ? 1.0 : seen > most ? most : seen;
  }};
"""


@wp.func_native(HEAVIER + """
  // A solve that failed holds the organ still for this step instead of spreading the damage.
  const double ok = status.data[3] == 0.0f ? 1.0 : 0.0;
  const double per_h = ok / timestep.data[0];
  const double heavy = plugin_state.data[3 * nfree];
  for (int i = 0; i < nnode; ++i) {
    const int at = (i >> 3) * 24 + (i & 7), adr = dofadr.data[i];
    if (adr < 0) continue;
    const double m = body_mass.data[bodyid.data[i]];
    const double gain = heavy > 1.0 && touched(&plugin_state.data[stateadr.data[i]]) ? heavy : 1.0;
    for (int c = 0; c < 3; ++c) {
      const double inertia = gain * (m + dof_armature.data[adr + c]);
      if (gain > 1.0) {
        const int diagonal = massadr.data[3 * i + c];
        M.data[diagonal] = qLD.data[diagonal] = inertia;
        qLDiagInv.data[adr + c] = 1.0 / inertia;
      }
      const double dv = (double)dvel.data[at + 8 * c];
      const double f = (ok != 0.0 ? inertia * dv * per_h : 0.0) - ext.data[3 * i + c];
      if (f == f) qfrc_passive.data[adr + c] += f;
    }
  }
""")
def _scatter_native(
  nnode: int,
  nfree: int,
  dofadr: wp.array[int],
  bodyid: wp.array[int],
  massadr: wp.array[int],
  stateadr: wp.array[int],
  timestep: wp.array[wp.float64],
  body_mass: wp.array[wp.float64],
  dof_armature: wp.array[wp.float64],
  ext: wp.array[wp.float64],
  dvel: wp.array4d[float],
  status: wp.array2d[float],
  plugin_state: wp.array[wp.float64],
  qfrc_passive: wp.array[wp.float64],
  M: wp.array[wp.float64],
  qLD: wp.array[wp.float64],
  qLDiagInv: wp.array[wp.float64],
): ...


@wp.kernel(enable_backward=False)
def _scatter(
  nnode: int,
  nfree: int,
  dofadr: wp.array[int],
  bodyid: wp.array[int],
  massadr: wp.array[int],
  stateadr: wp.array[int],
  # Model:
  timestep: wp.array[wp.float64],
  body_mass: wp.array[wp.float64],
  dof_armature: wp.array[wp.float64],
  # State in:
  ext_in: wp.array[wp.float64],
  dvel_in: wp.array4d[float],
  status_in: wp.array2d[float],
  # Data in:
  plugin_state_in: wp.array[wp.float64],
  # Data out:
  qfrc_passive_out: wp.array[wp.float64],
  M_out: wp.array[wp.float64],
  qLD_out: wp.array[wp.float64],
  qLDiagInv_out: wp.array[wp.float64],
):
  _scatter_native(
    nnode,
    nfree,
    dofadr,
    bodyid,
    massadr,
    stateadr,
    timestep,
    body_mass,
    dof_armature,
    ext_in,
    dvel_in,
    status_in,
    plugin_state_in,
    qfrc_passive_out,
    M_out,
    qLD_out,
    qLDiagInv_out,
  )


@wp.func_native(f"""
  const double h = timestep.data[0];
  bool changed = false;
  for (int i = 0; i < nnode; ++i) {{
    const int at = (i >> 3) * 24 + (i & 7), adr = dofadr.data[i], own = stateadr.data[i];
    for (int c = 0; c < 3; ++c) {{
      double df = 0.0;
      if (adr >= 0) df = qfrc_constraint.data[adr + c] - plugin_state.data[own + c];
      rhs.data[at + 8 * c] = (float)(h * df);
      changed = changed || df != 0.0;
    }}
  }}
  flags.data[{CHANGED}] = changed;
""")
def _impulses_native(
  nnode: int,
  dofadr: wp.array[int],
  stateadr: wp.array[int],
  timestep: wp.array[wp.float64],
  qfrc_constraint: wp.array[wp.float64],
  plugin_state: wp.array[wp.float64],
  rhs: wp.array4d[float],
  flags: wp.array[int],
): ...


@wp.kernel(enable_backward=False)
def _impulses(
  nnode: int,
  dofadr: wp.array[int],
  stateadr: wp.array[int],
  # Model:
  timestep: wp.array[wp.float64],
  # Data in:
  qfrc_constraint_in: wp.array[wp.float64],
  plugin_state_in: wp.array[wp.float64],
  # State out:
  rhs_out: wp.array4d[float],
  flags_out: wp.array[int],
):
  _impulses_native(
    nnode, dofadr, stateadr, timestep, qfrc_constraint_in, plugin_state_in, rhs_out, flags_out
  )


@wp.func_native(HEAVIER + f"""
  // Not by what MuJoCo made of them: its solver may have stopped where the forces that it reports
  // are not quite those that moved the dofs.
  const double h = timestep.data[0];
  const bool ok = status.data[3] == 0.0f, answered = ok && flags.data[{ANSWERED}];
  const double heavy = plugin_state.data[3 * nfree] > 1.0 ? plugin_state.data[3 * nfree] : 1.0;
  double acted = 0.0, meant = 0.0, gross = 0.0, whole = 0.0, sum[3] = {{0.0, 0.0, 0.0}};
  for (int i = 0; i < nnode; ++i) {{
    const int at = (i >> 3) * 24 + (i & 7), adr = dofadr.data[i], own = stateadr.data[i];
    if (adr < 0) continue;
    const double gain = touched(&plugin_state.data[own]) ? heavy : 1.0;
    const double inertia = gain * (body_mass.data[bodyid.data[i]] + dof_armature.data[adr]);
    double df2 = 0.0, f2 = 0.0;
    for (int c = 0; c < 3; ++c) {{
      double dv = ok ? (double)dvel.data[at + 8 * c] : 0.0;
      const double f = qfrc_constraint.data[adr + c], df = f - plugin_state.data[own + c];
      f2 += f * f;
      df2 += df * df;
      sum[c] += df;
      if (answered) {{
        acted += h * df * (double)x.data[at + 8 * c];
        dv += (double)x.data[at + 8 * c];
        const double v = (double)vel.data[at + 8 * c] + dv;
        qpos.data[qposadr.data[i] + c] += h * (v - qvel.data[adr + c]);
        qvel.data[adr + c] = v;
      }}
      plugin_state.data[own + c] = f;
      double* last = plugin_state.data + own + nfree + c;
      last[nfree] = last[0];
      last[0] = dv;
    }}
    meant += h * h * df2 / inertia;
    gross += sqrt(df2);
    whole += sqrt(f2);
  }}
  if (answered) plugin_state.data[3 * nfree] = heavier(heavy, acted, meant, sum, gross, whole,
                                                     heaviest.data[0]);
""")
def _remember_native(
  nnode: int,
  nfree: int,
  dofadr: wp.array[int],
  qposadr: wp.array[int],
  bodyid: wp.array[int],
  stateadr: wp.array[int],
  heaviest: wp.array[wp.float64],
  timestep: wp.array[wp.float64],
  body_mass: wp.array[wp.float64],
  dof_armature: wp.array[wp.float64],
  qfrc_constraint: wp.array[wp.float64],
  vel: wp.array4d[float],
  dvel: wp.array4d[float],
  x: wp.array4d[float],
  status: wp.array2d[float],
  flags: wp.array[int],
  qpos: wp.array[wp.float64],
  qvel: wp.array[wp.float64],
  plugin_state: wp.array[wp.float64],
): ...


@wp.kernel(enable_backward=False)
def _remember(
  nnode: int,
  nfree: int,
  dofadr: wp.array[int],
  qposadr: wp.array[int],
  bodyid: wp.array[int],
  stateadr: wp.array[int],
  heaviest: wp.array[wp.float64],
  # Model:
  timestep: wp.array[wp.float64],
  body_mass: wp.array[wp.float64],
  dof_armature: wp.array[wp.float64],
  # Data in:
  qfrc_constraint_in: wp.array[wp.float64],
  # State in:
  vel_in: wp.array4d[float],
  dvel_in: wp.array4d[float],
  x_in: wp.array4d[float],
  status_in: wp.array2d[float],
  flags_in: wp.array[int],
  # Data out:
  qpos_out: wp.array[wp.float64],
  qvel_out: wp.array[wp.float64],
  plugin_state_out: wp.array[wp.float64],
):
  _remember_native(
    nnode,
    nfree,
    dofadr,
    qposadr,
    bodyid,
    stateadr,
    heaviest,
    timestep,
    body_mass,
    dof_armature,
    qfrc_constraint_in,
    vel_in,
    dvel_in,
    x_in,
    status_in,
    flags_in,
    qpos_out,
    qvel_out,
    plugin_state_out,
  )


@dataclasses.dataclass
class Launches:
  """What a coupling launches around the solve.

  Attributes:
    gather: reads MuJoCo's arrays, on the CPU
    scatter: adds the passive force, on the CPU
    leave: takes the contact forces that MuJoCo found and what they changed by, on the CPU
    push: fills the solver's right-hand side with these impulses, on `side`
    answer: ends the step with the response to them, on `side`
    end: ends the step without one, on the CPU, or None where there is nothing to do
    advance: steps the plugin state, on the CPU
    place: makes the model fit the plugin state, on the CPU, or None where there is nothing to do
    enter: fills the solver's state, on `side`
    foresee: guesses what the next `gather` reads, on the CPU, or None where nobody wants it
    enter_ahead: fills the solver's state with that, on `side`
    look_only: looks at a solution that was begun so, on `side`
    look: looks at the solution, on `side`
    side: the device of these
  """

  gather: Callable[[], None]
  scatter: Callable[[], None]
  leave: Callable[[], None]
  advance: Callable[[], None]
  end: Callable[[], None] | None = None
  place: Callable[[], None] | None = None
  enter: Callable[[], None] = lambda: None
  look: Callable[[], None] = lambda: None
  foresee: Callable[[], None] | None = None
  enter_ahead: Callable[[], None] = lambda: None
  look_only: Callable[[], None] = lambda: None
  push: Callable[[], None] = lambda: None
  answer: Callable[[], None] = lambda: None
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
  organ, s, host = w.organ, w.body.shape, w.host
  vert = s.vert.numpy()
  start = int(mjstruct.view(m.plugin_stateadr, m.nplugin, np.int32)[instance])
  w.views = v = option_views(model) | {
    "dofadr": node_addresses(organ.dofadr, vert),
    "qposadr": node_addresses(organ.qposadr, vert),
    "bodyid": node_addresses(organ.body, vert),
    "stateadr": node_addresses(organ.stateadr, vert),
    "massadr": _mass_addresses(m, organ, vert),
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
    "M": wrap(d.M, m.nC),
    "qLD": wrap(d.qLD, m.nC),
    "qLDiagInv": wrap(d.qLDiagInv, m.nv),
    "plugin_state": wrap(d.plugin_state + 8 * start, 3 * organ.nfree + 1),
    "flags": wp.array(w.flags, dtype=int, device="cpu", copy=False),
    "heaviest": wp.array(w.heaviest, dtype=wp.float64, device="cpu", copy=False),
  }

  def gather():
    wp.launch(
      _gather,
      dim=1,
      inputs=[
        s.nnode,
        organ.nfree,
        int(mujoco.mjtDisableBit.mjDSBL_GRAVITY),
        w.body.numbers,
        step.REST,
        *(v[k] for k in ("dofadr", "qposadr", "bodyid", "stateadr", "frame")),
        *(v[k] for k in ("timestep", "gravity", "disableflags", "qpos0", "body_mass")),
        *(v[k] for k in ("qpos", "qvel", "qfrc_applied", "qfrc_passive", "xfrc_applied")),
        v["plugin_state"],
      ],
      outputs=[
        *(host[k] for k in ("step", "disp", "vel", "mass", "force_ext", "dvel_warm")),
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
        organ.nfree,
        *(v[k] for k in ("dofadr", "bodyid", "massadr", "stateadr", "timestep", "body_mass")),
        v["dof_armature"],
        w.ext,
        host["dvel"],
        host["status"],
        v["plugin_state"],
      ],
      outputs=[v[k] for k in ("qfrc_passive", "M", "qLD", "qLDiagInv")],
      device="cpu",
    )

  def leave():
    wp.launch(
      _impulses,
      dim=1,
      inputs=[
        s.nnode,
        *(v[k] for k in ("dofadr", "stateadr", "timestep", "qfrc_constraint", "plugin_state")),
      ],
      outputs=[host["rhs"], v["flags"]],
      device="cpu",
    )

  def advance():
    wp.launch(
      _remember,
      dim=1,
      inputs=[
        s.nnode,
        organ.nfree,
        *(v[k] for k in ("dofadr", "qposadr", "bodyid", "stateadr", "heaviest", "timestep")),
        *(v[k] for k in ("body_mass", "dof_armature", "qfrc_constraint")),
        *(host[k] for k in ("vel", "dvel", "sol", "status")),
        v["flags"],
      ],
      outputs=[v["qpos"], v["qvel"], v["plugin_state"]],
      device="cpu",
    )

  return Launches(gather, scatter, leave, advance)


def _mass_addresses(m, organ, vert: np.ndarray) -> wp.array:
  first = node_addresses(organ.dofadr, vert).numpy()
  dofs = np.maximum(first, 0)[:, None] + np.arange(3)
  found = np.where(first[:, None] >= 0, mass_addresses(m, dofs), -1)
  return wp.array(found.astype(np.int32).ravel(), dtype=int, device="cpu")


def node_addresses(values: np.ndarray, vert: np.ndarray) -> wp.array:
  """Returns per-vertex addresses in node order, -1 for padding, as a CPU array."""
  padded = np.where(vert >= 0, values[vert], -1).astype(np.int32)
  return wp.array(padded, dtype=int, device="cpu")


assert LANES == 8  # the native code above addresses slices of eight
