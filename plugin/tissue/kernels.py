"""The binding: functions of `native/*.h` become Warp kernels, all with one signature.

A kernel takes the number of threads that work on a world, one number that says what to do (a stage,
a flag) and one struct; its native function gets the struct, the `Thread` and that number. So an
argument list is written once, as the fields of the struct (`types`). Numbers that both languages
know are written in Python and printed as `constexpr` before the headers.
"""

from __future__ import annotations

import functools
import pathlib
import re
from collections.abc import Mapping

import warp as wp

NATIVE = pathlib.Path(__file__).parents[1] / "native"
MODULES: list[str] = []  # Warp modules of the kernels, in the order in which they were declared


def kernel(
  name: str,
  header: str,
  struct,
  constants: Mapping[str, int | float],
  bounds: tuple[int, int] | int | None = None,
  tag: str = "",
  fast: bool = False,
) -> wp.Kernel:
  """Returns the kernel that calls palpate::name(fields, thread, arg) for each thread.

  Its arguments are nthread, arg and the struct, its launch dimension (nworld, nthread). Kernels of
  one header are one Warp module, which is compiled when its first kernel is loaded.

  Args:
    name: the native function, a template on the struct
    header: its file in `native/`
    struct: the Warp struct that it takes
    constants: numbers by name that the header knows
    bounds: threads of a block at most, and blocks that a multiprocessor must have room for
    tag: what tells a module from others of the header with other constants
    fast: whether quotients and roots may be off in the last digit on CUDA
  """
  module = _module(header, tuple(constants.items()), tag)
  if fast:
    wp.set_module_options({"fast_math": True}, module)
  call = f"palpate::{name}(f, palpate::Thread{{world, tid, nthread}}, arg);"

  def native(world: int, tid: int, nthread: int, arg: int, f: struct): ...

  def entry(nthread: int, arg: int, f: struct):
    world, tid = wp.tid()
    native(world, tid, nthread, arg, f)

  native.__name__ = native.__qualname__ = f"{name}_native"
  entry.__name__ = entry.__qualname__ = name
  for function in (native, entry):
    function.__annotations__["f"] = struct
    function.__module__ = module
  native = wp.func_native(call)(native)
  return wp.kernel(enable_backward=False, launch_bounds=bounds, module=module)(entry)


@functools.cache
def _module(header: str, constants: tuple, tag: str) -> str:
  """Declares the Warp module of a header and returns its name."""
  name = f"palpate.native.{header.removesuffix('.h')}{tag}"
  preamble = _constexpr(dict(constants)) + f'\n#include "{header}"\n'
  options = wp.ModuleBuildOptions(
    extra_cpu_include_dirs=[str(NATIVE)],
    extra_cuda_include_dirs=[str(NATIVE)],
    extra_cpu_preamble=preamble,
    extra_cuda_preamble=preamble,
    extra_build_dependencies=[str(NATIVE / each) for each in _includes(header)],
  )
  wp.set_module_options({"extra_build_options": options, "enable_backward": False}, name)
  MODULES.append(name)
  return name


def _constexpr(constants: Mapping[str, int | float]) -> str:
  """Returns C++ that declares numbers under their Python names."""
  lines = [
    f"constexpr float {name} = {value!r}f;"
    if isinstance(value, float)
    else f"constexpr int {name} = {int(value)};"
    for name, value in constants.items()
  ]
  return "\n".join(["namespace palpate {", *lines, "}"])


def _includes(header: str) -> list[str]:
  """Returns the header and those that it includes, each once."""
  found, wanted = [], [header]
  while wanted:
    name = wanted.pop()
    if name not in found:
      found.append(name)
      wanted += re.findall(r'#include "(\w+\.h)"', (NATIVE / name).read_text())
  return sorted(found)
