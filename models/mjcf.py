"""The one writer of flexcomps and of OBJ files, and how both write a number.

Everything returns text. It does not end in a newline, except for a file's.
"""

import pathlib
import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from palpate.attributes import CONTACT, text

__all__ = ["CONTACT", "extension", "flexcomp", "numbers", "obj", "plugin", "tag"]

Mesh = tuple[np.ndarray, np.ndarray]  # points (n, 3), triangles (m, 3)

PLUGIN = "palpate.organ"
# Keeps MuJoCo from warning of a flex without forces of its own; the plugin sets it to 0.
EDGE = '<edge damping="1e-9"/>'
_WIDTH = 96


def numbers(values, digits: int = 9) -> str:
  """Returns numbers as an attribute has them, with so many significant digits; no -0."""
  return text(np.asarray(values, dtype=float), digits)


def tag(name: str, attributes: Mapping, inside: str = "", digits: int = 9) -> str:
  """Returns an element in lines of some 100 columns, what is inside indented by two spaces.

  Args:
    name: of the element
    attributes: text, numbers, flags, or arrays of numbers; None leaves one out
    inside: its children
    digits: of the numbers
  """
  lines = [f"<{name}"]
  for key, value in attributes.items():
    if value is None:
      continue
    word = f'{key}="{text(value, digits)}"'
    if len(lines[-1]) + len(word) > _WIDTH and lines[-1] != f"<{name}":
      lines.append(f"  {word}")
    else:
      lines[-1] += f" {word}"
  head = "\n".join(lines)
  return f"{head}>\n{textwrap.indent(inside, '  ')}\n</{name}>" if inside else f"{head}/>"


def plugin(config: Mapping | None = None, instance: str | None = None, digits: int = 9) -> str:
  """Returns the plugin of a flexcomp or body.

  Args:
    config: its keys, texts, numbers or arrays of numbers
    instance: the instance of the extension that it stands for, in place of keys
    digits: of the numbers
  """
  return tag("plugin", {"plugin": PLUGIN, "instance": instance}, _keys(config or {}, digits))


def extension(instances: Mapping[str, Mapping] | None = None, digits: int = 9) -> str:
  """Returns the extension that declares the plugin, with the keys of named instances of it."""
  made = [tag("instance", {"name": n}, _keys(k, digits)) for n, k in (instances or {}).items()]
  return tag("extension", {}, tag("plugin", {"plugin": PLUGIN}, "\n".join(made)))


def _keys(config: Mapping, digits: int) -> str:
  return "\n".join(
    f'<config key="{key}" value="{text(value, digits)}"/>' for key, value in config.items()
  )


def flexcomp(
  name: str,
  mesh: Mesh | str | None = None,
  *,
  config: Mapping | None = None,
  contact: Mapping | None = None,
  pin: Sequence[int] | np.ndarray | Mapping[str, Sequence[int] | np.ndarray] = (),
  inside: str = "",
  digits: int = 9,
  **attributes,
) -> str:
  """Returns a flexcomp of triangles.

  Args:
    name: of the flex
    mesh: points [m] and triangles, or the path of a mesh file; None where attributes say what it is
    config: the plugin's keys, which make a nodal organ of it; None for a flex without the plugin
      (a window, a rigid organ, whose body has the plugin, or a flex of MuJoCo's own)
    contact: attributes of <contact>
    pin: vertices that do not move; with names, which become comments
    inside: further children
    digits: of all numbers
    **attributes: of <flexcomp>: mass [kg], radius [m], rigid, material, rgba, ...
  """
  shape: dict = {}
  if isinstance(mesh, str):
    shape = {"type": "mesh", "file": mesh}
  elif mesh is not None:
    shape = {"type": "direct", "point": mesh[0], "element": np.asarray(mesh[1])}
  children = [] if config is None else [plugin(config, digits=digits), EDGE]
  children += [inside] if inside else []
  if contact is not None:
    children.append(tag("contact", contact, digits=digits))
  if not isinstance(pin, Mapping):
    children += [tag("pin", {"id": np.asarray(pin)})] if len(pin) else []
  else:
    children += [tag("pin", {"id": np.asarray(k)}) + f"  <!-- {n} -->" for n, k in pin.items()]
  return tag(
    "flexcomp", {"name": name, **shape, "dim": 2} | attributes, "\n".join(children), digits
  )


def obj(vertices: np.ndarray, triangles: np.ndarray, decimals: int = 6) -> str:
  """Returns a mesh as an OBJ file; micrometres unless more decimals are asked for."""
  lines = [" ".join(["v", *(f"{x + 0.0:.{decimals}f}" for x in v)]) for v in vertices]
  lines += [f"f {a} {b} {c}" for a, b, c in np.asarray(triangles) + 1]
  return "\n".join(lines) + "\n"


def read_obj(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
  """Returns vertices and triangles of a file that `obj` has written."""
  lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
  vertices = np.array([line[1:] for line in lines if line[0] == "v"], float)
  return vertices, np.array([line[1:] for line in lines if line[0] == "f"], int) - 1
