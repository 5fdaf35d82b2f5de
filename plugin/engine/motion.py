"""Where the motion of an organ is kept: in qpos and qvel, or, with windows, in the plugin state.

Vectors are in the organ's frame, one row a vertex.
"""

from __future__ import annotations

import mujoco
import numpy as np

from . import coupling, workspace
from .workspace import Workspace


class Nodal:
  """Motion of an organ whose vertices are MuJoCo's dofs, but for those inside of a solid."""

  def __init__(self, w: Workspace):
    self._w = w
    self._moving, self._inner = w.organ.jointed, w.organ.inner
    self._qpos = w.organ.qposs.reshape(-1, 3)
    self._dofs = w.organ.dofs.reshape(-1, 3)

  def displacement(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Returns the displacement from rest [m], (nvert, 3)."""
    moved = data.qpos[self._qpos] - model.qpos0[self._qpos] - self._shift
    return self._spread(moved, self._within("disp"))

  @property
  def _shift(self) -> np.ndarray:
    """How far cuts have moved rest positions [m], of the vertices that move."""
    mesh = self._w.organ.mesh
    return (mesh.rest - mesh.whole.rest)[self._moving] if mesh.uncut is not None else np.zeros(3)

  def velocity(self, data: mujoco.MjData) -> np.ndarray:
    """Returns the velocity [m/s], (nvert, 3)."""
    return self._spread(data.qvel[self._dofs], self._within("vel"))

  def contact_force(self, data: mujoco.MjData) -> np.ndarray:
    """Returns the contact force that the organ took in the last step [N], (nvert, 3)."""
    return self._spread(self._within("force"))

  def put(self, model, data, u: np.ndarray | None, v: np.ndarray | None):
    """Sets displacement and velocity of the vertices that move and forgets forces of the past."""
    if u is not None:
      data.qpos[self._qpos] = model.qpos0[self._qpos] + self._shift + u[self._moving]
    if v is not None:
      data.qvel[self._dofs] = v[self._moving]
    kept = [self._within(name).copy() for name in ("disp", "vel")]
    _forget(self._w)
    for name, old, new in zip(("disp", "vel"), kept, (u, v), strict=True):
      self._within(name)[:] = old if new is None else new[self._inner]

  def _within(self, name: str) -> np.ndarray:
    """Returns what the plugin state has of the vertices inside, (n, 3)."""
    return self._w.plugin_state[coupling.spans(self._w.organ)[name]].reshape(-1, 3)

  def _spread(self, values: np.ndarray, within: np.ndarray | float = 0.0) -> np.ndarray:
    out = np.zeros((len(self._w.organ.free), 3))
    out[self._moving] = values
    out[self._inner] = within
    return out


class Windowed:
  """Motion of an organ that MuJoCo knows under its tools only."""

  def __init__(self, w: Workspace):
    self._w = w
    self._nvert = w.organ.mesh.nvert

  def displacement(self, model, data) -> np.ndarray:
    """Returns the displacement from rest [m], (nvert, 3)."""
    return self._own("disp").copy()

  def velocity(self, data) -> np.ndarray:
    """Returns the velocity [m/s], (nvert, 3)."""
    return self._own("vel").copy()

  def contact_force(self, data) -> np.ndarray:
    """Returns the contact force that the organ took in the last step [N], (nvert, 3)."""
    out = np.zeros((self._nvert, 3))
    node = self._w.slots
    used = node >= 0
    out[node[used]] = self._w.host.own.force.numpy()[used]
    return out

  def put(self, model: mujoco.MjModel, data, u: np.ndarray | None, v: np.ndarray | None):
    """Sets displacement and velocity of the vertices that move and forgets forces of the past."""
    w, free = self._w, self._w.organ.free
    new = [self._own("disp").copy(), self._own("vel").copy()]
    for old, values in zip(new, (u, v), strict=True):
      if values is not None:
        old[free] = values[free]
    _forget(w)
    self._own("disp")[:], self._own("vel")[:] = new
    workspace.place(w, model._address)

  def _own(self, name: str) -> np.ndarray:
    """Returns a vector of the motion in the plugin state."""
    workspace.sync(self._w)
    return getattr(self._w.host.own.motion, name).numpy()


def _forget(w: Workspace):
  """Clears the plugin state, but for what has come apart."""
  kept = w.bonds.state.copy() if w.config.bonded else None
  cut = w.cuts.copy()
  w.plugin_state[:] = 0
  w.cuts.put(cut)
  if kept is not None:
    w.bonds.state[:] = kept


def of(w: Workspace) -> Nodal | Windowed:
  """Returns the motion of an organ in an mjData."""
  return Windowed(w) if w.organ.windows else Nodal(w)
