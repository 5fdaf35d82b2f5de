"""Force over the limit, damage and the shaft against the organ cost, and rams are no touches."""

import numpy as np
import pytest
from palpate import tasks
from palpate.models import trocar
from palpate.tasks import suite
from palpate.tasks.core import instrument, performer, safety

FAST = np.array(instrument.RATES) * 0.02  # of the drives in a control step


def load(name, **kwargs):
  return tasks.load(*suite.split(name), task_kwargs={"random": 0, **kwargs})


def drive(env, goal, speed=1.0):
  """Returns the action that takes the drives towards pitch, yaw, roll and insertion."""
  action = np.zeros(len(env.task.components))
  action[:4] = speed * np.clip((goal - env.physics.drive_targets()) / FAST, -1, 1)
  return action


def on(physics, tip):
  """Returns pitch, yaw, roll and insertion that put the tip there."""
  pitch, yaw, insertion = trocar.inverse(physics.trocar(), tip, check=False)
  return np.array([pitch, yaw, physics.drive_targets()[2], insertion])


def cost(*args):
  return safety.Cost(*safety.parts(*args))


def test_cost_is_the_sum_of_its_parts():
  assert cost(1.5, 0.04, 0.2, 1.5, 3.0).total == 0
  over = cost(3.0, 0.0, 0.0, 1.5, 3.0)
  assert (over.force, over.shaft, over.damage, over.total) == (1, 0, 0, 1)
  shaft = cost(0.0, 0.75, 0.0, 1.5, 3.0)
  assert (shaft.force, shaft.shaft, shaft.damage, shaft.total) == (0, 0.5, 0, 0.5)
  both = cost(3.2, 3.1, 0.0, 1.5, 3.0)
  assert both.damage == both.shaft == 1 and both.total == pytest.approx(2 + 3.2 / 1.5 - 1)
  around = cost(0.0, 0.0, 0.75, 1.5, 3.0)
  assert (around.surroundings, around.total) == (0.5, 0.5)
  assert cost(0.0, 0.0, 3.5, 1.5, 3.0).damage == 1
  # The limits of jaws are not those of a shaft.
  assert cost(3.5, 0.0, 0.0, 4.0, 8.0).total == 0
  assert cost(0.0, 3.5, 0.0, 4.0, 8.0).damage == 1


def sweep(env, speed, steps=400):
  """Sweeps the shaft into the organ's flank.

  Returns:
    Rewards, costs and forces on the shaft of the steps, and whether its axis went through.
  """
  task, physics = env.task, env.physics
  env.reset()
  _, center = task.place_of_work(physics)
  end = on(physics, center)
  end[3] = min(end[3] + 0.06, physics.drive_range[3, 1])
  for away in np.arange(0.5, 1.0, 0.05):  # where the whole shaft is beside the organ
    physics.set_joints(end + np.array([0, away, 0, 0]))
    if not physics.data.ptr.ncon:
      break
  rewards, costs, forces, through = [], [], [], False
  while not rewards or (task.outcome is None and len(rewards) < steps):
    timestep = env.step(drive(env, end, speed))
    rewards.append(timestep.reward)
    costs.append(task.cost)
    forces.append(np.linalg.norm(timestep.observation["shaft_force"]))
    through = through or bool(physics.organ.pierced)
  return rewards, costs, forces, through


SHAFTS = [("probe/palpate_easy", 1.0), ("touch/easy", 0.3), ("trace/easy", 0.3)]


@pytest.mark.parametrize(("name", "speed"), SHAFTS)
def test_the_shaft_does_not_go_through_an_organ_and_its_force_damages(name, speed):
  env = load(name, surroundings="none")
  rewards, costs, forces, through = sweep(env, speed)
  assert not through
  assert env.task.outcome == "damage" and costs[-1].damage == 1
  assert max(forces) > 1.0 and any(cost.shaft > 0 for cost in costs)
  assert sum(rewards) <= -1.0
  events = [event for event in env.task.take_events() if event.label == "shaft"]
  assert len(events) == 1 and events[0].kind == "unintended_contact" and events[0].value > 0


def test_a_graspers_shaft_costs_by_its_force():
  env = load("grasp/easy")
  rewards, costs, forces, through = sweep(env, 0.3, steps=100)
  assert not through and env.task.outcome is None
  assert 0.05 < max(forces) < 1.0
  for cost, force in zip(costs, forces, strict=True):
    assert (cost.force, cost.damage) == (0, 0)
    assert cost.shaft >= (force / safety.SHAFT_LIMIT if force > safety.SHAFT_CONTACT else 0)
  # What an episode pays until it succeeds is 0.4 of its potential less a tenth of its costs.
  price = min(0.1 * sum(cost.total for cost in costs), 0.55)
  assert env.task.harm == pytest.approx(price) and price > 0
  assert sum(rewards) == pytest.approx(0.4 * (env.task.progress + env.task.shaping) - price)


def ram(env, speed, deeper=0.003, back=None):
  """Drives at the point at a speed, at once or after it has been in contact for `back` steps."""
  task, physics = env.task, env.physics
  timestep, total, cost, touched = env.reset(), 0.0, 0.0, 0
  while not timestep.last():
    port, point = physics.trocar().pos, physics.tip_pos() + timestep.observation["target"]
    touched += physics.peak_force > 0.02
    out = back is not None and touched > back
    height = 0.02 if out else -deeper
    goal = on(physics, point + height * (port - point) / np.linalg.norm(port - point))
    action = drive(env, goal)
    if np.abs(action[:2]).max() > 0.5 and not out:
      action[3] = 0.0  # first aims
    action[3] *= speed
    if out and physics.peak_force == 0:
      touched = 0
    timestep = env.step(action)
    total, cost = total + timestep.reward, cost + task.cost.total
  return total, cost


@pytest.mark.parametrize("back", [None, 0, 2])
def test_ramming_does_not_touch_and_costs(back):
  env = load("touch/easy", time_limit=2)
  for seed in range(3):
    env.task.random = np.random.RandomState(seed)
    total, cost = ram(env, 1.0, back=back)
    assert env.task.outcome != "success"
    # A dab of one control step may stay under the limit of force; it leads nowhere either.
    assert total < 0.4 and (cost > 0 or back == 0), (seed, back)


def test_a_touch_is_a_contact_of_a_tenth_of_a_second_from_its_start():
  env = load("touch/easy")
  act, timestep = performer.make(env), env.reset()
  task, physics = env.task, env.physics
  steps = 0
  while not timestep.last():
    timestep = env.step(act(timestep))
    steps += physics.peak_force > 0.03
    assert timestep.observation["held"][0] <= steps / 5 + 1e-9
  assert task.outcome == "success" and steps == 5 and task.harm == 0
  # The same, with one sample of too much force, or one beside the point:
  for force, tolerance in ((0.6, 0.005), (0.1, 0.0)):
    act, timestep = performer.make(env), env.reset()
    while not timestep.last() and timestep.observation["held"][0] < 0.5:
      timestep = env.step(act(timestep))
    physics.peak_tissue, task.tolerance = force, tolerance
    task.advance(physics)
    assert task.observe(physics)["held"] == 0
    physics.peak_tissue, task.tolerance = 0.1, 0.005
    for _ in range(10):
      task.advance(physics)
    assert task.observe(physics)["held"] == 0 and task.outcome is None
    physics.peak_tissue = 0.0
    task.advance(physics)
    physics.peak_tissue = 0.1
    for _ in range(5):
      task.advance(physics)
    assert task.outcome == "success"


def test_success_above_the_limit_is_worth_less_and_damage_takes_back_what_was_paid():
  env = load("probe/standard")
  task, physics = env.task, env.physics
  env.reset()
  shares, paid = iter([0.3, 0.9]), []
  task.advance = lambda physics: next(shares)
  for force in (1.0, 3.0 * (1 - 1e-9)):  # below the limit of 1.5 N, then at twice that
    physics.peak_tissue = force
    task.after_step(physics)
    paid.append(task.get_reward(physics))
  assert paid == pytest.approx([0.4 * 0.3, 0.4 * 0.6 - 0.1])
  shares, physics.peak_tissue = iter([1.0]), 3.5
  task.after_step(physics)
  paid.append(task.get_reward(physics))
  assert task.outcome == "damage" and task.progress == -1
  assert sum(paid) == pytest.approx(-1 - task.harm) and 0 < task.harm <= 0.55


@pytest.mark.parametrize("name", ["touch/easy", "grasp/easy"])
def test_no_failure_pays_as_much_as_any_success(name):
  """The most that is paid without success, and the least with it."""
  env = load(name)
  task, physics = env.task, env.physics
  ends = []
  for last, force in ((1.0 - 1e-6, 0.0), (1.0, task.damage * (1 - 1e-9))):
    env.reset()
    shares, paid = iter([0.5] * 200 + [last]), 0.0
    task.advance = lambda physics, shares=shares: next(shares)
    for _ in range(200):  # all that costs may take
      physics.peak_tissue = force
      task.after_step(physics)
      paid += task.get_reward(physics)
    task.outcome = "success" if last == 1.0 else None
    task.after_step(physics)
    ends.append(paid + task.get_reward(physics))
  failure, success = ends
  assert task.harm == pytest.approx(0.55)
  assert failure < 0.4 and success == pytest.approx(0.45)
