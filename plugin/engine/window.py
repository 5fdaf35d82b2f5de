"""What MuJoCo sees of an organ through windows: small flexes that slide over it, under the tools.

Only nodes near a tool need degrees of freedom of MuJoCo: the organ's motion lives in
`plugin_state`, and each window's vertex bodies ("slots") stand on the nodes nearest to the tool,
with their position, velocity and effective inertia. The window's triangles are the organ's
triangles between them. Forces follow the formula of `coupling`; a node outside the window moves by
dv exactly as it would with dofs of its own and no contact.

plugin_state: displacement, velocity, last dv and the dv before (3 nvert each), contact force (3 W),
slots (W; node + 1, 0 for the slot's default node, -1 for a slot that is not used), poses of the
windows' geoms when the organ fell asleep (12 each), `TAIL` numbers.

The nodes' kernels (`window_nodes`) run on the CPU over that memory, or, for a `resident` organ, on
its device over a copy that `Resident` keeps; the slots' kernels (`window_slots`) on the CPU.
"""

from __future__ import annotations

import mujoco
import numpy as np
import warp as wp
from palpate.tissue import step
from palpate.tissue.types import State, System

from . import inertia, mjstruct, prepare, window_nodes, window_slots
from .coupling import Launches, mass_addresses, option_views, wrap
from .resident import Resident
from .window_nodes import Nodes
from .window_slots import Slots

# Nodes within this many mean edges of a tool may be in its window.
_REACH = 4.0
# An organ whose nodes move by less than this share of its size a second is at rest.
_SLOW = 1e-5
# Candidates of a window that a device reports, times the window's slots.
_ROOM = 16


def state_size(nvert: int, nslot: int, ngeom: int) -> int:
  """Returns the length of the plugin state; ngeom is summed over the windows."""
  return 12 * nvert + 4 * nslot + window_slots.POSE * ngeom + window_slots.TAIL


def launches(w, model: int, instance: int) -> Launches:
  """Returns the launches of window coupling for a workspace."""
  organ, s = w.organ, w.body
  win = organ.windows
  nslot, nvert = win.nslot, organ.mesh.nvert
  side = s.device if w.config.resident else wp.get_device("cpu")
  if not w.views:
    w.views = _scratch(w, side)
  v = w.views
  m, d = mjstruct.Model.from_address(model), mjstruct.Data.from_address(w.data)
  start = int(mjstruct.view(m.plugin_stateadr, m.nplugin, np.int32)[instance])
  v["plugin_state"] = wrap(d.plugin_state + 8 * start, state_size(nvert, nslot, win.geom.size))
  first = mjstruct.view(m.body_treeid, m.nbody, np.int32)[win.body[0]]
  w.policy = mjstruct.view(m.tree_sleep_policy, m.ntree, np.int32)[first:].data
  w.counts = mjstruct.view(m.flex_vertnum, m.nflex, np.int32)[organ.flex :].data
  slots = _slots(w, model)
  nodes = _nodes(w, side)
  away = nodes.inbox is not v["inbox"]  # the nodes are on another device

  def over_slots(kernel):
    wp.launch(kernel, dim=1, inputs=[slots], device="cpu")

  def over_nodes(kernel, count: int = nvert):
    window_nodes.launch(kernel, nodes, count, side)

  def receive():
    if away:
      wp.copy(nodes.inbox, v["inbox"])

  def send():
    if away:
      wp.copy(v["outbox"], nodes.outbox)
      wp.copy(w.host["status"], w.body.system.status)

  def end_step():
    over_nodes(window_nodes.commit)
    over_nodes(window_nodes.move_slots, nslot)

  def begin():
    if w.resident:
      end_step()
    over_nodes(window_nodes.enter)
    over_nodes(window_nodes.push_slots, nslot)

  def enter():
    receive()
    begin()

  def look():
    over_nodes(window_nodes.search)
    over_nodes(window_nodes.report, nslot)
    send()

  def look_again():
    receive()
    look()

  def end_step_now():
    receive()
    end_step()

  def enter_ahead():
    wp.copy(nodes.inbox, v["foreseen"])
    begin()

  def push():
    receive()
    nodes.rhs.zero_()
    over_nodes(window_nodes.push_impulses, nslot)

  def answer():
    over_nodes(window_nodes.commit)
    look()

  if w.config.resident:
    w.resident = Resident(w, nodes, start, end_step_now, look_again)
  return Launches(
    gather=lambda: over_slots(window_slots.gather),
    scatter=lambda: over_slots(window_slots.scatter),
    leave=lambda: over_slots(window_slots.leave),
    push=push,
    answer=answer,
    end=None if w.resident else end_step,
    advance=lambda: over_slots(window_slots.choose),
    place=lambda: over_slots(window_slots.place),
    enter=enter,
    look=look,
    foresee=(lambda: over_slots(window_slots.foresee)) if w.resident else None,
    enter_ahead=enter_ahead,
    look_only=look_again,
    side=side,
  )


def _ints(values) -> wp.array:
  return wp.array(np.asarray(values, np.int32).ravel(), dtype=int, device="cpu")


def _doubles(values) -> wp.array:
  return wp.array(np.asarray(values, np.float64).ravel(), dtype=wp.float64, device="cpu")


def _scratch(w, side: wp.Device) -> dict[str, wp.array]:
  """Returns the arrays of a workspace that outlive a new recording."""
  win = w.organ.windows
  nvert, nslot, nwindow = w.organ.mesh.nvert, win.nslot, len(win.flex)
  most = nvert
  if side.is_cuda:
    most = min(nvert, _ROOM * int(np.diff(win.adr).max()))
  boxes = {
    "inbox": window_nodes.inbox_size(nslot, nwindow),
    "outbox": window_nodes.outbox_size(nslot, nwindow, most),
    "foreseen": window_nodes.inbox_size(nslot, nwindow),
  }
  return {
    "placed": _ints(np.full(nslot, -2)),
    "taken": _ints(np.full(nvert, -1)),
    "chosen": _ints(np.zeros(nvert)),
    "candidate": _ints(np.zeros(nvert)),
    "distance": _doubles(np.zeros(nvert)),
    "claim": _ints(np.full(nvert, -1)),
    "left": _ints(np.full(nslot, -1)),
    "lagged": _doubles(np.zeros(3 * nslot)),
    "other": _doubles(np.zeros(3 * nslot)),
    "inertia": _doubles(np.zeros(nvert)),
    "flags": wp.array(w.flags, dtype=int, device="cpu", copy=False),
    "heaviest": wp.array(w.heaviest, dtype=wp.float64, device="cpu", copy=False),
    **{
      name: wp.zeros(size, dtype=wp.float64, device="cpu", pinned=side.is_cuda)
      for name, size in boxes.items()
    },
  }


def _most(w) -> int:
  """Returns the candidates of a window that the outbox has room for."""
  win = w.organ.windows
  head = window_nodes.outbox_size(win.nslot, len(win.flex), 0)
  return (len(w.views["outbox"]) - head) // (len(win.flex) * window_nodes.RECORD)


def _slots(w, model: int) -> Slots:
  """Returns the kernels' view of the slots."""
  m, d = mjstruct.Model.from_address(model), mjstruct.Data.from_address(w.data)
  organ, win, mesh = w.organ, w.organ.windows, w.organ.mesh
  dofs = (win.dofadr[:, None] + np.arange(3)).ravel()
  incidence = np.argsort(mesh.elem.ravel(), kind="stable") // 3
  count = np.bincount(mesh.elem.ravel(), minlength=mesh.nvert)
  edge = mesh.rest[mesh.elem[:, [1, 2, 0]]] - mesh.rest[mesh.elem]
  length = np.linalg.norm(edge, axis=2)
  spacing = float(length.mean())
  # A tool that touches a triangle is no farther from its corners than their longest edges.
  longest = np.zeros(mesh.nvert)
  for corner in (mesh.elem, mesh.elem[:, [1, 2, 0]]):
    np.maximum.at(longest, corner.ravel(), length.ravel())
  radius = float(mjstruct.view(m.flex_radius, m.nflex)[win.flex].max())
  margin = float(mjstruct.view(m.flex_margin, m.nflex)[win.flex].max())
  margin += float(mjstruct.view(m.geom_margin, m.ngeom)[win.geom].max(initial=0.0))
  numbers = {
    "nvert": mesh.nvert,
    "nslot": win.nslot,
    "nwindow": len(win.flex),
    "most": _most(w),
    "no_gravity": int(mujoco.mjtDisableBit.mjDSBL_GRAVITY),
    "resident": int(w.config.resident),
    "number": w.body.numbers,
    "rest_share": step.REST,
    "reach": max(_REACH * spacing, float(longest.max())) + radius,
    "slow": _SLOW * float(np.linalg.norm(np.ptp(mesh.rest, axis=0))),
    "longest": float(longest.max()),
    "skin": radius + margin,
    "weight": float(win.mass.sum()),
  }
  arrays = option_views(model) | {
    "node_mass": _doubles(win.mass),
    "rest": _doubles(mesh.rest),
    "touch": _doubles(longest + radius),
    "elem": _ints(mesh.elem),
    "near_adr": _ints(np.concatenate([[0], np.cumsum(count)])),
    "near": _ints(incidence),
    "home": _ints(win.home),
    "qhome": _doubles(win.qhome),
    "dofadr": _ints(win.dofadr),
    "massadr": _ints(mass_addresses(m, dofs)),
    "qposadr": _ints(win.qposadr),
    "bodyid": _ints(win.body),
    "window_adr": _ints(win.adr),
    "elem_adr": _ints(win.elem_adr),
    "elem_num": _ints(win.elem_num),
    "geom_adr": _ints(win.geom_adr),
    "geom": _ints(win.geom if win.geom.size else [0]),
    "frame": _doubles(organ.frame),
    "origin": _doubles(organ.origin),
    "ext": w.ext,
    "status": w.host["status"],
    "geom_type": wrap(m.geom_type, m.ngeom, wp.int32),
    "geom_size": wrap(m.geom_size, 3 * m.ngeom),
    "geom_aabb": wrap(m.geom_aabb, 6 * m.ngeom),
    "geom_rbound": wrap(m.geom_rbound, m.ngeom),
    "body_mass": wrap(m.body_mass, m.nbody),
    "flex_elem": wrap(m.flex_elem, m.nflexelemdata, wp.int32),
    "dof_armature": wrap(m.dof_armature, m.nv),
    "dof_M0": wrap(m.dof_M0, m.nv),
    "dof_invweight0": wrap(m.dof_invweight0, m.nv),
    "body_invweight0": wrap(m.body_invweight0, 2 * m.nbody),
    "body_awake": wrap(d.body_awake, m.nbody, wp.int32),
    "geom_xpos": wrap(d.geom_xpos, 3 * m.ngeom),
    "geom_xmat": wrap(d.geom_xmat, 9 * m.ngeom),
    "qpos": wrap(d.qpos, m.nq),
    "qvel": wrap(d.qvel, m.nv),
    "M": wrap(d.M, m.nC),
    "qLD": wrap(d.qLD, m.nC),
    "qLDiagInv": wrap(d.qLDiagInv, m.nv),
    "qfrc_applied": wrap(d.qfrc_applied, m.nv),
    "qfrc_passive": wrap(d.qfrc_passive, m.nv),
    "qfrc_constraint": wrap(d.qfrc_constraint, m.nv),
    "xfrc_applied": wrap(d.xfrc_applied, 6 * m.nbody),
  }
  return _struct(Slots, numbers | arrays | w.views)


def _nodes(w, side: wp.Device) -> Nodes:
  """Returns the kernels' view of the nodes: plugin state on the CPU, own arrays elsewhere."""
  organ, s, v = w.organ, w.body.shape, w.views
  nvert, nslot, nwindow = organ.mesh.nvert, organ.windows.nslot, len(organ.windows.flex)
  node = s.node.numpy()
  address, size = v["plugin_state"].ptr, 3 * nvert
  if w.config.resident:
    motion = [wp.zeros(size, dtype=wp.float64, device=side) for _ in range(4)]
  else:
    motion = [wrap(address + 8 * k * size, size) for k in range(4)]
  solving = w.host
  if w.config.resident:
    solving = {k: getattr(w.body.state, k) for k in State.vars}
    solving |= {k: getattr(w.body.system, k) for k in System.vars}
  crossing = ("step", "disp", "vel", "force_ext", "dvel_warm", "dvel", "rhs", "sol", "status")
  mass = np.ones(s.nnode)
  mass[node] = organ.windows.mass
  w.host["mass"].assign(mass.reshape(1, -1, 8).astype(np.float32))
  wp.copy(w.body.state.mass, w.host["mass"])
  numbers = {"nvert": nvert, "nslot": nslot, "nwindow": nwindow, "most": _most(w)}
  lowest = np.full(7, window_nodes.LOWEST)
  arrays = {
    "node": _ints((node // 8) * 24 + node % 8).to(side),
    "mass": _doubles(organ.windows.mass).to(side),
    "rest": _doubles(organ.mesh.rest).to(side),
    "disp": motion[0],
    "velocity": motion[1],
    "last": motion[2],
    "before": motion[3],
    "inbox": v["inbox"] if not side.is_cuda else wp.clone(v["inbox"], device=side),
    "outbox": v["outbox"] if not side.is_cuda else wp.clone(v["outbox"], device=side),
    "count": _ints(np.zeros(nwindow)).to(side),
    "extent": _ints(lowest).to(side),
    **{{"disp": "pos", "sol": "x"}.get(k, k): solving[k] for k in crossing},
  }
  return _struct(Nodes, numbers | arrays)


def _struct(kind, values: dict):
  """Returns a Warp struct with its fields from `values`."""
  out = kind()
  for name in kind.vars:
    setattr(out, name, values[name])
  return out


def settle(w, model: int):
  """Readies the state for the default slots."""
  set_inertia(w, mjstruct.Model.from_address(model))
  w.views["plugin_state"].fill_(0.0)  # MuJoCo has not cleared it yet


def hide(w):
  """Hides the organ's flex from MuJoCo until it is drawn again."""
  if w.counts[0]:
    prepare.show(mjstruct.Model.from_address(w.model), w.organ, shown=False)


def let_sleep(w, allowed: bool):
  """Lets MuJoCo put the windows' bodies to sleep, or wakes them in the middle of a step.

  It does so itself where `<flag sleep="enable"/>` is set: it then spends next to nothing on dofs
  that have nothing to do while the organ sleeps.
  """
  m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
  tree = mjstruct.view(m.body_treeid, m.nbody, np.int32)[w.organ.windows.body]
  policy = mujoco.mjtSleepPolicy
  may = policy.mjSLEEP_AUTO_ALLOWED if allowed else policy.mjSLEEP_AUTO_NEVER
  mjstruct.view(m.tree_sleep_policy, m.ntree, np.int32)[tree] = int(may)
  if allowed or (mjstruct.view(d.tree_asleep, m.ntree, np.int32)[tree] < 0).all():
    return
  lib = mjstruct.library()
  # Inertias stay: another organ may have made its own greater in this step.
  inertias = [(d.M, m.nC), (d.qLD, m.nC), (d.qLDiagInv, m.nv)]
  kept = [mjstruct.view(*each).copy() for each in inertias]
  lib.mj_fwdPosition(w.model, w.data)  # trees that may not sleep wake
  lib.mj_comVel(w.model, w.data)
  for each, values in zip(inertias, kept, strict=True):
    mjstruct.view(*each)[:] = values
  mjstruct.view(d.qfrc_passive, m.nv)[w.organ.dofs] = 0.0
  wp.capture_launch(w.before)


def wake(w):
  """Ends the organ's sleep: something has changed."""
  w.views["plugin_state"].numpy()[-window_slots.TAIL + 1] = 0.0


def set_inertia(w, m):
  """Stores the effective inertia of every node for the present time step."""
  organ, win = w.organ, w.organ.windows
  nodal = win.mass
  if step.SCHEMES[w.config.integrator].spreads:
    nodal = inertia.of_nodes(m, organ, w.body, w.config, win.mass, int(win.flex[0]))
  w.views["inertia"].assign(nodal)


def draw(w, model: int, data: int):
  """Writes the deformed surface where renderers read it."""
  m, d = mjstruct.Model.from_address(model), mjstruct.Data.from_address(data)
  organ = w.organ
  start = int(mjstruct.view(m.flex_vertadr, m.nflex, np.int32)[organ.flex])
  n = organ.mesh.nvert
  prepare.show(m, organ, shown=True)
  if w.resident:
    w.resident.fetch()
  out = mjstruct.view(d.flexvert_xpos, (m.nflexvert, 3))[start : start + n]
  u = w.views["plugin_state"].numpy()[: 3 * n].reshape(n, 3)
  out[:] = organ.origin + (organ.mesh.rest + u) @ organ.frame.T
