"""What each feature costs, so what switching it off saves."""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import time

import mujoco
import numpy as np
from benchmarks import plots, results, runner, scene
from benchmarks.runner import Bench, Case, Row

NODES = (642, 2562, 10242)
H, DEPTH = 1e-3, 0.008  # [s], [m]
ROUNDS, STEPS = 12, 10  # stretches of each variant, steps of a stretch
WHOLE = scene.Tissue(bend=1, bulk=1e4)
SCALES = {"picture": 60}  # pictures are made so many times a second, not every step
_COLUMNS = ("nodes", "feature", "with_ms", "without_ms", "saved_ms", "share", "iterations")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns one case a size: its variants are interleaved."""
  return [[{"case": f"{n}", "nodes": n} for n in ((162,) if args.short else NODES)]]


class _Variant:
  """A model with a feature left out, and its step times."""

  def __init__(self, nodes: int, change: dict, contact: bool = True, each=None, **keys):
    mesh = scene.shape("sphere", nodes)
    tissue = dataclasses.replace(WHOLE, **change)
    top = mesh.rest[np.argmax(mesh.rest[:, 2])]
    place = top + np.array([0, 0, scene.PROBE + 0.0006 + (0 if contact else 1.0)])
    self.model = scene.build(mesh, tissue, "implicit", H, probe=place, **keys)
    self.data = mujoco.MjData(self.model)
    self.organ = scene.handle(self.model, self.data)
    self.probe = scene.probe_dofs(self.model)
    self.each = each
    self.n = 0
    self.times: list[float] = []
    self.iterations: list[int] = []

  def advance(self):
    for _ in range(STEPS):
      done, rate = scene.ramp(self.n * H, 0.06)
      scene.put(
        self.data, self.probe, np.array([0, 0, -DEPTH * done]), np.array([0, 0, -DEPTH * rate])
      )
      start = runner.clock()
      mujoco.mj_step(self.model, self.data)
      if self.each:
        self.each(self)
      self.times.append(runner.clock() - start)
      self.iterations.append(self.organ.iterations)
      self.n += 1

  def fall_asleep(self):
    """Steps until the organ sleeps, uncounted."""
    for _ in range(100):
      if self.organ.asleep:
        break
      self.advance()
    self.times.clear()
    self.iterations.clear()

  def median(self) -> float:
    return 1e3 * float(np.median(self.times[2 * STEPS :]))


def _read(variant: _Variant):
  """Reads what a task reads every step."""
  organ = variant.organ
  return organ.xpos, organ.xvel, organ.contact_force


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Runs all variants of a size, interleaved, and returns a row a feature."""
  nodes = case["nodes"]
  whole = _Variant(nodes, {})
  without = {
    "bending": _Variant(nodes, {"bend": 0}),
    "volume": _Variant(nodes, {"bulk": 0.0}),
    "foundation": _Variant(nodes, {"foundation": 0.0}),
    "contact": _Variant(nodes, {}, contact=False),
    "two digits of the solve (tolerance 1e-2)": _Variant(nodes, {}, tolerance=1e-2),
  }
  readback = _Variant(nodes, {}, each=_read)
  window = _Variant(nodes, {}, window=True)
  asleep = _Variant(nodes, {}, contact=False, window=True)
  asleep.fall_asleep()
  everything = [whole, readback, window, asleep, *without.values()]
  for _ in range(ROUNDS):
    for variant in everything:
      variant.advance()
  base = whole.median()
  rows = [_row(nodes, name, base, v.median(), v) for name, v in without.items()]
  rows.append(_row(nodes, "readback (xpos, xvel, contact_force)", readback.median(), base, whole))
  rows.append(_row(nodes, "dofs of nodes out of reach (window)", base, window.median(), window))
  if asleep.organ.asleep:
    rows.append(_row(nodes, "all of it (window, asleep)", window.median(), asleep.median(), asleep))
  picture = _picture(whole)
  if picture is not None:
    each = picture * H * SCALES["picture"]  # share of a step at that rate
    rows.append(_row(nodes, "picture (640 x 480 at 60 Hz)", base + each, base, whole))
  return [_row(nodes, "nothing", base, base, whole), *rows]


def _row(nodes: int, feature: str, with_ms: float, without_ms: float, variant: _Variant) -> Row:
  saved = with_ms - without_ms
  return {
    "nodes": nodes,
    "feature": feature,
    "with_ms": with_ms,
    "without_ms": without_ms,
    "saved_ms": saved,
    "share": saved / with_ms,
    "iterations": float(np.mean(variant.iterations)),
  }


def _picture(variant: _Variant) -> float | None:
  """Returns the time of a picture [ms], or None where nothing can render."""
  try:
    with mujoco.Renderer(variant.model, 480, 640) as renderer:
      times = []
      for _ in range(6):
        start = time.perf_counter()
        renderer.update_scene(variant.data)
        renderer.render()
        times.append(time.perf_counter() - start)
  except Exception:
    return None
  return 1e3 * float(np.median(times[1:]))


def draw(rows: list[Row], out: pathlib.Path) -> list[pathlib.Path]:
  """Draws the saved share of each feature."""
  rows = [row for row in rows if row["feature"] != "nothing"]
  if not rows:
    return []
  features = list(dict.fromkeys(row["feature"] for row in rows))
  sizes = sorted({row["nodes"] for row in rows})
  figure, axes = plots.grid(1, 1, width=7.6, height=0.5 * len(features) + 1.4)
  ax = axes[0]
  shades = ("#9ecae1", "#4292c6", "#08519c")
  for k, nodes in enumerate(sizes):
    shares = {r["feature"]: 100 * r["share"] for r in rows if r["nodes"] == nodes}
    at = [i + 0.26 * (k - (len(sizes) - 1) / 2) for i in range(len(features))]
    ax.barh(at, [shares.get(f, 0) for f in features], 0.24, color=shades[k % 3],
            label=f"{nodes} nodes")  # fmt: skip
  ax.set_yticks(range(len(features)), features)
  ax.invert_yaxis()
  ax.axvline(0, color=plots.INK, lw=0.8)
  ax.set_xlabel("share of the step that is saved [%]")
  ax.legend(frameon=False, fontsize=8)
  return [plots.save(figure, out / "skipping.png", "What leaving a feature out saves")]


def summarize(rows: list[Row]) -> list[str]:
  """Returns the lines of the page."""
  lines = [
    "A sphere pressed 8 mm at h = 1 ms with bending, volume and foundation; each row leaves one "
    "thing out, all interleaved, medians of whole steps in CPU time of the one thread. Leaving a "
    "term out also changes the stiffness matrix and so the iterations: a saving can be negative.",
    "",
  ]
  table = [
    [r["nodes"], r["feature"], r["with_ms"], r["without_ms"], r["saved_ms"],
     f"{100 * r['share']:.0f} %", r["iterations"]]
    for r in rows
  ]  # fmt: skip
  head = ["nodes", "left out", "with [ms]", "without [ms]", "saved [ms]", "share", "iterations"]
  lines += [*plots.table(head, table), ""]
  if not any("picture" in str(r.get("feature")) for r in rows):
    lines += ["No picture: nothing to render with on this machine.", ""]
  if any("asleep" in str(r.get("feature")) for r in rows):
    lines += ["Asleep: an organ with a window, at rest, with no tool near; its saving is of the "
              "windowed step.", ""]  # fmt: skip
  return lines


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with: the three features that save most, whatever the size."""
  good = [r for r in rows if r["feature"] != "nothing"]
  shares = {name: [100 * r["share"] for r in good if r["feature"] == name]
            for name in dict.fromkeys(r["feature"] for r in good)}  # fmt: skip
  most = sorted(shares, key=lambda name: -max(shares[name]))[:3]
  return [
    f'Leaving out "{name}" saves {min(shares[name]):.0f} to {max(shares[name]):.0f} % of a step.'
    for name in most
  ]


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Draws the figures and writes the page."""
  drawn = draw(rows, path.parent)
  return results.Page("What each feature costs", finding(rows), summarize(rows), drawn)


BENCH = Bench("skipping", stages, run, _COLUMNS, report, jobs=1, limit=1800.0)
