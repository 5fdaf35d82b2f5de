"""The source of the project as the tests of the house read it: files, imports, names, functions."""

import ast
import functools
import pathlib

ROOT = pathlib.Path(__file__).parents[1]
ROOMS = {"palpate": "plugin", "palpate.models": "models", "palpate.tasks": "tasks"}


@functools.cache
def modules() -> dict[str, pathlib.Path]:
  """Returns the files of the package by module name."""
  found = {}
  for package, folder in ROOMS.items():
    for path in (ROOT / folder).rglob("*.py"):
      words = path.relative_to(ROOT / folder).with_suffix("").parts
      found[".".join([package, *(w for w in words if w != "__init__")])] = path
  return found


def headers() -> list[pathlib.Path]:
  return sorted((ROOT / "plugin").rglob("*.h"))


def suite_files() -> list[pathlib.Path]:
  return sorted((ROOT / "tests").rglob("*.py"))


@functools.cache
def tree(path: pathlib.Path) -> ast.Module:
  return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def nodes(path: pathlib.Path) -> list[ast.AST]:
  """Returns all that a file's syntax tree has, walked once for all rules."""
  return list(ast.walk(tree(path)))


def name_of(path: pathlib.Path) -> str:
  return path.relative_to(ROOT).as_posix()


def package_files() -> list[pathlib.Path]:
  return sorted(modules().values())


def below(folder: str) -> list[pathlib.Path]:
  return [path for path in package_files() if name_of(path).startswith(folder)]


@functools.cache
def imports(types: bool = True) -> list[tuple[str, str, bool]]:
  """Returns (module, what it imports, whether inside a function), of the package and of others.

  Args:
    types: whether with what type checkers alone import
  """
  found = []
  for module, path in modules().items():
    inside = {
      id(within)
      for node in nodes(path)
      if isinstance(node, ast.FunctionDef)
      for within in ast.walk(node)
      if isinstance(within, ast.Import | ast.ImportFrom)
    }
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    unrun = {
      id(within)
      for node in nodes(path)
      if not types and isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
      for within in node.body
    }
    for node in nodes(path):
      if id(node) in unrun:
        continue
      if isinstance(node, ast.Import):
        found += [(module, alias.name, id(node) in inside) for alias in node.names]
      elif isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
          above = package.split(".")[: len(package.split(".")) - node.level + 1]
          base = ".".join([*above, *([base] if base else [])])
        for alias in node.names:
          whole = f"{base}.{alias.name}"
          found.append((module, whole if whole in modules() else base, id(node) in inside))
  return found


def is_private(name: str) -> bool:
  return name.startswith("_") and not name.startswith("__") and name != "_"


@functools.cache
def defined(path: pathlib.Path) -> set[str]:
  """Returns the private names that a file defines: functions, classes, variables, attributes."""
  found = set()
  for node in nodes(path):
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
      found.add(node.name)
    elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
      found.add(node.id if isinstance(node, ast.Name) else node.attr)
    elif isinstance(node, ast.Import | ast.ImportFrom):
      found |= {alias.asname or alias.name for alias in node.names}
  return {name for name in found if is_private(name)}


def private_uses(paths: list[pathlib.Path]) -> set[str]:
  """Returns where files use private names of other files of the package."""
  package = set().union(*map(defined, package_files()))
  found = set()
  for path in paths:
    foreign = package - defined(path)
    for node in nodes(path):
      used = []
      if isinstance(node, ast.Attribute):
        own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
        used = [] if own else [node.attr]
      elif isinstance(node, ast.ImportFrom) and (node.level or "palpate" in (node.module or "")):
        used = [alias.name for alias in node.names if is_private(alias.name)]
        foreign = foreign | set(used)
      elif isinstance(node, ast.Call) and getattr(node.func, "id", getattr(
        node.func, "attr", "")) in ("setattr", "getattr", "delattr", "hasattr"):  # fmt: skip
        words = [a.value for a in node.args if isinstance(a, ast.Constant)]
        used = [str(word).rpartition(".")[2] for word in words]
      used = [name for name in used if name.rstrip("_") != "_fields"]  # of named tuples, ctypes
      found |= {f"{name_of(path)}: {name}" for name in used if name in foreign}
  return found
