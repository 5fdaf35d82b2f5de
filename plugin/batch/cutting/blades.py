"""Geoms that cut an organ of `Worlds`: the plugin's kernels, over rows of worlds.

A blade's path grows on the device. Now and then the host looks at which are long enough, or have
ended, and lets the meshes of those worlds come apart; see `engine.cutting.cutters`.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from palpate.engine.cutting import cutters, trails
from palpate.engine.layout import BLADE, LAW
from palpate.engine.model import mjstruct
from palpate.forces.host import for_worlds, world_kernel
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import allocate, doubles, fill, floats, ints, struct

from .. import host
from .fracture import Cutters

if TYPE_CHECKING:
  from ..organs import Organ

_ROWS = "state", "next", "force", "point", "held", "share", "hold", "due", "law"
_MESH = (
  ("elem", ints("nmesh", "nelem", 3)),
  ("tet", ints("nmesh", "ntet", 4)),
  ("flat", doubles("nmesh", "nnode", 3)),
)
_WorldBlades = for_worlds(cutters.Blades, _ROWS, _MESH)
_enter, _act, _keep = (
  world_kernel(name, "cutting/blades.h", _WorldBlades) for name in cutters.KERNELS
)
_STAGE, _WORK, _OPENED, _AT = (
  wp.constant(k) for k in (BLADE.stage, BLADE.work, BLADE.opened, BLADE.at)
)
_KEEPS = 1  # what is due is kept until it is done


@wp.func
def _turned(f: wp.array2d[wp.float64], c: int, x: wp.float64, y: wp.float64, z: wp.float64):
  return f[c, 0] * x + f[c, 1] * y + f[c, 2] * z


@struct
class Told:
  """Arrays of `Cutters`."""

  inside: floats("nworld", "nblade")
  force: floats("nworld", "nblade", 3)
  energy: floats("nworld", "nblade")
  length: floats("nworld", "nblade")
  seat: floats("nworld", "nblade", 3)


@wp.kernel(enable_backward=False)
def _show(b: _WorldBlades, out: Told):
  """Writes what cutters do, in the world's axes."""
  w, i = wp.tid()
  out.inside[w, i] = wp.where(b.state[w, i, _STAGE] == wp.float64(2.0), 1.0, 0.0)
  out.energy[w, i] = float(b.state[w, i, _WORK])
  out.length[w, i] = float(b.state[w, i, _OPENED])
  f = b.own.frame
  for c in range(3):
    turned = _turned(f, c, b.force[w, i, 0], b.force[w, i, 1], b.force[w, i, 2])
    out.force[w, i, c] = float(turned)
    at = _turned(f, c, b.state[w, i, _AT], b.state[w, i, _AT + 1], b.state[w, i, _AT + 2])
    out.seat[w, i, c] = float(b.own.origin[c] + at)


@wp.kernel(enable_backward=False)
def _feel(b: _WorldBlades, adr: int, data: wp.array2d[float]):
  """Adds the force on the tissue to a sensor."""
  w = wp.tid()
  f = b.own.frame
  for i in range(b.nblade):
    for c in range(3):
      turned = _turned(f, c, b.force[w, i, 0], b.force[w, i, 1], b.force[w, i, 2])
      data[w, adr + c] = data[w, adr + c] + float(turned)


class Blades(host.Opens):
  """What cuts an organ in all worlds.

  Args:
    organ: the organ, which has room for cuts
  """

  def __init__(self, organ: "Organ"):
    super().__init__(organ)
    self.host.need_springs()
    space, body, n = organ.space, organ.body, len(organ.config.cutters)
    self._model = mjstruct.Model.from_address(space.model)
    widths = cutters.WIDTHS.items()
    law = space.cutters.law(self._model, organ.config.thickness)
    values: dict[str, Any] = {
      name: self._zeros(self._nworld, n, wide, dtype=_WorldBlades.vars[name].type.dtype)
      for name, wide in widths
    }
    self._edges = space.cutters.constants()
    values |= self._edges | dict(
      law=np.tile(law, (self._nworld, 1, 1)),
      mesh=organ.patch.mesh,
      elem=organ.patch.elem,
      tet=organ.patch.tet,
      flat=organ.patch.rest,
      state=self.host.rows("blade", len(BLADE)),
      due=self._zeros(self._nworld, n, dtype=int),
      own=_by_nodes(host.nodes_of(organ), body),
      solve=_by_nodes(host.input_of(organ), body),
      number=body.tissue.number,
      mj=organ.batch.bodies,
    )
    self.fields = fill(_WorldBlades, self._device, values)
    self._steps = 0
    sizes = {"nworld": self._nworld, "nblade": n}
    self._told = allocate(Told, self._device, sizes)
    self._out = Cutters(*(getattr(self._told, name) for name in Cutters._fields))

  @property
  def aims(self) -> bool:
    """See `Force`."""
    return True

  def enter(self):
    """See `Force`."""
    self._over(_enter, self.fields, 1, _KEEPS)

  def act(self):
    """See `Force`."""
    self._over(_act, self.fields, 1)

  def end(self):
    """See `Force`."""
    self._over(_keep, self.fields, 1)

  def rest(self):
    """See `Force`."""
    super().rest()
    inputs = [self._mask, self.fields.due]
    wp.launch(_forget, dim=self.fields.due.shape, inputs=inputs, device=self._device)

  def configure(self, worlds: np.ndarray, rows: dict[str, np.ndarray]):
    """See `Force`."""
    if "thickness" not in rows:
      return
    law = self.fields.law.numpy()
    for world, thickness in zip(worlds, rows["thickness"], strict=True):
      law[world] = self._organ.space.cutters.law(self._model, float(thickness))
    self.fields.law.assign(law)

  def feel(self, adr: int, data: wp.array):
    """Adds their force to a sensor of three numbers."""
    wp.launch(_feel, dim=self._nworld, inputs=[self.fields, adr, data], device=self._device)

  def read(self) -> Cutters:
    """Returns what they do."""
    dim, inputs = self._told.inside.shape, [self.fields, self._told]
    wp.launch(_show, dim=dim, inputs=inputs, device=self._device)
    return self._out

  # The meshes come apart.

  def open(self, steps: int):
    """Lets the meshes of worlds come apart along the paths that are long enough, or ended."""
    due, currents = self.fields.due.numpy(), self._organ.space.cutters.by_current
    ctrl = self._organ.batch.d.ctrl.numpy() if currents else None
    state: Any = self.fields.state.numpy() if currents or due.any() else None
    acts = due.any(axis=1)
    for i, current in currents.items():
      acts |= (ctrl[:, current.actuator] > 0) | (state[:, i, BLADE.count] > 0)
    worlds = np.flatnonzero(acts).tolist()
    if not worlds:
      return
    cuts = self._organ.topology
    assert cuts is not None
    law, edge = self.fields.law.numpy(), self._organ.declared.mesh.edge_length
    cuts.follow()
    motion, d = cuts.motion(worlds), self._organ.batch.d
    turn = d.geom_xmat.numpy().astype(float) if currents or self.fields.ntet else np.zeros(0)
    for i, current in currents.items():
      given = steps * float(self._organ.batch.model.opt.timestep) * ctrl[:, current.actuator]
      place = d.geom_xpos.numpy()[:, current.geom].astype(float)
      for k, world in enumerate(worlds):
        row, line = state[world, i], current.line(place[world], turn[world, current.geom])
        burns = given[world] > 0 and self._burn(current, row, world, motion.disp[k], line, given)
        due[world, i] = trails.lay(row, edge) if burns else trails.end(row)
    for k, world in enumerate(worlds):
      for i in np.flatnonzero(due[world]):
        given, ended = (
          trails.GIVEN * float(law[world, i, LAW.force]) * edge,
          due[world, i] == trails.ENDED,
        )
        way = None
        if self.fields.ntet and i not in currents:
          way = trails.along(turn[world], self._edges["geom"][i], self._edges["axis"][i])
        self._open(state[world, i], bool(ended), given, way, motion, k, world)
    cuts.finish(worlds, motion)
    self.fields.state.assign(state)
    self.fields.due.zero_()

  def _burn(self, current, row: np.ndarray, world: int, disp: np.ndarray, line, given) -> bool:
    """Lets a path of a world follow a current, which has brought an energy [J]."""
    organ, cuts = self._organ, self._organ.topology
    mesh, thickness = cuts.mesh_of(world), organ.config.thickness
    where = organ.declared, mesh, mesh.rest + disp, cuts.finder, line
    return current.burn(row, *where, float(given[world]), thickness)

  def _open(self, row: np.ndarray, ended: bool, given: float, way, motion, k: int, world: int):
    """Opens the path of a blade in a world, the k-th of a motion."""
    organ, cuts = self._organ.declared, self._organ.topology

    def cut(path: np.ndarray, depth: np.ndarray | None) -> tuple[Any, Mesh]:
      where = organ, cuts.mesh_of(world), motion.disp[k], cuts.finder, way
      found = cuts.find(world, trails.path_of(path, depth, given, *where), motion, k)
      return cuts.apply(world, found, motion, k), cuts.mesh_of(world)

    trails.open_path(row, organ, cuts.mesh_of(world), ended, cuts.finder, cut)


@wp.kernel(enable_backward=False)
def _forget(mask: wp.array[bool], due: wp.array2d[int]):
  w, i = wp.tid()
  if mask[w]:
    due[w, i] = 0


def _by_nodes(fields: Any, body) -> Any:
  """Returns fields that name nodes in place of vertices."""
  fields.node = wp.array(np.arange(body.shape.nnode), dtype=int, device=body.device)
  return fields


def make(organ: "Organ") -> tuple[Blades, ...]:
  """Returns what cuts an organ of `Worlds`, if anything does."""
  return (Blades(organ),) if organ.topology and organ.space.cutters else ()
