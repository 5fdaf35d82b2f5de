"""The exercises in Gymnasium."""

import contextlib
import ctypes.util
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import types
import warnings

import mujoco
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


class Viewer:
  """Stands in for MuJoCo's passive viewer, whose own switches somebody turns."""

  def __init__(self, model, data, **panels):
    self.cam = types.SimpleNamespace(type=None, fixedcamid=-1)
    self.opt = types.SimpleNamespace(flags=np.zeros(4, np.uint8))
    self.user_scn = types.SimpleNamespace(flags=np.ones(4, np.uint8))
    self.model, self.panels, self.pictures, self.closed = model, panels, 0, False

  lock = contextlib.nullcontext

  def sync(self):
    assert not self.opt.flags.any() and self.user_scn.flags.all()
    self.pictures += 1
    self.user_scn.flags[1], self.opt.flags[2] = False, True

  def is_running(self):
    return True

  def close(self):
    self.closed = True


@pytest.fixture
def human(monkeypatch):
  """An environment that draws for people, with a stand-in for the viewer."""
  monkeypatch.setenv("DISPLAY", ":0")

  def make(viewer=Viewer):
    opened = []

    def launch(*words, **keys):
      opened.append(viewer(*words, **keys))
      return opened[-1]

    monkeypatch.setattr("mujoco.viewer.launch_passive", launch)
    return gymnasium.make("palpate/TouchEasy-v0", render_mode="human"), opened

  return make


def test_human_looks_through_the_laparoscope(human):
  env, windows = human()
  env.reset(seed=0)
  for _ in range(3):
    env.step(np.zeros(4))
  (window,) = windows
  assert window.cam.type == mujoco.mjtCamera.mjCAMERA_FIXED and window.pictures == 4
  assert window.cam.fixedcamid == window.model.camera("laparoscope").id
  assert not any(window.panels.values())
  env.close()
  assert window.closed


def test_closing_waits_for_the_window_to_go(human):
  gone = []

  class Slow(Viewer):
    def __init__(self, *words, **keys):
      super().__init__(*words, **keys)
      self.leave = threading.Event()
      threading.Thread(target=self.draw, daemon=True).start()

    def draw(self):
      self.leave.wait()
      time.sleep(0.3)  # MuJoCo's window finishes a picture
      gone.append(True)

    def close(self):
      self.leave.set()

  env, _ = human(Slow)
  env.reset(seed=0)
  env.close()
  assert gone


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("Xvfb"), reason="needs Xvfb")
def test_ctrl_c_with_a_window_ends_in_order():
  server = subprocess.Popen(
    ["Xvfb", "-displayfd", "1", "-screen", "0", "800x600x24"],
    stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
  )  # fmt: skip
  environment = os.environ | {"DISPLAY": f":{server.stdout.readline().strip()}"}
  environment.pop("MUJOCO_GL", None)
  lines = (
    "import gymnasium, numpy, palpate.tasks",
    "env = gymnasium.make('palpate/TouchEasy-v0', render_mode='human')",
    "env.reset(seed=0)",
    "print('open', flush=True)",
    "while True: env.step(numpy.zeros(4))",
  )
  command = [sys.executable, "-c", "\n".join(lines)]
  try:
    for _ in range(5):
      process = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
      )
      assert process.stdout.readline() == "open\n"
      process.send_signal(signal.SIGINT)
      _, error = process.communicate(timeout=60)
      assert process.returncode == -signal.SIGINT, error
  finally:
    server.terminate()


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
