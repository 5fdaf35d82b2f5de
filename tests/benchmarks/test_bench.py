"""Short forms of the benches: what a user would notice if it were wrong."""

import dataclasses
import json
import math
import pathlib
import subprocess

import mujoco
import numpy as np
import palpate
import pytest
from benchmarks import results, runner, scene
from benchmarks.accuracy import compare, error, films, judge, stability
from benchmarks.timing import thesis
from palpate.app import cli
from palpate.engine import contacts
from palpate.tissue import energy
from palpate.tissue.config import Config
from reference import exact
from reference.inside import Inside

ELEMENTS = {"membrane": {}, "spring": {"elements": "spring", "stiffness": 50.0}}


def rows_of(name: str, out: pathlib.Path) -> list[dict]:
  return results.read(out / f"{name}.csv")


def command(*words) -> int:
  return cli.main(["bench", *map(str, words)])


def options(bench, *words):
  return runner.options(bench, [*map(str, words)])


def of_cases(bench, cases):
  """Returns the bench with these cases alone."""
  return dataclasses.replace(bench, stages=lambda args: [cases])


def stability_cases(*words) -> list[dict]:
  return stability.stages(options(stability.BENCH, *words))[0]


@pytest.fixture(scope="module")
def error_rows(tmp_path_factory):
  out = tmp_path_factory.mktemp("error")
  assert command("error", "--short", "--jobs", 1, "--out", out) == 0
  return out, rows_of("error", out)


def only(rows, **what):
  return [r for r in rows if all(r[k] == v for k, v in what.items())]


# The float64 reference.


@pytest.mark.parametrize("elements", ELEMENTS)
def test_float64_force_is_minus_the_gradient_of_the_energy(elements):
  mesh = scene.shape("sphere", 162)
  config = Config(young=(3e4,), poisson=0.3, bend=0, foundation=2e5, **ELEMENTS[elements])
  own = exact.Elastic(mesh, config)
  random = np.random.RandomState(0)
  u, along = 1e-3 * random.standard_normal((2, mesh.nvert, 3))
  assert own.energy(u) == pytest.approx(energy.total(mesh, config, u), rel=1e-12)
  step = 1e-4
  slope = (own.energy(u + step * along) - own.energy(u - step * along)) / (2 * step)
  assert -(own.force(u) * along).sum() == pytest.approx(slope, rel=1e-6)
  k = own.stiffness(u)
  v = random.standard_normal((mesh.nvert, 3))
  damped = -config.damping * (k @ v.ravel()).reshape(-1, 3)
  np.testing.assert_allclose(own.force(u, v) - own.force(u), damped, atol=1e-9 * abs(damped).max())


def test_float64_force_of_a_solid_is_that_of_the_energy_and_of_the_kernels(scenes):
  surface, config = scene.shape("sphere", 162), films.config_of("solid")
  own = Inside(surface, config)
  random = np.random.RandomState(0)
  u, v, along = 1e-3 * random.standard_normal((3, own.mesh.nvert, 3))
  ends = [energy.total(own.mesh, config, u + sign * 1e-7 * along) for sign in (-1, 1)]
  slope = -(own.force(u, 0 * u) * along).sum()
  assert slope == pytest.approx((ends[1] - ends[0]) / 2e-7, rel=1e-6)
  keys = ("elements", "young", "poisson", "foundation", "damping")
  made = {key: getattr(config, key) for key in keys}
  body = scenes.kernels(surface.rest, surface.elem, **made)[2]
  force, mass = own.force(u, 100 * v), np.ones(len(u))
  found = scenes.step(body, 1e-5, u, 100 * v, mass, scheme="explicit") / 1e-5
  np.testing.assert_allclose(found, force, atol=1e-5 * np.abs(force).max())


@pytest.mark.parametrize("newton", [1, 3])
@pytest.mark.parametrize("elements", ELEMENTS)
def test_a_step_of_the_organ_is_the_float64_step(elements, newton):
  mesh = scene.shape("sphere", 162)
  tissue = scene.Tissue(**ELEMENTS[elements])
  keys = {"newton": newton, "tolerance": 1e-6, "iterations": 200}
  model = scene.build(mesh, tissue, "implicit", 1e-3, **keys)
  data = mujoco.MjData(model)
  nodes = scene.node_dofs(model, mesh.nvert)
  random = np.random.RandomState(1)
  u, v = 1e-3 * random.standard_normal((mesh.nvert, 3)), random.standard_normal((mesh.nvert, 3)) / 9
  data.qpos[nodes], data.qvel[nodes] = u, v
  mujoco.mj_step(model, data)
  config = Config(young=(3e4,), poisson=0.3, bend=0, foundation=2e5, **ELEMENTS[elements])
  mass = np.full(mesh.nvert, tissue.mass / mesh.nvert)
  step = exact.Step(exact.Elastic(mesh, config), mass, np.ones(mesh.nvert, bool))
  expected = step(1e-3, u, v, np.zeros_like(u), newton)
  gap = np.linalg.norm(data.qvel[nodes] - v - expected)
  assert gap < 1e-5 * np.linalg.norm(expected)  # the tolerance, and float32


def test_native_flex_gets_the_same_static_force():
  # The documented constants mean the same on both sides: a press at rest, small time step.
  found = []
  for scheme in ("implicit", scene.NATIVE):
    case = {"scene": "press", "nodes": 162, "elements": "membrane"}
    model = films.build(case, scheme, 2.5e-4)
    film = films.Film(case, model, weighs=scheme == scene.NATIVE)
    film.move(0.15)
    found.append(film.force[-1][2])
  assert found[0] > 0.1
  assert found[1] == pytest.approx(found[0], rel=0.02)  # MuJoCo's contacts give with h


# Error.


def test_error_bench_fills_its_files(error_rows):
  out, rows = error_rows
  about = json.loads((out / "error.json").read_text())
  assert about["done"] == about["cases"] == 10
  assert {"palpate", "mujoco", "warp", "cpu", "seed", "python"} <= set(about)
  assert about["palpate"] == palpate.__version__
  assert {r["status"] for r in rows} == {"ok"}
  for name in ("error_press.png", "error_vibrate.png"):
    assert (out / name).read_bytes().startswith(b"\x89PNG")
  page = (out / "error.md").read_text()
  assert "palpate bench error --short" in page and "A peer is faster" in page


@pytest.mark.parametrize("run", ["implicit", "implicit, window", "midpoint", compare.RIGHT])
def test_force_error_falls_with_the_time_step(error_rows, run):
  rows = sorted(only(error_rows[1], run=run, scene="press"), key=lambda r: r["h"])
  errors = [r["force_rms"] for r in rows]
  assert len(errors) == 3 and errors == sorted(errors)


@pytest.mark.parametrize("scheme", ["implicit", "implicit, window"])
def test_implicit_scheme_is_of_first_order(error_rows, scheme):
  rows = only(error_rows[1], run=scheme, scene="press")
  assert error.order(rows, "force_rms", most=2.1e-3) >= 0.95
  assert error.order(rows, "position_rms", most=2.1e-3) >= 0.95


def test_midpoint_is_of_second_order_in_vibration(error_rows):
  rows = only(error_rows[1], run="midpoint", scene="vibrate")
  assert error.order(rows, "position_rms") >= 1.8


def test_windows_have_the_error_of_nodal_coupling(error_rows):
  for scheme in ("implicit", "midpoint"):
    for row in only(error_rows[1], run=f"{scheme}, window"):
      (nodal,) = only(error_rows[1], run=scheme, scene=row["scene"], h=row["h"])
      assert row["force_rms"] == pytest.approx(nodal["force_rms"], rel=0.05)


def test_steps_are_solved_to_the_tolerance(error_rows):
  for scheme in ("implicit", "midpoint"):
    for row in only(error_rows[1], run=scheme):
      assert row["algebraic"] < 1e-3  # tolerance 1e-4 in another norm
  # One iteration, and yet near the converged step.
  (row,) = only(error_rows[1], run="implicit", scene="press", h=1e-3)
  assert row["nonlinear"] < 0.01


def test_implicit_force_is_closer_than_native_at_the_same_time_step(error_rows):
  for h in (5e-4, 1e-3, 2e-3):
    found = {r["run"]: r["force_rms"] for r in only(error_rows[1], scene="press", h=h)}
    assert found["implicit"] < min(found["native"], found[compare.RIGHT])
    assert found["implicit"] < 0.015


def test_native_flex_on_mujoco_3_keeps_an_error_that_no_time_step_takes_away(error_rows):
  at = {r["run"]: r["force_rms"] for r in only(error_rows[1], scene="press", h=5e-4)}
  if contacts.are_wrong():
    assert at["native"] > 1.5 * at[compare.RIGHT]
  else:
    assert at["native"] == pytest.approx(at[compare.RIGHT], rel=1e-6)


# Stability.


@pytest.mark.slow
def test_a_stiff_solid_that_keeps_its_volume_comes_to_rest(tmp_path):
  case = next(c for c in stability_cases() if c["case"] == "map-solid-0.49-0.005-1e+06")
  (row,) = judge.run(case, tmp_path)
  assert row["verdict"] == "rest" and row["growth"] < 1.0


def test_stability_bench_judges_every_case_and_resumes(tmp_path, capsys, monkeypatch):
  few = stability_cases("--short")
  few = [c for c in few if c["scheme"] == "implicit" and c["nodes"] == 162][-3:]
  assert {c["coupling"] for c in few} == {"nodal", "window"}
  small = of_cases(stability.BENCH, few)
  words = ("--short", "--out", tmp_path)
  assert not runner.execute(small, options(small, *words, "--minutes", 0))
  assert rows_of("stability", tmp_path) == []
  assert runner.execute(small, options(small, *words, "--resume"))
  rows = rows_of("stability", tmp_path)
  assert {r["case"] for r in rows} == {c["case"] for c in few}
  assert {r["verdict"] for r in rows} <= set(stability.VERDICTS)
  # A row cut short by a kill is run again; the others are not.
  path = tmp_path / "stability.csv"
  kept = path.read_text().splitlines(keepends=True)
  path.write_text("".join(kept[:-1]) + kept[-1][:20])
  assert runner.execute(small, options(small, *words, "--resume"))
  assert path.read_text().splitlines(keepends=True)[:-1] == kept[:-1]
  assert len(rows_of("stability", tmp_path)) == len(rows)
  for written in runner.report(small, options(small, *words)):
    assert written.stat().st_size > 0


def test_stability_bench_watches_what_comes_to_rest(tmp_path):
  for case in stability_cases("--short"):
    if case["set"] == "flat" and case["start"] == "plate":
      (row,) = stability.run(case, tmp_path)
      ours = case["side"] != "MuJoCo flex"
      assert row["verdict"] == ("rest" if ours else "moving"), row
      assert (row["std"] < 0.005) == ours


def test_stability_bench_covers_what_it_says():
  cases = stability_cases()
  ours = [c for c in cases if c["scheme"] == "implicit"]
  assert sum(c["coupling"] == "nodal" for c in ours) >= 1000
  assert sum(c["coupling"] == "window" for c in ours) >= 500
  flat = [c for c in cases if c["set"] == "flat"]
  assert {c["side"] for c in flat} == set(stability.FLAT)
  cases = [c for c in cases if c["set"] != "flat"]
  ours = [c for c in ours if c["set"] != "flat"]
  assert {c["side"] for c in cases} == set(stability.SIDES)
  assert len({c["case"] for c in cases}) == len(cases)
  assert {c["nodes"] for c in ours} == {162, 642, 2562, 10242}
  assert {c["shape"] for c in ours} >= set(scene.SHAPES) and len(scene.SHAPES) == 3
  assert {c["start"] for c in ours} == {"rest", *stability.STARTS}
  for key, low, high in (("h", 6e-4, 1.9e-2), ("young", 1.5e2, 8e6), ("speed", 0.03, 1.9)):
    assert min(c[key] for c in ours) < low and max(c[key] for c in ours) > high
  mass = [c["mass"] for c in ours]
  assert max(mass) / min(mass) > 0.9e4
  assert flat == [c for c in stability_cases() if c["set"] == "flat"]


def test_stability_bench_loses_little_when_time_runs_out():
  # The maps and the wild starts come first, then draws in blocks, each over the whole hypercube.
  cases = stability_cases()
  cube = [c for c in cases if c["set"] == "hypercube"]
  assert all(c["set"] != "hypercube" for c in cases[: len(cases) - len(cube)])
  first = cube[: len(cube) // 10]
  assert {c["nodes"] for c in first} == {162, 642, 2562, 10242}
  assert {c["side"] for c in first} >= {"implicit", "implicit, window", "MuJoCo flex"}


def _judged(tmp_path, side, **what):
  scheme, coupling = stability.SIDES[side]
  case = {"set": "map", "scheme": scheme, "coupling": coupling, "side": side, "case": "x"}
  (row,) = stability.run(stability.USUAL | case | {"nodes": 162} | what, tmp_path)
  return row


@pytest.mark.parametrize("side", ["implicit", "implicit, window"])
@pytest.mark.parametrize(("h", "young"), [(5e-4, 1e3), (1e-3, 1e5), (5e-3, 1e4), (5e-3, 1e6)])
def test_a_press_in_the_usual_range_comes_back_to_rest(tmp_path, side, h, young):
  row = _judged(tmp_path, side, h=h, young=young)
  assert row["verdict"] in ("rest", "moving")
  assert row["growth"] <= 1.0 and row["excess"] < 0.05
  assert row["force_N"] > 0


def test_energy_that_contacts_give_is_not_called_growth(tmp_path):
  # A fast probe loads the organ within a few steps: its energy is the contacts' work.
  row = _judged(tmp_path, "implicit", h=1e-3, young=1e5, speed=1.0)
  assert row["excess"] < 0.05 and row["verdict"] not in stability.FAILURES


def test_an_explicit_step_that_blows_up_is_called_so(tmp_path):
  assert _judged(tmp_path, "explicit", h=1e-2, young=1e6)["verdict"] in stability.FAILURES


@pytest.mark.parametrize(
  "name",
  [
    "map-implicit-0.005-1e+06",
    "hypercube-implicit-0.004155-89990-47",
    "hypercube-implicit-0.0009322-3.832e+06-130",  # 1.5 m/s
    "hypercube-implicit-0.001454-1.154e+06-366",  # pushed through by 0.1 m/s
    "hypercube-implicit-0.0005733-39910-213",  # plate thicker than its triangles are wide
    "hypercube-implicit-window-0.0007135-154.1-170",  # 1 g of tissue
    "hypercube-implicit-window-0.001793-570.6-214",
    "hypercube-implicit-0.003945-12780-157",  # nodes of three masses
  ],
)
def test_what_once_failed_is_stable(tmp_path, name):
  (case,) = [c for c in stability_cases() if c["case"] == name]
  (row,) = stability.run(case, tmp_path)
  assert row["verdict"] not in stability.FAILURES


def test_one_case_of_the_stability_bench_is_run_again_by_name(tmp_path, capsys):
  (case,) = [
    c["case"]
    for c in stability_cases("--short")
    if c["set"] == "map" and c["side"] == "implicit" and c["h"] == 1e-3 and c["young"] == 1e3
  ]
  for _ in range(2):
    assert command("stability", "--short", "--only", case, "--out", tmp_path) == 0
  found = [line for line in capsys.readouterr().out.splitlines() if "wall_s" not in line]
  assert found[: len(found) // 2] == found[len(found) // 2 :]
  assert f"case {case}" in found and any(line.startswith("  verdict ") for line in found)
  assert command("stability", "--short", "--only", "map-nothing", "--out", tmp_path) == 2
  assert "the nearest are map-" in capsys.readouterr().err


# Thesis and skipping.


def test_thesis_bench_measures_every_scheme(tmp_path):
  args = options(thesis.BENCH, "--short", "--cycles", "40", "--out", tmp_path)
  bench = of_cases(thesis.BENCH, [c for c in thesis.stages(args)[0] if c["side"] == 16])
  assert runner.execute(bench, args)
  runner.report(bench, args)
  rows = results.read(tmp_path / "thesis_cpu.csv")
  rates, traces = ([r for r in rows if r["kind"] == kind] for kind in ("rate", "trace"))
  assert {r["scheme"] for r in rates} == set(thesis.SCHEMES)
  assert all(r["rate_hz"] > 0 and 0 < r["step_ms"] < 1e3 and r["narrow_ms"] > 0 for r in rates)
  assert not any(r["diverged"] for r in rows)
  for scheme in thesis.SCHEMES:
    mine = [r for r in traces if r["scheme"] == scheme]
    held = [r["force_N"] for r in mine if 300 <= r["cycle"] < 500]
    assert min(held) > 0.01 and abs(mine[-1]["force_N"]) < 0.1 * max(held)
  page = (tmp_path / "thesis.md").read_text()
  assert "(611)" in page and "0 are gone" in page
  for row in rates:
    row["diverged"] = int(row["scheme"] == "explicit")
  page = thesis.summarize(rows)
  assert "| explicit | cpu | diverged |" in page and "| implicit | cpu | diverged |" not in page
  assert "Not stable at 1 ms: explicit on cpu at 16 x 16." in page[-1]


def test_the_thesis_page_says_its_headline_and_what_shared_the_machine():
  paths = [results.FOLDER / f"thesis_{name}.csv" for name in ("cpu", "cuda")]
  rows = [row for path in paths for row in results.read(path)]
  first, *_ = thesis.finding(rows)
  assert "6.5 times in the thesis" in first and "3.4 times in the whole haptic cycle" in first
  page = "\n".join(thesis.summarize(rows, thesis.conditions(results.FOLDER)))
  assert "5 runs at a time shared 16 cores and one card" in page
  assert page.count("| diverged |") == 6  # rate, cycle and integration of explicit at 256 x 256


def test_skipping_bench_gives_a_row_to_every_feature(tmp_path):
  assert command("skipping", "--short", "--out", tmp_path) == 0
  rows = rows_of("skipping", tmp_path)
  left_out = {r["feature"].split(" ")[0] for r in rows}
  assert {"nothing", "bending", "volume", "foundation", "contact", "readback"} <= left_out
  assert {"dofs", "all"} <= left_out  # windows, and asleep
  assert all(math.isfinite(r["with_ms"]) and r["with_ms"] > 0 for r in rows)


def test_results_of_a_bench_are_no_changes_of_the_code(tmp_path, monkeypatch):
  folder = tmp_path / "tests" / "results"
  folder.mkdir(parents=True)
  monkeypatch.setattr(results, "FOLDER", folder)
  code, rows = tmp_path / "code.py", folder / "rows.csv"
  code.write_text("1\n"), rows.write_text("1\n")
  own = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
  for words in (["init", "-q"], ["add", "."], [*own, "commit", "-qm", "a"]):
    subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
  clean = results.machine()["commit"]
  rows.write_text("2\n")
  assert len(clean) >= 7 and results.machine()["commit"] == clean
  code.write_text("2\n")
  assert results.machine()["commit"] == f"{clean}-dirty"
