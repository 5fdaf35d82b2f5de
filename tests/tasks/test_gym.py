"""The exercises in Gymnasium."""

import ctypes.util
import subprocess
import sys
import warnings

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from palpate.tasks import registry  # noqa: E402

IDS = [registry.gym_id(domain, task) for domain, tasks in registry.TASKS.items() for task in tasks]


# What takes long to import, and is not needed to know the names.
HEAVY = {"palpate.tasks.gym", "palpate.tasks.batch", "palpate.batch", "torch", "matplotlib"}
LIGHT = f"assert not (heavy := {HEAVY} & set(sys.modules)), heavy"


def run(*lines):
  subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True, timeout=120)


def test_importing_the_tasks_registers_them_and_stays_light():
  registered = "assert 'palpate/Touch-v0' in gymnasium.registry"
  run("import sys, palpate.tasks, gymnasium", registered, LIGHT)
  run("import sys, gymnasium, palpate.tasks", registered, LIGHT)


def test_gymnasium_finds_them_without_an_import():
  run(
    "import gymnasium",
    "env = gymnasium.make('palpate.tasks:palpate/TouchEasy-v0')",
    "assert env.spec.id == 'palpate/TouchEasy-v0'",
    "assert env.reset(seed=0)[0]['target'].shape == (3,)",
  )


def test_the_package_knows_neither_its_tasks_nor_its_commands():
  run(
    "import sys, palpate",
    "assert not [m for m in sys.modules if m.startswith(('palpate.tasks', 'palpate.app'))]",
  )


def test_without_gymnasium_the_tasks_are_there():
  run(
    "import sys",
    "sys.modules['gymnasium'] = None",
    "from palpate import tasks",
    "assert tasks.load('touch', 'easy').reset().first()",
  )


def test_ids():
  assert len(set(IDS)) == len(IDS)
  assert {"palpate/Touch-v0", "palpate/TouchEasy-v0", "palpate/ProbePalpateHard-v0"} < set(IDS)


@pytest.mark.parametrize("domain", ["Touch", "Probe", "ProbePalpate", "Grasp", "Trace", "Retract"])
def test_env_checker(domain):
  with warnings.catch_warnings():
    warnings.filterwarnings("ignore", ".*infinity.*")
    warnings.filterwarnings("ignore", ".*observation space m.*imum value.*")
    env = gymnasium.make(f"palpate/{domain}Easy-v0")
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_a_seed_repeats_and_another_does_not():
  env = gymnasium.make("palpate/TouchEasy-v0", disable_env_checker=True)
  first, second, third = (env.reset(seed=s)[0]["tip_pos"] for s in (1, 1, 2))
  np.testing.assert_array_equal(first, second)
  assert not np.array_equal(first, third)


def test_rendering():
  env = gymnasium.make("palpate/TouchEasy-v0", render_mode="rgb_array", width=64, height=48)
  env.reset(seed=0)
  picture = env.render()
  assert picture.shape == (48, 64, 3) and picture.dtype == np.uint8 and np.ptp(picture) > 20
  with pytest.raises(ValueError, match="render_mode is 'ascii'"):
    env.unwrapped.__class__(render_mode="ascii")
  env.close()


@pytest.mark.skipif(
  not (ctypes.util.find_library("EGL") or ctypes.util.find_library("OSMesa")),
  reason="no way to draw without a screen",
)
def test_rendering_without_a_screen_and_without_being_told_how(monkeypatch):
  for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY"):
    monkeypatch.delenv(name, raising=False)
  run(
    "import gymnasium, palpate.tasks",
    "env = gymnasium.make('palpate/TouchEasy-v0', render_mode='rgb_array', width=64, height=48)",
    "env.reset(seed=0)",
    "assert env.render().std() > 10",
  )


def test_human_says_that_there_is_no_display(monkeypatch):
  if not sys.platform.startswith("linux"):
    pytest.skip("displays are asked for on Linux")
  monkeypatch.delenv("DISPLAY", raising=False)
  monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
  env = gymnasium.make("palpate/TouchEasy-v0", render_mode="human")
  with pytest.raises(RuntimeError, match="no display"):
    env.reset()


def test_vectors_and_the_end_of_an_episode():
  envs = gymnasium.make_vec(
    "palpate/TouchEasy-v0", num_envs=2, vectorization_mode="sync", time_limit=0.06, record=True
  )
  observation, _ = envs.reset(seed=0)
  assert observation["target"].shape == (2, 3)
  for _ in range(3):
    _, reward, terminated, truncated, info = envs.step(np.zeros((2, 4)))
  assert truncated.all() and not terminated.any() and reward.shape == (2,)
  assert "time" in info["metrics"]
  assert "path_inefficiency" not in info["metrics"]  # of a part of the path
  envs.close()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
@pytest.mark.parametrize("backend", ["egl", "osmesa"])
def test_opengl_is_loaded_when_a_picture_is_asked_for(monkeypatch, backend):
  # Torch ends a process that has Mesa's LLVM.
  if not ctypes.util.find_library({"egl": "EGL", "osmesa": "OSMesa"}[backend]):
    pytest.skip(f"no {backend}")
  monkeypatch.setenv("MUJOCO_GL", backend)
  monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
  code = f"""
import os, palpate.tasks, mujoco
def drawn():
  return any(name in open("/proc/self/maps").read() for name in ("LLVM", "libEGL", "OSMesa"))
env = palpate.tasks.load("touch", "easy", task_kwargs=dict(random=0))
env.step(env.action_spec().minimum)
assert not drawn() and os.environ["MUJOCO_GL"] == {backend!r}
assert env.physics.render(48, 64).std() > 1 and drawn()
with mujoco.Renderer(env.physics.model.ptr, 48, 64) as renderer:
  renderer.update_scene(env.physics.data.ptr)
  assert renderer.render().std() > 1
try:
  mujoco.nothing
except AttributeError as error:
  assert "nothing" in str(error)
"""
  subprocess.run([sys.executable, "-c", code], check=True)
