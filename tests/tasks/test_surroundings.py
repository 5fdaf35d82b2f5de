"""The abdomen around an exercise: it is seen, hides no target, and changes nothing else."""

import mujoco
import numpy as np
import pytest
from palpate import tasks
from palpate.tasks import observation, suite
from palpate.tissue import subdivide


def load(name, surroundings="abdomen", **options):
  options = {"random": 0, "surroundings": surroundings, **options}
  return tasks.load(*suite.split(name), task_kwargs=options)


@pytest.mark.parametrize("name", ["touch/easy", "grasp/easy"])
def test_forces_are_the_same_to_the_bit(name):
  found = []
  for surroundings in ("none", "abdomen"):
    env = load(name, surroundings)
    env.reset()
    down = np.array([0, 0, 0, 1.0, *([0.2] if env.task.jaws else [])])
    seen = [env.step(down).observation for _ in range(60)]
    assert any(s["peak_force"] > 0.1 for s in seen)
    found.append((env.physics.integration_state(), seen))
  np.testing.assert_array_equal(found[0][0], found[1][0])
  for one, other in zip(found[0][1], found[1][1], strict=True):
    for key in one:
      np.testing.assert_array_equal(one[key], other[key])


def _marks(env):
  physics = env.physics
  model, data = physics.model.ptr, physics.data.ptr
  shown = physics.target_sites[model.site_rgba[physics.target_sites, 3] > 0]
  return np.concatenate([data.site_xpos[shown], getattr(env.task, "disc", np.zeros((0, 3)))])


@pytest.mark.parametrize(
  "name", ["touch/hard", "probe/hard", "grasp/hard", "retract/hard", "trace/hard"]
)
def test_no_target_is_hidden(name):
  env = load(name)
  scenery = np.array([0, 0, 1, 0, 0, 0], np.uint8)
  for _ in range(4):
    env.reset()
    physics = env.physics
    eye, geom = physics.camera()[0], np.zeros(1, np.int32)
    for mark in _marks(env):
      way = mark - eye
      far = np.linalg.norm(way)
      model, data = physics.model.ptr, physics.data.ptr
      hit = mujoco.mj_ray(model, data, eye, way / far, scenery, 1, -1, geom, None)
      # Where only scenery behind is met, it is further away; marks are spheres of 3 mm.
      assert hit < 0 or hit > far - 0.003, model.geom(int(geom[0])).name


def test_what_is_pressed_is_seen_pressed():
  env = load("touch/easy", observations=["sensors", "points", "segmentation"], pixels=(120, 160))
  env.reset()
  for _ in range(70):
    seen = env.step(np.array([0, 0, 0, 1.0])).observation
  physics = env.physics
  assert seen["peak_force"] > 0.1
  skin = subdivide.smooth(physics.organ.elem, 2)(physics.nodes())
  pos, axes, _ = physics.camera()
  world = seen["points"] * [1, -1, -1] @ axes.T + pos
  organ = world[seen["segmentation"] == observation.LABELS["organ"]][::5]
  assert np.linalg.norm(organ[:, None] - skin, axis=2).min(axis=1).max() < 0.005  # half an edge


def test_bad_surroundings_are_named():
  with pytest.raises(ValueError, match="surroundings is 'sea', expected one of abdomen, none"):
    load("touch/easy", "sea")
