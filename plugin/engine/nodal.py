"""Nodal coupling: an organ whose moving nodes are MuJoCo's degrees of freedom."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import numpy as np
import warp as wp
from palpate.tissue import step
from palpate.tissue.types import doubles, fill, ints, struct

from . import coupling, layout, mjstruct
from .coupling import Crossing, Mujoco
from .layout import FLAG, NodalState


@struct
class Nodal:
  """A nodal organ in MuJoCo's arrays and in the solver's; nodes are padded to whole slices."""

  nnode: int  # nodes
  rest_share: float  # see `step.REST`
  dofadr: ints("nnode")  # first dof of a node, -1 for pinned ones and padding
  qposadr: ints("nnode")  # its first number in qpos
  bodyid: ints("nnode")  # its body
  stateadr: ints("nnode")  # its first number in a block of the plugin state
  massadr: ints("nnode", 3)  # where M has the diagonals of its dofs
  frame: doubles(3, 3)  # rotation from the slides' axes to the world
  heaviest: doubles(1)  # see `Workspace`
  number: doubles("nnumber")  # see `NUMBERS`
  flags: ints(len(FLAG))  # see FLAG
  lagged: doubles("nnode", 3)  # external and lagged contact force [N]
  own: NodalState
  mj: Mujoco
  solve: Crossing


gather, scatter, push, remember = coupling.kernels(
  "nodal.h", Nodal, "gather_nodes", "scatter_nodes", "push_nodes", "remember_nodes"
)


def state_size(nfree: int, ncreep: int = 0, nbond: int = 0) -> int:
  """Returns the length of the plugin state of `nfree` degrees of freedom; see `coupling.sizes`."""
  return layout.size(NodalState, {"nfree": nfree, "ncreep": ncreep, "nbond": nbond})


class Phases(coupling.Phases):
  """Nodal coupling of a workspace's organ."""

  side = "cpu"

  def __init__(self, w, model: int, instance: int):
    m, organ, s = mjstruct.Model.from_address(model), w.organ, w.body.shape
    vert = s.vert.numpy()
    dofadr = _in_node_order(organ.dofadr, vert)
    dofs = np.maximum(dofadr, 0)[:, None] + np.arange(3)
    sizes = coupling.sizes(organ)
    state = coupling.plugin_state(model, w.data, instance, layout.size(NodalState, sizes))
    values = dict(
      nnode=s.nnode,
      rest_share=step.REST,
      dofadr=dofadr,
      qposadr=_in_node_order(organ.qposadr, vert),
      bodyid=_in_node_order(organ.body, vert),
      stateadr=_in_node_order(organ.stateadr, vert),
      massadr=np.where(dofadr[:, None] >= 0, coupling.mass_addresses(m, dofs), -1),
      frame=organ.frame,
      heaviest=wp.array(w.heaviest, dtype=wp.float64, device="cpu", copy=False),
      number=w.body.numbers,
      flags=wp.array(np.asarray(w.flags), dtype=int, device="cpu", copy=False),
      lagged=w.lagged,
      own=layout.carve(NodalState, state, sizes),
      mj=coupling.mujoco_arrays(model, w.data),
      solve=coupling.crossing(w.host),
    )
    w.views["plugin_state"] = state
    self._nodal = fill(Nodal, "cpu", values)

  def _launch(self, kernel):
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


def _in_node_order(values: np.ndarray, vert: np.ndarray) -> np.ndarray:
  """Returns values per vertex in the order of the nodes, -1 for padding."""
  return np.where(vert >= 0, values[vert], -1).astype(np.int32)
