"""Compiles the kernels of a step before it is taken, several at a time.

Launched one after the other, each is compiled as it is met: minutes on a GPU's first step.
"""

from __future__ import annotations

import collections
import os
from collections.abc import Callable, Iterable
from typing import Any

import warp as wp

from .private import instead

_BLOCK = 256  # threads of a block on CUDA where a launch does not say


def compile_ahead(device: wp.Device, works: Iterable[Callable[[], Any]]):
  """Compiles and loads the kernels that some callables launch, which it lets them only name.

  What they copy and fill is done.
  """
  found: dict[int, dict[Any, None]] = collections.defaultdict(dict)

  def note(kernel, *args, block_dim: int | None = None, **kwargs):
    if not kernel.is_generic:  # these are known by what they are launched with
      found[block_dim or _BLOCK][kernel.module] = None

  def once(condition, while_body, **kwargs):
    while_body(**kwargs)

  with instead([(wp, "launch", note), (wp, "launch_tiled", note), (wp, "capture_while", once)]):
    for work in works:
      work()
  for block_dim, modules in found.items():
    wp.force_load(device, [*modules], block_dim, max_workers=os.cpu_count())
