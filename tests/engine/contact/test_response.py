"""Stiff tissue answers contact forces itself: the step, its energy, what tools meet, its state."""

import mujoco
import numpy as np
import pytest
import scenes
from reference import exact

STIFF = {"young": 3e6, "foundation": 1e6, "iterations": 500, "damping": 5e-4}
COUPLINGS = ["nodal", "window", "resident"]


def load(coupling, device, h=2e-3, **keys):
  keys = STIFF | {"device": device} | keys
  if coupling == "resident":
    keys["resident"] = "true"
  return scenes.load(scenes.probed(coupling != "nodal", keys=keys, h=h, condim=1))


def masses(organ):
  if organ.config.window:
    return scenes.workspace(organ).organ.mass
  return np.full(organ.nvert, 0.1 / organ.nvert)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_the_step_is_implicit_in_the_contact_forces_that_the_step_finds(coupling, device):
  m, d, organ = load(coupling, device, bend=0)
  mesh = scenes.workspace(organ).organ.mesh
  step = exact.Step(exact.Elastic(mesh, organ.config), masses(organ), np.ones(organ.nvert, bool))
  seen = 0
  u, v, before = np.zeros((3, organ.nvert, 3))
  for _ in range(60):
    scenes.drive(m, d, 1)
    force = organ.contact_force
    change = np.abs(force - before).max()
    if change > 0.02 * max(np.abs(force).max(), 0.1):
      wanted = step(2e-3, u, v, force)
      lagged = step(2e-3, u, v, before)
      answer = np.abs(wanted - lagged).max()
      # The answer is solved for to a residual of 3 %.
      assert np.abs(organ.xvel - v - wanted).max() < 0.1 * answer
      seen += 1
    np.testing.assert_allclose(organ.displacement, u + 2e-3 * organ.xvel, atol=1e-9)
    u, v, before = organ.displacement, organ.xvel, force
  assert seen > 5 and organ.error is None


def excess(m, d, organ, steps):
  """Returns the most energy that the organ has beyond the contacts' work, and that work."""
  work = gross = most = 0.0
  x = organ.xpos
  mass = masses(organ)[:, None]
  for _ in range(steps):
    scenes.drive(m, d, 1)
    each = organ.contact_force * (organ.xpos - x)
    work, gross, x = work + each.sum(), gross + np.abs(each).sum(), organ.xpos
    most = max(most, organ.energy + 0.5 * (mass * organ.xvel**2).sum() - work)
  return most, gross


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_contacts_give_stiff_tissue_no_more_energy_than_their_work(coupling, device):
  # It had 3 % where MuJoCo's contacts moved the nodes by their own inertia.
  m, d, organ = load(coupling, device, h=4e-3, young=3e7, damping=1e-4)
  most, gross = excess(m, d, organ, 75)
  assert gross > 3e-4
  assert most < 0.003 * gross


def hold(m, d, steps):
  """Presses by up to 8 mm at 0.1 m/s and holds; returns the forces on the tool."""
  out = []
  for _ in range(steps):
    d.ctrl[0] = -0.008 * min(1, d.time / 0.08)
    mujoco.mj_step(m, d)
    out.append(d.qfrc_constraint[-2])
  return np.array(out)


def test_the_contact_force_of_stiff_tissue_comes_to_rest(device):
  held = []
  for coupling in ("nodal", "window"):
    m, d, _ = load(coupling, device, h=4e-3)
    f = hold(m, d, 150)[-20:]
    assert np.ptp(f) < 0.01 * f.mean()
    held.append(f.mean())
  assert held[0] > 0.5
  assert held[1] == pytest.approx(held[0], rel=0.01)  # other masses on the way in


def test_tissue_is_stiff_for_a_time_step(device):
  soft = load("nodal", device, h=1e-3, young=3e4, foundation=1e4)
  assert not scenes.workspace(soft[2]).graphs.stiff
  assert scenes.workspace(load("window", device)[2]).graphs.stiff
  m, d, organ = soft
  m.opt.timestep = 2e-2
  mujoco.mj_step(m, d, 2)
  assert scenes.workspace(organ).graphs.stiff
  m.opt.timestep = 1e-3
  mujoco.mj_step(m, d, 2)
  assert not scenes.workspace(organ).graphs.stiff


def test_a_light_organ_is_not_heavier_for_its_window(device):
  # The window's bodies have 0.2 g each in the MJCF, a node of the organ has 6 mg.
  m, d, _ = load("window", device, h=1e-3, young=300, foundation=1e3, damping=0.01, mass=1e-3)
  f = hold(m, d, 300)[-50:]
  assert np.ptp(f) < 0.05 * f.mean()


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_saved_state_goes_on_to_the_bit(coupling, device):
  m, d, organ = load(coupling, device)
  scenes.drive(m, d, 25)
  organ.sync()
  assert np.abs(scenes.goes_on(m, d, lambda each: scenes.drive(m, each, 20))).max() > 0.1


@pytest.mark.parametrize("solver", ["PGS", "CG", "Newton"])
@pytest.mark.parametrize("integrator", ["Euler", "implicit", "implicitfast"])
def test_solvers_and_integrators_of_mujoco_agree(solver, integrator):
  forces = []
  for name, kind in (("Newton", "Euler"), (solver, integrator)):
    m, d, organ = load("nodal", "cpu")
    m.opt.solver = getattr(mujoco.mjtSolver, f"mjSOL_{name.upper()}")
    m.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{kind.upper()}")
    m.opt.iterations = 1000
    m.dof_damping[-2:] = 0.1  # so that Euler has an implicit part too
    forces.append(hold(m, d, 80))
    assert organ.error is None
  assert forces[0].max() > 0.5
  assert forces[1][-1] == pytest.approx(forces[0][-1], rel=0.01)
