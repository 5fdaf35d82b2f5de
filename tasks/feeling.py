"""What a hand that searches remembers: where it has felt, and how stiff it was."""

import numpy as np

LEFT = 0.02  # force below which a press has ended [N]
DEEP = 0.0028  # what tells enough [m]
APART = 0.014  # how far from what was felt a place is left to feel [m]
BESIDE, NEAR = 0.008, 0.005  # what lies beside a place, and counts as there [m]
NOT_YET, BEYOND = -1, -2  # of the sides of a place
SOFT = 0.25  # share of the places felt that are softer than what counts as soft [-]


class Notes:
  """Stiffness by place, of presses deep enough to tell.

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
    self._deepest, self._depth = 0, 0.0

  def press(self, tip: np.ndarray, force: float) -> None:
    """Follows a press with a force [N]; each counts once, where it was deepest."""
    if force < LEFT:
      self._depth = 0.0
      return
    k = int(np.square(self.places - tip).sum(axis=1).argmin())
    depth = float((self.places[k] - tip) @ self._outward[k])
    if depth > max(self._depth, DEEP):
      if self._depth:
        self.stiffness[self._deepest] = 0.0
      self._deepest, self._depth, self.stiffness[k] = k, depth, force / depth

  def felt(self) -> dict[int, float]:
    """Returns the stiffness of the places that were felt [N/m]."""
    return {int(k): float(self.stiffness[k]) for k in np.flatnonzero(self.stiffness)}

  def left(self, tip: np.ndarray) -> int | None:
    """Returns the nearest place that is left to feel, None where none is."""
    near = self.places[self.stiffness > 0]
    gaps = np.linalg.norm(self.places[:, None] - near, axis=2).min(axis=1, initial=np.inf)
    away = np.where(gaps < APART, np.inf, np.linalg.norm(self.places - tip, axis=1))
    k = int(away.argmin())
    return k if away[k] < np.inf else None

  def stiffest(self) -> int | None:
    """Returns the place that felt stiffest, None where nothing was felt."""
    return int(self.stiffness.argmax()) if self.stiffness.any() else None

  def soft(self) -> float:
    """Returns what counts as soft [N/m]."""
    felt = self.stiffness[self.stiffness > 0]
    return float(np.quantile(felt, SOFT, method="lower")) if len(felt) else 0.0

  def around(self) -> np.ndarray:
    """Returns the places that tell of the sides of the stiffest; -1 not yet, -2 beyond  (4,)."""
    top, found = self.stiffest(), np.full(4, NOT_YET)
    if top is None:
      return found
    for i, side in enumerate(self.beside[top]):
      away = np.linalg.norm(self.places - self.places[side], axis=1)
      away[(self.stiffness == 0) | (np.arange(len(away)) == top)] = np.inf
      k = int(away.argmin())
      found[i] = BEYOND if side < 0 else k if away[k] < NEAR else NOT_YET
    return found

  def summary(self) -> np.ndarray:
    """Returns the stiffness of what is soft, of the stiffest, and of its four sides [N/m].

    That is 0 where a side was not felt yet, and -1 N/m beyond the field.
    """
    around, top = self.around(), self.stiffest()
    sides = np.where(around >= 0, self.stiffness[around], np.where(around == BEYOND, -1.0, 0.0))
    return np.array([self.soft(), 0.0 if top is None else self.stiffness[top], *sides])


def beside(places: np.ndarray, up: np.ndarray) -> np.ndarray:
  """Returns the places to the four sides of each, -1 where there is none  (nplace, 4)."""
  across = np.linalg.svd(np.reshape(up, (1, 3)))[2][1:]
  found = np.full((len(places), 4), -1)
  for i, way in enumerate((*across, *-across)):
    gap = np.linalg.norm(places[:, None] + BESIDE * way - places, axis=2)
    nearest = gap.argmin(axis=1)
    there = gap[np.arange(len(places)), nearest] < 0.5 * BESIDE
    found[there, i] = nearest[there]
  return found
