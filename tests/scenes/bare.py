"""Tissue without MuJoCo: a body, its arrays, its steps."""

import numpy as np
import warp as wp
from palpate.tissue import shape
from palpate.tissue import step as stepping
from palpate.tissue.config import Config
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.order import from_slices, to_slices


def kernels(points, elem, nworld=1, device="cpu", pin=(), **config):
  """Returns (mesh, configuration, body) of an organ outside of MuJoCo."""
  mesh = topology.build("organ", points, elem)
  settings = Config(**({"bend": 0.0} | config))
  if settings.elements == "solid":
    mesh = fill.fill("organ", mesh)
  pinned = np.zeros(mesh.nvert, bool)
  pinned[list(pin)] = True
  return mesh, settings, shape.make(mesh, settings, pinned, device, nworld=nworld)


def put(body, array, values):
  """Writes values per vertex, (nvert, ...) or (nworld, nvert, ...), into a sliced array."""
  nworld, rest = array.shape[0], (3,) if len(array.shape) == 4 else ()
  node, nnode = body.shape.node.numpy(), body.shape.nnode
  full = np.full((nworld, nnode, *rest), 0.0 if rest else 1.0)  # padding has a mass of 1
  full[:, node] = np.broadcast_to(values, (nworld, len(node), *rest))
  array.assign(np.stack([to_slices(each) for each in full]).astype(np.float32))


def get(body, array, world=0):
  """Returns a sliced array as float64 values per vertex."""
  return from_slices(array.numpy()[world])[body.shape.node.numpy()].astype(np.float64)


def step(body, h, u, v=0.0, mass=1.0, force=0.0, beta=None, scheme="implicit"):
  """Returns the change of velocity of one step, (nvert, 3); `beta` replaces the damping."""
  damping, eased = body.number("damping"), body.number("eased") * (scheme == "implicit")
  beta = damping - min(eased * h, 0.5 * damping) if beta is None else beta
  state = body.state
  row = np.array([[h, h * h + h * beta, 0, 0]], np.float32)
  state.step.assign(np.repeat(row, body.nworld, axis=0))
  for array, values in (
    (state.disp, u),
    (state.vel, v),
    (state.mass, mass),
    (state.force_ext, force),
    (state.dvel_warm, 0.0),
  ):
    put(body, array, np.asarray(values))
  with wp.ScopedDevice(body.device):
    stepping.step(body, scheme)
  return get(body, state.dvel)


def force(body, u):
  """Returns the internal force at displacement u [N]: one step of unit mass without K in it."""
  return step(body, 1.0, u, beta=-1.0)
