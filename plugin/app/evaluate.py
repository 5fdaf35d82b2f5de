"""`palpate evaluate`: scores a policy over many episodes of an exercise, in parallel."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import pathlib
from collections.abc import Iterator
from typing import Any

import palpate

from .console import CommandError, Progress


@dataclasses.dataclass(frozen=True)
class Result:
  """One episode.

  Attributes:
    seed: of the episode
    outcome: `success`, `damage`, `missed`, `time limit` or `error`
    total: sum of rewards [-]
    time: simulated [s]
    metrics: as JSON, see `score.Metrics`
    error: what went wrong, empty otherwise
  """

  seed: int
  outcome: str
  total: float
  time: float
  metrics: str
  error: str = ""


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("task", metavar="TASK", help="such as touch/easy; a domain alone is its standard task")
  add("--policy", metavar="NAME", default="expert", help="module:object, or expert, tremor, ...")
  add("--episodes", metavar="N", type=int, default=10, help="how many (%(default)s)")
  add("--seed", metavar="N", type=int, default=0, help="of the first episode (%(default)s)")
  add("--processes", metavar="N", type=int, default=1, help="at a time (%(default)s)")
  add("--json", metavar="FILE", help="write every episode's metrics")
  add("--reference", metavar="FILE", help="write an expert reference of these episodes")
  add("--recordings", metavar="FOLDER", help="keep every episode's recording, whole or not")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  for name in ("episodes", "processes"):
    if getattr(args, name) < 1:
      raise CommandError(f"{name} is {getattr(args, name)}, expected a whole number >= 1")
  palpate.register()
  from palpate.tasks import episode, suite

  try:
    name = "/".join(suite.split(args.task))
    _check_policy(args.policy)
  except ValueError as error:
    raise CommandError(str(error)) from None
  seeds = range(args.seed, args.seed + args.episodes)
  progress, results = Progress(), []
  for result in evaluate(name, args.policy, seeds, args.processes, args.recordings):
    results.append(result)
    progress.show(f"{len(results)} of {args.episodes}")
  progress.clear()
  print(table(name, args.policy, results, episode.reference(name)))
  if args.json:
    rows = [
      dataclasses.asdict(r) | {"metrics": json.loads(r.metrics) if r.metrics else None}
      for r in results
    ]
    pathlib.Path(args.json).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
  if args.reference:
    write_reference(pathlib.Path(args.reference), name, args.seed, results)
  errors = [r for r in results if r.outcome == "error"]
  if errors:
    raise CommandError(f"{len(errors)} episodes failed, the first: {errors[0].error}", code=1)
  return 0


def _check_policy(spec: str):
  from palpate.tasks import episode, experts

  if ":" in spec:
    episode.find(spec)
  elif spec not in experts.STYLES:
    names = ", ".join(experts.STYLES)
    raise ValueError(f"policy is {spec!r}, expected module:object or one of {names}")


def evaluate(
  name: str, policy: str, seeds: range, processes: int = 1, recordings: str | None = None
) -> Iterator[Result]:
  """Yields the result of each seed, in order; the processes are spawned, not forked.

  Args:
    name: of the task, such as "touch/easy"
    policy: see `episode.performer`
    seeds: of the episodes
    processes: at a time
    recordings: folder to keep the recordings in, SEED.npz
  """
  jobs = [(name, policy, seed, recordings) for seed in seeds]
  if processes == 1:
    yield from map(_one, jobs)
    return
  import multiprocessing

  with multiprocessing.get_context("spawn").Pool(min(processes, len(jobs))) as pool:
    yield from pool.imap(_one, jobs)


_environments: dict[str, Any] = {}  # of this process


def _one(job: tuple[str, str, int, str | None]) -> Result:
  name, policy, seed, folder = job
  palpate.register()
  from palpate.tasks import episode, suite

  if name not in _environments:
    _environments[name] = suite.load(*suite.split(name), task_kwargs={"random": 0})
  env = _environments[name]
  options = {"task_kwargs": {}, "performer": policy}
  try:
    recording = episode.run(env, episode.performer(policy, env, seed), seed, options)
  except episode.EpisodeError as error:
    recording = error.recording
  if folder is not None:
    pathlib.Path(folder).mkdir(parents=True, exist_ok=True)
    recording.save(pathlib.Path(folder) / f"{seed}.npz")
  info = recording.info
  return Result(
    seed=seed,
    outcome=info["outcome"],
    total=float(info["return"]),
    time=float(recording.time[-1]) if len(recording.time) else 0.0,
    metrics=recording.metrics().to_json(),
    error=info.get("error", ""),
  )


def table(name: str, policy: str, results: list[Result], reference: dict | None) -> str:
  """Returns mean and spread of return, time and every known metric, for people."""
  from palpate.tasks.metrics import METRICS, Metrics
  from palpate.tasks.score import score

  wins = sum(r.outcome == "success" for r in results)
  low, high = _wilson(wins, len(results))
  other = {r.outcome for r in results} - {"success"}
  counts = ", ".join(f"{k} {sum(r.outcome == k for r in results)}" for k in sorted(other))
  lines = [
    f"{name}, policy {policy}, {len(results)} episodes",
    f"success  {wins}/{len(results)} (95 % interval {100 * low:.0f} to {100 * high:.0f} %)"
    + (f"; {counts}" if counts else ""),
    f"{'':28} {'mean':>10} {'SD':>10} {'n':>5}",
  ]

  def row(label: str, values: list[float]) -> str:
    mean, sd = _mean_sd(values)
    return f"{label:28} {mean:>10.4g} {sd:>10.3g} {len(values):>5}"

  lines.append(row("Return [-]", [r.total for r in results]))
  metrics = [Metrics.from_json(r.metrics) for r in results]
  for key, spec in METRICS.items():
    known = [v * spec.scale for m in metrics if math.isfinite(v := getattr(m, key))]
    if known:
      lines.append(row(f"{spec.label} [{spec.shown}]", known))
  if reference is not None:
    scores = [s for m in metrics if math.isfinite(s := score(m, reference).composite)]
    if scores:
      lines.append(row("Composite score [-]", scores))
  return "\n".join(lines)


def write_reference(path: pathlib.Path, name: str, seed: int, results: list[Result]):
  """Writes the reference of the episodes that succeeded, with seed and versions."""
  import mujoco
  from palpate.tasks.metrics import Metrics
  from palpate.tasks.score import make_reference

  good = [Metrics.from_json(r.metrics) for r in results if r.outcome == "success"]
  if not good:
    raise CommandError(f"{name}: no episode succeeded, so there is no reference", code=1)
  data = make_reference(good, name, seed)
  data |= {"palpate": palpate.__version__, "mujoco": mujoco.__version__, "episodes": len(results)}
  path.parent.mkdir(parents=True, exist_ok=True)
  path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def _mean_sd(values: list[float]) -> tuple[float, float]:
  mean = math.fsum(values) / len(values)
  if len(values) < 2:
    return mean, math.nan
  return mean, math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1))


def _wilson(wins: int, count: int, z: float = 1.96) -> tuple[float, float]:
  """Returns the 95 % interval of a share (Wilson 1927)."""
  share = wins / count
  middle = (share + z * z / (2 * count)) / (1 + z * z / count)
  half = (
    z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
  )
  return max(middle - half, 0.0), min(middle + half, 1.0)
