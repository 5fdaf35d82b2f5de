"""Writes what a cut has changed of a solid into the arrays of its body, in place, as `refill`.

Tetrahedra and the places of edges stay. What an edge becomes beside itself goes to places that
wait, so only lists of what has a tetrahedron near the cut are written.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from .. import solid
from ..body import Body, arrays
from ..config import Config
from ..geometry.mesh import Mesh
from ..tets import NAMES, Tets, layout

_READ = (*NAMES, "slot_adr", "around_adr", "edge_adr")


class SolidRefill:
  """The arrays of a solid's body that has room for cuts.

  Args:
    body: the body, with a `Shape` and a `Tissue` of its own
    mesh: what its arrays are of
  """

  def __init__(self, body: Body, mesh: Mesh):
    self._body, self.mesh, self._config = body, mesh, None
    self._arrays, node = arrays(body), body.shape.node.numpy()
    self._here = self._copies()
    self._tets = Tets(mesh, layout(mesh, node, body.shape.nnode), node, self._here)
    if not body.device.is_cuda:
      self._tets.clear(body.system.half)

  def _copies(self) -> dict[str, wp.array]:
    """Returns the arrays on the CPU: copies of what is on a device."""
    return {name: self._arrays[name].to("cpu") for name in _READ}

  def forget(self):
    """Forgets what the arrays hold: others have written into them."""
    self._here = self._copies()
    self._tets.put(self._here)

  def write(self, mesh: Mesh, changed: np.ndarray, config: Config, pinned: np.ndarray):
    """Makes the body that of another mesh.

    Args:
      mesh: of the same whole
      changed: tetrahedra that are not as in the mesh so far
      config: configuration in force
      pinned: vertices that do not move, (nvert,) bool

    Raises:
      ValueError: there is no room for the edges; nothing has changed then.
    """
    if not changed.size:
      return
    moduli = None if config == self._config else solid.moduli(mesh, config)
    if not self._tets.write(mesh, moduli, pinned | mesh.unused, changed):
      raise ValueError("cuts leave no room for edges; give the organ more spare vertices")
    self._config = config
    if self._body.device.is_cuda:
      for name in NAMES:
        self._arrays[name].assign(self._here[name])
      self._body.system.half.zero_()  # of neighbours that are none any more
    self.mesh = mesh
