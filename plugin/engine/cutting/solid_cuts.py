"""Cuts of a solid: as those of a surface in `cuts`, by the faces between tetrahedra that are open.

The plugin state has these faces, in the place of triangles that wait, and of each vertex that cuts
have made a corner of a tetrahedron that it has: the rest follows, see `faces.restored`.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
from palpate.tissue.cutting import solid_cut
from palpate.tissue.cutting.cut import Motion
from palpate.tissue.cutting.path import Finder
from palpate.tissue.cutting.resolid import SolidRefill
from palpate.tissue.cutting.surface import WorkingCopy
from palpate.tissue.geometry import faces
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh

from .. import coupling
from ..model import flexes
from . import cuts
from .cuts import Cuts

if TYPE_CHECKING:
  from ..workspace import Workspace


def cuts_of(w: Workspace) -> Cuts:
  """Returns what cuts a workspace's organ."""
  return (SolidCuts if len(w.organ.mesh.tet) else Cuts)(w)


class SolidCuts(Cuts):
  """The mesh of a workspace's solid; false where there is no room for cuts."""

  def __init__(self, w: Workspace):
    super().__init__(w)
    self._ranked: np.ndarray | None = None  # see `_usual`
    self._median = 0.0

  def _make(self):
    self._refill = SolidRefill(self._w.body, self.whole)
    self.finder = Finder(WorkingCopy(self.whole))
    room = coupling.spans(self._w.organ)["corner"]
    self._cleaver = solid_cut.Cleaver(self.whole, self.finder, room.stop - room.start)
    self.seat = np.zeros(0, np.int64)

  def share(self, values: np.ndarray, vert: Any = slice(None)) -> np.ndarray:
    """Returns values by mass, see `Cuts.share`; what comes from inside has them as the skin."""
    out = np.where(
      self.source[vert] >= self.whole.nskin,
      self.mass[vert] * self._usual(values),
      super().share(values, vert),
    )
    return np.where(self.mass[vert] > 0, out, values[vert])

  def _usual(self, values: np.ndarray) -> float:
    """Returns the median of what vertices of the skin have for a mass."""
    if values is not self._ranked:
      was, n = self.declared.mass, self.whole.nouter
      ratio = np.sort(values[:n] / np.maximum(was[:n], 1e-300))
      self._ranked, self._median = values, ratio[n // 2]
    return self._median

  def _read(self) -> tuple:
    whole, own, n = self.whole, self._own, self.whole.nelem
    if not self._found[0]:
      found = faces.grown(self.mesh, whole.rest, whole.tet, whole.of_tet)
      return *found, self.declared.mass, np.arange(whole.nvert)
    corner, rest, mass = own["corner"], own["place"].reshape(-1, 3).copy(), own["weight"].copy()
    face, seat = (np.rint(np.clip(each[each > 0], 0, 2.0**52)).astype(np.int64) - 1
                  for each in (corner[n:], own["source"]))  # fmt: skip
    try:
      if flexes.stamp(self._words) != self._found[0]:
        raise ValueError
      tet = faces.restored(whole, rest, face, seat)
      of_tet = np.concatenate([whole.of_tet, faces.corners(face)])
      mesh, changed = faces.grown(self.mesh, rest, tet, of_tet)
    except ValueError:
      raise ValueError(cuts.FOREIGN) from None
    loose = np.append(flexes.unpack(corner[:n])[1], np.ones(len(face), bool))
    source = np.arange(whole.nvert)
    source[whole.spares][: len(seat)] = whole.tet.ravel()[seat]
    self.seat = seat
    return dataclasses.replace(mesh, loose=loose), changed, mass, source

  def _write(self, found: solid_cut.Cut, vert: np.ndarray):
    own, mesh, n = self._own, self.mesh, self.whole.nelem
    self._sit(found)
    face = faces.opened(mesh)
    assert mesh.loose is not None
    corner = np.zeros(len(own["corner"]))
    corner[:n] = flexes.pack(mesh.elem[:n], mesh.loose[:n])
    corner[n : n + len(face)] = face + 1
    new, words = np.concatenate([corner, mesh.rest.ravel(), self.mass]), self._words
    at, count = np.flatnonzero(new != words), len(words)
    if self._total is None:
      self._total = flexes.total(words, slice(None), count)
    self._total += flexes.total(new[at], at, count) - flexes.total(words[at], at, count)
    words[at] = new[at]
    own["source"][:] = 0.0
    own["source"][: len(self.seat)] = self.seat + 1
    self.stamp = self._found[0] = flexes.stamp_of(self._total)

  def _sit(self, found: solid_cut.Cut):
    """Notes a corner of each vertex that cuts have made."""
    first = self.whole.nouter
    seat = np.zeros(found.mesh.nouter - first, np.int64)
    seat[: len(self.seat)] = self.seat
    new = found.member >= first
    seat[found.member[new] - first] = found.seat[new]
    self.seat = seat

  def _touched(self, mesh: Mesh, changed: np.ndarray) -> np.ndarray:
    return topology.distinct(self.mesh.tet[changed], mesh.tet[changed])

  def _find(self, motion: Motion, points, given: float, depth, direction) -> solid_cut.Cut:
    w, organ, mesh = self._w, self._w.organ, self.mesh
    if mesh.uncut is None:
      self.seat = np.zeros(0, np.int64)
    if direction is not None:
      direction = np.asarray(direction, float) @ organ.frame
    how = ~organ.free, depth, direction, w.config, given
    return self._cleaver.cut(organ.name, mesh, motion, points, *how)

  def _report(self, found: solid_cut.Cut) -> cuts.Report:
    organ = self._w.organ
    path = [organ.origin + line @ organ.frame.T for line in found.path]
    nodes = found.mesh.nouter - self.mesh.nouter
    return cuts.Report(
      found.length, found.area, path, found.deviation, nodes, found.stopped, found.depth
    )
