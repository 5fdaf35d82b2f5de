"""`palpate evaluate`: scores a policy over many episodes of an exercise, in parallel."""

from __future__ import annotations

import argparse
import collections
import dataclasses
import json
import math
import os
import pathlib
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import palpate

from .. import console, options, workers
from ..console import CommandError
from ..trainee import keeping

if TYPE_CHECKING:
  from palpate.tasks.metrics import Metrics


@dataclasses.dataclass(frozen=True)
class Result:
  """One episode.

  Attributes:
    seed: of the episode
    outcome: `success`, `damage`, `missed`, `time limit` or `error`
    total: sum of rewards [-]
    time: simulated [s]
    metrics: as JSON, see `metrics.Metrics`; empty if the episode did not begin
    error: what went wrong, empty otherwise
  """

  seed: int
  outcome: str
  total: float
  time: float
  metrics: str = ""
  error: str = ""


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("task", metavar="TASK", help="such as touch/easy; a domain alone is its standard task")
  add("--policy", metavar="NAME", default="expert", help="module:object, expert, skilled...")
  add("--episodes", metavar="N", type=int, default=10, help="how many (%(default)s)")
  add("--seed", metavar="N", type=int, default=0, help="of the first episode (%(default)s)")
  workers.add_arguments(parser, 1)
  options.add_argument(parser)
  options.add_observations(parser)
  keeping.add_references(parser)
  add("--json", metavar="FILE", help="write every episode's metrics")
  add("--recordings", metavar="FOLDER", help="save the recording of every episode, complete or not")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  console.check_counts(args, "episodes")
  crew = workers.chosen(args)
  palpate.register()
  from palpate.tasks.core import performer

  known = keeping.references(args.references)
  name = options.task_name(args.task)
  with console.one_line():
    found = performer.find(args.policy)
    trained = performer.is_policy(found)
  file = console.output("json", args.json) if args.json else None
  if args.recordings:
    console.output_folder("recordings", args.recordings)
  task_kwargs = _seen(found) | options.read(args.set, args.observations)
  if task_kwargs or trained:  # what is wrong with them is said once
    env = options.environment(name, json.dumps(task_kwargs))
    with console.one_line():
      _ = performer.make(env, args.policy) if trained else None
  seeds = range(args.seed, args.seed + args.episodes)
  progress, results = console.Progress(), []
  with console.Interrupt() as interrupt:
    for result in evaluate(name, args.policy, seeds, crew, args.recordings, interrupt, task_kwargs):
      results.append(result)
      progress.show(f"{len(results)} of {args.episodes}")
  progress.clear()
  if results:
    print(table(name, args.policy, results, known(name)))
  if file is not None:
    rows = [dataclasses.asdict(r) | {"metrics": json.loads(r.metrics or "null")} for r in results]
    console.write(file, json.dumps(rows, indent=1) + "\n")
  if interrupt.seen:
    print(f"palpate: interrupted after {len(results)} of {args.episodes} episodes", file=sys.stderr)
    return 130
  errors = [r for r in results if r.outcome == "error"]
  if errors:
    raise CommandError(f"{len(errors)} episodes failed, the first: {errors[0].error}", code=1)
  return 0


def _seen(found: Any) -> dict[str, Any]:
  """Returns the options of the pictures that a policy sees."""
  pixels = list(getattr(getattr(found, "about", None), "pixels", ()))
  return {"observations": ["sensors", "pixels"], "pixels": pixels} if pixels else {}


def evaluate(
  name: str,
  policy: str,
  seeds: Sequence[int],
  crew: workers.Workers = workers.HERE,
  recordings: str | None = None,
  stop: Callable[[], bool] = lambda: False,
  task_kwargs: Mapping[str, Any] | None = None,
) -> Iterator[Result]:
  """Yields the result of each seed, in order.

  Args:
    name: of the task, such as "touch/easy"
    policy: see `performer.make`
    seeds: of the episodes
    crew: who runs them; this process by default
    recordings: folder to keep the recordings in, SEED.npz
    stop: once it says so, the episodes that run are finished and no more are begun
    task_kwargs: options of the task, JSON
  """
  kwargs = json.dumps(dict(task_kwargs or {}))
  folder = recordings and os.path.abspath(recordings)  # workers of a cluster stand elsewhere
  jobs = [(name, policy, seed, folder, kwargs) for seed in seeds]
  done = workers.parallel(perform, jobs, crew, stop)
  for seed, result in zip(seeds, done, strict=False):  # an interrupt leaves some out
    yield result or Result(seed, "error", 0.0, 0.0, error="a process died in it")


def perform(job: tuple[str, str, int, str | None, str]) -> Result:
  """Returns the result of an episode; a job is task, policy, seed, recordings' folder, options."""
  name, policy, seed, folder, kwargs = job
  palpate.register()
  from palpate.tasks.core import episode, performer

  env = options.environment(name, kwargs)
  info = {"task_kwargs": json.loads(kwargs), "performer": policy}
  try:
    recording = episode.run(env, performer.make(env, policy, seed), seed, info)
  except episode.EpisodeError as error:
    recording = error.recording
  except ValueError as error:  # the policy could not be made
    return Result(seed, "error", 0.0, 0.0, error=str(error))
  info = recording.info
  result = Result(
    seed=seed,
    outcome=info["outcome"],
    total=float(info["return"]),
    time=float(recording.time[-1]) if len(recording.time) else 0.0,
    metrics=recording.metrics().to_json(),
    error=info.get("error", ""),
  )
  try:
    if folder is not None:
      recording.save(pathlib.Path(folder) / f"{seed}.npz")
  except OSError as error:
    return dataclasses.replace(result, outcome="error", error=f"recording {seed}: {error}")
  return result


def table(name: str, policy: str, results: list[Result], reference: Mapping | None) -> str:
  """Returns mean and spread of return, time and every known metric, for people."""
  from palpate.tasks.metrics import METRICS, Metrics
  from scipy import stats

  wins = sum(r.outcome == "success" for r in results)
  share = stats.binomtest(wins, len(results)).proportion_ci(method="wilson")
  span = f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
  other = {r.outcome for r in results} - {"success"}
  counts = ", ".join(f"{k} {sum(r.outcome == k for r in results)}" for k in sorted(other))
  lines = [
    f"{name}, policy {policy}, {len(results)} episodes",
    f"success  {wins}/{len(results)} (95 % interval {span})" + (f"; {counts}" if counts else ""),
    f"{'':28} {'mean':>10} {'SD':>10} {'n':>5}",
  ]

  def row(label: str, values: list[float]) -> str:
    sd = statistics.stdev(values) if len(values) > 1 else math.nan
    return f"{label:28} {statistics.fmean(values):>10.4g} {sd:>10.3g} {len(values):>5}"

  lines.append(row("Return [-]", [r.total for r in results]))
  metrics = [Metrics.from_json(r.metrics) if r.metrics else Metrics() for r in results]
  if reference is not None:
    outcomes = [r.outcome for r in results]
    lines[2:2], scores = _proficiency(metrics, outcomes, reference)
    lines.append(row("Composite score [-]", scores))
  for key, spec in METRICS.items():
    known = [v * spec.scale for m in metrics if math.isfinite(v := getattr(m, key))]
    if known:
      lines.append(row(f"{spec.label} [{spec.shown}]", known))
  return "\n".join(lines)


def _proficiency(
  metrics: Sequence[Metrics], outcomes: Sequence[str], reference: Mapping[str, Any]
) -> tuple[list[str], list[float]]:
  """Returns the lines about proficiency, and the scores that are known."""
  from palpate.tasks.metrics import METRICS
  from palpate.tasks.people.score import CONSECUTIVE, REPEATS, score, trained

  scores = [score(m, reference, o) for m, o in zip(metrics, outcomes, strict=True)]
  passed = [s.proficient for s in scores]
  over = collections.Counter(METRICS[k].label for s in scores for k in s.over)
  rule = f"{CONSECUTIVE} in a row and {REPEATS} more"
  after = trained(passed)
  reached = f"reached after {after} episodes" if after else "not reached"
  lines = [f"proficient  {sum(passed)}/{len(passed)}; {rule}: {reached}"]
  if over:
    most = ", ".join(f"{label} {count}" for label, count in over.most_common(5))
    lines.append(f"over the limit most often: {most}")
  return lines, [s.composite for s in scores if math.isfinite(s.composite)]
