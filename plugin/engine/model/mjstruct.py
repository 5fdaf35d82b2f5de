"""ctypes views of mjModel and mjData that follow the installed MuJoCo.

MuJoCo's own introspection data gives the declarations, so that no layout is written down here.
`check` compares the result with the addresses the bindings report, once, before anything is run.
"""

import ctypes as C
import functools
import importlib.metadata
import math
import pathlib
from typing import Any, cast

import mujoco
import numpy as np
from mujoco.introspect import ast_nodes, structs
from packaging import requirements

NAME = "palpate.organ"  # of the plugin
_ERROR = int(mujoco.mjtLogLevel.mjLOG_ERROR)
_SCALAR = {
  "mjtNum": C.c_double,
  "double": C.c_double,
  "float": C.c_float,
  "int": C.c_int,
  "char": C.c_char,
  "mjtByte": C.c_ubyte,
  "mjtBool": C.c_bool,
  "mjtSize": C.c_int64,
  "uint64_t": C.c_uint64,
  "uintptr_t": C.c_size_t,
  "size_t": C.c_size_t,
  "unsigned int": C.c_uint,
  "unsigned char": C.c_ubyte,
}
_NUMBERS = frozenset(_SCALAR.values()) - {C.c_char}


def _ctype(declared: Any) -> type:
  if isinstance(declared, ast_nodes.PointerType):
    return C.c_void_p
  if isinstance(declared, ast_nodes.ArrayType):
    out: Any = _ctype(declared.inner_type)
    for extent in reversed(declared.extents):
      out = out * extent
    return out
  if not hasattr(declared, "name"):  # anonymous struct
    fields = [(f.name, _ctype(f.type)) for f in declared.fields]
    return type("anonymous", (C.Structure,), {"_fields_": fields})
  name = declared.name.removeprefix("struct ")
  if name in _SCALAR:
    return _SCALAR[name]
  return C.c_int if name.startswith("mjt") else _struct(name)


@functools.cache
def _struct(name: str) -> type[C.Structure]:
  known = structs.STRUCTS
  declared = known.get(name) or known.get(name + "_") or known[name.rstrip("_")]
  fields = [(f.name, _ctype(f.type)) for f in declared.fields]
  return type(declared.name, (C.Structure,), {"_fields_": fields})


@functools.cache
def declared(name: str) -> tuple[Any, tuple[int | str, ...]]:
  """Returns type and shape of what mjOption, mjModel or mjData has under a name.

  Of arrays the type is that of their numbers, and sizes are names of the model's.
  """
  every = (field for kind in _KINDS for field in structs.STRUCTS[kind].fields)
  field = next(field for field in every if field.name == name)
  kind: Any = field.type
  if isinstance(kind, ast_nodes.PointerType):
    return _ctype(kind.inner_type), tuple(field.array_extent or ())
  if isinstance(kind, ast_nodes.ArrayType):
    return _ctype(kind.inner_type), tuple(kind.extents)
  return _ctype(kind), (1,)


_KINDS = ("mjOption", "mjModel", "mjData")
Model = _struct("mjModel")
Data = _struct("mjData")
Contact = _struct("mjContact")
_Message = _struct("mjLogMessage")
LogHandler = C.CFUNCTYPE(None, C.c_void_p)
size = C.sizeof


@functools.cache
def library() -> C.CDLL:
  """Returns MuJoCo's shared library, the same that the Python bindings use."""
  folder = pathlib.Path(mujoco.__file__).parent
  names = ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll")
  found = sorted(path for name in names for path in folder.glob(name))
  if not found:
    raise ImportError(f"palpate: no MuJoCo library (libmujoco) in {folder}")
  lib = C.CDLL(str(found[0]))
  lib.mj_getPluginConfig.restype = C.c_char_p
  lib.mj_getPluginConfig.argtypes = [C.c_void_p, C.c_int, C.c_char_p]
  lib.mj_fwdPosition.argtypes = [C.c_void_p, C.c_void_p]
  lib.mj_fwdActuation.argtypes = [C.c_void_p, C.c_void_p]
  lib.mj_kinematics.argtypes = [C.c_void_p, C.c_void_p]
  lib.mj_comVel.argtypes = [C.c_void_p, C.c_void_p]
  lib.mj_projectConstraint.argtypes = [C.c_void_p, C.c_void_p]
  lib._mjPRIVATE_getGlobalLogHandler.restype = C.c_void_p
  lib._mjPRIVATE_setTlsLogHandler.restype = C.c_void_p
  lib._mjPRIVATE_setTlsLogHandler.argtypes = [LogHandler]
  lib.mjp_getPlugin.restype = C.c_void_p
  lib.mjp_getPlugin.argtypes = [C.c_char_p, C.c_void_p]
  lib.mju_warning.argtypes = [C.c_char_p, C.c_char_p]
  lib.mjp_registerPlugin.argtypes = [C.c_void_p]
  lib.mjp_defaultPlugin.argtypes = [C.c_void_p]
  lib.mjp_getPluginAtSlot.restype = C.c_void_p
  lib.mjp_getPluginAtSlot.argtypes = [C.c_int]
  return lib


def warn(text: str):
  """Issues a MuJoCo warning."""
  library().mju_warning(b"%s", f"{NAME}: {text}".encode())


def view(address: int | None, shape: Any, dtype: type = np.float64) -> np.ndarray:
  """Returns the array of `shape` that starts at `address`, without a copy."""
  sizes: tuple[int, ...] = tuple(int(n) for n in np.atleast_1d(shape))
  if not address or 0 in sizes:
    return np.zeros(sizes, dtype)
  size = math.prod(sizes) * np.dtype(dtype).itemsize
  buffer: Any = (C.c_char * size).from_address(address)
  return np.frombuffer(buffer, dtype).reshape(sizes)


class Struct:
  """The mjModel or mjData at an address as the bindings have it: its numbers and its own arrays.

  Args:
    kind: `Model` or `Data`
    address: of it
    model: of an mjData, its mjModel, which has the sizes
  """

  def __init__(self, kind: Any, address: int, model: Any = None):
    self.raw, self.address, self._model = kind.from_address(address), address, model

  def __getattr__(self, name: str) -> Any:
    value = getattr(self.raw, name)
    known = _arrays(type(self.raw).__name__).get(name)
    if known is None:
      return value
    kind, extents = known
    shape = [getattr(self._of(n), n) if isinstance(n, str) else n for n in extents]
    return view(value, shape, kind)

  def _of(self, size: str) -> Any:
    """Returns what has a size."""
    if size.startswith("mj"):
      return mujoco
    return self.raw if self._model is None or hasattr(self.raw, size) else self._model


@functools.cache
def _arrays(kind: str) -> dict[str, tuple[Any, tuple[int | str, ...]]]:
  """Returns type and shape of the arrays of numbers of mjModel or mjData."""
  fields = structs.STRUCTS[kind].fields
  arrays = [f for f in fields if isinstance(f.type, ast_nodes.PointerType) and f.array_extent]
  found = {field.name: declared(field.name) for field in arrays}
  return {n: (np.dtype(c).type, shape) for n, (c, shape) in found.items() if c in _NUMBERS}


def model(address: int) -> Struct:
  """Returns the mjModel at an address."""
  return Struct(Model, address)


def both(model: int, data: int) -> tuple[Struct, Struct]:
  """Returns the mjModel and the mjData at two addresses."""
  m = Struct(Model, model)
  return m, Struct(Data, data, m)


def config(m: Struct, instance: int, key: str) -> str:
  """Returns a plugin instance's configuration value, empty where it is not set."""
  value = library().mj_getPluginConfig(m.address, instance, key.encode())
  return value.decode() if value else ""


def error_text(message: int) -> str | None:
  """Returns the text of a log message at an address if it is of an error, or None."""
  found: Any = _Message.from_address(message)
  if found.level != _ERROR:
    return None
  text = found.subject.decode(errors="replace")
  return f"{found.func.decode()}: {text}" if found.func else text


def warnings(data: int) -> memoryview:
  """Returns last index and count of each of the warnings of the mjData at an address, in turn."""
  count = len(Data.from_address(data).warning)
  return view(data + Data.warning.offset, 2 * count, np.int32).data


class Identity:
  """Tells an mjModel from others that take its address when it is freed.

  Arrays lie in one buffer and where in it follows from the sizes at the start of the struct: as
  long as both are the same, views of the arrays are right.
  """

  def __init__(self, model: int):
    self.address = model
    fields: Any = Model
    self._sizes = view(model, fields.opt.offset, np.uint8).data
    self._buffer = view(model + fields.buffer.offset, 1, np.uintp).data
    self._were, self._lay = self._sizes.tobytes(), self._buffer[0]

  def is_of(self, model: int) -> bool:
    """Returns whether views made for this model are right for the living one at an address."""
    same = model == self.address and self._buffer[0] == self._lay
    return same and self._sizes.tobytes() == self._were


def name_of(m: Struct, kind: str, index: int) -> str:
  """Returns the name of a flex, body, geom, ... of an mjModel."""
  start = int(getattr(m, f"name_{kind}adr")[index])
  return C.string_at(m.raw.names + start).decode()


def check():
  """Raises ImportError for a MuJoCo out of range, or where the bindings' arrays are elsewhere."""
  try:
    needs = importlib.metadata.requires("palpate") or ()
  except importlib.metadata.PackageNotFoundError:  # sources on the path, which are not installed
    needs = ()
  for text in needs:
    need = requirements.Requirement(text)
    if need.name == "mujoco" and not need.specifier.contains(mujoco.__version__, prereleases=True):
      raise ImportError(
        f"mujoco is {mujoco.__version__}, expected {need.specifier}: pip install '{need}'"
      )
  m = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
  )
  d = mujoco.MjData(m)
  for owner, struct in ((m, Model), (d, Data)):
    raw = struct.from_address(owner._address)
    for field, ctype in cast(list[tuple[str, type]], struct._fields_):
      array = getattr(owner, field, None)
      # Empty and unallocated arena arrays have placeholder addresses in the bindings.
      if ctype is not C.c_void_p or not isinstance(array, np.ndarray) or array.size == 0:
        continue
      if getattr(raw, field) and array.__array_interface__["data"][0] != getattr(raw, field):
        version = importlib.metadata.version("mujoco")
        raise ImportError(
          f"palpate: {struct.__name__}.{field} of mujoco {version} is not where its introspection "
          "data says; install a version that palpate was run with (3.17, 4.0)"
        )
