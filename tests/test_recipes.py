"""The recipes of docs/extending.md, followed: their patches are applied to a copy of the code."""

import os
import pathlib
import re
import shutil
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[1]
FREE = """
import mujoco, numpy as np, palpate, trimesh
def make(**keys):
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = 1e-3, np.zeros(3)
  ball = trimesh.creation.icosphere(1, 0.02)
  palpate.add_organ(spec, ball, "organ", mass=0.02, device="cpu", young=1e4, **keys)
  return spec
def load(**keys):
  model = make(**keys).compile()
  data = mujoco.MjData(model)
  return model, data, palpate.Organ(model, data, "organ")
"""
DAMPED = """
model, data, organ = load(mass_damping=5.0)
organ.set_state(organ.xpos, np.tile([0.1, 0.0, 0.0], (organ.nvert, 1)))
mujoco.mj_step(model, data, 100)
np.testing.assert_allclose(organ.xvel.mean(axis=0), [0.1 / 1.005**100, 0, 0], atol=1e-5)
organ.configure(mass_damping=0.0)
before = organ.xvel.mean(axis=0)
mujoco.mj_step(model, data, 100)
np.testing.assert_allclose(organ.xvel.mean(axis=0), before, atol=1e-5)
try:
  load(mass_damping=-1.0)
except ValueError as error:
  assert "mass_damping is '-1', expected a number >= 0" in str(error), error
else:
  raise AssertionError("it was taken")
"""
LIFT = """
model, data, organ = load(lift=9.81)
rest = organ.xpos.mean(axis=0)
mujoco.mj_step(model, data, 100)
np.testing.assert_allclose((organ.xpos.mean(axis=0) - rest)[2], 0.5 * 9.81 * 0.1**2, rtol=0.02)
import palpate.batch
batch = palpate.batch.make(make(lift=9.81), 2, device="warp-cpu", nodes=4)
tissue = batch.organ("organ")
rest = tissue.xpos.numpy().mean(axis=1)
batch.step(100)
rise = (tissue.xpos.numpy().mean(axis=1) - rest)[:, 2]
np.testing.assert_allclose(rise, 0.5 * 9.81 * 0.1**2, rtol=0.02)
"""
SUCKER = """
import mujoco, numpy as np, palpate
from palpate import models
model = models.load("kidney", nodes=250, instruments=("sucker",)).compile()
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("press").id)
mujoco.mj_step(model, data, 400)
assert 0.05 < np.linalg.norm(data.sensor("sucker/tip_force").data) < 5.0
"""
ELASTIC = "-m", "pytest", "tests/tissue/test_elastic.py", "-q", "-x", "-p", "no:xdist", "-k"
# Section of the page; what is run; files that may be forgotten, and what is said then.
RECIPES = {
  "A configuration key": (
    ("-c", FREE + DAMPED),
    {"plugin/tissue/types.py": "MASS_DAMPING", "plugin/tissue/config.py": "mass_damping"},
  ),
  "An elastic energy of surfaces": (
    (*ELASTIC, "hardening"),
    {"plugin/tissue/energy.py": "test_force_is_minus_the_gradient_of_the_energy"},
  ),
  "An elastic energy of solids": (
    (*ELASTIC, "solid"),
    {"plugin/native/tissue/solid.h": "test_force_is_minus_the_gradient_of_the_energy"},
  ),
  "A force": (("-c", FREE + LIFT), {"plugin/tissue/config.py": "lift"}),
  "An instrument": (
    ("-c", SUCKER),
    {
      "models/trocar.py": "instrument is 'sucker', expected one of probe, ",
      "models/instruments/sucker.xml": "sucker.xml",
    },
  ),
}


def patches(section):
  """Returns the patches of a section of the page, by file."""
  page = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
  text = page.split(f"\n## {section}\n", 1)[1].split("\n## ", 1)[0]
  (patch,) = re.findall(r"^```diff\n(.*?)^```$", text, re.M | re.S)
  parts = re.split(r"^(?=--- )", patch, flags=re.M)[1:]
  return {re.search(r"^\+\+\+ b/(.*)$", part, re.M).group(1): part for part in parts}


def follow(folder, made):
  """Applies patches to a copy of the code; returns what an interpreter needs to import it."""
  ignore = shutil.ignore_patterns("__pycache__", "*.png", "results", "policies")
  for name in ("plugin", "models", "tasks", "tests"):
    shutil.copytree(ROOT / name, folder / name, ignore=ignore)
  shutil.copy(ROOT / "pyproject.toml", folder)
  for name in ("models", "tasks"):
    (folder / "plugin" / name).symlink_to(folder / name)
  (folder / "site").mkdir()
  (folder / "site/palpate").symlink_to(folder / "plugin")
  for part in made.values():
    numbers = "@@ -0,0 +1 @@" if part.startswith("--- /dev/null") else "@@ -9 +9 @@"
    text = re.sub("^@@$", numbers, part, flags=re.M)
    command = ["git", "apply", "--recount", "-"]
    subprocess.run(command, cwd=folder, input=text, text=True, check=True)
  inherited = {name: value for name, value in os.environ.items() if name != "PYTEST_ADDOPTS"}
  return {**inherited, "PYTHONPATH": str(folder / "site")}


def run(folder, environment, words):
  command = [sys.executable, *words]
  return subprocess.run(
    command, cwd=folder, env=environment, capture_output=True, text=True, check=False
  )


@pytest.mark.parametrize("section", RECIPES)
def test_a_recipe(tmp_path, section):
  words, _ = RECIPES[section]
  done = run(tmp_path, follow(tmp_path, patches(section)), words)
  assert done.returncode == 0, done.stdout + done.stderr


FORGOTTEN = [(section, name) for section, (_, names) in RECIPES.items() for name in names]
LESS = [pytest.param(*each, marks=pytest.mark.slow) for each in FORGOTTEN[1:]]


@pytest.mark.parametrize(("section", "name"), [FORGOTTEN[0], *LESS])
def test_a_step_that_is_forgotten_is_named(tmp_path, section, name):
  words, names = RECIPES[section]
  made = patches(section)
  del made[name]
  done = run(tmp_path, follow(tmp_path, made), words)
  assert done.returncode != 0 and names[name] in done.stdout + done.stderr
