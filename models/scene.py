# mujoco ships its bindings without type stubs:
# pyright: reportAttributeAccessIssue=false
"""Models to load: an organ alone, or a scene of organ, instruments, light and laparoscope.

The files under `models/<organ>/` are what this module writes at the default resolution; other
resolutions, variants and instruments are made when they are asked for.
"""

import functools
import pathlib
from collections.abc import Sequence

import mujoco
import numpy as np
from palpate import windows as author

from . import catalog, quality, shapes, trocar
from .catalog import DEFAULT, GRIDS, RESOLUTIONS, Entry, Port

INSTRUMENTS = trocar.NAMES
COUPLINGS = ("nodal", "window")
_ROOT = pathlib.Path(__file__).parent


class Body:
  """An organ's mesh and where it is held and named, in the organ's frame.

  Attributes:
    entry: of the catalogue
    vertices: nodes [m], rounded as the files have them  (n, 3)
    triangles: winding outward                           (m, 3)
    patches: pinned nodes  name -> indices
    landmarks: places on the surface [m]  name -> (3,)
  """

  def __init__(self, entry: Entry, nodes: int, grid: int, seed: int | None):
    self.entry = entry
    if grid:
      vertices, self.triangles = shapes.grid(entry.shape, grid, seed)
    else:
      vertices, self.triangles = shapes.mesh(shapes.organ(entry.shape, seed), nodes)
    self.vertices = np.round(vertices, 6) + 0.0
    self.patches = shapes.patches(entry.shape, self.vertices, seed)
    self.landmarks = shapes.landmarks(entry.shape, seed)

  @property
  def pins(self) -> np.ndarray:
    """Pinned nodes, sorted."""
    return np.unique(np.concatenate(list(self.patches.values())))

  @property
  def volume(self) -> float:
    """Enclosed volume [m^3]."""
    a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

  @property
  def area(self) -> float:
    """Surface [m^2]."""
    return float(np.linalg.norm(quality.normals(self.vertices, self.triangles), axis=1).sum() / 2)

  @property
  def mass(self) -> float:
    """Mass of the whole organ [kg]."""
    return self.entry.density * self.volume

  def young(self) -> list[float]:
    """Young's modulus [Pa], one value or one a triangle."""
    entry = self.entry
    if entry.inclusion is None:
      return [entry.young]
    values = shapes.inclusion_young(
      self.vertices,
      self.triangles,
      self.landmarks[entry.inclusion.landmark],
      entry.inclusion.radius,
      entry.young,
      entry.inclusion.young,
    )
    return [float(v) for v in np.round(values)]


@functools.lru_cache(maxsize=8)
def body(name: str, nodes: int = DEFAULT, grid: int = 0, seed: int | None = None) -> Body:
  """Returns the mesh of an organ of the catalogue; do not change it."""
  return Body(catalog.entry(name), nodes, grid, seed)


def path(name: str, scene: bool = True) -> pathlib.Path:
  """Returns the MJCF file of a scene, or of the organ alone, at the default resolution."""
  catalog.entry(name)
  folder = _ROOT / ("liver" if name == "liver_inclusion" else name)
  if scene:
    return folder / ("scene_inclusion.xml" if name == "liver_inclusion" else "scene.xml")
  return folder / f"{name}.xml"


def load(
  name: str,
  nodes: int = DEFAULT,
  seed: int | None = None,
  instruments: Sequence[str] = ("probe", "grasper"),
  handle: bool = False,
  grid: int | None = None,
  coupling: str = "nodal",
) -> mujoco.MjSpec:
  """Returns a scene: the organ, instruments, light, laparoscope, targets and keyframes.

  Args:
    name: organ, one of `NAMES`
    nodes: resolution, one of `RESOLUTIONS`
    seed: a number for a variant of the shape, None for the mean shape
    instruments: of `INSTRUMENTS`, at most two: the right hand's first
    handle: whether mocap handles pull the instruments in place of position actuators
    grid: a regular sheet of grid x grid nodes in place of `nodes`, one of `GRIDS`
    coupling: `nodal`, or `window` where MuJoCo knows the nodes near the instruments alone
  """
  shape = _body(name, nodes, seed, grid)
  _check_instruments(instruments)
  spec = mujoco.MjSpec.from_string(scene_xml(shape, name, instruments, handle, False, False))
  spec.attach(_organ(shape, name, coupling), prefix=f"{name}/", frame=spec.frame(name))
  free = None
  if coupling == "window":
    window = author.add_windows(spec, f"{name}/{name}")[0]
    free = 3 * len(spec.flex(window).vertbody)
    spec.memory = _megabytes(free // 3) << 20
  for key, (qpos, ctrl, mocap) in keyframes(shape, instruments, handle, free).items():
    spec.add_key(name=key, qpos=qpos, ctrl=ctrl, mpos=mocap)
  return spec


def organ(
  name: str,
  nodes: int = DEFAULT,
  seed: int | None = None,
  grid: int | None = None,
  coupling: str = "nodal",
) -> mujoco.MjSpec:
  """Returns the organ alone, to attach to a scene of your own; arguments as for `load`.

  With `coupling="window"` its window is sized for one 5 mm instrument;
  `palpate.add_windows(spec, name)` of the scene's own nodal organ sizes it for the tools there.
  """
  spec = _organ(_body(name, nodes, seed, grid), name, coupling)
  if coupling == "window":
    author.add_windows(spec, name)
  return spec


def _organ(shape: Body, name: str, coupling: str) -> mujoco.MjSpec:
  if coupling not in COUPLINGS:
    raise ValueError(f"organ {name!r}: coupling is {coupling!r}, expected nodal or window")
  return mujoco.MjSpec.from_string(organ_xml(shape, name, None, coupling == "window"))


def targets(name: str) -> tuple[str, ...]:
  """Returns the places on an organ that have names; their sites are `<name>_<place>`."""
  return tuple(shapes.organ(catalog.entry(name).shape).landmarks)


def _body(name: str, nodes: int, seed: int | None, grid: int | None) -> Body:
  catalog.entry(name)
  if nodes not in RESOLUTIONS:
    choices = ", ".join(map(str, RESOLUTIONS))
    raise ValueError(f"organ {name!r}: nodes is {nodes!r}, expected one of {choices}")
  if grid is not None and grid not in GRIDS:
    choices = ", ".join(map(str, GRIDS))
    raise ValueError(f"organ {name!r}: grid is {grid!r}, expected one of {choices}, or None")
  if seed is not None and not 0 <= seed < 2**32:
    raise ValueError(f"organ {name!r}: seed is {seed!r}, expected a number in [0, 2^32), or None")
  return body(name, 0 if grid else nodes, grid or 0, seed)


def _check_instruments(instruments: Sequence[str]):
  if isinstance(instruments, str):
    raise ValueError(f"instruments is {instruments!r}, expected a tuple such as ({instruments!r},)")
  for instrument in instruments:
    if instrument not in INSTRUMENTS:
      choices = ", ".join(INSTRUMENTS)
      raise ValueError(f"instrument is {instrument!r}, expected one of {choices}")
  if len(instruments) > 2:
    raise ValueError(f"instruments has {len(instruments)} names, expected at most two")


def numbers(values, digits: int = 6) -> str:
  """Returns numbers as MJCF has them."""
  return " ".join(f"{v + 0.0:.{digits}g}" for v in np.ravel(values).round(digits))


def obj(shape: Body) -> str:
  """Returns the mesh as an OBJ file."""
  lines = [f"v {x + 0.0:.6f} {y + 0.0:.6f} {z + 0.0:.6f}" for x, y, z in shape.vertices]
  lines += [f"f {a} {b} {c}" for a, b, c in shape.triangles + 1]
  return "\n".join(lines) + "\n"


def organ_xml(shape: Body, name: str, file: str | None, rigid: bool = False) -> str:
  """Returns the organ alone as MJCF.

  Args:
    shape: its mesh
    name: its name
    file: the mesh under assets/; None has it in the text
    rigid: whether it is declared to be given windows, in place of dofs for the nodes
  """
  entry = shape.entry
  if file is None:
    points, elements = numbers(shape.vertices), " ".join(map(str, shape.triangles.ravel()))
    mesh = f'type="direct" point="{points}" element="{elements}"'
  else:
    mesh = f'type="mesh" file="assets/{file}"'
  pins = "".join(
    f'        <pin id="{" ".join(map(str, index))}"/>  <!-- {patch} -->\n'
    for patch, index in shape.patches.items()
  )
  config = {
    "young": " ".join(f"{v:g}" for v in shape.young()),
    "poisson": f"{entry.poisson:g}",
    "thickness": f"{entry.thickness:g}",
    "foundation": f"{entry.foundation:g}",
    "bulk": f"{entry.bulk:g}",
    "damping": f"{entry.damping:g}",
  }
  if rigid:
    config |= {"mass": f"{shape.mass:.4g}", "pin": " ".join(map(str, shape.pins))}
  keys = "".join(f'          <config key="{k}" value="{v}"/>\n' for k, v in config.items())
  contact = (
    '        <contact condim="3" friction="0.3" solref="0.004 1" solimp="0.95 0.99 0.001" '
    'solmix="1000"\n          selfcollide="none"/>\n'
  )
  declared, owned, how = '<plugin plugin="palpate.organ"/>', "", f'mass="{shape.mass:.4g}"'
  plugin = f'        <plugin plugin="palpate.organ">\n{keys}        </plugin>\n'
  plugin += '        <edge damping="1e-9"/>\n'
  if rigid:
    declared = f'<plugin plugin="palpate.organ"><instance name="{name}">{keys}</instance></plugin>'
    owned, how = f'      <plugin plugin="palpate.organ" instance="{name}"/>\n', 'rigid="true"'
    plugin, pins = "", ""
  sites = "".join(
    f'      <site name="{name}_{mark}" class="{name}_target" pos="{numbers(pos)}"/>\n'
    for mark, pos in shape.landmarks.items()
  )
  return f"""<mujoco model="{name}">
  <!-- {entry.title}. x to the patient's right, y anterior, z superior. -->
  <extension>
    {declared}
  </extension>

  <default>
    <default class="{name}_target">
      <site type="sphere" size="0.002" group="3" rgba="0.2 0.75 0.35 1"/>
    </default>
  </default>

  <asset>
    <material name="{name}" rgba="{numbers(entry.rgba)}" specular="{entry.specular:g}"
      shininess="{entry.shininess:g}"/>
  </asset>

  <worldbody>
    <body name="{name}">
{owned}      <flexcomp name="{name}" {mesh} dim="2" {how} radius="0.001"
        material="{name}" flatskin="false">
{plugin}{contact}{pins}      </flexcomp>
{sites}    </body>
  </worldbody>
</mujoco>
"""


def _megabytes(nodes: int) -> int:
  """Returns memory for a scene: MuJoCo's broad phase takes 4 bytes for every pair of bodies."""
  return 64 + (5 * nodes * nodes // 2) // 10**6 // 32 * 32


def _look(pos, target) -> str:
  """Returns the xyaxes of a camera at `pos` that looks at `target`, z up."""
  forward = np.subtract(target, pos)
  forward = forward / np.linalg.norm(forward)
  right = np.cross(forward, [0, 0, 1])
  right /= np.linalg.norm(right)
  return numbers([*right, *np.cross(right, forward)], 5)


def scene_xml(
  shape: Body,
  name: str,
  instruments: Sequence[str],
  handle: bool = False,
  relative: bool = True,
  file: bool = True,
) -> str:
  """Returns the scene as MJCF.

  Args:
    shape: the organ
    name: its name
    instruments: at most two
    handle: whether mocap handles drive them
    relative: whether paths are from the organ's folder, or absolute
    file: whether organ and keyframes are in it, or an empty frame to attach the organ to
  """
  entry = shape.entry
  root = "../instruments" if relative else str(_ROOT / "instruments")
  suffix = "_handle" if handle else ""
  prefixes = _prefixes(instruments)
  files = sorted(set(instruments))
  models, attach, keys = "", "", ""
  if file:
    models = f'    <model name="{name}" file="{name}.xml"/>\n'
    attach = f'<attach model="{name}" prefix="{name}/"/>'
    keys = _keys_xml(keyframes(shape, instruments, handle))
  models += "".join(f'    <model name="{i}" file="{root}/{i}{suffix}.xml"/>\n' for i in files)
  frames = ""
  for instrument, prefix, port in zip(instruments, prefixes, entry.ports, strict=False):
    pos, quat = _place(shape, port)
    frames += (
      f'    <frame pos="{numbers(pos)}" quat="{numbers(quat)}">\n'
      f'      <attach model="{instrument}" prefix="{prefix}"/>\n    </frame>\n'
    )
  behind, backdrop = "", ""
  if entry.backdrop is not None:
    other, pos = entry.backdrop
    folder = f"../{other}" if relative else str(_ROOT / other)
    behind = (
      f'    <mesh name="{other}" file="{folder}/assets/{other}.obj" smoothnormal="true"/>\n'
      f'    <material name="{other}" rgba="{numbers(catalog.entry(other).rgba)}" specular="0.3"\n'
      f'      shininess="0.5"/>\n'
    )
    backdrop = (
      f'<geom name="{other}" type="mesh" mesh="{other}" material="{other}" pos="{numbers(pos)}"\n'
      f'      contype="0" conaffinity="0" group="2"/>\n      '
    )
  size = float(np.ptp(shape.vertices, axis=0).max())
  overview = np.array([0.9, 1.3, 1.1]) * size
  side = np.array([1.9, 0.15, 0.25]) * size
  forward = np.subtract(entry.target, entry.camera)
  return f"""<mujoco model="{name}_scene">
  <!-- {entry.title}, seen through a laparoscope.
       x to the patient's right, z anterior (up), -y superior. -->
  <compiler autolimits="true"/>
  <!-- The shape is the one in situ, where support and weight balance: no gravity. -->
  <option timestep="0.001" gravity="0 0 0" integrator="implicitfast" cone="elliptic"
    iterations="50"/>
  <size memory="{_megabytes(len(shape.vertices))}M"/>
  <statistic center="0 0 0" extent="{size:.3g}"/>

  <visual>
    <global offwidth="1280" offheight="960" azimuth="120" elevation="-25"/>
    <headlight ambient="0.22 0.2 0.2" diffuse="0.15 0.14 0.14" specular="0 0 0"/>
    <map znear="0.01" zfar="30"/>
    <rgba haze="0.16 0.07 0.06 1"/>
  </visual>

  <asset>
{models}    <texture name="cavity" type="skybox" builtin="gradient" rgb1="0.42 0.19 0.16"
      rgb2="0.10 0.03 0.03" width="128" height="128"/>
{behind}  </asset>

  <worldbody>
    <light name="laparoscope" pos="{numbers(entry.camera)}" dir="{numbers(forward)}" cutoff="50"
      exponent="8" diffuse="0.85 0.82 0.78" specular="0.6 0.6 0.6" castshadow="false"/>
    <light name="fill" directional="true" dir="0.3 -0.2 -1" diffuse="0.18 0.16 0.16"
      specular="0 0 0" castshadow="false"/>
    <camera name="laparoscope" pos="{numbers(entry.camera)}" fovy="60"
      xyaxes="{_look(entry.camera, entry.target)}"/>
    <camera name="overview" pos="{numbers(overview)}" fovy="45"
      xyaxes="{_look(overview, [0, 0, 0.1 * size])}"/>
    <camera name="side" pos="{numbers(side)}" fovy="45" xyaxes="{_look(side, [0, 0, 0])}"/>
{frames}    <frame name="{name}" quat="{numbers(catalog.SUPINE_QUAT)}">{backdrop}{attach}</frame>
  </worldbody>
{keys}</mujoco>
"""


def _prefixes(instruments: Sequence[str]) -> list[str]:
  if len(instruments) == 2 and instruments[0] == instruments[1]:
    return [f"right_{instruments[0]}/", f"left_{instruments[1]}/"]
  return [f"{instrument}/" for instrument in instruments]


def _place(shape: Body, port: Port) -> tuple[np.ndarray, np.ndarray]:
  """Returns position and orientation of an instrument's frame, rounded as the files have them."""
  away = np.array(port.away) / np.linalg.norm(port.away)
  landmark = catalog.to_world(shape.landmarks[port.landmark])
  pos = np.round(landmark + away * (trocar.DEPTH + port.gap), 3)
  return pos, np.round(trocar.aim(pos, landmark), 6)


def keyframes(
  shape: Body, instruments: Sequence[str], handle: bool, free: int | None = None
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
  """Returns qpos, ctrl and mocap positions of every keyframe by name.

  `home` has every joint at zero; `touch` the tips 5 mm off the places they point at, grasper and
  scissors 8 mm and open; `press` is `touch` with controls that take the first instrument 10 mm
  deep. The dofs of the instruments come first, so that their addresses do not depend on the
  organ's resolution; `free` are those of the organ, unless its nodes are.
  """
  if free is None:
    free = 3 * (len(shape.vertices) - len(shape.pins))
  keys = {}
  for key in ("home", "touch", "press"):
    qpos, ctrl, mocap = [], [], []
    for i, (instrument, port) in enumerate(zip(instruments, shape.entry.ports, strict=False)):
      jaws = instrument in ("grasper", "scissors")
      near = 0.0 if key == "home" else port.gap - (0.008 if jaws else 0.005)
      deep = port.gap + 0.01 if key == "press" and i == 0 else near
      opening = 0.7 if jaws and key != "home" else 0.0
      qpos += [0, 0, near, 0] + [opening / 2] * 2 * jaws
      ctrl += [0, 0, 0, 0] if handle else [0, 0, deep, 0]
      ctrl += [opening] * jaws
      pos, quat = _place(shape, port)
      shaft = np.zeros(3)
      mujoco.mju_rotVecQuat(shaft, np.array([0.0, 0.0, -1.0]), quat)
      mocap += list(pos + shaft * (trocar.DEPTH + deep)) if handle else []
    keys[key] = np.array(qpos + [0] * free), np.array(ctrl), np.array(mocap)
  return keys


def _keys_xml(keys: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> str:
  lines = ""
  for key, values in keys.items():
    given = zip(("qpos", "ctrl", "mpos"), values, strict=True)
    text = " ".join(f'{field}="{numbers(value)}"' for field, value in given if len(value))
    lines += f'    <key name="{key}" {text}/>\n'
  return f"\n  <keyframe>\n{lines}  </keyframe>\n"
