"""An exercise by a simulated hand: done, recorded, replayed to the bit, paused, stopped."""

import math

import mujoco
import numpy as np
import palpate
import pytest
from palpate.app import live
from palpate.app.live.devices.relative import Desk
from palpate.models import trocar, wrist
from palpate.models.handle import Wrist
from palpate.tasks import suite
from palpate.tasks.core import episode
from palpate.tasks.recording import Recording

KWARGS = {"input": "handle", "time_limit": 10}


def load(name="touch/easy", **kwargs):
  palpate.register()
  return suite.load(*suite.split(name), task_kwargs={"random": 0, **KWARGS, **kwargs})


def session(env, hand, **kwargs):
  pace = live.Pace.instant(env.physics.timestep())
  return live.Session(env, hand, 0, {"task_kwargs": KWARGS}, pace=pace, **kwargs)


class Toucher(live.Hand):
  """A person who brings the tip above the target, and presses until it is felt."""

  def __init__(self, env, **kwargs):
    self.env, self.shift, self._last, self._above = env, np.zeros(3), 0.0, False
    super().__init__(lambda t: tuple(self.shift), stiffness=400.0, damping=10.0, **kwargs)

  def read(self, now):
    physics, task = self.env.physics, self.env.task
    if now - self._last >= 0.02:
      self._last = now
      goal = task.goals[0]
      normal = physics.normal(goal)
      to = physics.point(goal) + 0.006 * normal - physics.tip_pos()
      self._above = self._above or np.linalg.norm(to) < 0.001
      if self._above:
        to = -3e-4 * normal * (np.linalg.norm(physics.contact_force()) < 0.12)
      step = physics.camera()[1].T @ to
      self.shift = self.shift + step * min(1.0, 8e-4 / max(np.linalg.norm(step), 1e-9))
    return super().read(now)


def test_an_exercise_is_done_by_hand_recorded_and_replayed(tmp_path):
  env = load()
  made = session(env, Toucher(env)).run()
  assert made.outcome == "success" and made.info["performer"] == "device:hand"
  assert made.info["live"]["steps"] == 20 * (len(made.time) - 1)
  assert made.info["live"]["faults"] == []
  old = Recording.load(made.save(tmp_path / "a.npz"))
  assert episode.differences(old, episode.replay(old)) == []
  assert math.isfinite(old.metrics().path_length)


def test_a_hand_without_orientation_leaves_the_shaft_as_it_is_turned():
  """The drawn pose has a roll: to take hold of the instrument must not undo it."""
  env = load(time_limit=1)
  made = session(env, live.Hand(lambda t: (0.0, 0.0, 0.0))).run()
  turn = np.abs(made.columns["quat"].reshape(-1, 4) @ made.columns["quat"].reshape(-1, 4)[0])
  assert 2 * np.degrees(np.arccos(np.minimum(turn, 1.0))).max() < 1.0


def test_held_keys_go_as_far_in_slow_motion():
  """A key is 60 mm a second of the simulation's time: the instrument is slow with the rest."""
  ends = []
  for speed in (1.0, 0.1):
    env, desk = load(time_limit=0.3), Desk()
    desk.feed(rate=(0.0, 1.0, 0.0, 0.0))
    made = session(env, desk)
    made.pace.speed = speed
    ends.append(made.run().column("tip_pos", 0)[-1])
  np.testing.assert_allclose(*ends, atol=1e-6)


def test_stopping_keeps_the_recording_and_lets_go():
  env = load()
  hand = live.Hand(lambda t: (0.0, 0.0, -0.01 * t))
  live_session = session(env, hand)
  live_session.coach = Stopper(live_session, 30)
  made = live_session.run()
  assert made.outcome == "stopped" and len(made.time) == 31
  assert hand.force == (0.0, 0.0, 0.0)


class Stopper:
  """Stops after some control steps."""

  def __init__(self, live_session, count):
    self.session, self.count = live_session, count

  def begin(self, env):
    pass

  def look(self, env):
    self.count -= 1
    self.session.pace.stopped = self.count <= 0

  def log(self):
    return {}


def test_a_pause_takes_no_time_of_the_exercise():
  """The hand presses its button twice: in between the clock of the exercise stands."""
  env = load(time_limit=1)
  held = lambda t: frozenset({"pause"} if 0.3 < t < 0.4 or 2.3 < t < 2.4 else ())  # noqa: E731
  hand = live.Hand(lambda t: (0.0, 0.0, 0.0), buttons=held)
  made = session(env, hand).run()
  assert made.time[-1] == pytest.approx(1.0) and made.outcome == "time limit"


def test_a_device_that_stumbles_is_in_the_recording():
  env = load(time_limit=1)
  hand = live.Hand(lambda t: (0.0, 0.0, 0.0) if t < 0.5 else (math.nan, 0.0, 0.0), damping=20.0)
  live_session = session(env, hand)
  live_session.coach = Stopper(live_session, 30)
  made = live_session.run()
  assert any("expected finite numbers" in fault for fault in made.info["live"]["faults"])


def test_pictures_are_of_fifty_moments_a_second_or_more():
  env = load(time_limit=1)
  times = []
  session(env, live.Hand(), publish=lambda s: times.append(s.env.physics.time())).run()
  assert 50 <= len(times) <= 62  # none beside the end of a control step


def test_two_hands_move_two_instruments_and_what_they_do_replays(tmp_path):
  """The right hand pulls its instrument up, the left one goes aside and switches its current on."""
  env = load("bimanual/easy", time_limit=0.6)
  right = live.Hand(lambda t: (0.0, 0.02 * t, 0.0))
  left = live.Hand(
    lambda t: (0.02 * t, 0.0, 0.0), buttons=lambda t: frozenset({"grip"} if t > 0.3 else ())
  )
  made = session(env, right, other=left).run()
  first, second = made.columns["tip_pos"].transpose(1, 0, 2)
  axes = env.physics.camera()[1]
  assert ((first[-1] - first[0]) @ axes)[1] > 0.004 > abs(((first[-1] - first[0]) @ axes)[0])
  assert ((second[-1] - second[0]) @ axes)[0] > 0.004 > abs(((second[-1] - second[0]) @ axes)[1])
  current = made.arrays["action"][1:, :, -1]
  assert (current[0] == -1).all() and (current[-1] == 1).all()
  assert 0.2 < made.columns["current"][-1, 0] < 0.35  # it is on, not told alone
  assert made.arrays["hook_felt"].shape == made.arrays["felt"].shape
  assert made.info["performer"] == "device:hand+hand"
  made.info["task_kwargs"] = {**KWARGS, "time_limit": 0.6}
  old = Recording.load(made.save(tmp_path / "a.npz"))
  assert episode.differences(old, episode.replay(old)) == []


def test_a_needle_stays_in_the_jaws_until_the_hand_has_closed_them_and_opens():
  """By the pose of the tip: the jaws are turned as they were, whatever way the hand goes."""
  assert suite.by_hand("suture/drive_easy") == "tip"
  env, held = load("suture/drive_easy", input="tip", time_limit=2), []
  closed = lambda t: frozenset({"grip"} if 0.4 < t < 0.6 else ())  # noqa: E731
  hand = live.Hand(lambda t: (0.0, 0.01 * t, 0.0), buttons=closed)
  look = lambda env: held.append((env.physics.time(), env.task.right_holds))  # noqa: E731
  made = session(env, hand).run(watch=look)
  assert made.outcome == "missed"  # it fell
  assert all(holds for time, holds in held if time < 0.6)
  assert not held[-1][1]
  early = made.columns["quat"][made.time < 0.5, 0]
  np.testing.assert_allclose(np.abs(early @ early[0]), 1.0, atol=1e-4)


def test_keys_lean_a_wrist_upwards_and_to_the_right_of_the_picture():
  """A device without orientation has a second and a third angle; what it leans stops in time."""
  env = load("suture/drive_easy", input="tip", time_limit=0.3)
  turned = []
  for rate in ((0, 0, 0, 0, 1, 0), (0, 0, 0, 0, 0, 1)):
    desk = Desk()
    desk.feed(rate=rate)
    quat = session(env, desk).run().columns["quat"][:, 0]
    away, both = np.empty(4), np.empty(3)
    mujoco.mju_mulQuat(away, quat[-1], quat[0] * [1, -1, -1, -1])
    mujoco.mju_quat2Vel(both, away, 1.0)
    turned.append(env.physics.camera()[1].T @ both)
  np.testing.assert_allclose(turned, 0.3 * np.array([[1, 0, 0], [0, -1, 0]]), atol=0.02)


def test_a_wrist_leans_as_far_as_its_joints_do():
  port = trocar.trocar(load("suture/drive_easy", input="tip").physics.model.ptr, "psm/")
  place, mat = wrist.forward(port, np.zeros(6))
  found = Wrist(port, trocar.orientation(mat))
  for _ in range(300):
    found.lean([0.02, 0.0, 0.0], place)
  far = found.quat(place)
  for _ in range(20):
    found.lean([-0.02, 0.0, 0.0], place)
  angle = 2 * np.arccos(min(abs(np.dot(far, found.quat(place))), 1.0))
  assert angle == pytest.approx(0.4, abs=0.01)  # it comes back at once


def test_hands_are_as_many_as_the_exercise_takes():
  with pytest.raises(ValueError, match="bimanual/easy: it takes two hands, expected another"):
    live.Session(load("bimanual/easy"), live.Hand())
  with pytest.raises(ValueError, match="touch/easy: it takes one hand, expected no other device"):
    live.Session(load(), live.Hand(), other=live.Hand())


def test_drives_are_refused():
  env = suite.load("touch", "easy", task_kwargs={"random": 0})
  with pytest.raises(ValueError, match="input is 'drives', expected 'handle'"):
    live.Session(env, live.Hand())
