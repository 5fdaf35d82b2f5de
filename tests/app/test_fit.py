"""`palpate fit`: constants come back, with honest intervals; what is wrong is named."""

import dataclasses
import functools
import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import palpate
import pytest
from palpate.app import cli
from palpate.app.console import CommandError
from palpate.app.fit import indentation, least_squares, measured
from palpate.tissue import config

palpate.register()

BLOCK = (0.04, 0.04, 0.02)
TRUE = {"young": 7000.0, "damping": 0.02, "poisson": 0.45}
TEST = indentation.Test("sphere", 0.006, BLOCK, edge=0.004, step=0.003)
WORDS = ["--radius", "0.006", "--sample-size", *map(str, BLOCK), "--edge", "0.004", "--h", "0.003"]


GRASP = indentation.Test("sphere", 0.006, (0.03, 0.02, 0.012), edge=0.004, step=0.003, grasp=True)
GRASPED = ["--test", "grasp", "--radius", "0.006", "--sample-size", "0.03", "0.02", "0.012",
           "--edge", "0.004", "--h", "0.003"]  # fmt: skip


def noisy(test):
  """Returns the record of a press, a hold and a release, with 2 % of noise."""
  time = np.linspace(0, 0.3, 2000)
  depth = 0.0025 * np.clip(np.minimum(time / 0.1, (0.28 - time) / 0.08), 0, 1)
  way = measured.Record(time, depth, np.ones_like(time))
  force = indentation.Indentation(test, way).force(TRUE)
  noise = 0.02 * force.max() * np.random.RandomState(0).standard_normal(time.size)
  return measured.Record(time, depth, force + noise)


@pytest.fixture(scope="module")
def record():
  return noisy(TEST)


def written(path, record, header="time [s],depth [mm],force [mN]"):
  rows = np.stack([record.time, 1e3 * record.depth, 1e3 * record.force], 1)
  np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.8g")
  return str(path)


def run(capsys, *words):
  code = cli.main(["fit", *map(str, words)])
  return code, capsys.readouterr()


@pytest.mark.parametrize(
  ("test", "words"), [(TEST, WORDS), (GRASP, GRASPED)], ids=["press", "grasp"]
)
def test_constants_of_simulated_data_come_back(tmp_path, capsys, test, words):
  record = noisy(test)
  data, out = written(tmp_path / "data.csv", record), tmp_path / "out"
  code, shown = run(capsys, data, *words, "--out", out)
  assert code == 0, shown.err
  about = json.loads((out / "fit.json").read_text())
  for name in ("young", "damping"):
    found = about["constants"][name]
    assert found["value"] == pytest.approx(TRUE[name], rel=0.02)
    assert 0.08 * TRUE[name] < found["high"] - found["low"] < 0.3 * TRUE[name]
    assert found["low"] < found["value"] < found["high"]
    assert re.search(rf"^{name} .*95 %", shown.out, re.M)
  assert about["residual"] == pytest.approx(0.02 * record.force.max(), rel=0.1)
  assert (out / "fit.png").stat().st_size > 10_000
  # The fragment is a plugin that compiles.
  plugin = (out / "fit.xml").read_text()
  texts = dict(re.findall(r'key="(\w+)" value="([^"]+)"', plugin))
  config.parse("organ", texts | {"window": "w", "mass": "1"}, 4, True)
  assert float(texts["young"]) == pytest.approx(about["constants"]["young"]["value"], rel=1e-4)


GRID = 0.05  # of a constant's logarithm


@functools.cache
def coarse(other):
  """Returns the fit's own model of a coarse block, of Young's modulus and one other constant.

  Forces are linear in the modulus where inertia is small, and between simulations on a grid of the
  other constant: a simulation serves many records.
  """
  time = np.linspace(0, 0.3, 60)
  way = measured.Record(time, 0.0025 * np.clip(time / 0.2, 0, 1), np.ones_like(time))
  model = indentation.Indentation(dataclasses.replace(TEST, edge=0.006, step=0.005), way)

  @functools.cache
  def of(k):
    value = TRUE[other] * np.exp(GRID * k)
    return model.force(TRUE | {other: min(value, 0.495)})

  def simulate(values):
    at = np.log(values.get(other, TRUE[other]) / TRUE[other]) / GRID
    k = int(np.floor(at))
    return values["young"] / TRUE["young"] * ((k + 1 - at) * of(k) + (at - k) * of(k + 1))

  return simulate


@pytest.mark.parametrize("count", [10, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
  ("names", "kept"), [(("young", "poisson"), {"poisson"}), (("young", "damping"), set())]
)
def test_intervals_of_noisy_records_hold_the_truth(names, kept, count):
  simulate, random = coarse(names[1]), np.random.RandomState(0)
  true, hits = simulate(TRUE), 0
  starts = {"young": 5000.0, "damping": 0.01, "poisson": TRUE["poisson"]}
  for _ in range(count):
    record = true + 0.05 * true.max() * random.standard_normal(true.size)
    found = least_squares.fit(
      [least_squares.constant(n, starts[n]) for n in names], simulate, record
    )
    assert set(found.kept) == kept
    hits += all(found.low[n] < TRUE[n] < found.high[n] for n in found.values)
    assert found.high["young"] < 1.3 * found.low["young"]
  assert hits >= 0.9 * count


@pytest.mark.parametrize("start", [0.3, 0.45])
def test_poisson_of_one_press_is_kept_wherever_it_starts(start):
  simulate = coarse("poisson")
  free = [least_squares.constant("young", 6000.0), least_squares.constant("poisson", start)]
  for noise in (0.0, 0.05):
    random = np.random.RandomState(1)
    true = simulate(TRUE)
    record = true + noise * true.max() * random.standard_normal(true.size)
    assert least_squares.fit(free, simulate, record).kept == {"poisson": pytest.approx(start)}


def test_the_command_names_what_the_data_do_not_determine(tmp_path, capsys, record):
  noise = 0.2 * record.force.max() * np.random.RandomState(1).standard_normal(record.time.size)
  rough = dataclasses.replace(record, force=record.force + noise)
  data, out = written(tmp_path / "data.csv", rough), tmp_path / "out"
  free = ["--free", "young", "poisson", "--set", "damping=0.02", "--set", "poisson=0.4"]
  coarse = ["--edge", "0.006", "--h", "0.005"]
  code, shown = run(capsys, data, *WORDS, *coarse, *free, "-o", out)
  assert code == 0, shown.err
  assert re.search("do not determine poisson: it is kept at 0.4, .* --set poisson=VALUE", shown.err)
  assert re.search(r"^poisson +0.4, kept", shown.out, re.M)
  about = json.loads((out / "fit.json").read_text())
  assert (about["undetermined"], about["known"]["poisson"]) == (["poisson"], 0.4)
  assert list(about["constants"]) == ["young"]


def test_a_press_that_depends_on_no_constant_is_refused():
  with pytest.raises(CommandError, match="the data determine none of damping, foundation"):
    free = [least_squares.constant("damping"), least_squares.constant("foundation")]
    least_squares.fit(free, lambda _: np.ones(20), np.ones(20) + 0.01 * np.arange(20))
  with pytest.raises(CommandError, match="2 rows for 2 constants"):
    least_squares.fit(free, lambda _: np.ones(2), np.ones(2))


def test_intervals_hold_what_they_promise():
  x, random = np.linspace(0, 1, 200), np.random.RandomState(0)
  hits = 0
  for _ in range(200):
    measured_force = 3.0 * x + 0.05 * random.standard_normal(200)
    free = [least_squares.constant("young", 2.0)]
    one = least_squares.fit(free, lambda v: v["young"] * x, measured_force, mesh=0.0, rough=0.0)
    hits += one.low["young"] < 3.0 < one.high["young"]
  assert 180 <= hits <= 199  # 95 %, and chance


def test_any_number_of_the_tissue_may_be_sought():
  known = least_squares.allowed()
  assert {"young", "poisson", "damping", "foundation"} <= set(known)
  assert not {"tolerance", "iterations", "device", "mass"} & set(known)
  for name in known:
    each = least_squares.constant(name)
    assert each.value(each.scaled(each.start)) == pytest.approx(each.start)
    assert 0 < each.start < each.high


@pytest.mark.parametrize(("tip", "power"), [("sphere", 1.5), ("flat", 1.0)])
def test_force_grows_with_depth_as_the_theory_of_the_tip_says(tip, power):
  time = np.linspace(0, 0.4, 60)
  way = measured.Record(time, 0.0015 * time / 0.4, np.ones_like(time))
  test = indentation.Test(tip, 0.005, BLOCK, edge=0.002, step=0.002)
  force = indentation.Indentation(test, way).force(TRUE | {"damping": 0.005})
  half, whole = (np.interp(t, time, force) for t in (0.15, 0.3))
  assert np.log2(whole / half) == pytest.approx(power, abs=0.25)
  guess = indentation.first_guess(test, measured.Record(time, way.depth, force), 0.45)
  assert 0.9 < guess / TRUE["young"] < 2.5  # a block is stiffer than a half space


def test_an_organ_may_be_what_was_pressed():
  time = np.linspace(0, 0.2, 20)
  way = measured.Record(time, 0.01 * time, np.ones_like(time))
  test = indentation.Test("sphere", 0.005, organ="kidney", place="anterior", edge=0.004, step=0.005)
  keys = {"young": 5000.0, "damping": 0.005}
  soft, hard = (
    indentation.Indentation(test, way).force(keys | {"young": young}) for young in (5000.0, 10000.0)
  )
  assert 0.005 < soft[-1] < 0.2
  assert hard[-1] == pytest.approx(2 * soft[-1], rel=0.05)


# What is wrong is named.

ROWS = "\n".join(f"{k / 100},{k / 100},{k / 1000}" for k in range(20))
BAD = {
  "no file": (None, "no file .*expected a CSV"),
  "empty": ("", "it is empty"),
  "no unit": ("time,depth [mm],force [N]", r"column 'time' has no unit, expected one of s, ms"),
  "unit": ("time [s],depth [inch],force [N]", r"column 'depth \[inch\]' is in 'inch', expected"),
  "column": ("time [s],depth [mm],push [N]", r"no column of the force, expected one called"),
  "twice": ("time [s],t [s],force [N]", "is a second time"),
  "word": ("time [s],depth [mm],force [N]\n0,0,none", "line 2: force is 'none', expected a finite"),
  "few": ("time [s],depth [mm],force [N]\n0,0,0", "1 rows, expected at least 10"),
  "long": (f"time [s],depth [mm],force [N]\n0,0,{'1' * 200_000}", "cannot be read: field larger"),
  "short": ("time [s],depth [mm],force [N]\n0,0", "line 2: force is '', expected"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_table_that_is_wrong_is_named(tmp_path, capsys, name):
  header, match = BAD[name]
  data = tmp_path / "data.csv"
  if header is not None:
    data.write_text(header if "\n" in header or not header else f"{header}\n{ROWS}\n")
  code, shown = run(capsys, data, *WORDS, "--out", tmp_path)
  assert code == 2
  assert re.search(match, shown.err), shown.err
  assert shown.err.count("\n") == 1


def values(change):
  made = np.stack([np.arange(20) / 100, np.arange(20) / 1e4, np.arange(20) / 100])
  change(*made)
  return measured.Record(*made)


@pytest.mark.parametrize(
  ("change", "match"),
  [
    (lambda t, d, f: t.__setitem__(5, 0.0), "time does not grow after row 5"),
    (lambda t, d, f: d.__imul__(-1), "depth is nowhere above 0"),
    (lambda t, d, f: d.__iadd__(0.01), "expected a record from the first touch on"),
    (lambda t, d, f: f.__imul__(-1), "where it is deepest, expected one > 0"),
    (lambda t, d, f: d.__imul__(100), "expected at most 0.8 of sample-size's height"),
  ],
)
def test_numbers_that_cannot_be_are_named(tmp_path, capsys, change, match):
  data = written(tmp_path / "data.csv", values(change))
  code, shown = run(capsys, data, *WORDS, "--out", tmp_path)
  assert (code, re.search(match, shown.err) is None) == (2, False), shown.err


@pytest.mark.parametrize(
  ("words", "match"),
  [
    (["--radius", "5", "--sample-size", "1", "1", "1"], r"radius is 5, expected .* in \(0, 1\)"),
    (["--radius", ".005"], "expected either --sample-size or --organ"),
    (["--radius", ".03", "--sample-size", ".04", ".04", ".02"], "at most half of sample-size"),
    (["--radius", ".005", "--organ", "spleen"], "organ is 'spleen', expected one of liver"),
    (["--radius", ".005", "--organ", "liver:back"], "place is 'back', expected one of"),
    (["--radius", ".005", "--organ", "liver", "--test", "grasp"], "grasp with --organ, expected"),
    ([*WORDS, "--free", "colour"], "free is 'colour', expected some of young"),
    ([*WORDS, "--set", "poisson=0.6"], r"poisson is '0.6', expected a number in \[0, 0.5\)"),
    ([*WORDS, "--set", "window=1"], "expected KEY=VALUE with one of young"),
  ],
)
def test_an_option_that_is_wrong_is_named(tmp_path, capsys, words, match):
  data = written(tmp_path / "data.csv", values(lambda *_: None))
  code, shown = run(capsys, data, *words, "--out", tmp_path)
  assert code == 2
  assert re.search(match, shown.err), shown.err


def test_ctrl_c_keeps_the_best_so_far(tmp_path, record):
  data, out = written(tmp_path / "data.csv", record), tmp_path / "out"
  slow = [*WORDS[:-1], "0.00002"]  # for minutes
  with subprocess.Popen(
    [sys.executable, "-m", "palpate", "fit", data, *slow, "--out", str(out)],
    stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ,
  ) as process:  # fmt: skip
    time.sleep(5)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=120)
  assert process.returncode == 130, said
  if (out / "fit.json").exists():
    assert not json.loads((out / "fit.json").read_text())["complete"]
    assert "interrupted; this is the best so far" in said
  else:
    assert "before the first simulation" in said or "interrupted" in said
