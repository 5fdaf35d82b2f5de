"""What `knot` and `extracorporeal` share: a slit Penrose drain, and a thread through its marks.

World: z is up, the drain lies on a block along y, and its slit is on top of it. A thread goes in
through the mark at +x and out at -x, below the slit, along a chord of the drain: straight.
"""

import functools
import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import palpate
from palpate.models import mjcf

from ...core import rules as r
from ...core import scenes
from ...core.base import Physics, Task
from ...core.scenes import BED, ORGAN, Scene
from .. import sheet
from .needles import RADIUS as CIRCLE

THREAD = "thread"
WIDE, HIGH, LONG = 0.0074, 0.0054, 0.028  # of a tube of 1/4 inch that lies flat [m]
DEEP = 0.00085  # of the thread below the top [m]
SLIT, GAPE = 0.0084, 0.0024  # of the slit: length, and how far it gapes in its middle [m]
MIDDLE = np.array([0.0, 0.0, HIGH - DEEP])  # of the stitch [m]
BITE = WIDE * float(np.sqrt(1.0 - (1.0 - 2.0 * DEEP / HIGH) ** 2))  # between the marks [m]
# Latex: 1 MPa is what rubbers of gloves and drains have at small strain; the wall is measured.
# It tears at some 10 kJ/m^2, as natural rubber does (Rivlin and Thomas 1953,
# 10.1002/pol.1953.120100303). Thread of silk sticks in it: friction is ours.
LATEX = {"young": 1e6, "thickness": 0.0005, "damping": 0.003}
TOUGH, FRICTION = 10000.0, 600.0  # [J/m^2], [N/m]
MASS = 0.0003  # of the tube, 1000 kg/m^3 [kg]
# Hook and loop under it: some 30 kPa hold it [N/m^3, Pa, J/m^2].
HELD = (1e8, 3e4, 60.0)
_SKIN, _MARGIN = 2.5e-4, 6e-4  # radius of the flex; of the thread's contacts, which come early [m]
_RGBA, _BLOCK = (0.86, 0.72, 0.42, 1.0), (0.022, 0.02, 0.003)
_STEEL = (0.75, 0.77, 0.8, 1.0)
# Contact bits: the thread and the block under the drain meet instruments by the first two. The
# thread and the foam meet by the third.
HANDS, BLOCK, LIES = 8, 16, 32
_SAMPLES = 4001  # of a section
# Height of foam on the block: tails lie on it, and jaws reach into it. They cannot take what lies
# on the block, as they are round and hold it 3.6 mm from their tips [m].
_SOFT, _FOAM = 0.002, (0.45, 0.6, 0.75, 1.0)
# Of vertices that a test pulls at: from the mark, and nearer to the slit, at most [m]; the angle of
# its pull over the table [rad].
_NEAR, _EDGE, _LIFT = 0.002, 1e-4, 0.6
_OUT, _UP = math.cos(_LIFT), math.sin(_LIFT)
CLOSED = 0.001  # gap of a slit that is [m], as FLS asks for
STAYS = 0.3  # and is to stay so for so long [s]
EDGE = 4.5e-4  # of the thread, four of its radii [m]
PULL = 0.6  # that strands are drawn with, and that the knot is to hold [N]
# Strands lie so long before the knot is tested [s]; the last pull of the test [N], its rise [N/s].
_LET_GO, _LAST, _RISES = 0.3, 2.0, 2.0


@functools.lru_cache(maxsize=8)
def drain(nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns the drain of about so many nodes, its bottom in z = 0.

  Returns:
    vertices [m] (nvert, 3), triangles (nelem, 3), and the vertices of both lips, those in front of
    each other side by side (n, 2)
  """
  turn = np.linspace(0.0, 2.0 * np.pi, _SAMPLES)
  section = np.stack([0.5 * WIDE * np.sin(turn), 0.5 * HIGH * (1.0 + np.cos(turn))], axis=1)
  along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(section, axis=0), axis=1))]
  around = 2 * round(0.5 * np.sqrt(nodes * along[-1] / LONG))
  rows = 2 * round(0.5 * nodes / around) + 1  # one of them in the slit's middle
  vertices, lips = [], []
  number = np.zeros((rows, around + 1), int)
  for j, y in enumerate(np.linspace(-0.5 * LONG, 0.5 * LONG, rows)):
    off = 0.5 * GAPE * max(0.0, 1.0 - (2.0 * y / SLIT) ** 2)
    for k in range(around + (off > 0.0)):
      at = off + (along[-1] - 2.0 * off) * k / around
      number[j, k] = len(vertices)
      vertices.append([np.interp(at, along, section[:, 0]), y, np.interp(at, along, section[:, 1])])
    if off > 0.0:
      lips.append([number[j, 0], number[j, around]])
    else:
      number[j, around] = number[j, 0]
  j, k = (i.ravel() for i in np.meshgrid(range(rows - 1), range(around), indexing="ij"))
  a, b, c, d = number[j, k], number[j, k + 1], number[j + 1, k + 1], number[j + 1, k]
  even = ((j + k) % 2 == 0)[:, None]
  first = np.where(even, np.stack([a, b, d], 1), np.stack([a, c, d], 1))
  second = np.where(even, np.stack([b, c, d], 1), np.stack([a, b, c], 1))
  return np.array(vertices), np.concatenate([first, second]), np.array(lips)


def build(
  scene: Scene,
  line: np.ndarray,
  meets: int = HANDS,
  friction: float = FRICTION,
  tough: float = TOUGH,
  wall: Mapping[str, float] = LATEX,
  needle: int = 0,
  **thread,
) -> mujoco.MjSpec:
  """Returns the drain on its block with a thread, instruments, light and what is around.

  A needle that meets nothing has been cut off the thread. The organ still knows the thread by it:
  see `sew`.

  Args:
    scene: what it plays in; its organ has about so many nodes
    line: the thread's nodes, from where the needle was to the other end [m]  (n, 3)
    meets: bits of what the thread meets: `HANDS` the instruments, `LIES` foam, 1 the drain
    friction: of needle and thread in the drain [N/m]
    tough: energy that it takes to open an area of it [J/m^2]
    wall: keys of its tissue
    needle: bits of what the needle meets; 0 for none
    **thread: see `palpate.add_thread`
  """
  vertices, triangles, _ = drain(scene.nodes)
  foot = np.flatnonzero(vertices[:, 2] < 0.1 * HIGH)
  law = f"{BED} {mjcf.numbers(HELD)} at {' '.join(map(str, foot))}"
  tissue = {**wall, "needles": f"needle {tough:g} {friction:g}", "bonds": law}
  flex = mjcf.flexcomp(
    ORGAN,
    (vertices, triangles),
    config=tissue | {"device": "cpu", "tolerance": scenes.TOLERANCE},
    contact=scenes.CONTACT,
    digits=7,
    mass=MASS,
    radius=_SKIN,
    rgba=_RGBA,
  )
  block = mjcf.tag("geom", {
    "type": "box", "size": np.array(_BLOCK), "pos": np.array([0.0, 0.0, -_BLOCK[2]]),
    "rgba": "0.25 0.4 0.6 1", "contype": 0, "conaffinity": BLOCK, "mass": 0,
  })  # fmt: skip
  spec = scenes.furnish(scene, flex, MIDDLE, block, slots=0)
  if meets & LIES:
    half = (*_BLOCK[:2], 0.5 * _SOFT)
    spec.worldbody.add_geom(
      type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=(0.0, 0.0, half[2]), rgba=_FOAM, contype=0,
      conaffinity=LIES, mass=0,
    )  # fmt: skip
  sheet.lie_in_fat(spec, scene)
  for geom in spec.geoms:
    if geom.parent.name.startswith(tuple(filter(None, scene.prefixes))) and geom.contype & 1:
      geom.contype, geom.conaffinity = geom.contype | BLOCK | HANDS, geom.conaffinity | HANDS
  contact = {"contype": meets, "conaffinity": meets, "margin": _MARGIN}
  # A step in which jaws close on a throw took 451 iterations. One that is cut off leaves forces out
  # of balance, which harm the drain.
  palpate.add_thread(spec, line, THREAD, contact=contact, iterations=1000, **thread)
  aside = None if needle else spec.worldbody.add_body(name="needle_holder")
  palpate.add_needle(
    spec, parent=aside, thread=THREAD, pos=line[0] + (0.0, CIRCLE, 0.0),
    contact={"contype": needle, "conaffinity": needle}, rgba=_STEEL if needle else (0, 0, 0, 0),
  )  # fmt: skip
  spec.equality(f"needle_{THREAD}").active = bool(needle)
  return spec


def sew(organ: palpate.Organ, line: np.ndarray) -> palpate.Thread:
  """Lays the thread along a line through the marks, see `build`, and returns it."""
  thread = palpate.Thread(organ.model, organ.data, THREAD)
  thread.lay(line)
  organ.sew("needle")
  return thread


def beside(nodes: int) -> np.ndarray:
  """Returns vertices of both lips beside the stitch, right and left, see `drain`  (n, 2)."""
  rest, _, lips = drain(nodes)
  return lips[np.abs(rest[lips[:, 0], 1]) < 0.25 * SLIT]


def beyond(nodes: int) -> np.ndarray:
  """Returns vertices of the wall beyond the marks, right and left, see `drain`  (n, 2)."""
  rest, _, _ = drain(nodes)
  sides = []
  for side in (1.0, -1.0):
    mark = MIDDLE + np.array([0.5 * side * BITE, 0.0, 0.0])
    outside = side * (rest[:, 0] - mark[0]) > -_EDGE  # the lips are not pulled
    sides.append(np.flatnonzero(outside & (np.linalg.norm(rest - mark, axis=1) < _NEAR)))
  return np.stack(sides, axis=1)


def part(s, o, force):
  """Lifts the wall on both sides of the stitch and pulls it apart with a force each [N]; a rule.

  Pulled flat, the tube would collapse with a jump.
  """
  each = force / float(o.wall.shape[0])
  for k in range(o.wall.shape[0]):
    r.apply(s, o.wall[k, 0], each * r.vector(_OUT, 0.0, _UP))
    r.apply(s, o.wall[k, 1], each * r.vector(-_OUT, 0.0, _UP))
  r.settle(s)


def pull_test(s, o):
  """Pulls the stitch apart, harder and harder, once its strands have been let go of; a rule.

  Returns:
    o; SUCCESS once the knot has held, MISSED once it has not, and RUNNING until then
  """
  parted = o.broken or not o.whole
  if o.gap < GAPE and not parted:
    o.security = o.pulled
  gapes = o.left > CLOSED and o.free > _LET_GO - 1e-6
  if gapes or parted or o.gap > GAPE or o.pulled == _LAST:
    return o, r.SUCCESS if o.security > PULL - 1e-6 else r.MISSED
  o.free = o.free + o.control_timestep
  o.pulled = r.clamp(_RISES * (o.free - _LET_GO), 0.0, _LAST)
  part(s, o, o.pulled)
  return o, r.RUNNING


def follow_stitch(s, o):
  """Finds the gap, the tension, and whether the thread is whole and in its holes; a rule."""
  count, pull = r.pierced(s)
  o.whole = count == 2
  o.broken = r.snapped(s)
  o.tension = r.taut(s)
  if o.free == 0.0:  # the test's pull is not the trainee's
    o.hardest = max(o.hardest, pull)
    o.tightest = max(o.tightest, o.tension)
  o.gap = 0.0
  for k in range(o.lips.shape[0]):
    o.gap = max(o.gap, float(r.vertex(s, o.lips[k, 0])[0] - r.vertex(s, o.lips[k, 1])[0]))
  if o.pulled == 0.0:
    o.left = o.gap
  return o


class Sewn(Task):
  """An exercise that draws throws down on the drain.

  A knot of several throws is tested: its strands are let go, and the wall on both sides of the
  stitch is lifted and pulled apart, harder and harder to 2 N. It holds where the slit is closed to
  1 mm when the strands are let go, and gapes less than unsewn, 2.4 mm, up to a pull of 0.6 N, with
  which its strands were drawn. The pull at which it gapes so, or the thread breaks or is torn out,
  is its security. The pull on the drain and the tension in the test do not count.

  Attributes:
    turns: how often the strands wind about each other in each throw
    throws: how many there are
    seated: throws that are down, of several
    lips: vertices of both beside the stitch, see `beside`
    wall: vertices that the test pulls at, see `beyond`
    gap: of the slit now [m]
    left: before the knot was pulled at [m]
    free: how long the strands have been let go of [s]
    pulled: what the wall is pulled with [N]
    security: what the knot has held [N]; NaN of one throw, which is not tested
    tension: the largest of the thread [N]
    hardest: largest pull on the drain so far [N], and `tightest`, largest tension
    broken: whether the thread is
    whole: whether it is in both of its holes
  """

  settles = 0.1  # the thread falls meanwhile, until it is laid

  def __init__(self, scene: Scene, random=None, *, turns: Sequence[int], **kwargs):
    """Makes the task.

    Args:
      scene: of the exercise
      random: see Task
      turns: how often the strands wind about each other in each throw, (1, 1) of a square knot,
        (2, 1, 1) of a surgeon's
      **kwargs: see Task
    """
    if not isinstance(turns, Sequence) or not turns or not {*turns} <= {1, 2}:
      raise ValueError(f"turns is {turns!r}, expected 1 or 2 for each throw, such as (2, 1, 1)")
    self.turns, self.throws = tuple(turns), len(turns)
    super().__init__(scene, random, **kwargs)
    self.lips, self.wall = beside(self.scene.nodes), beyond(self.scene.nodes)
    self.pairs, self.walls = len(self.lips), len(self.wall)

  def place_of_work(self, physics: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Returns all of the drain, and the middle of the stitch."""
    return np.arange(len(physics.organ.elem)), MIDDLE

  def begin(self, physics: Physics) -> None:
    """The slit gapes."""
    self.gap, self.tension, self.tightest, self.hardest = GAPE, 0.0, 0.0, 0.0
    self.whole, self.broken = True, False
    self.seated, self.left, self.free, self.pulled = 0, GAPE, 0.0, 0.0
    self.security = 0.0 if self.throws > 1 else math.nan

  def look(self, physics: Physics) -> None:
    """Finds how the stitch is now."""
    follow_stitch(physics, self)

  def lost(self, physics: Physics) -> bool:
    """Returns whether the thread is broken or out of the drain: the exercise has failed then."""
    if not self.broken and self.whole:
      return False
    self.outcome = "damage"
    self.event(physics, "note", label=self.label("damage"))
    return True

  def label(self, kind: str) -> str:
    """Returns what an event of the rules is called."""
    if kind == "damage":
      return "thread broken" if self.broken else "torn out of the drain"
    if kind == "missed" and self.free:
      return "the knot did not hold"
    return "throw" if kind == "target" else super().label(kind)

  def recorded(self, physics: Physics) -> dict[str, float]:
    """Returns tension, the pull on the drain, what the knot held, and the gap before its test."""
    pull, tension = float(np.linalg.norm(physics.needle().force)), self.tension
    if self.free:
      pull = tension = 0.0
    found = {"traction": pull, "gap": self.left, "tension": tension}
    return found | ({"security": self.security} if self.throws > 1 else {})
