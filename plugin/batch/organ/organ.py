"""An organ of a batch on a device."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from palpate.engine import coupling
from palpate.engine.windows import proxies
from palpate.forces import cutters
from palpate.forces.needles import Needles as Pierced
from palpate.forces.passive import Forces
from palpate.forces.table import FORCES
from palpate.forces.tears import Tears
from palpate.tissue import body as bodies
from palpate.tissue import config as configuration
from palpate.tissue import device as devices
from palpate.tissue import order, shape, step
from palpate.tissue.cutting.topology import Report, pieces
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import fill

from .. import bonds, kernels, needles
from ..base import Contacts, Tissue, spread
from ..contact import contact_rows, contacts, convex, edges
from ..cutting import blades
from ..cutting.cuts import Cuts
from ..cutting.fracture import Cutters
from ..mjw.arrays import arrays_of
from ..strip_organs import Slots
from . import host, patch
from .material import KEYS, Material
from .patch import launch

if TYPE_CHECKING:
  from palpate.engine.workspace import Workspace

  from ..rods import Thread
  from ..worlds import Worlds

_WHAT = {"xpos": 0, "xvel": 1, "contact_force": 2}
_STATUS = {"iterations": 0, "residual": 1}
_RANKED = 6  # threads that choose nodes, times the slots
_FEW = 32  # values that are checked one by one
_LOOK = 10  # steps after which it looks at most where meshes come apart


def plan_of(body, config, volumes: bool = False) -> devices.Plan | None:
  """Returns how a block takes a world's step; None where it is one that blocks do not know.

  Args:
    body: the tissue
    config: its configuration
    volumes: whether to be ready for volume stiffness or pressure that it does not have yet
  """
  if not step.SCHEMES[config.integrator].whole or body.newton > 1 or body.is_solid:
    return None
  return devices.plan(
    body.device,
    body.shape.nslice,
    int(body.shape.held_adr.numpy()[-1]),
    bends=body.has_bending,
    springs=config.elements == "spring",
    volumes=bool(volumes or config.bulk or config.pressure),
    tensions=config.tension > 0,
    meshes=config.spare > 0,
  )


class Organ(Tissue):
  """An organ of `Worlds`.

  Args:
    batch: the worlds, with mujoco_warp's model and data
    w: the plugin's workspace of the organ
    place: where the stripped model has its slots
    tools: geoms that they follow
    lines: threads that they follow

  Attributes:
    host: it, as forces see it
    forces: what acts on it beside its tissue
  """

  def __init__(self, batch: Worlds, w: Workspace, place: Slots, tools: np.ndarray, lines: list):
    organ, device, nworld = w.organ, batch.device, batch.nworld
    self.name, self.nvert, self.elem = organ.name, coupling.outer(organ), organ.mesh.elem
    self.declared, self.config, self.space, self.place = organ, organ.config, w, place
    self.instance = w.seen.instance
    self.batch, self._scheme = batch, step.SCHEMES[organ.config.integrator]
    still = shape.make(organ.mesh, organ.config, ~organ.free, str(device), nworld=0)
    self.body = bodies.worlds(still, nworld, plan_of(still, organ.config))
    self.body.newton = w.body.newton
    model, d, m = batch.model, batch.d, batch.m
    node = self.body.shape.node.numpy()
    mass = np.ones(self.body.shape.nnode, np.float32)
    mass[node] = np.where(organ.mass > 0, organ.mass, 1.0)  # spare vertices have none
    self.body.state.mass.assign(np.tile(order.to_slices(mass), (nworld, 1, 1)))
    nodal, surface = w.inertia(model._address), patch.Surface(self.body, organ, model, tools, lines)
    if not organ.windows:
      nodal = np.where(organ.free, nodal, proxies.WALL * organ.mass[organ.free].sum())
    values = patch.constants(self.body, organ, tools, lines, model, nodal, surface)
    values |= patch.variables(nworld, place.nslot, self.body.shape.nslice)
    values |= dict(
      nq=m.nq,
      nv=m.nv,
      dofadr=place.dofadr,
      qposadr=place.qposadr,
      bodyid=place.body,
      slot_mass=place.mass,
      sleeps=int(self.body.plan is not None),
      stiff=int(w.graphs.stiff and self._scheme.respond is not None),
      heaviest=float(w.host.arrays["heaviest"].numpy()[0]),
      overflow=batch.lost,
      bad=batch.bad,
      mask=batch.mask,
      **arrays_of(patch.Patch, m, d),
    )
    self._cuts, self._applied = None, None
    if organ.mesh.spare:
      self._cuts = Cuts(self, values, surface)
    self.patch = patch.make(values, self.body)
    self.host, self._steps = host.Host(self), 0
    self._touch = contacts.make(self, model, tools, lines)
    self._pressed = contact_rows.make(self, model, self._touch)
    self._convex = convex.make(model, tools, lines, nworld * place.nslot, m, d)
    kinds = {int(kind) for kind in model.geom_type[tools]} | ({contacts.LINE} if lines else set())
    self._find, self._lines = contacts.kernel(frozenset(kinds), self._touch.lifts > 0), []
    self._material = Material(self, batch, self._touch, self._pressed)
    self.forces = Forces(self.host, FORCES)

  def follow(self, threads: Sequence[Thread]):
    """Tells it the threads that its slots follow."""
    first = 0
    for thread in threads:
      f, origin = thread.fields, thread.declared.origin
      values = {"first": first, "now": f.now, "frame": f.frame, "origin": origin}
      self._lines.append(fill(edges.Line, self.body.device, values))
      first += len(thread.declared.rest) - 1

  def _lay_lines(self):
    """Writes where the threads' edges are."""
    for line in self._lines:
      dim, device = (self.batch.nworld, line.now.shape[1] - 1), self.body.device
      wp.launch(edges.lay, dim=dim, inputs=[self.patch, line], device=device)

  def enclose(self):
    """Lets the step know volume stiffness and pressure, from the next record on."""
    self.body.plan = plan_of(self.body, self.config, True)

  @property
  def responds(self):
    """What launches the answer to impulses, or None."""
    return self._scheme.respond

  @property
  def spreads(self) -> bool:
    """Whether a push on one node moves others within a step."""
    return self._scheme.spreads

  @functools.cached_property
  def vectors(self) -> dict[str, wp.array]:
    """Its motion in slices: displacement, velocity and the last two changes of that."""
    state, p = self.body.state, self.patch
    return {"disp": state.disp, "vel": state.vel, "last": p.last, "before": p.before}

  @functools.cached_property
  def motion(self) -> dict[str, wp.array]:
    """What worlds keep of it from step to step, a row each."""
    p = self.patch
    return self.vectors | {"force": p.force, "heavier": p.heavier, "calm": p.calm}

  @staticmethod
  def bytes_of(w: Workspace, device) -> float:
    """Returns about how many bytes a world takes of the organ of a workspace."""
    there = dataclasses.replace(w.body, device=device)
    alone = dataclasses.replace(w.body, levels=None, plan=plan_of(there, w.organ.config))
    held = 24.0 + 160.0 if w.forces else 0.0  # of springs beside the tissue
    if held and w.organ.mesh.spare:  # which follow a mesh a world
      held += 400.0
    return bodies.nbytes(alone) + (56.0 + held) * w.organ.mesh.nvert

  def stepped(self, last: bool):
    """Looks now and then after a step, or after the last one for now, where meshes come apart."""
    self._steps += 1
    opens = self.forces.of(Tears), self.cuts_by
    if self._cuts and any(opens) and (last or self._steps >= _LOOK):
      self._cuts.follow()
      for each in opens:
        each.open(self._cuts, self._steps)
      self._steps = 0

  @property
  def cuts_by(self) -> cutters.Cutters:
    """The force of its cutters."""
    return self.forces.of(cutters.Cutters)

  # Within a step.

  def load(self):
    """Loads the kernels, compiling them where the cache has none."""
    for kernel in (*step.kernels(self.body), patch.enter):
      kernel.load(self.body.device)

  def _over(self, kernel, count: int):
    launch(kernel, self.patch, self.batch.nworld, count, self.body.device)

  def begin(self):
    """Puts the slots on the nodes nearest to the tools and takes the tissue's step."""
    p = self.patch
    self._over(patch.tell_tools, max(1, p.ntool))
    self._lay_lines()
    self._over(patch.enter, p.nnode)
    if self._applied is not None:
      dim, device = self._applied.shape[:2], self.body.device
      wp.launch(kernels.apply, dim=dim, inputs=[p, self._applied], device=device)
    if not self.sews:
      self._enter()
    some = min(p.nnode, _RANKED * p.nslot)  # threads, for as many candidates as there mostly are
    self._over(patch.rank, some)
    self._over(patch.stand, max(some, p.nslot))
    if self._lines:  # whose steps ask for it
      dim, device = (self.batch.nworld, p.nslot), self.body.device
      inputs = [p, self.batch.d.qacc_warmstart]
      wp.launch(edges.lead, dim=dim, inputs=inputs, device=device)
    if not self.sews:
      self._scheme.step(self.body)

  def _enter(self):
    if self.body.state.hold.size:
      self.body.state.hold.zero_()
    self.forces.enter()

  @property
  def sews(self) -> bool:
    """Whether it holds threads, whose steps its own waits for."""
    return self._pierced.sews

  def follow_threads(self):
    """Takes the tissue's step after those of threads."""
    if self.sews:
      self._pierced.lead()
      self._enter()
      self._scheme.step(self.body)

  def touch(self):
    """Writes the window's contacts."""
    inputs, touch = [self.patch, self._touch, self._convex], self._touch
    dim, device = touch.many.shape, self.body.device
    wp.launch(self._find, dim=dim, inputs=[*inputs, False], device=device, block_dim=64)
    wp.launch(contacts.count, dim=dim[0], inputs=[touch], device=device)
    wp.utils.array_scan(touch.count, touch.before, inclusive=False)
    wp.launch(self._find, dim=dim, inputs=[*inputs, True], device=device, block_dim=64)
    wp.launch(contacts.add, dim=1, inputs=[touch], device=device)

  def push(self):
    """Adds the passive force, and keeps sliding contacts closed."""
    self._over(patch.push, self.place.nslot)
    contact_rows.keep_closed(self._pressed, self.body.device)
    self.forces.act()

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
    self.forces.end()

  def find_bad(self):
    """Flags worlds that are not finite."""
    self._over(patch.find_bad, self.patch.nnode)

  def rest(self):
    """Puts the worlds of the mask at rest."""
    self._over(patch.rest, self.patch.nnode)
    self.host.rest()
    if self._applied is not None:
      rows = self._applied.reshape((self.batch.nworld, -1))
      inputs = [self.batch.mask, self._unforced, rows]
      wp.launch(kernels.put_back_rows, dim=rows.shape, inputs=inputs, device=rows.device)
    if self._cuts:
      self._cuts.heal()

  def wake(self, worlds):
    """Lets the organ of some worlds step that may have slept."""
    calm = self.patch.calm.numpy()
    calm[worlds] = 0.0
    self.patch.calm.assign(calm)

  def rubs(self, geom: int, friction: np.ndarray):
    """Returns which array has the friction of a geom, where, and its new values a world."""
    tools = self.patch.tool_geom.numpy().tolist()
    return [(self._touch.slide, (tools.index(geom),), friction)] if geom in tools else []

  # Reading.

  @functools.cached_property
  def _out(self) -> dict[str, wp.array]:
    shape = (self.batch.nworld, self.nvert)
    return {name: wp.zeros(shape, dtype=wp.vec3, device=self.body.device) for name in _WHAT}

  @functools.cached_property
  def bonds(self) -> bonds.Bonds:
    """What it has grown on to."""
    return bonds.Grown(self)

  def _read(self, name: str) -> wp.array:
    if name in _STATUS:
      return self.body.system.status[:, _STATUS[name]]
    out, dim = self._out[name], (self.batch.nworld, self.nvert)
    wp.launch(kernels.show, dim=dim, inputs=[self.patch, _WHAT[name], out], device=self.body.device)
    return out.view(float)

  @property
  def needles(self) -> needles.Needles:
    """What the needles do that may go through it, see `Tissue`."""
    if not self._pierced:
      raise self._no_needles()
    return self._needles.read()

  @property
  def _pierced(self) -> Pierced:
    return self.forces.of(Pierced)

  @functools.cached_property
  def _needles(self) -> needles.Shown:
    return needles.Shown(self._pierced)

  @property
  def contacts(self) -> Contacts:
    """Contacts of the last step."""
    p = self._pressed
    wp.launch(contact_rows.press, dim=p.geom.shape, inputs=[p], device=self.body.device)
    return Contacts(p.geom, p.normal.view(float), p.pressed)

  @property
  def applied(self) -> wp.array:
    """Force applied to each vertex, see `Tissue`."""
    if self._applied is None:
      shape = self.batch.nworld, self.nvert, 3
      self._applied = wp.zeros(shape, dtype=float, device=self.body.device)
      self._unforced = wp.zeros((1, 3 * self.nvert), dtype=float, device=self.body.device)
      self.batch.record()
    return self._applied

  # Cuts.

  @property
  def topology(self) -> Cuts | None:
    """The worlds' meshes, None where there is no room for cuts."""
    return self._cuts

  @property
  def _spare(self) -> int:
    return self.declared.mesh.spare

  def _cut(self, points: dict[int, np.ndarray], depth, direction) -> list[Report | None]:
    assert self._cuts is not None
    return self._cuts.cut_each(points, depth, direction)

  def _told(self, name: str, world: int) -> list:
    if self._cuts is None:
      mesh, thickness = self.declared.mesh, self.config.thickness
      return [] if name == "reports" else pieces(mesh, self.declared.mass, thickness)
    return getattr(self._cuts, name)(world)

  def _piece_count(self) -> wp.array:
    if self._cuts is None:
      return wp.full(self.batch.nworld, len(self._told("pieces", 0)), dtype=int,
                     device=self.body.device)  # fmt: skip
    return self._cuts.counts()

  def _cutters(self) -> Cutters:
    if not self.cuts_by:
      raise ValueError(f"organ {self.name!r}: nothing cuts it, expected the key cutters")
    return self._blades.read()

  @functools.cached_property
  def _blades(self) -> blades.Shown:
    return blades.Shown(self.cuts_by)

  def feel(self, adr: int):
    """Adds the force of its cutters to a sensor of three numbers."""
    blades.feel(self.cuts_by, adr, self.batch.d.sensordata)

  def meshes(self) -> Sequence[Mesh]:
    """Returns the mesh of each world, see `Tissue`."""
    if self._cuts is None:
      return [self.declared.mesh] * self.batch.nworld
    self._cuts.follow()
    return [self._cuts.mesh(world) for world in range(self.batch.nworld)]

  def elem_of(self, world: int) -> np.ndarray:
    """Returns the triangles of a world, see `Tissue.elem_of`."""
    return self._cuts.mesh_now(self.batch.index(world)).elem if self._cuts else self.elem

  # Changing.

  def configure(self, mask=None, **keys):
    """Changes the tissue of worlds, see `Tissue.configure`."""
    batch, nworld = self.batch, self.batch.nworld
    chosen = np.flatnonzero(batch.checked(mask).numpy())
    rows = {key: spread(self, key, value, nworld)[chosen] for key, value in keys.items()}
    for key in rows:
      why = self._fixed(key)
      if why is not None:
        raise ValueError(
          f"organ {self.name!r}: {key!r} cannot change in a batch on a GPU{why}, expected one of "
          f"{', '.join(KEYS)}"
        )
    for key, values in rows.items():
      if key != "friction" and key != "mass":
        self._check(key, values)
    self._material.change(chosen, rows)
    if "thickness" in rows:
      self.cuts_by.refresh(rows["thickness"], chosen)
    self._pierced.refresh(self._pressed.tissue.numpy(), self._material.thickness)
    self.wake(chosen)

  def _fixed(self, key: str) -> str | None:
    """Returns why a key cannot change, None where it can."""
    if key not in KEYS:
      return ""
    if key == "poisson" and self.body.has_bending:
      return " while tissue bends"
    if key == "thickness" and self.body.is_solid:
      return " of a solid"
    if key == "poisson" and self.body.shape.ncapsule:
      return " of a solid with a skin"
    return None

  def _check(self, key: str, values: np.ndarray):
    """Raises ValueError where a value of a key is not allowed."""
    mesh, values = self.declared.mesh, np.unique(values)
    for value in values if len(values) < _FEW else (values.min(), values.max()):
      text = {key: f"{value:.9g}"}
      configuration.change(self.name, self.config, text, mesh.nelem, mesh.closed, self.config)
