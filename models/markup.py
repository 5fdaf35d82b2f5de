"""The MJCF of organs and of the catalogue's scenes."""

import pathlib
import textwrap
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from . import catalog, mjcf, trocar
from .catalog import Port
from .organs import Build

ROOT = pathlib.Path(__file__).parent
RADIUS = 0.001  # of an organ's flex [m]
_CAVITY = """<texture name="cavity" type="skybox" builtin="gradient" rgb1="0.42 0.19 0.16"
  rgb2="0.10 0.03 0.03" width="128" height="128"/>"""


def numbers(values, digits: int = 6) -> str:
  """Returns numbers as the files have them: to the micrometre."""
  return mjcf.numbers(np.round(np.ravel(values), digits), digits)


def organ(
  name: str,
  title: str,
  mesh: mjcf.Mesh | str,
  mass: float,
  config: Mapping,
  *,
  rgba: Sequence[float],
  specular: float = 0.5,
  shininess: float = 0.6,
  pin: Mapping[str, np.ndarray] | None = None,
  sites: Mapping[str, np.ndarray] | None = None,
  rigid: bool = False,
) -> str:
  """Returns an organ alone as MJCF.

  Args:
    name: of model, body, flex and material
    title: what it is, for the head of the file
    mesh: vertices [m] and triangles, or the path of a mesh file
    mass: [kg]
    config: the plugin's keys
    rgba: colour
    specular: of the wet surface
    shininess: of the wet surface
    pin: nodes that do not move, by where they are
    sites: named places on the surface [m]
    rigid: whether it is declared to be given windows, in place of dofs for the nodes
  """
  extension, flex = _flex(name, mesh, f"{mass:.4g}", config, pin or {}, rigid)
  marks = [
    f'<site name="{name}_{mark}" class="{name}_target" pos="{numbers(pos)}"/>'
    for mark, pos in (sites or {}).items()
  ]
  skin = {"name": name, "rgba": rgba, "specular": specular, "shininess": shininess}
  target = f"""
  <default>
    <default class="{name}_target">
      <site type="sphere" size="0.002" group="3" rgba="0.2 0.75 0.35 1"/>
    </default>
  </default>
"""
  body = textwrap.indent("\n".join([flex, *marks]), "      ")
  return f"""<mujoco model="{name}">
  <!-- {title} -->
{textwrap.indent(extension, "  ")}
{target if marks else ""}
  <asset>
    {mjcf.tag("material", skin)}
  </asset>

  <worldbody>
    <body name="{name}">
{body}
    </body>
  </worldbody>
</mujoco>
"""


def _flex(
  name: str,
  mesh: mjcf.Mesh | str,
  mass: str,
  config: Mapping,
  pin: Mapping[str, np.ndarray],
  rigid: bool,
) -> tuple[str, str]:
  """Returns extension and flexcomp of an organ."""
  look = {"radius": RADIUS, "material": name, "flatskin": False}
  if not rigid:
    flex = mjcf.flexcomp(
      name, mesh, config=config, contact=mjcf.CONTACT, pin=pin, digits=6, mass=mass, **look
    )
    return mjcf.extension(), flex
  pins = np.unique(np.concatenate([*pin.values(), []]).astype(int))
  flex = mjcf.flexcomp(name, mesh, contact=mjcf.CONTACT, digits=6, rigid=True, **look)
  extension = mjcf.extension({name: {**config, "mass": mass, "pin": pins}}, digits=6)
  return extension, f"{mjcf.plugin(instance=name)}\n{flex}"


def catalogued(
  build: Build, name: str, file: str | None, rigid: bool = False, solid: bool = False
) -> str:
  """Returns an organ of the catalogue as MJCF.

  Args:
    build: its mesh
    name: its name
    file: the mesh under assets/; None has it in the text
    rigid: as in `organ`
    solid: whether it is made of tetrahedra in place of a skin
  """
  entry = build.entry
  config: dict = entry.tissue.keys(solid) | {"young": build.young()}
  if solid:
    config["elements"] = "solid"
  return organ(
    name,
    f"{entry.title}. x to the patient's right, y anterior, z superior.",
    (build.vertices, build.triangles) if file is None else f"assets/{file}",
    build.mass,
    config,
    rgba=entry.rgba,
    specular=entry.specular,
    shininess=entry.shininess,
    pin=build.patches,
    sites=build.landmarks,
    rigid=rigid,
  )


def megabytes(nodes: int) -> int:
  """Returns memory for a scene: MuJoCo's broad phase takes 4 bytes for every pair of bodies."""
  return 64 + (5 * nodes * nodes // 2) // 10**6 // 32 * 32


def look(pos, target) -> str:
  """Returns the xyaxes of a camera at `pos` that looks at `target`, z up."""
  forward = np.subtract(target, pos)
  forward = forward / np.linalg.norm(forward)
  right = np.cross(forward, [0, 0, 1])
  right /= np.linalg.norm(right)
  return numbers([*right, *np.cross(right, forward)], 5)


def scene(
  build: Build, name: str, instruments: Sequence[str], handle: bool = False, root: str | None = ".."
) -> str:
  """Returns a scene of the catalogue as MJCF.

  Args:
    build: the organ
    name: its name
    instruments: at most two
    handle: whether mocap handles drive them
    root: folder of the models; None for a scene with an empty frame, to which the organ and its
      keyframes are added, and absolute paths
  """
  entry = build.entry
  whole, root = root is not None, root or str(ROOT)
  backdrop, drawn = _backdrop(entry, root)
  organ = f'<model name="{name}" file="{name}.xml"/>' if whole else ""
  attach = f'<attach model="{name}" prefix="{name}/"/>' if whole else ""
  frame = {"name": name, "quat": catalog.SUPINE_QUAT}
  frame = mjcf.tag("frame", frame, _lines(drawn, attach), digits=6)
  keys = _keys(keyframes(build, instruments, handle)) if whole else ""
  return f"""<mujoco model="{name}_scene">
  <!-- {entry.title}, seen through a laparoscope.
       x to the patient's right, z anterior (up), -y superior. -->
  <compiler autolimits="true"/>
  <!-- The shape is the one in situ, where support and weight balance: no gravity. -->
  <option timestep="0.001" gravity="0 0 0" integrator="implicitfast" cone="elliptic"
    iterations="50"/>
  <size memory="{megabytes(len(build.vertices))}M"/>
{_visual(build)}
  <asset>
{textwrap.indent(_lines(organ, _models(instruments, handle, root), _CAVITY, backdrop), "    ")}
  </asset>

  <worldbody>
{_views(build)}{_ports(build, instruments)}{textwrap.indent(frame, "    ")}
  </worldbody>
{keys}</mujoco>
"""


def _lines(*texts: str) -> str:
  return "\n".join(filter(None, texts))


def _models(instruments: Sequence[str], handle: bool, root: str) -> str:
  suffix = "_handle" if handle else ""
  return _lines(
    *(
      f'<model name="{each}" file="{root}/instruments/{each}{suffix}.xml"/>'
      for each in sorted(set(instruments))
    )
  )


def _visual(build: Build) -> str:
  size = float(np.ptp(build.vertices, axis=0).max())
  # The free camera starts on the laparoscope's side.
  x, y, z = np.subtract(build.entry.target, build.entry.camera)
  azimuth, elevation = np.degrees([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
  return f"""  <statistic center="0 0 0" extent="{size:.3g}"/>

  <visual>
    <global offwidth="1280" offheight="960" azimuth="{azimuth:.0f}" elevation="{elevation:.0f}"/>
    <headlight ambient="0.3 0.28 0.28" diffuse="0.5 0.48 0.46" specular="0.1 0.1 0.1"/>
    <map znear="0.01" zfar="30"/>
    <rgba haze="0.16 0.07 0.06 1"/>
  </visual>
"""


def _views(build: Build) -> str:
  """Returns lights and cameras."""
  entry, size = build.entry, float(np.ptp(build.vertices, axis=0).max())
  overview = np.array([0.9, 1.3, 1.1]) * size
  side = np.array([1.9, 0.15, 0.25]) * size
  forward = np.subtract(entry.target, entry.camera)
  return f"""    <light name="laparoscope" pos="{numbers(entry.camera)}" dir="{numbers(forward)}"
      cutoff="50" exponent="8" diffuse="0.5 0.48 0.46" specular="0.6 0.6 0.6" castshadow="false"/>
    <light name="fill" directional="true" dir="0.3 -0.2 -1" diffuse="0.18 0.16 0.16"
      specular="0 0 0" castshadow="false"/>
    <camera name="laparoscope" pos="{numbers(entry.camera)}" fovy="60"
      xyaxes="{look(entry.camera, entry.target)}"/>
    <camera name="overview" pos="{numbers(overview)}" fovy="45"
      xyaxes="{look(overview, [0, 0, 0.1 * size])}"/>
    <camera name="side" pos="{numbers(side)}" fovy="45" xyaxes="{look(side, [0, 0, 0])}"/>
"""


def _backdrop(entry: catalog.Entry, root: str) -> tuple[str, str]:
  """Returns the assets and the geom of the organ that is drawn behind, or nothing."""
  if entry.backdrop is None:
    return "", ""
  other, pos = entry.backdrop
  mesh = {"name": other, "file": f"{root}/{entry.shape}/assets/{other}.obj", "smoothnormal": True}
  skin = {"name": other, "rgba": catalog.entry(other).rgba, "specular": 0.3, "shininess": 0.5}
  geom = {"name": other, "type": "mesh", "mesh": other, "material": other, "pos": pos}
  geom |= {"contype": 0, "conaffinity": 0, "group": 2}
  return _lines(mjcf.tag("mesh", mesh), mjcf.tag("material", skin)), mjcf.tag("geom", geom)


def _ports(build: Build, instruments: Sequence[str]) -> str:
  """Returns the instruments in their trocars."""
  text = ""
  placed = zip(instruments, prefixes(instruments), build.entry.ports, strict=False)
  for instrument, prefix, port in placed:
    pos, quat = _place(build, port)
    text += (
      f'    <frame pos="{numbers(pos)}" quat="{numbers(quat)}">\n'
      f'      <attach model="{instrument}" prefix="{prefix}"/>\n    </frame>\n'
    )
  return text


def prefixes(instruments: Sequence[str]) -> list[str]:
  """Returns the prefixes of the names of a scene's instruments."""
  if len(instruments) == 2 and instruments[0] == instruments[1]:
    return [f"right_{instruments[0]}/", f"left_{instruments[1]}/"]
  return [f"{instrument}/" for instrument in instruments]


def _place(build: Build, port: Port) -> tuple[np.ndarray, np.ndarray]:
  """Returns position and orientation of an instrument's frame, rounded as the files have them."""
  away = np.array(port.away) / np.linalg.norm(port.away)
  landmark = catalog.to_world(build.landmarks[port.landmark])
  pos = np.round(landmark + away * (trocar.DEPTH + port.gap), 3)
  return pos, np.round(trocar.aim(pos, landmark), 6)


def keyframes(
  build: Build, instruments: Sequence[str], handle: bool, free: int | None = None
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
  """Returns qpos, ctrl and mocap positions of every keyframe by name.

  `home` has every joint at zero; `touch` the tips 5 mm off the places they point at, grasper and
  scissors 8 mm and open; `press` is `touch` with controls that take the first instrument 10 mm
  deep. The dofs of the instruments come first, so that their addresses do not depend on the
  organ's resolution; `free` are those of the organ, unless its nodes are.
  """
  if free is None:
    free = 3 * (len(build.vertices) - len(build.pins))
  keys = {}
  for key in ("home", "touch", "press"):
    qpos, ctrl, mocap = [], [], []
    for i, (instrument, port) in enumerate(zip(instruments, build.entry.ports, strict=False)):
      jaws, bent = instrument in trocar.JAWED, [0] * 2 * (instrument in trocar.WRISTED)
      near = 0.0 if key == "home" else port.gap - (0.008 if jaws else 0.005)
      deep = port.gap + 0.01 if key == "press" and i == 0 else near
      opening = 0.7 if jaws and key != "home" else 0.0
      qpos += [0, 0, near, 0] + bent + [opening / 2] * 2 * jaws
      ctrl += [0] * 6 if handle else [0, 0, deep, 0]
      ctrl += [opening] * jaws + bent
      pos, quat = _place(build, port)
      shaft = np.zeros(3)
      mujoco.mju_rotVecQuat(shaft, np.array([0.0, 0.0, -1.0]), quat)
      mocap += list(pos + shaft * (trocar.DEPTH + deep)) if handle else []
    keys[key] = np.array(qpos + [0] * free), np.array(ctrl), np.array(mocap)
  return keys


def _keys(keys: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> str:
  lines = ""
  for key, values in keys.items():
    given = zip(("qpos", "ctrl", "mpos"), values, strict=True)
    text = " ".join(f'{field}="{numbers(value)}"' for field, value in given if len(value))
    lines += f'    <key name="{key}" {text}/>\n'
  return f"\n  <keyframe>\n{lines}  </keyframe>\n"
