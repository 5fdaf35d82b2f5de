"""Nodal coupling: an organ whose moving nodes are MuJoCo's degrees of freedom."""

from typing import TYPE_CHECKING

import numpy as np
from palpate.tissue import step
from palpate.tissue.kernels import Kernel
from palpate.tissue.types import doubles, fill, ints, struct

from . import coupling
from .coupling import Crossing, Mujoco, Share
from .layout import FLAG, NodalState
from .model import inertia

if TYPE_CHECKING:
  from .host import Host


@struct
class Nodal:
  """A nodal organ in MuJoCo's arrays and in the solver's; nodes are padded to whole slices."""

  nnode: int  # nodes
  rest_share: float  # see `step.REST`
  dofadr: ints("nnode")  # first dof of a node, -1 for pinned ones and padding
  qposadr: ints("nnode")  # its first number in qpos
  bodyid: ints("nnode")  # its body
  stateadr: ints("nnode")  # its first number in a block of the plugin state, -1 for those
  nfree: int  # numbers of nodes that have dofs; those of the nodes inside of a solid follow
  massadr: ints("nnode", 3)  # where M has the diagonals of its dofs
  frame: doubles(3, 3)  # rotation from the slides' axes to the world
  weighs: int  # whether masses are not MuJoCo's: solids, and where cuts may come; then there are
  weight: doubles("nweighed")  # mass of a node [kg]
  inertia: doubles("nweighed")  # its inertia to MuJoCo [kg]
  shift: doubles("nweighed", 3)  # rest position now less that of the compiled model [m]
  heaviest: doubles(1)  # see `Host`
  number: doubles("nnumber")  # see `NUMBERS`
  flags: ints(len(FLAG))  # see FLAG
  lagged: doubles("nnode", 3)  # external and lagged contact force [N]
  own: NodalState
  mj: Mujoco
  solve: Crossing


gather, scatter, push, remember = coupling.kernels(
  "coupling/nodal.h", Nodal, "gather_nodes", "scatter_nodes", "push_nodes", "remember_nodes"
)


class Phases(coupling.Phases):
  """Nodal coupling of an organ.

  Args:
    host: the organ, bound to a model
    share: what cuts have made of values by mass
  """

  side = "cpu"

  def __init__(self, host: "Host", share: Share):
    m, organ, s = host.m, host.organ, host.body.shape
    vert = s.vert.numpy()
    dofadr = _in_node_order(organ.dofadr, vert)
    dofs = np.maximum(dofadr, 0)[:, None] + np.arange(3)
    weighs = organ.mesh.spare > 0 or len(organ.mesh.tet) > 0
    nweighed = weighs * len(vert)
    values = dict(
      nnode=s.nnode,
      rest_share=step.REST,
      dofadr=dofadr,
      qposadr=_in_node_order(organ.qposadr, vert),
      bodyid=_in_node_order(organ.body, vert),
      stateadr=_in_node_order(organ.stateadr, vert),
      massadr=np.where(dofadr[:, None] >= 0, coupling.mass_addresses(m, dofs), -1),
      frame=organ.frame,
      nfree=organ.nfree,
      weighs=int(weighs),
      weight=np.zeros(nweighed),
      inertia=np.zeros(nweighed),
      shift=np.zeros((nweighed, 3)),
      heaviest=host.arrays["heaviest"],
      number=host.number,
      flags=host.flags(),
      lagged=host.arrays["lagged"],
      own=host.own,
      mj=coupling.mujoco_arrays(host.model, host.data),
      solve=coupling.crossing(host.arrays),
    )
    self._nodal, self._host, self._share = fill(Nodal, "cpu", values), host, share
    self.reshape()

  def _launch(self, kernel: Kernel):
    kernel.launch("cpu", 1, 1, 0, self._nodal)

  def gather(self):
    """Reads MuJoCo's arrays into the solver's state."""
    self._launch(gather)

  def scatter(self):
    """Adds the passive force."""
    self._launch(scatter)

  def leave(self):
    """Fills the right-hand side with the impulses by which the contact forces changed."""
    self._launch(push)

  def advance(self):
    """Steps the plugin state, and ends the step with the response where there was one."""
    self._launch(remember)

  # Solids and cuts.

  def reshape(self, touched: np.ndarray | None = None):
    """Takes the mesh and the masses that the organ has now."""
    host, organ, n = self._host, self._host.organ, self._nodal
    if not n.weighs:
      return
    node, found = host.body.shape.node.numpy(), inertia.of_dofs(host.m, organ)
    n.weight.numpy()[node] = np.where(organ.mass > 0, organ.mass, 1.0)
    n.inertia.numpy()[node] = self._share(found)
    n.shift.numpy()[node] = organ.mesh.rest - organ.mesh.whole.rest

  def motion(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns displacement and velocity of the vertices, in the organ's frame, (nvert, 3) each."""
    organ, d, qpos0 = self._host.organ, self._host.d, self._host.m.qpos0
    shift = organ.mesh.rest - organ.mesh.whole.rest
    disp, vel = np.zeros((organ.mesh.nvert, 3)), np.zeros((organ.mesh.nvert, 3))
    at, dofs = organ.qposs.reshape(-1, 3), organ.dofs.reshape(-1, 3)
    disp[organ.jointed] = d.qpos[at] - qpos0[at] - shift[organ.jointed]
    vel[organ.jointed] = d.qvel[dofs]
    own = self._nodal.own
    for values, inside in ((disp, own.disp), (vel, own.vel)):
      values[organ.inner] = inside.numpy().reshape(-1, 3)
    return disp, vel

  def contact_force(self) -> np.ndarray:
    """See `coupling.Phases`."""
    out = np.zeros((self._host.organ.mesh.nvert, 3))
    out[self._host.organ.jointed] = self._nodal.own.force.numpy().reshape(-1, 3)
    return out

  def put(self, vert: np.ndarray, disp: np.ndarray | None, vel: np.ndarray | None):
    """See `coupling.Phases`."""
    organ, d, own = self._host.organ, self._host.d, self._nodal.own
    shift = organ.mesh.rest - organ.mesh.whole.rest
    vert = vert[organ.free[vert]]
    jointed = organ.dofadr[vert] >= 0
    mine, within = vert[jointed], vert[~jointed]
    if disp is not None:
      at = organ.qposadr[mine, None] + np.arange(3)
      d.qpos[at] = self._host.m.qpos0[at] + shift[mine] + disp[mine]
      own.disp.numpy().reshape(-1, 3)[within - organ.mesh.nskin] = disp[within]
    if vel is not None:
      d.qvel[organ.dofadr[mine, None] + np.arange(3)] = vel[mine]
      own.vel.numpy().reshape(-1, 3)[within - organ.mesh.nskin] = vel[within]

  def divide(self, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `coupling.Phases`."""
    organ, own = self._host.organ, self._nodal.own
    at = organ.stateadr[:, None] + np.arange(3)
    for name in ("last", "before"):
      block = getattr(own, name).numpy()
      block[at[member]] = block[at[group]]
    force, outer = own.force.numpy(), organ.dofadr[group] >= 0  # what was inside had none
    force[at[member]] = share[:, None] * np.where(
      outer[:, None], force[at[np.where(outer, group, member)]], 0.0
    )


def _in_node_order(values: np.ndarray, vert: np.ndarray) -> np.ndarray:
  """Returns values per vertex in the order of the nodes, -1 for padding."""
  return np.where(vert >= 0, values[vert], -1).astype(np.int32)
