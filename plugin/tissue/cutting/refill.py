"""Writes what a cut has changed into the arrays of a body, in place: recorded graphs go on.

Numbers of triangles, hinges and nodes stay, and rows have room (`rows.room`): so only what has a
triangle near the cut is written anew, as it was written first.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from .. import shape, step
from ..body import Body, arrays
from ..config import Config
from ..geometry.mesh import Mesh
from ..rows import NAMES, Rows
from .surface import WorkingCopy


class Refill:
  """The arrays of a body that has room for cuts.

  Args:
    body: the body, with a `Shape` and a `Tissue` of its own, of the whole mesh
    copy: where native code reads meshes
  """

  def __init__(self, body: Body, copy: WorkingCopy):
    self._body = body
    self.mesh = copy.whole
    self._arrays = arrays(body)
    self._rows = Rows(copy, self._here(), body.shape.node.numpy())

  def _here(self) -> dict[str, wp.array]:
    """Returns the arrays on the CPU: copies of what is on a device."""
    names = (*NAMES, "slot_adr", "bend_adr")
    return {name: self._arrays[name].to("cpu") for name in names}

  def forget(self):
    """Forgets what the arrays hold: others have written into them."""
    self._rows.put(self._here())

  def write(self, mesh: Mesh, changed: np.ndarray, config: Config, pinned: np.ndarray):
    """Makes the body that of another mesh.

    Args:
      mesh: of the same whole
      changed: triangles that are not as in the mesh so far
      config: configuration in force
      pinned: vertices that do not move, (nvert,) bool

    Raises:
      ValueError: the bending matrix has no room; nothing has changed then.
    """
    if not changed.size:
      return
    before, loosened = self.mesh.elem[changed], mesh.loose is not self.mesh.loose
    if not self._rows.write(mesh, config, pinned, changed, before, loosened):
      raise ValueError("cuts that meet leave no room in the bending matrix")
    if self._body.device.is_cuda:
      for name in NAMES:
        self._arrays[name].assign(getattr(self._rows.fields, name))
    old, self.mesh = self.mesh, mesh
    if mesh.closed != old.closed:
      shape.renumber(self._body, config, mesh.closed)
    if self._body.levels is not None and (mesh.uncut is None) != (old.uncut is None):
      shape.rerate(self._body.levels, mesh)
    step.calibrate(self._body)
