"""The words that the rules of exercises are written in.

A rule is a plain function of the world `s` and of the exercise's state in it, `o`, which it returns
changed. Python runs it for one world: `s` is the `Physics`, `o` the task, and these words are what
is below. For many worlds Warp compiles the same text, with the words of `tasks.batch.words` in
place of these; so a rule has no dictionaries, no strings, no chained comparisons, and counts in
loops from `int(0)`.
"""

import dataclasses
import functools
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, get_type_hints

import mujoco as mj
import numpy as np
import warp as wp
from palpate.tissue.types import Array

from ..metrics import knots

RUNNING, SUCCESS, DAMAGED, MISSED = range(4)
HIDDEN, LATER, NOW = range(3)  # looks of a mark
FAR = 1e9  # farther than anything [m]
OUTCOMES = (None, "success", "damage", "missed")

Vector = Annotated[Any, wp.vec3]
Vectors3 = Annotated[Any, wp.mat33]  # three vectors, a row each
TOLD = (float, wp.vec3, wp.mat33)  # kinds of what is observed
KINDS = (*TOLD, int, bool)


def unshaped(s, o):
  """Returns 0, the shaping of rules whose progress shows the way by itself."""
  return 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class Rules:
  """The rules of a domain.

  Attributes:
    state: class whose annotations are a world's state: numbers, flags, `Vector`, and arrays, such
      as `Annotated[Any, ints("targets")]`, whose sizes are numbers or attributes of the task; a
      task has attributes of these names
    advance: rule (s, o) that returns o, the progress and the outcome, one of RUNNING, SUCCESS,
      DAMAGED, MISSED, after a control step
    observe: rule (s, o) that returns o with its own observations up to date
    observed: fields of the state that are these
    metrics: of the domain's own, by the field that is an episode's value so far
    columns: of a recording, by the field that is their value, see `Recorder.append`
    begin: rule (s, o) that returns o as an episode begins and the physics can be asked, or None
    act: rule (s, o) that returns o once an action has moved the drives, before the physics, or None
    shared: arrays of the state that are the same in all worlds and episodes
    mark: rule (s, o, k) that returns where the pictures' mark k is [m], and its look, one of
      HIDDEN, LATER, NOW; None for no marks
    shaping: rule (s, o) that returns what the potential of the dense reward has beside the
      progress; their sum stays below 1 while an episode runs
  """

  state: type
  advance: Callable
  observe: Callable
  observed: tuple[str, ...]
  metrics: Mapping[str, str] = dataclasses.field(default_factory=dict)
  columns: Mapping[str, str] = dataclasses.field(default_factory=dict)
  _: dataclasses.KW_ONLY
  begin: Callable | None = None
  act: Callable | None = None
  shared: tuple[str, ...] = ()
  mark: Callable | None = None
  shaping: Callable = unshaped

  def __post_init__(self):
    where = f"{self.state.__module__}.{self.state.__qualname__}"
    for name, rule in vars(self).items():
      given = {"mark": "s, o and k"}
      given |= dict.fromkeys(("advance", "observe", "begin", "act", "shaping"), "s and o")
      if name not in given or (rule is None and name in ("begin", "act", "mark")):
        continue
      count = 2 + (name == "mark")
      if not inspect.isfunction(rule) or len(inspect.signature(rule).parameters) != count:
        raise TypeError(f"{where}: {name} is {rule!r}, expected a function of {given[name]}")
    known = self.fields
    for name, kind in known.items():
      if kind not in KINDS and not isinstance(kind, Array):
        raise TypeError(
          f"{where}: {name!r} is {kind!r}, expected int, float, bool, Vector, Vectors3 or an array"
        )
    for name in (*self.observed, *self.metrics.values(), *self.columns.values(), *self.shared):
      if name not in known:
        raise TypeError(f"{where}: {name!r} is no field, expected one of {', '.join(known)}")
    for name in (*self.observed, *self.metrics.values()):
      if known[name] not in TOLD:
        raise TypeError(
          f"{where}: {name!r} is told and {known[name]!r}, expected float, Vector or Vectors3"
        )

  @functools.cached_property
  def fields(self) -> dict[str, Any]:
    """Kinds of the fields by name."""
    found = get_type_hints(self.state, include_extras=True)
    return {
      name: hint.__metadata__[0] if hasattr(hint, "__metadata__") else hint
      for name, hint in found.items()
    }


INSTEAD: dict[Callable, Callable] = {}  # what Warp compiles in place of a function


def many(function: Callable) -> Callable:
  """Returns a decorator: what it decorates is compiled for many worlds in place of a function.

  For loops that numpy does at once: the two say the same, in the same words.
  """

  def add(other: Callable) -> Callable:
    INSTEAD[function] = other
    return other

  return add


# Numbers and vectors.


def root(x: float) -> float:
  """Returns the square root."""
  return math.sqrt(x)


def clamp(x: float, low: float, high: float) -> float:
  """Returns the number between two others that is nearest to one."""
  return min(max(x, low), high)


def rows(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
  """Returns three vectors as rows, see `Vectors3`."""
  return np.array([a, b, c])


def vector(x: float, y: float, z: float) -> np.ndarray:
  """Returns a vector."""
  return np.array([x, y, z])


def angle(y: float, x: float) -> float:
  """Returns the angle of a vector (x, y) against the first axis [rad]."""
  return math.atan2(y, x)


def sine(x: float) -> float:
  """Returns the sine of an angle [rad]."""
  return math.sin(x)


def length(v: np.ndarray) -> float:
  """Returns the length of a vector."""
  return math.sqrt(v.dot(v))


def dot(a: np.ndarray, b: np.ndarray) -> float:
  """Returns the product of two vectors."""
  return float(a.dot(b))


# Questions to the world.


def tip(s: Any) -> np.ndarray:
  """Returns where the tip is [m]."""
  return s.tip_pos()


def point(s: Any, triangle: int) -> np.ndarray:
  """Returns the middle of a triangle [m]."""
  return s.point(triangle)


def corner(s: Any, triangle: int, k: int) -> np.ndarray:
  """Returns where corner k of a triangle is [m]."""
  return s.nodes()[s.organ.elem[triangle, k]]


def normal(s: Any, triangle: int) -> np.ndarray:
  """Returns the outward unit normal of a triangle."""
  return s.normal(triangle)


def peak(s: Any) -> float:
  """Returns the largest force of tissue in the control step, jaws included [N]."""
  return s.peak_tissue


def force(s: Any) -> float:
  """Returns the force of tissue on the instrument below the shaft [N]."""
  return length(tissue_force(s))


def tissue_force(s: Any) -> np.ndarray:
  """Returns the force of tissue on the instrument below the shaft [N]."""
  return s.tissue_force()


def from_tip(s: Any, place: np.ndarray) -> np.ndarray:
  """Returns a place in the frame of the tip [m]."""
  return s.from_tip(place)


def closing(s: Any) -> bool:
  """Returns whether the jaws are told to close, see `Instrument`."""
  return s.closing()


def holds(s: Any) -> bool:
  """Returns whether tissue is between the jaws, see `Instrument`."""
  return s.holds()


def opening(s: Any) -> float:
  """Returns the opening of the jaws [rad]."""
  return float(s.gripper()[0])


def visible(s: Any, o: Any) -> float:
  """Returns the share of the points `o.disc` that the organ does not hide [-]."""
  return 1 - float(s.hidden(o.disc).mean())


def last_component(s: Any, o: Any) -> float:
  """Returns the last component of the action, the largest of its rows."""
  return float(o.action[..., -1].max())


def other_tip(s: Any) -> np.ndarray:
  """Returns where the tip of the other hand's instrument is [m]."""
  return s.second.tip_pos()


def other_point(s: Any, place: np.ndarray) -> np.ndarray:
  """Returns where a place in the frame of that tip is [m]."""
  return s.second.to_world(place)


def other_force(s: Any) -> float:
  """Returns the force of tissue on that instrument below the shaft [N]."""
  return length(s.second.tissue_force())


def pinch(s: Any) -> float:
  """Returns the smaller one of the forces on the two jaws [N]."""
  return float(s.gripper()[2:].min())


def other_pinch(s: Any) -> float:
  """Returns the same of the other hand's instrument [N]."""
  return float(s.second.gripper()[2:].min())


def needle_place(s: Any, place: np.ndarray) -> np.ndarray:
  """Returns where a place in the frame of the free body `needle` is [m]."""
  row, moved = s.free_pose("needle"), np.zeros(3)
  mj.mju_rotVecQuat(moved, place, row[3:])
  return row[:3] + moved


def scraped(s: Any) -> float:
  """Returns the force of the sensor `scrape`, of the last step of the physics [N]."""
  return length(s.felt_by("scrape"))


def pierced(s: Any) -> tuple[int, float]:
  """Returns how many holes the needle has in the organ, and its pull on that [N]."""
  found = s.needle()
  return len(found.holes), length(found.force)


def pinhole(s: Any, k: int) -> tuple[np.ndarray, float]:
  """Returns where one of these is at rest, and how far along the needle from its swage [m, m]."""
  hole = s.needle().holes[k]
  return hole.rest, float(hole.along)


def torn_at(s: Any, k: int) -> float:
  """Returns how far one of these has torn through the tissue [m]."""
  return float(s.needle().holes[k].torn)


def taut(s: Any) -> float:
  """Returns the largest tension of the needle's thread [N]."""
  return float(s.thread.tension.max())


def tugged(s: Any, first: int, count: int) -> float:
  """Returns the least tension of so many of the thread's edges, from one on [N]."""
  return float(s.thread.tension[first : first + count].min())


def fasten(s: Any, o: Any, on: bool) -> None:
  """Fastens the needle to its thread, or takes it off that, which it reports."""
  which = s.model.ptr.equality(f"needle_{s.thread.name}").id
  s.data.ptr.eq_active[which] = on
  if not on:
    o.event(s, "note", label="needle off its thread")


def put_away(s: Any, place: np.ndarray) -> None:
  """Puts the free body `needle` at a place, at rest [m]."""
  joint = s.data.ptr.joint("needle")
  joint.qpos[:3], joint.qvel[:] = place, 0.0


def jaws(s: Any, hand: int) -> tuple[float, float]:
  """Returns the opening of a hand's jaws, and what they are told [rad]."""
  opening, target = s.hands[hand].gripper()[:2]
  return float(opening), float(target)


def in_hand(s: Any, hand: int, place: np.ndarray) -> np.ndarray:
  """Returns a place in the frame of a hand's tip [m]."""
  return s.hands[hand].from_tip(place)


def vertex(s: Any, k: int) -> np.ndarray:
  """Returns where a vertex of the organ is [m]."""
  return s.nodes()[k]


def strand(s: Any, k: int) -> np.ndarray:
  """Returns where a node of the thread is [m]."""
  return s.thread.positions[k]


def strands(s: Any) -> int:
  """Returns how many nodes the thread has."""
  return len(s.thread.tension) + 1


def snapped(s: Any) -> bool:
  """Returns whether the thread has broken."""
  return bool(s.thread.broken.any())


def hold(s: Any, hand: int, node: int, place: np.ndarray, firm: bool) -> None:
  """Lets a hand's jaws hold a node of the thread at a place in the frame of the tip [m].

  Args:
    s: the world
    hand: which
    node: -1 for none
    place: where it is held
    firm: whether they bear on it, see `palpate.Thread.hold`
  """
  prefix = s.hands[hand].prefix
  tip = s.model.ptr.site(f"{prefix}tip").pos
  s.thread.hold(f"{prefix}{s.thread.name}", int(node), place + tip, firm)


def tied(s: Any, turns: Sequence[int]) -> int:
  """Returns how many throws of a knot the thread has, each the other way round than the one before.

  0 where it has none, or other throws than these, a granny's too; -1 where it has another knot than
  of so many throws, or is too tangled to tell.

  Args:
    s: the world
    turns: how often the strands wind about each other in each throw of the knot
  """
  found = knots.throws(knots.closed(s.thread.positions), len(turns))
  if found is None:
    return -1
  return next((k for k in range(len(turns) + 1) if knots.same(found, turns[:k])), 0)


def apply(s: Any, k: int, force: np.ndarray) -> None:
  """Applies a force to a vertex of the organ, until another one is [N]; `settle` is to follow."""
  model = s.model.ptr
  flex = mj.mj_name2id(model, mj.mjtObj.mjOBJ_FLEX, s.organ.name)
  body = model.flex_vertbodyid[model.flex_vertadr[flex] + k]
  s.data.ptr.xfrc_applied[body, :3] = force


def settle(s: Any) -> None:
  """Lets the next step know of these forces: it would throw up what it did not know of."""
  s.forward()


def lens(s: Any) -> np.ndarray:
  """Returns where the lens of the laparoscope is that one holds [m]."""
  return s.lens()[0]


def picture(s: Any) -> np.ndarray:
  """Returns the axes of its picture, right, up and back, see `Vectors3`."""
  return s.lens()[1].T


def guided_tip(s: Any) -> np.ndarray:
  """Returns where the tip of the instrument is that the exercise moves [m]."""
  return s.guided.tip_pos()


def guide(s: Any, joints: np.ndarray) -> None:
  """Tells its drives pitch, yaw [rad] and insertion [m]."""
  s.data.ctrl[s.guided.drives[[0, 1, 3]]] = joints


def bonds(s: Any) -> int:
  """Returns how many bonds the organ has, free ones too."""
  return len(s.organ.bonds)


def bond(s: Any, k: int) -> np.ndarray:
  """Returns where a bond is [m]."""
  return s.organ.bonds.positions[k]


def strand_distance(s: Any, k: int, start: np.ndarray, end: np.ndarray) -> float:
  """Returns how far a bond's strand, from its bed to the organ, is from a segment [m]."""
  return float(s.organ.bonds.distance(start, end)[k])


def is_free(s: Any, k: int) -> bool:
  """Returns whether a bond has broken."""
  return bool(s.organ.bonds.free[k])


def share_freed(s: Any) -> float:
  """Returns the share of the area of bonds that is free [-]."""
  return s.organ.bonds.share_freed


def traction(s: Any) -> float:
  """Returns the pull of all bonds together on the organ [N]."""
  return length(s.organ.bonds.force.sum(axis=0))


def weaken(s: Any, k: int, amount: float) -> None:
  """Adds to the damage of a bond."""
  amounts = np.zeros(bonds(s))
  amounts[k] = amount
  s.organ.bonds.weaken(amounts)


def cutter(s: Any) -> tuple[bool, float, np.ndarray]:
  """Returns of what cuts whether it is inside, how far it came, where it is at rest [m, m]."""
  (found,) = s.organ.cutters
  return found.inside, found.length, found.seat


def ended(s: Any, o: Any) -> bool:
  """Returns whether the episode has an outcome."""
  return bool(o.outcome)


def pieces(s: Any) -> int:
  """Returns how many parts the organ is in."""
  return len(s.organ.pieces)


# What the recorder is told; labels are the task's.


def miss(s: Any, o: Any, value: float) -> None:
  """Reports a contact, or a closing, beside what it was meant for, by so much [m]."""
  o.event(s, "miss", value, o.label("miss"))


def reach(s: Any, o: Any, value: float) -> None:
  """Reports a target that was reached, at a distance from it [m]."""
  o.event(s, "target", value, o.label("target"))


def grip(s: Any, o: Any, value: float) -> None:
  """Reports that the jaws have grasped the site, at a distance from it [m]."""
  o.event(s, "target", value, "grasp")


def slipped(s: Any, o: Any) -> None:
  """Reports a grasp that was lost in closed jaws, which a recording shows by itself."""


def drop(s: Any, o: Any) -> None:
  """Reports that what was held, or followed, is lost."""
  o.event(s, "drop", None, o.label("drop"))


def tear(s: Any, o: Any, value: float) -> None:
  """Reports what came free as it should not, a share of the area of bonds [-]."""
  o.event(s, "slip", value, "torn")


# Formulas.


def shown(k: int, done: int) -> int:
  """Returns the look of mark k where it is the turn of that after so many."""
  if k == done:
    return NOW
  return LATER if k > done else HIDDEN


def closeness(distance: float, start: float) -> float:
  """Returns 1 at the goal, 0 at the distance it started from, towards -1 far away [-].

  It falls with every distance, so that an agent that has gone astray is still told the way back.
  """
  least = max(start, 1e-3)
  if distance < least:
    return 1.0 - distance / least
  return least / distance - 1.0
