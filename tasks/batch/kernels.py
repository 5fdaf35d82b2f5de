"""What every vectorised exercise does in its worlds, a thread a world."""

import warp as wp
from palpate.tasks.core import base, jaws, safety
from palpate.tasks.core.physics import NEAR
from palpate.tissue.types import Array, floats, ints, struct

from .fields import DAMAGED, RUNNING, SUCCESS, Common

parts = wp.func(safety.parts)

_SHARE, _PRICE = wp.constant(base.SHARE), wp.constant(base.PRICE)
_MOST = wp.constant(base.MOST)
_SLACK = wp.constant(base.SLACK)
_ROOT = wp.constant(0.5**0.5)  # of a quarter turn's quaternion
_NEAR, _FACING = wp.constant(NEAR), wp.constant(jaws.FACING)
_distances = wp.types.vector(length=NEAR, dtype=float)
_numbers = wp.types.vector(length=NEAR, dtype=int)


# Vectors of arrays.


@wp.func
def vector(values: wp.array(dtype=float, ndim=2), w: int):
  """Returns the vector in a row."""
  return wp.vec3(values[w, 0], values[w, 1], values[w, 2])


@wp.func
def put(values: wp.array(dtype=float, ndim=2), w: int, v: wp.vec3):
  """Writes a vector into a row."""
  for k in range(3):
    values[w, k] = v[k]


@wp.func
def entry(values: wp.array(dtype=float, ndim=3), w: int, k: int):
  """Returns the vector in entry k of a row."""
  return wp.vec3(values[w, k, 0], values[w, k, 1], values[w, k, 2])


@wp.func
def node(s: Common, w: int, k: int):
  """Returns the position of a node [m]."""
  return entry(s.xpos, w, k)


@wp.func
def point(s: Common, w: int, triangle: int):
  """Returns the middle of a triangle [m]."""
  a, b = node(s, w, s.elem[triangle, 0]), node(s, w, s.elem[triangle, 1])
  return (a + b + node(s, w, s.elem[triangle, 2])) / 3.0


@wp.func
def normal(s: Common, w: int, triangle: int):
  """Returns the outward unit normal of a triangle."""
  a, b = node(s, w, s.elem[triangle, 0]), node(s, w, s.elem[triangle, 1])
  return wp.normalize(wp.cross(b - a, node(s, w, s.elem[triangle, 2]) - a))


@wp.kernel(enable_backward=False)
def write(at: wp.array[int], rows: wp.array2d[int], out: wp.array2d[int]):
  """Writes rows to their places."""
  k, i = wp.tid()
  out[at[k], i] = rows[k, i]


# A control step.


@wp.kernel(enable_backward=False)
def find_bad(action: wp.array(dtype=float, ndim=2), bad: wp.array(dtype=int)):
  """Finds an action that is not allowed: the greatest 1 + index, or 0."""
  w, k = wp.tid()
  if not (wp.abs(action[w, k]) <= 1.0 + _SLACK):  # nor a number
    wp.atomic_max(bad, 0, 1 + w * action.shape[1] + k)


@wp.kernel(enable_backward=False)
def act(s: Common):
  """Moves the drives' targets."""
  w = wp.tid()
  count = s.drive.shape[0]
  for k in range(count):
    target = s.ctrl[w, s.drive[k]] + wp.clamp(s.action[w, s.first + k], -1.0, 1.0) * s.move[k]
    s.ctrl[w, s.drive[k]] = wp.clamp(target, s.low[k], s.high[k])
  if s.fifth >= 0:
    share = 0.5 * (wp.clamp(s.action[w, s.first + count], -1.0, 1.0) + 1.0)
    s.ctrl[w, s.fifth] = s.low[count] + (s.high[count] - s.low[count]) * share


@wp.kernel(enable_backward=False)
def begin(s: Common):
  """Begins episodes: in the worlds of `begun`."""
  w = wp.tid()
  if not s.begun[w]:
    return
  for k in range(s.drive.shape[0]):
    s.ctrl[w, s.drive[k]] = s.pose[w, k]
  if s.fifth >= 0:
    s.ctrl[w, s.fifth] = 0.0
  s.step[w] = 0
  s.failed[w] = s.failures[w]
  s.outcome[w] = RUNNING
  s.harm[w] = 0.0
  s.paid[w] = 0.0
  s.progress[w, 0] = 0.0
  s.success[w] = False
  s.cost[w] = 0.0
  s.cost_force[w] = 0.0
  s.cost_shaft[w] = 0.0
  s.cost_surroundings[w] = 0.0
  s.cost_damage[w] = 0.0
  s.errors[w] = 0
  s.targets[w] = 0
  s.missed_by[w] = 0.0
  s.grasps[w] = 0
  s.slips[w] = 0


@wp.func
def _sensor(s: Common, w: int, k: int, adr: int):
  """Returns a sensor of three numbers in a step of the physics."""
  x = s.sensor_steps
  return wp.vec3(x[w, k, adr], x[w, k, adr + 1], x[w, k, adr + 2])


@wp.func
def forces(s: Common, w: int, k: int):
  """Returns the force of tissue on tip and shaft, and that on what is around, in a step [N]."""
  tip, shaft = _sensor(s, w, k, s.sensoradr[0]), _sensor(s, w, k, s.sensoradr[1])
  around = wp.vec3()
  if s.around >= 0:
    by_tip, by_shaft = _sensor(s, w, k, s.around), _sensor(s, w, k, s.around + 3)
    tip, shaft, around = tip - by_tip, shaft - by_shaft, by_tip + by_shaft
  return wp.vec3(wp.length(tip), wp.length(shaft), wp.length(around))


@wp.kernel(enable_backward=False)
def measure(s: Common, beginning: bool):
  """Measures the instrument: after a step, or where an episode begins."""
  w = wp.tid()
  if beginning and not s.begun[w]:
    return
  for k in range(s.drive.shape[0]):
    s.joints[w, k] = s.qpos[w, s.qposadr[k]]
    s.joint_vel[w, k] = s.qvel[w, s.dofadr[k]]
    s.drive_error[w, k] = s.ctrl[w, s.drive[k]] - s.joints[w, k]
  place(s, w)
  if s.head >= 0:
    s.camera_head[w, 0] = s.qpos[w, s.head]
  felt = wp.float32(0.0)
  most = wp.vec3()
  for k in range(3):
    s.contact_force[w, k] = 0.0
    s.tissue_force[w, k] = 0.0
    s.shaft_force[w, k] = 0.0
  if not beginning:
    for k in range(3):
      s.contact_force[w, k] = -s.sensordata[w, s.sensoradr[0] + k]
      s.tissue_force[w, k] = s.contact_force[w, k]
      if s.around >= 0:
        s.tissue_force[w, k] = s.contact_force[w, k] + s.sensordata[w, s.around + k]
      s.shaft_force[w, k] = -s.sensordata[w, s.sensoradr[1] + k]
    for k in range(s.sensor_steps.shape[1]):
      felt = wp.max(felt, wp.length(_sensor(s, w, k, s.sensoradr[0])))
      most = wp.max(most, forces(s, w, k))
  grip = wp.float32(0.0)
  if s.jaw >= 0:
    for k in range(2):
      s.gripper[w, 2 + k] = 0.0
      if not beginning:
        s.gripper[w, 2 + k] = s.sensordata[w, s.sensoradr[2 + k]]
        if s.drive.shape[0] == 4:  # a needle driver's grip is a needle's
          grip = wp.max(grip, s.sensor_mean[w, s.sensoradr[2 + k]])
    s.gripper[w, 0] = s.qpos[w, s.opening] + s.qpos[w, s.opening + 1]
    s.gripper[w, 1] = s.ctrl[w, s.jaw]
  s.peak_force[w, 0] = wp.max(felt, grip)
  s.tissue_peak[w] = wp.max(most[0], grip)
  s.shaft_peak[w] = most[1]
  s.around_peak[w] = most[2]


@wp.kernel(enable_backward=False)
def join(s: Common, other: Common):
  """Takes the largest forces of both hands."""
  w = wp.tid()
  s.peak_force[w, 0] = wp.max(s.peak_force[w, 0], other.peak_force[w, 0])
  s.tissue_peak[w] = wp.max(s.tissue_peak[w], other.tissue_peak[w])
  s.shaft_peak[w] = wp.max(s.shaft_peak[w], other.shaft_peak[w])
  s.around_peak[w] = wp.max(s.around_peak[w], other.around_peak[w])


@wp.func
def place(s: Common, w: int):
  """Finds the tip from the joints, see `models.trocar` and, for a wrist, `models.wrist`."""
  pitch, yaw, roll = s.joints[w, 0], s.joints[w, 1], s.joints[w, 2]
  sp, cp, sy, cy = wp.sin(pitch), wp.cos(pitch), wp.sin(yaw), wp.cos(yaw)
  far = s.depth - s.wrist[0] - s.wrist[1] + s.joints[w, 3]
  along = wp.vec3(sy, cy * sp, -cy * cp)
  by_pitch, by_yaw = wp.vec3(0.0, cy * cp, cy * sp), wp.vec3(cy, -sy * sp, sy * cp)
  vel = s.joint_vel[w, 3] * along
  vel += far * (s.joint_vel[w, 0] * by_pitch + s.joint_vel[w, 1] * by_yaw)
  port = wp.quat(s.body_quat[w, 1], s.body_quat[w, 2], s.body_quat[w, 3], s.body_quat[w, 0])
  tip = vector(s.body_pos, w) + wp.quat_rotate(port, far * along)
  vel = wp.quat_rotate(port, vel)
  q = port * wp.quat(wp.sin(0.5 * pitch), 0.0, 0.0, wp.cos(0.5 * pitch))
  q = q * wp.quat(0.0, -wp.sin(0.5 * yaw), 0.0, wp.cos(0.5 * yaw))
  turning = s.joint_vel[w, 0] * wp.quat_rotate(port, wp.vec3(1.0, 0.0, 0.0))
  turning -= s.joint_vel[w, 1] * wp.quat_rotate(q, wp.vec3(0.0, 1.0, 0.0))
  q = q * wp.quat(0.0, 0.0, -wp.sin(0.5 * roll), wp.cos(0.5 * roll))
  if s.drive.shape[0] > 4:
    turning -= s.joint_vel[w, 2] * wp.quat_rotate(q, wp.vec3(0.0, 0.0, 1.0))
    turning -= s.joint_vel[w, 4] * wp.quat_rotate(q, wp.vec3(0.0, 1.0, 0.0))
    half = 0.5 * s.joints[w, 4]
    q = q * wp.quat(0.0, -wp.sin(half), 0.0, wp.cos(half))
    link = wp.quat_rotate(q, wp.vec3(0.0, 0.0, -s.wrist[0]))
    tip += link
    vel += wp.cross(turning, link)
    turning += s.joint_vel[w, 5] * wp.quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
    half = 0.5 * s.joints[w, 5]
    q = q * wp.quat(wp.sin(half), 0.0, 0.0, wp.cos(half)) * wp.quat(0.0, 0.0, -_ROOT, _ROOT)
    link = wp.quat_rotate(q, wp.vec3(0.0, 0.0, -s.wrist[1]))
    tip += link
    vel += wp.cross(turning, link)
  put(s.tip_pos, w, tip)
  put(s.tip_vel, w, vel)
  s.tip_quat[w, 0] = q[3]
  for k in range(3):
    s.tip_quat[w, 1 + k] = q[k]


# Events, see `Task.event`.


@wp.func
def error(s: Common, w: int):
  """Counts a miss, a drop or a contact that was not meant."""
  s.errors[w] = s.errors[w] + 1


@wp.func
def judge(s: Common, w: int, progress: float, shaping: float, outcome: int):
  """Ends a control step that came to these, see `Rules`; a success is all of the progress."""
  over, lies, pushes, harmed = parts(
    s.tissue_peak[w], s.shaft_peak[w], s.around_peak[w], s.force_limit, s.damage
  )
  if lies > 0.0 and s.cost_shaft[w] == 0.0:
    error(s, w)
  if pushes > 0.0 and s.cost_surroundings[w] == 0.0:
    error(s, w)
  total = over + lies + pushes + harmed
  s.cost[w] = total
  s.cost_force[w] = over
  s.cost_shaft[w] = lies
  s.cost_surroundings[w] = pushes
  s.cost_damage[w] = harmed
  found = outcome
  now = progress
  if found == SUCCESS:
    now = 1.0
  if harmed > 0.0:
    found = DAMAGED
    now = -1.0
  paid = _SHARE * (now + shaping)
  if found == SUCCESS or found == DAMAGED:
    paid = now
  price = wp.min(_PRICE * total, _MOST - s.harm[w])
  s.harm[w] = s.harm[w] + price
  if s.sparse == 1:
    s.reward[w] = 0.0
    if found == SUCCESS:
      s.reward[w] = 1.0
  else:
    s.reward[w] = paid - s.paid[w] - price
  s.paid[w] = paid
  s.progress[w, 0] = now
  s.step[w] = s.step[w] + 1
  s.outcome[w] = found
  s.terminated[w] = found != RUNNING
  s.truncated[w] = found == RUNNING and s.step[w] >= s.limit
  s.success[w] = found == SUCCESS
  if s.failures[w] != s.failed[w]:  # numbers were not finite, and the world is at rest
    s.outcome[w] = RUNNING
    s.success[w] = False
    s.reward[w] = 0.0
    s.terminated[w] = False
    s.truncated[w] = True


# What is seen of the organ.


@wp.kernel(enable_backward=False)
def look(s: Common, beginning: bool):
  """Finds the nodes nearest to the tip, nearest first."""
  w = wp.tid()
  if beginning and not s.begun[w]:
    return
  tip = vector(s.tip_pos, w)
  distance = _distances()
  number = _numbers()
  for k in range(_NEAR):
    distance[k] = float(wp.inf)
  for k in range(s.xpos.shape[1]):
    d = wp.length_sq(node(s, w, k) - tip)
    if d < distance[_NEAR - 1]:
      slot = int(_NEAR - 1)
      while slot > 0 and distance[wp.max(slot - 1, 0)] > d:
        distance[slot] = distance[slot - 1]
        number[slot] = number[slot - 1]
        slot = slot - 1
      distance[slot] = d
      number[slot] = k
  for k in range(_NEAR):
    offset = node(s, w, number[k]) - tip
    for i in range(3):
      s.nodes_near[w, k, i] = offset[i]


@wp.kernel(enable_backward=False)
def survey(s: Common, beginning: bool):
  """Finds the displacement of the nodes of `surface`."""
  w, k = wp.tid()
  if beginning and not s.begun[w]:
    return
  offset = node(s, w, s.coarse[k]) - s.coarse0[k]
  for i in range(3):
    s.surface[w, k, i] = offset[i]


# What jaws hold, and what the organ hides.


@struct
class Between:
  """What the jaws touch."""

  side: floats("nside")  # see `Common`
  inner: floats("nworld", 2)
  left: Array(wp.mat33, ("nworld",))  # axes of the jaws
  right: Array(wp.mat33, ("nworld",))
  geom: ints("nworld", "ncontact")  # see `palpate.batch.Contacts`
  normal: floats("nworld", "ncontact", 3)
  force: floats("nworld", "ncontact")  # [N]


@wp.kernel(enable_backward=False)
def press(b: Between):
  """Adds up the force of the jaws' inner faces on the organ, see `Jaws.inner_force`."""
  w = wp.tid()
  both = wp.vec2(0.0, 0.0)
  for k in range(b.geom.shape[1]):
    g = b.geom[w, k]
    if g >= 0 and b.side[g] != 0.0:
      n = -wp.vec3(b.normal[w, k, 0], b.normal[w, k, 1], b.normal[w, k, 2])
      jaw = int(0)
      axes = b.left[w]
      if b.side[g] < 0.0:
        jaw = 1
        axes = b.right[w]
      along = b.side[g] * (n[0] * axes[0, 0] + n[1] * axes[1, 0] + n[2] * axes[2, 0])
      if along > _FACING:
        both[jaw] = both[jaw] + b.force[w, k] * along
  b.inner[w, 0] = both[0]
  b.inner[w, 1] = both[1]


@wp.kernel(enable_backward=False)
def hide(s: Common):
  """Finds which points of the disc the organ hides: rays against triangles, as `Physics.hidden`."""
  w, k = wp.tid()
  covered = wp.bool(False)
  eye = vector(s.eye, w)
  ray = s.disc[w, k] - eye
  for i in range(s.elem.shape[0]):
    a = node(s, w, s.elem[i, 0])
    e1, e2 = node(s, w, s.elem[i, 1]) - a, node(s, w, s.elem[i, 2]) - a
    out = eye - a
    across = wp.cross(out, e1)
    size = wp.dot(ray, wp.cross(e2, e1))
    side = wp.sign(size)
    size = side * size
    u = side * wp.dot(ray, wp.cross(e2, out))
    v = side * wp.dot(ray, across)
    far = side * wp.dot(e2, across)
    if u >= 0.0 and v >= 0.0 and u + v <= size and far > 0.0 and far < 0.999 * size:
      covered = True
  s.behind[w, k] = covered
