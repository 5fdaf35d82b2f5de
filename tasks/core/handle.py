"""An exercise by handle: the action says where the hand holds the instrument.

A row of an action has a component for each of `ROW`, then those of the jaws or the report; all of
them are in [-1, 1]. An action is one row, or several that are evenly spaced over the control step;
the handle moves in straight lines from row to row, so that one for each step of the physics says
all, and that is what a live exercise records.
"""

import math
from collections.abc import Callable

import numpy as np

# Place of the handle in the world [m], and its orientation.
ROW = ("x", "y", "z", "qw", "qx", "qy", "qz")


class Guide:
  """Takes a handle along the rows of an action.

  Attributes:
    row: where the handle is
    live: fills a row of the action when it is its turn, in place; None where they are known ahead
  """

  def __init__(self):
    self.row = np.zeros(len(ROW))
    self.live: Callable[[np.ndarray, int], None] | None = None
    self._rows, self._before = np.zeros((0, len(ROW))), self.row

  def put(self, pose: np.ndarray) -> None:
    """Starts anew at a pose  (7,)."""
    self.row = np.array(pose)
    self._rows = np.zeros((0, len(pose)))

  def follow(self, rows: np.ndarray) -> None:
    """Takes the rows of an action  (n, 7 or more)."""
    self._rows, self._before = rows, self.row

  def advance(self, k: int, count: int, h: float) -> tuple[np.ndarray, list[float], list[float]]:
    """Returns row, velocity [m/s] and angular velocity [rad/s] for step k of `count` of h [s]."""
    rows = self._rows
    if self.live is not None:
      self.live(rows, k)
    if not len(rows):
      return self.row, [0.0] * 3, [0.0] * 3
    row = rows[k] if len(rows) == count else self._between((k + 1) / count * len(rows))
    now, then = row.tolist(), self.row.tolist()
    now[3:7] = unit(now[3:7], then[3:7])
    self.row = np.array(now)
    return self.row, [(a - b) / h for a, b in zip(now[:3], then[:3], strict=True)], spin(
      then[3:7], now[3:7], h
    )  # fmt: skip

  def _between(self, at: float) -> np.ndarray:
    """Returns the row `at` rows behind where the action began; rows are at 1, 2, ..."""
    i = min(math.ceil(at - 1e-9), len(self._rows)) - 1
    end, start = self._rows[i], self._rows[i - 1] if i else self._before
    if len(start) < len(end):  # where the episode begins there are only poses
      start = np.concatenate([start, end[len(start) :]])
    if start[3:7] @ end[3:7] < 0:
      start = np.concatenate([start[:3], -start[3:7], start[7:]])
    return start + (at - i) * (end - start)


def unit(quat: list[float], like: list[float]) -> list[float]:
  """Returns a quaternion of length 1, of the two of a rotation the one nearer to another."""
  w, x, y, z = quat
  length = math.sqrt(w * w + x * x + y * y + z * z)
  if length < 1e-6:
    return like
  sign = w * like[0] + x * like[1] + y * like[2] + z * like[3]
  scale = math.copysign(1 / length, sign)
  return [w * scale, x * scale, y * scale, z * scale]


def spin(first: list[float], second: list[float], h: float) -> list[float]:
  """Returns the angular velocity in the world between two unit quaternions h [s] apart [rad/s].

  Exact to second order in the angle: 2 Im(q2 conj(q1)) / h.
  """
  a, b, c, d = first
  w, x, y, z = second
  scale = 2 / h
  return [
    scale * (x * a - w * b - y * d + z * c),
    scale * (y * a - w * c - z * b + x * d),
    scale * (z * a - w * d - x * c + y * b),
  ]
