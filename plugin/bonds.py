"""`Bonds`: what an organ has grown on to, and how much of it is free."""

import numpy as np
import numpy.typing as npt
from palpate.engine.layout import BOND
from palpate.engine.workspace import Workspace
from palpate.forces.cohesive_bonds import Group


class Bonds:
  """The bonds of an organ as they are now; none of its arrays is a view.

  Args:
    space: the organ's workspace
  """

  def __init__(self, space: Workspace):
    self._space = space

  @property
  def _groups(self) -> list[Group]:
    return self._space.bonds.groups

  def _all(self, name: str) -> np.ndarray:
    return np.concatenate([np.zeros(0), *(group.now[name] for group in self._groups)])

  @property
  def _state(self) -> np.ndarray:
    slot = self._all("slot").astype(int)
    return self._space.bonds.state[slot] if len(slot) else np.zeros((0, len(BOND)))

  def __len__(self) -> int:
    return len(self.vertices)

  @property
  def count(self) -> int:
    """How many there are, free ones too."""
    return len(self)

  @property
  def vertices(self) -> np.ndarray:
    """Vertex of each, (n,)."""
    return self._all("vert").astype(int)

  @property
  def made(self) -> np.ndarray:
    """Which of the bonds that were made each is, or is a part of since a cut, (n,)."""
    first = np.cumsum([0, *(len(group.grip.vert) for group in self._groups)])
    parts = [group.now["made"] + k for group, k in zip(self._groups, first, strict=False)]
    return np.concatenate([np.zeros(0, int), *parts])

  @property
  def area(self) -> np.ndarray:
    """Area that each stands for [m^2], (n,)."""
    return self._all("area")

  @property
  def damage(self) -> np.ndarray:
    """Of each: 0 while it is whole, 1 when it is free [-], (n,)."""
    return self._state[:, BOND.damage].clip(0.0, 1.0)

  @property
  def free(self) -> np.ndarray:
    """Whether each has broken, (n,) bool."""
    return self.damage >= 1.0

  @property
  def share_freed(self) -> float:
    """Share of the area whose bonds have broken [-]; 0 where there are none."""
    area = self.area
    return float(area[self.free].sum() / area.sum()) if len(area) else 0.0

  @property
  def released(self) -> np.ndarray:
    """Energy that damage has taken of each [J], (n,); its area times `energy` once pulled free."""
    return self._state[:, BOND.released].copy()

  @property
  def energy(self) -> float:
    """Sum of `released` [J]."""
    return float(self.released.sum())

  def weaken(self, amount: npt.ArrayLike):
    """Adds damage, as a hook's current does; what a bond had stored of energy goes with it.

    Args:
      amount: what is added to the damage of each, or of all [-]
    """
    add, count = np.asarray(amount, float), len(self)
    if add.shape not in ((), (count,)):
      raise ValueError(f"amount has shape {add.shape}, expected () or ({count},)")
    if not (add >= 0).all():
      raise ValueError(f"amount is {add.min()}, expected numbers >= 0")
    state, slot = self._space.bonds.state, self._all("slot").astype(int)
    state[slot, BOND.damage] = np.minimum(state[slot, BOND.damage] + add, 1.0)

  @property
  def positions(self) -> np.ndarray:
    """Where their vertices are now [m], (n, 3)."""
    return self._space.host.places(self.vertices)

  @property
  def stretch(self) -> np.ndarray:
    """How far each was from what it leads to as the last step began, in the world [m], (n, 3)."""
    return self._written("stretch")

  def distance(self, start: npt.ArrayLike, end: npt.ArrayLike) -> np.ndarray:
    """Returns how far strands are from a segment, such as a wire's axis [m], (n,).

    A strand goes from what a bond leads to, as the last step began, to its vertex.

    Args:
      start: of the segment, in the world [m]  (3,)
      end: of it [m]  (3,)
    """
    d, e = np.asarray(end, float) - start, self.stretch
    r = start - (self.positions - e)
    dd, de, ee = d @ d, e @ d, (e**2).sum(axis=1)
    dr, er = r @ d, (e * r).sum(axis=1)

    def share(above: np.ndarray, below: np.ndarray) -> np.ndarray:
      return np.divide(above, below, where=below > 0, out=np.zeros(len(e))).clip(0, 1)

    # As `between` of core/geom.h: the nearest point of one line, of the other strand, and back.
    apart = dd * ee - de**2
    s = share(de * er - dr * ee, np.where(apart > 1e-6 * dd * ee, apart, 0.0))
    t = share(de * s + er, ee)
    s = share(de * t - dr, np.full(len(e), dd))
    return np.linalg.norm(r + s[:, None] * d - t[:, None] * e, axis=1)

  @property
  def stored(self) -> float:
    """Elastic energy as the last step began, less what the step's damage took of it [J]."""
    stiffness = np.repeat(
      [g.law.stiffness for g in self._groups], [len(g.now["vert"]) for g in self._groups]
    )
    far2 = (self.stretch**2).sum(axis=1)
    return float((0.5 * stiffness * self.area * (1.0 - self.damage) * far2).sum())

  @property
  def force(self) -> np.ndarray:
    """Force of each on its vertex in the last step, in the world [N], (n, 3)."""
    return self._written("pull")

  def _written(self, name: str) -> np.ndarray:
    parts = [group.arrays[name].numpy()[0, : len(group.now["vert"])] for group in self._groups]
    return np.concatenate([np.zeros((0, 3)), *parts])
