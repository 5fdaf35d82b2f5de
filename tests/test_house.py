"""The rules of the house: what may import what, and one place for each thing.

A rule finds its offenders in the source, none of which is run.
"""

import ast
import functools
import re
import tomllib

import pytest
from sources import (
  ROOT,
  below,
  headers,
  imports,
  modules,
  name_of,
  nodes,
  package_files,
  private_uses,
  suite_files,
)

# Floors from the ground up; an import leads to the same floor or a lower one.
FLOORS = ("native", "tissue", "engine", "organ", "batch", "models", "tasks", "app")
PACKAGE = ("plugin", "models", "tasks")


# Imports.


def floor(module: str) -> int:
  """Returns the floor of a module of the package."""
  words = module.split(".")
  room = words[1] if len(words) > 1 else "organ"  # palpate itself: the handle and register
  handles = "attributes", "authoring", "bonds", "camera", "meshes", "needle", "screen", "skins"
  names = {"__main__": "app", "forces": "engine"}  # one floor, no circle
  names |= dict.fromkeys((*handles, "spares", "thread", "windows"), "organ")
  return FLOORS.index(names.get(room, room))


@functools.cache
def inner(types: bool = True) -> list[tuple[str, str, bool]]:
  """Returns the imports of the package's own modules, with those for type checkers alone or not."""
  return [(a, b, hidden) for a, b, hidden in imports(types) if b in modules() and a != b]


def upward() -> set[str]:
  return {f"{a} -> {b}" for a, b, _ in inner() if floor(a) < floor(b)}


def app_imported() -> set[str]:
  return {f"{a} -> {b}" for a, b, _ in inner() if floor(b) == len(FLOORS) - 1 != floor(a)}


def cycles() -> set[str]:
  """Returns the modules that are on a circle of imports, function by function ones too."""
  below_: dict[str, set[str]] = {}
  for a, b, _ in inner(types=False):
    if a != "palpate" and b != "palpate":  # the package itself is imported with every module
      below_.setdefault(a, set()).add(b)

  @functools.cache
  def reach(start: str) -> frozenset[str]:
    seen, todo = set(), [start]
    while todo:
      for b in below_.get(todo.pop(), ()):
        if b not in seen:
          seen.add(b)
          todo.append(b)
    return frozenset(seen)

  return {a for a in below_ if a in reach(a)}


def hidden() -> set[str]:
  """Returns imports of the package inside of functions, below the roof."""
  roof = len(FLOORS) - 1
  found = [(a, b) for a, b, inside in inner() if inside and a != "palpate"]
  return {f"{a} -> {b}" for a, b in found if floor(a) < roof}


def hidden_needs() -> set[str]:
  """Returns imports inside of functions of what is always installed, below the roof."""
  settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
  always = {re.match(r"[\w-]+", need)[0] for need in settings["project"]["dependencies"]}
  always = {{"warp-lang": "warp"}.get(need, need.replace("-", "_")) for need in always}
  return {
    name_of(modules()[a])
    for a, b, inside in imports()
    if inside and floor(a) < len(FLOORS) - 1 and a != "palpate" and b.partition(".")[0] in always
    if b not in ("mujoco.viewer", "trimesh")  # the first wants a screen, the second takes long
  }


def mujoco_in_tissue() -> set[str]:
  engines = ("mujoco", "mujoco_warp", "dm_control")
  return {f"{a} -> {b}" for a, b, _ in imports() if floor(a) < 2 and b.partition(".")[0] in engines}


def private_in_tests() -> set[str]:
  return private_uses(suite_files())


def private_in_the_package() -> set[str]:
  return private_uses(package_files())


# One place for each thing.


def wide_kernels() -> set[str]:
  """Returns the files but one, whose kernels have mujoco_warp's arguments, with more than four."""
  found = set()
  for path in package_files():
    for node in nodes(path) if name_of(path) != "plugin/batch/contact/fixed_order.py" else ():
      if isinstance(node, ast.FunctionDef):
        marks = [ast.unparse(mark) for mark in node.decorator_list]
        if len(node.args.args) > 4 and any(re.match(r"wp\.kernel\b", mark) for mark in marks):
          found.add(name_of(path))
  return found


def model_writers() -> set[str]:
  """Returns the files but prepare.py that write to an mjModel's arrays outside of a step."""
  found = set()
  for path in [*below("plugin/engine"), *below("plugin/organ"), *below("plugin/tissue")]:
    for node in nodes(path):
      targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
      for target in targets:
        text = ast.unparse(target) if isinstance(target, ast.Subscript) else ""
        # Those of the windows' bodies, in a step, and what only renderers read are known.
        if re.match(r"(m|model)\.(?!tree_sleep_policy|skin_vert)\w+\[", text):
          found.add(name_of(path))
  return found - {"plugin/engine/model/prepare.py"}


def scheme_comparisons() -> set[str]:
  """Returns the files but the registry that compare a scheme's name."""
  names = {"implicit", "midpoint", "neumann", "explicit"}
  found = set()
  for path in below("plugin"):
    for node in nodes(path):
      if isinstance(node, ast.Compare):
        words = [n.value for n in ast.walk(node) if isinstance(n, ast.Constant)]
        if names & {word for word in words if isinstance(word, str)}:
          found.add(name_of(path))
  return found - {"plugin/tissue/step.py"}


def literal_offsets() -> set[str]:
  """Returns the files but layout.py with numbers of an index into a state or a box."""
  boxes = r"(plugin_state|inbox|outbox|state)\b"
  found = set()
  for path in [*below("plugin/engine"), *below("plugin/organ"), *below("plugin/windows")]:
    for node in nodes(path):
      if not isinstance(node, ast.Subscript) or not re.search(boxes, ast.unparse(node.value)):
        continue
      numbers = [n.value for n in ast.walk(node.slice) if isinstance(n, ast.Constant)]
      if any(type(n) is int and n > 0 for n in numbers):
        found.add(name_of(path))
  return found - {"plugin/engine/layout.py"}


RULES = {
  "imports lead down": upward,
  "the roof is imported by nobody": app_imported,
  "no circle of imports": cycles,
  "no import of the package in a function": hidden,
  "no import of what is always there in a function": hidden_needs,
  "tissue knows no MuJoCo": mujoco_in_tissue,
  "tests use public names": private_in_tests,
  "modules use public names of each other": private_in_the_package,
  "kernels of four arguments": wide_kernels,
  "one file writes to models": model_writers,
  "schemes in one registry": scheme_comparisons,
  "offsets in one table": literal_offsets,
}
# What only some files may have in their text: whose files, the pattern, and these files.
PLACES = {
  "device switches": (
    ("plugin",), r"__CUDA_ARCH__|__CUDACC",
    ("plugin/native/core/simd.h", "plugin/native/core/group.h"),
  ),
  "native code in headers": (PACKAGE, r"\.func_native\b", ("plugin/tissue/kernels.py",)),
  "private modules of others": (
    PACKAGE, r"(?m)^ *(from|import) .*\._src\b",
    ("plugin/batch/mjw/private.py", "plugin/tissue/device.py"),
  ),
  "writers of flexcomps": (
    PACKAGE, r"<flexcomp\s+\w+=\"|\.add_flex\(",
    # The second asks MuJoCo by one contact, and knows no models.
    ("models/mjcf.py", "plugin/engine/contacts.py", "plugin/windows.py", "plugin/authoring.py"),
  ),
  "builder of test scenes": (
    ("tests",), r"<flexcomp[^>{]*point=",
    ("tests/scenes/documents.py", "tests/reference/press_explicit_20us.py", "tests/test_house.py"),
  ),
  "writer of OBJ": (PACKAGE, r"\"[vf] [{%]|\[\"v\",|newmtl", ("models/mjcf.py",)),
  "writer of films": (
    PACKAGE, r"\b(get_writer|mimsave|mimwrite)\(", ("plugin/app/draw/film.py",)
  ),
  "writer of CSV": (
    (*PACKAGE, "tests"), r"\bcsv\.(Dict)?[Ww]riter\(",
    ("plugin/app/console.py", "tests/benchmarks/results.py"),
  ),
  "versions asked for": (
    ("plugin/engine", "plugin/tissue", "plugin/organ"), r"mujoco\.(__version__|mj_version)",
    ("plugin/engine/model/mjstruct.py",),
  ),
}  # fmt: skip


@pytest.mark.parametrize("rule", RULES)
def test_rule(rule):
  assert not RULES[rule]()


@pytest.mark.parametrize("place", PLACES)
def test_place(place):
  rooms, pattern, allowed = PLACES[place]
  files = [*package_files(), *headers(), *suite_files()]
  found = {name_of(path) for path in files if re.search(pattern, path.read_text("utf-8"))}
  found = {name for name in found if name.startswith(rooms)}
  assert found <= set(allowed)
  assert found, "nothing is found: does the pattern still fit?"


def test_the_wheel_is_the_package_alone():
  settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
  packages = settings["setuptools"]["packages"]
  assert not [name for name in packages if re.search("test|bench", name)]
  for module, path in modules().items():
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    assert package in packages, f"{name_of(path)} would be left out of the wheel"
