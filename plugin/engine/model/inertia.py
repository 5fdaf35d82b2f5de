"""Effective inertia: the mass that a contact meets at a node; MuJoCo gets it as joint armature."""

import contextlib
import dataclasses
import hashlib

import mujoco
import numpy as np
import warp as wp
from palpate.tissue import body as bodies
from palpate.tissue import shape, solid, step
from palpate.tissue.body import Body
from palpate.tissue.config import MATERIAL, Config
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.order import from_slices, to_slices
from palpate.tissue.step import SCHEMES

from . import mjstruct
from .declare import Declaration
from .flexes import meeting_geoms

# Loads whose response gives the effective inertia; between them it follows the nodal area.
_SAMPLES = 24
# Nodes that say whether a shell is stiff, and times its own mass that one moves then: presses of
# nodes of 2.8 to 3 masses gained energy from contacts that MuJoCo answers with the dofs' inertia,
# while a fold pinched by jaws, of two masses, shook them at 30 Hz where it answered for itself.
_FEW = 8
_STIFF = 2.75
# Times its inertia by itself that a pressed node may have, which is stretched too.
_PRESSED = 2.0
_KNOWN = 64
# A pressed shell stiffens and few nodes of a patch touch: between 1 and the limit of 2.
_MARGIN = 1.5
_alone: dict[bytes, np.ndarray] = {}  # what it depends on -> `_by_itself`


def stiffness(
  m: mjstruct.Struct, organ: Declaration, body: Body, config: Config, nodal: np.ndarray
) -> tuple[bool, float]:
  """Returns whether tissue is stiff for the model's time step, and how much one node alone is more.

  A shell is where a push on one node moves others with it within a step: where one in four has an
  effective inertia of over `_STIFF` masses by itself. Solids always are: soft ones that lay on a
  plane or under a plate shook by 5 to 14 % where MuJoCo answered for them.

  Args:
    m: the mjModel
    organ: the organ
    body: its tissue
    config: its configuration in force
    nodal: effective inertia of every node [kg], (nvert,)

  Returns:
    whether it is; most times its inertia in `nodal` that a pressed node may have [-]
  """
  sample = _spread(organ.mesh, organ.free, _FEW)
  alone = _by_itself(m, organ, body, config, sample)
  stiff = len(organ.mesh.tet) or np.quantile(alone / masses(m, organ)[sample], 0.75) > _STIFF
  return bool(stiff), _PRESSED * max(1.0, float(np.median(alone / nodal[sample])))


def iterations(m: mjstruct.Struct, organ: Declaration, config: Config) -> int:
  """Returns how many Newton iterations a step takes, for the model's time step."""
  if not len(organ.mesh.tet) or not SCHEMES[config.integrator].ahead:
    return config.newton
  gain = shape.gain(config, float(m.opt.timestep))
  return max(config.newton, solid.iterations(organ.mesh, config, masses(m, organ), gain))


def _by_itself(
  m: mjstruct.Struct, organ: Declaration, body: Body, config: Config, sample: np.ndarray
) -> np.ndarray:
  """Returns the effective inertia of the nodes `sample` [kg], each pushed alone."""
  h, mass = float(m.opt.timestep), masses(m, organ)
  numbers = [h, config.damping, config.foundation, config.bulk]
  known = np.concatenate([numbers, mass, organ.mesh.rest.ravel(), organ.free])
  key = hashlib.sha256(known.tobytes()).digest()
  key += repr((organ.config, config.integrator, material(config))).encode()
  if key not in _alone:
    if len(_alone) >= _KNOWN:
      _alone.pop(next(iter(_alone)))
    gain = shape.gain(config, h)
    terms = {key: getattr(config, key) for key in ("damping", "foundation", "bulk")}
    scratch = _scratch(body, dataclasses.replace(_compiled(organ, config), **terms))
    with _naming(organ):
      response = _responses(scratch, organ.mesh, mass, organ.free, h, 0.0, gain, sample)
    _alone[key] = 1 / response
  return _alone[key]


def of_nodes(
  m: mjstruct.Struct, organ: Declaration, body: Body, config: Config, mass: np.ndarray, flex: int
) -> np.ndarray:
  """Returns the effective inertia of every node for the tools that meet `flex` [kg], (nvert,).

  It is that of the compiled configuration with the material in force.
  """
  h, config = float(m.opt.timestep), _compiled(organ, config)
  radius = _tool_radius(m, organ, flex)
  gain = shape.gain(config, h)
  scratch = _scratch(body, config)
  with _naming(organ):
    return effective_inertia(scratch, organ.mesh, mass, organ.free, h, radius, gain)


@contextlib.contextmanager
def _naming(organ: Declaration):
  """Names the organ in a ValueError."""
  try:
    yield
  except ValueError as error:
    raise ValueError(f"organ {organ.name!r}: {error}") from None


def of_dofs(m: mjstruct.Struct, organ: Declaration) -> np.ndarray:
  """Returns the inertia that the dofs of every node have in the model [kg], (nvert,)."""
  inertia = masses(m, organ).copy()
  own = organ.jointed
  inertia[own] = m.body_mass[organ.body[own]]
  inertia[own] += m.dof_armature[organ.dofs].reshape(-1, 3)[:, 0]
  return inertia


def masses(m: mjstruct.Struct, organ: Declaration) -> np.ndarray:
  """Returns the mass of every node that MuJoCo, a solid or the windows give it [kg], (nvert,)."""
  if organ.windows:
    return organ.windows.mass
  if len(organ.mesh.tet):
    return organ.mass
  return m.body_mass[organ.body]


def material(config: Config) -> tuple:
  """Returns the constants of the tissue that its stiffness follows from."""
  return tuple(getattr(config, key) for key in MATERIAL)


def _compiled(organ: Declaration, config: Config) -> Config:
  """Returns the compiled configuration with the material of another."""
  return dataclasses.replace(organ.config, **dict(zip(MATERIAL, material(config), strict=True)))


def _scratch(body: Body, config: Config) -> Body:
  """Returns a body of one world of that tissue, for solves that a per cent is good enough for."""
  out = bodies.worlds(body)
  shape.renumber(out, dataclasses.replace(config, tolerance=1e-2, newton=1))
  out.state.mass.assign(np.where(out.shape.vert.numpy() >= 0, 0.0, 1.0).reshape(1, -1, 8))
  return out


def _tool_radius(m: mjstruct.Struct, organ: Declaration, flex: int) -> float:
  """Returns the radius of the largest contact patch to expect [m]: that of the thickest tool.

  Planes and height fields touch all there is; a patch of a quarter of the organ stands for them.
  """
  colliding = meeting_geoms(m, flex)
  limit = 0.25 * float(np.ptp(organ.mesh.rest, axis=0).max())
  kind, size, geom = m.geom_type, m.geom_size, mujoco.mjtGeom
  radius = 0.0
  for g in colliding:
    if kind[g] in (geom.mjGEOM_SPHERE, geom.mjGEOM_CAPSULE, geom.mjGEOM_CYLINDER):
      own = size[g, 0]
    elif kind[g] in (geom.mjGEOM_BOX, geom.mjGEOM_ELLIPSOID, geom.mjGEOM_MESH):
      own = np.sort(size[g])[1]
    else:
      own = limit
    radius = max(radius, float(own))
  return min(radius, limit)


def effective_inertia(
  body: Body, mesh: Mesh, mass: np.ndarray, free: np.ndarray, h: float, radius: float, gain: float
) -> np.ndarray:
  """Returns the inertia that a contact meets at each node at rest [kg], (nvert,).

  That of node i is 1 / sum_j n^T (A^-1)_ij n over the nodes j within a contact patch. The row sum
  keeps the spectral radius of Mhat (A^-1 on the contact nodes) at or under 1; the iteration on the
  contact force is stable up to 2. What it adds to the mass is taken `_MARGIN` times: too little
  lets a contact move its nodes alone, and stiff shells crumple under the tool. Evenly spread nodes
  are solved for; others follow the nearest of them in proportion to their area.

  Args:
    body: the organ, of one world; its state is overwritten
    mesh: its mesh
    mass: nodal masses [kg], (nvert,)
    free: nodes that move, (nvert,) bool
    h: time step [s]
    radius: radius of the contact patch [m]; 0 for the node alone
    gain: factor of K in A [s^2]
  """
  area = topology.vertex_areas(mesh.rest, mesh.elem)
  sample = _spread(mesh, free, _SAMPLES)
  response = _responses(body, mesh, mass, free, h, radius, gain, sample)
  # Per area, so that finer parts of the surface get less.
  specific = 1 / response / area[sample]
  distance2 = ((mesh.rest[:, None] - mesh.rest[sample]) ** 2).sum(axis=2)
  nearest = np.argsort(distance2, axis=1)[:, :3]
  weight = 1 / (np.take_along_axis(distance2, nearest, axis=1) + 1e-12 * distance2.max() + 1e-300)
  weight /= weight.sum(axis=1, keepdims=True)
  found = np.maximum(area * (weight * specific[nearest]).sum(axis=1), mass)
  return mass + _MARGIN * (found - mass)


def _responses(
  body: Body,
  mesh: Mesh,
  mass: np.ndarray,
  free: np.ndarray,
  h: float,
  radius: float,
  gain: float,
  sample: np.ndarray,
) -> np.ndarray:
  """Returns how fast each sample moves where it and the nodes around it get a unit impulse."""
  normal = topology.vertex_normals(mesh.rest, mesh.elem)
  node, state = body.shape.node.numpy(), body.state

  def put(array: wp.array, values: np.ndarray):
    full = np.zeros((body.shape.nnode, *values.shape[1:]), np.float32)
    full[node] = values
    array.assign(to_slices(full)[None])

  for array in (state.disp, state.vel, state.dvel_warm):
    array.zero_()
  put(state.mass, mass)
  floor = 0.0
  state.step.assign(np.array([[h, gain, floor, 0]], np.float32))
  response = np.zeros(len(sample))
  for k, i in enumerate(sample):
    alone = np.arange(mesh.nvert) == i
    around = free & (((mesh.rest - mesh.rest[i]) ** 2).sum(axis=1) <= radius**2)
    for patch in (alone | around, alone):
      put(state.force_ext, np.where(patch[:, None], normal[i] / h, 0.0))
      step.step(body)
      response[k] = from_slices(state.dvel.numpy()[0])[node[i]] @ normal[i]
      if response[k] > 0.0:  # where the surface is folded, a push may lift its middle
        break
  gives = response > 0.0
  if not gives.any():
    size = np.linalg.norm(np.ptp(mesh.rest, axis=0))
    raise ValueError(
      "no vertex gives way to a push, expected tissue that single precision can solve; the organ "
      f"is {size:.3g} m long: is its scale right?"
    )
  response[~gives] = response[gives].min()  # a single one may fail where steps are long
  return response


def _spread(mesh: Mesh, free: np.ndarray, count: int) -> np.ndarray:
  """Returns up to `count` nodes of the surface that move, spread over it."""
  outer = np.flatnonzero(free[: mesh.nouter])
  return outer[topology.spread(mesh.rest[outer], count)]
