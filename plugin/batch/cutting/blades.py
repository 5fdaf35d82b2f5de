"""What a batch tells of the geoms that cut an organ: arrays on the device, and a sensor's force."""

import warp as wp
from palpate.engine.layout import BLADE
from palpate.forces import cutters
from palpate.forces.host import for_worlds
from palpate.tissue.types import allocate, floats, struct, tuple_of

_WorldBlades = for_worlds(cutters.Blades)
_STAGE, _WORK, _OPENED, _AT = (
  wp.constant(k) for k in (BLADE.stage, BLADE.work, BLADE.opened, BLADE.at)
)


@wp.func
def _turned(f: wp.array2d[wp.float64], c: int, x: wp.float64, y: wp.float64, z: wp.float64):
  return f[c, 0] * x + f[c, 1] * y + f[c, 2] * z


@struct
class Told:
  """What cuts an organ in all worlds, in the order of its key `cutters`."""

  inside: floats("nworld", "nblade")  # 1 where it has gone through the wall and is there
  force: floats("nworld", "nblade", 3)  # on the tissue in the last step [N]
  energy: floats("nworld", "nblade")  # that opening the tissue has taken [J]
  length: floats("nworld", "nblade")  # of its paths so far, at rest [m]
  seat: floats("nworld", "nblade", 3)  # where it is in the tissue at rest [m]


class Cutters(tuple_of(Told)):
  """The arrays of `Told`."""


@wp.kernel(enable_backward=False)
def _show(b: _WorldBlades, out: Told):
  """Writes what cutters do, in the world's axes."""
  w, i = wp.tid()
  out.inside[w, i] = wp.where(b.state[w, i, _STAGE] == wp.float64(2.0), 1.0, 0.0)
  out.energy[w, i] = float(b.state[w, i, _WORK])
  out.length[w, i] = float(b.state[w, i, _OPENED])
  f = b.own.frame
  for c in range(3):
    turned = _turned(f, c, b.force[w, i, 0], b.force[w, i, 1], b.force[w, i, 2])
    out.force[w, i, c] = float(turned)
    at = _turned(f, c, b.state[w, i, _AT], b.state[w, i, _AT + 1], b.state[w, i, _AT + 2])
    out.seat[w, i, c] = float(b.own.origin[c] + at)


@wp.kernel(enable_backward=False)
def _feel(b: _WorldBlades, adr: int, data: wp.array2d[float]):
  """Adds the force on the tissue to a sensor."""
  w = wp.tid()
  f = b.own.frame
  for i in range(b.nblade):
    for c in range(3):
      turned = _turned(f, c, b.force[w, i, 0], b.force[w, i, 1], b.force[w, i, 2])
      data[w, adr + c] = data[w, adr + c] + float(turned)


class Shown:
  """Arrays of what cutters do.

  Args:
    force: the cutters
  """

  def __init__(self, force: cutters.Cutters):
    self._force = force
    sizes = {"nworld": force.host.nworld, "nblade": len(force.names)}
    self._told = allocate(Told, force.host.device, sizes)

  def read(self) -> Cutters:
    """Returns what they do."""
    dim, inputs = self._told.inside.shape, [self._force.fields, self._told]
    wp.launch(_show, dim=dim, inputs=inputs, device=self._force.host.device)
    return Cutters.of(self._told)


def feel(force: cutters.Cutters, adr: int, data: wp.array):
  """Adds the force of cutters to a sensor of three numbers."""
  inputs = [force.fields, adr, data]
  wp.launch(_feel, dim=force.host.nworld, inputs=inputs, device=force.host.device)
