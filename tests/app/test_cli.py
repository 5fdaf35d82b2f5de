"""The palpate command: exit codes, one-line errors, doctor, warmup, silence."""

import os
import re
import shutil
import subprocess
import sys

import pytest
import warp as wp
from palpate.app import cli, doctor
from palpate.app.press import command

PROBE = '<body><joint name="j" type="slide" axis="0 0 -1"/><geom size=".01" mass="1"/></body>'


def palpate(*words, **environment):
  """Runs the command in a process of its own."""
  return subprocess.run(
    [sys.executable, "-m", "palpate", *words],
    capture_output=True,
    text=True,
    env=os.environ | environment,
    timeout=300,
  )


def test_help_lists_commands_and_needs_neither_mujoco_nor_warp():
  done = subprocess.run(
    [sys.executable, "-X", "importtime", "-m", "palpate", "--help"],
    capture_output=True,
    text=True,
    timeout=60,
  )
  assert done.returncode == 0
  for words in cli.COMMANDS:
    assert re.search(rf"^ +{words[0]} ", done.stdout, re.M), f"{words[0]} is not in the help"
  assert not re.search(r"\| +(mujoco|warp)\b", done.stderr)


def test_its_module_runs_as_the_command_does():
  words = [sys.executable, "-m", "palpate.app.cli", "evaluate", "touch/none"]
  done = subprocess.run(words, capture_output=True, text=True, timeout=300)
  assert done.returncode == 2 and "touch/none" in done.stderr


def test_every_command_has_help(capsys):
  for words in cli.COMMANDS:
    with pytest.raises(SystemExit) as end:
      cli.main([*words, "--help"])
    assert end.value.code == 0
    assert f"usage: palpate {' '.join(words)}" in capsys.readouterr().out


@pytest.mark.parametrize(
  ("words", "usage"),
  [
    (["fit", "data.csv", "--radius", "0.005", "-x"], "usage: palpate fit "),
    (["run", "press", "-x"], "usage: palpate run press "),
    (["--colour", "doctor"], "usage: palpate "),
  ],
)
def test_an_unknown_option_shows_the_usage_of_its_command(capsys, words, usage):
  with pytest.raises(SystemExit) as end:
    cli.main(words)
  said = capsys.readouterr().err
  assert end.value.code == 2
  assert said.startswith(usage), said
  assert "unrecognized arguments: -" in said


@pytest.mark.parametrize("words", [["--help"], ["run", "press", "--help"], ["exercise", "--list"]])
def test_a_reader_that_has_enough_is_no_error(words):
  reader, writer = os.pipe()
  os.close(reader)
  with os.fdopen(writer, "w") as closed:
    done = subprocess.run(
      [sys.executable, "-m", "palpate", *words], env=os.environ | {"PYTHONUNBUFFERED": ""},
      stdout=closed, stderr=subprocess.PIPE, text=True, timeout=60,
    )  # fmt: skip
  assert (done.returncode, done.stderr) == (141, "")


def test_without_a_command_it_says_what_is_missing():
  done = palpate()
  assert done.returncode == 2
  assert "COMMAND" in done.stderr


def test_loading_and_running_a_scene_says_nothing_and_leaves_no_log(tmp_path):
  code = (
    "import mujoco, palpate;"
    f"model = mujoco.MjModel.from_xml_path({str(command.folder() / 'scene.xml')!r});"
    "data = mujoco.MjData(model); mujoco.mj_step(model, data, nstep=50)"
  )
  done = subprocess.run(
    [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=300
  )
  assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
  assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
  ("options", "said"),
  [
    ("--scene nowhere.xml", "no scene 'nowhere.xml', expected an MJCF file"),
    ("--depth 10", "depth is 10 m, expected a number in (0, 1]"),
    ("--depth nan", "depth is nan m, expected a number in (0, 1]"),
    ("--depth 0.09 --speed 1", "depth is 0.09 m, expected at most 0.05"),
    ("--speed 0", "speed is 0 m/s, expected a number in (0, 10]"),
    ("--h -1", "h is -1 s, expected a number in (0, 0.02]"),
    ("--hold 1e9", "hold is 1e+09 s, expected a number in [0, 60]"),
    ("--nodes 5", "nodes is 5, expected a number in [100, 100000]"),
    ("--seed -1", "seed is -1, expected a number in [0, 2^32)"),
    ("--device abacus", "device is 'abacus', expected 'cpu', 'cuda:0' or 'auto'"),
    ("--device cuda:63", "device is 'cuda:63'"),
    ("--set yung=3", "expected KEY=VALUE with one of elements, tetrahedra, young"),
    ("--set young=soft", "organ 'organ': young is 'soft', expected a number > 0"),
    ("--organ spleen", "no organ 'spleen' in the model, it has 'organ'"),
    ("--actuator motor", "no actuator 'motor' in the scene, it has 'probe'"),
    ("--video press.avi", "video is 'press.avi', expected a name that ends in .mp4 or .gif"),
    ("--picture a.bmp", "picture is 'a.bmp', expected a name that ends in .png"),
    ("--scene SCENE --nodes 500", "nodes and seed make the shipped organ anew"),
  ],
)
def test_a_wrong_option_is_one_line_and_exit_code_2(options, said, capsys, tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  words = options.replace("SCENE", str(command.folder() / "scene.xml")).split()
  assert cli.main(["run", "press", "--out", str(tmp_path), *words]) == 2
  error = capsys.readouterr().err
  assert said in error
  assert error.count("\n") == 1
  assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


@pytest.mark.parametrize(
  ("scene", "said"),
  [
    ("<mujoco>", "XML"),
    ("<mujoco><nonsense/></mujoco>", "nonsense"),
    ("<mujoco/>", "no organ in scene.xml, expected a flexcomp with plugin 'palpate.organ'"),
  ],
)
def test_a_wrong_scene_is_one_line_and_exit_code_2(scene, said, capsys, tmp_path):
  (tmp_path / "scene.xml").write_text(scene)
  words = ["run", "press", "--scene", str(tmp_path / "scene.xml"), "--out", str(tmp_path / "out")]
  assert cli.main(words) == 2
  error = capsys.readouterr().err
  assert said in error
  assert error.count("\n") == 1


@pytest.mark.parametrize(
  ("actuator", "said"),
  [
    ('<velocity name="probe" joint="j" kv="1" ctrlrange="0 1"/>', "no position actuator"),
    ('<position name="probe" joint="j"/>', "no ctrlrange"),
    ('<position name="probe" joint="hinge" ctrlrange="0 1"/>', "not drive a slide joint"),
    ("", "it has none"),
  ],
)
def test_a_probe_that_cannot_press_is_one_line_and_exit_code_2(actuator, said, capsys, tmp_path):
  shutil.copy(command.folder() / "assets" / "organ.obj", tmp_path)
  hinge = '<body><joint name="hinge"/><geom size=".01"/></body>'
  (tmp_path / "scene.xml").write_text(
    '<mujoco><extension><plugin plugin="palpate.organ"/></extension><worldbody>'
    '<flexcomp name="organ" type="mesh" file="organ.obj" dim="2" mass=".1">'
    '<plugin plugin="palpate.organ"/><edge damping="1e-9"/></flexcomp>'
    f"{PROBE}{hinge}</worldbody><actuator>{actuator}</actuator></mujoco>"
  )
  words = ["run", "press", "--scene", str(tmp_path / "scene.xml"), "--out", str(tmp_path / "out")]
  assert cli.main(words) == 2
  assert said in capsys.readouterr().err


def test_doctor_reports_everything():
  done = palpate("doctor")
  for word in ("palpate", "python", "mujoco", "warp-lang", "dm-control", "numpy", "cpu", "slot"):
    assert word in done.stdout
  lines = done.stdout.splitlines()
  assert {line.split()[1] for line in lines[:-1]} >= {"devices", "cache", "plugin", "self-test"}
  wrong = [line for line in lines if line.startswith("WRONG")]
  assert done.returncode == (1 if wrong else 0)
  assert not [line for line in wrong if line.split()[1] != "drawing"], done.stdout


@pytest.mark.skipif(
  bool(os.environ.get("DISPLAY")) or not sys.platform.startswith("linux"),
  reason="needs a machine without a screen",
)
def test_doctor_says_what_is_wrong(monkeypatch, capsys):
  monkeypatch.setattr(doctor, "CHECKS", {"drawing": doctor.CHECKS["drawing"]})
  monkeypatch.setenv("MUJOCO_GL", "glfw")
  assert cli.main(["doctor"]) == 1
  said = capsys.readouterr().out
  assert re.match(r"WRONG +drawing +MUJOCO_GL is glfw", said) and said.endswith("\n1 thing wrong\n")


def test_doctor_reads_a_cache_that_others_write(monkeypatch, capsys, tmp_path):
  (tmp_path / "part").mkdir()
  (tmp_path / "part" / "kernel.o").touch()
  scandir = os.scandir

  def vanishing(folder):
    if os.path.basename(folder) == "part":
      raise FileNotFoundError(folder)
    return scandir(folder)

  monkeypatch.setattr(os, "scandir", vanishing)
  monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
  monkeypatch.setattr(doctor, "CHECKS", {"cache": doctor.CHECKS["cache"]})
  assert cli.main(["doctor"]) == 0, capsys.readouterr().out


def test_warmup_prints_seconds_for_every_module(capsys):
  assert cli.main(["warmup", "--device", "cpu"]) == 0
  rows = dict(re.findall(r"cpu +palpate\.cpu\.[\w.]*?(\w+) +([\d.]+) s", capsys.readouterr().out))
  assert {"elastic", "schemes", "pcg", "multigrid", "nodal", "proxies", "world_rods"} <= set(rows)


def test_warmup_names_the_devices_there_are(capsys):
  assert cli.main(["warmup", "--device", "abacus"]) == 2
  assert "no device 'abacus', expected one of cpu" in capsys.readouterr().err
