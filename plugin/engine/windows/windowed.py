"""Windows: what MuJoCo sees of an organ is a small flex that slides over it, under the tools.

Only nodes near a tool need degrees of freedom of MuJoCo: the organ's motion lives in
`plugin_state`, and the window's vertex bodies ("slots") stand on the nodes nearest to the tools,
with their position, velocity and effective inertia. The window's triangles are the organ's
triangles between them. Forces follow the same formula as on all nodes; a node outside the window
moves by dv exactly as it would with dofs of its own and no contact.

The nodes' kernels (`nodes`) run on the CPU over the plugin state, or, for a `resident` organ, on
its device over a copy that `Resident` keeps; the slots' kernels (`slots`) on the CPU.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue import step
from palpate.tissue.kernels import Kernel
from palpate.tissue.types import Views

from .. import coupling, layout, safe_calls
from ..coupling import Share
from ..layout import TAIL, Inbox, Motion, Outbox
from ..model import inertia, mjstruct, prepare
from . import nodes, proxies
from .resident import Resident

if TYPE_CHECKING:
  from ..host import Host
  from ..workspace import Workspace

# Candidates that a device reports, times the slots.
ROOM = 16


def side_of(host: Host) -> wp.Device:
  """Returns the device of the nodes' kernels."""
  return host.body.device if host.config.resident else wp.get_device("cpu")


def sizes_of(host: Host) -> dict[str, int]:
  """Returns what the blocks of `layout` need."""
  nvert, nslot = host.organ.mesh.nvert, host.organ.window.nslot
  most = min(nvert, ROOM * nslot) if side_of(host).is_cuda else nvert
  return coupling.sizes(host.organ) | {"most": most}


def scratch(host: Host) -> dict[str, Any]:
  """Returns what outlives a new recording of an organ's graphs."""
  organ, sizes, pinned = host.organ, sizes_of(host), side_of(host).is_cuda
  return proxies.scratch(organ.mesh.nvert, organ.window.nslot) | {
    name: wp.zeros(layout.size(kind, sizes), dtype=wp.float64, device="cpu", pinned=pinned)
    for name, kind in (("inbox", Inbox), ("outbox", Outbox), ("foreseen", Inbox))
  }


class Phases(coupling.Phases):
  """Window coupling of an organ.

  Args:
    host: the organ, bound to a model
    kept: what `scratch` gave
    share: what cuts have made of values by mass
  """

  def __init__(self, host: Host, kept: dict[str, Any], share: Share):
    organ, sizes = host.organ, sizes_of(host)
    self.side = side_of(host)
    self._resident, self._away = host.config.resident, self.side.is_cuda
    self._status = host.arrays["status"], host.body.system.status
    self.boxes = {
      "own": host.own,
      "inbox": layout.carve(Inbox, kept["inbox"], sizes),
      "outbox": layout.carve(Outbox, kept["outbox"], sizes),
      "foreseen": layout.carve(Inbox, kept["foreseen"], sizes),
    }
    self._slots = proxies.make(host, self.boxes, kept, sizes)
    self._host, self._kept, self._share = host, kept, share
    # The boxes here and on `side`, which may be the same.
    self._near, self._foreseen = (kept["inbox"], kept["outbox"]), kept["foreseen"]
    self._far, motion = self._near, host.own.motion
    if self._away:
      inbox, outbox = (wp.clone(box, device=self.side) for box in self._near)
      self._far = inbox, outbox
    if self._resident:
      self._motion = wp.zeros(layout.size(Motion, sizes), dtype=wp.float64, device=self.side)
      motion = layout.carve(Motion, self._motion, sizes)
      own = host.flags().numpy().data, self.boxes, host.state.numpy()
      self.resident = Resident(*own, self._motion, self._end_now, self.look_ahead)
    self._nodes = nodes.make(host, self.side, motion, self._far, sizes)
    self._weights = nodes.Weights(host, self._nodes)
    self._weights.put(np.arange(organ.mesh.nvert))
    self._reshape = proxies.Reshape(organ, self._slots)
    self._motion_here = Views(host.own.motion)

  # Cuts.

  def reshape(self, touched: np.ndarray | None = None):
    """Takes the mesh and the masses that the organ has now."""
    organ = self._host.organ
    touched = np.arange(organ.mesh.nvert) if touched is None else touched
    self._reshape.put(organ, touched)
    share_inertia(self._host, self._kept, self._share, touched)
    self._weights.put(touched)
    wake(self._host)

  def motion(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns displacement and velocity of the vertices, where the state has them."""
    if self.resident:
      self.resident.fetch()
    motion = self._motion_here
    return motion.disp, motion.vel

  def contact_force(self) -> np.ndarray:
    """See `coupling.Phases`."""
    out, node = np.zeros((self._host.organ.mesh.nvert, 3)), self._kept["placed"].numpy()
    used = node >= 0
    out[node[used]] = self._host.own.force.numpy()[used]
    return out

  def put(self, vert: np.ndarray, disp: np.ndarray | None, vel: np.ndarray | None):
    """See `coupling.Phases`."""
    motion = self._motion_here
    for there, values in ((motion.disp, disp), (motion.vel, vel)):
      if values is not None:
        there[vert] = values[vert]
    if self.resident:
      self.resident.renew()

  def divide(self, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `coupling.Phases`; slots keep their forces."""
    for values in (self._motion_here.last, self._motion_here.before):
      values[member] = values[group]

  def _over_slots(self, kernel: Kernel):
    proxies.launch(kernel, self._slots)

  def _over_nodes(self, kernel: Kernel):
    nodes.launch(kernel, self._nodes, self._nodes.nvert, self.side)

  def _over_pushed(self, kernel: Kernel):
    nodes.launch(kernel, self._nodes, self._nodes.nslot, self.side)

  def _receive(self):
    if self._away:
      wp.copy(self._far[0], self._near[0])

  def place(self):
    """Puts the windows where the plugin state says."""
    self._over_slots(proxies.place)

  def gather(self):
    """Tells what acts on the slots and where the tools are."""
    self._over_slots(proxies.gather)

  def enter(self):
    """Ends the last step if the motion is on a device; fills the solver's state."""
    self._receive()
    self._begin()

  def _begin(self):
    if self._resident:
      self._end()
    self._over_nodes(nodes.enter)
    self._over_pushed(nodes.push_slots)

  def look(self):
    """Looks for nodes near the tools."""
    self._over_nodes(nodes.search)
    self._over_pushed(nodes.report)
    if self._away:
      wp.copy(self._near[1], self._far[1])
      wp.copy(*self._status)

  def scatter(self):
    """Adds the passive force on the slots."""
    self._over_slots(proxies.scatter)

  def leave(self):
    """Takes the slots' motion and contact forces, and says whether the organ falls asleep."""
    self._over_slots(proxies.leave)

  def push(self):
    """Fills the right-hand side with the impulses on the slots."""
    self._receive()
    self._nodes.solve.rhs.zero_()
    self._over_pushed(nodes.push_impulses)

  def answer(self):
    """Ends the step with the response, and looks at where the nodes are then."""
    self._over_nodes(nodes.commit)
    self.look()

  def end(self):
    """Ends the step, unless the motion is on a device: there the next one does."""
    if not self._resident:
      self._end()

  def _end(self):
    self._over_nodes(nodes.commit)
    self._over_pushed(nodes.move_slots)

  def _end_now(self):
    self._receive()
    self._end()

  def advance(self):
    """Gives the window the nodes nearest to the tools."""
    self._over_slots(proxies.choose)

  def foresee(self):
    """Guesses what the next `gather` tells."""
    self._over_slots(proxies.foresee)

  def enter_ahead(self):
    """Ends the last step and fills the solver's state with the guess."""
    wp.copy(self._far[0], self._foreseen)
    self._begin()

  def look_ahead(self):
    """Looks again, with where the tools are now."""
    self._receive()
    self.look()


def settle(w: Workspace, model: int):
  """Readies the state for the default slots."""
  set_inertia(w, mjstruct.model(model))
  w.host.state.fill_(0.0)  # MuJoCo has not cleared it yet


def find_astray(w: Workspace) -> float:
  """Returns how far a slot is from the node that the plugin state says it is on, at most [m]."""
  own, turn = w.host.own, w.turn
  assert turn is not None
  if own.tail.numpy()[TAIL.stamp] < 0:  # that motion is on a device, and the slots have moved
    return np.inf if turn.stood else 0.0
  win, n, number = w.organ.window, w.organ.mesh.nvert, own.slot.numpy()
  node = np.where(number == 0, win.home, np.where((number >= 1) & (number <= n), number - 1, -1))
  used = np.flatnonzero(node >= 0)
  node = node[used].astype(int)
  first = win.qposadr[used, None] + np.arange(3)
  qpos = w.host.d.qpos[first]
  disp = own.motion.disp.numpy()[node]
  return float(np.abs(qpos - win.qhome[used] - w.organ.mesh.rest[node] - disp).max(initial=0.0))


def hide(w: Workspace):
  """Hides the organ's flex from MuJoCo until it is drawn again."""
  if w.seen.counts[0]:
    prepare.show(mjstruct.model(w.model), w.organ, shown=False)


def let_sleep(w: Workspace, allowed: bool):
  """Lets MuJoCo put the windows' bodies to sleep, or wakes them in the middle of a step.

  It does so itself where `<flag sleep="enable"/>` is set: it then spends next to nothing on dofs
  that have nothing to do while the organ sleeps.
  """
  m, d = mjstruct.both(w.model, w.data)
  tree = m.body_treeid[w.organ.window.body]
  policy = mujoco.mjtSleepPolicy
  may = policy.mjSLEEP_AUTO_ALLOWED if allowed else policy.mjSLEEP_AUTO_NEVER
  m.tree_sleep_policy[tree] = int(may)
  if allowed or (d.tree_asleep[tree] < 0).all():
    return
  find_contacts_again(w)  # trees that may not sleep wake
  mjstruct.library().mj_comVel(w.model, w.data)
  d.qfrc_passive[w.organ.dofs] = 0.0
  wp.capture_launch(w.graphs.before)


def find_contacts_again(w: Workspace):
  """Does the position stage once more.

  It keeps the inertias of all other dofs: another organ may have raised its own in this step.
  Threads that have taken theirs take it anew, from the rows that there are now.
  """
  m, d = mjstruct.both(w.model, w.data)
  other = np.ones(m.nv, bool)
  other[w.organ.dofs] = False
  row = np.repeat(other, m.M_rownnz)
  kept = [(d.M, row), (d.qLD, row), (d.qLDiagInv, other)]
  values = [array[which].copy() for array, which in kept]
  assert w.triangles  # else nothing changes the triangles
  safe_calls.find_contacts(w.triangles.model(w.model), w.data)
  for (array, which), were in zip(kept, values, strict=True):
    array[which] = were
  coupling.again(w.data, w.seen.instance)


def wake(host: Host):
  """Ends the organ's sleep: something has changed."""
  host.own.tail.numpy()[TAIL.quiet] = 0.0


def set_inertia(w: Workspace, m: mjstruct.Struct):
  """Stores the effective inertia of every node for the present time step."""
  organ, win = w.declared, w.organ.window
  nodal = win.mass
  if step.SCHEMES[w.config.integrator].spreads:
    nodal = inertia.of_nodes(m, organ, w.body, w.config, win.mass, win.flex)
  w.views["whole"] = nodal
  share_inertia(w.host, w.views, w.share)


def share_inertia(host: Host, kept: dict[str, Any], share: Share, vert: Any = slice(None)):
  """Gives vertices, some or all, that were one their part of its inertia."""
  kept["inertia"].numpy()[vert] = proxies.hold(host.organ, share(kept["whole"], vert), vert)


def shortage(w: Workspace) -> str | None:
  """Returns what the windows had no room for at most, and what to do, or None."""
  nodes, triangles = w.report.missed
  if nodes:
    what = f"{nodes} nodes that tools touch and keep the deepest; give them more vertices"
  elif triangles:
    what = f"{triangles} triangles between their nodes; give them more elements"
  else:
    return None
  return f"organ {w.organ.name!r}: its windows have no room for {what}"


def draw(w: Workspace, model: int, data: int):
  """Writes the deformed surface where renderers read it."""
  m, d = mjstruct.both(model, data)
  organ = w.organ
  start = int(m.flex_vertadr[organ.flex])
  n = prepare.drawn(organ.mesh)
  prepare.show(m, organ, shown=True)
  if w.graphs.resident:
    w.graphs.resident.fetch()
  out = d.flexvert_xpos[start : start + n]
  disp = w.host.own.motion.disp.numpy()[:n]
  out[:] = organ.origin + (organ.mesh.rest[:n] + disp) @ organ.frame.T
