"""Contacts with triangles act on their corners by barycentric weights, on any MuJoCo."""

import mujoco
import numpy as np
import pytest
from trimesh.triangles import closest_point, points_to_barycentric

JACOBIAN = {"dense": mujoco.mjtJacobian.mjJAC_DENSE, "sparse": mujoco.mjtJacobian.mjJAC_SPARSE}


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
