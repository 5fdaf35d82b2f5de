"""Workers: processes and a Ray cluster do the same, also when one of them dies on the way."""

import os
import pathlib
import pickle
import signal
import sys
import time
import types

import pytest
from palpate.app import cli, workers
from palpate.app.workers import Processes

PROCESSES = Processes(2)


def square(number: int) -> int:
  if number < 0:
    raise ValueError(f"{number} is no number")
  return number * number


def nap(seconds: float) -> float:
  time.sleep(seconds)
  return seconds


def die_once(path: str) -> str:
  """Ends its worker the first time, without a word."""
  mark = pathlib.Path(path)
  if not mark.exists():
    mark.touch()
    os.kill(os.getpid(), signal.SIGKILL)
  return mark.name


def test_a_process_that_dies_takes_one_job_with_it(tmp_path):
  marks = [str(tmp_path / name) for name in "abc"]
  (tmp_path / "a").touch(), (tmp_path / "c").touch()
  assert list(workers.parallel(die_once, marks, PROCESSES)) == ["a", None, "c"]


def test_errors_limits_and_deadlines():
  with pytest.raises(ValueError, match="-3 is no number"):
    list(workers.parallel(square, [1, 2, -3], PROCESSES))
  ended = {e.index: e.status for e in PROCESSES.run(nap, [0.0, 60.0], limit=2.0)}
  assert ended == {0: "ok", 1: "timeout"}
  late = time.monotonic() + 1.0
  assert list(PROCESSES.run(nap, [60.0, 60.0, 60.0], deadline=late)) == []
  done = []
  for ended in PROCESSES.run(square, list(range(9)), lambda: bool(done)):
    done.append(ended.value)
  assert 0 < len(done) < 4  # what had begun is finished


def test_options(capsys):
  assert cli.main(["evaluate", "touch/easy", "--processes", "0"]) == 2
  assert "processes is 0, expected a whole number >= 1" in capsys.readouterr().err


DIES = """
import os, pathlib, signal
from palpate.tasks.core import performer

class Policy(performer.Performer):
  def __init__(self, env, seed):
    super().__init__(env, seed=seed)
    mark = pathlib.Path(__file__).with_name("mark")
    if seed == 1 and not mark.exists():
      mark.touch()
      os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_ray_cluster_loses_nothing_with_a_worker(tmp_path, monkeypatch, capsys):
  pytest.importorskip("ray")
  monkeypatch.chdir(tmp_path)
  monkeypatch.setattr(sys, "path", sys.path.copy())
  (tmp_path / "dies.py").write_text(DIES)
  short = ["--episodes", "2", "--set", "time_limit=0.2", "--set", "surroundings=none"]
  words = ["evaluate", "touch/easy", "--policy", "dies:Policy", "--json", "ray.json", *short]
  assert cli.main([*words, "--ray", "--processes", "2", "--recordings", "kept"]) == 0
  assert (tmp_path / "mark").exists()  # it did die
  assert {path.name for path in (tmp_path / "kept").iterdir()} == {"0.npz", "1.npz"}
  assert cli.main(["evaluate", "touch/easy", "--json", "one.json", *short]) == 0
  assert (tmp_path / "ray.json").read_bytes() == (tmp_path / "one.json").read_bytes()


def test_a_worker_names_the_folder_that_it_takes_for_the_package(tmp_path, monkeypatch):
  """As Ray's do beside a clone named palpate: Python finds a package without modules there."""
  empty = types.ModuleType("palpate")
  empty.__path__ = [str(tmp_path / "palpate")]
  job = pickle.dumps((square, 2))
  assert workers.unpacked([], job) == ("ok", 4)
  monkeypatch.setitem(sys.modules, "palpate", empty)
  status, error = workers.unpacked([], job)
  assert status == "error" and f"workers take the folder {empty.__path__[0]!r}" in str(error)


def test_a_cluster_that_is_not_there_is_one_line(monkeypatch, capsys):
  ray = pytest.importorskip("ray")

  def nobody(address, **_):
    raise ConnectionError("nobody answers")

  monkeypatch.setattr(ray, "init", nobody)
  assert cli.main(["evaluate", "touch/easy", "--ray", "host:6379"]) == 1
  assert capsys.readouterr().err == "palpate: ray: no cluster at 'host:6379': nobody answers\n"
