"""The builder of the scenes of tests and benches, and helpers; the fixture `scenes` is this module.

Every size is in SI units.
"""

import mujoco
import numpy as np
import palpate
import pytest
import trimesh
import warp as wp
from palpate.engine import plugin as engine
from palpate.models import mjcf
from palpate.models.block import box  # noqa: F401 - of `scenes`
from palpate.tissue import fill, shape
from palpate.tissue import mesh as topology
from palpate.tissue import step as stepping
from palpate.tissue.config import Config
from palpate.tissue.order import from_slices, to_slices
from scipy.spatial import Delaunay

needs_cuda = pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")

RADIUS = 0.05  # of the test sphere [m]
FLEX = 0.0005  # radius of the flexes [m]
PLAIN = {"solref": "0.004 1", "condim": "1"}  # stiff contacts without friction


# Meshes: points (nvert, 3) and triangles (nelem, 3).


def sphere(subdivisions=2, radius=RADIUS):
  mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
  return np.array(mesh.vertices), np.array(mesh.faces)


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


DIGITS = 17  # of numbers in MJCF: all that a double has


def plugin(**config):
  """Returns the plugin's declaration; a key of None is left out, `device` is cpu unless given."""
  return mjcf.plugin(_keys(config), digits=DIGITS)


def _keys(config):
  return {k: v for k, v in ({"device": "cpu"} | config).items() if v is not None}


def contacts(contact):
  """Returns how a flex touches: stiff and without friction unless said otherwise."""
  return {"selfcollide": "none"} | PLAIN | (contact or {})


def flex(points, elem, inside, name="organ", pin=(), contact=None, **attributes):
  """Returns a flexcomp whose nodes are MuJoCo's, around what is `inside` of it."""
  attributes = {"mass": 0.1, "radius": FLEX} | attributes
  return mjcf.flexcomp(
    name,
    (points, elem),
    inside=inside,
    contact=contacts(contact),
    pin=pin,
    digits=DIGITS,
    **attributes,
  )


def organ(
  points, elem, name="organ", mass=0.1, pin=(), contact=None, radius=FLEX, rgba=None, **config
):
  """Returns an organ whose nodes are MuJoCo's; `config` are the plugin's keys."""
  inside = "\n".join([plugin(**config), mjcf.EDGE])
  return flex(points, elem, inside, name, pin, contact, mass=mass, radius=radius, rgba=rgba)


def windowed(
  points, elem, name="organ", grid="window", count="9 6 1", contact=None, radius=FLEX, **config
):
  """Returns an organ in a body of its own and the flexcomp of its window, `count` slots."""
  keys = plugin(**{"window": grid, "mass": 0.1} | config)
  surface = mjcf.flexcomp(
    name,
    (points, elem),
    contact=mjcf.NO_CONTACT,
    digits=DIGITS,
    rigid=True,
    radius=radius,
  )
  window = mjcf.flexcomp(
    grid,
    inside=mjcf.EDGE,
    contact=contacts(contact),
    type="grid",
    count=count,
    spacing=".01 .01 .01",
    mass=0.01,
    radius=radius,
  )
  return mjcf.tag("body", {"name": name}, f"{keys}\n{surface}") + window


def world(
  *bodies,
  h=1e-3,
  gravity=(0, 0, 0),
  integrator="Euler",
  solver="Newton",
  tolerance=1e-10,
  memory=100,
  option="",
  flag="",
  extra="",
):
  """Returns a whole MJCF document around the bodies; `memory` in MB."""
  return (
    f'<mujoco><option timestep="{h}" gravity="{mjcf.numbers(gravity)}" integrator="{integrator}" '
    f'solver="{solver}" tolerance="{tolerance}" {option}>{flag}</option><size memory="{memory}M"/>'
    f"{mjcf.extension()}"
    f"<worldbody>{''.join(bodies)}</worldbody>{extra}</mujoco>"
  )


def ball(z, radius=0.006, mass=0.05, joint=True):
  """Returns a ball on a vertical slide called `z`, at height z."""
  slide = '<joint name="z" type="slide" axis="0 0 1"/>' if joint else ""
  return (
    f'<body name="ball" pos="0 0 {z}">{slide}'
    f'<geom size="{radius}" mass="{mass}" condim="1" solref="0.004 1"/></body>'
  )


def press(h=1e-3, subdivisions=2, integrator="Euler", frame=(), tool=0.006, **config):
  """Returns a sphere on a foundation with a driven ball above; `ctrl` is its depth."""
  config = {"young": 30e3, "foundation": 2e5} | config
  points, elem = sphere(subdivisions)
  inside = organ(points, elem, **config) + ball(RADIUS + tool + 0.0005, tool)
  for attributes in reversed(frame):
    inside = f"<body {attributes}>{inside}</body>"
  drive = '<actuator><position name="depth" joint="z" kp="500" kv="10"/></actuator>'
  return world(inside, h=h, integrator=integrator, extra=drive)


PROBED = {"young": 3e4, "poisson": 0.3, "foundation": 1e4, "tolerance": 1e-6}


def probed(
  window=True, *, keys=None, count="9 6 1", frame="", condim=3, h=1e-3, cone="pyramidal", flag=""
):
  """Returns a sphere under a probe on two slides; with a window, or with all nodes MuJoCo's."""
  points, elem = sphere(2)
  contact = {"condim": condim, "friction": "0.5", "solref": "0.004 1"}
  keys = PROBED | (keys or {})
  if window:
    made = windowed(points, elem, count=count, contact=contact, **keys)
  else:
    made = organ(points, elem, contact=contact, **keys)
  tool = f"""<body name="tool" pos="0.0013 0.0007 {RADIUS + 0.0067}">
    <joint name="z" type="slide" axis="0 0 1"/><joint name="x" type="slide" axis="1 0 0"/>
    <geom name="tip" size="0.006" mass="0.05" condim="{condim}" friction="0.5"/></body>"""
  drive = """<actuator><position joint="z" kp="500" kv="10"/>
    <position joint="x" kp="500" kv="10"/></actuator>"""
  body = f'<body name="frame" {frame}>{made}{tool}</body>'
  return world(body, h=h, option=f'cone="{cone}"', flag=flag, extra=drive)


def ridge(frame="", pinned=True, contact=None, extra=""):
  """Returns a ridge of tissue between the jaws of a grasper that also lifts."""
  points, elem = sphere(2, 1.0)
  points = points * [0.010, 0.02, 0.03]
  pin = np.flatnonzero(points[:, 2] < -0.02) if pinned else ()
  contact = {"condim": 4, "friction": 1} | (contact or {})
  keys = {"young": 2e4, "bulk": 1e4, "foundation": 1e4, "tolerance": 1e-7}
  colour = (0.8, 0.4, 0.3, 1)
  tissue = organ(points, elem, mass=0.02, pin=pin, contact=contact, rgba=colour, **keys)
  jaws = "".join(
    f'<body name="{name}" pos="{0.0165 * side} 0 0">'
    f'<joint name="{name}" type="slide" axis="{-side} 0 0"/><geom name="{name}" type="ellipsoid" '
    f'size="0.004 0.008 0.006" mass="0.01" friction="1" condim="4"/></body>'
    for name, side in (("left", 1), ("right", -1))
  )
  grasper = f"""<body name="grasper" pos="0 0 0.022"><joint name="z" type="slide" axis="0 0 1"/>
    <geom size="0.002" pos="0 0 0.03" mass="0.05" contype="0" conaffinity="0"/>{jaws}</body>"""
  drive = """<actuator><position joint="z" kp="1000" kv="20"/>
    <position joint="left" kp="300" kv="5"/><position joint="right" kp="300" kv="5"/></actuator>"""
  body = f'<body name="frame" {frame}>{tissue}{grasper}</body>'
  return world(body, extra, integrator="implicitfast", option='cone="elliptic"', extra=drive)


# Running.


def load(made, name="organ"):
  """Returns model, data and the organ's handle, of MJCF, an MjSpec or an MjModel."""
  if isinstance(made, mujoco.MjModel):
    model = made
  else:
    model = mujoco.MjModel.from_xml_string(made) if isinstance(made, str) else made.compile()
  data = mujoco.MjData(model)
  return model, data, palpate.Organ(model, data, name)


def bodies(organ):
  """Returns the body of each vertex of an organ, (nvert,)."""
  flex = mujoco.mj_name2id(organ.model, mujoco.mjtObj.mjOBJ_FLEX, organ.name)
  start = organ.model.flex_vertadr[flex]
  return organ.model.flex_vertbodyid[start : start + organ.nvert]


def dofs(organ):
  """Returns the degrees of freedom of each moving vertex, (nfree, 3)."""
  return organ.model.body_dofadr[bodies(organ)[organ.free]][:, None] + np.arange(3)


def qposs(organ):
  """Returns the places of each moving vertex in qpos, (nfree, 3)."""
  joint = organ.model.body_jntadr[bodies(organ)[organ.free]]
  return organ.model.jnt_qposadr[joint][:, None] + np.arange(3)


def workspace(organ):
  """Returns what the engine keeps of an organ in its mjData."""
  instance = organ.model.body_plugin[bodies(organ)].max()
  return engine.find(organ.data._address, int(instance))


def slots(organ):
  """Returns the node in each slot of an organ's windows, -1 in an empty one."""
  return workspace(organ).views["placed"].numpy()


def slot_bodies(organ):
  """Returns the body of each slot of an organ's windows."""
  return workspace(organ).organ.windows.body


def lump(organ, mass=0.1):
  """Gives an organ whose nodes are MuJoCo's the masses of a windowed one."""
  area = topology.vertex_areas(organ.xpos0, organ.elem)
  organ.model.body_mass[bodies(organ)[organ.free]] = (mass * area / area.sum())[organ.free]
  mujoco.mj_setConst(organ.model, mujoco.MjData(organ.model))


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


def drive(model, data, steps):
  """Presses the probe of `probed` 6 mm, slides 10 mm, releases; returns its forces."""
  out = []
  for _ in range(steps):
    t = data.time
    data.ctrl[0] = -0.008 * min(1, t / 0.08) + 0.02 * max(0, min(1, (t - 0.25) / 0.05))
    data.ctrl[1] = 0.01 * max(0, min(1, (t - 0.12) / 0.1))
    mujoco.mj_step(model, data)
    out.append(data.qfrc_constraint[-2:].copy())
  return np.array(out)


def grasp(model, data, organ, steps=450):
  """Grasps the `ridge`, lifts it 4 mm, lets go; returns forces on the joints and positions."""
  joints = [model.joint(name).dofadr[0] for name in ("z", "left", "right")]
  forces, positions = [], []
  for _ in range(steps):
    shut = 0.0075 * min(1, data.time / 0.1) - 0.008 * np.clip((data.time - 0.33) / 0.05, 0, 1)
    data.ctrl[:] = 0.004 * np.clip((data.time - 0.15) / 0.1, 0, 1), shut, shut
    mujoco.mj_step(model, data)
    forces.append(data.qfrc_constraint[joints])
    positions.append(organ.xpos)
  return np.array(forces), np.array(positions)


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


def beside(coupling, bodies, points=None, elem=None, h=1e-3, gravity=(0, 0, 0), **keys):
  """Returns model, data and organ of tissue, a ball unless given, beside bodies.

  Args:
    coupling: `nodal` or `window`
    bodies: MJCF
    points: (nvert, 3)
    elem: triangles
    h: time step
    gravity: of the world
    **keys: the plugin's
  """
  if points is None:
    points, elem = sphere(2)
  if coupling == "window":
    body = windowed(points, elem, **keys) + ball(1.0, joint=False)
  else:
    body = organ(points, elem, **keys)
  return load(world(body + bodies, h=h, gravity=gravity))


def masses(organ):
  """Returns the mass of each vertex, (nvert,)."""
  windows = workspace(organ).organ.windows
  return organ.model.body_mass[bodies(organ)] if windows is None else windows.mass


# Kernels without MuJoCo.


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
  beta = body.number("damping") if beta is None else beta
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


def motion(model):
  """Returns qpos and qvel of each step of a press with fresh data."""
  data = mujoco.MjData(model)
  return run(model, data, 80, record=True)


def adrift(**settings):
  """Returns an organ on a foundation, in motion, with nothing else."""
  points, elem = sphere(1)
  config = {"young": 3e4, "foundation": 1e5, "device": "cpu"}
  own = set(settings) & {"bulk", "device", "newton"}
  config |= {key: settings.pop(key) for key in own}
  model, data, made = load(world(organ(points, elem, **config), **settings))
  random = np.random.RandomState(0)
  made.set_state(xvel=random.uniform(-0.1, 0.1, (made.nvert, 3)))
  return model, data, made


class Warnings:
  """Collects MuJoCo's warnings instead of a log file."""

  def __enter__(self):
    self.lines = []
    mujoco.set_mju_user_warning(self.lines.append)
    return lambda: "\n".join(self.lines)

  def __exit__(self, *_):
    mujoco.set_mju_user_warning(None)
