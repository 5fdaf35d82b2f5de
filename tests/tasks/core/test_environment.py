"""Environments as dm_control has them: its own checks, control steps, time limits, observations."""

import pathlib

import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils
from palpate import tasks
from palpate.tasks import registry, suite
from palpate.tasks.core import observation, performer

PAGE = pathlib.Path(__file__).parents[3] / "docs" / "environments.md"
PICTURES = ("pixels", "depth", "segmentation", "points")


def load(name, environment=None, **options):
  return tasks.load(
    *suite.split(name), task_kwargs={"random": 0, **options}, environment_kwargs=environment
  )


class Conformance(test_utils.EnvironmentTestMixin, absltest.TestCase):
  """dm_env's checks of timesteps, specs and the sequence of episodes."""

  def make_object_under_test(self):
    return load("grasp/easy", observations=("sensors", "state", *PICTURES), pixels=(12, 16))

  def make_action_sequence(self):
    spec = self.environment.action_spec()
    for _ in range(5):
      yield spec.generate_value()


class FlatConformance(test_utils.EnvironmentTestMixin, absltest.TestCase):
  """The same of flat observations, which dm_control offers."""

  def make_object_under_test(self):
    return load("touch/easy", {"flat_observation": True, "n_sub_steps": 5}, time_limit=0.05)


@pytest.mark.parametrize(
  "arguments, step", [({}, 0.02), ({"control_timestep": 0.05}, 0.05), ({"n_sub_steps": 10}, 0.01)]
)
def test_control_timestep_and_sub_steps(arguments, step):
  env = load("touch/easy", arguments, time_limit=0.2)
  env.reset()
  before, count = env.physics.drive_targets().copy(), 0
  timestep = env.step(np.array([0.0, 0.0, 1.0, 0.0]))
  # An action is a rate, whatever the step.
  assert env.physics.drive_targets()[2] - before[2] == pytest.approx(3.0 * step)
  assert env.physics.time() == pytest.approx(step) == env.control_timestep()
  while not timestep.last():
    timestep, count = env.step(np.zeros(4)), count + 1
  assert count + 1 == round(0.2 / step) and env.physics.time() == pytest.approx(0.2)


def test_experts_act_at_other_rates():
  for name, arguments in (("touch/easy", {"n_sub_steps": 10}), ("probe/easy", {"n_sub_steps": 30})):
    env = load(name, arguments)
    act, timestep = performer.make(env), env.reset()
    while not timestep.last():
      timestep = env.step(act(timestep))
    assert env.task.outcome == "success"


@pytest.mark.parametrize(
  "environment, options, said",
  [
    ({"n_sub_steps": 0}, {}, "n_sub_steps is 0, expected a whole number >= 1"),
    ({"n_sub_steps": 2.5}, {}, "n_sub_steps is 2.5, expected a whole number >= 1"),
    ({"control_timestep": -0.02}, {}, "control_timestep is -0.02, expected a number > 0"),
    ({"control_timestep": 0.0205}, {}, "must be an integer multiple"),
    ({"n_sub_steps": 20, "control_timestep": 0.02}, {}, "Both n_sub_steps and control_timestep"),
    ({}, {"time_limit": 0}, "time_limit is 0, expected a number > 0"),
    ({}, {"observations": "state"}, "observations is 'state', expected a list of names"),
    ({}, {"observations": ()}, "observations is empty, expected some of sensors, state, pixels"),
    ({}, {"observations": ("gripper",)}, r"observations has 'gripper', .*: joints, joint_vel, "),
    ({}, {"pixels": (0, 3)}, r"pixels is \(0, 3\), expected height and width, both whole numbers"),
    ({}, {"pixels": (2000, 3)}, "pixels is 2000, 3, expected at most 960, 1280"),
  ],
)
def test_what_is_not_allowed_is_said(environment, options, said):
  with pytest.raises(ValueError, match=said):
    load("touch/easy", environment, **options)


# Observations.


def test_groups_can_be_switched_off():
  sensors = [name for name, row in observation.ROWS.items() if row.group == "sensors"]
  own = {"grasp/easy": "gripper", "touch/easy": None, "navigate/easy": "camera_head"}
  for name, has in own.items():
    rest = {"gripper", "camera_head"} - {has}
    both, robot, state = (
      load(name, observations=groups).reset().observation
      for groups in (None, ["sensors"], ["state"])
    )
    assert list(robot) == [each for each in sensors if each not in rest]
    assert set(robot) | set(state) == set(both) and not set(robot) & set(state)
    assert {"nodes_near", "surface", "progress", "target"} <= set(state)


def test_single_observations_can_be_chosen():
  env = load("touch/easy", observations=["sensors", "target"])
  assert "target" in env.observation_spec() and "normal" not in env.observation_spec()
  env = load("touch/easy", observations=["tip_pos"], pixels=(8, 8))
  assert list(env.reset().observation) == ["tip_pos", "pixels"]


@pytest.mark.parametrize("surroundings", ["none", "abdomen"])
def test_pictures_agree_with_each_other_and_with_the_scene(surroundings):
  env = load("grasp/easy", observations=PICTURES, pixels=(60, 80), surroundings=surroundings)
  seen = env.reset().observation
  assert list(seen) == list(PICTURES)
  label, depth, points = seen["segmentation"], seen["depth"], seen["points"]
  organ, tool, mark = (label == observation.LABELS[n] for n in ("organ", "instrument", "target"))
  assert organ.mean() > 0.05 and tool.any() and mark.any() and (label == 0).any()
  # Colours: the organ's mean is not the background's.
  assert np.abs(seen["pixels"][organ].mean(0) - seen["pixels"][label == 0].mean(0)).max() > 20
  np.testing.assert_array_equal(points[..., 2][label > 0], depth[label > 0])
  if surroundings == "none":
    assert (points[label == 0] == 0).all() and np.ptp(depth[label == 0]) == 0
  else:  # the wall is everywhere behind
    assert (depth > 0).all() and depth.max() < 0.5
    np.testing.assert_array_equal(points[..., 2], depth)
  # In the world, points of the organ lie on its nodes, up to an edge, and the tip's on the tip.
  pos, axes, _ = env.physics.camera()
  world = points * [1, -1, -1] @ axes.T + pos
  nodes = env.physics.nodes()
  away = np.linalg.norm(world[organ][::7, None] - nodes, axis=2).min(axis=1)
  assert away.max() < 0.006
  assert np.linalg.norm(world[tool] - env.physics.tip_pos(), axis=1).min() < 0.006


def test_pictures_do_not_show_what_is_hidden():
  env = load("probe/palpate_easy", observations=["sensors", "segmentation"], pixels=(60, 80))
  env.reset()
  spread = {}
  for shown in (False, True):
    env.physics.mark(0, env.task.inclusion + np.array([0, 0, 0.004]), shown=shown)
    label = env.task.get_observation(env.physics)["segmentation"]
    spread[shown] = (label == observation.LABELS["target"]).any()
  assert spread == {False: False, True: True}


def test_specs_draw_nothing(monkeypatch):
  env = load("touch/easy", observations=PICTURES)
  monkeypatch.setattr(type(env.physics), "contexts", property(lambda _: pytest.fail("it drew")))
  assert env.observation_spec()["pixels"].shape == (84, 84, 3)


def test_the_page_has_every_observation():
  page = PAGE.read_text()
  assert observation.table() in page  # paste it anew
  for domain, names in registry.TASKS.items():
    for name in names:
      if "easy" not in name:
        continue  # what the easy ones have
      env = load(f"{domain}/{name}")
      for key, spec in env.observation_spec().items():
        shape = "(" + ", ".join(map(str, spec.shape)) + "," * (len(spec.shape) == 1) + ")"
        bare = key.removeprefix("hook_").removeprefix("left_psm_")
        row = observation.ROWS.get(bare)
        if row:
          wristed = env.physics.trocar().wrist and bare in ("joints", "joint_vel", "drive")
          assert spec.shape == ((6,) if wristed else row.shape) and spec.dtype == np.float64
        else:
          cells = f" | `{key}` | `state` | {shape} | float64 |"
          exercise = f"{domain}/{name.removesuffix('_easy')}"
          assert f"| {domain}{cells}" in page or f"| {exercise}{cells}" in page
