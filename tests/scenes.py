"""Meshes, scenes and helpers that the tests share; the fixture `scenes` is this class."""

import mujoco
import numpy as np
import palpate
import pytest
import trimesh
import warp as wp
from palpate.tissue import elastic, solver, types
from palpate.tissue import mesh as topology
from palpate.tissue import shape as surface
from palpate.tissue.config import Config
from scipy.spatial import Delaunay

needs_cuda = pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")

RADIUS = 0.05  # of the test sphere [m]
PLAIN = {"solref": "0.004 1", "condim": "1"}  # stiff contacts without friction


def join(values) -> str:
  """Returns numbers as the text of an MJCF attribute."""
  return " ".join(f"{v:.17g}" for v in np.ravel(values))


class Scenes:
  """Builders; every size in SI units."""

  RADIUS = RADIUS

  # Meshes: points (nvert, 3) and triangles (nelem, 3).

  @staticmethod
  def sphere(subdivisions=2, radius=RADIUS):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(mesh.vertices), np.array(mesh.faces)

  @staticmethod
  def strip(length, width, nx, ny):
    """Returns a flat strip along x, diagonals alternating, origin at the middle of its left end."""
    x, y = np.linspace(0, length, nx + 1), np.linspace(-width / 2, width / 2, ny + 1)
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((nx + 1, ny + 1))], -1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))
    a = i * (ny + 1) + j
    b, c, d = a + ny + 1, a + ny + 2, a + 1
    odd = ((i + j) % 2 == 1)[:, None]
    first = np.where(odd, np.stack([a, b, d], 1), np.stack([a, b, c], 1))
    second = np.where(odd, np.stack([b, c, d], 1), np.stack([a, c, d], 1))
    return points.reshape(-1, 3), np.concatenate([first, second])

  @staticmethod
  def triangular(length, width, nx, ny, jitter=0.0, seed=0):
    """Returns a flat strip of triangles, equilateral where width / ny is 0.866 length / nx.

    Args:
      length: along x [m]
      width: along y [m]
      nx: edges along x
      ny: rows
      jitter: greatest random move of the inner nodes, in edges
      seed: of those moves
    """
    rows = []
    for j in range(ny + 1):
      x = np.linspace(0, length, nx + 1)
      if j % 2:
        x = np.concatenate([[0], 0.5 * (x[1:] + x[:-1]), [length]])
      rows.append(np.stack([x, np.full(len(x), (j / ny - 0.5) * width), np.zeros(len(x))], 1))
    points = np.concatenate(rows)
    inside = (points[:, 0] > 1e-9) & (points[:, 0] < length - 1e-9)
    inside &= np.abs(points[:, 1]) < width / 2 - 1e-9
    move = np.random.RandomState(seed).uniform(-jitter, jitter, (len(points), 2)) * length / nx
    points[inside, :2] += move[inside]
    elem = Delaunay(points[:, :2]).simplices
    area = topology.area_vectors(points, elem)[:, 2]
    elem[area < 0] = elem[area < 0][:, [0, 2, 1]]
    return points, elem[np.abs(area) > 1e-12]

  # MJCF.

  @staticmethod
  def organ(points, elem, name="organ", mass=0.1, pin=(), contact=None, radius=0.0005, **config):
    """Returns a flexcomp; `config` are the plugin's keys, of which `device` is cpu unless given."""
    config.setdefault("device", "cpu")
    keys = "".join(f'<config key="{key}" value="{value}"/>' for key, value in config.items())
    contact = PLAIN | (contact or {})
    contact = " ".join(f'{key}="{value}"' for key, value in contact.items())
    pins = f'<pin id="{" ".join(map(str, pin))}"/>' if len(pin) else ""
    return (
      f'<flexcomp name="{name}" type="direct" dim="2" mass="{mass}" radius="{radius}" '
      f'point="{join(points)}" element="{" ".join(map(str, np.ravel(elem)))}">'
      f'<plugin plugin="palpate.organ">{keys}</plugin>'
      f'<contact selfcollide="none" {contact}/><edge damping="1e-9"/>{pins}</flexcomp>'
    )

  @staticmethod
  def world(*bodies, h=1e-3, gravity=(0, 0, 0), integrator="Euler", option="", extra=""):
    """Returns a whole MJCF document around the bodies."""
    return (
      f'<mujoco><option timestep="{h}" gravity="{join(gravity)}" integrator="{integrator}" '
      f'solver="Newton" tolerance="1e-10" {option}/><size memory="100M"/>'
      f'<extension><plugin plugin="palpate.organ"/></extension>'
      f"<worldbody>{''.join(bodies)}</worldbody>{extra}</mujoco>"
    )

  @staticmethod
  def load(xml, name="organ"):
    """Returns model, data and the organ's handle."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    return model, data, palpate.Organ(model, data, name)

  @staticmethod
  def ball(z, radius=0.006, mass=0.05, joint=True):
    """Returns a ball on a vertical slide called `z`, at height z."""
    slide = '<joint name="z" type="slide" axis="0 0 1"/>' if joint else ""
    return (
      f'<body name="ball" pos="0 0 {z}">{slide}'
      f'<geom size="{radius}" mass="{mass}" condim="1" solref="0.004 1"/></body>'
    )

  @staticmethod
  def press(h=1e-3, subdivisions=2, integrator="Euler", frame=(), tool=0.006, **config):
    """Returns a sphere on a foundation with a driven ball above; `ctrl` is its depth."""
    config = {"young": 30e3, "foundation": 2e5} | config
    points, elem = Scenes.sphere(subdivisions)
    inside = Scenes.organ(points, elem, **config) + Scenes.ball(RADIUS + tool + 0.0005, tool)
    for attributes in reversed(frame):
      inside = f"<body {attributes}>{inside}</body>"
    drive = '<actuator><position name="depth" joint="z" kp="500" kv="10"/></actuator>'
    return Scenes.world(inside, h=h, integrator=integrator, extra=drive)

  # Running.

  @staticmethod
  def dof(organ):
    """Returns the degrees of freedom of each moving vertex, (nfree, 3)."""
    return organ.dofs

  @staticmethod
  def run(model, data, steps, record=False, speed=0.1, deepest=0.008):
    """Presses at constant speed to the deepest point and stays; returns qpos of each step."""
    out = []
    for _ in range(steps):
      if model.nu:
        data.ctrl[0] = -min(speed * data.time, deepest)
      mujoco.mj_step(model, data)
      if record:
        out.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(out)

  @staticmethod
  def settle(model, data, organ, steps=200, still=1e-5):
    """Steps until two steps move no vertex by more than `still` of the greatest displacement."""
    quiet = 0
    for _ in range(steps):
      mujoco.mj_step(model, data)
      moved = np.abs(data.qvel).max() * model.opt.timestep
      quiet = quiet + 1 if moved <= still * np.abs(organ.displacement).max() else 0
      if quiet == 2:
        return
    raise AssertionError(f"still moving by {moved} m a step after {steps} steps")

  # Kernels without MuJoCo.

  @staticmethod
  def kernels(points, elem, nworld=1, device="cpu", pin=(), **config):
    """Returns (mesh, configuration, surface, state) of an organ outside of MuJoCo."""
    mesh = topology.build("organ", points, elem)
    settings = Config(**({"bend": 0.0} | config))
    pinned = np.zeros(mesh.nvert, bool)
    pinned[list(pin)] = True
    constants = surface.make(mesh, settings, pinned, device)
    with wp.ScopedDevice(constants.device):
      elastic.calibrate(constants, types.make_state(constants))
      state = types.make_state(constants, nworld)
    return mesh, settings, constants, state

  @staticmethod
  def put(s, array, values):
    """Writes values per vertex, (nvert, ...) or (nworld, nvert, ...), into a sliced array."""
    nworld = array.shape[0]
    vert = s.vert.numpy()
    values = np.broadcast_to(values, (nworld, s.nvert, *((3,) if len(array.shape) == 4 else ())))
    full = np.where(vert >= 0, 0.0, 1.0)  # padding: mass 1, and
    full = np.broadcast_to(
      full if len(array.shape) == 3 else 0.0 * full[:, None], (nworld, s.nnode, *values.shape[2:])
    ).copy()
    full[:, vert >= 0] = values[:, vert[vert >= 0]]
    array.assign(np.stack([surface.to_slices(f) for f in full]).astype(np.float32))

  @staticmethod
  def get(s, array, world=0):
    """Returns a sliced array as float64 values per vertex."""
    return surface.from_slices(array.numpy()[world])[s.node.numpy()].astype(np.float64)

  @staticmethod
  def step(s, state, h, u, v=0.0, mass=1.0, force=0.0, beta=None):
    """Returns the change of velocity of one implicit step, (nvert, 3); `beta` replaces damping."""
    beta = s.damping if beta is None else beta
    row = np.array([[h, h * h + h * beta, 0, 0]], np.float32)
    state.step.assign(np.repeat(row, state.nworld, axis=0))
    for array, values in (
      (state.pos, u),
      (state.vel, v),
      (state.mass, mass),
      (state.force_ext, force),
      (state.dvel_warm, 0.0),
    ):
      Scenes.put(s, array, np.asarray(values))
    with wp.ScopedDevice(s.device):
      solver.step(s, state)
    return Scenes.get(s, state.dvel)

  @staticmethod
  def force(s, state, u):
    """Returns the internal force at displacement u [N]: one step of unit mass without K in it."""
    return Scenes.step(s, state, 1.0, u, beta=-1.0)
