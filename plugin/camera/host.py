"""What cameras look at: worlds with bodies and organs. A batch is one, an mjData another."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import mujoco
import numpy as np
import warp as wp
from palpate.engine import coupling
from palpate.engine import plugin as engine
from palpate.engine.cutting import cuts as cutting
from palpate.engine.workspace import Workspace
from palpate.organ import Organ, instances
from palpate.tissue.geometry.mesh import Mesh


class Seen(Protocol):
  """An organ in worlds, see `palpate.batch.Tissue`."""

  @property
  def name(self) -> str:
    """Name of the flexcomp."""
    ...

  @property
  def nvert(self) -> int:
    """Number of vertices."""
    ...

  @property
  def space(self) -> Workspace:
    """Its workspace in one mjData."""
    ...

  @property
  def xpos(self) -> wp.array:
    """Positions [m], (nworld, nvert, 3)."""
    ...

  def meshes(self) -> Sequence[Mesh]:
    """Returns the mesh of each world; it is another object once it was cut."""
    ...


class Host(Protocol):
  """Worlds, see `palpate.batch.Batch`."""

  model: mujoco.MjModel
  nworld: int
  device: Any

  @property
  def organs(self) -> Mapping[str, Seen]:
    """The organs by name."""
    ...

  def index(self, world: int) -> int:
    """Returns the number of a world that there is."""
    ...

  def poses(self) -> tuple[wp.array, wp.array, np.ndarray]:
    """Returns where bodies are, see `Batch.poses`."""
    ...


class Single:
  """An mjData as one world, which is seen as it was in its last step.

  Args:
    model: that data is of
    data: the state
    device: where pictures of it are drawn, a Warp device
  """

  nworld = 1

  def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, device: str):
    self.model, self._data, self.device = model, data, wp.get_device(device)
    self._pos = wp.zeros((1, model.nbody), dtype=wp.vec3, device=self.device)
    self._mat = wp.zeros((1, model.nbody), dtype=wp.mat33, device=self.device)
    self.organs = {
      name: _Organ(Organ(model, data, name), engine.find(data._address, number), self.device)
      for name, number in instances(model).items()
    }

  def index(self, world: int) -> int:
    """Returns the number of the world."""
    return world

  def poses(self) -> tuple[wp.array, wp.array, np.ndarray]:
    """Returns where bodies are now, see `Batch.poses`."""
    self._pos.assign(self._data.xpos[None].astype(np.float32))
    self._mat.assign(self._data.xmat.reshape(1, -1, 3, 3).astype(np.float32))
    return self._pos, self._mat, np.arange(self.model.nbody)


class _Organ:
  """An organ of `Single`."""

  def __init__(self, handle: Organ, space: Workspace, device: Any):
    self.space, self._handle = space, handle
    self.name, self.nvert = space.organ.name, coupling.outer(space.organ)
    self._xpos = wp.full((1, self.nvert, 3), float("nan"), dtype=float, device=device)

  @property
  def xpos(self) -> wp.array:
    found = self._handle.xpos
    whole = np.full((1, self.nvert, 3), np.nan, np.float32)
    whole[0, : len(found)] = found
    self._xpos.assign(whole)
    return self._xpos

  def meshes(self) -> list[Mesh]:
    cutting.follow(self.space)
    return [self.space.organ.mesh]
