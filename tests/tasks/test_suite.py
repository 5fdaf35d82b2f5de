"""The exercises, after dm_control's suite_test: specs, seeds, observations, rewards, reset."""

import itertools

import mujoco
import numpy as np
import pytest
from palpate import models, tasks
from palpate.tasks import metrics, registry, suite
from palpate.tasks.core import engine, performer, scenes
from palpate.tasks.domains import grasp

IDS = ["/".join(pair) for pair in tasks.ALL_TASKS]
# Levels of an exercise are one text with other numbers: one of each, and at length all.
LEVELS = [
  pytest.param(name, marks=pytest.mark.slow) if name.endswith(("standard", "hard")) else name
  for name in IDS
]
_cache = {}


def load(name, **kwargs):
  return tasks.load(*suite.split(name), task_kwargs={"random": 0, **kwargs})


@pytest.fixture(params=IDS)
def env(request):
  """One environment a task, made once: the organ's mesh takes a second."""
  if request.param not in _cache:
    _cache[request.param] = load(request.param)
  seed(_cache[request.param], 0)
  return _cache[request.param]


def seed(env, value):
  env.task.random = np.random.RandomState(value)


def actions(env, count, value=1):
  spec = env.action_spec()
  draw = np.random.RandomState(value).uniform
  found = [draw(spec.minimum, spec.maximum) for _ in range(count)]
  if "report" in env.task.components:  # a report ends the episode
    for action in found:
      action[4] = -1.0
  return found


def roll(env, steps):
  out = [env.reset()]
  for action in actions(env, steps):
    out.append(env.step(action))
  return out


def test_tasks_and_tags():
  assert set(tasks.BENCHMARKING) == set(tasks.ALL_TASKS)
  assert set(tasks.EASY) | set(tasks.HARD) < set(tasks.ALL_TASKS)
  assert suite.TASKS_BY_DOMAIN == registry.TASKS  # what is read is what is there
  assert registry.TASKS["probe"][:4] == ("easy", "standard", "hard", "depth")  # as written


def test_unknown_names_list_the_choices():
  with pytest.raises(ValueError, match=r"domain is 'tuch', expected .*; did you mean 'touch'\?"):
    tasks.load("tuch", "easy")
  with pytest.raises(ValueError, match=r"'eazy', expected one of easy, .*; did you mean 'easy'\?"):
    tasks.load("touch", "eazy")
  with pytest.raises(ValueError, match=r"task is 'touch/eazy', .*; did you mean 'touch/easy'\?"):
    suite.split("touch/eazy")
  with pytest.raises(ValueError, match="reward is 'dence', expected one of dense, sparse"):
    load("touch/easy", reward="dence")


def test_specs_and_observations(env):
  spec = env.action_spec()
  assert spec.shape == (len(env.task.components),)
  assert (spec.minimum == -1).all() and (spec.maximum == 1).all()
  assert spec.name.split("\t") == list(env.task.components)
  assert env.control_timestep() == pytest.approx(0.02)
  assert env.physics.timestep() == 0.001
  specs = env.observation_spec()
  for timestep in roll(env, 3):
    assert list(timestep.observation) == list(specs)
    for name, value in timestep.observation.items():
      specs[name].validate(value)
      assert value.dtype == np.float64 and np.isfinite(value).all(), name


@pytest.mark.parametrize("env", LEVELS, indirect=True)
def test_a_seed_decides_everything(env):
  first = roll(env, 6)
  state = env.physics.integration_state()
  seed(env, 0)
  second = roll(env, 6)
  np.testing.assert_array_equal(state, env.physics.integration_state())
  for a, b in zip(first, second, strict=True):
    assert a.reward == b.reward
    for name in a.observation:
      np.testing.assert_array_equal(a.observation[name], b.observation[name], err_msg=name)
  seed(env, 1)
  other = env.reset()
  assert not np.array_equal(other.observation["tip_pos"], first[0].observation["tip_pos"])


@pytest.mark.parametrize("env", LEVELS, indirect=True)
def test_rewards_are_finite_and_bounded_and_the_episode_can_start_anew(env):
  for _ in range(2):
    steps = roll(env, 8)
    total = 0.0
    for timestep in steps[1:]:
      if timestep.first():  # an episode ended before
        break
      assert np.isfinite(timestep.reward) and -2 <= timestep.reward <= 1
      total += timestep.reward
    assert total <= 1 + 1e-9
  # From whatever state the physics is in:
  env.physics.data.qvel[:] = np.random.RandomState(0).normal(size=env.physics.model.nv) * 0.1
  seed(env, 0)
  a = env.reset()
  seed(env, 0)
  b = env.reset()
  for name in a.observation:
    np.testing.assert_array_equal(a.observation[name], b.observation[name], err_msg=name)


def test_going_on_from_a_state_gives_the_same_to_the_bit():
  env = load("touch/easy")
  roll(env, 5)
  state = env.physics.integration_state()
  ends = []
  for _ in range(2):
    env.physics.place(state)
    for action in actions(env, 5, 2):
      env.task.before_step(action, env.physics)
      env.physics.step(20)
    ends.append(env.physics.integration_state())
  np.testing.assert_array_equal(*ends)


def test_dense_reward_is_the_change_of_progress_and_takes_back_what_is_lost():
  env = load("touch/easy")
  first = env.reset()
  assert first.observation["progress"] == 0 and first.observation["peak_force"] == 0
  total, least = 0.0, 0.0
  for k in range(40):  # towards the organ, then away from it
    timestep = env.step(np.array([0, 0, 0, 0.5 if k < 10 else -1.0]))
    total += timestep.reward
    least = min(least, timestep.reward)
    np.testing.assert_allclose(total, 0.4 * timestep.observation["progress"][0], atol=1e-12)
  assert least < -0.004 and total < 0
  assert env.reset().observation["progress"] == 0


def test_a_potential_shows_the_way_to_a_grasp():
  env = load("grasp/easy")
  task, potential, loose = env.task, {}, []

  def go(opening, *steps):
    """Notes the potential after moves to heights over the site and beside it [m], and openings."""
    act = performer.make(env)
    timestep = env.reset()
    act.begin()
    act.extra[:] = opening
    across, _, up = act.trocar.mat.T
    site = env.physics.point(task.site)
    for name, height, opening, *aside in steps:
      for action in act.move(site + height * up + sum(aside) * across, speed=0.03):
        env.step(action)
      while act.extra[0] > opening:
        act.extra -= 0.03
        timestep = env.step(act.step())
      potential[name] = task.progress + task.shaping
      assert not timestep.last() and potential[name] < 1
    task.done, task.lowered = True, grasp.REST
    resting = grasp.shaping(env.physics, task)
    task.lowered = 0.0
    loose.append(resting - grasp.shaping(env.physics, task))

  go(-0.68, ("beside, closed", 0.01, -0.68), ("pressed, closed", -0.006, -0.68))
  go(1.0, ("beside", 0.01, 1.0), ("over it", -0.006, 1.0), ("closing", -0.006, -0.2),
     ("grasped", -0.006, -0.55), ("lifted", 0.001, -0.55), ("pushed", -0.012, -0.55),
     ("deep", -0.018, -0.55))  # fmt: skip
  go(-0.68, ("sunk in aside, closed", -0.009, -0.68, 0.006))
  order = ["beside, closed", "beside", "over it", "closing", "grasped", "lifted"]
  assert sorted(order, key=potential.__getitem__) == order
  assert loose[1] < 0.5 * grasp.LOOSE < 0.9 * grasp.LOOSE < loose[2] <= grasp.LOOSE
  assert potential["pressed, closed"] < potential["over it"] - 0.1
  assert potential["sunk in aside, closed"] < potential["beside"]
  assert potential["closing"] < potential["deep"] < potential["pushed"] - 0.02
  assert potential["pushed"] < potential["grasped"] - 0.02
  told = []  # of a fold that was held long enough, far above the lift, above and at rest, and below
  for lifts in (1.9, 1.2, 0.6, 0.0, -0.5, -2.0):
    task.rest = env.physics.point(task.site) - lifts * task.lift * task.up
    high = min(max(lifts, 0.0), 1.0)
    told.append(0.9 + 0.05 * (1.0 - high) + grasp.shaping(env.physics, task))
  assert (np.diff(told[:4]) > 0.01).all() and (np.diff(told[3:]) < -0.01).all()


def test_quick_forms_agree_with_the_plain_ones():
  env = load("grasp/easy")
  physics = env.physics
  env.reset()
  camera = physics.model.ptr.camera("laparoscope").id
  seen = set()
  for turn in np.linspace(-0.8, 0.8, 9):  # of the camera about its own vertical
    pos, mat, fovy = physics.camera()
    rotation = np.array(
      [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    kept = physics.data.ptr.cam_xmat[camera].copy()
    physics.data.ptr.cam_xmat[camera] = (mat @ rotation).ravel()
    wanted = metrics.in_view(physics.tip_pos(), pos, mat @ rotation, fovy)
    assert physics.tip_visible() == bool(wanted)
    seen.add(bool(wanted))
    physics.data.ptr.cam_xmat[camera] = kept
  assert seen == {True, False}
  normals = physics.normals()
  np.testing.assert_allclose(physics.normal(7), normals[7], rtol=1e-14)
  nodes, elem = physics.organ.xpos, physics.organ.elem
  np.testing.assert_array_equal(physics.nodes(), nodes)
  a, b, c = nodes[elem[7]]
  np.testing.assert_allclose(
    np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a)), normals[7], rtol=1e-12
  )
  spec = env.action_spec()
  down = np.array([0, 0, 0, 0.6, 1.0])
  for _ in range(60):
    env.step(np.clip(down, spec.minimum, spec.maximum))
    if physics.data.ptr.ncon:
      break
  np.testing.assert_array_equal(physics.nodes(), physics.organ.xpos)  # not those before the step
  model, data = physics.model.ptr, physics.data.ptr
  triangles = {frozenset(e) for e in elem.tolist()}
  touched = set()
  for contact in data.contact:  # with a triangle of the window, whose corners are nodes
    flex = int(max(contact.flex))
    start = model.flex_elemdataadr[flex] + 3 * int(max(contact.elem))
    at = data.flexvert_xpos[model.flex_vertadr[flex] + model.flex_elem[start : start + 3]]
    away = np.linalg.norm(physics.nodes()[:, None] - at, axis=2)
    assert away.min(axis=0).max() < 1e-9
    touched.add(frozenset(away.argmin(axis=0).tolist()))
  assert touched <= triangles
  a, b, c = np.moveaxis(physics.nodes()[[sorted(e) for e in touched]], 1, 0)
  area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
  assert area > 0
  np.testing.assert_allclose(physics.contact_area(), area, rtol=1e-9)


def test_hidden_is_what_a_ray_says():
  env = load("retract/easy")
  env.reset()
  physics = env.physics
  eye = physics.camera()[0]
  random = np.random.RandomState(0)
  points = physics.nodes().mean(axis=0) + 0.03 * random.normal(size=(60, 3))
  wanted = []
  for point in points:
    hits = False
    for corners in physics.nodes()[physics.organ.elem]:
      # eye + t (point - eye) = a + u (b - a) + v (c - a)
      a, b, c = corners
      u, v, t = np.linalg.solve(np.stack([b - a, c - a, eye - point], axis=1), eye - a)
      hits = hits or (u >= 0 and v >= 0 and u + v <= 1 and 0 < t < 0.999)
    wanted.append(hits)
  assert 0 < sum(wanted) < len(wanted)
  np.testing.assert_array_equal(physics.hidden(points), wanted)


def test_an_episode_begins_at_rest_and_wakes_under_the_tool():
  for name in ("touch/easy", "grasp/easy"):
    env = load(name)
    env.reset()
    assert np.linalg.norm(env.physics.organ.xvel, axis=1).max() < 1e-6  # [m/s]
    act = performer.make(env)
    timestep = env.reset()
    awake = False
    while not timestep.last() and not awake:
      timestep = env.step(act(timestep))
      awake = not env.physics.organ.asleep and env.physics.data.ptr.ncon > 0
    assert awake
    assert env.physics.organ.window_warning is None and env.physics.organ.error is None


def test_sparse_reward_pays_success_alone():
  env = load("touch/easy", reward="sparse")
  assert all(t.reward == 0 for t in roll(env, 5)[1:])


def test_pixels():
  env = load("touch/easy", pixels=(24, 32))
  pixels = env.reset().observation["pixels"]
  assert pixels.shape == (24, 32, 3) and pixels.dtype == np.uint8 and np.ptp(pixels) > 20


@pytest.mark.parametrize("value, text", [(np.nan, "nan"), (1.5, "1.5"), (-np.inf, "-inf")])
def test_actions_that_are_not_allowed(value, text):
  env = load("touch/easy")
  env.reset()
  with pytest.raises(ValueError, match=f"touch/easy: action yaw is {text}, expected a number in"):
    env.step(np.array([0, value, 0, 0]))
  with pytest.raises(ValueError, match=r"action has shape \(3,\), expected \(4,\): pitch, yaw"):
    env.step(np.zeros(3))


def test_a_scene_of_ones_own_must_have_what_the_task_needs():
  spec = scenes.build(scenes.Scene(nodes=250, targets=1))
  env = load("touch/easy", model=spec)
  assert env.reset().observation["target"].shape == (3,)
  spec.delete(spec.site("target0"))
  with pytest.raises(ValueError, match="no site 'target0'"):
    load("touch/easy", model=spec)
  catalogue = models.load("liver", nodes=250, instruments=("probe",))
  catalogue.worldbody.add_site(name="target0")
  env = load("touch/easy", model=catalogue, organ="liver/liver")
  assert env.reset().observation["nodes_near"].shape == (8, 3)
  with pytest.raises(ValueError, match="no flex 'organ'"):
    load("touch/easy", model=catalogue)
  with pytest.raises(ValueError, match="palpate_easy: model is given, expected none"):
    load("probe/palpate_easy", model=spec)
  gripper = scenes.build(scenes.Scene("gallbladder", "grasper", nodes=250, center="fundus"))
  gripper.delete(next(a for a in gripper.actuators if a.name == "grasper/jaw"))
  with pytest.raises(ValueError, match="no actuator 'grasper/jaw'"):
    load("grasp/easy", model=gripper)
  bare = mujoco.MjSpec()
  with pytest.raises(ValueError, match="no body 'probe/trocar'"):
    load("touch/easy", model=bare)


def test_every_organ_has_its_colour():
  colours = []
  for organ, center in (
    ("liver", "right_lobe"), ("kidney", "anterior"), ("stomach", "body"), ("gallbladder", "fundus")
  ):  # fmt: skip
    model = scenes.build(scenes.Scene(organ, nodes=250, center=center)).compile()
    flex = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, scenes.ORGAN)
    colours.append(model.flex_rgba[flex])
  for a, b in itertools.combinations(colours, 2):
    assert np.abs(a - b).max() > 0.02


def test_too_much_force_is_a_failure():
  env = load("touch/easy", damage=0.2)
  timestep = env.reset()
  task, physics = env.task, env.physics
  for _ in range(400):
    offset = timestep.observation["target"]
    deeper = physics.trocar().mat[:, 2] @ offset < 0 or physics.peak_force > 0
    timestep = env.step(np.array([0, 0, 0, 1.0 if deeper else 0.0]))
    task.done = min(task.done, 0)  # presses on
    if timestep.last():
      break
    task.outcome = None
  assert timestep.last() and env.task.outcome == "damage" and env.task.progress == -1


@pytest.mark.parametrize("limit", ["force_limit", "damage"])
@pytest.mark.parametrize("value", [np.nan, -1.0, 0.0, np.inf])
def test_limits_that_cannot_be(limit, value):
  with pytest.raises(ValueError, match=f"touch/easy: {limit} is {value}, expected a number > 0"):
    load("touch/easy", **{limit: value})


def test_a_wrong_report_is_a_miss():
  env = load("probe/palpate_easy")
  env.reset()
  timestep = env.step(np.array([0, 0, 0, 0, 1.0]))
  assert timestep.last() and timestep.discount == 0 and env.task.outcome == "missed"


def test_time_limit_ends_with_the_discount_of_going_on():
  env = load("touch/easy", time_limit=0.1)
  env.reset()
  for _ in range(5):
    timestep = env.step(np.zeros(4))
  assert timestep.last() and timestep.discount == 1 and env.task.outcome is None
  assert isinstance(env, engine.Environment)  # dm_control's where it is installed
