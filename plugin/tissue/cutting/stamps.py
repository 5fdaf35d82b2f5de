"""Triangles as one number each, and stamps that tell meshes apart, in numbers that a double has."""

import functools
from typing import Any

import numpy as np

_BITS = 17  # of the number of a vertex
MOST = 2**_BITS  # vertices that an organ with room for cuts may have


def pack(elem: np.ndarray, loose: np.ndarray | None = None) -> np.ndarray:
  """Returns corners of triangles and a mark as one number each, exact in a double, (nelem,)."""
  a, b, c = elem.T.astype(float)
  packed = a + 2.0**_BITS * (b + 2.0**_BITS * c)
  return packed if loose is None else packed + 2.0 ** (3 * _BITS) * loose


def unpack(packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the corners of triangles, (nelem, 3), and which are marked, (nelem,) bool."""
  there = np.abs(packed) < 2.0 ** (3 * _BITS + 1)
  whole = np.where(there, packed, 0.0).astype(np.int64)
  return (whole[:, None] >> (_BITS * np.arange(3))) & (MOST - 1), whole >> 3 * _BITS > 0


def stamp(*parts: Any) -> float:
  """Returns a number that tells meshes apart, over 2^50: 48 bits of a sum of words by odd keys."""
  values = np.concatenate([np.ravel(part).astype(float) for part in parts])
  return stamp_of(total(values, slice(None), len(values)))


def total(values: np.ndarray, where: Any, count: int) -> int:
  """Returns the sum that a stamp is made of, of those of `count` numbers that are there."""
  words = values.view(np.uint64)
  return int(((words ^ words >> np.uint64(32)) * _keys(count)[where]).sum())


def stamp_of(total: int) -> float:
  """Returns the stamp of a sum, of which 64 bits count."""
  return float(2**50 + (total % 2**64 >> 16))


@functools.lru_cache(maxsize=8)
def _keys(count: int) -> np.ndarray:
  keys = np.random.Generator(np.random.PCG64(7)).integers(0, 2**64, count, np.uint64)
  return keys | np.uint64(1)
