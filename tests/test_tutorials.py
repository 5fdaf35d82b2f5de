"""The tutorials: their code runs as it stands, and ends with what their text promises."""

import csv
import json
import math
import pathlib
import re
import subprocess
import sys

import numpy as np
import pytest

FOLDER = pathlib.Path(__file__).parents[1] / "docs" / "tutorials"
NAMES = ("first_organ", "first_exercise", "first_policy", "first_cut")


def cells(name: str) -> list[dict]:
  return json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]


def run(name: str, folder: pathlib.Path, *wanted: str) -> list:
  """Runs a tutorial in a process of its own; returns the values of expressions at its end."""
  pytest.importorskip("matplotlib")
  pytest.importorskip("gymnasium")
  code = ["import matplotlib", "matplotlib.use('agg')"]  # draws without a screen
  code += ["".join(cell["source"]) for cell in cells(name) if cell["cell_type"] == "code"]
  values = ", ".join(f"np.asarray({each}).tolist()" for each in wanted)
  code += ["import json", f"json.dump([{values}], open('values.json', 'w'))"]
  (folder / "tutorial.py").write_text("\n".join(code), encoding="utf-8")
  done = subprocess.run(
    [sys.executable, "tutorial.py"], cwd=folder, capture_output=True, text=True, timeout=300
  )
  assert done.returncode == 0, done.stderr
  return json.loads((folder / "values.json").read_text(encoding="utf-8"))


def test_the_first_organ_bears_a_ball_and_pushes_the_arm_back(tmp_path):
  wanted = ("resting_force", "weight", "depth", "force", "picture", "model.nv", "organ.nvert")
  bears, weight, *pressed, picture, nv, nvert = run("first_organ", tmp_path, *wanted)
  depth, force = np.array(pressed)
  assert bears == pytest.approx(weight, rel=0.01)
  assert nv < nvert  # by windows
  assert depth[-1] == pytest.approx(0.008, abs=5e-4)  # the actuators are springs
  assert force[depth < -1e-4].max() == pytest.approx(0, abs=1e-9)
  assert 0.1 < force[-1] < 0.3
  assert (np.diff(force[depth > 5e-4]) > 0).all()
  assert np.std(picture) > 10  # [0, 255]


def test_the_first_exercise_is_solved_by_its_expert_and_by_hand_alone_and_in_four_worlds(tmp_path):
  wanted = ("expert_outcome", "outcome", "metrics['time']", "outcomes", "times")
  expert, hand, time, outcomes, times = run("first_exercise", tmp_path, *wanted)
  assert (expert, hand) == ("success", "success")
  assert outcomes == ["success"] * 4
  assert times[0] == pytest.approx(time, abs=1e-5)  # float32


def test_the_first_policy_succeeds_almost_as_often_as_the_expert(tmp_path):
  expert, clone = run("first_policy", tmp_path, "scores['expert']", "scores['clone']")
  assert expert[0] == 1.0
  assert clone[0] >= 0.8
  assert 0.5 < clone[2] / expert[2] < 2  # time


def test_the_first_cut_opens_and_takes_a_piece_off(tmp_path):
  wanted = ("report.length", "report.deviation", "report.stopped", "healed", "gape", "pull",
            "[piece.held for piece in organ.pieces]", "fall", "before", "after")  # fmt: skip
  length, off, stopped, healed, gape, pull, held, fall, *pictures = run(
    "first_cut", tmp_path, *wanted
  )
  assert length == pytest.approx(0.07, rel=0.02)
  assert off < 1e-4
  assert not stopped
  assert healed == 2562
  assert 0.01 < gape < 0.016
  assert pull > 0.1
  assert held == [True, False]
  assert fall == pytest.approx(9.81 / 2 * 0.07**2, rel=0.2)
  before, after = np.array(pictures)
  assert (np.abs(before - after).max(axis=2) > 50).mean() > 0.01  # of the pixels


@pytest.mark.parametrize("name", NAMES)
def test_notebooks_begin_with_an_example_and_keep_no_outputs(name):
  title, example, *rest = cells(name)
  assert title["cell_type"] == "markdown"
  assert title["source"][0].startswith("# First ")
  assert example["cell_type"] == "code"
  assert "print(" in "".join(example["source"])
  for cell in (example, *rest):
    if cell["cell_type"] == "code":
      assert (cell["execution_count"], cell["outputs"]) == (None, [])


@pytest.mark.parametrize("name", NAMES)
def test_links_of_notebooks_lead_somewhere(name):
  text = "".join("".join(c["source"]) for c in cells(name) if c["cell_type"] == "markdown")
  for target in re.findall(r"\]\((?!https?:)([^)#]+)", text):
    assert (FOLDER / target).is_file(), target


def test_every_notebook_is_listed_and_tested():
  page = (FOLDER / "README.md").read_text(encoding="utf-8")
  assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(NAMES)
  assert set(re.findall(r"\]\((\w+)\.ipynb\)", page)) == set(NAMES)


@pytest.mark.slow
def test_ppo_learns_from_nothing_in_a_few_worlds_on_the_cpu():
  pytest.importorskip("torch")
  options = ["--device", "cpu", "--worlds", "4", "--minutes", "0.1"]
  command = [sys.executable, str(FOLDER / "ppo.py"), "touch/easy", *options]
  curve = subprocess.run(command, check=True, timeout=600, stdout=subprocess.PIPE, text=True).stdout
  rows = list(csv.DictReader(curve.splitlines()))
  assert len(rows) >= 2 and int(rows[-1]["steps"]) == int(rows[0]["steps"]) * len(rows)
  assert all(math.isfinite(float(row["paid"])) and float(row["made"]) > 0 for row in rows)
