"""Threads, signals and processes: who may step what, and what an attack leaves standing."""

import copy
import pathlib
import subprocess
import sys
import threading

import mujoco
import numpy as np
import palpate
import pytest
import warp as wp
from mujoco import rollout
from scenes import drive, load, probed

TESTS = str(pathlib.Path(__file__).parents[1])
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
HEAD = f"""
import importlib, os, signal, sys, threading, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # which the parent may ignore
sys.path.insert(0, {TESTS!r})
import mujoco, numpy as np, palpate, warp as wp
from scenes import load, press, probed
"""


@pytest.fixture
def process(tmp_path):
  """Returns what runs a program: its exit status, what it printed and its errors."""

  def start(code: str):
    file = tmp_path / "program.py"
    file.write_text(HEAD + code)
    command = [sys.executable, str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    return done.returncode, done.stdout.strip(), done.stderr

  return start


def trajectories(model, count=6, steps=40):
  """Returns initial states and controls of presses to different depths."""
  d = mujoco.MjData(model)
  start = np.empty(mujoco.mj_stateSize(model, FULL))
  mujoco.mj_getState(model, d, start, FULL)
  control = np.zeros((count, steps, model.nu))
  control[:, :, 0] = -np.linspace(0.002, 0.01, count)[:, None]
  return np.tile(start, (count, 1)), control


# Threads of one process.


def test_a_model_with_windows_passes_from_thread_to_thread():
  m, d, _ = load(probed())
  alone = drive(m, mujoco.MjData(m), 60)
  other, out = mujoco.MjData(m), []
  drive(m, other, 30)
  for steps in (20, 40):
    thread = threading.Thread(target=lambda steps=steps: out.append(drive(m, d, steps)))
    thread.start()
    thread.join()
    drive(m, other, 3)
  np.testing.assert_allclose(np.concatenate(out), alone, atol=1e-9)
  assert [palpate.Organ(m, each, "organ").error for each in (d, other)] == [None, None]


def test_threads_that_step_one_model_with_windows_take_turns():
  m, *_ = load(probed())
  alone = drive(m, mujoco.MjData(m), 150)
  ready, found = threading.Barrier(4), []

  def loop():
    d = mujoco.MjData(m)
    ready.wait()
    found.append((drive(m, d, 150), palpate.Organ(m, d, "organ").error))

  threads = [threading.Thread(target=loop) for _ in range(4)]
  for thread in threads:
    thread.start()
  for thread in threads:
    thread.join()
  assert len(found) == 4
  for forces, error in found:
    np.testing.assert_array_equal(forces, alone)
    assert error is None


def test_rollout_of_one_model_with_windows_by_several_threads_is_the_same_as_by_one():
  m, d, _ = load(probed())
  state, control = trajectories(m)
  expected, _ = rollout.rollout(m, d, state, control)
  datas = [mujoco.MjData(m) for _ in range(3)]
  with rollout.Rollout(nthread=3) as run:
    for _ in range(3):
      found, _ = run.rollout(m, datas, state, control)
      np.testing.assert_array_equal(found, expected)
  assert [palpate.Organ(m, each, "organ").error for each in datas] == 3 * [None]


@pytest.mark.parametrize("young", [3e4, 3e6])
def test_rollout_of_copies_by_several_threads_is_the_same_as_by_one(young):
  m, d, _ = load(probed(keys={"young": young}))
  state, control = trajectories(m)
  expected, _ = rollout.rollout(m, d, state, control)
  models = [copy.copy(m) for _ in state]
  datas = [mujoco.MjData(each) for each in models[:3]]
  with rollout.Rollout(nthread=3) as run:
    for _ in range(3):
      found, _ = run.rollout(models, datas, state, control)
      np.testing.assert_allclose(found, expected, atol=1e-9)
  for model, data in zip(models, datas, strict=False):
    assert palpate.Organ(model, data, "organ").error is None


def test_what_a_thread_records_is_not_recorded_by_others(monkeypatch):
  begin, seen = wp.ScopedCapture.__enter__, []

  def begin_and_look(capture):
    found = begin(capture)
    cpu = wp.get_device("cpu")
    thread = threading.Thread(target=lambda: seen.append(cpu.is_capturing))
    thread.start()
    thread.join()
    return found

  monkeypatch.setattr(wp.ScopedCapture, "__enter__", begin_and_look)
  load(probed())
  assert len(seen) > 5 and not any(seen)


@pytest.mark.slow
def test_kernels_of_other_threads_run_while_graphs_are_recorded(process):
  code = """
@wp.kernel
def add(x: wp.array(dtype=float), y: wp.array(dtype=float)):
  i = wp.tid()
  y[i] = y[i] + x[i]

ready, stop, wrong = threading.Event(), threading.Event(), []
def work():
  while not stop.is_set():
    x, y = wp.ones(100, dtype=float, device="cpu"), wp.zeros(100, dtype=float, device="cpu")
    for _ in range(10): wp.launch(add, dim=100, inputs=[x, y], device="cpu")
    if not (y.numpy() == 10).all(): wrong.append(y.numpy())
    ready.set()
m, d, organ = load(probed())
threads = [threading.Thread(target=work) for _ in range(2)]
for t in threads: t.start()
ready.wait()
sys.setswitchinterval(1e-5)
for k in range(40):
  organ.configure(tolerance=1e-5 + 1e-7 * k)
  mujoco.mj_step(m, d)
sys.setswitchinterval(5e-3)
stop.set()
for t in threads: t.join()
print("wrong:", wrong, organ.error)
"""
  status, out, errors = process(code)
  assert (status, out) == (0, "wrong: [] None"), errors


@pytest.mark.slow
def test_models_are_compiled_by_several_threads(process):
  code = """
refused = []
def build(k):
  for j in range(6):
    try:
      m, d, organ = load(press(subdivisions=1, young=1e4 + 1e3 * k + j))
      mujoco.mj_step(m, d)
      if organ.error: refused.append(organ.error)
    except ValueError as error: refused.append(str(error))
threads = [threading.Thread(target=build, args=(k,)) for k in range(4)]
for t in threads: t.start()
for t in threads: t.join()
print(refused)
"""
  status, out, errors = process(code)
  assert (status, out) == (0, "[]"), errors


# Processes.


def test_threads_that_step_while_the_process_ends(process):
  code = """
def loop(xml):
  m, d, _ = load(xml)
  started.release()
  while True: mujoco.mj_step(m, d)
started = threading.Semaphore(0)
for xml in (probed(), probed(), probed(False)):
  threading.Thread(target=loop, args=(xml,), daemon=True).start()
for _ in range(3): started.acquire()
time.sleep(0.1)
print("done")
"""
  for _ in range(2):
    status, out, errors = process(code)
    assert (status, out) == (0, "done"), errors


@pytest.mark.skipif(sys.platform == "win32", reason="needs fork")
def test_a_child_can_compile_that_was_forked_while_another_thread_did(process):
  code = """
stop = False
def loop(k):
  while not stop: load(press(subdivisions=1, young=1e3 + k + time.time() % 100))
threads = [threading.Thread(target=loop, args=(k,)) for k in (0, 1000)]
for t in threads: t.start()
bad = []
for k in range(8):
  time.sleep(0.02)
  pid = os.fork()
  if not pid:
    m, d, organ = load(press(subdivisions=1))
    mujoco.mj_step(m, d)
    os._exit(0 if organ.error is None else 1)
  end = time.time() + 10
  found = 0, 0
  while not found[0] and time.time() < end:
    time.sleep(0.01)
    found = os.waitpid(pid, os.WNOHANG)
  if not found[0]:
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
  if not found[0] or found[1]: bad.append(found)
stop = True
for t in threads: t.join()
print("bad:", bad)
"""
  status, out, errors = process(code)
  assert (status, out) == (0, "bad: []"), errors


def test_the_plugin_is_loaded_once_and_goes_on_when_somebody_tries_again(process):
  package = pathlib.Path(palpate.__file__).parent
  code = f"""
from palpate.engine import plugin
m, d, organ = load(probed())
mujoco.mj_step(m, d, 5)
try:
  importlib.reload(plugin)
except ImportError as error:
  print("again" in str(error))
import importlib.util
name = "palpate_twice"
spec = importlib.util.spec_from_file_location(
  name, {str(package / "engine" / "plugin.py")!r}, submodule_search_locations=[]
)
sys.modules[name] = importlib.util.module_from_spec(spec)
sys.modules[name].__package__ = "palpate.engine"
try:
  spec.loader.exec_module(sys.modules[name])
  sys.modules[name].register()
except ImportError as error:
  print("one name" in str(error))
mujoco.mj_step(m, d, 5)
print(organ.error, round(d.time, 6))
"""
  status, out, errors = process(code)
  assert (status, out.split("\n")) == (0, ["True", "True", "None 0.01"]), errors


@pytest.mark.parametrize("kind", ["organ", "windowed"])
def test_an_organ_that_fails_late_in_the_first_compilation_is_refused_by_name(process, kind):
  code = f"""
import scenes
points, elem = scenes.triangular(0.1, 0.05, 4, 3)
try: load(scenes.world(scenes.{kind}(1e-9 * points, elem, young=2e4, foundation=1e4)))
except ValueError as error: print(error)
"""
  status, out, errors = process(code)
  assert status == 0, errors
  assert "organ 'organ': no vertex gives way" in out and "is its scale right" in out


# Signals.


@pytest.mark.parametrize("windowed", [True, False])
def test_ctrl_c_ends_a_loop_of_steps_and_leaves_them_whole(process, windowed):
  # Signals nearly always fall into a callback, between any two instructions of it.
  code = f"""
armed = False  # in the block that catches it
def on_alarm(number, frame):
  if armed: on_ctrl_c(number, frame)
on_ctrl_c = signal.getsignal(signal.SIGINT)
signal.signal(signal.SIGALRM, on_alarm)
def drive(interrupts):
  global armed
  m, d, organ = load(probed({windowed}))
  heard = 0
  signal.setitimer(signal.ITIMER_REAL, 0.001, 0.001)
  while d.time < 249.5 * m.opt.timestep:
    d.ctrl[0] = -0.004 * min(1, d.time / 0.1)
    try:
      armed = interrupts
      mujoco.mj_step(m, d)
      armed = False
    except KeyboardInterrupt: armed, heard = False, heard + 1
  signal.setitimer(signal.ITIMER_REAL, 0)
  print(heard, organ.error)
  return d.qpos.tobytes() + d.qvel.tobytes() + d.plugin_state.tobytes()
print(drive(False) == drive(True))
"""
  status, out, errors = process(code)
  quiet, loud, same = out.split("\n")
  assert (status, quiet, same) == (0, "0 None", "True"), errors
  assert loud.endswith(" None") and int(loud.split()[0]) > 2


def test_what_another_handler_raises_comes_out_and_the_organ_says_so(process):
  code = """
for windowed in (True, False):
  m, d, organ = load(probed(windowed))
  signal.signal(signal.SIGINT, signal.default_int_handler)  # as notebooks do
  for k in range(15):
    try:
      threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGINT)).start()
      while True: mujoco.mj_step(m, d)
    except KeyboardInterrupt: pass
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert organ.error is None or "a step was interrupted by KeyboardInterrupt" in organ.error
    mujoco.mj_resetData(m, d)
    assert organ.error is None
    while d.time < 0.02: mujoco.mj_step(m, d)
    motion = d.plugin_state.tobytes()
    if not k: first = motion
    assert motion == first and organ.error is None
signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(5))
threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
while True: mujoco.mj_step(m, d)
"""
  status, _, errors = process(code)
  assert status == 5 and "Exception ignored" not in errors, errors


def test_signals_while_contacts_are_found_again_do_no_harm(process):
  code = """
armed = False  # not while one is handled
def on_alarm(number, frame):
  global armed
  if armed:
    armed = False
    raise TimeoutError
signal.signal(signal.SIGALRM, on_alarm)
m, d, organ = load(probed())
other, raised = mujoco.MjData(m), 0
pairs = (d, organ), (other, palpate.Organ(m, other, "organ"))
signal.setitimer(signal.ITIMER_REAL, 0.001, 0.003)
end = time.perf_counter() + 2
while time.perf_counter() < end:
  try:
    armed = True
    for data, _ in pairs: mujoco.mj_step(m, data)
    armed = False
  except TimeoutError: raised += 1
  for data, each in pairs:
    if each.error:
      raised += "TimeoutError" in each.error
      mujoco.mj_resetData(m, data)
signal.setitimer(signal.ITIMER_REAL, 0)
print(raised > 0, bool(np.isfinite(organ.displacement).all()), raised)
"""
  status, said, errors = process(code)
  assert status == 0 and said.startswith("True True"), said + errors


@pytest.mark.parametrize("window", [True, False])
def test_a_signal_in_the_middle_of_a_cut_waits_until_it_is_made(process, window):
  code = f"""
import trimesh
def on_alarm(number, frame):
  raise TimeoutError
signal.signal(signal.SIGALRM, on_alarm)
spec = mujoco.MjSpec()
spec.option.gravity = 0, 0, 0
palpate.add_organ(spec, trimesh.creation.icosphere(2, 0.05), "organ", mass=0.3, young=5000,
                  foundation=4e4, windows={window}, spare=120)
m = spec.compile()
d = mujoco.MjData(m)
organ, rng, raised, made = palpate.Organ(m, d, "organ"), np.random.RandomState(0), 0, 0
mujoco.mj_step(m, d, 20)
still, mass = organ.xpos.copy(), organ.mass.sum()
end = time.perf_counter() + 4
while time.perf_counter() < end:
  count = organ.nvert
  try:
    try:
      signal.setitimer(signal.ITIMER_REAL, rng.uniform(2e-4, 4e-3))
      organ.cut(organ.xpos[rng.randint(organ.nvert, size=2)])
    finally: signal.setitimer(signal.ITIMER_REAL, 0)
  except (TimeoutError, ValueError) as error: raised += isinstance(error, TimeoutError)
  made += organ.nvert > count
  assert abs(organ.mass.sum() - mass) < 1e-12 and np.isfinite(organ.xpos).all()
  if made % 5 == 4:
    mujoco.mj_resetData(m, d)
    mujoco.mj_step(m, d, 20)
    assert organ.error is None and np.array_equal(organ.xpos, still), organ.error
    made += 1
print(raised > 5, made > 10, raised, made)
"""
  status, said, errors = process(code)
  assert status == 0 and said.startswith("True True"), said + errors


def test_ctrl_c_is_heard_in_a_loop_of_forward(process):
  code = """
m, d, organ = load(probed())
for handler in (signal.getsignal(signal.SIGINT), signal.default_int_handler):
  signal.signal(signal.SIGINT, handler)
  try:
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    while True: mujoco.mj_forward(m, d)
  except KeyboardInterrupt: print(signal.getsignal(signal.SIGINT) is handler)
"""
  assert process(code)[:2] == (0, "True\nTrue")
