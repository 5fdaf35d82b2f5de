"""The laparoscope of a live exercise: held by a hand, following the tip, and recorded."""

import functools

import numpy as np
import palpate
import pytest
from palpate.app import live
from palpate.app.live.devices.device import DeviceError
from palpate.app.live.devices.relative import Desk
from palpate.app.live.scope import Scope
from palpate.models import laparoscope
from palpate.tasks import suite
from palpate.tasks.core import episode

BACK = np.array([-0.05, 0.15, 0.12])
STEP = 0.02  # [s]
NOTHING = np.full((1, 3), 9.0)


def make(device=None):
  """Returns a laparoscope that looks at the origin from 0.2 m, level."""
  back = BACK / np.linalg.norm(BACK)
  right = np.cross([0, 0, 1], back)
  right /= np.linalg.norm(right)
  mat = np.column_stack([right, np.cross(back, right), back])
  return Scope(device or Desk(), BACK.copy(), mat, 50.0)


def off(scope, tip):
  """Returns how far a point is from the picture's middle, as a share of half its height."""
  x, y, back = scope.mat.T @ (tip - scope.pos)
  return np.hypot(x, y) / (-back * np.tan(np.radians(25)))


class Loose(Desk):
  """A device that says, at each reading, what a test tells it to."""

  says = None

  def read(self, now):
    if isinstance(self.says, DeviceError):
      raise self.says
    return self.says and self.says(super().read(now))

  def reopen(self):
    return not isinstance(self.says, DeviceError)


def test_a_device_that_fails_is_named_and_the_picture_stays_until_it_is_back():
  device = Loose("loose")
  scope, pos = make(device), BACK

  def same(reading, x=0.0):
    return reading._replace(pos=(x, 0.0, 0.0))

  stages = [
    (same, ""),
    (functools.partial(same, x=np.nan), "loose: pose is (nan, 0.0, 0.0), expected finite numbers"),
    (same, ""),
    (functools.partial(same, x=50.0), "jumped 50000 mm"),
    (DeviceError("loose: it is gone"), "loose: it is gone"),
    (same, ""),
    (None, "loose: no reading for 0.25 s"),
    (same, ""),
  ]
  for k, (says, told) in enumerate(stages):
    device.says = says
    for i in range(60 if says is None or k == 5 else 1):
      assert not scope.advance(2 * k + STEP * i, STEP, np.zeros(3), NOTHING)
    assert told in scope.message and bool(told) == bool(scope.message)
    np.testing.assert_array_equal(scope.pos, pos)
  device.says = functools.partial(same, x=0.01)
  assert scope.advance(20.0, STEP, np.zeros(3), NOTHING)


def test_it_begins_where_the_picture_was_and_stays():
  scope = make()
  pos, mat = scope.pos.copy(), scope.mat.copy()
  assert not any(scope.advance(STEP * k, STEP, np.zeros(3), NOTHING) for k in range(20))
  np.testing.assert_array_equal(scope.pos, pos)
  np.testing.assert_array_equal(scope.mat, mat)


@pytest.mark.parametrize("tip", [(0.05, 0.0, 0.0), (-0.03, -0.04, 0.02)])
def test_it_follows_slowly_and_only_what_has_strayed(tip):
  scope, tip = make(), np.array(tip)
  scope.follows = True
  still = np.array([0.01, 0.0, 0.0])
  assert off(scope, still) < 0.4
  assert not any(scope.advance(STEP * k, STEP, still, NOTHING) for k in range(20))
  places = [scope.pos.copy()]
  for k in range(400):
    scope.advance(STEP * (20 + k), STEP, tip, NOTHING)
    places.append(scope.pos.copy())
    assert abs(laparoscope.level(scope.mat)) < 1e-6
  assert off(scope, tip) < 0.06
  speed = np.linalg.norm(np.diff(places, axis=0), axis=1).max() / STEP
  assert 0.01 < speed < 0.06


def test_a_hand_moves_rolls_and_tilts_it():
  desk = Desk()
  scope = make(desk)
  scope.advance(0.0, STEP, np.zeros(3), NOTHING)
  desk.feed(move=(0.01, 0, 0, 0))
  right = scope.mat[:, 0].copy()
  start = scope.pos.copy()
  assert scope.advance(STEP, STEP, np.zeros(3), NOTHING)
  np.testing.assert_allclose((scope.pos - start) @ right, 0.01, rtol=0.05)
  desk.feed(move=(0, 0, -0.02, 0))
  back, before = scope.mat[:, 2].copy(), scope.pos.copy()
  scope.advance(2 * STEP, STEP, np.zeros(3), NOTHING)
  assert (scope.pos - before) @ -back == pytest.approx(0.02 * np.cos(laparoscope.OPTICS), rel=1e-3)
  # Rolled, the optics of 30 degrees look elsewhere, and the picture stays level.
  desk.feed(move=(0, 0, 0, 0.5))
  scope.advance(3 * STEP, STEP, np.zeros(3), NOTHING)
  assert scope.mat[:, 2] @ back < 0.98 and abs(laparoscope.level(scope.mat)) < 1e-9
  desk.feed(jaw=0.1)
  scope.advance(4 * STEP, STEP, np.zeros(3), NOTHING)
  assert laparoscope.level(scope.mat) == pytest.approx(0.1 * np.pi)
  scope.follows = True  # which levels
  for k in range(5, 60):
    scope.advance(k * STEP, STEP, np.zeros(3), NOTHING)
  assert abs(laparoscope.level(scope.mat)) < 1e-6


def test_the_lens_keeps_away_from_the_organ():
  desk = Desk()
  scope, start = make(desk), BACK.copy()
  scope.advance(0.0, STEP, start, NOTHING)
  desk.feed(move=(0, 0, -0.01, 0))
  scope.advance(STEP, STEP, start, NOTHING)
  organ = start[None] + 7 * (scope.pos - start)  # in the way of the shaft
  for k in range(2, 60):
    desk.feed(move=(0, 0, -0.005, 0))
    scope.advance(k * STEP, STEP, start, organ)
  assert 0.0199 < np.linalg.norm(scope.pos - organ) < 0.0251


def test_an_exercise_with_a_laparoscope_that_moves_is_replayed_to_the_bit():
  palpate.register()
  kwargs = {"input": "handle", "time_limit": 0.8}
  env = suite.load("touch", "easy", task_kwargs={"random": 0, **kwargs})
  desk = Desk()
  session = live.Session(
    env, live.Hand(lambda t: (0.02 * t, 0.0, 0.0)), 0, {"task_kwargs": kwargs}, camera=desk,
    pace=live.Pace.instant(env.physics.timestep()),
  )  # fmt: skip
  seen = []

  def watch(env):
    seen.append(env.physics.camera()[1])
    if len(seen) == 20:
      desk.feed(move=(0.03, 0.02, 0.0, 0.3), jaw=0.05)
    return False

  made = session.run(watch=watch)
  assert np.abs(seen[-1] - seen[0]).max() > 0.05
  rows = made.arrays["laparoscope"]
  assert np.isnan(rows[:20]).all() and np.isfinite(rows[-1]).all()
  # The hand goes on along the picture's new right: it moves by what is seen.
  pos = made.columns["tip_pos"][:, 0]
  way = pos[-1] - pos[30]
  assert way @ seen[-1][:, 0] > 0.98 * np.linalg.norm(way)
  assert episode.differences(made, episode.replay(made)) == []


def test_who_holds_the_laparoscope_as_the_instrument_has_no_other():
  palpate.register()
  kwargs = {"input": "handle", "time_limit": 0.4}
  env = suite.load("navigate", "standard", task_kwargs={"random": 0, **kwargs})
  desk = Desk()
  desk.feed(jaw=0.25)
  session = live.Session(
    env, desk, 0, {"task_kwargs": kwargs}, camera=Desk(),
    pace=live.Pace.instant(env.physics.timestep()),
  )  # fmt: skip
  made = session.run()
  assert session.scope is None and "laparoscope" not in made.arrays
  assert env.physics.head()[0] == pytest.approx(np.pi / 4, abs=0.02)
  assert episode.differences(made, episode.replay(made)) == []
