"""The rules of the house: what may import what, and one place for each thing.

A rule finds its offenders in the source, none of which is run. What does not comply yet is named in
NOT_YET, and a name that does comply must go from there.
"""

import ast
import functools
import pathlib
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
  strings,
  suite_files,
)

# Floors from the ground up; an import leads to the same floor or a lower one.
FLOORS = ("native", "tissue", "engine", "organ", "batch", "models", "tasks", "app")

NOT_YET: dict[str, set[str]] = {}


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
    if b != "mujoco.viewer"  # wants a screen
  }


def mujoco_in_tissue() -> set[str]:
  engines = ("mujoco", "mujoco_warp", "dm_control")
  return {f"{a} -> {b}" for a, b, _ in imports() if floor(a) < 2 and b.partition(".")[0] in engines}


# Private names.


def private_in_tests() -> set[str]:
  return private_uses(suite_files())


def private_in_the_package() -> set[str]:
  return private_uses(package_files())


def private_sources() -> set[str]:
  """Returns the files but two that import what is private to mujoco_warp or Warp."""
  allowed = {"plugin/batch/private.py", "plugin/tissue/device.py"}
  return {name_of(modules()[a]) for a, b, _ in imports() if "._src" in b} - allowed


# One place for each thing.


def device_switches() -> set[str]:
  """Returns the files but simd.h and group.h that ask whether they are compiled for CUDA."""
  allowed = ("plugin/native/core/simd.h", "plugin/native/core/group.h")
  paths = [p for p in [*package_files(), *headers()] if name_of(p) not in allowed]
  return {name_of(p) for p in paths if re.search(r"__CUDA_ARCH__|__CUDACC", p.read_text())}


def native_in_python() -> set[str]:
  """Returns the files but the binding that give Warp native code."""
  return {
    name_of(path)
    for path in package_files()
    if name_of(path) != "plugin/tissue/kernels.py"
    for node in nodes(path)
    if isinstance(node, ast.Attribute) and node.attr == "func_native"
  }


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


def writers(pattern: str, *allowed: str) -> set[str]:
  """Returns the files with a string that matches, but for the allowed ones."""
  return {
    name_of(path)
    for path in package_files()
    if name_of(path) not in allowed and any(re.search(pattern, text) for text in strings(path))
  }


def calls(pattern: str, paths: list[pathlib.Path], *allowed: str) -> set[str]:
  """Returns the files that call what matches, but for the allowed ones."""
  return {
    name_of(path)
    for path in paths
    if name_of(path) not in allowed
    for node in nodes(path)
    if isinstance(node, ast.Call) and re.search(pattern, ast.unparse(node.func))
  }


def flexcomp_writers() -> set[str]:
  probe = "plugin/engine/contacts.py"  # asks MuJoCo by one contact, and knows no models
  found = writers(r'<flexcomp\s+\w+="', "models/mjcf.py", probe)
  return found | calls(r"\.add_flex$", package_files(), "plugin/windows.py", "plugin/authoring.py")


def flexcomp_in_tests() -> set[str]:
  """Returns the tests that write an organ's flexcomp; `scenes` is the one builder."""
  allowed = ("tests/scenes/documents.py", "tests/reference/press_explicit_20us.py")
  return {
    name_of(path)
    for path in suite_files()
    if name_of(path) not in allowed
    and any(re.search(r"<flexcomp[^>]*point=", text) for text in strings(path))
  }


def obj_writers() -> set[str]:
  return writers(r"^(v|f|vn|vt) $|^\n?(v|f) %|newmtl", "models/mjcf.py")


def film_writers() -> set[str]:
  return calls(r"get_writer$|mimsave$|mimwrite$", package_files(), "plugin/app/draw/film.py")


def csv_writers() -> set[str]:
  allowed = ("plugin/app/console.py", "tests/benchmarks/results.py")
  return calls(r"csv\.(Dict)?[Ww]riter$", [*package_files(), *suite_files()], *allowed)


def model_writers() -> set[str]:
  """Returns the files but prepare.py that write to an mjModel's arrays outside of a step."""
  found = set()
  for path in [*below("plugin/engine"), *below("plugin/organ"), *below("plugin/tissue")]:
    for node in nodes(path):
      targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
      for target in targets:
        text = ast.unparse(target) if isinstance(target, ast.Subscript) else ""
        if re.match(r"(mjstruct\.)?view\((m|model)\.|(m|model)\.\w+\[", text):
          if "tree_sleep_policy" not in text:  # of the windows' bodies, in a step
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


def version_questions() -> set[str]:
  """Returns the files of the plugin but mjstruct.py that ask for MuJoCo's version."""
  found = set()
  for path in [*below("plugin/engine"), *below("plugin/tissue"), *below("plugin/organ")]:
    if re.search(r"mujoco\.(__version__|mj_version)", path.read_text()):
      found.add(name_of(path))
  return found - {"plugin/engine/model/mjstruct.py"}


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
  "private modules of others in one file": private_sources,
  "device switches": device_switches,
  "native code in headers": native_in_python,
  "kernels of four arguments": wide_kernels,
  "one writer of flexcomps": flexcomp_writers,
  "one builder of test scenes": flexcomp_in_tests,
  "one writer of OBJ": obj_writers,
  "one writer of films": film_writers,
  "one writer of CSV": csv_writers,
  "one file writes to models": model_writers,
  "schemes in one registry": scheme_comparisons,
  "versions asked for in one file": version_questions,
  "offsets in one table": literal_offsets,
}


@pytest.mark.parametrize("rule", RULES)
def test_rule(rule):
  found, known = RULES[rule](), NOT_YET.get(rule, set())
  assert found - known == set(), "new offenders"
  assert known - found == set(), "these comply: take them out of NOT_YET"


def test_not_yet_names_rules():
  assert set(NOT_YET) <= set(RULES)


def test_the_wheel_is_the_package_alone():
  settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
  packages = settings["setuptools"]["packages"]
  assert not [name for name in packages if re.search("test|bench", name)]
  for module, path in modules().items():
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    assert package in packages, f"{name_of(path)} would be left out of the wheel"
