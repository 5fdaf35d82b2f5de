"""`palpate evaluate`: scores, spread, and what is kept when something breaks."""

import json
import signal
import sys

import pytest
from palpate.app import cli, console, evaluate
from palpate.tasks.recording import Recording


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  monkeypatch.setattr(sys, "path", sys.path.copy())


def test_evaluate_prints_success_and_spread(capsys, tmp_path):
  out = tmp_path / "reference.json"
  assert cli.main(["evaluate", "touch/easy", "--episodes", "2", "--reference", str(out)]) == 0
  text = capsys.readouterr().out
  assert "success  2/2" in text and "Path length [mm]" in text
  data = json.loads(out.read_text())
  assert data["task"] == "touch/easy" and data["n"] == 2 and data["seed"] == 0
  kept = tmp_path / "kept"
  words = ["evaluate", "touch/easy", "--policy", "math:nan", "--episodes", "1"]
  assert cli.main([*words, "--recordings", str(kept)]) == 2
  assert "math:nan' is a float, expected something to call" in capsys.readouterr().err
  words = ["evaluate", "touch/easy", "--policy", "math:sqrt", "--episodes", "1"]
  assert cli.main([*words, "--recordings", str(kept)]) == 1
  assert "1 episodes failed, the first: TypeError" in capsys.readouterr().err
  assert Recording.load(kept / "0.npz").info["outcome"] == "error"
  assert cli.main(["evaluate", "touch/eazy"]) == 2
  assert "task is 'touch/eazy', expected one of" in capsys.readouterr().err
  assert cli.main(["evaluate", "touch/easy", "--policy", "nobody"]) == 2


def test_processes_give_the_same_as_one():
  one = list(evaluate.evaluate("touch/easy", "expert", range(2)))
  two = list(evaluate.evaluate("touch/easy", "expert", range(2), processes=2))
  assert one == two


def test_a_policy_that_cannot_be_made_is_one_line(tmp_path, capsys):
  text = "class P:\n  def __init__(self, env, seed): raise OSError('no weights')\n"
  (tmp_path / "lost.py").write_text(text)
  words = ["evaluate", "touch/easy", "--policy", "lost:P", "--episodes", "1", "--json", "a.json"]
  assert cli.main(words) == 1
  said = capsys.readouterr()
  assert said.err == "palpate: 1 episodes failed, the first: policy 'lost:P': OSError: no weights\n"
  assert json.loads((tmp_path / "a.json").read_text())[0]["outcome"] == "error"


def test_a_process_that_dies_ends_the_job_and_keeps_what_was_done(tmp_path, monkeypatch, capsys):
  text = "import os\ndef die(observation): os._exit(3)\n"
  (tmp_path / "deadly.py").write_text(text)
  monkeypatch.setenv("PYTHONPATH", str(tmp_path))
  words = ["evaluate", "touch/easy", "--policy", "deadly:die", "--episodes", "3"]
  assert cli.main([*words, "--processes", "2", "--json", "a.json"]) == 1
  said = capsys.readouterr()
  assert "3 episodes failed, the first: a process died" in said.err
  assert "success  0/3" in said.out and "error 3" in said.out
  assert len(json.loads((tmp_path / "a.json").read_text())) == 3


def test_outputs_that_cannot_be_written_are_said_before_the_work(tmp_path, monkeypatch, capsys):
  monkeypatch.setattr(evaluate, "evaluate", lambda *_: pytest.fail("it worked first"))
  (tmp_path / "file").touch()
  for words in (["--json", "file/a.json"], ["--reference", "."], ["--recordings", "file"]):
    assert cli.main(["evaluate", "touch/easy", *words]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"palpate: {words[0][2:]}: cannot write '") and said.count("\n") == 1


def test_ctrl_c_keeps_the_episodes_that_were_done(tmp_path, monkeypatch, capsys):
  show = console.Progress.show

  def interrupt(self, text, always=False):
    if text == "1 of 9":
      signal.raise_signal(signal.SIGINT)
    show(self, text, always)

  monkeypatch.setattr(console.Progress, "show", interrupt)
  assert cli.main(["evaluate", "touch/easy", "--episodes", "9", "--json", "a.json"]) == 130
  said = capsys.readouterr()
  assert "interrupted after 1 of 9 episodes" in said.err and "success  1/1" in said.out
  assert len(json.loads((tmp_path / "a.json").read_text())) == 1


def test_options_of_the_task_are_passed_on(tmp_path, capsys):
  text = "import numpy as np\nseen = []\ndef act(o):\n  seen.append(o['pixels'].shape)\n"
  (tmp_path / "look.py").write_text(text + "  return np.array([0.0, 0.0, 0.0, -1.0])\n")
  words = ["evaluate", "touch/easy", "--policy", "look:act", "--episodes", "1", "--seed", "5"]
  words += ["--set", "time_limit=0.1", "--set", "pixels=[16, 24]", "--set", "reward=sparse"]
  words += ["--set", 'randomise={"light": [0.5, 1.5]}', "--json", "a.json"]
  assert cli.main([*words, "--recordings", str(tmp_path / "kept")]) == 0
  (result,) = json.loads((tmp_path / "a.json").read_text())
  assert result["outcome"] == "time limit" and result["time"] == pytest.approx(0.1)
  assert result["total"] == 0 and sys.modules["look"].seen == [(16, 24, 3)] * 5
  info = Recording.load(tmp_path / "kept" / "5.npz").info
  assert info["task_kwargs"]["pixels"] == [16, 24] and 0.5 <= info["randomised"]["light"] <= 1.5
  assert cli.main(["exercise", "--replay", str(tmp_path / "kept" / "5.npz"), "--no-report"]) == 0
  assert "the replay is the same to the bit" in capsys.readouterr().out


@pytest.mark.parametrize(
  "words, said",
  [
    ("reward", "set is 'reward', expected NAME=VALUE"),
    ("reward=dens", "reward is 'dens', expected one of dense, sparse"),
    ("random=1", "set has 'random', expected --seed"),
    ("rewards=dense", "unexpected keyword argument 'rewards'"),
    ("time_limit=-1", "touch/easy: time_limit is -1, expected a number > 0 [s]"),
    ("pixels=84", "pixels is 84, expected height and width"),
  ],
)
def test_wrong_options_are_one_line(words, said, capsys):
  for command in ("evaluate", "exercise"):
    assert cli.main([command, "touch/easy", "--set", words]) == 2
    message = capsys.readouterr().err
    assert message.startswith("palpate: ") and said in message and message.count("\n") == 1
