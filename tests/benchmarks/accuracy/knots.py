"""Knots in threads: does anything go through, what holds, and what do edges cost?

- Random tangles are pulled tight by 0.5 N. No edge may pass through another while nodes move on
  straight lines from step to step. Where one does, in a long step, in which the thread may have
  gone round instead, the Jones polynomial of the thread, closed far away, must stay the same. It
  cannot be told where part of the thread came before a hand, or has too many crossings.
- Knots are drawn tight by 2 N at all four strands, the ends are let go, and the strands are pulled
  apart by up to 80 % of the thread's strength.
- An overhand knot is drawn tight by 0.5 N with edges of 2 to 5 radii.
- The same in 15 cm of thread within 0.5 s, with edges that are alike, that are graded (short in the
  middle), or that begin alike and are refined where the thread touches itself (`refine`).
- The square knot of a stitch through a drain of 1000 nodes is drawn tight by 1 N, and timed while
  it is held so.

Times are CPU times of `mj_step`, without the first 20 steps, in which the thread, straight at rest,
springs from its initial curve.
"""

from __future__ import annotations

import argparse
import pathlib
import time

import mujoco
import numpy as np
import scenes.threads as scene
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate import register
from palpate.tasks.metrics import knots

TANGLES, EACH = 1000, 20  # of a case
KNOTS = ((1,), (1, 1), (1, -1), (2, -1), (2, -1, 1))
MATERIALS = ("silk", "vicryl", "polypropylene")
FRICTIONS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4)  # of silk on itself
SEGMENTS = (2.0, 2.5, 3.0, 4.0, 5.0)  # [radii]
# Of 15 cm, by name: the edges at the ends, and if they are others those in the middle [radii].
FINE, TAIL = 2.2, 0.057  # [m]
LONG = {
  "alike 2.2": (FINE, 0.0),
  "alike 4.8": (4.8, 0.0),
  "alike 10.9": (10.9, 0.0),
  "graded": (18.0, FINE),
  "refined": (10.9, FINE),
}
# Nodes of an organ in a window, which MuJoCo has; 0 for all.
STITCHES = {"stitch": 0, "stitch windowed": 24}
_START = 20  # steps
_COLUMNS = (
  *("kind", "seed", "knot", "material", "friction", "segment", "nodes", "passes", "same", "near"),
  *("error", "held", "slip_mm", "kept_mm", "median_ms", "high_ms"),
)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns tangles, knots and edge lengths."""
  short = args.short
  count, each = (4, 2) if short else (TANGLES, EACH)
  tangles = [
    {"case": f"tangles {k}", "kind": "tangle", "seed": k, "count": each}
    for k in range(0, count, each)
  ]
  pulls = [
    {"case": f"{material} {turns}", "kind": "pull", "turns": " ".join(map(str, turns)),
     "material": material, "friction": 0.0}
    for material in MATERIALS[: 1 if short else None]
    for turns in KNOTS[: 1 if short else None]
  ]  # fmt: skip
  pulls += [
    {"case": f"square {friction}", "kind": "pull", "turns": "1 -1", "material": "silk",
     "friction": friction}
    for friction in (() if short else FRICTIONS)
  ]  # fmt: skip
  edges = [
    {"case": f"edges {segment:g}", "kind": "edge", "segment": segment}
    for segment in SEGMENTS[-1 if short else 0 :]
  ]
  edges += [
    {"case": f"15 cm {name}", "kind": "long", "how": name}
    for name in list(LONG)[-1 if short else 0 :]
  ]
  stitches = [
    {"case": case, "kind": "stitch", "window": window}
    for case, window in list(STITCHES.items())[: 1 if short else None]
  ]
  return [edges + stitches, pulls + tangles]


def _timed(model: mujoco.MjModel, data: mujoco.MjData) -> float:
  """Takes a step and returns its time [ms]."""
  start = time.thread_time()
  mujoco.mj_step(model, data)
  return 1e3 * (time.thread_time() - start)


def _times(took: list[float]) -> dict:
  counted = took[_START:]
  return {"median_ms": float(np.median(counted)), "high_ms": float(np.percentile(counted, 99))}


def tangle(seed: int) -> Row:
  """Pulls a tangle tight and returns what became of it."""
  points = scene.tangle(seed, 4 * scene.RADIUS)
  before, took = knots.jones(knots.closed(points)), list[float]()

  def step(model: mujoco.MjModel, data: mujoco.MjData):
    took.append(_timed(model, data))

  thread, clear, through = scene.by_hands(points, 0.5, 250, step, bend=1e-4)
  nearest = scene.nearest(thread.positions) / scene.RADIUS
  after = knots.jones(knots.closed(thread.positions))
  told = clear and before is not None and after is not None
  return {
    "kind": "tangle", "seed": seed, "nodes": len(points), "passes": through,
    "same": int(before == after) if told else "", "near": nearest, "error": thread.error or "",
    **_times(took),
  }  # fmt: skip


def pull(turns: tuple[int, ...], material: str, friction: float) -> Row:
  """Pulls a knot and returns what held."""
  took: list[float] = []
  contact = {"friction": friction} if friction else None
  held, slip, thread = scene.pull_test(
    turns, material, step=lambda m, d: took.append(_timed(m, d)), contact=contact
  )
  return {
    "kind": "pull", "knot": knots.NAMES.get(turns, str(turns)), "material": material,
    "friction": friction or "", "segment": 2.5, "nodes": len(thread.positions), "held": held,
    "slip_mm": 1e3 * slip, "error": thread.error or "", **_times(took),
  }  # fmt: skip


def edge(segment: float) -> Row:
  """Draws an overhand knot tight and returns how much thread it keeps."""
  points = scene.overhand(0.0012, segment * scene.RADIUS, 0.012)
  took: list[float] = []
  thread, *_ = scene.by_hands(points, 0.5, 400, lambda m, d: took.append(_timed(m, d)))
  kept = thread.length - np.linalg.norm(thread.positions[-1] - thread.positions[0])
  return {
    "kind": "edge", "segment": segment, "nodes": len(points), "kept_mm": 1e3 * kept,
    "error": thread.error or "", **_times(took),
  }  # fmt: skip


def long(how: str) -> Row:
  """Does so with a long thread, see LONG."""
  (coarse, fine), radius, config = LONG[how], scene.RADIUS, {}
  points = scene.overhand(0.0012, (coarse if how != "graded" else 0.1) * radius, TAIL)
  if how == "graded":
    points = scene.graded(points, fine * radius, coarse * radius, 0.004)
  elif fine:
    config["refine"] = fine * radius
  took: list[float] = []
  thread, *_ = scene.by_hands(
    points, 0.5, 1000, lambda m, d: took.append(_timed(m, d)), within=500, **config
  )
  kept = thread.length - np.linalg.norm(thread.positions[-1] - thread.positions[0])
  return {
    "kind": "long", "knot": how, "segment": coarse, "nodes": len(points), "kept_mm": 1e3 * kept,
    "error": thread.error or "", **_times(took),
  }  # fmt: skip


def stitch(window: int) -> Row:
  """Draws the knot of a stitch tight and returns what steps take from then on."""
  model, data, thread = scene.stitch(1000, window)
  took = []
  for k in range(800):
    data.ctrl[-2:] = min(1.0, k / 200)
    took.append(_timed(model, data))
  knot = knots.name(knots.closed(thread.positions, np.array([-1.0, 0.0, 0.0])))
  return {
    "kind": "stitch", "knot": knot, "material": "silk", "nodes": len(thread.positions),
    "error": thread.error or "", **_times(took[400:]),
  }  # fmt: skip


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the rows of a case."""
  register()
  if case["kind"] == "tangle":
    return [tangle(seed) for seed in range(case["seed"], case["seed"] + case["count"])]
  if case["kind"] == "edge":
    return [edge(case["segment"])]
  if case["kind"] == "long":
    return [long(str(case["how"]))]
  if case["kind"] == "stitch":
    return [stitch(int(case["window"]))]
  turns = tuple(map(int, str(case["turns"]).split()))
  return [pull(turns, case["material"], case["friction"])]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  tangles = [r for r in rows if r["kind"] == "tangle"]
  decided = [r for r in tangles if not r["passes"] or r["same"] in (0, 1)]
  kept = sum(r["same"] != 0 for r in decided)
  held = [f"{r['knot']} {r['held']:.0%}" for r in rows if r["kind"] == "pull"
          and r["material"] == "silk" and not r["friction"]]  # fmt: skip
  lines = [
    f"Of {len(tangles)} tangles pulled tight {len(decided)} are decided, and {kept} of these keep "
    "their knot."
  ]
  if held:
    lines.append(
      f"In silk hold, as shares of the strength (80 % is all that was tried): {', '.join(held)}."
    )
  stitches = [r for r in rows if r["kind"] == "stitch"]
  if stitches:
    best = min(stitches, key=lambda r: r["median_ms"])
    lines.append(
      "A step of a stitch with a tight knot in an organ of 1000 nodes takes "
      f"{best['median_ms']:.2f} ms, 99 % no more than {best['high_ms']:.2f} ms."
    )
  return lines


def label(row: Row) -> str:
  """Returns how long edges are."""
  return f"{row['segment']:g}" if row["kind"] == "edge" else row["knot"]


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page."""
  kinds = "tangle", "pull", "edge", "long", "stitch"
  # Processes end in any order.
  cases = [case["case"] for stage in stages(argparse.Namespace(short=False)) for case in stage]
  order = {case: k for k, case in enumerate(cases)}
  rows = sorted(rows, key=lambda r: order.get(r["case"], len(order)))
  by = {kind: [r for r in rows if r["kind"] == kind] for kind in kinds}
  pulls = [
    [r["knot"], r["material"], f"{r['friction'] or '-'}", f"{r['held']:.2f}", f"{r['slip_mm']:.1f}",
     f"{r['median_ms']:.2f}", f"{r['high_ms']:.1f}"]
    for r in by["pull"]
  ]  # fmt: skip
  edges, lengths = (
    [
      [label(r), str(r["nodes"]), f"{r['kept_mm']:.2f}", f"{r['median_ms']:.2f}",
       f"{r['high_ms']:.1f}"]
      for r in by[kind]
    ]
    for kind in ("edge", "long")
  )  # fmt: skip
  times = ["median [ms]", "99 % [ms]"]
  head = ["knot", "material", "friction, if not its own", "held", "came out [mm]", *times]
  lines = [str(__doc__).partition("\n\n")[2], "", *plots.table(head, pulls), ""]
  head = ["edge [radii]", "nodes", "kept in the knot [mm]", *times]
  lines += [*plots.table(head, edges), ""]
  lines += [*plots.table(["edges in 15 cm [radii]", *head[1:]], lengths), ""]
  stitches = [
    [r["case"], str(r["nodes"]), r["knot"], f"{r['median_ms']:.2f}", f"{r['high_ms']:.2f}"]
    for r in by["stitch"]
  ]
  head = ["scene", "nodes of the thread", "knot", *times]
  lines += [*plots.table(head, stitches), ""]
  unsolved = sum("not solved" in r["error"] for r in by["tangle"])
  other = sum(bool(r["error"]) for r in by["tangle"]) - unsolved
  lost = [str(r["seed"]) for r in by["tangle"] if r["same"] == 0]
  free = sum(not r["passes"] for r in by["tangle"])
  undecided = [str(r["seed"]) for r in by["tangle"] if r["passes"] and r["same"] not in (0, 1)]
  lines += [
    f"In {free} tangles no edge passes another. Undecided: {', '.join(undecided) or 'none'}. "
    f"Changed knots: {', '.join(lost) or 'none'}. "
    f"Steps that were not solved to the end are in {unsolved} tangles, other errors in {other}.",
    "",
    results.link(path),
  ]
  panels: dict = {
    name: {label(r): ([r["median_ms"]], [r["kept_mm"]]) for r in by[kind]}
    for name, kind in (("by edges [radii]", "edge"), ("15 cm, by edges [radii]", "long"))
  }
  title = "Thread kept in an overhand knot, by the time of a step"
  picture = plots.curves(path.with_suffix(".png"), title, panels, "median step [ms]", "kept [mm]")
  return results.Page("Knots", finding(rows), lines, [picture])


BENCH = Bench("knots", stages, run, columns=_COLUMNS, report=report, jobs=4)
