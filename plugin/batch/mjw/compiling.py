"""Compiles the kernels of a step before it is taken, several at a time.

Launched one after the other, each is compiled as it is met: minutes on a GPU's first step.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from .private import instead, of_threads

_BLOCK = 256  # threads of a block on CUDA where a launch does not say
# Told to who asks how many threads and blocks fill a device: to find out, Warp compiles the kernel.
_FILLING = (_BLOCK, 1)


def compile_ahead(device: wp.Device, works: Iterable[Callable[[], Any]]):
  """Compiles and loads the kernels that some callables launch, which it lets them only name.

  What they copy and fill is done.
  """
  found: dict[tuple[Any, int], None] = {}

  def note(kernel, *args, block_dim: int | None = None, **kwargs):
    if not kernel.is_generic:  # these are known by what they are launched with
      found[kernel.module, block_dim or _BLOCK] = None

  def once(condition, while_body, **kwargs):
    while_body(**kwargs)

  def fill(kernel, device=None):
    return _FILLING

  with instead([
    (wp, "launch", note),
    (wp, "launch_tiled", note),
    (wp, "capture_while", once),
    (wp, "get_suggested_block_size", fill),
  ]):  # fmt: skip
    for work in works:
      work()
  # One pool: `force_load` has one for each size of blocks, and waits for its slowest module.
  with of_threads(), ThreadPoolExecutor(os.cpu_count()) as pool:
    for job in [pool.submit(wp.force_load, device, [each], size, 0) for each, size in found]:
      job.result()
