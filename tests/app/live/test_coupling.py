"""The coupling of a hand: steps, energy, clutch, scaling, limits, two hands, failing devices."""

import math
import time

import mujoco
import numpy as np
import palpate
import pytest
from palpate import models
from palpate.app import live

NEW = "probe/"


@pytest.fixture(scope="module")
def model():
  palpate.register()
  spec = models.load("liver", 250, handle=True, coupling="window")
  made = spec.compile()
  made.opt.timestep = 1e-3
  return made


def start(model, young=1.0):
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key("touch").id)
  mujoco.mj_forward(model, data)
  if young != 1.0:
    palpate.Organ(model, data, "liver/liver").configure(young=young)
  return data


def couple(model, data, hand, **options):
  return live.Loop(model, data, {NEW: hand}, live.Options(**options), live.Pace.instant())


def run(loop, duration, measure):
  out = []
  loop.run(duration, lambda loop: out.append(measure(loop)))
  return np.array(out)


@pytest.mark.parametrize("rate", [30, 1000])
def test_the_felt_force_has_no_steps(model, rate):
  """Pressed into the liver and over it at up to 63 mm/s; a handle that jumps 30 times a second
  makes steps of 1 N."""
  w = 2 * math.pi
  hand = live.Hand(lambda t: (0.01 * math.sin(w * t), 0, -0.005 * (1 - math.cos(w * t))), rate=rate)
  data = start(model)
  loop = couple(model, data, hand)
  force = run(loop, 1.2, lambda loop: loop.links[0].force)
  assert np.linalg.norm(force, axis=1).max() > 0.2
  assert np.linalg.norm(np.diff(force, axis=0), axis=1).max() < 0.1


def test_a_slow_device_feels_no_edge_from_a_fast_hand(model):
  """At 0.3 m/s and 30 Hz; without the limit the force on it has steps of 0.12 N."""
  w = 2 * math.pi * 3
  hand = live.Hand(lambda t: (0.01 * math.sin(w * t), 0, -0.005 * (1 - math.cos(w * t))), rate=30)
  loop = couple(model, start(model), hand)
  made = run(loop, 0.9, lambda loop: (*loop.links[0].force, math.hypot(*hand.vel)))
  assert made[:, 3].max() > 0.3 and np.linalg.norm(made[:, :3], axis=1).max() > 0.3
  assert np.linalg.norm(np.diff(made[:, :3], axis=0), axis=1).max() < 0.1


def thrown(model, rate, duration, mass=0.05, damping=0.0, stiffness=100.0):
  """Returns energies of a hand that is let go 20 mm off where a spring wants it, deep in tissue 30
  times as stiff: its own [J], and the account of what it has given [J]; and the loop."""
  hand = live.Hand(lambda t: (0, 0, -0.02), mass, damping, stiffness, rate)
  hand.pos = (0.0, 0.0, 0.0)
  loop = couple(model, start(model, 30.0), hand, ramp=0.0)

  def energy(loop):
    spring = 0.5 * stiffness * (math.dist(hand.pos, (0, 0, -0.02)) ** 2)
    return hand.energy + spring, loop.links[0].energy

  return run(loop, duration, energy).T, loop


@pytest.mark.parametrize(
  ("rate", "duration"),
  [
    (1000, 1.5),
    (30, 3),
    pytest.param(1000, 60, marks=pytest.mark.slow),
    pytest.param(30, 60, marks=pytest.mark.slow),
  ],
)
def test_a_hand_on_stiff_tissue_gains_no_energy(model, rate, duration):
  (own, account), _ = thrown(model, rate, duration)
  assert own.max() <= 0.5 * 100 * 0.02**2 + 1.0e-3 + 1e-9  # where it began, and what it is lent
  assert account.min() >= 0.0
  assert own[-100:].max() < 0.5 * own[0]


def test_the_account_is_what_keeps_a_slow_device_calm(model):
  """Without it the same hand at 30 Hz is thrown about: the test above can fail."""
  hand = live.Hand(lambda t: (0, 0, -0.02), 0.05, 0.0, 100.0, 30)
  hand.pos = (0.0, 0.0, 0.0)
  loop = couple(model, start(model, 30.0), hand, ramp=0.0, passive=False)
  assert run(loop, 1.5, lambda loop: hand.energy).max() > 0.2


def test_scaling_and_clutch(model):
  """At half scale the tip goes half as far; while the clutch is held it stays."""
  data = start(model)
  first = data.site("probe/tip").xpos.copy()
  held = lambda t: frozenset({"clutch"} if 0.6 < t < 1.2 else ())  # noqa: E731
  hand = live.Hand(
    lambda t: (0.0, 0.012 * min(t / 0.4, 1) + 0.02 * (t > 0.6), 0), 0.1, 9.0, buttons=held
  )
  loop = couple(model, data, hand, scale=0.5)
  path = run(loop, 1.8, lambda loop: data.site("probe/tip").xpos.copy())
  far = np.linalg.norm(path - first, axis=1)
  assert far[590] == pytest.approx(0.006, abs=2e-4)
  np.testing.assert_allclose(path[1150], path[590], atol=3e-4)
  assert far[-1] == pytest.approx(0.006, abs=5e-4)  # what the hand moved meanwhile counts nothing


def test_forces_come_by_a_ramp_and_stay_below_the_limits(model):
  hand = live.Hand(lambda t: (0, 0, -0.05), stiffness=1000.0)
  hand.pos = (0.0, 0.0, 0.0)
  loop = couple(model, start(model, 30.0), hand, ramp=1.0, force_limit=0.8, passive=False)
  force = np.linalg.norm(run(loop, 1.2, lambda loop: loop.links[0].force), axis=1)
  assert force[:40].max() < 0.4
  assert force.max() == pytest.approx(0.8)
  assert hand.force == (0.0, 0.0, 0.0)  # after the end


def test_a_motion_that_diverges_is_not_felt(model):
  hand = live.Hand(lambda t: (0, 0, -0.02))
  loop = couple(model, start(model), hand, ramp=0.0)
  loop.run(0.1)
  loop.links[0].feel([0.05] * 6)
  assert np.linalg.norm(hand.force) > 0.01
  loop.links[0].feel([math.nan] * 6)
  assert hand.force == (0.0, 0.0, 0.0)


def test_orientation_turns_the_shaft_and_is_felt(model):
  data = start(model)
  shaft = data.site("probe/tip").xmat.reshape(3, 3)[:, 2].copy()
  turn = data.cam("laparoscope").xmat.reshape(3, 3).T @ shaft

  def quat(t):
    half = 0.5 * min(t, 0.5)
    return (math.cos(half), *(math.sin(half) * turn))

  hand = live.Hand(lambda t: (0.0, 0.0, 0.0), quat=quat)
  roll = data.joint("probe/roll").qpos[0]
  loop = couple(model, data, hand)
  torque = run(loop, 1.0, lambda loop: hand.torque)
  assert abs(abs(data.joint("probe/roll").qpos[0] - roll) - 0.5) < 0.01
  assert 1e-3 < np.linalg.norm(torque, axis=1).max() < 0.1


def test_two_hands(model):
  data = start(model)
  hands = {
    "probe/": live.Hand(lambda t: (0.005 * min(t, 1), 0, 0)),
    "grasper/": live.Hand(lambda t: (0, 0.005 * min(t, 1), 0), rate=60),
  }
  tips = {p: data.site(f"{p}tip").xpos.copy() for p in hands}
  right, up = data.cam("laparoscope").xmat.reshape(3, 3)[:, :2].T
  live.Loop(model, data, hands, pace=live.Pace.instant()).run(1.2)
  for prefix, way in (("probe/", right), ("grasper/", up)):
    np.testing.assert_allclose(
      data.site(f"{prefix}tip").xpos - tips[prefix], 0.005 * way, atol=3e-4
    )


def test_jaws_close_with_the_hand(model):
  data = start(model)
  held = lambda t: frozenset({"grip"} if t > 0.5 else ())  # noqa: E731
  hand = live.Hand(lambda t: (0.0, 0.0, 0.0), buttons=held)
  loop = live.Loop(model, data, {"grasper/": hand}, pace=live.Pace.instant())
  opening = run(loop, 1.5, lambda loop: data.sensor("grasper/jaw").data[0])
  assert opening[450] > 0.5 and opening[-1] < 0.1


def test_another_device_takes_over_where_the_first_one_left(model):
  data = start(model)
  closed = []
  first = live.Hand(lambda t: (0.005 * min(t, 1), 0, 0))
  first.close = lambda: closed.append(1)
  loop = couple(model, data, first)
  path = run(loop, 0.5, lambda loop: data.site("probe/tip").xpos.copy())
  second = live.Hand(lambda t: (0.1, 0.004 * min(t / 0.4, 1), 0.2))  # it is somewhere else
  loop.links[0].change(second)
  after = run(loop, 0.8, lambda loop: data.site("probe/tip").xpos.copy())
  up = data.cam("laparoscope").xmat.reshape(3, 3)[:, 1]
  assert np.linalg.norm(np.diff([path[-1], *after], axis=0), axis=1).max() < 1e-4
  np.testing.assert_allclose(after[-1] - path[-1], 0.004 * up, atol=4e-4)
  assert loop.links[0].device is second
  for _ in range(100):
    if closed:
      break
    time.sleep(0.01)
  assert closed == [1] and first.force == (0.0, 0.0, 0.0)


def test_a_device_that_vanishes_in_mid_motion(model):
  """Force to zero, a pause in which nothing moves, and on from there when it is back."""
  data = start(model)
  hand = live.Hand(lambda t: (0, 0, -0.012 * min(t, 1)))
  loop = couple(model, data, hand)
  assert np.linalg.norm(run(loop, 0.8, lambda loop: hand.force)[-1]) > 0.05
  hand.gone, pauses = True, 0
  rest = loop.pace.rest

  def watch(seconds=0.01):
    nonlocal pauses
    pauses += 1
    if pauses == 1:
      hand.force = (0.0, 0.0, 0.0)  # an unplugged device pushes no more
      watch.time = data.time
    if pauses == 120:
      hand.gone = False
      hand.pos = (0.03, 0.0, 0.0)  # it was moved meanwhile
    rest(seconds)

  loop.pace.rest = watch
  force = run(loop, 0.5, lambda loop: loop.links[0].force)
  assert watch.time == pytest.approx(0.8)
  assert pauses >= 120 and loop.links[0].message == "hand: it is gone"
  assert np.linalg.norm(force[0]) < 0.05  # the ramp begins anew
  assert np.linalg.norm(np.diff(force, axis=0), axis=1).max() < 0.2


@pytest.mark.parametrize(
  ("pos", "said"),
  [
    ((math.nan, 0.0, 0.0), "hand: pose is (nan, "),
    ((0.0, math.inf, 0.0), "expected finite numbers"),
    ((0.5, 0.0, 0.0), "hand: jumped 500 mm in 1 ms"),
  ],
)
def test_a_pose_that_is_none_is_named_and_moves_nothing(model, pos, said):
  data = start(model)
  hand = live.Hand(lambda t: (0.0, 0.0, 0.0), stiffness=0.0)
  loop = couple(model, data, hand)
  loop.run(0.2)
  before = data.site("probe/tip").xpos.copy()
  hand.pos = pos
  loop.run(0.2)
  assert said in loop.links[0].message
  np.testing.assert_allclose(data.site("probe/tip").xpos, before, atol=2e-4)


def test_a_device_that_falls_silent_is_gone(model):
  hand = live.Hand(lambda t: (0.0, 0.0, 0.0))
  loop = couple(model, start(model), hand)
  loop.run(0.1)
  hand.read, rests, rest = lambda now: None, [], loop.pace.rest

  def stop(seconds=0.01):
    rests.append(loop.links[0].state)
    loop.pace.stopped = len(rests) > 3
    rest(seconds)

  loop.pace.rest = stop
  loop.run(1.0)
  assert rests[-1] == "lost" and "hand: no reading for 0.25" in loop.links[0].message


@pytest.mark.parametrize(
  ("name", "value"), [("scale", 0.0), ("force_limit", -1.0), ("ramp", math.nan)]
)
def test_options_that_are_none_are_named(name, value):
  with pytest.raises(ValueError, match=f"{name} is "):
    live.Options(**{name: value})
