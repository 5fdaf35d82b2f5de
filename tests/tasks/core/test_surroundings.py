"""The abdomen around an exercise: it is seen and met, hides no target, changes nothing else."""

import mujoco
import numpy as np
import pytest
from palpate import tasks
from palpate.tasks import suite
from palpate.tasks.core import instrument, observation
from palpate.tissue.geometry import subdivide


def load(name, surroundings="abdomen", **options):
  options = {"random": 0, "surroundings": surroundings, **options}
  return tasks.load(*suite.split(name), task_kwargs=options)


DOWN = np.array([0.0, 0.0, 0.0, 0.5])  # reaches the liver in 45 steps


@pytest.mark.parametrize(
  ("name", "action", "steps", "least"),
  [("touch/easy", DOWN, 50, 0.1), ("tease/easy", DOWN, 5, 0.0), ("cut/easy", DOWN, 5, 0.0)],
)
def test_forces_are_the_same_to_the_bit(name, action, steps, least):
  found = []
  for surroundings in ("none", "abdomen"):
    env = load(name, surroundings)
    env.reset()
    seen = [env.step(action).observation for _ in range(steps)]
    assert any(s["peak_force"] >= least for s in seen)
    found.append((env.physics.data.qpos.copy(), seen))
  np.testing.assert_array_equal(found[0][0], found[1][0])
  for one, other in zip(found[0][1], found[1][1], strict=True):
    for key in one:
      np.testing.assert_array_equal(one[key], other[key])


@pytest.mark.parametrize("name", ["touch/easy", "grasp/easy", "cut/easy", "tease/easy"])
@pytest.mark.parametrize("surroundings", ["none", "unseen"])
def test_who_goes_aside_meets_what_is_around(name, surroundings):
  env = load(name, surroundings)
  env.reset()
  aside = np.zeros(env.action_spec().shape)
  aside[:4] = -0.5 if name == "cut/easy" else 0.5, 0.5, 0.0, 0.5
  felt, events = [], []
  for _ in range(100):
    felt.append(env.step(aside).observation["peak_force"][0])
    events += [event.label for event in env.task.take_events()]
    if "surroundings" in events:
      break
  met = surroundings == "unseen"
  assert (env.task.cost.surroundings > 0) == met and (max(felt) > 0.1) == met
  assert env.task.outcome is None and ("surroundings" in events) == met
  if met:  # it is felt, and is no tissue
    forces = env.physics.forces()
    assert forces["force"].max() < 1e-9 < 0.1 < forces["surroundings_force"].max() == max(felt)
    assert env.task.cost.shaft == 0 == env.physics.peak_tissue
    # Further in the force grows as that of a spring, and the wall does not throw it back.
    more = [env.step(aside).observation["peak_force"][0] for _ in range(4)]
    assert felt[-1] < max(more) < 3


@pytest.mark.parametrize("name", ["grasp/easy", "bimanual/easy", "dissect/hard", "cut/hard"])
def test_nobody_begins_in_what_is_around(name):
  env = load(name, "unseen")
  for seed in range(10):
    env.task.random = np.random.RandomState(seed)
    env.reset()
    mujoco.mj_forward(env.physics.model.ptr, env.physics.data.ptr)
    for hand in env.physics.hands:
      for name in instrument.AROUND:
        assert not hand.sensor(name).any()


def _scenery(model) -> dict[str, np.ndarray]:
  """Returns corners of the triangles of what is only drawn [m]  (n, 3, 3)."""
  found = {}
  for k in range(model.nskin):
    vertex, face = model.skin_vertadr[k], model.skin_faceadr[k]
    elem = model.skin_face[face : face + model.skin_facenum[k]]
    if model.skin(k).name.startswith("abdomen_"):
      found[model.skin(k).name] = model.skin_vert[vertex:][elem].astype(float)
  return found


def _first(eye: np.ndarray, way: np.ndarray, corner: np.ndarray) -> np.ndarray:
  """Returns at which shares of the ways from the eye triangles are met, 2 for none  (n, m)."""
  a, ab, ac = corner[:, 0], corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
  s = eye - a
  det = way @ np.cross(ac, ab).T
  u = way @ np.cross(ac, s).T
  v, far = way @ np.cross(s, ab).T, (ac * np.cross(s, ab)).sum(axis=1)
  with np.errstate(divide="ignore", invalid="ignore"):
    u, v, t = u / det, v / det, far / det
  met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
  return np.where(met, t, 2.0)


def _marks(env):
  physics = env.physics
  model, data = physics.model.ptr, physics.data.ptr
  sites = np.array(physics.target_sites)
  shown = sites[model.site_rgba[sites, 3] > 0]
  return np.concatenate([data.site_xpos[shown], getattr(env.task, "disc", np.zeros((0, 3)))])


@pytest.mark.parametrize(
  "name", ["touch/hard", "grasp/hard", "retract/hard", "trace/hard", "tease/easy", "cut/hard"]
)
def test_no_target_is_hidden(name):
  env = load(name)
  for _ in range(3):
    env.reset()
    eye, marks = env.physics.camera()[0], _marks(env)
    way = marks - eye
    near = 0.003 / np.linalg.norm(way, axis=1)  # marks are spheres of 3 mm
    for name, corner in _scenery(env.physics.model.ptr).items():
      assert _first(eye, way, corner).min() > (1 - near).min(), name


def test_what_is_pressed_is_seen_pressed():
  env = load("touch/easy")
  env.reset()
  forces = [env.step(DOWN).observation["peak_force"] for _ in range(50)]
  assert max(forces) > 0.1
  seer = load("touch/easy", observations=["points", "segmentation"], pixels=(120, 160))
  seer.reset()
  physics = seer.physics
  physics.place(env.physics.integration_state())
  seen = seer.task.get_observation(physics)
  skin = subdivide.smooth(physics.organ.elem, 2)(physics.nodes())
  pos, axes, _ = physics.camera()
  world = seen["points"] * [1, -1, -1] @ axes.T + pos
  organ = world[seen["segmentation"] == observation.LABELS["organ"]][::5]
  assert np.linalg.norm(organ[:, None] - skin, axis=2).min(axis=1).max() < 0.005  # half an edge


def test_bad_surroundings_are_named():
  with pytest.raises(ValueError, match="is 'sea', expected one of abdomen, unseen, none"):
    load("touch/easy", "sea")
