"""Passive forces: what acts on an organ beside its tissue, and the table of all kinds.

A kind is a `Force` over a `Host`, so it acts in one world of the plugin and in the worlds of a
batch alike, and costs nothing where it is not used. The kernels are in `native/forces`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, TypeVar

import numpy as np
from palpate.tissue.cutting.facets import Path
from palpate.tissue.cutting.path import Finder
from palpate.tissue.cutting.topology import Report
from palpate.tissue.geometry.mesh import Mesh

from .host import Host, Twin

Springs = tuple[np.ndarray, np.ndarray, np.ndarray]  # vertices, stiffness [N/m], stretch [m]


class Opening:
  """An organ whose meshes forces let come apart, in one world or in many.

  Attributes:
    finder: of places on its surface
  """

  finder: Finder

  def begin(self, worlds: list[int]):
    """Prepares worlds, which `disp` and `cut` are asked of."""

  def mesh(self, world: int) -> Mesh:
    """Returns the mesh of a world as it is now."""
    raise NotImplementedError

  def disp(self, world: int) -> np.ndarray:
    """Returns the displacements of its vertices in the organ's frame [m], (nvert, 3)."""
    raise NotImplementedError

  def cut(self, world: int, path: Path) -> Report:
    """Cuts a world along a path; ValueError where that cannot be."""
    raise NotImplementedError

  def burn(self, current: Any):
    """Lets the bonds of one world feel a current; in a batch they do so in each step."""

  def finish(self):
    """Ends what `begin` has begun."""


class Force:
  """What acts on an organ beside its tissue, in all worlds of its host; by itself nothing.

  Args:
    host: the organ

  Attributes:
    KEYS: configuration keys that ask for it
    ENTER, ACT, END: kernels of `enter`, `act` and `end`, None for nothing
    host: the organ
    fields: what they take, made by `bind`
    count: items of a world that their threads share; 0 for a thread a world
    followers: forces of this kind of other organs, which lead to this one
  """

  KEYS: ClassVar[tuple[str, ...]]
  ENTER: ClassVar[Twin | None] = None
  ACT: ClassVar[Twin | None] = None
  END: ClassVar[Twin | None] = None

  def __init__(self, host: Host):
    self.host = host
    self.fields: Any = None
    self.count = 0
    self.followers: list[Force] = []

  def __bool__(self) -> bool:
    return True

  @property
  def aims(self) -> bool:
    """Whether it has to know where bodies are as a step begins: they may move."""
    return False

  @property
  def weighs(self) -> bool:
    """Whether it adds to MuJoCo's inertia of bodies."""
    return False

  def take(self, declared: Force, twin: Any):
    """Takes what the same force of another mjData has; `twin` returns this one's of that's."""

  def bind(self):
    """Points the kernels at the host's arrays."""

  def enter(self):
    """Adds to the solver's input, after a coupling has filled it."""
    self._launch(self.ENTER)

  def bear(self, other: Force):
    """Adds to the input of another organ to which it leads, given the force of this kind there."""

  def act(self):
    """Lets bodies feel what has acted."""
    self._launch(self.ACT)

  def end(self):
    """Keeps what the step has made of it."""
    self._launch(self.END)

  def open(self, opening: Opening, steps: int = 1) -> bool:
    """Lets meshes come apart where they have to, `steps` after the last time; returns whether."""
    return False

  def _launch(self, kernel: Twin | None):
    if self and kernel is not None:
      self.host.launch(kernel, self.fields, self.count)

  def follow(self, other: Force):
    """Lets it be launched, bound and reshaped with another organ, to which it leads."""
    if self not in other.followers:
      other.followers.append(self)

  # What follows the mesh of a world.

  def carry(self, world: int, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """Gives vertices that a cut has divided their part of what the plugin state has of them.

    Args:
      world: the world
      group: of vertices that were one, which  (n,)
      member: those vertices                   (n,)
      share: their part of its area            (n,)
    """

  def reshape(self, world: int):
    """Follows the meshes of a world, which was cut or has healed."""

  def springs(self, world: int) -> list[Springs]:
    """Returns vertices, stiffness [N/m] and stretch in the organ's frame [m] of its springs."""
    return []


Kind = TypeVar("Kind", bound=Force)


class Forces:
  """The passive forces of an organ, in the order in which they act.

  Args:
    host: the organ
    kinds: of forces
  """

  def __init__(self, host: Host, kinds: dict[str, type[Force]]):
    self.host = host
    self._each: list[Any] = [kind(host) for kind in kinds.values()]

  def __iter__(self) -> Iterator[Any]:
    return iter(self._each)

  def __bool__(self) -> bool:
    return any(self._each)

  def of(self, kind: type[Kind]) -> Kind:
    """Returns the force of a kind."""
    (found,) = (each for each in self._each if type(each) is kind)
    return found

  def take(self, declared: Forces, twin: Any):
    """Takes what an organ has in another mjData; `twin` returns a force here of one there."""
    for each in self._each:
      each.take(declared.of(type(each)), twin)

  def bind(self):
    """Points kernels at the host's arrays; also those of other organs that lead to this one."""
    for each in self._each:
      kernel = each.ENTER or each.ACT or each.END
      if (each or each.followers) and kernel is not None:
        self.host.load(kernel)
      each.bind()
      for follower in each.followers:
        follower.host.bind(self.host.model)  # kernels of this organ read its bodies
        follower.bind()

  def enter(self):
    """Adds to the solver's input."""
    for each in self._each:
      each.enter()
      for follower in each.followers:
        follower.bear(each)

  def act(self):
    """Lets bodies feel what has acted."""
    for each in self._each:
      each.act()

  def end(self):
    """Keeps what the step has made of them."""
    for each in self._each:
      each.end()

  def carry(self, world: int, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """Gives vertices that a cut has divided their part, see `Force.carry`."""
    for each in self._each:
      each.carry(world, group, member, share)

  def reshape(self, world: int):
    """Follows the mesh of a world."""
    for each in self._each:
      for one in (each, *each.followers):
        one.reshape(world)

  def springs(self, world: int) -> list[Springs]:
    """Returns the springs of all, see `Force.springs`."""
    return [springs for each in self._each for springs in each.springs(world)]
