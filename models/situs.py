"""One abdomen: any of its organs soft, the others scenery, lit by an endoscope.

`furnish` draws scenery, which then has no contacts and no dofs; `obstruct` lets instruments meet
it. World: that of the catalogue's scenes, the liver's frame turned so that anterior is up and
superior is -y.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from palpate import skins
from palpate import windows as author

from . import catalog, laparoscope, markup, organs, scene, scenery, texture, trocar
from .scenery import Surface

NAMES = ("liver", "gallbladder", "stomach")  # organs, in the order they are drawn
CAMERA, LIGHT = "laparoscope", "endoscope"
SURROUNDINGS = "surroundings"  # body of what instruments meet there
GROUP = 2  # of the scenery
_LEVELS = {"liver": 1, "gallbladder": 0, "stomach": 1}  # of the smooth surfaces of scenery
# By eye after photographs of operations; a texture takes 14 % off.
COLOURS = {
  "liver": (0.62, 0.22, 0.17, 1.0),
  "gallbladder": (0.60, 0.65, 0.46, 1.0),
  "stomach": (0.86, 0.60, 0.53, 1.0),
  "kidney": (0.62, 0.27, 0.23, 1.0),
  "fat": (0.95, 0.77, 0.43, 1.0),
  "wall": (0.92, 0.56, 0.47, 1.0),
}
# Specular share of wet surfaces; by eye. Much of it turns yellow and pink ones green.
_SHEEN = {"fat": 0.12, "wall": 0.15, "stomach": 0.3, "gallbladder": 0.4}
# What the fixed renderer's light loses on its way, 1 at 15 cm: 0.55 + 0.45 (d / 15 cm)^2.
_FADE = (0.55, 0.0, 0.45 / 0.15**2)
# What instruments meet: number of balls in an organ, the shell of the wall, and the bits of organs
# and fat and of the wall. Contact is a spring of about 200 N/m to a tip of 0.2 kg: an impedance of
# 0.01 lets a hundredth of the drive through to it, and its stiffness is mass / (0.01 t^2).
_BALLS = {"liver": 20, "stomach": 10, "gallbladder": 6, "fat": 16}
_WALL = ((-0.01, 0.09, 0.035), (0.175, 0.21, 0.175), 2.4)
_SOFT = {"solref": (0.3, 1.0), "solimp": (0.01, 0.01, 0.001, 0.5, 2.0), "condim": 1, "priority": 1}
_INSIDE, _WITHIN, _HIDDEN = 2, 4, 4  # and the group that nobody draws
_JAW = (0.0025, 0.0215)  # of closed jaws: radius, and from the tip to their pivot [m]
_VIEW = ((0.0, 0.175, 0.135), (0.0, 0.03, 0.005))  # of `abdomen`'s camera: from, to [m]


@dataclasses.dataclass(frozen=True)
class Arrangement:
  """What assistants hold aside so that an organ is seen.

  Attributes:
    lifts: how far other organs are from their places, in the world [m]
    fat: how far the fat is from its place, upward [m]
    without: organs, ducts and fat that would be in the way
  """

  lifts: Mapping[str, tuple[float, float, float]] = dataclasses.field(default_factory=dict)
  fat: float = 0.0
  without: tuple[str, ...] = ()


# By the organ that is worked on; all ours.
ARRANGEMENTS: Mapping[str, Arrangement] = {
  "liver": Arrangement(),
  "gallbladder": Arrangement({"liver": (0.0, -0.012, 0.01)}),
  "stomach": Arrangement(
    {"liver": (0.03, -0.05, 0.03), "gallbladder": (0.03, -0.05, 0.03)},
    fat=-0.02, without=("cystic_duct", "cystic_artery"),
  ),
  "kidney": Arrangement(
    {"liver": (0.0, -0.06, 0.03), "gallbladder": (0.0, -0.06, 0.03)},
    fat=-0.05, without=("stomach", "duodenum", "cystic_duct", "cystic_artery"),
  ),
}  # fmt: skip


def abdomen(
  soft: Mapping[str, int] | Sequence[str] = ("liver", "gallbladder"),
  instruments: Sequence[str] = ("grasper", "probe"),
  handle: bool = False,
  seed: int | None = None,
  look: int = 0,
) -> mujoco.MjSpec:
  """Returns a scene of the whole upper abdomen.

  Args:
    soft: organs of NAMES that are tissue, and their nodes, one of `RESOLUTIONS`; names alone have
      1000. The others are scenery
    instruments: of `INSTRUMENTS`, at most two, the right hand's first
    handle: whether mocap handles pull the instruments in place of position actuators
    seed: of the soft organs' shapes, None for the mean ones
    look: seed of spots and vessels
  """
  if isinstance(soft, str):
    raise ValueError(f"soft is {soft!r}, expected a tuple such as ({soft!r},)")
  nodes = dict(soft) if isinstance(soft, Mapping) else dict.fromkeys(soft, catalog.DEFAULT)
  for name in nodes:
    if name not in NAMES:
      raise ValueError(f"soft has {name!r}, expected some of {', '.join(NAMES)}")
  scene.check_instruments(instruments, handle)
  spec = mujoco.MjSpec.from_string(_BASE)
  for name, count in nodes.items():
    frame = spec.worldbody.add_frame(pos=place(name), quat=catalog.SUPINE_QUAT)
    spec.attach(scene.organ(name, count, seed), prefix=f"{name}/", frame=frame)
  for instrument, prefix, (port, aim) in zip(
    instruments, markup.prefixes(instruments), _PORTS, strict=False
  ):
    trocar.attach(spec, instrument, prefix, np.array(port), trocar.aim(port, aim), handle)
  for name in nodes:
    spec.flex(f"{name}/{name}").contype = 0  # tools meet it, other organs do not
    author.add_windows(spec, f"{name}/{name}")
    cover(spec, f"{name}/{name}", name, look)
  furnish(spec, [name for name in NAMES if name not in nodes], look=look)
  light(spec, *_VIEW)
  return spec


_PORTS = (((0.09, 0.09, 0.15), (0.05, 0.06, 0.03)), ((-0.07, 0.09, 0.15), (-0.01, 0.05, 0.03)))
_BASE = f"""<mujoco model="abdomen">
  <compiler autolimits="true"/>
  <option timestep="0.001" gravity="0 0 0" integrator="implicitfast" cone="elliptic"/>
  <size memory="128M"/>
  <statistic center="0 0.04 0" extent="0.3"/>
  <visual><global offwidth="1280" offheight="960"/><map znear="0.01" zfar="10"/></visual>
  <worldbody>
    <camera name="{CAMERA}" pos="{markup.numbers(_VIEW[0])}" fovy="62"
      xyaxes="{markup.look(*_VIEW)}"/>
  </worldbody>
</mujoco>"""


def place(name: str, of: str = "liver") -> np.ndarray:
  """Returns where an organ is from another one, in the world [m]  (3,)."""
  here, there = (np.array(catalog.PLACES[each][0]) for each in (name, of))
  return catalog.to_world(here - there)


def cover(spec: mujoco.MjSpec, organ: str, kind: str, look: int = 0, uv=None) -> str:
  """Gives an organ of a spec a skin with the look of its kind; returns the skin's name.

  Args:
    spec: changed in place
    organ: name of the flexcomp
    kind: of the catalogue
    look: seed of spots and vessels
    uv: texture coordinates of its vertices (n, 2); None makes them
  """
  material = paint(spec, kind, look)
  flex = spec.flex(organ)
  if uv is None:
    uv = scenery.texcoord(kind, np.reshape(flex.vert, (-1, 3)), np.reshape(flex.elem, (-1, 3)))
  return skins.add_skin(spec, organ, material=material, texcoord=uv)


def dress(spec: mujoco.MjSpec, organ: str, kind: str, uv: np.ndarray):
  """Gives an organ's own surface the look of a kind; an open one, since skins have one side.

  Args:
    spec: changed in place
    organ: name of the flexcomp
    kind: of COLOURS
    uv: texture coordinates of its vertices  (n, 2)
  """
  flex = spec.flex(organ)
  flex.material = _material(spec, organ, COLOURS[kind], kind, look=0)  # its colour is its own
  flex.rgba = [0.5, 0.5, 0.5, 1.0]
  flex.texcoord, flex.elemtexcoord = np.ravel(uv), flex.elem


def vary(spec: mujoco.MjSpec, organ: str, count: int):
  """Gives an organ's skin and surface further materials, each with a texture of another seed.

  Number k is called as the organ's own material, `_k` behind it; k = 0 is that itself.

  Args:
    spec: changed in place
    organ: name of the flexcomp
    count: of textures
  """
  skins_ = [skin.material for skin in spec.skins if skin.name.startswith(organ)]
  for name in dict.fromkeys([spec.flex(organ).material, *skins_]):
    made = spec.material(name) if name else None
    if made is None:
      continue
    paper = made.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)]
    for k in range(1, count) if paper else ():
      twin = spec.add_material(
        name=f"{name}_{k}", rgba=made.rgba, specular=made.specular, shininess=made.shininess
      )
      _hang(spec, twin, paper.removeprefix("abdomen_"), k, f"{paper}_{k}")
      twin.texrepeat = made.texrepeat


def surround(
  spec: mujoco.MjSpec,
  organ: str,
  kind: str,
  uv: np.ndarray,
  view,
  look: int = 0,
  arrangement: Arrangement | None = None,
  eye: str = "",
):
  """Puts a scene's only organ, which is at the world's origin, into an abdomen.

  Args:
    spec: changed in place
    organ: name of the flexcomp
    kind: of PLACES
    uv: texture coordinates of its vertices  (n, 2)
    view: where the camera is and what it looks at [m]
    look: seed of spots and vessels
    arrangement: what is held aside, None for that of ARRANGEMENTS
    eye: see `light`
  """
  cover(spec, organ, kind, look, uv)
  held = arrangement or ARRANGEMENTS[kind]
  furnish(spec, [name for name in NAMES if name != kind], kind, held, look)
  pos, target = view
  light(spec, pos, target, eye)


def enter(spec: mujoco.MjSpec, name: str, nodes: int, seed: int | None = None, look: int = 0):
  """Puts a scene of `models.load` into an abdomen, lit as its laparoscope's.

  Args:
    spec: changed in place
    name: of the organ, and `nodes` and `seed` of its shape, as it was loaded
    nodes: see `name`
    seed: see `name`
    look: seed of spots and vessels
  """
  build, lamp = organs.build(name, nodes, 0, seed), spec.light(CAMERA)
  kind, pos = build.entry.shape, np.array(lamp.pos)
  if build.entry.backdrop is not None:
    spec.delete(spec.geom(build.entry.backdrop[0]))
  uv = scenery.texcoord(kind, build.vertices, build.triangles)
  surround(spec, f"{name}/{name}", kind, uv, (pos, pos + lamp.dir), look)


def furnish(
  spec: mujoco.MjSpec,
  organs: Sequence[str] = NAMES,
  around: str = "liver",
  arrangement: Arrangement | None = None,
  look: int = 0,
):
  """Adds what is only drawn: organs, ducts, fat and the wall.

  Args:
    spec: changed in place
    organs: which ones
    around: organ whose origin is the world's
    arrangement: what is held aside
    look: seed of spots and vessels
  """
  held = arrangement or Arrangement()
  for name, surface, pos in _placed(organs, around, held):
    draw(spec, name, surface, paint(spec, name, look, 2.0 if name == "fat" else 1.0), pos)
  for name, duct in catalog.DUCTS.items():
    if name in held.without:
      continue
    path = catalog.to_world(np.array(duct.points))
    surface = scenery.tube(path, np.full(len(path), duct.diameter / 2))
    kind = "stomach" if name == "duodenum" else None
    skin = _material(spec, name, duct.rgba, kind, look)
    goes_with = "stomach" if name == "duodenum" else "gallbladder"
    lift = held.lifts.get(goes_with, (0, 0, 0))
    draw(spec, name, surface, skin, np.array(lift) - place(around))


def _placed(
  organs: Sequence[str], around: str, held: Arrangement
) -> Iterator[tuple[str, Surface, np.ndarray]]:
  """Yields organs, fat and the wall: name, surface and where it is; arguments as of `furnish`."""
  origin = place(around)
  for name in organs:
    if name not in held.without:
      yield name, _surface(name), place(name) - origin + held.lifts.get(name, (0, 0, 0))
  if "fat" not in held.without:
    yield "fat", _surface("fat"), [0, 0, held.fat] - origin
  yield "wall", _surface("wall"), -origin


@functools.cache
def _surface(name: str, fine: bool = True) -> Surface:
  """Returns an organ's surface, or that of the fat or the wall, which are ours."""
  if name == "fat":
    return scenery.sheet(_fat, (-0.17, -0.06), (0.15, 0.27), (54, 56) if fine else (36, 36))
  if name == "wall":
    return scenery.shell(*_WALL, (44, 30))
  return scenery.to_world(scenery.organ(name, _LEVELS[name] if fine else 0))


@functools.cache
def _balls(name: str) -> tuple[np.ndarray, np.ndarray]:
  """Returns the balls in the place of an organ or of the fat, see `scenery.balls`."""
  return scenery.balls(_surface(name, fine=False), _BALLS[name])


def obstruct(
  spec: mujoco.MjSpec,
  organs: Sequence[str] = NAMES,
  around: str = "liver",
  arrangement: Arrangement | None = None,
  more: Surface | None = None,
):
  """Lets the instruments of a scene, and nothing else, meet what is around.

  Organs and fat are balls in their inside, the wall is planes around it; shafts, which go through
  the wall, do not meet that. What an instrument exerts there is in `tip_force` and `shaft_force`
  too; `surroundings_tip` and `surroundings_shaft` tell it from what it exerts on tissue.

  Args:
    spec: changed in place, with its instruments
    organs: which ones
    around: organ whose origin is the world's
    arrangement: what is held aside
    more: fat that lies elsewhere
  """
  body, held = spec.worldbody.add_body(name=SURROUNDINGS), arrangement or Arrangement()
  wall = body.add_body()  # planes have no bounds: beside them MuJoCo would try every ball

  def add(on: mujoco.MjsBody, meets: int, **shape: Any) -> None:
    on.add_geom(contype=0, conaffinity=meets, group=_HIDDEN, mass=0, **_SOFT, **shape)

  every = [(_balls(name), pos) for name, _, pos in _placed(organs, around, held) if name in _BALLS]
  if more is not None:
    every.append((scenery.balls(more, _BALLS["fat"]), np.zeros(3)))
  for (centers, radii), pos in every:
    for center, radius in zip(centers + pos, radii, strict=True):
      add(body, _INSIDE, pos=center, size=[radius, 0, 0])
  middle, radii, power = _WALL
  for turn in np.arange(6) * np.pi / 3:
    way = np.array([np.cos(turn), np.sin(turn), 0.0])
    # Of |x/a|^p + |y/b|^p + |z/c|^p = 1 this is how far it goes that way, by Hoelder's inequality.
    far = np.linalg.norm(np.multiply(radii, way), power / (power - 1))
    quat = trocar.aim(np.zeros(3), way)  # z of a plane is out of it
    pos = middle + far * way - place(around)
    add(wall, _WITHIN, type=mujoco.mjtGeom.mjGEOM_PLANE, pos=pos, quat=quat, size=[1, 1, 1])
  for port in spec.bodies:
    if port.name.endswith("/trocar"):
      prefix = port.name.removesuffix("trocar")
      jaws = spec.body(f"{prefix}jaw_left") is not None
      if jaws:  # closed they are a capsule: their many geoms would cost a twelfth of a step
        end = spec.site(f"{prefix}tip")
        low = end.pos[2]
        end.parent.add_geom(
          type=mujoco.mjtGeom.mjGEOM_CAPSULE,
          fromto=[0.0, 0.0, low + _JAW[0], 0.0, 0.0, 0.0 if low else _JAW[1]],
          size=[_JAW[0], 0, 0],
          contype=_INSIDE | _WITHIN,
          conaffinity=0,
          group=_HIDDEN,
          mass=0,
        )
      shaft = spec.geom(f"{prefix}shaft")
      shaft.contype |= _INSIDE
      for geom in [] if jaws else spec.body(f"{prefix}tip").geoms:
        geom.contype |= geom.contype and _INSIDE | _WITHIN
      for name, kind in (("tip", mujoco.mjtObj.mjOBJ_XBODY), ("shaft", mujoco.mjtObj.mjOBJ_GEOM)):
        spec.add_sensor(
          name=f"{prefix}{SURROUNDINGS}_{name}",
          type=mujoco.mjtSensor.mjSENS_CONTACT,
          objtype=kind,
          objname=prefix + name,
          reftype=mujoco.mjtObj.mjOBJ_XBODY,
          refname=SURROUNDINGS,
          intprm=[2, 3, 1],  # the force, of all contacts together
        )


def _fat(x: np.ndarray, y: np.ndarray) -> np.ndarray:
  """Returns the height of the omentum over the bowel [m]; ours, in lumps of 2 to 4 cm.

  It rises to the liver around bile duct, artery and portal vein, the hepatoduodenal ligament, and
  is cleared off cystic duct and artery.
  """
  base = -0.022 - 0.5 * np.maximum(np.abs(x + 0.01) - 0.10, 0) - 0.08 * np.maximum(y - 0.12, 0)
  large, small = scenery.bumps(1, 0.085, 0.012), scenery.bumps(2, 0.036, 0.0035)
  rise = 0.024 * np.exp(-((x + 0.02) ** 2 + (y - 0.034) ** 2) / (2 * 0.013**2))
  clear = 0.02 * np.exp(-((x + 0.002) ** 2 + (y - 0.058) ** 2) / (2 * 0.012**2))
  return base + rise - clear + large(x, y) + small(x, y)


def light(spec: mujoco.MjSpec, pos, target, eye: str = "") -> None:
  """Lights a scene as an endoscope does, and by nothing else: ever less with the distance.

  Args:
    spec: changed in place
    pos: of the lens [m]
    target: what it is exposed for [m]
    eye: body of the camera that the lamp goes with, empty for a camera that stands
  """
  for lamp in list(spec.lights):
    spec.delete(lamp)
  head = spec.visual.headlight
  head.ambient, head.diffuse, head.specular = [0.2] * 3, [0.12] * 3, [0.0] * 3
  forward = np.subtract(target, pos)
  # Beside the lens: what reflects it is not all in the picture's middle.
  beside = np.cross(forward, [0.0, 0.0, 1.0])
  beside *= laparoscope.BESIDE / np.linalg.norm(beside)
  near = min(1.0, np.polyval(_FADE[::-1], np.linalg.norm(forward)))  # exposed for what is near
  body, place = (spec.worldbody, np.asarray(pos) + beside)
  if eye:
    body, place, forward = (
      spec.body(eye),
      np.array([laparoscope.BESIDE, 0.0, 0.0]),
      np.array([0.0, 0.0, -1.0]),
    )
  body.add_light(
    name=LIGHT,
    pos=place,
    dir=forward,
    type=mujoco.mjtLightType.mjLIGHT_SPOT,
    cutoff=70,
    exponent=2,
    attenuation=_FADE,
    ambient=near * np.array([0.05, 0.045, 0.045]),
    diffuse=near * np.array([0.92, 0.89, 0.85]),
    specular=near * np.array([0.7, 0.7, 0.7]),
    castshadow=False,
  )


def paint(spec: mujoco.MjSpec, kind: str, look: int = 0, repeat: float = 1.0) -> str:
  """Returns the name of the material of a kind of COLOURS, made unless the spec has it."""
  return _material(spec, kind, COLOURS[kind], kind, look, repeat)


def _material(spec, name: str, rgba, kind: str | None, look: int, repeat: float = 1.0) -> str:
  """Returns the name of the material of a tissue, made unless the spec has it."""
  name = f"abdomen_{name}"
  if spec.material(name) is not None:
    return name
  made = spec.add_material(
    name=name, rgba=rgba, specular=_SHEEN.get(kind or "", 0.5), shininess=0.75
  )
  made.texrepeat = [repeat, repeat]
  if kind is not None:
    _hang(spec, made, kind, look, f"abdomen_{kind}")
  return name


def _hang(spec: mujoco.MjSpec, material: mujoco.MjsMaterial, kind: str, look: int, name: str):
  """Gives a material a texture, made unless the spec has it."""
  if spec.texture(name) is None:
    pixels = texture.texture(kind, look)
    spec.add_texture(
      name=name,
      type=mujoco.mjtTexture.mjTEXTURE_2D,
      width=pixels.shape[1],
      height=pixels.shape[0],
      nchannel=3,
      data=pixels.ravel(),
    )
  roles = list(material.textures)
  roles[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
  material.textures = roles


def draw(spec: mujoco.MjSpec, name: str, surface: Surface, material: str, pos=(0, 0, 0)) -> None:
  """Adds a surface to the world: a skin, which no contact, ray or state knows of."""
  count = len(surface.vertices)
  skin = spec.add_skin(
    name=f"abdomen_{name}",
    vert=(surface.vertices + pos).ravel(),
    face=surface.triangles.ravel(),
    texcoord=surface.texcoord.ravel(),
    material=material,
    bodyname=["world"],
    bindpos=[0.0, 0.0, 0.0],
    bindquat=[1.0, 0.0, 0.0, 0.0],
    group=GROUP,
  )
  skin.vertid, skin.vertweight = [np.arange(count)], [np.ones(count)]
