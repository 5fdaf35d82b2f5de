"""Contacts with triangles act on their corners by barycentric weights, on any MuJoCo."""

import mujoco
import numpy as np
import pytest
from reference import plates
from trimesh.triangles import closest_point, points_to_barycentric

JACOBIAN = {"dense": mujoco.mjtJacobian.mjJAC_DENSE, "sparse": mujoco.mjtJacobian.mjJAC_SPARSE}
USUAL = {"condim": 1, "solref": "0.02 1"}  # contacts as firm as their tissue asks for


def corners(model, data, contact):
  """Returns the first dofs of a touched triangle's corners and their barycentric weights."""
  flex = contact.flex[1]
  elem = model.flex_elem[model.flex_elemdataadr[flex] :].reshape(-1)[3 * contact.elem[1] :][:3]
  vert = elem + model.flex_vertadr[flex]
  x, p = data.flexvert_xpos[vert][None], contact.pos[None]
  weight = points_to_barycentric(x, closest_point(x, p))[0]
  return model.body_dofadr[model.flex_vertbodyid[vert]], weight


def shares(model, data):
  """Returns what the contacts push each dof with, by their forces and barycentric weights [N]."""
  out, force = np.zeros(model.nv), np.zeros(6)
  for k, contact in enumerate(data.contact):
    mujoco.mj_contactForce(model, data, k, force)
    push = contact.frame.reshape(3, 3).T @ force[:3]
    for adr, weight in zip(*corners(model, data, contact), strict=True):
      out[adr : adr + 3] += weight * push
  return out


def check(model, data, dofs):
  assert data.ncon and (data.contact.elem[:, 1] >= 0).all()
  expected = shares(model, data)[dofs]
  assert np.linalg.norm(expected) > 1e-3
  atol = 1e-9 * np.abs(expected).max()
  np.testing.assert_allclose(data.qfrc_constraint[dofs], expected, rtol=0, atol=atol)


def touch(scenes, window=False, jacobian="sparse", steps=60, **options):
  """Returns a probe that presses aside, off the middles of triangles."""
  model, data, organ = scenes.load(scenes.probed(window, **options))
  model.opt.jacobian = JACOBIAN[jacobian]
  for k in range(2 * steps):
    data.ctrl[:] = -0.05e-3 * min(k, steps), 0.02e-3 * min(k, steps)
    mujoco.mj_step(model, data)
  mujoco.mj_forward(model, data)
  assert organ.error is None
  return model, data


def own_dofs(model):
  return np.arange(model.nv)[model.dof_bodyid != model.body("tool").id]


@pytest.mark.parametrize("window", [False, True])
@pytest.mark.parametrize("jacobian", JACOBIAN)
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("condim", [1, 3, 4, 6])
def test_corners_get_barycentric_shares(scenes, window, jacobian, cone, condim):
  model, data = touch(scenes, window, jacobian, condim=condim, cone=cone)
  check(model, data, own_dofs(model))


@pytest.mark.parametrize("jacobian", JACOBIAN)
@pytest.mark.parametrize(("solver", "noslip"), [("PGS", 0), ("CG", 0), ("Newton", 3)])
def test_every_solver_sees_the_same_rows(scenes, jacobian, solver, noslip):
  model, data = touch(scenes, jacobian=jacobian)
  usual = data.qfrc_constraint[own_dofs(model)].copy()
  model.opt.solver = getattr(mujoco.mjtSolver, f"mjSOL_{solver.upper()}")
  model.opt.noslip_iterations = noslip
  model.opt.iterations = 10000
  mujoco.mj_forward(model, data)
  check(model, data, own_dofs(model))
  if not noslip:
    atol = 1e-3 * np.abs(usual).max()
    np.testing.assert_allclose(data.qfrc_constraint[own_dofs(model)], usual, atol=atol)


def test_islands_do_not_matter(scenes):
  model, data = touch(scenes)
  forces = []
  for flags in (0, mujoco.mjtDisableBit.mjDSBL_ISLAND):
    model.opt.disableflags = flags
    mujoco.mj_forward(model, data)
    forces.append(data.qfrc_constraint.copy())
  np.testing.assert_allclose(*forces, atol=1e-6 * np.abs(forces[0]).max())


def test_a_second_pass_over_the_same_rows_changes_nothing(scenes):
  model, data = touch(scenes)
  rows, mass = data.efc_J.copy(), data.efc_D.copy()
  mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_POS, 0)
  np.testing.assert_allclose(data.efc_J, rows, atol=1e-14)
  np.testing.assert_allclose(data.efc_D, mass, rtol=1e-12)


def one_triangle(scenes, pin=()):
  points = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
  organ = scenes.organ(points, np.array([[0, 1, 2]]), foundation=1e7, damping=0.01, pin=pin)
  ball = scenes.ball(0.0, radius=1e-4).replace('pos="0 0 0.0"', 'pos="0.02 0.03 0.00055"')
  return scenes.load(scenes.world(organ, ball, gravity=(0, 0, -9.81)))


@pytest.mark.parametrize("pin", [(), (0,)])
def test_a_weight_on_one_triangle_rests_on_its_corners(scenes, pin):
  model, data, _ = one_triangle(scenes, pin)
  model.dof_damping[-1] = 1.0
  while data.time < 1.0:
    mujoco.mj_step(model, data)
  expected = 0.05 * 9.81 * np.array([0.5, 0.2, 0.3])
  found = -data.qfrc_constraint[:-1].reshape(-1, 3)[:, 2]
  np.testing.assert_allclose(found, expected[len(pin) :], rtol=1e-2)


def test_a_pressed_organ_does_not_flicker(scenes):
  points, elem = scenes.sphere(2, 1.0)
  points = points * (0.045, 0.06, 0.04)
  keys = {"young": 1860, "thickness": 0.005, "foundation": 2e4, "bulk": 1e4, "damping": 0.005}
  organ = scenes.organ(points, elem, mass=0.8, bend=0, **keys)
  drive = '<actuator><position joint="z" kp="2000" kv="40"/></actuator>'
  ball = scenes.ball(0.0445, radius=0.004)
  model, data, _ = scenes.load(scenes.world(organ, ball, extra=drive))
  force = []
  for k in range(400):
    data.ctrl[0] = -0.0005 - 0.02e-3 * k
    mujoco.mj_step(model, data)
    force.append(data.qfrc_constraint[-1])
  force = np.array(force)
  force = force[np.flatnonzero(force > 1e-9)[0] :][20:]
  assert (force > 1e-9).all()
  assert np.sqrt(np.mean(np.diff(force) ** 2)) < 0.02 * force.mean()


def pressed(scenes, mesh, tool, depth, steps=250, h=1e-3, **config):
  """Returns model, data and organ of tissue that is held at the bottom, under a tool at a depth."""
  points, elem = mesh
  low, top = points[:, 2].min(), points[:, 2].max()
  pin = np.flatnonzero(points[:, 2] < low + 0.1 * (top - low))
  keys = {"radius": 0.0005, "pin": pin, "damping": 0.005, "contact": USUAL} | config
  tissue = scenes.organ(points, elem, **keys)
  body = f"""<body name="tool" pos="0 0 {top + 0.0007}"><joint name="z" type="slide" axis="0 0 1"/>
    <geom name="tool" {tool} mass="0.5" condim="1"/></body>"""
  drive = '<actuator><position joint="z" kp="20000" kv="200"/></actuator>'
  model, data, organ = scenes.load(scenes.world(tissue, body, h=h, extra=drive))
  scenes.run(model, data, steps, deepest=depth + 0.0002)
  assert organ.error is None and not organ.pierced
  return model, data, organ


@pytest.mark.parametrize("subdivisions", [2, 3])
@pytest.mark.parametrize(("tool", "kind"), [
  ('size=".006" pos="0 0 .006"', {"young": 1e6, "foundation": 1e5}),
  ('type="box" size=".012 .012 .01" pos="0 0 .01"',
   {"young": 1e5, "elements": "solid", "mass": 0.27}),
])  # fmt: skip
def test_contacts_are_firm_on_every_mesh(scenes, subdivisions, tool, kind):
  depth = 0.005
  _, data, _ = pressed(scenes, scenes.sphere(subdivisions, 0.04), tool, depth, **kind)
  assert data.ncon and -data.contact.dist.min() < 0.02 * depth


def block(scenes, edge, at):
  """Returns a block whose top has the point with these weights in a triangle at its middle."""
  points, elem = scenes.box((0.08, 0.08, 0.04), edge)
  corner = points[elem]
  upper = elem[(corner[:, :, 2] > points[:, 2].max() - 1e-6).all(axis=1)]
  middle = upper[np.argmin(np.linalg.norm(points[upper].mean(axis=1)[:, :2], axis=1))]
  return points - np.append((np.array(at) @ points[middle])[:2], 0.0), elem


@pytest.mark.parametrize("at", [(1, 0, 0), (1 / 2, 1 / 2, 0), (1 / 3, 1 / 3, 1 / 3)])
def test_a_ball_that_is_small_for_the_mesh_meets_tissue(scenes, at):
  young, nu, radius, depth, edge = 5000.0, 0.45, 0.04, 4e-4, 0.008
  ball = f'size="{radius}" pos="0 0 {radius}"'
  keys = {"elements": "solid", "young": young, "poisson": nu, "mass": 0.25, "tolerance": 1e-5}
  model, data, organ = pressed(scenes, block(scenes, edge, at), ball, depth, 400, **keys)
  deep, radius = -data.qpos[model.joint("z").qposadr[0]] - 0.0002, radius + 0.0005
  assert np.sqrt(radius * deep) == pytest.approx(0.5 * edge, rel=0.05)  # of the contact
  # Hertz; the layer adds 1.133 chi (Dimitriadis et al. 2002, doi:10.1016/S0006-3495(02)75620-8).
  hertz = 4 / 3 * young / (1 - nu**2) * np.sqrt(radius) * deep**1.5
  layer = 1 + 1.133 * np.sqrt(radius * deep) / 0.04
  # 20 to 80 % more where contacts yield by nothing that the mesh lacks.
  assert np.linalg.norm(organ.force) == pytest.approx(hertz * layer, rel=0.12)


SKIN = {"young": 5000.0, "poisson": 0.45, "thickness": 0.002, "foundation": 2e5, "tolerance": 1e-5,
        "damping": 0.005, "radius": 0.0005, "contact": USUAL, "subgrid": "true"}  # fmt: skip


def skin(scenes, at):
  """Returns the top of that block, alone."""
  points, elem = block(scenes, 0.008, at)
  kept, elem = np.unique(
    elem[(points[elem][:, :, 2] > points[:, 2].max() - 1e-6).all(axis=1)], return_inverse=True
  )
  return points[kept], elem.reshape(-1, 3)


def on_skin(scenes, at, depth, mass, **keys):
  """Returns the forces of a ball that is held in a skin and its place, once it is there."""
  points, elem = skin(scenes, at)
  tissue = scenes.organ(points, elem, mass=mass, **SKIN | keys)
  top, radius = points[:, 2].max() + 0.0005, 0.04
  ball = f"""<body pos="0 0 {top + radius}"><joint name="z" type="slide" axis="0 0 1"/>
    <geom size="{radius}" mass="0.5" condim="1"/></body>"""
  drive = '<actuator><position joint="z" kp="20000" kv="200"/></actuator>'
  model, data, _ = scenes.load(scenes.world(tissue, ball, extra=drive))
  force = []
  for k in range(700):
    data.ctrl[:] = -depth * min(1.0, k / 300)
    mujoco.mj_step(model, data)
    force.append(data.joint("z").qfrc_constraint[0])
  return np.array(force[-200:]), radius + 0.0005


@pytest.mark.parametrize("depth", [4e-4, 1.6e-3])  # of a contact half an edge wide, and an edge
@pytest.mark.parametrize("at", [(1, 0, 0), (1 / 2, 1 / 2, 0), (1 / 3, 1 / 3, 1 / 3)])
def test_a_ball_that_is_small_for_the_mesh_meets_a_skin(scenes, at, depth):
  force, radius = on_skin(scenes, at, depth, 0.05)
  rigidity = SKIN["young"] * SKIN["thickness"] ** 3 / (12 * (1 - SKIN["poisson"] ** 2))
  exact = plates.ball(radius, depth, SKIN["foundation"], rigidity)
  # 37 to 200 % more where contacts yield by nothing that the mesh lacks.
  assert force.mean() == pytest.approx(exact, rel=0.14)
  mesh = on_skin(scenes, at, depth, 0.05, subgrid="false")[0]
  assert mesh.mean() > 1.3 * exact


@pytest.mark.parametrize("depth", [4e-4, 8e-4, 1.6e-3])
def test_a_ball_in_a_heavy_skin_is_at_rest(scenes, depth):
  force, _ = on_skin(scenes, (1 / 3, 1 / 3, 1 / 3), depth, 0.5)
  assert force.std() < 0.005 * force.mean()  # 150 % where C falls faster than the force grows


def test_what_two_tools_pinch_does_not_yield_to_them(scenes):
  points, elem = skin(scenes, (1, 0, 0))
  tissue = scenes.organ(points, elem, mass=0.05, **SKIN)
  balls = "".join(
    f"""<body name="{name}" pos="0 0 {points[0, 2] + side * 0.0035}">
    <joint name="{name}" type="slide" axis="0 0 {-side}"/><geom size=".003" mass="0.02" condim="1"/>
    </body>""" for name, side in (("up", 1), ("down", -1))
  )  # fmt: skip
  drive = "".join(f'<motor joint="{name}"/>' for name in ("up", "down"))
  scene = scenes.world(tissue, balls, extra=f"<actuator>{drive}</actuator>")
  model, data, _ = scenes.load(scene)
  data.ctrl[:] = 0.2
  mujoco.mj_step(model, data, 400)
  assert abs(data.qpos[-2:]).max() < 2e-4 and data.ncon


def test_a_needle_does_not_fall_through_a_coarse_mesh(scenes):
  keys = {"elements": "solid", "young": 5000.0, "mass": 0.25}
  mesh = block(scenes, 0.008, (1 / 3, 1 / 3, 1 / 3))
  *_, organ = pressed(scenes, mesh, 'size=".001" pos="0 0 .001"', 0.003, 200, **keys)
  assert organ.force[2] < -0.01


def test_a_tool_too_small_for_the_mesh_is_named_once(scenes):
  mesh, keys = scenes.sphere(1, 0.04), {"young": 1e4, "foundation": 1e5}
  with scenes.Warnings() as seen:
    pressed(scenes, mesh, 'size=".0005" pos="0 0 .0005"', 0.002, 100, **keys)
    assert seen().count("edges of 2 mm would do") == 1
  with scenes.Warnings() as seen:
    pressed(scenes, mesh, 'size=".006" pos="0 0 .006"', 0.002, 100, **keys)
    assert not seen()
