"""Writes wrapped surfaces as a model folder: meshes, organs, scene and report."""

import os
import pathlib
import textwrap
from collections.abc import Iterable, Mapping

import numpy as np
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology

from .. import markup, mjcf
from ..catalog import ENTRIES
from ..markup import numbers
from .wrap import Report

Wrapped = tuple[np.ndarray, np.ndarray, Report]

# What a new organ is until its maker knows better: liver.
_LIVER = ENTRIES["liver"]
SCENE = "scene"


def check(
  folder: str | pathlib.Path,
  names: Iterable[str],
  young: float = _LIVER.tissue.young,
  foundation: float | None = None,
  overwrite: bool = False,
  solid: bool = False,
) -> None:
  """Raises a ValueError for what `write` would refuse; arguments as for that."""
  for name in names:
    if not name or not all(c.isascii() and (c.isalnum() or c in "_-") for c in name):
      raise ValueError(f"name is {name!r}, expected letters, digits, _ and -")
    if name.lower() == SCENE:
      raise ValueError(f"name is {name!r}, which the scene's file has; expected another")
  for key, value in (("young", young), ("foundation", foundation)):
    if value is not None and not (np.isfinite(value) and value > 0):
      raise ValueError(f"{key} is {value:g}, expected a number > 0")
  root = pathlib.Path(folder)
  if os.path.lexists(root) and not root.is_dir():
    raise ValueError(f"{str(root)!r} is a file, expected a folder")
  above = next(path for path in (root.absolute(), *root.absolute().parents) if path.exists())
  if not above.is_dir() or not os.access(above, os.W_OK):
    raise ValueError(f"cannot write to {str(above)!r}")
  if root.is_dir() and any(root.iterdir()) and not overwrite:
    raise ValueError(f"folder {str(root)!r} is not empty, and nothing in it is to be lost")
  for path in (root / "assets", root / "assets" / "x"):
    if path.parent.is_symlink() and path.parent != root:
      raise ValueError(f"{str(path.parent)!r} is a link, expected a folder of its own")


def write(
  folder: str | pathlib.Path,
  organs: Mapping[str, Wrapped],
  young: float = _LIVER.tissue.young,
  foundation: float | None = None,
  overwrite: bool = False,
  solid: bool = False,
) -> list[pathlib.Path]:
  """Writes `<name>.xml` and `assets/<name>.obj` for each organ, `scene.xml` and `README.md`.

  Args:
    folder: made if it is not there
    organs: what `wrap` returned, by names of letters, digits, _ and -
    young: Young's modulus [Pa]
    foundation: Winkler foundation, which holds the organ in place [Pa/m]; None for the liver's, and
      for none of a solid
    overwrite: whether the folder may have files; those of the names above are replaced
    solid: whether they are filled with tetrahedra, in place of a skin

  Returns:
    The paths, the scene's first.

  Raises:
    ValueError: a name or a constant is not allowed, there is something to be lost, or tetrahedra do
      not fill a surface.
  """
  check(folder, organs, young, foundation, overwrite)
  root = pathlib.Path(folder)
  config = _LIVER.tissue.keys(solid) | {"young": young}
  config |= {"elements": "solid"} if solid else {}
  config |= {"foundation": foundation} if foundation else {}
  if solid:
    for name, (vertices, triangles, _) in organs.items():
      fill.fill(name, topology.build(name, vertices, triangles))
  files = {root / f"{SCENE}.xml": _scene(organs), root / "README.md": _readme(organs, config)}
  for name, (vertices, triangles, report) in organs.items():
    mesh, mass = f"assets/{name}.obj", _LIVER.tissue.mass_of(report.volume)
    files[root / mesh] = mjcf.obj(vertices, triangles, decimals=8)
    files[root / f"{name}.xml"] = markup.organ(name, name, mesh, mass, config, rgba=_LIVER.rgba)
  for path, text in files.items():
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f"{path.name}.new")
    new.write_text(text, encoding="utf-8")
    new.replace(path)  # a link is replaced, not followed
  return list(files)


def _scene(organs: Mapping[str, Wrapped]) -> str:
  points = np.concatenate([vertices for vertices, _, _ in organs.values()])
  low, high = points.min(axis=0), points.max(axis=0)
  middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
  eye = middle + size * np.array([0.6, -0.9, 0.7])
  models = "\n".join(f'<model name="{name}" file="{name}.xml"/>' for name in organs)
  frames = "\n".join(
    f'<frame>\n  <attach model="{name}" body="{name}" prefix="{name}/"/>\n</frame>'
    for name in organs
  )
  first = next(iter(organs))
  return f"""<mujoco model="{first} scene">
  <option timestep="0.001" gravity="0 0 0"/>
  <size memory="{markup.megabytes(len(points))}M"/>
  <statistic center="{numbers(middle)}" extent="{size:.3g}"/>
  <visual>
    <headlight ambient="0.35 0.35 0.35" diffuse="0.5 0.5 0.5"/>
    <map znear="0.01"/>
    <global offwidth="1280" offheight="960"/>
  </visual>

  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.3 0.35 0.4" rgb2="0.1 0.1 0.12" width="64"
      height="384"/>
{textwrap.indent(models, "    ")}
  </asset>

  <worldbody>
    <light pos="{numbers(eye + np.array([0, 0, size]))}" dir="{numbers(middle - eye)}"/>
    <camera name="overview" pos="{numbers(eye)}" xyaxes="{markup.look(eye, middle)}"/>
{textwrap.indent(frames, "    ")}
  </worldbody>
</mujoco>
"""


def _readme(organs: Mapping[str, Wrapped], config: Mapping) -> str:
  first, density = next(iter(organs)), _LIVER.tissue.density
  held = config.get("foundation", 0)
  inside = "filled with tetrahedra" if "elements" in config else "a skin"
  how = f"{inside}, foundation {held:g} Pa/m" if held else inside
  holds = "the foundation holds it" if held else "nothing holds it: pin, attach or support it"
  text = f"""# {first}

Made by `palpate wrap`. `{SCENE}.xml` shows what these files hold, each an organ to attach:

![{first}]({first}.png)

E = {config["young"]:g} Pa, {density:g} kg/m^3, {how}: the liver's values where not given, to be
replaced by the tissue's own. Nothing is pinned; {holds}.
"""
  for name, (_, _, report) in organs.items():
    rows = [("mass", f"{_LIVER.tissue.mass_of(report.volume):.4g} kg"), *report.rows()]
    table = "\n".join(f"| {what} | {value} |" for what, value in rows)
    text += f"\n## {name}.xml\n\n| | |\n|---|---|\n{table}\n"
  return text
