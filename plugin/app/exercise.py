"""`palpate exercise`: runs one exercise, records it and writes its report."""

import argparse
import contextlib
import dataclasses
import functools
import pathlib
import sys
from collections.abc import Callable
from typing import Any

import palpate

from . import console, options
from .console import CommandError
from .draw import film
from .trainee import keeping


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("task", metavar="TASK", nargs="?", help="such as touch/easy; a domain alone is its standard")
  add("--list", action="store_true", help="list the exercises and performers")
  add(
    "--performer", metavar="NAME", help="expert, tremor, ..., or a policy as module:object (expert)"
  )
  add(
    "--device", metavar="NAME",
    help="do it live with a device: mouse, keyboard or touch on a page; gamepad, spacemouse, udp, "
    "openhaptics, forcedimension, haply, hand",
  )  # fmt: skip
  add("--left", metavar="NAME", help="device of the other hand, in an exercise for two hands")
  add("--scale", metavar="X", type=float, default=1.0, help="of a device's movements (%(default)s)")
  add("--seed", metavar="N", type=int, default=0, help="of the episode (%(default)s)")
  add("--replay", metavar="FILE", help="replay a recording and check that the result is the same")
  add(
    "-o", "--out", metavar="FOLDER",
    help="folder of recording and report (out/TASK; out/TASK_replay; with --trainee only "
    "the record)",
  )  # fmt: skip
  add("--film", metavar="FILE", help="write a film too, .mp4 or .gif")
  add("--size", metavar="WxH", default="640x480", help="of the film [pixels] (%(default)s)")
  options.add_argument(parser)
  keeping.add_arguments(parser)
  add("--states", action="store_true", help="store the state of every step in the recording")
  add("--no-report", action="store_true", help="write no report")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  if not args.list and not args.task and not args.replay:
    raise CommandError("no TASK; `palpate exercise --list` lists them")
  palpate.register()
  from palpate.tasks.core import episode

  if args.list:
    return _list()
  _check_who(args)
  if args.device:
    from .live.devices import registry

    with console.one_line():
      if registry.on_page(args.device):
        return _page(args)
      if args.left and registry.on_page(args.left):
        raise ValueError(f"left is {args.left!r}, which is on a page as --device alone")
  job = _prepare(args)
  progress, failure, views = console.Progress(), None, _views(args, job)
  camera = contextlib.nullcontext(views)
  if job.film:
    camera = film.laparoscope(job.film, job.size)
  with console.Interrupt() as interrupt, camera as shoot:

    def watch(env) -> bool:
      progress.show(f"{job.name} {env.physics.time():.1f} s, {100 * env.task.best:.0f} % done")
      if shoot is not None:
        shoot(env)
      return interrupt.seen

    try:
      recording = job.run(watch)
    except episode.EpisodeError as error:
      recording, failure = error.recording, error
    finally:
      progress.clear()
  fault = _write(job, recording, not args.no_report, views)
  if "live" in recording.info:
    live = recording.info["live"]
    print(
      f"steps      {100 * live['on_time']:.2f} % on time, 99 % within {live['p99_us']:.0f} us; "
      f"{live['work_us']:.0f} us of work each"
    )
    print("\n".join(f"palpate: {fault}" for fault in live["faults"]), end="", file=sys.stderr)
  if interrupt.seen:
    print("palpate: interrupted; the recording up to there is kept", file=sys.stderr)
    return 130
  if failure is not None:
    raise CommandError(str(failure), code=1)
  if fault:
    raise CommandError(fault, code=1)
  if job.old is not None:
    changed = episode.differences(job.old, recording)
    if changed:
      raise CommandError(f"the replay differs in {', '.join(changed)}", code=1)
    print("the replay is the same to the bit")
  return 0


def _check_who(args: argparse.Namespace):
  """Raises CommandError where the options contradict each other."""
  if args.device and not args.task:
    raise CommandError("device is given without a TASK; a replay takes no device")
  if args.left and not args.device:
    raise CommandError(f"left is {args.left!r} without --device NAME, that of the main hand")
  if args.device and args.performer:
    raise CommandError(f"performer is {args.performer!r} and device is {args.device!r}, expected "
                       "one of them")  # fmt: skip
  if args.trainee is None or args.replay:
    return
  if not (args.device or args.performer):
    raise CommandError(
      f"trainee is {args.trainee!r} without --device NAME: the expert's script would act under "
      "that name; --performer expert if that is meant"
    )
  if args.set:
    raise CommandError(
      f"set is {args.set[0]!r} with --trainee: an attempt is at the exercise as it is"
    )


def _page(args: argparse.Namespace) -> int:
  """Opens the page on the exercise."""
  if args.left:
    raise CommandError(f"left is {args.left!r} with --device {args.device}: the page asks for it")
  from . import serve

  name = options.task_name(args.task)
  for option in ("set", "film", "states"):
    if getattr(args, option):
      raise CommandError(f"{option} is given with --device {args.device}, whose page has none")
  kept = keeping.read(args, name, pages=True)
  out = pathlib.Path(args.out or "out/live")
  return serve.run(out, device=args.device, task=name, kept=kept)


def _list() -> int:
  from palpate.tasks import suite
  from palpate.tasks.core import performer

  for domain, task in suite.ALL_TASKS:
    print(f"{f'{domain}/{task}':24} {suite.summary(domain, task)}")
  names = (*performer.STYLES, *performer.PEOPLE, "trained", "module:object")
  print(f"performers: {', '.join(names)}")
  return 0


@dataclasses.dataclass(frozen=True)
class _Job:
  """What is run, and where its files go.

  Attributes:
    name: of the task
    seed: of the episode
    run: runs it and returns its recording; takes what is called after every step
    old: the recording that is replayed, None for a new one
    folder: of the files, None where they are in a record alone
    film: file of the film, None without one
    size: its width and height [pixels]
    references: what finds the references of tasks
    sitting: of a record, None without one
    path: of the file in it
  """

  name: str
  seed: int
  run: Callable[[Callable[[Any], bool]], Any]
  old: Any
  folder: pathlib.Path | None
  film: pathlib.Path | None
  size: tuple[int, int]
  references: Any
  sitting: keeping.Sitting | None
  path: pathlib.Path | None


def _prepare(args: argparse.Namespace) -> _Job:
  """Returns the job, everything that can be wrong with it checked."""
  old, sitting, path = None, None, None
  references = keeping.references(args.references)
  with console.one_line(OSError):
    if args.replay:
      if args.trainee is not None:
        raise CommandError("trainee is given with --replay, which is no attempt")
      old, run = _replay(args.replay)
      name, seed = old.info["task"], old.info["seed"]
    else:
      name, seed, info = options.task_name(args.task), args.seed, {}
      if kept := keeping.read(args, name):
        sitting = kept.begin()
        path, info = sitting.reserve(name)
      run = _perform(args, name, info, path)
  folder = None
  if args.out or not sitting:
    default = f"out/{name.replace('/', '_')}{'_replay' if old else ''}"
    folder = console.output_folder("out", pathlib.Path(args.out or default))
  if old and folder and (folder / "recording.npz").resolve() == pathlib.Path(args.replay).resolve():
    raise CommandError(f"out is {str(folder)!r}, the folder of the recording that is replayed")
  shot = console.output("film", args.film, film.FILMS) if args.film else None
  if shot:
    film.check(shot.suffix)
  size = film.size(args.size)
  return _Job(name, seed, run, old, folder, shot, size, references, sitting, path)


def _replay(path: str):
  """Returns a recording, and what runs it again."""
  from palpate.tasks.core import episode
  from palpate.tasks.recording import Recording

  old = Recording.load(path)
  env = episode.environment(old)
  return old, lambda watch: episode.replay(old, watch, env)


def _perform(
  args: argparse.Namespace, name: str, info: dict[str, Any], journal: pathlib.Path | None
):
  """Returns what runs an episode of a task."""
  from palpate.tasks.core import episode, performer

  task_kwargs = options.read(args.set)
  if args.device:
    return _by_hand(args, name, task_kwargs, info, journal)
  who = args.performer or "expert"
  info = {"task_kwargs": task_kwargs, "performer": who, **info}
  performer.find(who)
  env = options.load(name, task_kwargs)
  act = performer.make(env, who, args.seed)
  return functools.partial(episode.run, env, act, args.seed, info, args.states, journal=journal)


def _by_hand(
  args: argparse.Namespace,
  name: str,
  task_kwargs: dict[str, Any],
  info: dict[str, Any],
  journal: pathlib.Path | None,
):
  """Returns what runs an episode of a task with a device."""
  from palpate.tasks import suite

  from . import live

  task_kwargs = {"observations": ["joints"], **task_kwargs, "input": suite.by_hand(name)}
  env = options.load(name, task_kwargs)
  try:
    device, coupled = live.device(args.device), live.Options(scale=args.scale)
    other = live.device(args.left) if args.left else None
  except live.DeviceError as error:
    raise CommandError(str(error), code=1) from None
  info = {"task_kwargs": task_kwargs, **info}
  session = live.Session(env, device, args.seed, info, coupled, other=other, journal=journal)
  return lambda watch: session.run(watch=watch)


def _views(args: argparse.Namespace, job: _Job) -> film.Strip | None:
  """Returns what takes the report's pictures; None where a person would wait for them."""
  wanted = job.folder and not (args.no_report or job.film or args.device)
  return film.Strip() if wanted else None


def _write(job: _Job, recording: Any, report: bool, views: film.Strip | None) -> str:
  """Writes recording, metrics and report, says where they are, and returns what went wrong."""
  end = recording.time[-1] if len(recording.time) else 0.0
  print(f"{job.name}, seed {job.seed}: {recording.info['outcome']} after {end:.2f} s")
  if job.folder:
    _write_files(job, job.folder, recording, report, views)
  if job.film:
    print(f"film       {job.film}")
  if job.sitting is None:
    return ""
  kept = job.sitting.keep(recording, path=job.path)
  print(f"recording  {kept.path or 'lost'}")
  print("\n".join(kept.said), end="\n" * bool(kept.said))
  return kept.fault


def _write_files(
  job: _Job, folder: pathlib.Path, recording: Any, report: bool, views: film.Strip | None
) -> None:
  """Writes recording, metrics and report to a folder."""
  from palpate.tasks.files import replacing
  from palpate.tasks.people.report import write_report

  with console.writing(folder):
    print(f"recording  {recording.save(folder / 'recording.npz')}")
    with replacing(folder / "metrics.json") as file:
      file.write(recording.metrics().to_json(1) + "\n")
    if report and len(recording.time):
      shot = job.film.read_bytes() if job.film and job.film.suffix == ".mp4" else None
      pictures = None if views is None else views.pictures()
      try:
        reference = job.references(job.name)
        page = write_report(recording, folder, reference, film=shot, pictures=pictures)
        print(f"report     {page}")
      except ImportError as error:
        print(f"no report: {error}; install palpate[plot]", file=sys.stderr)
