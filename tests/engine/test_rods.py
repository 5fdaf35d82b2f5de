"""Threads: closed forms of rods, states, breaking, bad input."""

import mujoco
import numpy as np
import palpate
import pytest
import scenes
from palpate import batch
from scenes.rods import (
  BENDING,
  FREE,
  MASS,
  POISSON,
  RADIUS,
  STRETCH,
  document,
  force,
  line,
  load,
  run,
)
from scipy.optimize import brentq

STATE = mujoco.mjtState.mjSTATE_INTEGRATION


# Statics. Long steps lose their energy at once; a state at rest does not depend on them.


def test_a_hanging_thread_is_a_catenary():
  length, span, n = 0.15, 0.1, 76
  s = np.linspace(-length / 2, length / 2, n)
  slope = span / length
  points = np.stack([slope * s, 0 * s, np.abs(s) * np.sqrt(1 - slope**2)], axis=1)
  model, data, thread = load(points, pin=(0, n - 1), h=0.02, bend=1e-4)
  run(model, data, 400)
  a = brentq(lambda a: 2 * a * np.sinh(span / 2 / a) - length, 1e-3, 1)
  sag = points[0, 2] - thread.positions[:, 2].min()
  assert sag == pytest.approx(a * (np.cosh(span / 2 / a) - 1), rel=1e-2)
  horizontal = MASS / length * 9.81 * a
  assert thread.tension.min() == pytest.approx(horizontal, rel=1e-2)


def test_a_pulled_thread_stretches_by_hooke():
  model, data, thread = load(line(31, 0.06), pin=(0,), h=0.01, option=FREE)
  force(model, data, 30, (1.0, 0, 0))
  run(model, data, 100)
  assert thread.length / 0.06 - 1 == pytest.approx(1.0 / STRETCH, rel=1e-6)
  np.testing.assert_allclose(thread.tension, 1.0, rtol=1e-6)


def test_a_cantilever_is_eulers_elastica():
  """Of a tip load of 4 E I / L^2; from theta'' = -4 cos theta, theta(0) = theta'(1) = 0."""
  n, length = 61, 0.06
  edge = length / (n - 1)
  model, data, thread = load(line(n + 1, length + edge, -edge), pin=(0, 1), h=0.02, option=FREE)
  force(model, data, n, (0, 0, -4 * BENDING / length**2))
  run(model, data, 400)
  tip = thread.positions[-1] / length
  assert -tip[2] == pytest.approx(0.66996, rel=1e-3)
  assert 1 - tip[0] == pytest.approx(0.32894, rel=1e-3)


@pytest.mark.parametrize(("share", "buckles"), [(0.97, False), (1.03, True)])
def test_a_column_buckles_at_eulers_load(share, buckles):
  n, length = 41, 0.06
  edge = length / (n - 1)
  model, data, thread = load(line(n + 1, length + edge, -edge), pin=(0, 1), h=0.1, option=FREE)
  data.qpos[2::3] += 1e-5 * np.linspace(0, 1, n - 1) ** 2
  force(model, data, n, (-share * np.pi**2 * BENDING / 4 / length**2, 0, 0))
  run(model, data, 1200)
  assert (abs(thread.positions[-1, 2]) > 0.1 * length) == buckles


@pytest.mark.parametrize(("share", "buckles"), [(0.95, False), (1.05, True)])
def test_a_twisted_rod_buckles_at_greenhills_twist(share, buckles):
  """Clamped ends, no tension: G J theta / (2 E I) = 4.4934, the first root of tan x = x."""
  n, length = 41, 0.04
  edge = length / (n - 1)
  pins = (0, 1, n, n + 1)
  model, data, thread = load(line(n + 2, length + 2 * edge, -edge), pin=pins, h=0.05, option=FREE)
  critical = 2 * 4.4934 * (1 + POISSON)
  for _ in range(40):
    thread.turn(n, share * critical / 40)
    run(model, data, 1)
  assert thread.twist.sum() == pytest.approx(share * critical, rel=1e-9)
  data.qpos[1::3] += 1e-6 * np.sin(np.pi * np.linspace(0, 1, n - 2))
  run(model, data, 150)
  # The ends stay where they are: it buckles as far as it stretches.
  assert (np.abs(thread.positions[:, 1:]).max() > 5e-6) == buckles
  assert thread.twist.sum() == pytest.approx(share * critical, rel=1e-3)


# Motion.


def energy(data, thread):
  return thread.energy + 0.5 * MASS / len(thread.positions) * (data.qvel**2).sum()


def test_free_flight_keeps_momentum():
  model, data, _ = load(line(31, 0.06), option=FREE)
  rng = np.random.RandomState(0)
  data.qvel[:] = np.repeat(rng.normal(0, 0.1, (7, 3)), 5, axis=0)[:31].ravel()
  before = data.qvel.reshape(-1, 3).sum(axis=0)
  run(model, data, 300)
  np.testing.assert_allclose(data.qvel.reshape(-1, 3).sum(axis=0), before, rtol=1e-9)


@pytest.mark.parametrize(("yield_strain", "iterations"), [(0, 10), (2e-4, 30)])
def test_energy_only_falls(yield_strain, iterations):
  """Though light nodes are flung about, no step takes more than so many iterations."""
  keys = dict(option=FREE, iterations=iterations, yield_strain=yield_strain)
  model, data, thread = load(line(41, 0.08), pin=(0,), **keys)
  rng = np.random.RandomState(1)
  data.qvel[:] = np.repeat(rng.normal(0, 1.0, (8, 3)), 5, axis=0).ravel()
  energies = []
  for _ in range(300):
    run(model, data, 1)
    energies.append(energy(data, thread))
  assert (np.diff(energies) <= 1e-9 * energies[0]).all()
  assert thread.error is None
  assert np.any(thread.rest_curvature) == (yield_strain > 0)


def test_a_plucked_thread_rings_down_by_its_drag():
  """Its energy falls as exp(-c t / m) against that without, whatever the step itself damps."""
  n, drag, h, steps = 21, 8e-3, 1e-4, 800
  left = []
  for c in (0.0, drag):
    model, data, thread = load(line(n, 0.04), pin=(0, 1, n - 2, n - 1), h=h, option=FREE, drag=c)
    force(model, data, n // 2, (0, 0, 1e-5))
    run(model, data, 300)
    force(model, data, n // 2, (0, 0, 0))
    start = energy(data, thread)
    run(model, data, steps)
    left.append(energy(data, thread) / start)
  rate = drag * 0.04 / (n - 1) / (MASS / n)  # of a node [1/s]
  assert left[1] / left[0] == pytest.approx(np.exp(-rate * steps * h), rel=0.05)
  assert left[1] < 0.2 * left[0]


@pytest.mark.parametrize("h", [1e-3, 2e-3])
def test_a_sudden_pull_of_a_newton_is_borne(h):
  model, data, thread = load(line(61, 0.12), pin=(0,), h=h)
  run(model, data, 200)
  force(model, data, 60, (0.6, 0.8, 0))
  run(model, data, 300)
  assert thread.error is None
  np.testing.assert_allclose(thread.tension, 1.0, rtol=0.02)
  assert np.abs(data.qvel).max() < 0.1


# Plastic bending.


def bend_of(thread):
  """Returns the curvature of the nodes inside, as `Thread.rest_curvature`, (nnode - 2, 3)."""
  e = np.diff(thread.positions, axis=0)
  along = np.linalg.norm(e, axis=1)
  chi = along[1:] * along[:-1] + (e[1:] * e[:-1]).sum(axis=1)
  return 2 * np.cross(e[:-1], e[1:]) / chi[:, None]


@pytest.mark.parametrize("share", [0.3, 0.9, 1.1])
def test_a_bent_thread_springs_back_by_what_it_bears(share):
  """Let go from an arc of curvature k it keeps k - yield_strain / radius (perfect plasticity)."""
  curvature, edge = 50.0, 1e-3
  most = share * curvature
  model, data, thread = load(line(31, 30 * edge), option=FREE, yield_strain=most * RADIUS)
  angle = 2 * np.arctan(0.5 * curvature * edge) * np.arange(30)
  steps = edge * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
  rest = np.tile([0, -max(0.0, curvature - most) * edge, 0], (29, 1))
  thread.lay(np.append(np.zeros((1, 3)), np.cumsum(steps, axis=0), axis=0))
  model.opt.timestep = 1e-8  # its inertia holds it
  run(model, data, 1)
  model.opt.timestep = 0.01
  for _ in range(2):
    np.testing.assert_allclose(thread.rest_curvature[1:-1], rest, atol=1e-7)
    run(model, data, 100)
  np.testing.assert_allclose(bend_of(thread), rest, atol=1e-7)
  assert thread.energy < 1e-15


def test_what_does_not_yield_moves_as_an_elastic_thread():
  """To 0.1 um: a thread that may yield has its twist among its unknowns."""
  threads = []
  for keys in ({}, {"yield_strain": 0.01}):
    model, data, thread = load(line(42, 0.0615, -0.0015), pin=(0, 1), option=FREE, **keys)
    force(model, data, 41, (0, 1e-4, -4 * BENDING / 0.06**2))
    run(model, data, 60)
    threads.append(thread)
  assert not thread.rest_curvature.any() and np.abs(bend_of(thread)).max() > 0.05
  np.testing.assert_allclose(threads[1].positions, threads[0].positions, atol=1e-7)


def test_a_bend_that_is_kept_turns_with_the_thread():
  """About an axis along one of its ends, by more than a turn of which nothing is lost."""
  model, data, thread = load(line(41, 0.04), h=0.01, option=FREE, yield_strain=5e-4)
  s = np.linspace(0, 0.04, 41)
  bends = np.stack([s - 5 * s**2, 40 * s**3, 8 * s**2], axis=1)
  thread.lay(bends)
  model.opt.timestep = 1e-8
  run(model, data, 1)
  model.opt.timestep = 0.01
  run(model, data, 100)
  before, rest = bend_of(thread), thread.rest_curvature[1:-1]
  size = np.linalg.norm(rest, axis=1)
  assert size.max() > 0.01
  np.testing.assert_allclose(rest, before, atol=1e-4)
  places = thread.positions
  axis = (places[1] - places[0]) / np.linalg.norm(places[1] - places[0])
  data.qvel[:] = 2.0 * np.cross(axis, places - places.mean(axis=0)).ravel()
  run(model, data, 150)
  after = bend_of(thread)
  np.testing.assert_allclose(thread.rest_curvature[1:-1], after, atol=1e-3)
  np.testing.assert_allclose(np.linalg.norm(after, axis=1), size, atol=1e-3)
  assert ((before * after).sum(axis=1) < 0.0)[size > 0.01].all()


# States.


@pytest.mark.parametrize("yield_strain", [0, 1e-3])
def test_a_state_has_all_there_is_to_the_bit(yield_strain):
  points = line(21, 0.04)
  args = dict(pin=(0, 1, 19, 20), world='<geom type="capsule" size=".004 .02" pos=".02 0 -.006"/>')
  model, data, thread = load(points, yield_strain=yield_strain, **args)
  data.qvel[1::3] = 0.05
  data.qvel[2::3] = -0.2
  thread.turn(0, 0.3)
  run(model, data, 80)

  def drive(each):
    run(model, each, 60)
    return np.append(each.qpos, each.plugin_state)

  scenes.goes_on(model, data, drive)
  assert np.abs(thread.twist).max() > 1e-3
  assert np.any(thread.rest_curvature) == (yield_strain > 0)


def test_reset_forgets_twist_and_errors():
  model, data, thread = load(line(11, 0.02), pin=(0, 1))
  thread.turn(0, 0.3)
  data.qpos[0] = np.nan
  run(model, data, 2)
  assert "position (qpos 0) is not finite" in thread.error
  mujoco.mj_resetData(model, data)
  run(model, data, 1)
  assert thread.error is None
  assert np.abs(thread.twist).max() < 1e-6


# Breaking.


def test_a_thread_breaks_above_its_strength_and_falls_freely():
  """Where it hangs, since there its own weight adds most; in every state and copy alike."""
  strength, weight = 0.01, MASS * 9.81
  model, data, thread = load(
    line(21, 0.04), pin=(0,), strength=strength, option='gravity="9.81 0 0"'
  )
  state, pull = np.zeros(mujoco.mj_stateSize(model, STATE)), 0.9 * (strength - weight)
  while not thread.broken.any():
    mujoco.mj_getState(model, data, state, STATE)
    pull += 1e-5
    force(model, data, 20, (pull, 0, 0))
    run(model, data, 1)
  assert thread.broken.nonzero()[0].tolist() == [0]
  assert pull + weight * 20.5 / 21 == pytest.approx(strength, rel=0.02)
  again, copied = mujoco.MjData(model), mujoco.MjData(model)
  handles = [thread, *(palpate.Thread(model, each, "t") for each in (again, copied))]
  mujoco.mj_setState(model, again, state, STATE)
  assert not handles[1].broken.any()
  force(model, again, 20, (pull, 0, 0))
  run(model, again, 1)
  mujoco.mj_copyData(copied, model, again)
  speed = data.qvel[::3].mean()
  for each in (data, again, copied):
    each.qfrc_applied[:] = 0
    run(model, each, 20)
    np.testing.assert_array_equal(each.plugin_state, data.plugin_state)
    np.testing.assert_array_equal(each.qpos, data.qpos)
  assert data.qvel[::3].mean() == pytest.approx(speed + 0.02 * 9.81, rel=1e-6)
  assert thread.tension[0] == 0.0 and all(each.broken[0] for each in handles)
  mujoco.mj_resetData(model, data)
  assert not thread.broken.any()


@pytest.mark.parametrize("strength", [0, 0.05])
def test_a_ball_falls_through_a_thread_that_it_breaks(strength):
  """MuJoCo still has the edge that has broken: the parts would hold the ball between them."""
  world = '<body name="ball" pos=".021 0 .0022"><freejoint/><geom size=".002" mass=".002"/></body>'
  model, data, thread = load(line(21, 0.04), pin=(0, 20), world=world, strength=strength)
  for _ in range(150):
    run(model, data, 1)
    if data.body("ball").xpos[2] < -0.05:
      break
  assert thread.broken.any() == (data.body("ball").xpos[2] < -0.05) == (strength > 0)
  assert thread.error is None


def test_a_part_of_a_thread_is_laid_under_tension():
  _, _, thread = load(line(31, 0.03), option=FREE)
  before = thread.positions
  thread.lay([before[10], (0.004, 0.004, 0), (-0.03, 0, 0.002)], np.arange(10, -1, -1), 0.5)
  np.testing.assert_allclose(thread.positions[10:], before[10:], atol=1e-12)
  # A chord of the corner is as long as the edge.
  np.testing.assert_allclose(thread.tension, np.repeat([0.5, 0.0], [10, 20]), atol=1e-6)


def test_a_step_that_is_not_solved_is_told():
  model, data, thread = load(line(31, 0.06), pin=(0,), iterations=1, option=FREE)
  data.qvel[1::3] = np.sin(np.linspace(0, 9, 30))
  run(model, data, 1)
  assert "a step was not solved in 1 iterations" in thread.error


def test_a_foreign_state_is_refused():
  model, data, thread = load(line(11, 0.02))
  data.plugin_state[:] = 3.0
  run(model, data, 1)
  assert "not one of this thread" in thread.error


# Bad input.


@pytest.mark.parametrize(
  ("kwargs", "message"),
  [
    (dict(points=line(5, 3e-4)), r"edge \d is 0.075 mm long and radius is 0.1 mm"),
    (dict(points=[[0, 0, 0], [9e-3, 0, 0], [9e-3, 9e-3, 0], [5e-3, 9e-3, 0], [5e-3, -9e-3, 0]]),
     "edges 0 and 3 start 0 mm from each other and radius is 0.1 mm"),
    (dict(points=line(5, 0.01), thickness=0.001), "thickness is set and elements is 'rod'"),
    (dict(points=line(5, 0.01), twist=-1), "thread 't': twist is '-1', expected a number >= 0"),
    (dict(points=line(5, 0.01), yield_strain=-1), "yield_strain is '-1', expected a number >= 0"),
    (dict(points=line(5, 0.01), yield_strain=0.1, twist=0), "allowed only where twist is not 0"),
    (dict(points=line(5, 0.01), option='integrator="RK4"'), "RK4"),
    (dict(points=line(5, 0.01), elements="solid"), "flexcomp dim is 1, expected dim='2'"),
    (dict(points=line(5, 0.01), contact='selfcollide="auto"'), "selfcollide"),
  ],
)  # fmt: skip
def test_bad_threads_are_named(kwargs, message):
  text = document(kwargs.pop("points"), **kwargs)
  if "selfcollide" in message:
    text = text.replace('selfcollide="none" ', "")
  with pytest.raises(ValueError, match=message):
    mujoco.MjModel.from_xml_string(text)


def test_threads_are_stepped_in_batches_on_the_cpu():
  model, data, _ = load(line(11, 0.02), pin=(0,))
  worlds = batch.make(model, 3, "cpu")
  worlds.step(30)
  run(model, data, 30)
  np.testing.assert_allclose(worlds.qpos.numpy()[2], data.qpos, atol=1e-8)  # single precision


def test_add_thread_writes_what_mjcf_says():
  spec = mujoco.MjSpec()
  spec.option.gravity = 0, 0, 0
  palpate.add_thread(spec, line(21, 0.04), "silk", material="silk", size="4-0", pin=(0,))
  model = spec.compile()
  data = mujoco.MjData(model)
  thread = palpate.Thread(model, data, "silk")
  adr = model.body("silk_20").dofadr[0]
  data.qfrc_applied[adr] = 0.5
  run(model, data, 300)
  stretch = 8.7e9 * np.pi * (0.0875e-3) ** 2
  assert thread.length / 0.04 - 1 == pytest.approx(0.5 / stretch, rel=1e-3)


@pytest.mark.parametrize(
  ("kwargs", "message"),
  [
    (dict(points=[[0, 0, 0]]), r"points is \(1, 3\), expected \(n, 3\), n of 2 or more"),
    (dict(material="nylon"), "material is 'nylon', expected one of vicryl, silk, polypropylene"),
    (dict(size="9-0"), "size is '9-0', expected one of 3-0, 4-0, 5-0"),
    (dict(pin=(30,)), "thread 'thread': pin has 30"),
    (dict(foundation=3), "foundation is set and elements is 'rod'"),
  ],
)
def test_add_thread_names_bad_input(kwargs, message):
  with pytest.raises(ValueError, match=message):
    palpate.add_thread(mujoco.MjSpec(), kwargs.pop("points", line(11, 0.02)), **kwargs)
