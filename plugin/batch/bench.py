"""Where worlds are cut: several at once, each on a thread and in memory of its own."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from palpate.tissue import cut as cutting
from palpate.tissue.body import Body
from palpate.tissue.mesh import Mesh
from palpate.tissue.meshes import Meshes
from palpate.tissue.path import Finder
from palpate.tissue.rows import Rows
from palpate.tissue.surface import WorkingCopy

# Threads at most: what is native runs beside what is Python, of which there is half as much.
MOST = 4
T = TypeVar("T")


class Bench:
  """Finds cuts and writes them into rows of meshes, one world after the other.

  Args:
    whole: the mesh before the first cut
    meshes: of the worlds
    still: the tissue of one world on the CPU

  Attributes:
    knife: finds cuts
    finder: finds places of a surface
    rows: writes what follows from a mesh
  """

  def __init__(self, whole: Mesh, meshes: Meshes, still: Body):
    copy = WorkingCopy(whole)
    self.knife, self.finder = cutting.Knife(copy), Finder(copy)
    starts = {"slot_adr": still.shape.slot_adr, "bend_adr": still.shape.bend_adr}
    self.rows = Rows(copy, meshes.arrays | starts, still.shape.node.numpy())


class Benches:
  """Some benches, on a thread each.

  Args:
    make: makes one
  """

  def __init__(self, make: Callable[[], Bench]):
    self._make, self._there = make, [make()]
    self._most = min(MOST, os.cpu_count() or 1)
    self._pool: ThreadPoolExecutor | None = None

  @property
  def first(self) -> Bench:
    """The bench for what is done alone."""
    return self._there[0]

  def each(self, work: Callable[[Bench, int], T], count: int) -> list[T]:
    """Does work(bench, k) for k in range(count), several at once; returns what it returned."""
    n = min(self._most, count)
    if n < 2:
      return [work(self.first, k) for k in range(count)]
    while len(self._there) < n:
      self._there.append(self._make())
    if self._pool is None:
      self._pool = ThreadPoolExecutor(self._most)

    def part(i: int) -> list[T]:
      return [work(self._there[i], int(k)) for k in parts[i]]

    parts = np.array_split(np.arange(count), n)
    return [each for found in self._pool.map(part, range(n)) for each in found]
