"""What acts on an organ beside its tissue: springs that hold its nodes, and what feels them.

`Beside` is what ties, bonds, supports and relaxation are to a step. All of them run on the CPU,
over an organ's `Nodes` and its solver's `Input`, and cost nothing where they are not used. In a
batch on a GPU the same kernels act in all worlds, see `palpate.batch.forces.base`.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from palpate.tissue import body as bodies
from palpate.tissue.kernels import Kernel
from palpate.tissue.types import doubles, fill, floats, ints, struct, vector

from .. import coupling
from ..layout import TAIL
from ..model import mjstruct

if TYPE_CHECKING:
  from ..model.declare import Declaration
  from ..workspace import Workspace


@struct
class Bodies:
  """MuJoCo's own memory, under its own names."""

  timestep: doubles(1)
  qpos0: doubles("nq")
  body_parentid: ints("nbody")
  body_rootid: ints("nbody")
  body_dofnum: ints("nbody")
  body_dofadr: ints("nbody")
  geom_bodyid: ints("ngeom")
  geom_type: ints("ngeom")
  geom_size: doubles("ngeom", 3)
  geom_aabb: doubles("ngeom", 6)
  qpos: doubles("nq")
  qvel: doubles("nv")
  xpos: doubles("nbody", 3)
  xmat: doubles("nbody", 9)
  cvel: doubles("nbody", 6)
  cdof: doubles("nv", 6)
  qacc_warmstart: doubles("nv")
  subtree_com: doubles("nbody", 3)
  geom_xpos: doubles("ngeom", 3)
  geom_xmat: doubles("ngeom", 9)
  qfrc_passive: doubles("nv")


@struct
class Nodes:
  """Where an organ's vertices are: in MuJoCo's memory, or with windows in the plugin state."""

  windowed: int  # whether it is in the plugin state
  rest: doubles("nvert", 3)  # rest position [m]
  disp: doubles("nvert", 3)  # displacement, of an organ with windows [m]
  vel: doubles("nvert", 3)  # velocity, of one with windows [m/s]
  qposadr: ints("nvert")  # first qpos, of one without; -1 for pinned ones
  dofadr: ints("nvert")  # first dof
  frame: doubles(3, 3)  # rotation from the organ's axes to the world
  origin: doubles(3)  # position of its frame [m]


@struct
class Input:
  """What an organ's solver is given, and what it finds."""

  node: ints("nvert")  # node of each vertex
  quiet: doubles("nworld")  # how long it has been at rest [s]
  hold: floats("nworld", "nholdslice", 6, 8)
  force_ext: vector
  vel: vector
  dvel: vector
  status: floats("nworld", 4)


class Beside:
  """What acts on a workspace's organ beside its tissue; by itself nothing.

  Args:
    w: the workspace

  Attributes:
    KEYS: configuration keys that ask for it
    ENTER, ACT, END: kernels of `enter`, `act` and `end`, None for nothing
    fields: what they take, made by `bind`
  """

  KEYS: tuple[str, ...]
  ENTER: Kernel | None = None
  ACT: Kernel | None = None
  END: Kernel | None = None

  def __init__(self, w: "Workspace"):
    self._w = w
    self.fields: Any = None

  def load(self):
    """Loads the kernels, if there is something to do for them."""
    if self and self.ENTER is not None:
      self.ENTER.load(wp.get_device("cpu"))

  def bind(self, model: int):
    """Points the kernels at the arrays of a model and of the workspace's mjData."""

  def carry(self, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """Gives vertices that a cut has divided their part of what the plugin state has of them.

    Args:
      group: of vertices that were one, which  (n,)
      member: those vertices                   (n,)
      share: their part of its area            (n,)
    """

  def reshape(self) -> list:
    """Follows the organ's mesh, which was cut or has healed.

    Returns:
      workspaces whose graphs have to be recorded anew: there was no more room
    """
    return []

  def enter(self):
    """Adds to the solver's input, after a coupling has filled it."""
    self._launch(self.ENTER)

  def act(self):
    """Lets bodies feel what has acted."""
    self._launch(self.ACT)

  def end(self):
    """Takes into the plugin state what the step has made of it."""
    self._launch(self.END)

  def _launch(self, kernel: Kernel | None):
    if self and kernel is not None:
      kernel.launch("cpu", 1, 1, 0, self.fields)

  def rows(self, block: str, width: int) -> wp.array:
    """Returns a block of the plugin state as kernels take it, (n, width)."""
    where, state = coupling.spans(self._w.organ)[block], self._w.views["plugin_state"]
    shape = (where.stop - where.start) // width, width
    return wp.array(ptr=state.ptr + 8 * where.start, dtype=wp.float64, shape=shape, device="cpu")


def nodes(w: "Workspace"):
  """Returns `Nodes` of a workspace."""
  organ = w.organ
  windowed = organ.windows is not None
  motion = w.boxes["own"].motion if windowed else None
  none = np.zeros((0, 3))
  values = dict(
    windowed=int(windowed),
    rest=base(organ),
    disp=motion.disp if motion else none,
    vel=motion.vel if motion else none,
    qposadr=organ.qposadr,
    dofadr=organ.dofadr,
    frame=organ.frame,
    origin=organ.origin,
  )
  return fill(Nodes, "cpu", values)


def base(organ: "Declaration") -> np.ndarray:
  """Returns what displacements here are from: nodal, qpos0 whatever was cut [m], (nvert, 3)."""
  return organ.mesh.rest if organ.windows else organ.mesh.whole.rest


def solver(w: "Workspace"):
  """Returns `Input` of a workspace."""
  values = {name: w.host[name] for name in ("force_ext", "vel", "dvel", "status")}
  node = w.body.shape.node.numpy()
  return fill(Input, "cpu", values | {"node": node, "quiet": quiet(w), "hold": w.hold.array})


def quiet(w: "Workspace") -> np.ndarray | wp.array:
  """Returns where a workspace has how long its organ has been at rest [s], (1,)."""
  if w.organ.windows:
    return coupling.wrap(w.boxes["own"].tail.ptr + 8 * TAIL.quiet, 1)
  return np.zeros(1)


class Hold:
  """`State.hold` of a workspace's body, and what the CPU writes for it; not there until asked for.

  Args:
    w: the workspace
  """

  def __init__(self, w: "Workspace"):
    self._w = w
    self.array: wp.array | None = None

  def __bool__(self) -> bool:
    return self.array is not None

  def need(self):
    """Makes it."""
    if self.array is None:
      there = bodies.hold(self._w.body)
      cuda = self._w.body.device.is_cuda
      self.array = wp.zeros_like(there, device="cpu", pinned=True) if cuda else there

  def clear(self):
    """Takes all springs away, before a step's are put."""
    assert self.array is not None
    self.array.zero_()

  def cross(self):
    """Brings the springs to the device of the solve."""
    there = self._w.body.state.hold
    if there.device.is_cuda and self.array is not None:
      wp.copy(there, self.array)


def may_move(m, body) -> bool:
  """Returns whether one of these bodies may move: all but what is welded to the world."""
  return bool(mjstruct.view(m.body_weldid, m.nbody, np.int32)[body].any())
