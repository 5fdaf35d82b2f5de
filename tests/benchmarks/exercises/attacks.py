"""Counts what random attacks break: files, meshes, configurations, lives, threads, long runs.

    palpate bench attacks
    palpate bench attacks --kinds exercises --jobs 14 --minutes 60 --resume

A case is a block of seeds or of steps; a seed that fails is named. The first seeds of each run in
every test; here are ten thousand of each, a million steps of one organ, ten million of the hard
exercises in blocks of twenty thousand, each from a seed of its own, and the threads for a minute.
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
SOAK = 20_000  # steps of an exercise a case
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
  seeds, acts, steps, soak, seconds = args.seeds, ACTS, args.steps, args.soak, 60.0
  lives, threads = LIVES, THREADS
  if args.short:
    seeds, acts, steps, soak, seconds, lives, threads = 10, 200, 2000, 2000, 0.5, 1, THREADS[:1]
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
  hard = tasks.HARD
  each = min(SOAK, -(-soak // len(hard)))
  cases += [
    {
      "case": f"{'-'.join(hard[k % len(hard)])}-{k // len(hard)}",
      "kind": "exercises",
      "first": k,
      "count": each,
    }
    for k in range(-(-soak // each))
  ]
  return [[case for case in cases if case["kind"] in args.kinds]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  kind, first, count = case["kind"], case["first"], case["count"]
  held, failed, said = [0, 0], {}, []
  try:
    if kind in FUZZ:
      failed = apart.sweep(kind, first + count, first)
    elif kind == "life":
      held = apart.measure("life.py", first, count)
    elif kind in ("nodal", "window"):
      held = apart.measure("steps.py", kind, count)
    elif kind == "exercises":
      seed, k = divmod(first, len(tasks.HARD))
      said = soak.act(tasks.HARD[k], seed, count)
    else:
      count = soak.step_on_threads(first, case["seconds"], kind == "one model")
  except AssertionError as error:
    failed = {first: str(error)}
  why = "; ".join(f"{seed}: {text}" for seed, text in failed.items())
  row = {"kind": kind, "tried": count, "failed": len(failed)}
  row |= {"early_kb": held[0], "late_kb": held[1], "why": " ".join(why.split())[:300]}
  return [row | {"said": " ".join("; ".join(said).split())[:300]}]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.add_argument("--seeds", metavar="N", type=int, default=10_000, help="of each kind")
  parser.add_argument("--steps", metavar="N", type=int, default=1_000_000, help="of one organ")
  parser.add_argument("--soak", metavar="N", type=int, default=10_000_000,
                      help="of the hard exercises")  # fmt: skip
  parser.add_argument("--kinds", metavar="KIND", nargs="+", choices=list(WHAT), default=list(WHAT),
                      help=f"of attacks: {', '.join(WHAT)} (all)")  # fmt: skip


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  tried, failed = (sum(row[key] for row in rows) for key in ("tried", "failed"))
  kinds = ", ".join(what for kind, what in WHAT.items() if any(r["kind"] == kind for r in rows))
  return [f"{failed} of {tried:,} random attacks and steps failed.", f"Tried: {kinds}."]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  table = []
  for kind, what in WHAT.items():
    mine = [row for row in rows if row["kind"] == kind]
    if not mine:
      continue
    tried, failed = (sum(row[key] for row in mine) for key in ("tried", "failed"))
    grown = sum(row["late_kb"] - row["early_kb"] for row in mine) if mine[0]["early_kb"] else None
    # The first fifth of the steps, or half of the things done, is not counted.
    late = tried * (0.5 if kind == "life" else 0.8)
    memory = ["-", "-"] if grown is None else [f"{grown:+,}", f"{1e5 * grown / late:+.0f}"]
    table.append([what, f"{tried:,}", str(failed), *memory])
  why = [f"- {row['case']}: {row['why']}" for row in rows if row["failed"]]
  said = [f"- {row['case']}: {row['said']}" for row in rows if row.get("said")]
  lines = [
    "A case fails when it ends its process, is not finite without saying so, gives an error that "
    "is none of ours or names nothing, or, on threads and in repeated presses, is not the same to "
    "the bit. Memory is what a process holds more at the end than after a fifth of the steps, or "
    "half of the things done. " + results.link(out / "attacks.csv"),
    "",
    *plots.table(["attack", "tried", "failed", "memory [kB]", "in 100,000 [kB]"], table),
    *(["", "What failed:", "", *why] if why else []),
    *(["", "What was said of tools at full scale:", "", *said] if said else []),
  ]
  return [results.page(out / "attacks.md", "What attacks break", about, lines, finding(rows))]


BENCH = Bench("attacks", stages, run, report=report, arguments=arguments, limit=3600.0)
