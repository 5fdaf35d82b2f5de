"""Writes a wrapped surface as a model folder: mesh, organ, scene, report and picture."""

from __future__ import annotations

import pathlib

import numpy as np

from . import markup, mjcf, quality
from .catalog import ENTRIES
from .markup import numbers
from .wrap import Report

# What a new organ is until its maker knows better: liver.
_LIVER = ENTRIES["liver"]


def write(
  folder: str | pathlib.Path,
  name: str,
  vertices: np.ndarray,
  triangles: np.ndarray,
  report: Report,
  young: float = _LIVER.tissue.young,
  foundation: float = _LIVER.tissue.foundation,
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
  mass = _LIVER.tissue.mass_of(quality.volume(vertices, triangles))
  config = _LIVER.tissue.keys() | {"young": young, "foundation": foundation}
  files = {
    root / "assets" / f"{name}.obj": mjcf.obj(vertices, triangles, decimals=8),
    root / f"{name}.xml": markup.organ(
      name, name, f"assets/{name}.obj", mass, config, rgba=_LIVER.rgba
    ),
    root / "scene.xml": _scene(name, vertices),
    root / "README.md": _readme(name, mass, young, foundation, report),
  }
  for path, text in files.items():
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
  return list(files)


def _scene(name: str, vertices: np.ndarray) -> str:
  low, high = vertices.min(axis=0), vertices.max(axis=0)
  middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
  eye = middle + size * np.array([0.6, -0.9, 0.7])
  away = (eye - middle) / np.linalg.norm(eye - middle)
  right = np.cross([0.0, 0.0, 1.0], away)
  right /= np.linalg.norm(right)
  axes = numbers(np.concatenate([right, np.cross(away, right)]))
  memory = 64 + 5 * len(vertices) ** 2 // 2_000_000
  return f"""<mujoco model="{name} scene">
  <option timestep="0.001" gravity="0 0 0"/>
  <size memory="{memory}M"/>
  <statistic center="{numbers(middle)}" extent="{size:.3g}"/>
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
    <light pos="{numbers(eye + np.array([0, 0, size]))}" dir="{numbers(-away)}"/>
    <camera name="overview" pos="{numbers(eye)}" xyaxes="{axes}"/>
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
{_LIVER.tissue.density:g} kg/m^3: the liver's values where not given, to be replaced by the
tissue's own.
Nothing is pinned; the foundation holds it.

| | |
|---|---|
{table}
"""
