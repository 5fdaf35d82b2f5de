"""Experts play the worlds of a batch in closed loop: what they see is what a GPU has computed."""

import mujoco
import numpy as np
import pytest
from devices import needs_cuda

pytest.importorskip("gymnasium")

import warp as wp
from palpate.tasks import registry
from palpate.tasks.batch import fields, vector
from palpate.tasks.core import instrument, performer
from palpate.tasks.core.stage import STATE

SEED = 100


class Beside:
  """A single environment whose physics shows a world of a batch, and the expert in it."""

  def __init__(self, worlds, world):
    import gymnasium

    name = registry.gym_id(*worlds.task.name.split("/"))
    self.env = gymnasium.make(name, disable_env_checker=True, surroundings="unseen")
    self.seen, _ = self.env.reset(seed=SEED + world)
    self.worlds, self.world, self.first = worlds, world, True
    self.act = performer.make(self.env.unwrapped.environment)
    self.data = mujoco.MjData(worlds.batch.model)
    self.physics = self.env.unwrapped.environment.physics
    self.physics.step, self.physics.holds = self.show, self.holds

  def show(self, nstep=1):
    """Puts the physics in the state of the world."""
    batch, shown = self.worlds.batch, self.worlds.fields
    batch.get_state(self.world, self.data)
    state = np.empty(mujoco.mj_stateSize(batch.model, STATE))
    mujoco.mj_getState(batch.model, self.data, state, STATE)
    self.physics.place(state)
    self.physics.data.sensordata[:] = batch.sensordata.numpy()[self.world]
    self.physics.peak_force = float(shown.peak_force.numpy()[self.world, 0])
    self.physics.peak_tissue = float(shown.tissue_peak.numpy()[self.world])
    self.physics.peak_shaft = float(shown.shaft_peak.numpy()[self.world])

  def holds(self):
    inner = self.worlds.fields.inner.numpy()[self.world]
    opening = self.physics.sensor("jaw")[0]
    return bool(inner.min() > instrument.HELD_FORCE and opening > instrument.FOLD)

  def action(self):
    class Step:
      observation = self.seen

      def first(_):
        return self.first

    return np.clip(self.act(Step()), -1, 1)

  def step(self, action):
    self.seen = self.env.step(action)[0]
    self.first = False


TASKS = "grasp/easy", "retract/easy", "dissect/easy", "tease/easy", "bimanual/easy", "cut/easy"
TASKS += ("suture/drive_easy", "suture/running_easy", "suture/knot_easy")


@pytest.mark.parametrize(
  ("device", "task"),
  [("cpu", "grasp/easy"), *(pytest.param("cuda:0", task, marks=needs_cuda) for task in TASKS)],
)
def test_experts_hold_tissue_in_a_batch(device, task):
  count = 1 if device == "cpu" else 6
  env = vector.Exercises(count, task, device=device)
  env.reset(seed=SEED)
  worlds, playing = env.parts[0], set(range(count))
  besides, outcomes = [Beside(worlds, k) for k in range(count)], {}
  while playing:
    actions = np.array([beside.action() for beside in besides], np.float32)
    over = worlds.step(wp.array(actions, device=worlds.device))
    told = worlds.fields.outcome.numpy()
    for k in sorted(playing):
      besides[k].step(actions[k])
      if over[k]:
        outcomes[k] = fields.OUTCOMES[told[k]]
        playing.discard(k)
  assert list(outcomes.values()).count("success") >= count - 1, outcomes
  env.close()
