"""An organ of a batch on a device."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import warp as wp
from palpate.engine import inertia, mjstruct, slots
from palpate.tissue import body as bodies
from palpate.tissue import config as configuration
from palpate.tissue import device as devices
from palpate.tissue import order, shape, step
from palpate.tissue.types import NUMBERS

from . import contacts, convex, kernels, patch
from .base import Tissue, spread
from .patch import GRADES, launch
from .strip import Slots

_WHAT = {"xpos": 0, "xvel": 1, "contact_force": 2}
_STATUS = {"iterations": 0, "residual": 1}
_KEYS = (*NUMBERS, "young", "friction")
_FEW = 32  # values that are checked one by one


def _plan(body, config) -> devices.Plan | None:
  """Returns how a block takes a world's step; None where it is one that blocks do not know."""
  if config.integrator != "implicit" or body.newton > 1 or body.is_solid:
    return None
  return devices.plan(body.device, body.shape.nslice, body.shape.nslot, body.has_bending)


class Organ(Tissue):
  """An organ of `Worlds`.

  Args:
    batch: the worlds, with mujoco_warp's model and data
    w: the plugin's workspace of the organ
    place: where the stripped model has its slots
    tools: geoms that they follow
  """

  def __init__(self, batch, w, place: Slots, tools: np.ndarray):
    organ, device, nworld = w.organ, batch.device, batch.nworld
    self.name, self.nvert, self.elem = organ.name, organ.mesh.nvert, organ.mesh.elem
    self.declared, self.config, self.space, self.place = organ, organ.config, w, place
    self.instance = w.instance
    self._batch, self._scheme = batch, step.SCHEMES[organ.config.integrator]
    still = shape.make(organ.mesh, organ.config, ~organ.free, str(device), nworld=0)
    self.body = bodies.worlds(still, nworld)
    self.body.plan = _plan(self.body, organ.config)
    model, d, m = batch.model, batch.d, batch.m
    node = self.body.shape.node.numpy()
    mass = np.ones(self.body.shape.nnode, np.float32)
    mass[node] = organ.mass
    self.body.state.mass.assign(np.tile(order.to_slices(mass), (nworld, 1, 1)))
    held = organ.mass if organ.windows else np.where(organ.free, organ.mass, organ.mass.mean())
    nodal = w.inertia(model._address)
    if organ.windows:
      held = slots.hold(organ, held)
    else:
      wall = slots.WALL * organ.mass[organ.free].sum()
      held, nodal = np.where(organ.free, held, wall), np.where(organ.free, nodal, wall)
    values = patch.constants(self.body, organ, tools, model, nodal, held)
    values |= patch.variables(nworld, place.nslot, self.body.shape.nslice)
    values |= dict(
      nq=m.nq,
      nv=m.nv,
      nbody=m.nbody,
      dofadr=place.dofadr,
      qposadr=place.qposadr,
      bodyid=place.body,
      slot_mass=place.mass,
      stiff=int(w.stiff and self._scheme.respond is not None),
      heaviest=float(w.heaviest[0]),
      ngravity=nworld,
      overflow=batch.lost,
      bad=batch.bad,
      mask=batch.mask,
      gravity=m.opt.gravity,
      dof_armature=m.dof_armature,
      body_invweight0=m.body_invweight0,
      **{name: getattr(d, name) for name in (
        "geom_xpos", "geom_xmat", "qpos", "qvel", "qfrc_passive", "qfrc_constraint")},
    )  # fmt: skip
    self.patch = patch.make(values, self.body)
    self._touch = contacts.make(model, organ, tools, place.flex, nworld, d)
    self._convex = convex.make(model, tools, nworld * place.nslot, m, d)
    kinds = frozenset(int(kind) for kind in model.geom_type[tools])
    self._find, self._region = contacts.kernel(kinds), int(nworld * place.nslot * self._touch.room)
    self._graded = False

  @staticmethod
  def bytes_of(w) -> float:
    """Returns about how many bytes a world takes of the organ of a workspace."""
    alone = dataclasses.replace(w.body, levels=None)
    return bodies.nbytes(alone) + 44.0 * w.organ.mesh.nvert

  # Within a step.

  def load(self):
    """Loads the kernels, compiling them where the cache has none."""
    for module in (*step.modules(self.body), patch.MODULE):
      wp.load_module(module, device=self.body.device)

  def _over(self, kernel, count: int):
    launch(kernel, self.patch, self._batch.nworld, count, self.body.device)

  def begin(self):
    """Puts the slots on the nodes nearest to the tools and takes the tissue's step."""
    p = self.patch
    self._over(patch.tell_tools, max(1, p.ntool))
    self._over(patch.enter, p.nnode)
    self._over(patch.rank, p.most)
    self._over(patch.stand, max(p.most, p.nslot))
    self._scheme.step(self.body)

  def touch(self):
    """Writes the window's contacts."""
    dim, device = (self._batch.nworld, self.place.nslot), self.body.device
    inputs = [self.patch, self._touch, self._convex]
    wp.launch(self._find, dim=dim, inputs=inputs, device=device, block_dim=64)
    wp.launch(contacts.add, dim=1, inputs=[self._touch.nacon, self._region], device=device)

  def push(self):
    """Adds the passive force."""
    self._over(patch.push, self.place.nslot)

  def end(self):
    """Ends the step with the contact forces that mujoco_warp found."""
    nslot = self.place.nslot
    respond = self._scheme.respond if self.patch.stiff else None
    if respond:
      self.body.system.rhs.zero_()
    self._over(patch.take, nslot)
    if respond:
      respond(self.body)
      self._over(patch.follow, 1)
    self._over(patch.commit, self.patch.nnode)

  def find_bad(self):
    """Flags worlds that are not finite."""
    self._over(patch.find_bad, self.patch.nnode)

  def rest(self):
    """Puts the worlds of the mask at rest."""
    self._over(patch.rest, self.patch.nnode)

  # Reading.

  @functools.cached_property
  def _out(self) -> dict[str, wp.array]:
    shape = (self._batch.nworld, self.nvert)
    return {name: wp.zeros(shape, dtype=wp.vec3, device=self.body.device) for name in _WHAT}

  def _read(self, name: str) -> wp.array:
    if name in _STATUS:
      return self.body.system.status[:, _STATUS[name]]
    out, dim = self._out[name], (self._batch.nworld, self.nvert)
    wp.launch(kernels.show, dim=dim, inputs=[self.patch, _WHAT[name], out], device=self.body.device)
    return out.view(float)

  # Changing.

  def configure(self, mask=None, **keys):
    """Changes the tissue of worlds, see `Tissue.configure`."""
    batch, nworld = self._batch, self._batch.nworld
    chosen = batch._mask(mask).numpy()
    rows = {key: spread(self, key, value, nworld) for key, value in keys.items()}
    for key, values in rows.items():
      if key not in _KEYS:
        raise ValueError(
          f"organ {self.name!r}: {key!r} cannot change in a batch on a GPU, expected one of "
          f"{', '.join(_KEYS)}"
        )
      if key != "friction":
        self._check(key, np.unique(values[chosen], axis=0))
    if "young" in rows:
      rows["young_scale"] = rows.pop("young") / self._young()
    number = self.body.tissue.number.numpy()
    for key, values in rows.items():
      if key == "friction":
        rough = self._touch.rough.numpy()
        rough[chosen] = values[chosen]
        self._touch.rough.assign(rough)
      else:
        number[chosen, NUMBERS.index(key)] = values[chosen]
    self.body.tissue.number.assign(number)
    if "young_scale" in rows:
      self._grade(number[:, NUMBERS.index("young_scale")])

  def _young(self) -> float:
    if len(set(self.config.young)) > 1:
      raise ValueError(f"organ {self.name!r}: its triangles differ in young, expected young_scale")
    return self.config.young[0]

  def _check(self, key: str, values: np.ndarray):
    """Raises ValueError where a value of a key is not allowed."""
    if values.ndim > 1:
      raise ValueError(
        f"organ {self.name!r}: young of each triangle, which a batch on a GPU cannot have, "
        "expected one number a world"
      )
    mesh = self.declared.mesh
    for value in values if len(values) < _FEW else (values.min(), values.max()):
      text = {key: f"{int(value)}" if key == "iterations" else f"{value:.9g}"}
      configuration.change(self.name, self.config, text, mesh.nelem, mesh.closed, self.config)

  def _grade(self, scale: np.ndarray):
    """Lets tools meet the inertia of tissue of that scale of Young's modulus."""
    if scale.min() < 0.999 * GRADES[0] or scale.max() > 1.001 * GRADES[-1]:
      raise ValueError(
        f"organ {self.name!r}: young_scale is in [{scale.min():g}, {scale.max():g}], expected "
        f"[{GRADES[0]:g}, {GRADES[-1]:g}]"
      )
    w, batch = self.space, self._batch
    m = mjstruct.Model.from_address(batch.model._address)
    if not self._graded and self._scheme.spreads:
      flex = int(w.organ.windows.flex[0]) if w.organ.windows else w.organ.flex
      mass = inertia.masses(m, w.organ)
      table, node = self.patch.inertia.numpy(), self.body.shape.node.numpy()
      for k, grade in enumerate(GRADES):
        found = inertia.of_nodes(m, w.organ, w.body, self._scaled(grade), mass, flex)
        table[k, node] = np.where(self.declared.free, found, table[k, node])
      self.patch.inertia.assign(table)
      self._graded = True
    self.patch.grade.assign(np.log2(scale / GRADES[0]).astype(np.float32))
    stiff = self.patch.stiff
    if not stiff and self._scheme.respond is not None:
      nodal = w.inertia(batch.model._address)
      config = self._scaled(float(scale.max()))
      stiff, _ = inertia.stiffness(m, w.organ, w.body, config, nodal)
      if stiff:
        self.patch.stiff = 1
        batch.record()

  def _scaled(self, scale: float):
    young = tuple(scale * each for each in self.config.young)
    stiffness = self.config.stiffness
    return dataclasses.replace(self.config, young=young, stiffness=stiffness)
