"""The scripts that time the solver and the loop: that they run, and what they write adds up."""

import csv
import importlib.util
import pathlib
import sys

import pytest

HERE = pathlib.Path(__file__).parent


@pytest.fixture
def run(monkeypatch, tmp_path):
  def call(name, *words):
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", HERE / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "argv", [name, *map(str, words), "-o", str(tmp_path)])
    module.main()
    return tmp_path

  return call


def rows(path):
  with path.open(newline="") as file:
    return list(csv.DictReader(file))


def test_solver_is_timed_with_both_preconditioners(run):
  out = run("solver", "--nodes", 200, "--repeat", 2)
  found = rows(out / "solver_cpu.csv")
  assert [(r["preconditioner"], r["bend"]) for r in found] == [
    ("jacobi", "0.0"),
    ("multilevel", "0.0"),
    ("jacobi", "1.0"),
    ("multilevel", "1.0"),
  ]
  assert all(float(r["residual"]) <= 1e-4 and int(r["iterations"]) > 0 for r in found)
  assert all(float(r["step_ms"]) > float(r["assemble_ms"]) > 0 for r in found)


def test_loop_touches_says_where_time_goes_and_sleeps(run):
  out = run("loop", "--nodes", 642, "--steps", 100, "--condim", 3, 1)
  for row in rows(out / "loop_cpu.csv"):
    assert int(row["contacts"]) > 0 and int(row["missed"]) == 0
    parts = ("mujoco_ms", "coupling_ms", "device_ms")
    assert sum(float(row[name]) for name in parts) == pytest.approx(float(row["step_ms"]))
    assert float(row["assemble_ms"]) > 0 and float(row["solve_ms"]) > 0
    assert float(row["rest_ms"]) > 0  # NaN if the organ does not fall asleep
  run("loop", "--table", out)
  lines = (out / "loop.md").read_text().splitlines()
  table = [line for line in lines if line.startswith("| cpu | 678 |")]
  assert len(table) == 2
  assert all(line.count("|") == lines[6].count("|") for line in table)
