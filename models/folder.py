"""Writes a wrapped surface as a model folder: mesh, organ, scene, report and picture."""

from __future__ import annotations

import pathlib

import numpy as np

from . import scene
from .catalog import ENTRIES
from .wrap import Report

# The tissue of a new organ until its maker knows better: the liver's.
_TISSUE = ENTRIES["liver"]


def write(
  folder: str | pathlib.Path,
  name: str,
  vertices: np.ndarray,
  triangles: np.ndarray,
  report: Report,
  young: float = _TISSUE.young,
  foundation: float = _TISSUE.foundation,
) -> list[pathlib.Path]:
  """Writes `<name>.xml`, `scene.xml`, `assets/<name>.obj` and `README.md`; returns their paths.

  Args:
    folder: made if it is not there
    name: of the organ; letters, digits, _ and -
    vertices: nodes [m], (n, 3)
    triangles: winding outward, (m, 3)
    report: of the wrapping
    young: Young's modulus [Pa]
    foundation: Winkler foundation, which holds the organ in place [Pa/m]

  Raises:
    ValueError: the name or a constant is not allowed.
  """
  if not name or not all(c.isalnum() or c in "_-" for c in name):
    raise ValueError(f"name is {name!r}, expected letters, digits, _ and -")
  for key, value in (("young", young), ("foundation", foundation)):
    if not (np.isfinite(value) and value > 0):
      raise ValueError(f"{key} is {value:g}, expected a number > 0")
  root = pathlib.Path(folder)
  a, b, c = (vertices[triangles[:, k]] for k in range(3))
  mass = _TISSUE.density * float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
  files = {
    root / "assets" / f"{name}.obj": _obj(vertices, triangles),
    root / f"{name}.xml": _organ(name, mass, young, foundation),
    root / "scene.xml": _scene(name, vertices),
    root / "README.md": _readme(name, mass, young, foundation, report),
  }
  for path, text in files.items():
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
  return list(files)


def _obj(vertices: np.ndarray, triangles: np.ndarray) -> str:
  lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices]
  lines += [f"f {i} {j} {k}" for i, j, k in triangles + 1]
  return "\n".join(lines) + "\n"


def _organ(name: str, mass: float, young: float, foundation: float) -> str:
  return f"""<mujoco model="{name}">
  <extension>
    <plugin plugin="palpate.organ"/>
  </extension>

  <asset>
    <material name="{name}" rgba="{scene.numbers(_TISSUE.rgba)}" specular="0.5" shininess="0.6"/>
  </asset>

  <worldbody>
    <body name="{name}">
      <flexcomp name="{name}" type="mesh" file="assets/{name}.obj" dim="2" mass="{mass:.4g}"
        radius="0.001" material="{name}" flatskin="false">
        <plugin plugin="palpate.organ">
          <config key="young" value="{young:g}"/>
          <config key="poisson" value="{_TISSUE.poisson:g}"/>
          <config key="thickness" value="{_TISSUE.thickness:g}"/>
          <config key="foundation" value="{foundation:g}"/>
          <config key="bulk" value="{_TISSUE.bulk:g}"/>
          <config key="damping" value="{_TISSUE.damping:g}"/>
        </plugin>
        <edge damping="1e-9"/>
        <contact condim="3" friction="0.3" solref="0.004 1" solimp="0.95 0.99 0.001" solmix="1000"
          selfcollide="none"/>
      </flexcomp>
    </body>
  </worldbody>
</mujoco>
"""


def _scene(name: str, vertices: np.ndarray) -> str:
  low, high = vertices.min(axis=0), vertices.max(axis=0)
  middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
  eye = middle + size * np.array([0.6, -0.9, 0.7])
  away = (eye - middle) / np.linalg.norm(eye - middle)
  right = np.cross([0.0, 0.0, 1.0], away)
  right /= np.linalg.norm(right)
  axes = scene.numbers(np.concatenate([right, np.cross(away, right)]))
  memory = 64 + 5 * len(vertices) ** 2 // 2_000_000
  return f"""<mujoco model="{name} scene">
  <option timestep="0.001" gravity="0 0 0"/>
  <size memory="{memory}M"/>
  <statistic center="{scene.numbers(middle)}" extent="{size:.3g}"/>
  <visual>
    <headlight ambient="0.35 0.35 0.35" diffuse="0.5 0.5 0.5"/>
    <map znear="0.01"/>
    <global offwidth="1280" offheight="960"/>
  </visual>

  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.3 0.35 0.4" rgb2="0.1 0.1 0.12" width="64"
      height="384"/>
    <model name="{name}" file="{name}.xml"/>
  </asset>

  <worldbody>
    <light pos="{scene.numbers(eye + np.array([0, 0, size]))}" dir="{scene.numbers(-away)}"/>
    <camera name="overview" pos="{scene.numbers(eye)}" xyaxes="{axes}"/>
    <frame>
      <attach model="{name}" body="{name}" prefix="{name}/"/>
    </frame>
  </worldbody>
</mujoco>
"""


def _readme(name: str, mass: float, young: float, foundation: float, report: Report) -> str:
  table = "\n".join(
    f"| {line.partition(': ')[0]} | {line.partition(': ')[2]} |" for line in str(report).split("\n")
  )
  return f"""# {name}

Made by `palpate wrap`. `{name}.xml` is the organ to attach, `scene.xml` shows it.

![{name}]({name}.png)

E = {young:g} Pa, foundation {foundation:g} Pa/m, mass {mass:.4g} kg at
{_TISSUE.density:g} kg/m^3: the liver's values where not given, to be replaced by the tissue's own.
Nothing is pinned; the foundation holds it.

| | |
|---|---|
{table}
"""
