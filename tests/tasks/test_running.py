"""A running suture: what is sewn, what closes the cut, and what is lost."""

import mujoco
import numpy as np
import palpate
import pytest
from palpate.models import wrist
from palpate.tasks import suite
from palpate.tasks.core import episode, performer, rules, stage
from palpate.tasks.domains import sheet
from palpate.tasks.domains.suturing import needles, running
from palpate.tasks.recording import Recording


def load(task):
  return suite.load("suture", task, task_kwargs={"random": 0, "surroundings": "none"})


@pytest.fixture(scope="module")
def easy():
  return load("running_easy")


def test_an_episode_begins_with_loose_stitches_in_a_cut_that_gapes(easy):
  easy.reset()
  task, physics = easy.task, easy.physics
  holes, nodes = physics.organ.pinholes, physics.nodes()
  assert len(holes) == 2 * task.placed == 6
  assert all(hole.thread and hole.along < 0 for hole in holes)
  rest = [hole.rest for hole in holes]
  np.testing.assert_allclose(rest, task.marks[:6], atol=1.4e-3)  # its edges are 1.5 mm long
  assert physics.thread.tension.max() < 0.01
  assert task.gap == pytest.approx(np.ptp(nodes[task.edges, 0], axis=1).max())
  assert 2e-3 < task.gap < 2.6e-3
  swage = needles.arc(physics, 0.0)
  np.testing.assert_allclose(physics.thread.positions[0], swage, atol=1e-6)
  at = running.place(physics, task, 7)
  np.testing.assert_allclose(at[:2], task.marks[7, :2], atol=2e-3)


@pytest.mark.slow
def test_an_organ_that_slept_is_awake_once_it_is_sewn(easy):
  """The thread touches it in its holes alone."""
  easy.reset()
  sewn = easy.physics
  model = stage.compile_spec(easy.task.spec(None))
  made = stage.build(model, [easy.task.prefix, easy.task.second], "organ")
  data = mujoco.MjData(made.model)
  mujoco.mj_setState(made.model, data, made.state, stage.STATE)
  organ = palpate.Organ(made.model, data, "organ")
  mujoco.mj_step(made.model, data, 300)
  assert organ.asleep
  data.joint("needle").qpos[:] = sewn.free_pose("needle")
  palpate.Thread(made.model, data, "suture").lay(sewn.thread.positions)
  organ.sew("needle")
  mujoco.mj_step(made.model, data)
  assert not organ.asleep
  assert np.abs(organ.needles[0].force).max() > 0


def test_a_sheet_over_the_stomach_has_its_relief():
  flat, _ = sheet.sheet(480)
  laid = sheet.laid_over(flat, "stomach", "body")
  np.testing.assert_array_equal(laid[:, :2], flat[:, :2])
  x, y = flat[:, :2].T
  near = np.hypot(x, y) < 0.015
  across, along = np.linalg.lstsq(flat[near, :2] ** 2 / 2, laid[near, 2], rcond=None)[0]
  assert 0.035 < -1 / across < 0.05  # its tube is 43 mm thick there, see `shapes`
  assert abs(along) < 0.2 * abs(across)


def test_who_lets_go_has_missed(easy):
  timestep, task = easy.reset(), easy.task
  action = np.zeros(len(task.components))
  action[task.components.index("jaw")] = 1.0
  while not timestep.last():
    timestep = easy.step(action)
  assert task.outcome == "missed" and task.done == 3
  assert easy.physics.time() < 1.0


@pytest.mark.parametrize(
  ("changed", "outcome"),
  [
    ({"done": 4, "gap0": 0.002}, rules.MISSED),  # a stitch is gone
    ({"tolerance": 1e-4, "placed": 0, "misses": np.full(8, 2e-4)}, rules.MISSED),
    ({"close": 0.01, "closed": 0.49}, rules.RUNNING),  # closed, but not placed
  ],
)
def test_what_does_not_count(easy, monkeypatch, changed, outcome):
  easy.reset()
  for name, value in changed.items():
    monkeypatch.setattr(easy.task, name, value)
  assert running.advance(easy.physics, easy.task)[2] == outcome


@pytest.mark.slow
def test_hands_that_pull_a_needle_in_the_wall_against_each_other_throw_nothing(easy):
  """Each by 12 mm along an axis, at 20 mm/s, once both hold it."""
  timestep, task, physics = easy.reset(), easy.task, easy.physics
  act = performer.make(easy, seed=0)
  while not (task.left_holds and task.right_holds):
    timestep = easy.step(act(timestep))
  model, data, begun = physics.model.ptr, physics.data.ptr, physics.integration_state()
  for way in (*np.eye(3), *-np.eye(3)):
    physics.place(begun)
    held = [wrist.forward(hand.trocar(), hand.drive_targets()) for hand in physics.hands]
    for k in range(1200):
      far = min(2e-5 * k, 0.012)
      for hand, (pos, turn), side in zip(physics.hands, held, (1, -1), strict=True):
        roll = float(hand.drive_targets()[2])
        data.ctrl[hand.drives] = wrist.inverse(hand.trocar(), pos + side * far * way, turn, roll)
      mujoco.mj_step(model, data)
      now = physics.organ.needles[0]
      assert np.linalg.norm(now.force) < task.damage / 2
      assert np.linalg.norm(data.joint("needle").qvel[:3]) < 0.5
    assert not data.warning.number.any() and physics.organ.error is None
    assert len(now.holes) >= 6  # those of the thread; the needle may be drawn out, or go in again


@pytest.mark.slow
def test_the_expert_closes_the_cut_and_replays_to_the_bit(tmp_path):
  env = load("running_easy")
  made = episode.run(env, performer.make(env, seed=0), 0, {"task_kwargs": {"surroundings": "none"}})
  assert made.outcome == "success"
  found = made.metrics()
  assert found.final_gap < 1e-3 and found.tearing == 0.0
  assert found.target_error < 1e-3 and found.regrasps == 1
  # Less than 0.4 N leaves more than a millimetre; a hole bears 1.8 N of the thread on both sides.
  assert 0.4 < found.peak_tension < 1.0
  old = Recording.load(made.save(tmp_path / "a.npz"))
  assert episode.differences(old, episode.replay(old)) == []
