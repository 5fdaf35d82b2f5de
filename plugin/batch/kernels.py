"""Small kernels of batches on a device: resets, counts, and states in the user's layout."""

from typing import Any

import warp as wp
from palpate.forces.cohesive_bonds import Bonded
from palpate.tissue.types import Array, also, doubles, floats, ints, struct

from .mjw.arrays import theirs
from .organ.patch import Patch

HELD = wp.constant(1.0 - 2.0**-24)  # the most damage that leaves a bond, in float32


@theirs(model="body_pos body_quat", data="qpos qvel geom_xpos geom_xmat")
class Move:
  """Where joints and bodies of the worlds of a mask are put, and geoms before that."""

  mask: Array(wp.bool, ("nworld",))
  at: ints("njoint", 2)  # places of joints in qpos and qvel
  values: floats("nworld", "njoint")  # positions of joints [rad, m]
  body: int  # a body
  pos: Array(wp.vec3, ("nworld",))  # its position in its parent's frame [m]
  quat: Array(wp.quat, ("nworld",))  # its orientation there
  xpos: Array(wp.vec3, ("nworld", "ngeom"))  # of geoms [m]
  xmat: Array(wp.mat33, ("nworld", "ngeom"))


@wp.kernel(enable_backward=False)
def pose(m: Move):
  """Puts joints at positions."""
  w, k = wp.tid()
  if m.mask[w]:
    m.qpos[w, m.at[k, 0]] = m.values[w, k]
    m.qvel[w, m.at[k, 1]] = 0.0


@wp.kernel(enable_backward=False)
def place(m: Move):
  """Moves a body in its parent's frame."""
  w = wp.tid()
  if m.mask[w]:
    m.body_pos[w, m.body] = m.pos[w]
    m.body_quat[w, m.body] = m.quat[w]


@wp.kernel(enable_backward=False)
def switch(active: wp.array[bool], equality: int, eq_active: wp.array2d[bool]):
  """Switches an equality in each world."""
  w = wp.tid()
  eq_active[w, equality] = active[w]


@wp.kernel(enable_backward=False)
def put_back(m: Move):
  """Puts geoms of the worlds that are not of the mask where they were."""
  w, g = wp.tid()
  if not m.mask[w]:
    m.geom_xpos[w, g] = m.xpos[w, g]
    m.geom_xmat[w, g] = m.xmat[w, g]


@theirs(model="eq_data eq_solref eq_solimp", data="eq_active")
class Holding:
  """By which of its nodes a body holds a thread in each world."""

  first: int  # of the equalities of the body and each node
  nnode: int
  node: ints("nworld")  # that is held, -1 for none
  anchor: floats("nworld", 3)  # where in the body [m]
  firm: Array(wp.bool, ("nworld",))  # whether the body bears on it
  solref: wp.vec2  # of the equality where it does
  impedance: float
  loose_solref: wp.vec2  # and where not
  loose_impedance: float


@wp.kernel(enable_backward=False)
def hold(h: Holding):
  """Joins the node that is held to the body, and no other."""
  w, k = wp.tid()
  e = h.first + k
  h.eq_active[w, e] = h.node[w] == k
  if h.node[w] == k:
    firm = h.firm[w]
    data = h.eq_data[w, e]
    solimp = h.eq_solimp[w, e]
    for c in range(3):
      data[c] = h.anchor[w, c]
      data[3 + c] = 0.0
    for c in range(2):
      solimp[c] = wp.where(firm, h.impedance, h.loose_impedance)
    h.eq_data[w, e] = data
    h.eq_solimp[w, e] = solimp
    h.eq_solref[w, e] = wp.where(firm, h.solref, h.loose_solref)


@struct
class Sensed:
  """What the sensors of the steps of a call come to."""

  adr: ints("nsensor + 1")  # first number of a sensor
  data: floats("nworld", "nsensordata")
  peak: floats("nworld", "nsensor")
  mean: floats("nworld", "nsensordata")
  seen: floats("nworld", "nstep", "nsensordata")  # in each step, see `Batch.watch`
  count: ints("nworld")  # steps so far


@wp.kernel(enable_backward=False)
def sum_up(s: Sensed):
  """Adds the sensors of a step to their sums, and keeps the greatest squares of their norms."""
  w = wp.tid()
  n = s.count[w]
  s.count[w] = n + 1
  for k in range(s.peak.shape[1]):
    square = float(0.0)
    for i in range(s.adr[k], s.adr[k + 1]):
      square += s.data[w, i] * s.data[w, i]
      s.mean[w, i] = s.mean[w, i] + s.data[w, i]
      if n < s.seen.shape[1]:
        s.seen[w, n, i] = s.data[w, i]
    s.peak[w, k] = wp.max(s.peak[w, k], square)


@wp.kernel(enable_backward=False)
def average(s: Sensed):
  """Makes norms and means of the sums of some steps."""
  w = wp.tid()
  for k in range(s.peak.shape[1]):
    s.peak[w, k] = wp.sqrt(s.peak[w, k])
    for i in range(s.adr[k], s.adr[k + 1]):
      s.mean[w, i] = s.mean[w, i] / float(s.count[w])
  s.count[w] = 0


@wp.kernel(enable_backward=False)
def note(bad: wp.array[int], mask: wp.array[bool], failures: wp.array[int]):
  """Makes a mask of the bad worlds and counts them."""
  w = wp.tid()
  mask[w] = bad[w] != 0
  failures[w] = failures[w] + bad[w]
  bad[w] = 0


@wp.kernel(enable_backward=False)
def count(found: wp.array[int], bits: wp.array[int], lost: int, out: wp.array[int]):
  """Keeps the most that windows had no room for, and what mujoco_warp says was lost."""
  w = wp.tid()
  most = found[w]
  if bits[w] & lost:
    most = wp.max(most, 1)
  out[w] = wp.max(out[w], most)


@wp.kernel(enable_backward=False)
def spread(source: wp.array2d[float], at: wp.array[int], out: wp.array2d[float]):
  """Writes columns of a row a world to their places."""
  w, k = wp.tid()
  out[w, at[k]] = source[w, k]


@wp.kernel(enable_backward=False)
def spread_nodes(p: Patch, adr: wp.array[int], velocity: int, out: wp.array2d[float]):
  """Writes the motion of nodes that are dofs of the model to their places."""
  w, i = wp.tid()
  n, m = p.node[i], p.mesh[w]
  for c in range(3):
    if adr[i] >= 0:
      if velocity == 1:
        out[w, adr[i] + c] = p.solve.vel[w, n // 8, c, n % 8]
      else:
        shift = float(p.rest[m, n, c] - p.rest[0, n, c])
        out[w, adr[i] + c] = p.solve.disp[w, n // 8, c, n % 8] + shift


@wp.kernel(enable_backward=False)
def apply(p: Patch, applied: wp.array3d[float]):
  """Adds the force that is applied to each vertex to the solver's input."""
  w, i = wp.tid()
  force = wp.vec3(applied[w, i, 0], applied[w, i, 1], applied[w, i, 2])
  if wp.length_sq(force) > 0.0:
    n = p.node[i]
    p.calm[w] = wp.float64(0.0)
    for c in range(3):
      own = float(0.0)  # in the organ's frame
      for r in range(3):
        own += float(p.frame[r, c]) * force[r]
      p.solve.force_ext[w, n // 8, c, n % 8] = p.solve.force_ext[w, n // 8, c, n % 8] + own


@struct
class Whole:
  """What worlds have again that are whole again."""

  first: int  # of the numbers of `inside`, see `NUMBERS`
  count: int  # pieces
  inside: floats("nworld", 2)  # volume stiffness and pressure
  pieces: ints("nworld")
  opened: ints("nworld")  # whether it is cut
  own: ints("nworld")  # see `Meshes`


@wp.kernel(enable_backward=False)
def heal(p: Patch, s: Whole):
  """Gives the worlds of a mask their whole mesh: the first one, or their own."""
  w = wp.tid()
  if p.mask[w] and s.opened[w] > 0:
    s.opened[w] = 0
    p.mesh[w] = wp.where(s.own[w] > 0, 1 + w, 0)
    s.pieces[w] = s.count
    for k in range(s.inside.shape[1]):
      p.tissue.number[w, s.first + k] = s.inside[w, k]


@wp.kernel(enable_backward=False)
def get_rows(source: wp.array2d[float], row: wp.array[int], out: wp.array2d[float]):
  """Copies some rows."""
  k, i = wp.tid()
  out[k, i] = source[row[k], i]


@wp.kernel(enable_backward=False)
def put_rows(source: wp.array2d[float], row: wp.array[int], out: wp.array2d[float]):
  """Writes rows to their places."""
  k, i = wp.tid()
  out[row[k], i] = source[k, i]


@wp.func
def _choose(n: int, k: int):
  """Returns n over k, k up to 3."""
  if k == 2:
    return n * (n - 1) // 2
  return n * (n - 1) * (n - 2) // 6


@wp.func
def triple(a: int, b: int, c: int, n: int):
  """Returns the number of a triple of n in the order of `itertools.combinations`."""
  low = wp.min(a, wp.min(b, c))
  high = wp.max(a, wp.max(b, c))
  middle = a + b + c - low - high
  before = _choose(n, 3) - _choose(n - low, 3)
  return before + _choose(n - low - 1, 2) - _choose(n - middle, 2) + high - middle - 1


@wp.func
def _lane(v: wp.array4d[float], w: int, n: int):
  return wp.vec3(v[w, n // 8, 0, n % 8], v[w, n // 8, 1, n % 8], v[w, n // 8, 2, n % 8])


@wp.kernel(enable_backward=False)
def show(p: Patch, what: int, out: wp.array2d[wp.vec3]):
  """Writes positions, velocities or contact forces of vertices, in the world's axes."""
  w, i = wp.tid()
  n = p.node[i]
  f = p.frame
  frame = wp.mat33(
    float(f[0, 0]), float(f[0, 1]), float(f[0, 2]),
    float(f[1, 0]), float(f[1, 1]), float(f[1, 2]),
    float(f[2, 0]), float(f[2, 1]), float(f[2, 2]),
  )  # fmt: skip
  m = p.mesh[w]
  if what == 0 and p.share[m, n] == wp.float64(0.0):
    out[w, i] = wp.vec3(wp.nan)
  elif what == 0:
    x = _lane(p.solve.disp, w, n)
    at = wp.vec3(float(p.rest[m, n, 0]), float(p.rest[m, n, 1]), float(p.rest[m, n, 2]))
    origin = wp.vec3(float(p.origin[0]), float(p.origin[1]), float(p.origin[2]))
    out[w, i] = origin + frame * (at + x)
  elif what == 1:
    out[w, i] = frame * _lane(p.solve.vel, w, n)
  else:
    out[w, i] = frame * wp.vec3(p.force[w, n, 0], p.force[w, n, 1], p.force[w, n, 2])


@wp.kernel(enable_backward=False)
def show_rod(
  now: wp.array3d[wp.float64], frame: wp.array2d[wp.float64], origin: wp.vec3,
  out: wp.array2d[wp.vec3],
):  # fmt: skip
  """Writes where a thread's nodes are in the world."""
  w, i = wp.tid()
  x = wp.vec3()
  for a in range(3):
    for c in range(3):
      x[a] += float(frame[a, c] * now[w, i, c])
  out[w, i] = origin + x


@struct
class Laid:
  """Where a thread is laid, and its fields of `rods.WorldRods`."""

  mask: Array(wp.bool, ("nworld",))  # worlds
  places: doubles("nworld", "nnode", 3)  # in the slides' axes [m]
  now: doubles("nworld", "nnode", 3)
  speed: doubles("nworld", "nnode", 3)
  rest: doubles("nnode", 3)
  qpos0: floats("nq")
  qpos: floats("nworld", "nq")
  qvel: floats("nworld", "nv")
  qposadr: ints("nnode")
  dofadr: ints("nnode")


@wp.kernel(enable_backward=False)
def lay(f: Laid):
  """Puts nodes at places, at rest."""
  w, i, c = wp.tid()
  if f.mask[w] and f.dofadr[i] >= 0:
    x = f.places[w, i, c]
    f.now[w, i, c] = x
    f.speed[w, i, c] = wp.float64(0.0)
    zero = wp.float64(f.qpos0[f.qposadr[i] + c]) - f.rest[i, c]
    f.qpos[w, f.qposadr[i] + c] = float(x + zero)
    f.qvel[w, f.dofadr[i] + c] = 0.0


@struct
class Pulled:
  """Edges of a thread."""

  now: doubles("nworld", "nnode", 3)  # see `rods.WorldRods`
  springs: doubles(2, "nnode")  # stiffness [N/m] and length at rest [m], as nodes begin
  moved: doubles("nworld", "nmoved")  # see `layout.RodState`
  broken: doubles("nworld", "nnode")


@wp.kernel(enable_backward=False)
def pull_rod(f: Pulled, out: wp.array2d[float]):
  """Writes the tension of a thread's edges."""
  w, i = wp.tid()
  square = wp.float64(0.0)
  for c in range(3):
    edge = f.now[w, i + 1, c] - f.now[w, i, c]
    square += edge * edge
  whole = wp.float64(1.0) - f.broken[w, i]
  stretch, length = wp.float64(f.springs[0, i]), wp.float64(f.springs[1, i])
  if f.moved.shape[1] > 0:  # nodes move along it
    length += f.moved[w, i + 1] - f.moved[w, i]
    stretch *= f.springs[1, i] / length
  out[w, i] = float(whole * stretch * (wp.sqrt(square) - length))


@wp.kernel(enable_backward=False)
def put_back_rows(mask: wp.array[bool], start: wp.array2d[Any], out: wp.array2d[Any]):
  """Puts rows of the worlds of a mask back to where they start."""
  w, k = wp.tid()
  if mask[w]:
    out[w, k] = start[0, k]


NUMBERS = wp.bool, wp.int32, wp.float32, wp.float64  # of rows that are put back
for _number in NUMBERS:
  wp.overload(put_back_rows, {name: wp.array2d[_number] for name in ("start", "out")})


@struct
@also(Bonded, "row", "count", "made", "slot", "area", "state", "pull", "stretch")
class BondLists:
  """Bonds that were made together, in all worlds."""

  before: int  # number of bonds in groups before this one
  whole: floats("nmade")  # area of each that was made [m^2]


@wp.kernel(enable_backward=False)
def show_bonds(
  b: BondLists, damage: wp.array2d[float], force: wp.array3d[float], stretch: wp.array3d[float]
):
  """Takes damage, force and stretch of bonds to those that were made, the last as a mean."""
  w, n = wp.tid()
  r = b.row[w]
  if n < b.count[r, 0]:
    i = b.before + b.made[r, n]
    had = b.state[w, b.slot[r, n], 0]
    wp.atomic_min(damage, w, i, wp.where(had >= wp.float64(1.0), 1.0, wp.min(float(had), HELD)))
    share = float(b.area[r, n]) / b.whole[i]
    for c in range(3):
      wp.atomic_add(force, w, i, c, float(b.pull[w, n, c]))
      wp.atomic_add(stretch, w, i, c, share * float(b.stretch[w, n, c]))


@wp.kernel(enable_backward=False)
def weaken_bonds(b: BondLists, amount: wp.array2d[float]):
  """Adds to the damage of bonds what is given for those that were made."""
  w, n = wp.tid()
  r = b.row[w]
  if n < b.count[r, 0]:
    more = b.state[w, b.slot[r, n], 0] + wp.float64(amount[w, b.before + b.made[r, n]])
    b.state[w, b.slot[r, n], 0] = wp.min(more, wp.float64(1.0))


@wp.kernel(enable_backward=False)
def forget(mask: wp.array[bool], row: wp.array[int]):
  """Gives worlds the lists of the first meshes again."""
  w = wp.tid()
  if mask[w]:
    row[w] = 0


@wp.kernel(enable_backward=False)
def share_freed(damage: wp.array2d[float], area: wp.array[float], out: wp.array[float]):
  """Finds the share of the area of bonds that is free."""
  w = wp.tid()
  whole = float(0.0)
  free = float(0.0)
  for k in range(area.shape[0]):
    whole += area[k]
    if damage[w, k] >= 1.0:
      free += area[k]
  out[w] = wp.where(whole > 0.0, free / whole, 0.0)
