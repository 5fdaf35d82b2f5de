"""Springs that hold an organ's nodes beside what the tissue does, and the bodies that feel them."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import numpy as np
import warp as wp
from palpate.tissue import body as bodies
from palpate.tissue.types import doubles, ints, struct

from . import mjstruct


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
  xpos: doubles("nbody", 3)
  xmat: doubles("nbody", 9)
  cvel: doubles("nbody", 6)
  cdof: doubles("nv", 6)
  qacc_warmstart: doubles("nv")
  subtree_com: doubles("nbody", 3)
  geom_xpos: doubles("ngeom", 3)
  geom_xmat: doubles("ngeom", 9)
  qfrc_passive: doubles("nv")


class Hold:
  """`State.hold` of a workspace's body, and what the CPU writes for it; not there until asked for.

  Args:
    w: the workspace
  """

  def __init__(self, w):
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
