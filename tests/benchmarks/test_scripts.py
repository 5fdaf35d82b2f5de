"""The benches of one question: that they run, and what they write adds up."""

import itertools
import json
import sys

import pytest
from benchmarks import results
from benchmarks.accuracy import peer
from palpate.app import cli
from palpate.app.console import CommandError
from palpate.engine import contacts


def command(*words) -> int:
  return cli.main(["bench", *map(str, words)])


@pytest.mark.parametrize(
  "page", sorted(results.FOLDER.rglob("[a-z]*.md")), ids=lambda page: page.stem
)
def test_a_page_begins_with_its_finding_and_its_plot(page):
  """`results.write` writes them so; `--draw` writes a page again from its rows."""
  title, blank, *rest = page.read_text(encoding="utf-8").splitlines()
  finding = list(itertools.takewhile(lambda line: line.startswith("- "), rest))
  assert title.startswith("# ") and not blank and 1 <= len(finding) <= 3
  plots = sorted(page.parent.glob(f"{page.stem}*.png"))
  assert not plots or any(f"]({plot.name})" in line for plot in plots for line in rest[:9])


def test_a_finding_has_at_most_three_lines(tmp_path):
  with pytest.raises(ValueError, match="4 lines, expected at most 3"):
    results.write(tmp_path / "long.md", results.Page("Long", ["line"] * 4, []), {})


def test_solver_is_timed_with_both_preconditioners(tmp_path):
  assert command("solver", "--nodes", 200, "--repeat", 2, "-o", tmp_path) == 0
  found = results.read(tmp_path / "solver_cpu.csv")
  assert json.loads((tmp_path / "solver_cpu.json").read_text())["options"]["repeat"] == "2"
  assert [(r["preconditioner"], r["bend"]) for r in found] == [
    ("jacobi", 0),
    ("multilevel", 0),
    ("jacobi", 1),
    ("multilevel", 1),
  ]
  assert all(float(r["residual"]) <= 1e-4 and int(r["iterations"]) > 0 for r in found)
  assert all(float(r["step_ms"]) > 0 and float(r["assemble_ms"]) > 0 for r in found)


def test_loop_touches_says_where_time_goes_and_sleeps(tmp_path):
  assert command("loop", "--nodes", 642, "--steps", 100, "--condim", 3, 1, "-o", tmp_path) == 0
  for row in results.read(tmp_path / "loop_cpu.csv"):
    assert int(row["contacts"]) > 0 and int(row["missed"]) == 0
    parts = ("mujoco_ms", "coupling_ms", "device_ms")
    assert sum(float(row[name]) for name in parts) == pytest.approx(float(row["step_ms"]))
    assert float(row["assemble_ms"]) > 0 and float(row["solve_ms"]) > 0
    assert float(row["rest_ms"]) > 0  # NaN if the organ does not fall asleep
  lines = (tmp_path / "loop.md").read_text().splitlines()
  table = [line for line in lines if line.startswith("| cpu | 678 |")]
  (head,) = [line for line in lines if line.startswith("| device |")]
  assert len(table) == 2
  assert all(line.count("|") == head.count("|") for line in table)


def test_another_python_takes_the_same_steps():
  keys = {"kind": "solid", "nodes": 42, "side": "peer", "h": 4e-3, "tolerance": 1e-8}
  here = peer.Run(**keys)
  with peer.another(sys.executable) as other:
    assert other
    there = peer.Beside(other, keys)
    for run in (here, there):
      run.restart()
      run.finish()
    assert there.about == here.about and there.time > 0
    assert there.force == pytest.approx(here.force, abs=1e-15)
  with pytest.raises(CommandError, match="expected an interpreter"), peer.another("/none"):
    pass


@pytest.mark.slow
def test_mujoco_warps_flex_is_beside_ours(tmp_path):
  assert command("flex", "--short", "-o", tmp_path) == 0
  rows = results.read(tmp_path / "flex_cpu.csv")
  assert [row["side"] for row in rows] == ["flex", "ours"]
  assert all(row["rate"] > 0 and row["error"] < 0.1 and not row["failures"] for row in rows)


def test_peer_is_beside_ours(tmp_path):
  assert command("peer", "--short", "--nodes", 162, "--repeats", 1, "-o", tmp_path) == 0
  rows = results.read(tmp_path / "peer.csv")
  for kind in ("skin", "bending", "solid"):
    mine = [r for r in rows if r["kind"] == kind and r["h"] == 1e-3]
    ours, flex, right = (
      next(r for r in mine if (r["side"], r["weights"]) == key)
      for key in (("window", "as is"), ("peer", "as is"), ("peer", "right"))
    )
    assert ours["second_s"] > 0 and 0 < ours["error"] < 0.05
    if kind != "solid":  # whose linear tetrahedra lock in the flex; others have the same constants
      assert ours["force_N"] == pytest.approx(right["force_N"], rel=0.15)
    if contacts.are_wrong():
      assert flex["error"] > 1.5 * right["error"] > 0
  page = (tmp_path / "peer.md").read_text()
  assert "times ours" in page and "A step of 1 ms" in page
