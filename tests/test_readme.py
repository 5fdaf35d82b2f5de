"""What the README, the pages and the wheel promise."""

import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile

import pytest
from palpate.app import cli
from palpate.tissue import config

ROOT = pathlib.Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONFIGURATION = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
PAGES = [
  page
  for pattern in (
    "*.md",
    "docs/*.md",
    "docs/tutorials/*.md",
    "tasks/*.md",
    "models/*/*.md",
    "tests/benchmarks/results/**/*.md",
  )
  for page in sorted(ROOT.glob(pattern))
]


def blocks(language):
  return re.findall(rf"^```{language}\n(.*?)^```", README, re.M | re.S)


def test_the_first_two_commands_set_up_everything():
  run, test = (block.strip() for block in blocks("sh")[:2])
  extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
  for command in (run, test):
    assert command.startswith("python3 -m venv .venv && .venv/bin/pip install -e '.[")
    assert re.search(r"\[(\w+)\]", command)[1] in extras
  assert run.endswith("&& .venv/bin/palpate run press")
  assert test.endswith("&& .venv/bin/python -m pytest")


def test_the_ci_runs_the_test_command_of_the_readme():
  ci = (ROOT / ".ci" / "run").read_text()
  find = re.search(r"test_command=\"\$\((.*)\)\"", ci)[1]
  found = subprocess.run(["bash", "-c", find], cwd=ROOT, capture_output=True, text=True).stdout
  assert found.strip() == blocks("sh")[1].strip()
  assert '\nbash -c "$test_command"\n' in ci
  assert os.access(ROOT / ".ci" / "run", os.X_OK)
  assert "run: .ci/run" in (ROOT / ".github" / "workflows" / "ci.yml").read_text()


def test_the_examples_run_and_the_organ_carries_the_ball(tmp_path):
  (tmp_path / "organ.xml").write_text(blocks("xml")[0])
  shutil.copytree(ROOT / "models" / "press", tmp_path / "models" / "press")
  done = subprocess.run(
    [sys.executable, "-c", blocks("python")[0]],
    cwd=tmp_path,
    capture_output=True,
    text=True,
    timeout=300,
  )
  assert (done.returncode, done.stderr) == (0, "")
  said = [float(x) for x in re.search(r"contact force \[N\] \[(.*)\]", done.stdout)[1].split()]
  assert said[2] == pytest.approx(-0.02 * 9.81, abs=2e-4)  # nearly at rest after 2 s
  assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


# The tutorials have a test of their own, and so has authoring.md, whose example is a scene.
GUIDES = {
  "docs/abdomen.md": "",
  "docs/accuracy.md": "matplotlib",
  "docs/batch.md": "",
  "docs/cutting.md": "",
  "docs/datasets.md": "h5py",
  "docs/environments.md": "",
  "docs/fitting.md": "matplotlib",
  "docs/live.md": "",
  "docs/pixels.md": "gymnasium",
  "docs/record.md": "matplotlib",
  "docs/trouble.md": "",
  "docs/vector.md": "gymnasium",
  "docs/wrapping.md": "",
  "tasks/README.md": "",
}


@pytest.mark.parametrize("page", GUIDES)
def test_a_guide_begins_with_an_example_that_runs(page, here):
  if GUIDES[page]:
    pytest.importorskip(GUIDES[page])
  text = (ROOT / page).read_text(encoding="utf-8")
  found = re.search(r"^```(\w*)\n(.*?)^```", text, re.M | re.S)
  assert text[: found.start()].count("\n") <= 8
  pathlib.Path("organ.xml").write_text(blocks("xml")[0])
  shutil.copytree(ROOT / "models" / "press", "models/press")
  language, code = found.groups()
  lines = [line for line in code.splitlines() if not line.startswith("pip install")]
  if language == "sh" and all(line.startswith("palpate ") for line in lines):
    for line in lines:
      assert cli.main(shlex.split(line, comments=True)[1:]) == 0, line
    return
  command = [sys.executable, "-c", code]
  if language == "sh":
    command = ["bash", "-ec", code]
  path = os.pathsep.join([str(pathlib.Path(sys.executable).parent), os.environ["PATH"]])
  done = subprocess.run(command, env=os.environ | {"PATH": path}, capture_output=True, text=True)
  assert done.returncode == 0, done.stderr


def test_a_newcomer_reads_it_in_three_minutes():
  assert len(README.splitlines()) <= 150
  assert len(re.findall(r"^\|(?:-+\|)+$", README, re.M)) == 1  # one table


def test_the_table_of_configuration_keys_is_the_one_that_the_rows_print():
  assert config.table() in CONFIGURATION  # paste it anew


def test_the_commands_it_names_exist():
  names = {" ".join(words) for words in cli.COMMANDS}
  told = set(re.findall(r"^palpate (\w+(?: press)?)", README, re.M))
  assert told <= names
  assert "run press" in told


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page):
  for target in re.findall(r"\]\((?!https?:)([^)#\s]+)[)#]", page.read_text(encoding="utf-8")):
    assert (page.parent / target).is_file(), target


def test_the_picture_is_small():
  assert (ROOT / "models" / "press" / "press.png").stat().st_size < 300e3


# Prints by what name the cache of compiled kernels knows some of them.
KERNELS = (
  "import warp; from palpate.tissue import step; "
  "print(warp.get_module('palpate.cpu.tissue.elastic').get_module_hash().hex())"
)


def test_the_wheel_holds_everything_and_runs_without_the_sources(tmp_path):
  pytest.importorskip("setuptools", "77")
  tree = tmp_path / "tree"
  skip = shutil.ignore_patterns(".*", "build", "dist", "out", "tests", "*.egg-info", "__pycache__")
  shutil.copytree(ROOT, tree, ignore=skip)
  build = [
    "wheel",
    "--no-deps",
    "--no-build-isolation",
    "--no-index",
    "-w",
    str(tmp_path),
    str(tree),
  ]
  done = subprocess.run(
    [sys.executable, "-m", "pip", *build], capture_output=True, text=True, timeout=300
  )
  assert done.returncode == 0, done.stderr
  (wheel,) = tmp_path.glob("palpate-*.whl")
  with zipfile.ZipFile(wheel) as archive:
    held = set(archive.namelist())
    archive.extractall(tmp_path / "site")

  expected = set()
  for folder, package in (("plugin", ""), ("models", "models/"), ("tasks", "tasks/")):
    for file in (tree / folder).rglob("*"):
      if file.is_file():
        expected.add(f"palpate/{package}{file.relative_to(tree / folder).as_posix()}")
  assert expected - held == set()
  assert {name for name in held if "test" in name.lower()} == set()
  assert "palpate/models/instruments/parts/common.xml" in held

  outside = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
  done = subprocess.run(
    [sys.executable, "-m", "palpate", "run", "press", "--depth", "0.002", "--hold", "0.02"],
    cwd=tmp_path,
    env=outside | {"PYTHONPATH": str(tmp_path / "site")},
    capture_output=True,
    text=True,
    timeout=300,
  )
  assert (done.returncode, done.stderr) == (0, "")
  assert "contact force, static" in done.stdout
  where = subprocess.run(
    [sys.executable, "-c", f"import palpate; print(palpate.__file__); {KERNELS}"],
    cwd=tmp_path,
    env=outside | {"PYTHONPATH": str(tmp_path / "site")},
    capture_output=True,
    text=True,
    timeout=60,
  )
  file, kernels = where.stdout.splitlines()
  assert file.startswith(str(tmp_path))
  here = subprocess.run([sys.executable, "-c", KERNELS], capture_output=True, text=True, timeout=60)
  assert [kernels] == here.stdout.splitlines(), "would be compiled anew for each place"
