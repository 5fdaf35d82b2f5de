"""A mesh where native code reads and writes it."""

import dataclasses

import numpy as np

from ..geometry.mesh import Mesh
from ..types import DIMS, allocate, doubles, flags, longs, struct


@struct
class Surface:
  """A surface, cut or not; `Mesh` says what the fields are."""

  nvert: int
  nelem: int
  most: int  # neighbours that a vertex has room for
  rest: doubles("nvert", 3)
  elem: longs("nelem", 3)
  twin: longs("nhalf")
  ring: longs("nvert", "most")
  spoke: longs("nvert", "most")  # `Mesh.ring_elem`
  degree: longs("nvert")
  loose: flags("nelem")
  whole_elem: longs("nelem", 3)
  whole_twin: longs("nhalf")


# Of `Surface` and of `Mesh`, what a cut changes.
_NAMES = {name: name for name in ("rest", "elem", "twin", "ring", "degree")} | {
  "spoke": "ring_elem"
}


class WorkingCopy:
  """The arrays of one mesh after another, all of one whole; of a solid those of its skin.

  Attributes:
    whole: the mesh before the first cut
    fields: what native code takes
    sizes: named sizes of its arrays
  """

  def __init__(self, mesh: Mesh):
    self.whole = whole = mesh.whole
    self._mesh: Mesh | None = None
    sizes = {"nvert": whole.nvert, "nelem": whole.nelem, "most": whole.ring.shape[1]}
    self.sizes = sizes | {"nhalf": 3 * whole.nelem}
    self.fields = allocate(Surface, "cpu", self.sizes)
    for name, value in sizes.items():
      setattr(self.fields, name, value)
    self._host = host_views(self.fields, Surface)
    self._host["whole_elem"][:], self._host["whole_twin"][:] = whole.elem, whole.twin

  def put(self, mesh: Mesh):
    """Makes the arrays those of a mesh."""
    if mesh is self._mesh:
      return
    n = self.whole.nelem
    for name, of_mesh in _NAMES.items():
      values = getattr(mesh, of_mesh)
      self._host[name][:] = values[:n] if name == "elem" else values
    self._host["loose"][:] = 0 if mesh.loose is None else mesh.loose[:n]
    self._mesh = mesh

  def take(self, mesh: Mesh, closed: bool, apart: bool, nouter: int) -> Mesh:
    """Returns the mesh that native code has made of one that was put here.

    Args:
      mesh: that one
      closed: whether there is no boundary edge
      apart: whether it may have come apart, so that `loose` is another
      nouter: vertices on the surface
    """
    arrays = {of_mesh: self._host[name].copy() for name, of_mesh in _NAMES.items()}
    loose = self._host["loose"].astype(bool) if apart else mesh.loose
    more = {"closed": closed, "loose": loose, "uncut": self.whole}
    self._mesh = out = dataclasses.replace(mesh, **arrays, **more)
    vars(out)["nouter"] = nouter
    return out

  def forget(self):
    """Lets the next `put` write everything."""
    self._mesh = None


def host_views(fields, kind) -> dict[str, np.ndarray]:
  """Returns the arrays of a struct on the CPU."""
  return {name: getattr(fields, name).numpy() for name in DIMS[kind.key]}
