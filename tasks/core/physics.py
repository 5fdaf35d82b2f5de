"""The physics of an exercise: one organ, an instrument or two, and what one asks of them."""

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import mujoco as mj
import numpy as np
import scipy
from palpate import Organ, Thread
from palpate.forces.needles import Needle
from palpate.models import laparoscope
from palpate.tissue.config import Config
from palpate.tissue.geometry import mesh as topology

from ..learn.portable import Portable
from ..metrics.samples import Stretch
from . import scenes
from .engine import wrap
from .instrument import SCOPE, Instrument, Second, axes, jawed
from .scenes import CAMERA, GUIDED, LIGHT, ORGAN
from .stage import STATE

NEAR, COARSE = 8, 32  # nodes in the observations
_FACING = 0.75  # least cosine between a target's normal and the way to the trocar
_PIN_GAP = 0.012  # targets keep this far from pinned nodes [m]


class Physics(Instrument, Portable):
  """Physics of an exercise: one organ, and its instrument on a trocar.

  It is that instrument itself, where one asks for its tip and forces; where there are two, the
  other is `second`, and the largest forces are those of both.

  Attributes:
    second: the instrument of the other hand, None where there is none
    guided: an instrument that the exercise itself moves, in nobody's hand; None for none
    thread: the scene's thread, None for none
    looked: where `look_from` has put the laparoscope, and its orientation; None where it stands
    eyes: what draws pictures without OpenGL, once it did
    rests: whether nothing moves in it: episodes are drawn from it alone
    meanwhile: called in the middle of every `step`, with what need not be done at its end, where a
      live exercise has least time; None for nothing
  """

  second: Second | None = None
  guided: Second | None = None
  looked: np.ndarray | None = None
  thread: Thread | None = None
  eyes: Any = None
  rests = False
  meanwhile: Callable[[], None] | None = None

  def use(
    self, model: mj.MjModel, prefix: str, targets: int, organ: str = ORGAN, second: str = ""
  ) -> None:
    """Takes a compiled scene; ValueError names what it lacks.

    Args:
      model: with the organ, the instrument and the sites `target0`, ...
      prefix: of the instrument, for instance "probe/"
      targets: number of target sites needed
      organ: name of the organ
      second: prefix of the other hand's instrument, "" where there is none
    """
    self.organ_name = organ
    for name in filter(None, (prefix, second)):
      held = mj.mj_name2id(model, mj.mjtObj.mjOBJ_BODY, f"{name}handle") >= 0
      check_scene(model, name, targets, organ, held)
    if model is not self.model.ptr:
      self._reload_from_model(wrap(model))
    self.organ = Organ(model, self.data.ptr, organ)
    threads = [
      mj.mj_id2name(model, mj.mjtObj.mjOBJ_FLEX, k) for k in np.flatnonzero(model.flex_dim == 1)
    ]
    self.thread = Thread(model, self.data.ptr, threads[0]) if threads else None
    self._nodes: np.ndarray | None = None
    self._needle: Needle | None = None
    self._points: dict[int, np.ndarray] = {}
    self._camera = model.camera(CAMERA).id
    self.target_sites = [model.site(f"target{i}").id for i in range(targets)]
    model.site_sameframe[self.target_sites] = 0  # else a site at its body's origin stays there
    self._xpos0 = self.organ.xpos0
    self.coarse = topology.spread(self._xpos0, COARSE)
    self._coarse0 = self._xpos0[self.coarse]
    self._stretch: tuple[np.ndarray, np.ndarray, Stretch] | None = None
    self._cuts = bool(self.organ.config.cutters)
    self.equip(prefix)
    self.second = self.beside(second) if second else None
    moved = mj.mj_name2id(model, mj.mjtObj.mjOBJ_BODY, f"{GUIDED}trocar") >= 0
    self.guided = self.beside(GUIDED) if moved else None
    self.quiet()

  def beside(self, prefix: str) -> Second:
    """Returns another instrument of the scene."""
    return Second(self, prefix)

  @property
  def hands(self) -> tuple[Instrument, ...]:
    """The instruments, the main one first."""
    return (self, self.second) if self.second else (self,)

  def step(self, nstep: int = 1) -> None:
    """Advances the physics; keeps the contact forces on tip, shaft and jaws of all the steps."""
    with self.check_invalid_state():
      model, data = self.model.ptr, self.data.ptr
      begin, end, sensors = mj.mj_step1, mj.mj_step2, data.sensordata
      values = np.empty((nstep, model.nsensordata))
      hands, h = self.hands, self.timestep()
      busy = [hand for hand in hands if hand.busy]
      for hand in hands:
        hand.begin(nstep)
      for k in range(nstep):
        end(model, data)
        values[k] = sensors
        if self._cuts:  # MuJoCo's contacts know nothing of it
          self.edge = np.sum([cutter.force for cutter in self.organ.cutters], axis=0)
          values[k, self._sensors["tip_force"]] += self.edge
        for hand in busy:
          hand.advance(k, nstep, h)
        if k == nstep // 2 and self.meanwhile is not None:
          self.meanwhile()
        begin(model, data)
      for hand in hands:
        hand.keep(values)
      self._join()
      self.moved()

  def _join(self) -> None:
    """Takes the largest forces of both hands."""
    if self.second:
      for name in ("peak_force", "peak_tissue", "peak_shaft", "peak_surroundings"):
        setattr(self, name, max(getattr(self, name), getattr(self.second, name)))

  def resume(self, data: mj.MjData, rest: dict[str, Any], config: Config) -> None:
    """See `Portable`."""
    super().resume(data, rest, config)
    for other in filter(None, (self.second, self.guided)):
      other.bind(self)

  def quiet(self) -> None:
    """See `Instrument`; of all."""
    super().quiet()
    self.looked = None
    if self.second:
      self.second.quiet()

  def forward(self) -> None:
    """Recomputes what depends on the state."""
    super().forward()
    self.moved()

  def moved(self) -> None:
    """Forgets what `nodes`, `point`, `needle` keep: for a state that is changed from outside."""
    self._nodes, self._points, self._needle = None, {}, None

  def place(self, state: np.ndarray) -> None:
    """Puts the physics in an integration state, from which it goes on as it did before."""
    mj.mj_setState(self.model.ptr, self.data.ptr, state, STATE)
    mj.mj_forward(self.model.ptr, self.data.ptr)
    # mj_forward replaces the warm start.
    mj.mj_setState(self.model.ptr, self.data.ptr, state, STATE)
    self.moved()

  def integration_state(self) -> np.ndarray:
    """Returns everything that the next step depends on (mjSTATE_INTEGRATION)."""
    state = np.empty(mj.mj_stateSize(self.model.ptr, STATE))
    mj.mj_getState(self.model.ptr, self.data.ptr, state, STATE)
    return state

  def free_pose(self, name: str) -> np.ndarray:
    """Returns place [m] and orientation, w x y z, of the body of a free joint  (7,)."""
    return self.data.ptr.joint(name).qpos

  def felt_by(self, name: str) -> np.ndarray:
    """Returns a copy of a sensor of the scene."""
    return self.data.ptr.sensor(name).data.copy()

  def put(self, joints: Mapping[str, np.ndarray], bodies: Mapping[str, np.ndarray]) -> None:
    """Puts joints at positions, and bodies that have none at a place and orientation  (7,)."""
    model, data = self.model.ptr, self.data.ptr
    for name, row in bodies.items():
      model.body(name).pos[:], model.body(name).quat[:] = row[:3], row[3:]
    for name, values in joints.items():
      data.joint(name).qpos[:] = values
    if joints or bodies:
      mj.mj_forward(model, data)

  def nodes(self) -> np.ndarray:
    """Returns the positions of the organ's nodes [m]  (nvert, 3); computed once a control step."""
    if self._nodes is None:
      moved = self.organ.displacement
      rest = self._xpos0 if len(moved) == len(self._xpos0) else self.organ.xpos0  # it is cut
      nodes = rest + moved
      nodes.flags.writeable = False
      self._nodes = nodes
    return self._nodes

  def needle(self) -> Needle:
    """Returns what the organ's one needle does; computed once a control step."""
    if self._needle is None:
      (self._needle,) = self.organ.needles
    return self._needle

  def strain(self, rest: np.ndarray) -> Callable[[], float]:
    """Returns what works out the largest strain of the organ's surface as it is now [-].

    Args:
      rest: nodes against which, of an organ that is cut its shape at rest [m]  (nvert, 3)
    """
    now, elem = self.nodes(), self.organ.elem
    if self._stretch is None or self._stretch[0] is not rest or self._stretch[1] is not elem:
      same = len(now) == len(rest)
      self._stretch = rest, elem, Stretch(rest if same else self.organ.xpos0, elem)
    return functools.partial(self._stretch[2].most, now)

  def nodes_near(self) -> np.ndarray:
    """Returns the organ's nodes nearest to the tip, from the tip [m]  (NEAR, 3)."""
    offset = self.nodes() - self.tip_pos()
    distance2 = np.einsum("ij,ij->i", offset, offset)
    near = distance2.argpartition(NEAR)[:NEAR]
    return offset[near[distance2[near].argsort(kind="stable")]]

  def surface(self) -> np.ndarray:
    """Returns the displacement of nodes spread over the organ [m]  (COARSE, 3)."""
    return self.nodes()[self.coarse] - self._coarse0

  def point(self, triangle: int) -> np.ndarray:
    """Returns where the middle of one of the organ's triangles is [m]  (3,); as `nodes`."""
    if triangle not in self._points:
      a, b, c = self.nodes()[self.organ.elem[triangle]]
      self._points[triangle] = (a + b + c) / 3
    return self._points[triangle].copy()

  def normals(self) -> np.ndarray:
    """Returns the outward unit normals of the organ's triangles  (nelem, 3)."""
    normal = _twice_area(self.nodes(), self.organ.elem)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)

  def normal(self, triangle: int) -> np.ndarray:
    """Returns the outward unit normal of one of the organ's triangles  (3,)."""
    # In plain numbers, as every step asks for one.
    (ax, ay, az), b, c = self.nodes()[self.organ.elem[triangle]].tolist()
    ux, uy, uz = b[0] - ax, b[1] - ay, b[2] - az
    vx, vy, vz = c[0] - ax, c[1] - ay, c[2] - az
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(x * x + y * y + z * z)
    return np.array([x / length, y / length, z / length])

  def reachable(self, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the triangles that the instrument is to work on, and the middle of that place [m].

    They face the trocar within 40 deg, lie within `spread` [m] of where the shaft points and away
    from pinned nodes.
    """
    organ, port = self.organ, self.trocar()
    x = self.nodes()
    middle = x[organ.elem].mean(axis=1)
    shaft = -port.mat[:, 2]
    offset = middle - port.pos
    depth = offset @ shaft
    aside = np.linalg.norm(offset - depth[:, None] * shaft, axis=1)
    facing = -(self.normals() @ shaft)
    free = organ.free[organ.elem].all(axis=1)
    if not organ.free.all():
      pins = scipy.spatial.KDTree(x[~organ.free])
      free &= pins.query(middle)[0] > _PIN_GAP
    reach = np.linalg.norm(offset, axis=1)
    low, high = port.ranges[2] + port.depth + np.array([0.01, -0.015])
    fit = np.flatnonzero(free & (reach > low) & (reach < high) & (facing > _FACING))
    if not len(fit):
      raise ValueError(f"the shaft of {self.prefix!r} does not point at the organ, expected it to")
    center = middle[fit[np.argmin(aside[fit] + 0.3 * depth[fit])]]
    place = fit[np.linalg.norm(middle[fit] - center, axis=1) < spread]
    return place, center

  def contact_area(self) -> float:
    """Returns the area of the organ's triangles in contact with the instrument [m^2]."""
    data, model = self.data.ptr, self.model.ptr
    if not data.ncon:
      return 0.0
    contact = data.contact
    pairs = contact.flex.max(axis=1).tolist(), contact.elem.max(axis=1).tolist()
    flat = np.append(model.flex_dim == 2, False)  # not a thread, nor two geoms, which have -1
    touched = {pair for pair in zip(*pairs, strict=True) if flat[pair[0]]}
    if not touched:
      return 0.0
    flex, elem = np.array(sorted(touched)).T
    first = model.flex_elemdataadr[flex] + 3 * elem
    corners = model.flex_vertadr[flex, None] + model.flex_elem[first[:, None] + np.arange(3)]
    area = 0.0
    # One triangle or two under a probe, thirty in the jaws: plain numbers are quicker than arrays.
    for (ax, ay, az), b, c in data.flexvert_xpos[corners].tolist():
      ux, uy, uz = b[0] - ax, b[1] - ay, b[2] - az
      vx, vy, vz = c[0] - ax, c[1] - ay, c[2] - az
      area += math.hypot(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx) / 2
    return area

  def tip_visible(self) -> bool:
    """Whether the laparoscope's picture holds the tip; that of the laparoscope is its lens."""
    if self.prefix == SCOPE:
      return True
    return self.visible(self.data.ptr.sensordata[self._sensors["tip_pos"]])

  def visible(self, point: np.ndarray) -> bool:
    """Whether the laparoscope's picture holds a point of the world."""
    # As metrics.in_view; in plain numbers it takes a tenth of the time, and it runs every step.
    k, data = self._camera, self.data.ptr
    x, y, z = (point - data.cam_xpos[k]).tolist()
    m = data.cam_xmat[k].tolist()
    depth = -(m[2] * x + m[5] * y + m[8] * z)
    half = depth * math.tan(math.radians(float(self.model.ptr.cam_fovy[k])) / 2)
    across, up = m[0] * x + m[3] * y + m[6] * z, m[1] * x + m[4] * y + m[7] * z
    return depth > 0 and abs(up) <= half and abs(across) <= half * 4 / 3

  def look_from(self, row: np.ndarray) -> None:
    """Puts a laparoscope that stands elsewhere, from the next step on.

    What is hidden is so from where it stood when the episode began.

    Args:
      row: place of the lens [m] and orientation of the picture, w x y z  (7,)
    """
    if self.looked is None:
      self._eye = self.camera()[0]
    model, lamp = self.model.ptr, mj.mjtObj.mjOBJ_LIGHT
    laparoscope.stand(model, self._camera, mj.mj_name2id(model, lamp, LIGHT), row)
    self.looked = row

  def camera(self) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns the laparoscope's position [m], axes and vertical field of view [deg]."""
    k, data = self._camera, self.data.ptr
    return (
      data.cam_xpos[k].copy(),
      data.cam_xmat[k].reshape(3, 3).copy(),
      float(self.model.ptr.cam_fovy[k]),
    )

  def hidden(self, points: np.ndarray) -> np.ndarray:
    """Returns which points the organ hides from the laparoscope  (n,) bool.

    Rays against triangles after Moeller and Trumbore 1997.
    """
    eye = self.camera()[0] if self.looked is None else self._eye
    a, b, c = np.moveaxis(self.nodes()[self.organ.elem], 1, 0)
    e1, e2, s = b - a, c - a, eye - a
    q = _cross(s, e1)
    # Each product of a ray with a vector of a triangle is an entry of a matrix (n, nelem).
    rays = points - eye
    det, u, v = rays @ _cross(e2, e1).T, rays @ _cross(e2, s).T, rays @ q.T
    side, far = np.sign(det), (e2 * q).sum(axis=1)
    size, u, v, t = side * det, side * u, side * v, side * far
    return ((u >= 0) & (v >= 0) & (u + v <= size) & (t > 0) & (t < 0.999 * size)).any(axis=1)

  def mark(
    self,
    index: int,
    pos: np.ndarray,
    shown: bool = True,
    now: bool = False,
    size: float | None = None,
  ) -> None:
    """Puts target site `index` at `pos` [m], for the pictures, yellow where it is its turn now."""
    site = self.target_sites[index]
    if size is not None:
      self.model.site_size[site] = size
    self.model.site_rgba[site, :3] = scenes.NOW if now else scenes.LATER
    self.model.site_pos[site] = pos
    self.data.site_xpos[site] = pos
    self.model.site_rgba[site, 3] = 0.9 if shown else 0.0


def check_scene(
  model: mj.MjModel, prefix: str, targets: int, organ: str, handle: bool = False
) -> None:
  """Raises ValueError naming what a scene lacks for an exercise; arguments as `Physics.use`."""
  jaw, touch = (("jaw",), ("jaw", "touch_left", "touch_right")) if jawed(prefix) else ((), ())
  drives = () if handle else axes(prefix)
  for kind, names in (
    ("body", [f"{prefix}trocar", *([f"{prefix}handle"] if handle else [])]),
    ("site", [f"{prefix}tip", *(f"target{i}" for i in range(targets))]),
    ("actuator", [prefix + name for name in (*drives, *jaw)]),
    ("sensor", [prefix + name for name in ("tip_pos", "tip_force", "shaft_force", *touch)]),
    ("camera", [CAMERA]),
    ("flex", [organ]),
  ):
    for name in names:
      if mj.mj_name2id(model, getattr(mj.mjtObj, f"mjOBJ_{kind.upper()}"), name) < 0:
        raise ValueError(f"the scene has no {kind} {name!r}, which the exercise needs")


def _twice_area(pos: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns the normals of triangles, as long as twice their areas [m^2]  (nelem, 3)."""
  a, b, c = pos[elem[:, 0]], pos[elem[:, 1]], pos[elem[:, 2]]
  return _cross(b - a, c - a)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  """Returns the cross products of rows  (n, 3); a third of the time of numpy's."""
  (x1, y1, z1), (x2, y2, z2) = a.T, b.T
  return np.stack([y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2], axis=1)
