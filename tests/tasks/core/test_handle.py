"""Exercises by handle: the same success, recording and replay, and what the hand feels."""

import copy

import numpy as np
import pytest
from palpate.tasks import suite
from palpate.tasks.core import episode, performer
from palpate.tasks.recording import Recording

HANDLE = {"input": "handle"}


def load(name="touch/easy", **kwargs):
  return suite.load(*suite.split(name), task_kwargs={"random": 0, **HANDLE, **kwargs})


def hold(env):
  """Returns the action that holds the handle where it is."""
  extra = np.zeros(len(env.task.extra))
  return np.concatenate([env.physics.handle.pos, env.physics.handle.quat, extra])


@pytest.mark.parametrize("name", ["touch/easy", "probe/easy", "grasp/easy"])
def test_the_expert_succeeds_by_handle_and_replays_to_the_bit(name, tmp_path):
  env = load(name)
  made = episode.run(env, performer.make(env, seed=0), 0, {"task_kwargs": HANDLE})
  assert made.outcome == "success"
  assert np.abs(made.arrays["felt"][1:, :, :3]).max() > 0.05  # the hand felt the organ [N]
  old = Recording.load(made.save(tmp_path / "a.npz"))
  assert episode.differences(old, episode.replay(old)) == []


def test_the_expert_succeeds_by_the_pose_of_the_tip_and_replays_to_the_bit(tmp_path):
  env = load(input="tip")
  made = episode.run(env, performer.make(env, seed=0), 0, {"task_kwargs": {"input": "tip"}})
  assert made.outcome == "success"
  old = Recording.load(made.save(tmp_path / "a.npz"))
  assert episode.differences(old, episode.replay(old)) == []


def test_rows_are_places_evenly_spaced_over_the_step():
  """One row, two on the straight line to it, and one for each step of the physics, are the same."""
  ends = []
  for count in (1, 2, 20):
    env = load()
    env.reset()
    start = hold(env)
    goal = start + np.r_[0.003, -0.002, 0.001, np.zeros(4)]
    share = np.arange(1, count + 1)[:, None] / count
    env.step(start + share * (goal - start))
    ends.append(np.concatenate([env.physics.handle.pos, env.physics.tip_pos()]))
  np.testing.assert_allclose(ends[0][:3], goal[:3], atol=1e-12)
  np.testing.assert_allclose(ends[1:], ends[:1] * np.ones((2, 1)), atol=1e-12)


def test_the_tip_follows_the_handle():
  env = load()
  env.reset()
  row = hold(env)
  row[:3] += [0.004, 0.003, 0.002]
  row[3:7] = env.physics.handle_row(row[:3], 0.4)[3:]
  for _ in range(40):
    env.step(row)
  np.testing.assert_allclose(env.physics.tip_pos(), row[:3], atol=2e-4)
  np.testing.assert_allclose(env.physics.joints()[2], 0.4, atol=5e-3)
  np.testing.assert_allclose(env.physics.drive_targets()[2], 0.4, atol=1e-9)


def test_a_copy_goes_on_to_the_bit():
  env = load("grasp/easy")
  act = performer.make(env, seed=0)
  timestep = env.reset()
  for _ in range(30):
    timestep = env.step(act(timestep))
  twin = copy.deepcopy(env)
  row = np.r_[hold(env)[:-1], 0.5]
  for _ in range(5):
    row[:3] += 0.0005
    first, second = env.step(row), twin.step(row)
  for name, value in first.observation.items():
    np.testing.assert_array_equal(value, second.observation[name])


@pytest.mark.parametrize(
  ("change", "said"),
  [
    (lambda row: row[:5], r"action has shape \(5,\), expected \(7,\): x, y, z, qw, qx, qy, qz"),
    (lambda row: row + np.r_[np.nan, np.zeros(6)], "action x is nan, expected a number in"),
    (lambda row: np.stack([row, 3 + row]), r"action x is 3\..*, expected a number in \[-1, 1\]"),
    (lambda row: row[None, None], "has shape"),
  ],
)
def test_what_is_no_row_is_named(change, said):
  env = load()
  env.reset()
  with pytest.raises(ValueError, match=said):
    env.step(change(hold(env)))


def test_what_is_no_input_is_named():
  with pytest.raises(ValueError, match="input is 'hand', expected one of drives, handle"):
    load(input="hand")


def test_gymnasium_takes_it():
  gymnasium = pytest.importorskip("gymnasium")
  import palpate.tasks  # noqa: F401

  env = gymnasium.make("palpate/Touch-v0", input="handle")
  env.reset(seed=0)
  assert env.action_space.shape == (7,)
  _, _, terminated, _, info = env.step(hold(env.unwrapped.environment).astype(np.float64))
  assert not terminated and info["outcome"] is None
  env.close()


def test_pictures_do_not_show_the_handle():
  seen = []
  for how in ("drives", "handle"):
    env = suite.load("touch", "easy", task_kwargs={"random": 0, "input": how})
    env.reset()
    camera = env.physics.model.ptr.camera("laparoscope").id
    seen.append(env.physics.render(60, 80, camera_id=camera))
  np.testing.assert_array_equal(*seen)
