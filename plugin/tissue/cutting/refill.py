"""Writes what a cut has changed into the arrays of a body, in place: recorded graphs go on.

Numbers of triangles, tetrahedra, hinges, edges and nodes stay, and rows have room (`rows.room`): so
only what is near the cut is written anew, as it was written first.
"""

import numpy as np
import warp as wp

from .. import shape, step
from ..body import Body, arrays
from ..config import Config
from ..geometry.mesh import Mesh
from .facets import Edges


class Refill:
  """The arrays of a body that has room for cuts.

  Args:
    body: the body, with a `Shape` and a `Tissue` of its own, of the whole mesh
    facets: what comes apart
  """

  def __init__(self, body: Body, facets: Edges):
    self._body, self._facets = body, facets
    self.mesh: Mesh = facets.whole
    self._arrays = arrays(body)
    self._names = (*facets.OF_SHAPE, *facets.OF_TISSUE)
    self._here: dict[str, wp.array] = {}
    self.forget()

  def forget(self):
    """Forgets what the arrays hold: others have written into them."""
    names, body = (*self._names, *self._facets.READ), self._body
    self._here = {name: self._arrays[name].to("cpu") for name in names}  # copies of a device's
    half = body.system.half if body.is_solid and not body.device.is_cuda else None
    self._facets.aim(self._here, body.shape.node.numpy(), body.shape.nnode, half)

  def write(self, mesh: Mesh, changed: np.ndarray, config: Config, pinned: np.ndarray):
    """Makes the body that of another mesh.

    Args:
      mesh: of the same whole
      changed: triangles, of a solid tetrahedra, that are not as in the mesh so far
      config: configuration in force
      pinned: vertices that do not move, (nvert,) bool

    Raises:
      ValueError: there is no room for bending, or for edges; nothing has changed then.
    """
    if not changed.size:
      return
    body, old = self._body, self.mesh
    self._facets.write(old, mesh, changed, config, pinned)
    if body.device.is_cuda:
      for name in self._names:
        self._arrays[name].assign(self._here[name])
      body.system.half.zero_()  # of former neighbours
    self.mesh = mesh
    if body.is_solid:
      return
    if mesh.closed != old.closed:
      shape.renumber(body, config, mesh.closed)
    if body.levels is not None and (mesh.uncut is None) != (old.uncut is None):
      shape.rerate(body.levels, mesh)
    step.calibrate(body)
