"""What needles do in the worlds of a batch."""

from collections.abc import Sequence

import numpy as np
from palpate.engine.coupling import CONSTANTS
from palpate.engine.layout import HOLES
from palpate.forces import needles
from palpate.forces.host import for_worlds
from palpate.tissue.kernels import kernel
from palpate.tissue.types import allocate, floats, ints, struct, tuple_of


@struct
class ToldNeedles:
  """Needles of an organ in all worlds, in the order of its key `needles`.

  Of holes there is room for 20, the first made first; those from `count` on are of no use.
  """

  touches: floats("nworld", "nneedle")  # 1 where its tip is pressed on a surface
  inside: floats("nworld", "nneedle")  # 1 where its tip is in a solid
  force: floats("nworld", "nneedle", 3)  # of the whole needle on the organ in the last step [N]
  tip_force: floats("nworld", "nneedle", 3)  # that of its tip [N]
  energy: floats("nworld", "nneedle")  # that piercing and cutting have taken [J]
  count: ints("nworld", "nneedle")  # its holes
  hole_inside: floats("nworld", "nneedle", HOLES)  # 1 where a hole is a point inside of a solid
  hole_thread: floats("nworld", "nneedle", HOLES)  # 1 where the needle's thread is in it
  hole_at: floats("nworld", "nneedle", HOLES, 3)  # where it is now [m]
  hole_rest: floats("nworld", "nneedle", HOLES, 3)  # the same at rest [m]
  hole_along: floats("nworld", "nneedle", HOLES)  # where along the needle, see `Pinhole` [m]
  hole_force: floats("nworld", "nneedle", HOLES, 3)  # on the organ in the last step [N]
  hole_torn: floats("nworld", "nneedle", HOLES)  # how far it has torn through the tissue [m]


class Needles(tuple_of(ToldNeedles)):
  """The arrays of `ToldNeedles`."""


_OF_HOLES = [name for name in ToldNeedles.vars if name.startswith("hole_")]
_OF_NEEDLES = ("touches", "inside", "force", "tip_force", "energy")


@struct
class Telling:
  """Needles, and what is told of them."""

  pierced: for_worlds(needles.Pierced)
  told: ToldNeedles


_tell = kernel("tell_needles", "forces/needles.h", Telling, CONSTANTS, tag=".worlds", own=True)


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
    return Needles.of(self._telling.told)


def gathered(every: Sequence[tuple[needles.Needle, ...]]) -> Needles:
  """Returns arrays of what the needles of each world do."""
  told = allocate(ToldNeedles, "cpu", {"nworld": len(every), "nneedle": len(every[0])})
  out = {name: getattr(told, name).numpy() for name in ToldNeedles.vars}
  for at in np.ndindex(out["count"].shape):
    needle = every[at[0]][at[1]]
    for name in _OF_NEEDLES:
      out[name][at] = getattr(needle, name)
    out["count"][at] = len(needle.holes)
    for k, hole in enumerate(needle.holes):
      for name in _OF_HOLES:
        out[name][(*at, k)] = getattr(hole, name.removeprefix("hole_"))
  return Needles.of(told)
