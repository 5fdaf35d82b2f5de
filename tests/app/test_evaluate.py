"""`palpate evaluate`: scores, spread, and what is kept when something breaks."""

import json
import pathlib
import re
import signal
import sys

import pytest
from palpate import tasks
from palpate.app import cli, console, panel, workers
from palpate.app.learn import evaluate
from palpate.tasks.learn import policy
from palpate.tasks.people import score
from palpate.tasks.recording import Recording

QUICK = {"surroundings": "none", "nodes": 250}  # to load in another process

pytestmark = pytest.mark.usefixtures("here")


def test_evaluate_prints_success_and_spread(capsys, tmp_path):
  assert cli.main(["evaluate", "touch/easy", "--episodes", "2"]) == 0
  text = capsys.readouterr().out
  assert "success  2/2" in text and "Path length [mm]" in text
  assert re.search("proficient  [012]/2; 2 in a row and 10 more: not reached", text)
  kept = tmp_path / "kept"
  words = ["evaluate", "touch/easy", "--policy", "math:nan", "--episodes", "1"]
  assert cli.main([*words, "--recordings", str(kept)]) == 2
  assert "math:nan' is a float, expected something to call" in capsys.readouterr().err
  words = ["evaluate", "touch/easy", "--policy", "math:sqrt", "--episodes", "1"]
  assert cli.main([*words, "--recordings", str(kept)]) == 1
  said = capsys.readouterr()
  assert "1 episodes failed, the first: TypeError" in said.err
  assert "proficient  0/1" in said.out
  assert re.search(r"Composite score \[-\] +-20 ", said.out)  # the floor
  assert Recording.load(kept / "0.npz").info["outcome"] == "error"
  assert cli.main(["evaluate", "touch/eazy"]) == 2
  assert "task is 'touch/eazy', expected one of" in capsys.readouterr().err
  assert cli.main(["evaluate", "touch/easy", "--policy", "nobody"]) == 2


def test_standing_still_scores_the_floor(tmp_path, capsys):
  text = "import numpy as np\ndef still(observation): return np.zeros(4)\n"
  (tmp_path / "still.py").write_text(text)
  assert cli.main(["evaluate", "touch/easy", "--policy", "still:still", "--episodes", "1"]) == 0
  said = capsys.readouterr().out
  assert "proficient  0/1" in said and re.search(r"Composite score \[-\] +-20 ", said)


def test_references_are_made_and_resumed(tmp_path, capsys, monkeypatch):
  words = ["panel", "touch/easy", "-o", "made", "--runs", "runs", "--processes", "1"]
  assert cli.main([*words, "--episodes", "2"]) == 0
  assert "touch/easy: 2 of 2 episodes succeeded" in capsys.readouterr().out
  path = tmp_path / "made" / "touch_easy.json"
  data = score.read_reference(path)
  assert (data["task"], data["performer"]) == ("touch/easy", "skilled")
  assert (data["n"], data["episodes"], data["seed"]) == (2, 2, 10000)
  assert data["metrics"]["time"]["limit"] >= data["metrics"]["time"]["mean"]
  (runs,) = (tmp_path / "runs").iterdir()
  assert len(list(runs.iterdir())) == 2
  ran = []
  monkeypatch.setattr(panel, "perform", lambda job: ran.append(job) or evaluate.perform(job))
  assert cli.main([*words, "--episodes", "3"]) == 0
  assert [job[2] for job in ran] == [10002]
  assert score.read_reference(path)["n"] == 3
  monkeypatch.setattr(panel, "fingerprint", lambda: "changed")
  assert cli.main([*words, "--episodes", "1"]) == 0
  assert len(ran) == 2  # other sources, other episodes


def test_references_need_successes(tmp_path, capsys):
  words = ["panel", "touch/easy", "-o", "made", "--episodes", "1", "--processes", "1"]
  assert cli.main([*words, "--performer", "math:sqrt"]) == 1
  assert "0 of 1 episodes succeeded, too few for a reference; TypeError" in capsys.readouterr().err
  assert cli.main([*words, "--performer", "nobody"]) == 2


def test_processes_give_the_same_as_one():
  job = ("touch/easy", "expert", range(2))
  one = list(evaluate.evaluate(*job, task_kwargs=QUICK))
  two = list(evaluate.evaluate(*job, workers.Processes(2), task_kwargs=QUICK))
  assert one == two


def test_a_policy_that_cannot_be_made_is_one_line(tmp_path, capsys):
  text = "class P:\n  def __init__(self, env, seed): raise OSError('no weights')\n"
  (tmp_path / "lost.py").write_text(text)
  words = ["evaluate", "touch/easy", "--policy", "lost:P", "--episodes", "1", "--json", "a.json"]
  assert cli.main(words) == 1
  said = capsys.readouterr()
  assert said.err == "palpate: 1 episodes failed, the first: policy 'lost:P': OSError: no weights\n"
  assert json.loads((tmp_path / "a.json").read_text())[0]["outcome"] == "error"


def test_a_policy_of_another_task_is_refused_before_the_work(tmp_path, monkeypatch, capsys):
  pytest.importorskip("safetensors")
  monkeypatch.setattr(evaluate, "evaluate", lambda *_: pytest.fail("it worked first"))
  shipped = pathlib.Path(tasks.__file__).parent / "policies" / "probe_easy.safetensors"
  words = ["evaluate", "touch/easy", "--set", "surroundings=none", "--episodes", "9"]
  assert cli.main([*words, "--policy", str(shipped)]) == 2
  said = capsys.readouterr().err
  assert said == "palpate: the policy is of probe/easy, not of touch/easy\n"
  monkeypatch.setattr(policy, "FOLDER", tmp_path)
  assert cli.main(["evaluate", "tease/hard", "--policy", "trained"]) == 2
  assert "no trained policy comes with tease/hard, expected one of none" in capsys.readouterr().err


def test_a_process_that_dies_ends_the_job_and_keeps_what_was_done(tmp_path, monkeypatch, capsys):
  text = "import os\ndef die(observation): os._exit(3)\n"
  (tmp_path / "deadly.py").write_text(text)
  monkeypatch.setenv("PYTHONPATH", str(tmp_path))
  words = ["evaluate", "touch/easy", "--policy", "deadly:die", "--episodes", "2"]
  words += [word for item in QUICK.items() for word in ("--set", "{}={}".format(*item))]
  assert cli.main([*words, "--processes", "2", "--json", "a.json"]) == 1
  said = capsys.readouterr()
  assert "2 episodes failed, the first: a process died" in said.err
  assert "success  0/2" in said.out and "error 2" in said.out
  assert len(json.loads((tmp_path / "a.json").read_text())) == 2


def test_outputs_that_cannot_be_written_are_said_before_the_work(tmp_path, monkeypatch, capsys):
  monkeypatch.setattr(evaluate, "evaluate", lambda *_: pytest.fail("it worked first"))
  (tmp_path / "file").touch()
  for words in (["--json", "file/a.json"], ["--json", "."], ["--recordings", "file"]):
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
    ("rewards=dense", "set has 'rewards', expected one of damage, force_limit"),
    ("time_limit=-1", "touch/easy: time_limit is -1, expected a number > 0 [s]"),
    ("pixels=84", "pixels is 84, expected height and width"),
  ],
)
def test_wrong_options_are_one_line(words, said, capsys):
  for command in ("evaluate", "exercise"):
    assert cli.main([command, "touch/easy", "--set", words]) == 2
    message = capsys.readouterr().err
    assert message.startswith("palpate: ") and said in message and message.count("\n") == 1
