"""Metrics of an episode, added up in each control step: those of `tasks.metrics` by their names.

Not those that need the whole signal at once, filtered or as a spectrum, nor areas and strains: what
is not in `NAMES` a recording of the single environment has.
"""

import enum

import warp as wp
from palpate.tasks.metrics import METRICS
from palpate.tasks.metrics import force as pressing
from palpate.tissue.types import Array, doubles, floats, ints, struct

from .fields import Common
from .kernels import forces, vector

NAMES = (
  "time", "path_length", "mean_speed", "peak_speed", "contact_speed", "economy_of_volume",
  "path_inefficiency",
  "depth_path", "angular_path", "response_orientation", "errors", "target_error",
  "peak_force", "mean_force", "rms_force", "force_time_product", "force_breaches",
  "excess_impulse", "shaft_contact", "peak_shaft_force", "peak_surroundings_force",
  "peak_grip", "mean_grip", "grip_breaches", "grip_ratio", "grasp_slips",
)  # fmt: skip
M = enum.IntEnum("M", NAMES, start=0)  # columns of `Tally.values`
_SETTLE = wp.constant(pressing.SETTLE)
_LONG = wp.constant(1 << 30)  # steps ago: never
_TIP, _GRIP = wp.constant(0), wp.constant(1)


@struct
class Tally:
  """Sums of the episode so far; of forces a column for the tip and one for the jaws' grip."""

  contact: float  # force above which there is contact [N]
  limit: float  # of force and grip [N]
  grips: int  # whether the grip has one
  h: wp.float64  # step of the physics [s]
  values: floats("nworld", len(NAMES))
  pos: floats("nworld", 3)  # of the tip, a control step ago [m]
  quat: floats("nworld", 4)
  low: Array(wp.vec3, ("nworld",))  # of the path [m]
  high: Array(wp.vec3, ("nworld",))
  path: doubles("nworld")  # [m]
  fastest: doubles("nworld")  # longest way in a control step [m]
  rush: doubles("nworld")  # that in one with contact [m]
  depth: doubles("nworld")  # [m]
  turned: doubles("nworld")  # [rad]
  rolled: doubles("nworld")  # [rad]
  peak: doubles("nworld", 2)  # [N]
  last: doubles("nworld", 2)  # force of the last step [N]
  product: doubles("nworld", 2)  # force over time in contact [N s]
  square: doubles("nworld", 2)  # [N^2 s]
  touched: doubles("nworld", 2)  # time in contact [s]
  excess: doubles("nworld")  # [N s]
  since: ints("nworld", 2)  # steps since the limit was breached
  breaches: ints("nworld", 2)
  shaft_peak: doubles("nworld")  # [N]
  shaft_last: doubles("nworld")  # [N]
  shaft_time: doubles("nworld")  # [s]
  around_peak: doubles("nworld")  # on what is around [N]
  pulled: doubles("nworld")  # impulse of the tip while the jaws grip [N s]
  gripped: doubles("nworld")  # impulse of the grip meanwhile [N s]


@wp.kernel(enable_backward=False)
def start(s: Common, t: Tally):
  """Begins with nothing where an episode begins."""
  w = wp.tid()
  if not s.begun[w]:
    return
  _stay(s, t, w)
  t.low[w] = vector(s.tip_pos, w)
  t.high[w] = vector(s.tip_pos, w)
  zero = wp.float64(0.0)
  t.path[w] = zero
  t.fastest[w] = zero
  t.rush[w] = zero
  t.depth[w] = zero
  t.turned[w] = zero
  t.rolled[w] = zero
  t.excess[w] = zero
  t.shaft_peak[w] = zero
  t.shaft_last[w] = zero
  t.shaft_time[w] = zero
  t.around_peak[w] = zero
  t.pulled[w] = zero
  t.gripped[w] = zero
  for q in range(2):
    t.peak[w, q] = zero
    t.last[w, q] = zero
    t.product[w, q] = zero
    t.square[w, q] = zero
    t.touched[w, q] = zero
    t.since[w, q] = _LONG
    t.breaches[w, q] = 0


@wp.func
def _stay(s: Common, t: Tally, w: int):
  """Keeps where the tip is."""
  for k in range(3):
    t.pos[w, k] = s.tip_pos[w, k]
  for k in range(4):
    t.quat[w, k] = s.tip_quat[w, k]


@wp.func
def _shaft(q: wp.array2d[float], w: int):
  """Returns the direction of the shaft."""
  x, y, z, r = q[w, 1], q[w, 2], q[w, 3], q[w, 0]
  return wp.vec3(-2.0 * (x * z + r * y), -2.0 * (y * z - r * x), 2.0 * (x * x + y * y) - 1.0)


@wp.func
def _move(s: Common, t: Tally, w: int):
  """Adds the way of a control step; returns it [m]."""
  way = vector(s.tip_pos, w) - vector(t.pos, w)
  far = wp.float64(wp.length(way))
  t.path[w] = t.path[w] + far
  t.fastest[w] = wp.max(t.fastest[w], far)
  middle = wp.normalize(_shaft(s.tip_quat, w) + _shaft(t.quat, w))
  t.depth[w] = t.depth[w] + wp.float64(wp.abs(wp.dot(way, middle)))
  t.low[w] = wp.min(t.low[w], vector(s.tip_pos, w))
  t.high[w] = wp.max(t.high[w], vector(s.tip_pos, w))
  v = wp.vec3(t.quat[w, 1], t.quat[w, 2], t.quat[w, 3])
  u = wp.vec3(s.tip_quat[w, 1], s.tip_quat[w, 2], s.tip_quat[w, 3])
  real = t.quat[w, 0] * s.tip_quat[w, 0] + wp.dot(v, u)
  turn = t.quat[w, 0] * u - s.tip_quat[w, 0] * v - wp.cross(v, u)
  side = wp.where(real < 0.0, -1.0, 1.0)
  t.turned[w] = t.turned[w] + wp.float64(2.0 * wp.atan2(wp.length(turn), side * real))
  roll = wp.abs(2.0 * wp.atan2(side * turn[2], side * real))
  t.rolled[w] = t.rolled[w] + wp.float64(roll)
  _stay(s, t, w)
  return far


@wp.func
def _press(t: Tally, w: int, q: int, force: float):
  """Adds the force of a step of the physics."""
  f, limit = wp.float64(force), wp.float64(t.limit)
  t.peak[w, q] = wp.max(t.peak[w, q], f)
  if force > t.contact:
    t.product[w, q] = t.product[w, q] + t.h * f
    t.square[w, q] = t.square[w, q] + t.h * f * f
    t.touched[w, q] = t.touched[w, q] + t.h
  since = t.since[w, q]
  if force > t.limit:
    if since == _LONG or (since > 0 and wp.float64(since + 1) * t.h > wp.float64(_SETTLE)):
      t.breaches[w, q] = t.breaches[w, q] + 1
    t.since[w, q] = 0
  elif since < _LONG:
    t.since[w, q] = since + 1
  if q == _TIP:
    zero = wp.float64(0.0)
    a, b = t.last[w, q] - limit, f - limit
    above, whole = wp.max(a, zero) + wp.max(b, zero), wp.abs(a) + wp.abs(b)
    if whole > zero:
      t.excess[w] = t.excess[w] + wp.float64(0.5) * t.h * above * above / whole
  t.last[w, q] = f


@wp.kernel(enable_backward=False)
def add(s: Common, t: Tally):
  """Adds a control step."""
  w = wp.tid()
  far = _move(s, t, w)
  touched = t.touched[w, _TIP]
  for k in range(s.sensor_steps.shape[1]):
    found = forces(s, w, k)
    force, shaft = found[0], found[1]
    t.around_peak[w] = wp.max(t.around_peak[w], wp.float64(found[2]))
    _press(t, w, _TIP, force)
    t.shaft_last[w] = wp.float64(shaft)
    t.shaft_peak[w] = wp.max(t.shaft_peak[w], wp.float64(shaft))
    if shaft > t.contact:
      t.shaft_time[w] = t.shaft_time[w] + t.h
    if s.jaw >= 0:
      grip = wp.max(s.sensor_steps[w, k, s.sensoradr[2]], s.sensor_steps[w, k, s.sensoradr[3]])
      _press(t, w, _GRIP, grip)
      if force > t.contact and grip > t.contact:
        t.pulled[w] = t.pulled[w] + t.h * wp.float64(force)
        t.gripped[w] = t.gripped[w] + t.h * wp.float64(grip)
  if t.touched[w, _TIP] > touched:
    t.rush[w] = wp.max(t.rush[w], far)
  _tell(s, t, w)


@wp.func
def _share(part: wp.float64, whole: wp.float64):
  """Returns a quotient, unknown where nothing was there."""
  return wp.where(whole > wp.float64(0.0), float(part / whole), wp.nan)


@wp.func
def _inefficiency(s: Common, w: int, path: wp.float64):
  """Returns by how much a path is longer than the task's, of one that was finished [%]."""
  longer = 100.0 * (_share(path, wp.float64(s.reference[w])) - 1.0)
  return wp.where(s.success[w], longer, wp.nan)


@wp.func
def _end(t: Tally, w: int, q: int):
  """Returns for how long less than a step the last force counts: ends count half [s]."""
  half = wp.float64(0.5) * t.h
  return wp.where(t.last[w, q] > wp.float64(t.contact), half, wp.float64(0.0))


@wp.func
def _tell_force(t: Tally, w: int, q: int, peak: int, mean: int, breaches: int):
  """Writes what tip and grip have both."""
  half = _end(t, w, q)
  product, touched = t.product[w, q] - half * t.last[w, q], t.touched[w, q] - half
  was = t.touched[w, q] > wp.float64(0.0)
  t.values[w, peak] = wp.where(was, float(t.peak[w, q]), wp.nan)
  t.values[w, mean] = _share(product, touched)
  t.values[w, breaches] = wp.where(was, float(t.breaches[w, q]), wp.nan)


@wp.func
def _tell(s: Common, t: Tally, w: int):
  """Writes the metrics of the episode so far."""
  time = wp.float64(s.dt) * wp.float64(s.step[w])
  path, size = t.path[w], t.high[w] - t.low[w]
  moved = path > wp.float64(0.0)
  t.values[w, M.time] = float(time)
  t.values[w, M.path_length] = wp.where(moved, float(path), wp.nan)
  t.values[w, M.mean_speed] = wp.where(moved, float(path / time), wp.nan)
  t.values[w, M.peak_speed] = wp.where(moved, float(t.fastest[w]) / s.dt, wp.nan)
  met = t.touched[w, _TIP] > wp.float64(0.0)
  t.values[w, M.contact_speed] = wp.where(met, float(t.rush[w]) / s.dt, wp.nan)
  side = wp.pow(size[0] * size[1] * size[2], 1.0 / 3.0)
  t.values[w, M.economy_of_volume] = _share(wp.float64(side), path)
  t.values[w, M.path_inefficiency] = _inefficiency(s, w, path)
  t.values[w, M.depth_path] = wp.where(moved, float(t.depth[w]), wp.nan)
  t.values[w, M.angular_path] = wp.where(moved, float(t.turned[w]), wp.nan)
  t.values[w, M.response_orientation] = wp.where(moved, float(t.rolled[w]), wp.nan)
  t.values[w, M.errors] = float(s.errors[w])
  t.values[w, M.target_error] = _share(wp.float64(s.missed_by[w]), wp.float64(s.targets[w]))
  _tell_force(t, w, _TIP, M.peak_force, M.mean_force, M.force_breaches)
  half = _end(t, w, _TIP)
  last = t.last[w, _TIP]
  square = _share(t.square[w, _TIP] - half * last * last, t.touched[w, _TIP] - half)
  t.values[w, M.rms_force] = wp.sqrt(square)
  was = t.touched[w, _TIP] > wp.float64(0.0)
  t.values[w, M.force_time_product] = wp.where(was, float(t.product[w, _TIP] - half * last), wp.nan)
  t.values[w, M.excess_impulse] = wp.where(was, float(t.excess[w]), wp.nan)
  lies = wp.where(t.shaft_last[w] > wp.float64(t.contact), wp.float64(0.5) * t.h, wp.float64(0.0))
  t.values[w, M.shaft_contact] = float(t.shaft_time[w] - lies)
  t.values[w, M.peak_shaft_force] = float(t.shaft_peak[w])
  t.values[w, M.peak_surroundings_force] = wp.where(s.around >= 0, float(t.around_peak[w]), wp.nan)
  _tell_force(t, w, _GRIP, M.peak_grip, M.mean_grip, M.grip_breaches)
  if t.grips == 0:
    t.values[w, M.grip_breaches] = wp.nan
  end = wp.min(_end(t, w, _TIP), _end(t, w, _GRIP))
  gripped = t.gripped[w] - end * t.last[w, _GRIP]
  t.values[w, M.grip_ratio] = _share(gripped, t.pulled[w] - end * last)
  t.values[w, M.grasp_slips] = wp.where(s.grasps[w] > 0, float(s.slips[w]), wp.nan)


_SUM, _MAX, _MEAN = (wp.constant(k) for k in range(3))
_HOWS = [("sum", "max", "mean", "all").index(METRICS[name].combine) for name in NAMES]


@wp.kernel(enable_backward=False)
def join(s: Common, t: Tally, other: Tally, how: wp.array[int]):
  """Makes metrics of both hands together of those of each, see `Recording.metrics`."""
  w, k = wp.tid()
  a, b = t.values[w, k], other.values[w, k]
  if how[k] > _MEAN:  # they are of the whole
    if k == M.path_inefficiency:
      t.values[w, k] = _inefficiency(s, w, t.path[w] + other.path[w])
  elif wp.isnan(a) or wp.isnan(b):
    t.values[w, k] = wp.where(wp.isnan(a), b, a)
  elif how[k] == _MAX:
    t.values[w, k] = wp.max(a, b)
  else:
    t.values[w, k] = wp.where(how[k] == _SUM, a + b, 0.5 * (a + b))


def hows(device) -> wp.array:
  """Returns how each metric is made of those of two hands."""
  return wp.array(_HOWS, dtype=int, device=device)


def names(jaws: bool) -> tuple[str, ...]:
  """Returns the metrics of an instrument, with jaws or without."""
  return NAMES if jaws else NAMES[: M.peak_grip]
