"""What a hand that searches remembers: where it has felt, and how stiff it was."""

import numpy as np

LEFT = 0.02  # force below which a press has ended [N]
DEEP = 0.0028  # what tells enough [m]
APART = 0.014  # how far from what was felt a place is left to feel [m]
BESIDE, NEAR = 0.008, 0.005  # what lies beside a place, and counts as there [m]
SOFT = 0.25  # share of the places felt that are softer than what counts as soft [-]
STIFF = 1.6  # times that: what is felt around, before anything else [-]
WIDTH = 1.2  # of the bell of stiffness above an inclusion, over its radius [-]
NOISE = 8.0  # of what is felt: triangles differ [N/m]


class Notes:
  """Stiffness by place, of presses deep enough to tell, and what follows from it.

  Attributes:
    stiffness: force over depth, 0 where nothing was felt  (nplace,) [N/m]
    beside: places to the four sides of each, -1 beyond the field  (nplace, 4)
  """

  def __init__(self, places: np.ndarray, outward: np.ndarray, up: np.ndarray):
    """Remembers nothing yet.

    Args:
      places: that may be felt  (nplace, 3) [m]
      outward: normals there  (nplace, 3)
      up: what the sides are across  (3,)
    """
    self.places, self.beside = places, beside(places, up)
    self._outward, self.stiffness = outward, np.zeros(len(places))
    self._last, self._depth = nearest(places, places.mean(axis=0)), 0.0

  def press(self, tip: np.ndarray, force: float) -> None:
    """Follows a press with a force [N]; each counts once, where it was deepest."""
    if force < LEFT:
      self._depth = 0.0
      return
    k = nearest(self.places, tip)
    depth = float((self.places[k] - tip) @ self._outward[k])
    if depth > max(self._depth, DEEP):
      if self._depth:
        self.stiffness[self._last] = 0.0
      self._last, self._depth, self.stiffness[k] = k, depth, force / depth

  def felt(self) -> dict[int, float]:
    """Returns the stiffness of the places that were felt [N/m]."""
    return {int(k): float(self.stiffness[k]) for k in np.flatnonzero(self.stiffness)}

  def left(self) -> int | None:
    """Returns the place to feel next, None where enough is felt.

    That is a side of what is stiff, or else of those far from all that was felt the nearest to the
    last; the first is in the middle.
    """
    felt = np.flatnonzero(self.stiffness)
    gaps = np.linalg.norm(self.places[:, None] - self.places[felt], axis=2)
    away = np.linalg.norm(self.places - self.places[self._last], axis=1)
    away[gaps.min(axis=1, initial=np.inf) < APART] = np.inf
    k = int(away.argmin())
    if away[k] < np.inf and self.stiffness.max() <= STIFF * self.soft():
      return k
    top = int(self.stiffness.argmax())
    for side in self.beside[top][self.beside[top] >= 0]:
      gaps = np.linalg.norm(self.places[felt] - self.places[side], axis=1)
      if not (gaps[felt != top] < NEAR).any():
        return int(side)
    return None

  def soft(self) -> float:
    """Returns what counts as soft [N/m]."""
    felt = self.stiffness[self.stiffness > 0]
    return float(np.quantile(felt, SOFT, method="lower")) if len(felt) else 0.0

  def expected(self, radius: float) -> np.ndarray:
    """Returns where an inclusion is to be expected  (3,) [m]."""
    felt = np.flatnonzero(self.stiffness)
    more = self.stiffness[felt] - self.soft()
    likely = chance(self.places, felt, more, radius)
    return likely @ self.places / likely.sum()


def chance(places: np.ndarray, felt: np.ndarray, more: np.ndarray, radius: float) -> np.ndarray:
  """Returns how likely an inclusion is under each place, against the likeliest [-]  (nplace,).

  As likely as a bell of stiffness on it, h exp(-(d/w)^2) above what is soft, fits what was felt.

  Args:
    places: where it may be  (nplace, 3) [m]
    felt: which of them were felt  (nfelt,)
    more: stiffness there above what is soft  (nfelt,) [N/m]
    radius: of the inclusion [m]
  """
  distance = np.linalg.norm(places[:, None] - places[felt], axis=2)
  bell = np.exp(-((distance / (WIDTH * radius)) ** 2))
  # What the best height takes off the sum of squares.
  gain = np.maximum(bell @ more, 0.0) ** 2 / np.maximum((bell**2).sum(axis=1), 1e-9)
  return np.exp((gain - gain.max()) / (2 * NOISE**2))


def nearest(places: np.ndarray, point: np.ndarray) -> int:
  """Returns the place nearest to a point."""
  return int(np.linalg.norm(places - point, axis=1).argmin())


def beside(places: np.ndarray, up: np.ndarray) -> np.ndarray:
  """Returns the places to the four sides of each, -1 where there is none  (nplace, 4)."""
  one, two = np.linalg.svd(np.reshape(up, (1, 3)))[2][1:]
  found = np.full((len(places), 4), -1)
  for i, way in enumerate((one, two, -one, -two)):
    gap = np.linalg.norm(places[:, None] + BESIDE * way - places, axis=2)
    nearest = gap.argmin(axis=1)
    there = gap[np.arange(len(places)), nearest] < 0.5 * BESIDE
    found[there, i] = nearest[there]
  return found
