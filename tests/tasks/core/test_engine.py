"""Exercises without dm_control do the same to the bit, but for depths."""

import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

# Steps an exercise, draws it, goes on from a pickled copy, and saves what it saw.
SCRIPT = """
import copy, pickle, sys
if sys.argv[1] == "without":
  sys.modules["dm_control"] = None  # as where it is not installed
import gymnasium, numpy as np, palpate.tasks
assert ("dm_control.mujoco" in sys.modules) == (sys.argv[1] == "with")
env = palpate.tasks.load(*sys.argv[2].split("/"), {
  "random": 0, "observations": ("sensors", "pixels", "depth", "segmentation"), "pixels": (48, 64)})
draw, spec = np.random.RandomState(0).uniform, env.action_spec()
seen = [env.reset()]
for _ in range(5):
  seen.append(env.step(draw(spec.minimum, spec.maximum)))
twin = pickle.loads(pickle.dumps(env))
other = copy.deepcopy(env)
action = draw(spec.minimum, spec.maximum)
seen += [each.step(action) for each in (env, twin, other)]
single = gymnasium.make("palpate/TouchEasy-v0")
single.reset(seed=1)
extra = {"gym": single.step(0.5 * np.ones(single.action_space.shape))[0],
         "film": env.physics.render(40, 60, "laparoscope")}
pictures = {f"{k}_{name}": value for k, each in enumerate(seen)
            for name, value in each.observation.items()}
rewards = {f"{k}_reward": np.array(each.reward, float) for k, each in enumerate(seen)}
extra["gym"] = np.concatenate([np.ravel(each) for each in extra["gym"].values()]) if isinstance(
  extra["gym"], dict) else extra["gym"]
np.savez(sys.argv[3], **pictures, **rewards, **extra)
"""


@pytest.mark.skipif(find_spec("dm_control") is None, reason="dm_control is not installed")
def test_an_exercise_without_dm_control_does_the_same(tmp_path):
  found = []
  for how in ("with", "without"):
    path = tmp_path / f"{how}.npz"
    command = [sys.executable, "-c", SCRIPT, how, "grasp/easy", str(path)]
    subprocess.run(command, check=True, timeout=300)
    found.append(np.load(path))
  one, two = found
  assert set(one) == set(two)
  assert one["8_pixels"].std() > 5  # something is seen
  for name in one:
    # MuJoCo's renderer and dm_control's make metres of the depth buffer in another order.
    rtol = 1e-4 if name.endswith("depth") else 0.0
    np.testing.assert_allclose(one[name], two[name], rtol=rtol, err_msg=name)
  np.testing.assert_array_equal(two["6_tip_pos"], two["7_tip_pos"])  # the copies go on alike
