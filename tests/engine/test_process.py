"""Whole processes: what they print, how they end, and another MuJoCo."""

import ctypes.util
import os
import pathlib
import subprocess
import sys

import mujoco
import pytest

SCENE = pathlib.Path(__file__).parents[2] / "models" / "press" / "scene.xml"


_SCRIPT = """
import sys, mujoco, palpate
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
for _ in range(20):
  mujoco.mj_step(model, data)
organ = palpate.Organ(model, data, "organ")
print(mujoco.__version__, organ.nvert, organ.error, repr(float(data.qpos[0])))
"""


def _process(scenes, tmp_path, python=sys.executable):
  path = tmp_path / "scene.xml"
  path.write_text(scenes.press(subdivisions=1))
  environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
  return subprocess.run(
    [python, "-c", _SCRIPT, str(path)],
    cwd=tmp_path,
    env=environment,
    capture_output=True,
    text=True,
    timeout=300,
    check=True,
  )


def test_a_fresh_process_prints_nothing_and_leaves_no_log(scenes, tmp_path):
  done = _process(scenes, tmp_path)
  assert len(done.stdout.splitlines()) == 1, done.stdout
  # Warp itself speaks of a missing CUDA driver; of MuJoCo and palpate nothing may be left.
  ours = [line for line in done.stderr.splitlines() if not line.startswith("Warp CUDA warning")]
  assert ours == []
  assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]


def test_another_mujoco_gives_the_same_motion(scenes, tmp_path):
  python = os.environ.get("PALPATE_OTHER_PYTHON", "")
  if not pathlib.Path(python).is_file():
    pytest.skip("PALPATE_OTHER_PYTHON names no Python that has another mujoco and palpate")
  version, nvert, error, qpos = _process(scenes, tmp_path, python).stdout.split()
  assert version != mujoco.__version__ and (nvert, error) == ("42", "None")
  ours = _process(scenes, tmp_path).stdout.split()[3]
  assert float(qpos) == pytest.approx(float(ours), abs=1e-7)


def test_ctrl_c_ends_a_loop_of_steps(tmp_path):
  # The signal nearly always falls into a callback, where ctypes would drop the exception.
  script = tmp_path / "loop.py"
  script.write_text(
    "import os, signal, threading\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # which the parent may ignore
    "import mujoco, palpate\n"
    f"m = mujoco.MjModel.from_xml_path({str(SCENE)!r})\n"
    "d = mujoco.MjData(m)\n"
    "mujoco.mj_step(m, d)\n"
    "threading.Timer(0.2, lambda: os.kill(os.getpid(), signal.SIGINT)).start()\n"
    "try:\n"
    "  while d.time < 60: mujoco.mj_step(m, d)\n"
    "  print('lost')\n"
    "except KeyboardInterrupt:\n"
    "  print('interrupted', palpate.Organ(m, d, 'organ').error)\n"
  )
  out = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
  assert out.stdout.strip().endswith("interrupted None"), out.stdout + out.stderr


def test_data_that_outlives_the_modules_is_freed_quietly(scenes):
  # In a cycle that only the interpreter's last collection finds.
  code = f"""
import gc, sys, mujoco, palpate
gc.disable()
class Holder: pass
holder = Holder()
holder.model = mujoco.MjModel.from_xml_string({scenes.press(subdivisions=1)!r})
holder.data = mujoco.MjData(holder.model)
mujoco.mj_step(holder.model, holder.data)
holder.me = sys.modules["kept by nobody"] = holder
print("stepped")
"""
  done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
  assert (done.returncode, done.stdout.strip()) == (0, "stepped"), done.stderr
  assert "Exception" not in done.stderr and "Error" not in done.stderr


@pytest.mark.parametrize("order", ["palpate, mujoco", "mujoco, palpate"])
def test_drawing_without_a_screen_and_without_being_told_how(order, monkeypatch):
  for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY"):
    monkeypatch.delenv(name, raising=False)
  if not (ctypes.util.find_library("EGL") or ctypes.util.find_library("OSMesa")):
    pytest.skip("no way to draw without a screen")
  code = f"""
import {order}
model = mujoco.MjModel.from_xml_path({str(SCENE)!r})
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
  renderer.update_scene(data)
  assert renderer.render().std() > 1
"""
  subprocess.run([sys.executable, "-c", code], check=True)
