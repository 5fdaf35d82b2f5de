"""`palpate trainee show`: a person's learning curves and standing."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from ..console import CommandError, output, writing
from . import history, keeping

if TYPE_CHECKING:
  from palpate.tasks.people.limits import Lookup

  from .record import Episode


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("name", metavar="NAME", help="of the person")
  keeping.add_record(parser)
  add("--task", metavar="TASK", action="append", default=[], help="only this task; may be repeated")
  add(
    "--metric", metavar="METRIC", action="append", default=[],
    help="metric to draw, such as peak_force; may be repeated (time, path_length, peak_force)",
  )  # fmt: skip
  add("--assessments", action="store_true", help="leave out attempts with a coach")
  keeping.add_references(parser)
  add("-o", "--out", metavar="FILE", help="page to write, .html, or the plots of a task, .png")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from palpate.tasks.metrics import check_names
  from palpate.tasks.people import curves

  from .record import Record

  metrics = args.metric or curves.SHOWN
  path = output("out", args.out, (".html", ".png")) if args.out else None
  known = keeping.references(args.references)
  with keeping.one_line():
    check_names(metrics)
    record = Record(keeping.folder(args))
    person = record.find(args.name)
    episodes = record.episodes(person)
    keeping.tell(record)
  if args.references:
    episodes = history.judged(episodes, known)
  then = _next(episodes)
  attempts = history.attempts(episodes, args.assessments)
  if absent := [task for task in args.task if task not in attempts]:
    done = ", ".join(attempts) or "nothing"
    raise CommandError(f"task is {absent[0]!r}, {person.name!r} has done {done}")
  shown = {task: attempts[task] for task in args.task or attempts}
  print(summary(f"{person.name}, {then}", shown))
  if path is None:
    return 0
  try:
    if path.suffix.lower() == ".png":
      data = _picture(shown, known, metrics)
    else:
      data = page(person.name, then, shown, known, metrics).encode()
  except ImportError as error:
    raise CommandError(f"{error}; install palpate[plot]", code=1) from None
  with writing(path):
    path.write_bytes(data)
    path.chmod(0o600)
  print(path)
  return 0


def summary(head: str, shown: Mapping[str, Sequence[Episode]]) -> str:
  """Returns the standing in words, for a terminal."""
  lines = [head]
  if shown:
    lines.append(f"{'':22} attempts success proficient")
  for task, done in shown.items():
    wins, good = (sum(e.outcome == "success" for e in done), sum(e.proficient for e in done))
    rule, chart = standing(done)
    lines.append(f"{task:22} {len(done):>8} {wins:>7} {good:>10}  {rule}; {chart}")
  return "\n".join(lines)


def standing(done: Sequence[Episode]) -> tuple[str, str]:
  """Returns how far a person is by the rule of proficiency, and by the CUSUM."""
  from palpate.tasks.people import curriculum, cusum, score

  passed = [e.proficient for e in done]
  after = score.trained(passed)
  more = curriculum.left(passed)
  rule = f"rule met after {after}" if after else f"{more} more proficient meet the rule"
  points = cusum.chart(passed)
  crossed = [k + 1 for k, point in enumerate(points) if point.changed]
  if not crossed:
    return rule, f"CUSUM {points[-1].value:.2g} of {cusum.LIMIT:g}"
  word = "competent since" if points[-1].competent else "competence lost at"
  return rule, f"CUSUM: {word} attempt {crossed[-1]}"


def _next(episodes: Sequence[Episode]) -> str:
  """Returns what to do next, in words, and what was interrupted."""
  from palpate.tasks.people import curriculum
  from palpate.tasks.recording import INTERRUPTED

  met = curriculum.done(history.passed(episodes))
  then = curriculum.following(met)
  cut_off = sum(e.outcome == INTERRUPTED for e in episodes)
  said = f"exercises done: {len(met)}, " + (f"next is {then}" if then else "nothing is left")
  return f"{said}; {cut_off} interrupted, not counted" if cut_off else said


def _picture(
  shown: Mapping[str, Sequence[Episode]], known: Lookup, metrics: Sequence[str]
) -> bytes:
  """Returns the plots of the one task that is shown, PNG."""
  from palpate.tasks.people import curves, plots

  if len(shown) != 1:
    tasks = ", ".join(shown) or "nothing"
    raise CommandError(f"out is a .png, which shows one --task; there is {tasks}")
  ((task, done),) = shown.items()
  return plots.png(curves.learning_figure(done, known(task), metrics))


def page(
  name: str,
  then: str,
  shown: Mapping[str, Sequence[Episode]],
  known: Lookup,
  metrics: Sequence[str],
) -> str:
  """Returns the page.

  Args:
    name: of the person
    then: what is next, in words
    shown: task -> attempts
    known: what finds the references of tasks
    metrics: names of those that are drawn
  """
  from palpate.tasks.people import curriculum, curves, cusum, page, plots

  body = [f"<h1>{page.text(name)}</h1>", f"<p class='outcome'>{page.text(then)}</p>"]
  rows = []
  for task, done in shown.items():
    wins, good = (sum(e.outcome == "success" for e in done), sum(e.proficient for e in done))
    cells = [task, str(len(done)), str(wins), str(good), *standing(done)]
    rows.append(page.row(map(page.text, cells), (1, 2, 3)))
  head = ["exercise", "attempts", "success", "proficient", "rule of proficiency", "CUSUM"]
  body.append(page.table(head, rows, (1, 2, 3)))
  for task, done in shown.items():
    picture = plots.png(curves.learning_figure(done, known(task), metrics))
    body.append(f"<h2>{page.text(task)}</h2>")
    body.append(page.image(picture, f"score, metrics and CUSUM over attempts at {task}"))
  rates = f"{100 * cusum.ACCEPTABLE:g} % and {100 * cusum.UNACCEPTABLE:g} %"
  risk, find = (100 * cusum.chance(p, 30) for p in (cusum.UNACCEPTABLE, cusum.ACCEPTABLE))
  body.append(
    "<p class='small faint'>Score: 0 is the mean of skilled people, one is a standard deviation. "
    "Proficient is a success within every limit. Rule of proficiency: "
    f"{curriculum.RULE} (Ritter and Scott 2007). CUSUM: the learning-curve CUSUM of Biau et al. "
    f"2008, then the CUSUM of Bolsin and Colson 2000; an attempt fails unless it is proficient; "
    f"acceptable and unacceptable failure rates are {rates}, decision limits ±{cusum.LIMIT:g}. Who "
    f"fails at the unacceptable rate is called competent within 30 attempts with a chance of "
    f"{risk:.2g} %, who fails at the acceptable one with {find:.2g} %.</p>"
  )
  return page.document(f"{name}: learning curves", body)
