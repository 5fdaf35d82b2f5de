"""`palpate doctor`: what is installed, what works, and what is wrong, one line each."""

import argparse
import contextlib
import importlib.metadata
import importlib.util
import os
import pathlib
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable

from packaging import requirements
from palpate import __version__

from .console import CommandError

_EXTRAS = {
  "matplotlib": "plot",
  "imageio-ffmpeg": "video",
  "gymnasium": "gym",
  "websockets": "live",
}
_TIMEOUT = 60  # [s]
_DRAW = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 16, 16) as renderer:
  renderer.update_scene(data)
  assert renderer.render().any(), "the picture is black"
"""


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options: none."""


def main(args: argparse.Namespace) -> int:
  """Prints the findings; returns 1 if something is wrong, else 0."""
  wrong = 0
  for name, check in CHECKS.items():
    try:
      state, lines = "ok", check()
    except Exception as error:
      what = str(error) if isinstance(error, CommandError) else f"{type(error).__name__}: {error}"
      state, lines = "WRONG", [" ".join(what.split())]
      wrong += 1
    for line in lines:
      print(f"{state:<5}  {name:<9} {line}", flush=True)
  print("all is well" if not wrong else f"{wrong} thing{'s' * (wrong > 1)} wrong")
  return 1 if wrong else 0


def _palpate() -> list[str]:
  where = pathlib.Path(__file__).parent
  return [f"{__version__}, python {platform.python_version()}, {platform.platform()}, {where}"]


def _packages() -> list[str]:
  lines, bad = [], []
  every = map(requirements.Requirement, importlib.metadata.requires("palpate") or [])
  for wanted in every:
    if wanted.marker and not wanted.marker.evaluate({"extra": ""}):
      continue
    try:
      version = importlib.metadata.version(wanted.name)
    except importlib.metadata.PackageNotFoundError:
      bad.append(f"{wanted.name} is not installed, expected {wanted.specifier or 'it'}")
      continue
    lines.append(f"{wanted.name} {version}")
    if not wanted.specifier.contains(version, prereleases=True):
      bad.append(f"{wanted.name} is {version}, expected {wanted.specifier}")
  if bad:
    raise CommandError("; ".join(bad))
  missing = []
  for package, extra in _EXTRAS.items():
    try:
      lines.append(f"{package} {importlib.metadata.version(package)}")
    except importlib.metadata.PackageNotFoundError:
      missing.append(f"{package} (extra {extra})")
  return [", ".join(lines)] + ([f"not installed: {', '.join(missing)}"] if missing else [])


def _devices() -> list[str]:
  import warp as wp
  from palpate.tissue import device

  device.lower_log_level()
  device.init()
  lines = [f"{d.alias}: {d.name}" for d in wp.get_cuda_devices()] or ["no CUDA device"]
  return [f"cpu: {os.cpu_count()} cores; {'; '.join(lines)}"]


def _cache() -> list[str]:
  import warp as wp

  folder = pathlib.Path(wp.config.kernel_cache_dir or "")
  if not os.access(folder, os.W_OK):
    raise CommandError(f"cannot write to the kernel cache {folder}; set WARP_CACHE_PATH")
  size = 0
  for parent, _, names in os.walk(folder):
    for name in names:
      with contextlib.suppress(FileNotFoundError):  # other processes move what they have compiled
        size += os.path.getsize(os.path.join(parent, name))
  return [f"{folder} ({size / 1e6:.1f} MB)"]


def _plugin() -> list[str]:
  from palpate import register
  from palpate.engine.model.mjstruct import NAME

  slot = register()
  return [f"{NAME} is registered with MuJoCo, slot {slot}"]


def _tasks() -> list[str]:
  _python("import palpate.tasks.core.engine")
  try:
    return [f"start with dm-control {importlib.metadata.version('dm-control')}"]
  except importlib.metadata.PackageNotFoundError:
    return ["start without dm-control"]


def _gl() -> list[str]:
  chosen = os.environ.get("MUJOCO_GL")
  reasons, works = [], []
  for backend in ("egl", "osmesa", "glfw"):
    try:
      _python(_DRAW, MUJOCO_GL=backend)
      works.append(backend)
    except CommandError as error:
      reasons.append(f"{backend}: {error}")
  if not works:
    raise CommandError(f"no way to draw, install libegl1 or libosmesa6 ({'; '.join(reasons)})")
  if chosen in ("egl", "osmesa", "glfw") and chosen not in works:
    raise CommandError(f"MUJOCO_GL is {chosen}, which does not work here; {', '.join(works)} does")
  return [f"works: {', '.join(works)}; MUJOCO_GL is {chosen or 'not set'}"]


def _torch() -> list[str]:
  if importlib.util.find_spec("torch") is None:
    return ["not installed"]
  _python("import palpate.tasks; palpate.tasks.load('touch', 'easy').reset(); import torch")
  return ["starts after an exercise"]


def _python(code: str, **environment: str):
  """Runs code in an interpreter of its own; raises CommandError with its last word if it fails."""
  inherited = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}  # MuJoCo sets it
  try:
    done = subprocess.run(
      [sys.executable, "-c", code],
      env=inherited | environment,
      capture_output=True,
      text=True,
      timeout=_TIMEOUT,
    )
  except subprocess.TimeoutExpired:
    raise CommandError(f"no answer in {_TIMEOUT} s", 1) from None
  if done.returncode:
    words = done.stderr.strip().splitlines() or [f"ended by signal {-done.returncode}"]
    raise CommandError(words[-1], 1)


def _self_test() -> list[str]:
  import mujoco
  from palpate import register
  from palpate.organ import Organ

  from .press import command, probe

  register()
  model = mujoco.MjModel.from_xml_path(str(command.folder() / "scene.xml"))
  data = mujoco.MjData(model)
  organ = Organ(model, data, "organ")
  tool = probe.find(model, "probe")
  samples = list(probe.press(model, data, organ, tool, depth=0.005, speed=0.1, hold=0.02))
  if organ.error:
    raise CommandError(organ.error)
  step = statistics.median(s.step_s for s in samples)
  force = max(s.force for s in samples)
  if not 0.01 < force < 1 or samples[-1].force:
    raise CommandError(f"the press of 5 mm gives {force:.3g} N, expected 0.01 to 1 N")
  return [f"press on {organ.device}: {len(samples)} steps of {1e3 * step:.2f} ms, {force:.3f} N"]


CHECKS: dict[str, Callable[[], list[str]]] = {
  "palpate": _palpate,
  "packages": _packages,
  "devices": _devices,
  "cache": _cache,
  "plugin": _plugin,
  "tasks": _tasks,
  "drawing": _gl,
  "torch": _torch,
  "self-test": _self_test,
}
