"""Gymnasium environments in use: ends, wrappers, processes, copies."""

import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from palpate.tasks import registry, suite  # noqa: E402

STILL = np.zeros(4)


def make(**options):
  return gymnasium.make("palpate/TouchEasy-v0", disable_env_checker=True, **options)


def run_to_end(env):
  env.reset(seed=0)
  for count in range(1, 10_000):
    *_, terminated, truncated, info = env.step(STILL)
    if terminated or truncated:
      return count, truncated, info
  return None


def test_every_id_says_how_many_steps_there_are():
  for domain, tasks in registry.TASKS.items():
    for task in tasks:
      spec = gymnasium.spec(registry.gym_id(domain, task))
      assert spec.max_episode_steps == registry.step_limit(domain, task)
  env = suite.load("touch", "easy")
  assert env.step_limit == gymnasium.spec("palpate/TouchEasy-v0").max_episode_steps == 500


@pytest.mark.parametrize(
  "options, count",
  [
    ({"time_limit": 0.1}, 5),
    ({"time_limit": 0.1, "n_sub_steps": 10}, 10),
    ({"time_limit": 0.3, "max_episode_steps": -1}, 15),
  ],
)
def test_the_last_step_is_known_as_such(options, count):
  found, truncated, info = run_to_end(make(record=True, **options))
  assert found == count and truncated and "time" in info["metrics"]


@pytest.mark.parametrize("options", [{"time_limit": 20}, {"control_timestep": 0.01}])
def test_a_time_limit_that_would_be_cut_is_warned_of(options):
  with pytest.warns(UserWarning, match="has max_episode_steps=1000 too, episodes end after 500"):
    env = make(max_episode_steps=1000, **options)
  assert env.unwrapped.environment.step_limit == 1000


def test_a_step_without_a_reset_is_refused():
  env = make(time_limit=0.04).unwrapped
  with pytest.raises(gymnasium.error.ResetNeeded, match=r"touch/easy: .* expected reset first"):
    env.step(STILL)
  run_to_end(env)
  with pytest.raises(gymnasium.error.ResetNeeded, match="an episode that is over"):
    env.step(STILL)
  env.reset()
  env.step(STILL)


def test_pictures_are_in_their_spaces():
  names = ["sensors", "pixels", "depth", "segmentation", "points"]
  env = make(observations=names, pixels=(8, 12), randomise={"light": (0.5, 2)})
  check_env(env.unwrapped, skip_render_check=True)
  space = env.observation_space
  assert space["pixels"] == gymnasium.spaces.Box(0, 255, (8, 12, 3), np.uint8)
  assert space["segmentation"] == gymnasium.spaces.Box(0, 3, (8, 12), np.uint8)
  assert space["points"].dtype == np.float32 and "progress" not in space.keys()
  _, info = env.reset(seed=0)
  assert 0.5 <= info["randomised"]["light"] <= 2


def test_the_frame_rate_is_that_of_the_control_steps():
  assert make().metadata["render_fps"] == 50
  assert make(n_sub_steps=50).metadata["render_fps"] == 20


@pytest.mark.parametrize("way", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_go_on_to_the_bit(way):
  env = make(record=True, time_limit=1.0)
  env.reset(seed=4)
  for _ in range(20):
    env.step(np.array([0.0, 0.0, 0.0, 0.6]))
  twin = way(env)
  for _ in range(30):
    a, b = (each.step(np.array([0.1, 0.0, 0.0, 0.3])) for each in (env, twin))
    assert a[1:4] == b[1:4]
    assert all(np.array_equal(a[0][name], b[0][name]) for name in a[0])
  assert a[3] and a[4]["metrics"] == b[4]["metrics"]
  a, b = (each.reset()[0] for each in (env, twin))
  assert all(np.array_equal(a[name], b[name]) for name in a)


def test_a_film_is_recorded(tmp_path):
  pytest.importorskip("moviepy")
  imageio = pytest.importorskip("imageio.v3")
  env = make(render_mode="rgb_array", width=64, height=48, time_limit=0.2)
  env = gymnasium.wrappers.RecordVideo(env, str(tmp_path), disable_logger=True)
  run_to_end(env)
  env.close()
  (film,) = tmp_path.glob("*.mp4")
  frames = imageio.imread(film)
  assert frames.shape[1:] == (48, 64, 3) and len(frames) >= 10 and np.ptp(frames) > 20


# Processes.

_ASYNC = """
import sys, numpy as np, gymnasium, palpate.tasks

def main(draw, context):
  if draw == "own":
    env = gymnasium.make("palpate/TouchEasy-v0", render_mode="rgb_array", width=32, height=24)
    env.reset()
    env.render()
  elif draw == "other":
    import mujoco
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    renderer = mujoco.Renderer(model, 24, 32)
    renderer.update_scene(mujoco.MjData(model))
    renderer.render()
  try:
    envs = gymnasium.make_vec(
      "palpate/TouchEasy-v0", num_envs=2, vectorization_mode="async", pixels=(24, 32),
      vector_kwargs={"context": context},
    )
    seen = envs.reset(seed=0)[0]["pixels"]
    envs.step(np.zeros((2, 4)))
    envs.close()
    print("drew", seen.shape, bool(seen.std() > 10))
  except RuntimeError as error:
    print("refused", error)

if __name__ == "__main__":
  main(*sys.argv[1:])
"""
_DREW = "drew (2, 24, 32, 3) True"
_REFUSED = "refused this process was forked from one that had drawn, "


def says(script, *words):
  try:
    done = subprocess.run(
      [sys.executable, script, *words], capture_output=True, text=True, timeout=200
    )
  except subprocess.TimeoutExpired:
    pytest.fail("it hangs")
  return done.stdout or done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="fork is Linux's way")
@pytest.mark.parametrize(
  "drawn, context, said",
  [
    ("nothing", "fork", _DREW),
    pytest.param("own", "fork", _REFUSED, marks=pytest.mark.slow),
    pytest.param("other", "fork", _REFUSED, marks=pytest.mark.slow),
    pytest.param("own", "forkserver", _DREW, marks=pytest.mark.slow),
  ],
)
def test_processes_of_a_vector_draw_or_say_why_not(drawn, context, said, tmp_path):
  script = tmp_path / "vector.py"
  script.write_text(_ASYNC)
  assert says(script, drawn, context).startswith(said)


def test_a_process_forked_after_drawing_says_so_and_frees_nothing_of_its_parents(tmp_path):
  script = tmp_path / "fork.py"
  script.write_text("""
import os, palpate.tasks
env = palpate.tasks.load("touch", "easy", task_kwargs={"random": 0})
env.physics.render(24, 32, camera_id=0)
pid = os.fork()
if pid:
  os.waitpid(pid, 0)
else:
  try:
    env.physics.render(24, 32, camera_id=0)
  except RuntimeError as error:
    print("refused", error, flush=True)
  env.physics.free()
  os._exit(0)
""")
  assert says(script).startswith(_REFUSED)
