"""Trace: follow a curve drawn on the stomach with the probe, in light contact.

Own observations: `target` (3,), from the tip to the next point of the curve [m]; `ahead` (3, 3),
from the tip to points 5, 10 and 15 mm further along the curve [m].

Progress: 0.1 * closeness to the next point of the curve + 0.9 * share of the curve's length traced.
Tracing starts within the tolerance of the curve's start, and goes on as far as the tip gets along
the curve while it presses with 0.02 N or more within the tolerance of it, step after step. Where
contact is lost or the curve left, it goes on from what is traced already: what is skipped in the
air does not count, but for gaps of 3 mm at most, together a tenth of the length. Success: all of
it, to the last 1.5 mm. Failure: a force above the damage limit, or the time limit.

Shaping: 0.15 * that closeness + 0.1 while it traces, times the share of the length that is left.
"""

import dataclasses
import math
from typing import Annotated, Any

import numpy as np
import scipy
import warp as wp
from palpate.tissue.types import Array, floats, ints

from ..core import rules as r
from ..core.base import Physics, Task
from ..core.performer import Performer, Script
from ..core.scenes import Scene
from ..registry import exercise

STOMACH = Scene(organ="stomach", center="body", port=(0.03, 0.045, 0.12), camera=(-0.05, 0.1, 0.14))
CONTACT = 0.02  # [N]
STEP = 0.0015  # between points of the curve [m]
GAP, SKIPPED = 0.003, 0.1  # largest gap in contact [m], and share of the length that all may have
WINDOW = 4  # points before and after the end of what is traced, to look for the tip between
AHEAD = tuple(round(d / STEP) for d in (0.005, 0.01, 0.015))  # points that are observed
FIRST, SECOND, THIRD = AHEAD
DRAWN = 160  # points along the curve as it is drawn
_ATTEMPTS = 40
_FACING = 0.7  # least cosine between the surface's normal and the way to the trocar
MARKS = 30  # spheres that draw the curve
LEAD = 4  # of them that show where to begin or to go on, and which way: one is a pixel from afar


class State:
  """State of a world."""

  tolerance: float  # [m]
  count: int  # points of the curve
  triangles: Annotated[Any, ints(DRAWN)]  # they lie in
  weights: Annotated[Any, Array(wp.vec3, (DRAWN,))]
  arc: Annotated[Any, floats(DRAWN)]  # how far along the curve they are [m]
  traced: float  # [m]
  skipped: float  # [m]
  tracing: bool
  touching: bool
  distance0: float  # [m]
  target: r.Vector
  ahead: r.Vectors3


# The rules. What goes over many points is written for numpy, and for many worlds below it.


def settle(s, o):
  """Finds where the curve is, which moves with the organ."""
  corners = s.nodes()[s.organ.elem[o.triangles]]
  o.now = np.einsum("ij,ijk->ik", o.weights, corners)
  return o


@r.many(settle)
def _settle(s, o):
  return o


def place(s, o, k):
  """Returns where a point of the curve is [m]."""
  return o.now[k]


@r.many(place)
def _place(s, o, k):
  t, share = o.triangles[k], o.weights[k]
  return share[0] * r.corner(s, t, 0) + share[1] * r.corner(s, t, 1) + share[2] * r.corner(s, t, 2)


def done(o):
  """Returns the number of points that are traced."""
  return int(np.searchsorted(o.arc, o.traced, side="right")) if o.traced else 0


@r.many(done)
def _done(o):
  found = int(0)
  if o.traced > 0.0:
    for k in range(o.count):
      if o.arc[k] <= o.traced:
        found = k + 1
  return found


def project(s, o):
  """Returns how far along the curve the tip is, near what is traced, and how far off it [m]."""
  k = max(done(o) - 1, 0)
  part = slice(max(k - WINDOW, 0), k + WINDOW + 1)
  start, arc = o.now[part], o.arc[part]
  along = np.diff(start, axis=0)
  offset = r.tip(s) - start[:-1]
  share = np.einsum("ij,ij->i", offset, along) / np.einsum("ij,ij->i", along, along)
  share = np.clip(share, 0.0, 1.0)
  off = np.linalg.norm(offset - share[:, None] * along, axis=1)
  i = int(off.argmin())
  return float(arc[i] + share[i] * (arc[i + 1] - arc[i])), float(off[i])


@r.many(project)
def _project(s, o):
  middle = max(done(o) - 1, 0)
  along_curve, off = float(0.0), float(r.FAR)
  for k in range(max(middle - WINDOW, 0), min(middle + WINDOW, o.count - 1)):
    start = place(s, o, k)
    along = place(s, o, k + 1) - start
    share = r.clamp(r.dot(r.tip(s) - start, along) / r.dot(along, along), 0.0, 1.0)
    far = r.length(r.tip(s) - start - share * along)
    if far < off:
      off = far
      along_curve = o.arc[k] + share * (o.arc[k + 1] - o.arc[k])
  return along_curve, off


def aside(s, o):
  """Returns how far the tip is from the nearest point of the curve [m]."""
  return float(scipy.spatial.KDTree(o.now).query(r.tip(s))[0])


@r.many(aside)
def _aside(s, o):
  off = float(r.FAR)
  for k in range(o.count):
    off = min(off, r.length(place(s, o, k) - r.tip(s)))
  return off


def distance(s, o):
  """Returns how far the tip is from the next point of the curve [m]."""
  return r.length(place(s, o, min(done(o), o.count - 1)) - r.tip(s))


def follow(
  tracing: bool,
  traced: float,
  skipped: float,
  place: float,
  on: bool,
  tolerance: float,
  length: float,
) -> tuple[bool, float, float]:
  """Returns whether tracing goes on, how far it has come, and what gaps add up to [m].

  Args:
    tracing: whether it did
    traced: how far it had come along the curve [m]
    skipped: what gaps added up to [m]
    place: of the tip along the curve [m]
    on: whether it presses on the curve
    tolerance: largest distance of the start from the curve's [m]
    length: of the curve [m]
  """
  gap = place - traced
  again = on and not tracing and gap > 0.0
  within = gap <= GAP and skipped + gap <= SKIPPED * length
  if traced == 0.0:
    within = place <= tolerance
  goes = on and (within or not again)
  further = max(traced, place) if goes else traced
  return goes, further, skipped + gap if again and goes and traced > 0.0 else skipped


def advance(s, o):
  """Follows the tip along the curve."""
  o = settle(s, o)
  whole = o.arc[o.count - 1]
  touches = r.force(s) > CONTACT
  along, off = project(s, o)
  on = touches and off <= o.tolerance
  tracing, traced, skipped = follow(o.tracing, o.traced, o.skipped, along, on, o.tolerance, whole)
  o.tracing = tracing
  o.traced = traced
  o.skipped = skipped
  if o.touching and not touches and traced > 0.0:
    r.drop(s, o)
  if touches and not o.touching:
    beside = aside(s, o)
    if beside > o.tolerance:
      r.miss(s, o, beside)
  o.touching = touches
  if traced >= whole - STEP:
    return o, 1.0, r.SUCCESS
  return o, 0.1 * r.closeness(distance(s, o), o.distance0) + 0.9 * traced / whole, r.RUNNING


def shaping(s, o):
  """Returns what tells the way to the curve, and to stay on it."""
  left = 1.0 - o.traced / o.arc[o.count - 1]
  on = 0.1 if o.tracing else 0.0
  return left * (0.15 * r.closeness(distance(s, o), o.distance0) + on)


def observe(s, o):
  """Finds target and ahead."""
  at, last, here = done(o), o.count - 1, r.tip(s)
  o.target = place(s, o, min(at, last)) - here
  o.ahead = r.rows(
    place(s, o, min(at + FIRST, last)) - here,
    place(s, o, min(at + SECOND, last)) - here,
    place(s, o, min(at + THIRD, last)) - here,
  )
  return o


def marked(o, k):
  """Returns the number of the point where a mark is."""
  return (2 * k * (o.count - 1) + MARKS - 1) // (2 * (MARKS - 1))


def mark(s, o, k):
  """Marks what is left of the curve, and where to begin or to go on."""
  at, first = marked(o, k), min(done(o), o.count - 1)
  begins = at >= first and (k < LEAD or marked(o, max(k - LEAD, 0)) < first)
  look = r.LATER if at >= first else r.HIDDEN
  return place(s, o, at), r.NOW if begins else look


@exercise("trace/easy", 20, "easy", asks="Trace an arc of about 40 mm within 5 mm",
          scene=dataclasses.replace(STOMACH, nodes=250), size=0.02, turns=0.0,
          tolerance=0.005)  # fmt: skip
@exercise("trace/standard", 30, asks="Trace an S of about 60 mm within 3.5 mm",
          scene=dataclasses.replace(STOMACH, nodes=500), size=0.025, turns=1.0, tolerance=0.0035,
          jitter=0.005)  # fmt: skip
@exercise("trace/hard", 40, "hard",
          asks="Trace a double S of about 80 mm within 3 mm, on stomachs that vary",
          scene=dataclasses.replace(STOMACH, nodes=1000), size=0.026, turns=2.0, tolerance=0.003,
          jitter=0.005, variants=(None, 1, 2), force_limit=0.5, damage=2.0)  # fmt: skip
class Trace(Task):
  """Follow a curve in light contact."""

  watch = ("miss", "unintended_contact", "drop")
  mark_radius = 0.0015
  targets = MARKS
  rules = r.Rules(State, advance, observe, ("target", "ahead"), shaping=shaping, mark=mark)

  def __init__(self, *, size: float, turns: float, tolerance: float, **kwargs):
    """Makes the task.

    Args:
      size: half the width of the curve [m]
      turns: how often it waves; 0 is an arc
      tolerance: largest distance of the tip from the curve [m]
      **kwargs: see Task
    """
    self.size, self.turns, self.tolerance = size, turns, tolerance
    super().__init__(**{"spread": 0.03, **kwargs})

  def begin(self, physics: Physics) -> None:
    """Draws the curve: a wave in the plane across the shaft, dropped on the surface."""
    place, center = self.place_of_work(physics)
    for attempt in range(_ATTEMPTS):  # where the organ is narrow a curve may fall off its edge
      if attempt:
        center = physics.point(self.random.choice(place))
      drawn = self._draw(physics, center, self.size * 0.98**attempt)
      if drawn is not None:
        self.curve, self.triangles, self.weights = drawn
        break
    else:
      raise ValueError(f"{self.name}: no room for the curve under the shaft")
    gaps = np.linalg.norm(np.diff(self.curve, axis=0), axis=1)
    self.arc = np.concatenate([[0.0], gaps.cumsum()])
    self.traced, self.skipped = 0.0, 0.0
    self.tracing, self.touching = False, False
    self.now, self.count = self.curve, len(self.curve)
    self.distance0 = distance(physics, self)
    self.reference_length = float(self.arc[-1]) + self.distance0

  def _draw(self, physics: Physics, center: np.ndarray, size: float):
    """Returns points, triangles and weights in them; None where the curve leaves the place."""
    port = physics.trocar()
    across = port.mat[:, :2]
    angle = self.random.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    t = np.linspace(-1, 1, DRAWN)
    bend = self.random.uniform(0.25, 0.4) * self.random.choice([-1, 1])
    if self.turns:
      wave = bend * np.sin(self.turns * np.pi * t)
    else:
      wave = bend * (1 - t**2)
    flat = size * np.stack([t, wave], axis=1) @ turn.T
    start = center + flat @ across.T
    # Drop along the shaft: the triangle hit from outside that is nearest to the trocar.
    elem, x, ray = physics.organ.elem, physics.nodes(), -port.mat[:, 2]
    drawn, spread = start @ across, (x @ across)[elem]
    under = (spread.min(axis=1) <= drawn.max(axis=0)) & (spread.max(axis=1) >= drawn.min(axis=0))
    under = np.flatnonzero(under.all(axis=1))
    if not len(under):
      return None
    a, b, c = np.moveaxis(x[elem[under]], 1, 0)
    e1, e2, origin = b - a, c - a, start - 0.1 * ray
    p, s = np.cross(ray, e2), origin[:, None] - a
    q = np.cross(s, e1)
    with np.errstate(divide="ignore", invalid="ignore"):
      scale = 1 / np.einsum("ij,ij->i", e1, p)
      u, v = np.einsum("kij,ij->ki", s, p) * scale, (q @ ray) * scale
      far = np.einsum("ij,kij->ki", e2, q) * scale
      far[~((u >= 0) & (v >= 0) & (u + v <= 1) & (far > 0))] = np.inf
    hit = np.arange(DRAWN), far.argmin(axis=1)
    if not np.isfinite(far[hit]).all():
      return None
    points, triangles = origin + far[hit][:, None] * ray, under[hit[1]]
    weights = np.stack([1 - u[hit] - v[hit], u[hit], v[hit]], axis=1)
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if gaps.max() > STEP or (physics.normals()[triangles] @ -ray).min() < _FACING:
      return None
    along = np.concatenate([[0], gaps.cumsum()])
    keep = np.unique(np.searchsorted(along, np.arange(0, along[-1], STEP)))
    return points[keep], triangles[keep], weights[keep]

  @property
  def done(self) -> int:
    """Number of points of the curve that are traced."""
    return done(self)

  def label(self, kind: str) -> str:
    """Returns what a drop is."""
    return "contact lost" if kind == "drop" else ""

  def instruct(self, physics: Physics) -> str:
    """Says where to begin, or to go on."""
    if not self.traced:
      return "Touch the beginning of the line"
    if not self.touching:
      return "Touch the line where you have left it, and go on"
    return f"Follow the line in light contact, {100 * self.traced / float(self.arc[-1]):.0f} % done"

  def constants(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns the curve to trace [m]."""
    return {"curve": self.curve}

  def expert(self, p: Performer) -> Script:
    """Goes along the curve in light contact."""
    physics = p.physics
    up = physics.trocar().mat[:, 2]
    at = min(float(self.done), len(self.curve) - 1.0)
    if not self.tracing:
      yield from p.above(self.curve[int(at)], 0.01, up)
    yield from p.push(0.08, -up, lambda: self.tracing, most=3.0)
    # Pulls a point along the curve and keeps the force by its height.
    height, contact = float((p.tip - self.curve[int(at)]) @ up), 0.0
    step = 0.02 * p.style.speed * self.control_timestep / STEP
    while self.outcome is None:
      contact += self.control_timestep
      # Where contact was lost it waits, or goes back behind what is traced.
      most = self.done + 3.0 if self.tracing else max(at - 0.5, self.done - 3.0)
      at = min(at + step, max(most, 0.0), len(self.curve) - 1)
      force = float(np.linalg.norm(physics.contact_force()))
      error = 0.15 * p.excess(contact) - force
      height -= p.care * float(np.clip(0.08 * error, -0.01, 0.01)) * self.control_timestep
      k = int(at)
      ahead = self.curve[min(k + 1, len(self.curve) - 1)]
      rest = self.curve[k] + (at - k) * (ahead - self.curve[k])
      wander = p.style.detour * 0.006 * math.sin(2.5 * contact)
      wander += p.style.overshoot * 0.012 * math.sin(5 * contact)
      p.tip = rest + height * up + wander * physics.trocar().mat[:, 0]
      yield p.step()
    yield from p.move(p.tip + 0.01 * up)
