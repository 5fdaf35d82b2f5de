"""The runner: cases that fail, runs that go on, options, and that every bench starts."""

import dataclasses
import subprocess
import sys

import pytest
from benchmarks import results, run, runner
from benchmarks.accuracy import error
from palpate.app import cli
from palpate.app.console import CommandError


def command(*words) -> int:
  return cli.main(["bench", *map(str, words)])


def execute(bench, *words) -> bool:
  return runner.execute(bench, runner.options(bench, [*map(str, words)]))


def rows_of(path) -> list[dict]:
  return results.read(path)


def test_a_case_that_fails_is_noted_and_the_rest_goes_on(tmp_path):
  what = {"nodes": 162, "elements": "membrane"}
  bad = {"case": "bad", "kind": "run", "scene": "press", "h": 1e-3, "short": 1} | what
  good = {"case": "good", "kind": "reference", "scene": "vibrate", "level": 4} | what
  bench = dataclasses.replace(error.BENCH, stages=lambda args: [[bad, good]])  # no reference of bad
  assert execute(bench, "--out", tmp_path, "--jobs", 2)
  status = {r["case"]: r["status"] for r in rows_of(tmp_path / "error.csv")}
  assert status["bad"].startswith("error: ValueError: no reference")
  assert status["good"] == "ok"


def small(case, out):
  if case["number"] == 2 and not (out / "go").exists():
    raise RuntimeError("not yet")
  return [{"number": case["number"], "square": case["number"] ** 2}]


SMALL = runner.Bench(
  "small", lambda args: [[{"case": f"n{k}", "number": k} for k in range(4)]], small
)


def test_in_one_process_a_case_that_fails_ends_the_run_and_it_resumes_there(tmp_path):
  with pytest.raises(RuntimeError, match="not yet"):
    execute(SMALL, "--out", tmp_path)
  assert [r["square"] for r in rows_of(tmp_path / "small.csv")] == [0, 1]
  (tmp_path / "go").touch()
  assert execute(SMALL, "--out", tmp_path, "--resume")
  rows = rows_of(tmp_path / "small.csv")
  assert [(r["case"], r["status"], r["square"]) for r in rows] == [
    ("n0", "ok", 0),
    ("n1", "ok", 1),
    ("n2", "ok", 4),
    ("n3", "ok", 9),
  ]
  about = results.notes(tmp_path / "small.csv")
  assert about["done"] == about["cases"] == 4 and "cpu" in about
  assert execute(SMALL, "--out", tmp_path, "--resume", "--only", "n1")
  rows = rows_of(tmp_path / "small.csv")
  assert [r["case"] for r in rows] == ["n0", "n2", "n3", "n1"] and rows[-1]["square"] == 1
  assert results.notes(tmp_path / "small.csv")["options"] == {"only": "n1"}
  with pytest.raises(CommandError, match="the nearest are"):
    execute(SMALL, "--out", tmp_path, "--resume", "--only", "n9")


def test_results_of_another_form_are_not_resumed(tmp_path):
  (tmp_path / "small.csv").write_text("number,square\n1,1\n")
  assert rows_of(tmp_path / "small.csv") == [{"status": "ok", "number": 1, "square": 1}]
  with pytest.raises(CommandError, match="another form"):
    execute(SMALL, "--out", tmp_path, "--resume")
  assert (tmp_path / "small.csv").read_text() == "number,square\n1,1\n"


def test_a_page_written_again_keeps_the_remarks(tmp_path):
  path, about = tmp_path / "small.md", {"palpate": "1", "bench": "small", "short": True}
  results.write(
    path, results.Page("Small", ["It is 2 mm."], ["table"], [tmp_path / "small.png"]), about
  )
  assert path.read_text() == (
    "# Small\n\n- It is 2 mm.\n\n![Small](small.png)\n\npalpate 1.\n\n"
    "    palpate bench small --short\n\ntable\n"
  )
  path.write_text(path.read_text() + "\n## Remarks\n\n- by hand\n")
  results.write(path, results.Page("Small", ["It is 3 mm."], ["another table"]), about)
  assert path.read_text().endswith("another table\n\n## Remarks\n\n- by hand\n")


def test_starting_over_keeps_the_old_rows_aside(tmp_path):
  bench = dataclasses.replace(error.BENCH, stages=lambda args: [])
  (tmp_path / "error.csv").write_text("case,status\nold,ok\n")
  execute(bench, "--out", tmp_path)
  assert (tmp_path / "error.csv.old").read_text() == "case,status\nold,ok\n"
  assert rows_of(tmp_path / "error.csv") == []


@pytest.mark.parametrize("name", run.BENCHES)
def test_every_bench_is_a_command_with_help(name, capsys):
  with pytest.raises(SystemExit) as end:
    command(name, "--help")
  assert end.value.code == 0
  text = capsys.readouterr().out
  for option in ("--short", "--resume", "--jobs", "--minutes", "--only", "--out"):
    assert option in text


def test_the_list_of_benches(capsys):
  assert command() == 0
  assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(run.BENCHES)
  assert command("nothing") == 2
  assert "no bench 'nothing', expected one of batch, " in capsys.readouterr().err


def test_benches_need_no_pytest(tmp_path, monkeypatch):
  code = "import sys; sys.modules['pytest'] = None; from palpate.app import cli; cli.main()"
  words = ["bench", "solver", "--nodes", "200", "--repeat", "1", "-o", str(tmp_path)]
  monkeypatch.chdir(tmp_path)  # an editable install knows its checkout
  done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
  assert (tmp_path / "solver_cpu.csv").exists(), done.stderr


def test_without_a_checkout_it_says_so(tmp_path, monkeypatch, capsys):
  monkeypatch.setattr("palpate.__file__", str(tmp_path / "site-packages/palpate/__init__.py"))
  monkeypatch.chdir(tmp_path)
  assert command("solver") == 1
  assert "run the command in a checkout of Palpate's sources" in capsys.readouterr().err


def test_wrong_options_are_refused_in_one_line(tmp_path, capsys):
  assert command("error", "--jobs", -1, "--out", tmp_path) == 2
  assert "jobs is -1" in capsys.readouterr().err
  assert command("error", "--draw", "--out", tmp_path) == 1
  assert "expected the rows of an earlier run" in capsys.readouterr().err
