"""Scenes of the exercises: one organ, one instrument on a trocar, a laparoscope, target markers.

World: z is up, away from the table, and the patient lies on the back: the organ's frame (x to the
patient's right, y anterior, z superior) is turned so that anterior is up and superior is -y.

Every scene has the organ `organ`, the instrument under the prefix `probe/` or `grasper/`, the
camera `laparoscope` and the sites `target0`, `target1`, ... that the task puts where it wants
them.
"""

import dataclasses
import functools
from collections.abc import Mapping

import mujoco
import numpy as np
import palpate
from palpate.models import catalog, laparoscope, markup, mjcf, scenery, shapes, situs, trocar
from palpate.models.catalog import Tissue
from palpate.tissue.geometry.mesh import vertex_normals

NOW, LATER = (1.0, 0.8, 0.1), (0.2, 0.75, 0.95)  # colours of targets
FILM, RAW = (0.9, 0.74, 0.55, 0.9), (0.32, 0.05, 0.04, 1.0)  # colours of bonds that hold, and did
ORGAN = "organ"
BED = "bed"  # patch of the gallbladder, and the body that is in the liver's place
CAMERA = "laparoscope"
GUIDED = "guided/"  # prefix of an instrument that the exercise itself moves
LIGHT = situs.LIGHT
INPUTS = ("drives", "handle", "tip")
SURROUNDINGS = ("abdomen", "unseen", "none")
# The organ's solref counts, not the instrument's: light nodes want stiff contacts.
CONTACT = {
  "condim": 3,
  "selfcollide": "none",
  "solref": (0.002, 1),
  "solimp": (0.95, 0.99, 0.001),
  "solmix": 1e4,
}
# Residual of the organ's solve; 1e-4, the plugin's own, changes contact forces by 0.1 %.
TOLERANCE = 1e-2
# Slots of the organ's window for each 1000 nodes; the experts' instruments touch 15 and 38 at most.
_SLOTS = {"probe": 40, "grasper": 48, "scalpel": 40, "hook": 24, "laparoscope": 40, "psm": 40}
_SLOTS |= {"knot_pusher": 24}
# More than MuJoCo's 1 makes friction creep less: 2.4 N of grip then hold 3 N, with 3 only 2 N.
_IMPRATIO = {"probe": 3, "grasper": 10, "scalpel": 3, "laparoscope": 3, "psm": 100}
_IMPRATIO |= {"knot_pusher": 10}
# Foundation of an organ that comes away from its bed [Pa/m]; ours: what lies around it lets go too.
_LOOSE = 3e3
_FILM = (0.0045, 0.0045, 0.0012)  # of the film where a bond is, and of the raw bed [m]
_UNSEEN = 3  # group that no picture shows
_TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # organ's frame to world


# What the instrument feels of each organ; `catalog.TISSUES` has the sources.
TISSUES: Mapping[str, Tissue] = {
  organ: catalog.TISSUES[f"{organ}_field"]
  for organ in ("liver", "kidney", "stomach", "gallbladder")
}


@dataclasses.dataclass(frozen=True)
class Scene:
  """What a scene is made of; equal scenes compile to equal models.

  Attributes:
    organ: one of `TISSUES`
    instrument: `probe`, `grasper`, `scalpel`, `psm` or the `laparoscope`, which then has the camera
    nodes: number of the organ's nodes
    variant: seed of the organ's shape, None for the mean shape
    center: the organ's landmark that ports and camera look at
    port: from there to the trocar [m]  (3,)
    camera: from there to the camera [m]  (3,)
    second: instrument of the other hand, "" for none
    second_port: from the landmark to its trocar [m]  (3,)
    optics: angle between the laparoscope's shaft and its view, where it is the instrument [rad]
    guided: instrument that the exercise itself moves and that meets nothing, "" for none
    guided_port: from the landmark to its trocar [m]  (3,)
    targets: number of target sites
    inclusion: hidden stiff place: position in the world [m] (3), radius [m], factor on Young's
      modulus; None for healthy tissue. Without gravity: the organ would sag less where it is stiff
    input: what an action moves: position `drives`, a `handle` that pulls the instrument, or the
      pose of its `tip`, which inverse kinematics turns into targets of the drives
    bonds: stiffness [N/m^3], strength [Pa], energy [J/m^2] of what holds the organ in its bed; None
      where it is pinned there
    surroundings: what is around the organ, one of SURROUNDINGS: an abdomen that instruments meet,
      the same without pictures, or nothing
  """

  organ: str = "liver"
  instrument: str = "probe"
  nodes: int = 1000
  variant: int | None = None
  center: str = "right_lobe"
  port: tuple[float, float, float] = (0.03, 0.05, 0.125)
  camera: tuple[float, float, float] = (-0.05, 0.15, 0.12)
  second: str = ""
  second_port: tuple[float, float, float] = (-0.05, 0.0, 0.12)
  optics: float = laparoscope.OPTICS
  guided: str = ""
  guided_port: tuple[float, float, float] = (0.06, 0.05, 0.12)
  targets: int = 1
  inclusion: tuple[float, ...] | None = None
  input: str = "drives"
  bonds: tuple[float, float, float] | None = None
  surroundings: str = "abdomen"

  @property
  def prefixes(self) -> tuple[str, str]:
    """Prefixes of the instruments; "" in place of the second where there is none."""
    names = [self.instrument, self.second] if self.second else [self.instrument]
    first, *other = markup.prefixes(names)
    return first, other[0] if other else ""

  @property
  def handle(self) -> bool:
    """Whether a handle pulls the instruments in place of position drives."""
    return self.input == "handle"


def chosen(scene: Scene, input: str, nodes: int | None, surroundings: str | None) -> Scene:
  """Returns a scene as it was asked for; arguments as of `base.Task`."""
  if surroundings is None:
    surroundings = scene.surroundings
  if surroundings not in SURROUNDINGS:
    choices = ", ".join(SURROUNDINGS)
    raise ValueError(f"surroundings is {surroundings!r}, expected one of {choices}")
  if input not in INPUTS:
    raise ValueError(f"input is {input!r}, expected one of {', '.join(INPUTS)}")
  bent = [name for name in (scene.instrument, scene.second) if name in trocar.WRISTED]
  if bent and input == "handle":
    raise ValueError(f"input is 'handle', which a {bent[0]} has not, expected drives or tip")
  if nodes is None:
    nodes = scene.nodes
  if not (isinstance(nodes, int) and 100 <= nodes <= 20000):
    raise ValueError(f"nodes is {nodes!r}, expected a whole number in [100, 20000], or None")
  return dataclasses.replace(scene, input=input, nodes=nodes, surroundings=surroundings)


@functools.lru_cache(maxsize=32)
def surface(organ: str, nodes: int, variant: int | None) -> tuple[np.ndarray, np.ndarray]:
  """Returns vertices in the world [m] (nvert, 3) and triangles (nelem, 3)."""
  vertices, triangles = getattr(shapes, organ)(nodes, variant)
  vertices = vertices @ _TURN.T
  vertices.flags.writeable = triangles.flags.writeable = False
  return vertices, triangles


@functools.lru_cache(maxsize=32)
def pins(organ: str, nodes: int, variant: int | None, but: str = "") -> tuple[int, ...]:
  """Returns the nodes that do not move, without those of one patch."""
  patches = _patches(organ, nodes, variant)
  found = [patch for name, patch in patches.items() if name != but]
  return tuple(int(i) for i in np.unique(np.concatenate(found)))


@functools.lru_cache(maxsize=32)
def bed(organ: str, nodes: int, variant: int | None) -> tuple[int, ...]:
  """Returns the nodes that lie in the bed and do not belong to another patch."""
  held = pins(organ, nodes, variant, BED)
  return tuple(sorted({int(i) for i in _patches(organ, nodes, variant)[BED]} - set(held)))


def _patches(organ: str, nodes: int, variant: int | None) -> dict[str, np.ndarray]:
  vertices, _ = surface(organ, nodes, variant)
  return shapes.patches(organ, vertices @ _TURN, variant)


@functools.lru_cache(maxsize=32)
def _landmarks(organ: str, variant: int | None) -> dict[str, np.ndarray]:
  return {k: _TURN @ v for k, v in shapes.landmarks(organ, variant).items()}


def landmark(scene: Scene, name: str) -> np.ndarray:
  """Returns the place of one of the organ's landmarks in the world [m]  (3,)."""
  marks = _landmarks(scene.organ, scene.variant)
  if name not in marks:
    raise ValueError(f"organ {scene.organ!r} has no landmark {name!r}, it has {', '.join(marks)}")
  return marks[name]


def films(model: mujoco.MjModel, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns which bonds have a film, and the sites that draw it."""
  names = [model.site(k).name for k in range(model.nsite)]
  found = [(k, f"{BED}{vertex}") for k, vertex in enumerate(vertices)]
  pairs = [(k, names.index(name)) for k, name in found if name in names]
  which, sites = np.array(pairs, int).reshape(-1, 2).T
  return which, sites


def build(scene: Scene) -> mujoco.MjSpec:
  """Returns the scene, ready to be changed and compiled."""
  return _build(scene).copy()


@functools.lru_cache(maxsize=8)
def _build(scene: Scene) -> mujoco.MjSpec:
  if scene.organ not in TISSUES:
    raise ValueError(f"organ is {scene.organ!r}, expected one of {', '.join(TISSUES)}")
  tissue = TISSUES[scene.organ]
  vertices, triangles = surface(scene.organ, scene.nodes, scene.variant)
  young = np.array([tissue.young])
  if scene.inclusion is not None:
    *place, radius, factor = scene.inclusion
    young = shapes.inclusion_young(
      vertices, triangles, np.array(place), radius, tissue.young, factor * tissue.young
    )
  center = landmark(scene, scene.center)
  shape, config = (scene.organ, scene.nodes, scene.variant), tissue.keys()
  config = config | {"young": young, "device": "cpu", "tolerance": TOLERANCE}
  if scene.bonds is not None:
    law, grown = mjcf.numbers(scene.bonds), " ".join(map(str, bed(*shape)))
    config |= {"bonds": f"{BED} {law} at {grown}", "foundation": _LOOSE}
  flex = mjcf.flexcomp(
    ORGAN, (vertices, triangles),
    config=config, contact=CONTACT, pin=pins(*shape, BED if scene.bonds else ""), digits=7,
    mass=tissue.mass, radius=0.001, rgba=catalog.entry(scene.organ).rgba,
  )  # fmt: skip
  spec = furnish(scene, flex, center)
  if scene.inclusion is not None:
    spec.option.gravity = np.zeros(3)
  # What it has grown on to is in its place.
  held = situs.Arrangement() if scene.bonds else situs.ARRANGEMENTS[scene.organ]
  if scene.surroundings == "abdomen":
    uv = scenery.texcoord(scene.organ, vertices @ _TURN, triangles)
    view = center + scene.camera, center
    eye = f"{laparoscope.NAME}/eye" if scene.instrument == laparoscope.NAME else ""
    situs.surround(spec, ORGAN, scene.organ, uv, view, arrangement=held, eye=eye)
    flat, outward = mujoco.mjtGeom.mjGEOM_ELLIPSOID, vertex_normals(vertices, triangles)
    for node in bed(*shape) if scene.bonds else ():
      turn = trocar.aim(np.zeros(3), outward[node])
      spec.worldbody.add_site(
        name=f"{BED}{node}", type=flat, pos=vertices[node], quat=turn, size=_FILM
      )
  if scene.surroundings != "none":
    situs.obstruct(spec, [n for n in situs.NAMES if n != scene.organ], scene.organ, held)
  if scene.guided:
    _guide(spec, scene, center)
  return spec


def _guide(spec: mujoco.MjSpec, scene: Scene, center: np.ndarray) -> None:
  """Adds the instrument that the exercise itself moves."""
  port = center + scene.guided_port
  trocar.attach(spec, scene.guided, GUIDED, port, trocar.aim(port, center))
  for geom in spec.geoms:
    if geom.parent.name.startswith(GUIDED):
      geom.contype = geom.conaffinity = 0


def furnish(
  scene: Scene, organ: str, center: np.ndarray, bed: str = "", slots: int | None = None
) -> mujoco.MjSpec:
  """Returns an organ with instrument, camera, light and targets around it.

  Args:
    scene: instrument, ports and number of targets
    organ: flexcomp of the organ
    center: what port and camera are from [m]  (3,)
    bed: what is in the body that the organ is bonded to
    slots: of the organ's window; None for what experts touch, 0 for no window: what has no geoms,
      such as a thread, meets it everywhere
  """
  spec = mujoco.MjSpec.from_string(_xml(organ, center, scene, bed))
  hands = (scene.instrument, scene.port), (scene.second, scene.second_port)
  for (name, offset), prefix in zip(hands, scene.prefixes, strict=True):
    port = center + offset
    if name == laparoscope.NAME:
      _look(spec, scene, center)
    elif name:
      trocar.attach(spec, name, prefix, port, trocar.aim(port, center), scene.handle)
  for geom in spec.geoms:
    if geom.parent.name.endswith("handle"):
      geom.group = _UNSEEN  # it would hide the tip
  if slots is None:
    touched = sum(_SLOTS[name] for name in (scene.instrument, scene.second) if name)
    slots = touched * max(1, -(-scene.nodes // 1000))
  if slots:
    palpate.add_windows(spec, ORGAN, nodes=slots)
  return spec


def _look(spec: mujoco.MjSpec, scene: Scene, center: np.ndarray) -> None:
  """Puts the camera on a laparoscope, whose picture is level where its joints are zero."""
  prefix = f"{laparoscope.NAME}/"
  back = np.asarray(scene.port) / np.linalg.norm(scene.port)
  quat = trocar.orientation(laparoscope.upright(back))
  trocar.attach(spec, laparoscope.NAME, prefix, center + scene.port, quat, scene.handle)
  spec.body(f"{prefix}eye").quat = laparoscope.turned(scene.optics)
  spec.camera(f"{prefix}camera").name = CAMERA


def _xml(flex: str, center: np.ndarray, scene: Scene, bed: str) -> str:
  def numbers(values) -> str:
    return mjcf.numbers(values, digits=7)

  camera = center + scene.camera
  back = np.asarray(scene.camera) / np.linalg.norm(scene.camera)
  axes = numbers(laparoscope.upright(back).T[:2].ravel())
  fixed = scene.instrument != laparoscope.NAME
  lens = f'<camera name="{CAMERA}" pos="{numbers(camera)}" fovy="50" xyaxes="{axes}"/>' * fixed
  sites = "".join(
    f'<site name="target{i}" size="0.003" rgba="0.2 0.75 0.95 0.9"/>' for i in range(scene.targets)
  )
  return f"""
<mujoco model="exercise">
  <compiler autolimits="true"/>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic"
    impratio="{_IMPRATIO[scene.instrument]}"/>
  {mjcf.extension()}
  <visual>
    <global offwidth="1280" offheight="960"/>
    <headlight ambient="0.3 0.3 0.3" diffuse="0.6 0.6 0.6"/>
    <map znear="0.005" zfar="5"/>
  </visual>
  <statistic center="{numbers(center)}" extent="0.2"/>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.25 0.12 0.12" rgb2="0.05 0.02 0.02"
      width="64" height="64"/>
  </asset>
  <worldbody>
    <light pos="{numbers(camera + np.array([0, 0, 0.05]))}" dir="{numbers(-back)}"
      castshadow="false"/>
    {lens}
    {sites}
    <body name="{BED}">{bed}</body>
    {flex}
  </worldbody>
</mujoco>"""
