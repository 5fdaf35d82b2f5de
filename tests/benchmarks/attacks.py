"""Counts what random attacks break: files, meshes, configurations, lives, threads, long runs.

    python tests/benchmarks/run.py attacks

A case is a block of seeds or one long run; a seed that fails is named. The first seeds of each run
in every test; here are ten thousand of each, a million steps, and the threads for a minute.
"""

import argparse
import pathlib

from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from fuzz import apart, soak
from palpate import tasks

FUZZ = ("configurations", "meshes", "files")
THREADS = (2, 4, 16)
BLOCK = 250  # seeds a case
LIVES, ACTS = 8, 6000
WHAT = {
  "configurations": "random keys",
  "meshes": "random and defective meshes",
  "files": "spoilt meshes, label maps and recordings",
  "life": "things done to models, data and organs",
  "nodal": "steps of presses, nodal",
  "window": "steps of presses, windowed",
  "copies": "steps on 2, 4 and 16 threads, a model each",
  "one model": "steps on 2, 4 and 16 threads, one windowed model",
  "exercises": "steps of the hard exercises, random actions",
}


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a block of seeds, life, coupling, number of threads and exercise."""
  seeds, acts, steps, seconds = args.seeds, ACTS, args.steps, 60.0
  lives, threads = LIVES, THREADS
  if args.short:
    seeds, acts, steps, seconds, lives, threads = 10, 200, 2000, 0.5, 1, THREADS[:1]
  cases = [
    {"case": f"{kind}-{n}", "kind": kind, "first": n, "count": 0, "seconds": seconds}
    for kind in ("copies", "one model")
    for n in threads
  ]
  cases += [
    {"case": kind, "kind": kind, "first": 0, "count": steps} for kind in ("window", "nodal")
  ]
  cases += [
    {"case": f"{kind}-{first}", "kind": kind, "first": first, "count": min(BLOCK, seeds - first)}
    for first in range(0, seeds, BLOCK)
    for kind in FUZZ
  ]
  cases += [
    {"case": f"life-{seed}", "kind": "life", "first": seed, "count": acts} for seed in range(lives)
  ]
  each = steps // len(tasks.HARD)
  cases += [
    {"case": "-".join(name), "kind": "exercises", "first": k, "count": each}
    for k, name in enumerate(tasks.HARD)
  ]
  return [cases]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  kind, first, count = case["kind"], case["first"], case["count"]
  held, failed = [0, 0], {}
  try:
    if kind in FUZZ:
      failed = apart.sweep(kind, first + count, first)
    elif kind == "life":
      held = apart.measure("life.py", first, count)
    elif kind in ("nodal", "window"):
      held = apart.measure("steps.py", kind, count)
    elif kind == "exercises":
      soak.act(tasks.HARD[first], 1, count)
    else:
      count = soak.step_on_threads(first, case["seconds"], kind == "one model")
  except AssertionError as error:
    failed = {first: str(error)}
  why = "; ".join(f"{seed}: {text}" for seed, text in failed.items())
  row = {"kind": kind, "tried": count, "failed": len(failed)}
  return [row | {"early_kb": held[0], "late_kb": held[1], "why": " ".join(why.split())[:300]}]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.add_argument("--seeds", metavar="N", type=int, default=10_000, help="of each kind")
  parser.add_argument("--steps", metavar="N", type=int, default=1_000_000, help="of a long run")


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  table = []
  for kind, what in WHAT.items():
    mine = [row for row in rows if row["kind"] == kind]
    if not mine:
      continue
    tried, failed = (sum(row[key] for row in mine) for key in ("tried", "failed"))
    grown = sum(row["late_kb"] - row["early_kb"] for row in mine) if mine[0]["early_kb"] else None
    table.append([what, f"{tried:,}", str(failed), "-" if grown is None else f"{grown:+,}"])
  why = [f"- {row['case']}: {row['why']}" for row in rows if row["failed"]]
  lines = [
    "A case fails when it ends its process, is not finite without saying so, gives an error that "
    "is none of ours or names nothing, or, on threads and in repeated presses, is not the same to "
    "the bit. Memory is what a process holds more at the end than after a fifth of the steps, or "
    "half of the things done. " + results.link(out / "attacks.csv"),
    "",
    *plots.table(["attack", "tried", "failed", "memory [kB]"], table),
    *(["", "What failed:", "", *why] if why else []),
  ]
  return [results.page(out / "attacks.md", "What attacks break", about, lines)]


BENCH = Bench("attacks", stages, run, report=report, arguments=arguments, limit=3600.0)
