"""The same test as a measured one, simulated: a tool, or two, go the way that was measured."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
from palpate import add_organ
from palpate.models import block, catalog, organs, shapes
from palpate.models.meshing.refine import refine
from palpate.organ import Organ
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology

from ..console import CommandError
from .least_squares import Stopped
from .measured import Record

_STEPS = 600  # of a record, unless the time step is given
_LEAST, _MOST = 2.5e-4, {"sphere": 4e-3, "flat": 1e-3}  # time step [s]
# In the radius of the contact, of the finest triangles; a flat tool has a rim.
_EDGES = {"sphere": 3.0, "flat": 5.0}
_AROUND = 1.6  # radii of the contact that those reach
_NODES = 1000  # of an organ, before it gets finer under the tool
_WINDOW = 1500  # vertices under a tool; where more are touched forces are up to 10 % off
_SOFT = 0.02  # share of the radius of the tool that the organ's flex has
_SUNK = 0.8  # of a block's height, that a tool may go
_FOLLOW = 0.3  # of a change of that depth in a step, which contacts take three steps for
_TRIES, _SMALLER = 6, 0.93  # of edges, where tetrahedra do not fill a mesh
_HEAVY = 1e4  # times the organ's mass, so that contacts do not move the tool


@dataclasses.dataclass(frozen=True)
class Test:
  """An indentation, or a grasp: two tools opposite each other, each of which goes half the way.

  Attributes:
    tip: of the tool, sphere or flat
    radius: of the tool [m]
    size: of a block, held at its bottom and pressed in the middle of its top, or held at one side
      and grasped in the middle of top and bottom [m]; or
    organ: of the catalogue, and
    place: where on it
    edge: longest edge of a triangle under the tool [m]; None for a third of the contact's radius,
      a fifth for a flat tool
    step: time step [s]; None to take some 600 for the record
    grasp: whether it is one, of a block
  """

  tip: str
  radius: float
  size: tuple[float, float, float] | None = None
  organ: str = ""
  place: str = ""
  edge: float | None = None
  step: float | None = None
  grasp: bool = False

  @property
  def share(self) -> float:
    """What each tool goes of the way that was measured."""
    return 0.5 if self.grasp else 1.0


@dataclasses.dataclass(frozen=True)
class Sample:
  """What is pressed.

  Attributes:
    mesh: vertices [m] and triangles
    pin: vertices that are held
    touch: where each tool touches first [m], and from where it comes
    mass: [kg]
    keys: the plugin's configuration
  """

  mesh: tuple[np.ndarray, np.ndarray]
  pin: np.ndarray
  touch: list[tuple[np.ndarray, np.ndarray]]
  mass: float
  keys: dict


class Indentation:
  """A test that is simulated, for any constants of the tissue.

  Args:
    test: what is pressed by what
    record: how deep at which time
  """

  def __init__(self, test: Test, record: Record):
    self._test, self._record = test, record
    self.step = test.step or float(np.clip(record.time[-1] / _STEPS, _LEAST, _MOST[test.tip]))
    deepest = test.share * float(record.depth.max())
    contact = test.radius  # how wide it gets [m]
    if test.tip == "sphere":
      contact = min(contact, math.sqrt(contact * deepest))
    edge, around = test.edge or contact / _EDGES[test.tip], _AROUND * contact
    for _ in range(_TRIES):
      if test.organ:
        self.sample = _of_catalogue(test, edge, around)
      else:
        self.sample = _block(test, edge, around, deepest)
      fault = _fault(self.sample)
      if not fault:
        return
      edge *= _SMALLER
    raise CommandError(f"{fault}; another --edge may do", code=1)

  @property
  def _tools(self) -> list[str]:
    return [f"tool{k}" for k in range(len(self.sample.touch))]

  @property
  def nodes(self) -> int:
    """Vertices of the tissue's surface."""
    return len(self.sample.mesh[0])

  @property
  def keys(self) -> dict:
    """The tissue's configuration before any constant is changed."""
    return self.sample.keys

  def force(
    self, constants: Mapping[str, float], is_stopped: Callable[[], bool] = lambda: False
  ) -> np.ndarray:
    """Returns the tissue's push on the tool at the record's times [N], (n,).

    Raises:
      Stopped: `is_stopped`, asked before each step, said so
    """
    try:
      # Compiled anew, since what contacts meet follows from stiffness and damping.
      model = self._scene(constants).compile()
      data = mujoco.MjData(model)
      organ = Organ(model, data, "tissue")
    except (ValueError, mujoco.FatalError) as error:
      raise CommandError(str(error).strip().splitlines()[-1]) from None
    joints, record, h = [model.joint(name) for name in self._tools], self._record, self.step
    qpos, dof = ([int(getattr(joint, adr)[0]) for joint in joints] for adr in ("qposadr", "dofadr"))
    time = h * np.arange(math.ceil(record.time[-1] / h) + 2)
    depth = self._test.share * np.interp(time, record.time, record.depth)
    force, sunk = np.zeros(len(time) - 1), 0.0
    for k in range(len(force)):
      if is_stopped():
        raise Stopped
      data.qpos[qpos] = depth[k] + sunk
      data.qvel[dof] = (depth[k + 1] - depth[k]) / h
      mujoco.mj_step(model, data)
      force[k] = -data.qfrc_constraint[dof].mean()
      sunk += _FOLLOW * (_sunk(data) - sunk)
    if organ.error or not np.isfinite(force).all():
      raise CommandError(f"the simulation broke off: {organ.error or 'a force is nan'}", code=1)
    if not force[depth[1:].argmax()] > 0:
      raise CommandError(f"the tool went through the tissue, expected h under {h:g} s", code=1)
    return np.interp(record.time, time[1:], force)

  def _scene(self, constants: Mapping[str, float]) -> mujoco.MjSpec:
    test, sample = self._test, self.sample
    spec = mujoco.MjSpec()
    spec.option.timestep = self.step
    spec.option.gravity = np.zeros(3)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.memory = 500 << 20
    soft = _SOFT * test.radius
    for name, (at, away) in zip(self._tools, sample.touch, strict=True):
      tool = spec.worldbody.add_body(name=name, pos=at + soft * away, quat=_facing(away))
      tool.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, -1])
      _add_tip(tool, test, soft, _HEAVY * sample.mass)
    keys: dict[str, Any] = {**sample.keys, **constants}
    add_organ(
      spec, sample.mesh, "tissue", mass=sample.mass, pin=sample.pin.tolist(), radius=soft,
      contact={"condim": 1, "solref": (3 * self.step, 1), "solimp": (0.99, 0.999, 1e-4)},
      windows={"nodes": min(len(sample.touch) * _WINDOW, self.nodes)}, device="cpu", **keys,
    )  # fmt: skip
    return spec


def _sunk(data: mujoco.MjData) -> float:
  """Returns how far the tool has sunk into the contacts, which are soft [m].

  The mean over their forces: by reciprocity that is what a little compliance on a surface adds to
  the way of a tool whose force is given.
  """
  row = np.maximum(data.contact.efc_address, 0)
  force = np.where(data.contact.efc_address < 0, 0.0, data.efc_force[row] if data.nefc else 0.0)
  return -float(force @ data.contact.dist) / max(float(force.sum()), 1e-12)


def _fault(sample: Sample) -> str:
  """Returns why tetrahedra cannot fill a sample, if they cannot."""
  if sample.keys.get("elements") != "solid":
    return ""
  try:
    fill.fill("tissue", topology.build("tissue", *sample.mesh))
  except ValueError as error:
    return str(error)
  return ""


def first_guess(test: Test, record: Record, poisson: float) -> float:
  """Returns Young's modulus [Pa] by the formula of a half space, of the deepest row.

  Hertz: F = 4/3 E* sqrt(R) d^1.5; a flat punch: F = 2 E* R d (Johnson 1985, Contact Mechanics,
  eq. 4.23 and 3.36), with E* = E / (1 - nu^2).
  """
  k = int(record.depth.argmax())
  depth, force = test.share * float(record.depth[k]), float(record.force[k])
  if test.tip == "sphere":
    reduced = 0.75 * force / math.sqrt(test.radius * depth**3)
  else:
    reduced = 0.5 * force / (test.radius * depth)
  return reduced * (1 - poisson**2)


def _add_tip(tool, test: Test, soft: float, mass: float):
  """Adds the geom of the tool, whose front is at the body's origin, the flex's radius off it."""
  if test.tip == "sphere":
    radius = test.radius - soft  # a sphere and a flex of radius `soft` meet as one of `radius`
    tool.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=[0, 0, radius],
                  mass=mass, condim=1)  # fmt: skip
    return
  tool.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[test.radius, test.radius, 0],
                pos=[0, 0, test.radius], mass=mass, condim=1)  # fmt: skip


def _facing(away: np.ndarray) -> np.ndarray:
  """Returns the orientation whose z axis is `away`."""
  quat = np.zeros(4)
  mujoco.mju_quatZ2Vec(quat, away)
  return quat


def _block(test: Test, edge: float, around: float, deepest: float) -> Sample:
  """Returns a block that stands on a table, or that is held at one side."""
  assert test.size is not None
  if deepest > _SUNK * test.share * test.size[2]:
    raise CommandError(
      f"depth is up to {deepest / test.share:g} m, expected at most {_SUNK:g} of sample-size's "
      f"height, {test.size[2]:g} m"
    )
  spacing = min(max(min(test.size) / 6, 1.5 * edge), min(test.size) / 2)
  points, elem = block.specimen(test.size, around, min(edge, spacing), spacing, test.grasp)
  half = np.array(test.size) / 2
  if test.grasp:
    pin = np.flatnonzero((np.abs(points[:, :2]) > half[:2] - 1e-9).any(axis=1))
  else:
    pin = np.flatnonzero(points[:, 2] < -half[2] + 1e-9)
  up = np.array([0.0, 0.0, 1.0])
  touch = [(sign * half[2] * up, sign * up) for sign in (1, -1)[: 1 + test.grasp]]
  mass = catalog.TISSUES["liver"].mass_of(math.prod(test.size))
  return Sample((points, elem), pin, touch, mass, {"elements": "solid"})


def _of_catalogue(test: Test, edge: float, around: float) -> Sample:
  """Returns an organ of the catalogue, solid where it is not hollow."""
  built = organs.build(test.organ, _NODES)
  at = built.landmarks[test.place]
  points, elem = refine(built.vertices, built.triangles, at, around, edge)
  pin = np.unique(np.concatenate(list(shapes.patches(built.entry.shape, points).values())))
  corner = points[elem]
  normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
  near = np.linalg.norm(corner.mean(axis=1) - at, axis=1) < max(around, edge)
  away = normal[near].sum(axis=0)
  away /= np.linalg.norm(away)
  at = at + float(((points - at) @ away)[np.linalg.norm(points - at, axis=1) < around].max()) * away
  solid = not built.entry.hollow
  keys = built.entry.tissue.keys(solid) | ({"elements": "solid"} if solid else {})
  return Sample((points, elem), pin, [(at, away)], built.mass, keys)
