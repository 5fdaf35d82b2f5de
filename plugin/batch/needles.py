"""What needles do in the worlds of a batch."""

# pyright: reportInvalidTypeForm=false
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp
from palpate.engine.coupling import CONSTANTS
from palpate.engine.layout import HOLES
from palpate.forces import needles
from palpate.forces.host import for_worlds
from palpate.tissue.kernels import kernel
from palpate.tissue.types import allocate, floats, ints, struct


class Needles(NamedTuple):
  """Needles of an organ in all worlds, in the order of its key `needles`.

  Of holes there is room for 20, the first made first; those from `count` on are of no use.

  Attributes:
    touches: 1 where its tip is pressed on a surface                          (nworld, n)
    inside: 1 where its tip is in a solid                                     (nworld, n)
    force: of the whole needle on the organ in the last step [N]           (nworld, n, 3)
    tip_force: that of its tip [N]                                         (nworld, n, 3)
    energy: that piercing and cutting have taken [J]                          (nworld, n)
    count: its holes                                                          (nworld, n)
    hole_inside: 1 where a hole is a point inside of a solid              (nworld, n, 20)
    hole_thread: 1 where the needle's thread is in it                     (nworld, n, 20)
    hole_at: where it is now [m]                                       (nworld, n, 20, 3)
    hole_rest: the same at rest [m]                                    (nworld, n, 20, 3)
    hole_along: where along the needle, see `Pinhole` [m]                 (nworld, n, 20)
    hole_force: on the organ in the last step [N]                      (nworld, n, 20, 3)
    hole_torn: how far it has torn through the tissue [m]                 (nworld, n, 20)
  """

  touches: wp.array
  inside: wp.array
  force: wp.array
  tip_force: wp.array
  energy: wp.array
  count: wp.array
  hole_inside: wp.array
  hole_thread: wp.array
  hole_at: wp.array
  hole_rest: wp.array
  hole_along: wp.array
  hole_force: wp.array
  hole_torn: wp.array


_OF_HOLES = [name for name in Needles._fields if name.startswith("hole_")]
_OF_NEEDLES = ("touches", "inside", "force", "tip_force", "energy")


@struct
class ToldNeedles:
  """Arrays of `Needles`."""

  touches: floats("nworld", "nneedle")
  inside: floats("nworld", "nneedle")
  force: floats("nworld", "nneedle", 3)
  tip_force: floats("nworld", "nneedle", 3)
  energy: floats("nworld", "nneedle")
  count: ints("nworld", "nneedle")
  hole_inside: floats("nworld", "nneedle", HOLES)
  hole_thread: floats("nworld", "nneedle", HOLES)
  hole_at: floats("nworld", "nneedle", HOLES, 3)
  hole_rest: floats("nworld", "nneedle", HOLES, 3)
  hole_along: floats("nworld", "nneedle", HOLES)
  hole_force: floats("nworld", "nneedle", HOLES, 3)
  hole_torn: floats("nworld", "nneedle", HOLES)


@struct
class Telling:
  """Needles, and what is told of them."""

  pierced: for_worlds(needles.Pierced)
  told: ToldNeedles


_tell = kernel("tell_needles", "forces/needles.h", Telling, CONSTANTS)


class Shown:
  """Arrays of what needles do.

  Args:
    force: the needles
  """

  def __init__(self, force: needles.Needles):
    self._force, host = force, force.host
    self._telling = Telling()
    sizes = {"nworld": host.nworld, "nneedle": len(force.names)}
    self._telling.told = allocate(ToldNeedles, host.device, sizes)
    self._telling.pierced = force.fields
    _tell.load(host.device)

  def read(self) -> Needles:
    """Returns what they do."""
    host = self._force.host
    _tell.launch(host.device, host.nworld, 1, 0, self._telling, 32)
    return _as_tuple(self._telling.told)


def gathered(every: Sequence[tuple[needles.Needle, ...]]) -> Needles:
  """Returns arrays of what the needles of each world do."""
  told = allocate(ToldNeedles, "cpu", {"nworld": len(every), "nneedle": len(every[0])})
  out = {name: getattr(told, name).numpy() for name in Needles._fields}
  for at in np.ndindex(out["count"].shape):
    needle = every[at[0]][at[1]]
    for name in _OF_NEEDLES:
      out[name][at] = getattr(needle, name)
    out["count"][at] = len(needle.holes)
    for k, hole in enumerate(needle.holes):
      for name in _OF_HOLES:
        out[name][(*at, k)] = getattr(hole, name.removeprefix("hole_"))
  return _as_tuple(told)


def _as_tuple(told) -> Needles:
  return Needles(*(getattr(told, name) for name in Needles._fields))
