"""The binding: functions of `native/` become Warp kernels, all with one signature.

A kernel takes the number of threads that work on a world, one number that says what to do (a stage,
a flag) and one struct, or where it is; its native function gets the struct, the `Thread` and that
number. So an argument list is written once, as the fields of the struct (`types`). Numbers that
both languages know are written in Python and printed as `constexpr` before the headers.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import pathlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from .types import DIMS

NATIVE = pathlib.Path(__file__).parents[1] / "native"
# Warp modules of the kernels by kind of device, in the order in which they were declared, and the
# constants that any of their kernels knows.
MODULES: dict[str, dict[str, dict[str, int | float]]] = {"cpu": {}, "cuda": {}}


@wp.func_native(snippet="WP_TILE_SYNC();")
def meet_block():
  """Waits for the threads of a block: each then sees what the others have written."""
  ...


@dataclasses.dataclass(frozen=True)
class Kernel:
  """A native function as kernels of Warp: on CUDA a launch brings its struct along.

  On the CPU it says where the struct is: Warp copies and checks what a recorded launch brings in
  every replay, which for a struct of 50 arrays takes as long as small organs' shorter passes.

  Attributes:
    struct: what it takes
    cuda: kernel of nthread, arg, the struct
    cpu: kernel of nthread, arg, an array of one struct
  """

  struct: Any
  cuda: wp.Kernel
  cpu: wp.Kernel

  def on(self, device: wp.Device) -> wp.Kernel:
    """Returns the kernel for a device."""
    return self.cuda if device.is_cuda else self.cpu

  def load(self, device: wp.Device, block_dim: int | None = None):
    """Loads its module on a device, compiling it where the cache has none.

    Args:
      device: where
      block_dim: threads of a block, see `launch`: for others CUDA code is compiled anew
    """
    block_dim = block_dim if device.is_cuda else None
    wp.load_module(self.on(device).module.name, device=device, block_dim=block_dim)

  def launch(
    self, device, nworld: int, nthread: int, arg: int, fields, block_dim: int | None = None
  ):
    """Launches the kernel.

    Args:
      device: where
      nworld: number of worlds
      nthread: threads that work on a world
      arg: what to do
      fields: the struct; what is recorded on the CPU reads it when it is replayed
      block_dim: threads of a block; Warp's choice where None
    """
    device = wp.get_device(device)
    inputs = [nthread, arg, fields if device.is_cuda else _reference(self.struct, fields)]
    dim = nworld, nthread
    wp.launch(self.on(device), dim=dim, inputs=inputs, device=device, block_dim=block_dim)

  def command(self, fields, arg: int = 0) -> wp.Launch:
    """Returns what launches the kernel on the CPU, a thread over a world, as often as is wanted.

    Args:
      fields: the struct, read when it is launched
      arg: what to do
    """
    inputs = [1, arg, _reference(self.struct, fields)]
    return wp.launch(self.cpu, dim=(1, 1), inputs=inputs, device="cpu", record_cmd=True)


def aim(fields, **arrays: np.ndarray):
  """Lets fields of a struct be arrays of the host, of their types, which the caller keeps.

  As by a `wp.array` around each, but at once: that takes 16 us.
  """
  native = fields.__ctype__()
  for name, array in arrays.items():
    assert array.flags.c_contiguous
    getattr(native, name).data = array.ctypes.data


def _reference(struct, fields) -> wp.array:
  """Returns an array of the struct's own memory, which it keeps."""
  address = ctypes.addressof(fields.__ctype__())
  out = wp.array(ptr=address, dtype=struct, shape=1, device="cpu")
  out.fields = fields
  return out


def kernel(
  name: str,
  header: str,
  struct,
  constants: Mapping[str, int | float],
  bounds: tuple[int, int] | int | None = None,
  tag: str = "",
  fast: bool = False,
  own: bool = False,
) -> Kernel:
  """Returns the kernel that calls palpate::name(fields, thread, arg) for each thread.

  Kernels of one header and one kind of device are one Warp module, which is compiled when its first
  kernel is loaded.

  Args:
    name: the native function, a template on the struct
    header: its file in `native/`
    struct: the Warp struct that it takes
    constants: numbers by name that the header knows
    bounds: threads of a block at most, and blocks that a multiprocessor must have room for
    tag: what tells a module from others of the header with other constants
    fast: whether quotients and roots may be off in the last digit on CUDA
    own: whether the function gets what its world has of its own, see `_lead`
  """
  known = tuple(constants.items())

  def native(world: int, tid: int, nthread: int, arg: int, f: struct): ...

  def brought(nthread: int, arg: int, f: struct):
    world, tid = wp.tid()
    native(world, tid, nthread, arg, f)

  def pointed(nthread: int, arg: int, f: wp.array(dtype=struct)):
    world, tid = wp.tid()
    native(world, tid, nthread, arg, f[0])

  native.__name__ = native.__qualname__ = f"{name}_native"
  native.__annotations__["f"] = brought.__annotations__["f"] = struct
  pointed.__annotations__["f"] = wp.array(dtype=struct)
  lead, fields = (f"auto own = f; {_lead(struct, 'own')}", "own") if own else ("", "f")
  call = f"palpate::{name}({fields}, palpate::Thread{{world, tid, nthread}}, arg);"
  native = wp.func_native(f"palpate::Flush flush; {lead}{call}")(native)

  def made(entry, kind: str, bounds) -> wp.Kernel:
    entry.__name__ = entry.__qualname__ = name
    entry.__module__ = module = _module(header, kind, known, tag)
    if fast and kind == "cuda":
      wp.set_module_options({"fast_math": True}, module)
    return wp.kernel(enable_backward=False, launch_bounds=bounds, module=module)(entry)

  return Kernel(struct, made(brought, "cuda", bounds), made(pointed, "cpu", None))


# The first sizes of arrays with a row a world, where "*" may be one row of all, and "nlump" none.
# And what says a world's row of others.
_WORLDS = "nworld", "*", "nlump"
_ROW = {"nrow": "row", "nmesh": "mesh"}


def _lead(struct, path: str) -> str:
  """Returns C++ that leads the arrays of a struct, and of structs in it, to their world's rows.

  These are rows of arrays whose first size is in `_WORLDS` or `_ROW`.
  """
  arrays: dict[str, list[str]] = {}
  text = ""
  for name, var in struct.vars.items():
    dims = DIMS[struct.key].get(name)
    if dims:
      size = "nworld" if dims[0] in _WORLDS else dims[0]
      arrays.setdefault(size, []).append(f"{path}.{name}")
    elif isinstance(var.type, type(struct)):
      text += _lead(var.type, f"{path}.{name}")
  for size in (*_ROW, "nworld"):  # the world's row is known until it is led there itself
    row = f"palpate::own_row({path}.{_ROW[size]}, world)" if size in _ROW else "world"
    if size in arrays:
      text += f"palpate::move_each({', '.join([row, *arrays[size]])}); "
  return text


@functools.cache
def _module(header: str, kind: str, constants: tuple, tag: str) -> str:
  """Declares the Warp module of a header for one kind of device and returns its name."""
  name = f"palpate.{kind}.{header.removesuffix('.h').replace('/', '.')}{tag}"
  known = MODULES[kind].setdefault(name, {})
  known |= dict(constants)
  options = wp.ModuleBuildOptions(**{f"extra_{kind}_preamble": _constexpr(known) + _text(header)})
  wp.set_module_options({"extra_build_options": options, "enable_backward": False}, name)
  return name


def longest_first(kind: str) -> list[str]:
  """Returns the modules for a kind of device, those with the longest text first.

  These take longest to compile: where some are compiled at once, none is then left over at the end.
  """

  def length(name: str) -> int:
    options = wp.get_module_options(name)["extra_build_options"]
    return len(getattr(options, f"extra_{kind}_preamble"))

  return sorted(MODULES[kind], key=length, reverse=True)


def _constexpr(constants: Mapping[str, int | float]) -> str:
  """Returns C++ that declares numbers under their Python names."""
  lines = [
    f"constexpr float {name} = {value!r}f;"
    if isinstance(value, float)
    else f"constexpr int {name} = {int(value)};"
    for name, value in constants.items()
  ]
  return "\n".join(["namespace palpate {", *lines, "}\n"])


def _text(header: str, seen: set[str] | None = None) -> str:
  """Returns a header with those that it includes in their places, each once.

  Warp's cache names a module by its text and options. A path among them, as of a folder of headers,
  would have every checkout and environment compile its own.
  """
  seen = seen or set()
  seen.add(header)

  return "".join(
    part if i % 2 == 0 else "" if part in seen else _text(part, seen)
    for i, part in enumerate(_parts(header))
  )


@functools.cache
def _parts(header: str) -> list[str]:
  """Returns a header's text where every second entry is the name of a header to include there."""
  text = (NATIVE / header).read_text(encoding="utf-8").replace("#pragma once\n", "")
  return re.split(r'^#include "([\w/]+\.h)"\n', text, flags=re.M)
