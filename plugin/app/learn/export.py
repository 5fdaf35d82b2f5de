"""`palpate export`: makes a data set of demonstrations, new ones or of recordings.

Every episode is kept in FOLDER.part as soon as it ends, whole or not at all, and what is there is
not run again with --resume. When all are there the data set is made of them and takes the name
FOLDER; nothing of that name is ever half a data set.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import pathlib
import shlex
import shutil
import sys
from collections.abc import Sequence
from typing import Any

import palpate

from .. import console, datasets, options, workers
from ..console import CommandError
from ..panel import fingerprint

_JOB = "job.json"
_LICENCE = "Apache-2.0"  # of episodes of scripts, as of Palpate


@dataclasses.dataclass(frozen=True)
class Kept:
  """An episode that has ended.

  Attributes:
    name: that it is spoken of by
    outcome: how it ended; None where it is not kept
    steps: how many control steps it took
    why: it is not kept
  """

  name: str
  outcome: str | None
  steps: int = 0
  why: str = ""


@dataclasses.dataclass(frozen=True)
class Job:
  """An episode to be made, or to be made again.

  Attributes:
    task: such as "touch/easy"
    performer: see `performer.make`
    kwargs: options of the exercise, JSON
    seed: of the episode, where there is no recording
    recording: path of one, or empty
    path: where the episode is kept
    noise: see `demonstrations.perform`
  """

  task: str
  performer: str
  kwargs: str
  seed: int
  recording: str
  path: str
  noise: float = 0.0

  @property
  def name(self) -> str:
    """What people know the episode by."""
    return self.recording or f"seed {self.seed}"


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("task", metavar="TASK", nargs="?", help="such as touch/easy; a domain alone is its standard")
  add("-o", "--out", metavar="FOLDER", required=True, help="of the data set; it must be new")
  add("--format", choices=datasets.FORMATS, default="robomimic", help="(%(default)s)")
  add("--performer", metavar="NAME", default="expert", help="as evaluate's policy (%(default)s)")
  add("--episodes", metavar="N", type=int, default=10, help="how many (%(default)s)")
  add("--seed", metavar="N", type=int, default=0, help="of the first episode (%(default)s)")
  add(
    "--noise", metavar="SD", type=float, default=0.0,
    help="add noise to the instrument's motion; the stored actions are without it (%(default)s)",
  )  # fmt: skip
  add(
    "--recordings", metavar="PATH", nargs="+",
    help="recordings, or folders of them, instead of new episodes",
  )  # fmt: skip
  add(
    "--observations", metavar="NAME", nargs="+", default=["sensors", "state"],
    help="groups (sensors, state), pictures (pixels, ...) and single ones (sensors state)",
  )  # fmt: skip
  add("--size", metavar="HxW", help="of pictures [pixels] (84x84)")
  add(
    "--renderer", metavar="NAME",
    help="what draws pictures: opengl, or a device, cpu or cuda:0, which needs no OpenGL (opengl)",
  )  # fmt: skip
  options.add_argument(parser)
  add("--failures", action="store_true", help="include episodes without success, marked as such")
  add("--licence", metavar="NAME", help=f"of the data ({_LICENCE}; unknown for recordings)")
  add("--resume", action="store_true", help="continue with the episodes in FOLDER.part")
  workers.add_arguments(parser, os.cpu_count() or 1)


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  console.check_counts(args, "episodes")
  if not 0 <= args.noise <= 1:
    raise CommandError(f"noise is {args.noise}, expected a number in [0, 1]")
  crew = workers.chosen(args)
  console.need(*datasets.FORMATS[args.format])
  palpate.register()
  task, kwargs, todo = _todo(args)
  out = pathlib.Path(args.out)
  if out.exists() and (not out.is_dir() or any(out.iterdir())):
    raise CommandError(f"out is {args.out!r}, which exists, expected a new folder")
  parts = out.with_name(out.name + ".part").absolute()
  jobs = _jobs(args, task, kwargs, todo, parts)
  _begin(parts, args, task, kwargs)
  kept, seen = _run(jobs, crew)
  if seen:
    done = f"{len(kept)} of {len(jobs)} episodes"
    print(f"palpate: interrupted after {done}; go on with --resume", file=sys.stderr)
    return 130
  about = datasets.About(task, kwargs, *_who(args), _command(args))
  lines = _assemble(out, parts, args, about, list(zip(jobs, kept, strict=True)))
  print("\n".join(lines))
  return 0


def _who(args: argparse.Namespace) -> tuple[str, str]:
  """Returns who did it, and the licence."""
  if args.recordings:
    return "recordings", args.licence or "unknown"
  return args.performer, args.licence or _LICENCE


def _command(args: argparse.Namespace) -> str:
  words = ["palpate", "export", args.task or "", "--format", args.format]
  if not args.recordings:
    words += ["--performer", args.performer, "--episodes", args.episodes, "--seed", args.seed]
    words += ["--noise", args.noise] if args.noise else []
  words += ["--observations", *args.observations]
  words += ["--size", args.size] if args.size else []
  words += ["--renderer", args.renderer] if args.renderer else []
  words += [word for text in args.set for word in ("--set", text)]
  return shlex.join(str(word) for word in words if word != "")


def _todo(args: argparse.Namespace) -> tuple[str, dict[str, Any], list[tuple[str, dict]]]:
  """Returns task, options, and the recordings with their own options; all are checked."""
  from palpate.tasks.core import performer

  chosen: dict[str, Any] = {"observations": args.observations}
  if args.size:
    chosen["pixels"] = _size(args.size)
  if args.renderer:
    chosen["renderer"] = args.renderer
  kwargs, found = options.read(args.set), []
  with console.one_line(OSError):
    if args.recordings:
      if args.task or args.set or args.noise:
        raise ValueError("recordings have a task, options and actions of their own, expected none")
      task, kwargs, found = _recordings(args.recordings)
    elif args.task:
      task = options.task_name(args.task)
      performer.find(args.performer)
    else:
      raise ValueError("neither TASK nor --recordings is given")
    kwargs = kwargs | chosen if args.recordings else chosen | kwargs
    env = options.environment(task, json.dumps(kwargs))
    datasets.of(args.format).check(env)
  _check_drawing(env)
  return task, kwargs, [(path, own | chosen) for path, own in found]


def _check_drawing(env: Any):
  if not env.task.observed.pictures or env.task.renderer != "opengl":
    return
  try:
    env.physics.render(16, 16)
  except Exception as error:  # each backend of OpenGL has its own
    text = f"{type(error).__name__}: {error}"
    raise CommandError(f"no way to draw pictures ({text}); see palpate doctor", code=1) from None


def _size(text: str) -> list[int]:
  height, x, width = text.partition("x")
  if not (x and height.isdigit() and width.isdigit()):
    raise CommandError(f"size is {text!r}, expected height and width such as 96x128")
  return [int(height), int(width)]


def _recordings(names: Sequence[str]) -> tuple[str, dict[str, Any], list[tuple[str, dict]]]:
  """Returns the task of recordings, the options of the first, and all with their options."""
  from palpate.tasks.recording import Recording

  paths = []
  for path in map(pathlib.Path, names):
    paths += sorted(path.rglob("*.npz")) if path.is_dir() else [path]
  if not paths:
    raise ValueError(f"recordings: no .npz in {', '.join(names)}")
  infos = [Recording.load(path).info for path in paths]
  for path, info in zip(paths, infos, strict=True):
    if not isinstance(info.get("task_kwargs"), dict) or not isinstance(info.get("task"), str):
      raise ValueError(f"{path}: the recording is not one of an exercise")
  kinds = [(info["task"], info["task_kwargs"].get("input", "drives")) for info in infos]
  for path, (task, way) in zip(paths, kinds, strict=True):
    if (task, way) != kinds[0]:
      raise ValueError(f"{path} is of {task}, by {way}, expected {kinds[0][0]}, by {kinds[0][1]}, "
                       "as in the first one")  # fmt: skip
  own = [info["task_kwargs"] for info in infos]
  names = [str(path.absolute()) for path in paths]
  return kinds[0][0], own[0], list(zip(names, own, strict=True))


def _jobs(
  args: argparse.Namespace,
  task: str,
  kwargs: dict[str, Any],
  todo: list[tuple[str, dict]],
  parts: pathlib.Path,
) -> list[Job]:
  if todo:
    names = [hashlib.sha256(pathlib.Path(path).read_bytes()).hexdigest()[:16] for path, _ in todo]
    return [
      Job(task, "", json.dumps(own), 0, path, str(parts / f"{name}.npz"))
      for name, (path, own) in zip(names, todo, strict=True)
    ]
  seeds, options_ = range(args.seed, args.seed + args.episodes), json.dumps(kwargs)
  paths = [str(parts / f"{seed:08d}.npz") for seed in seeds]
  return [
    Job(task, args.performer, options_, seed, "", path, args.noise)
    for seed, path in zip(seeds, paths, strict=True)
  ]


def _begin(parts: pathlib.Path, args: argparse.Namespace, task: str, kwargs: dict[str, Any]):
  """Makes the folder of episodes, or checks that what is there is of this job."""
  mine = {
    "task": task, "performer": _who(args)[0], "options": kwargs, "noise": args.noise,
    "sources": fingerprint(),
  }  # fmt: skip
  mine, path = json.loads(json.dumps(mine)), parts / _JOB
  if path.exists():
    if not args.resume:
      raise CommandError(f"out has {str(parts)!r}, expected --resume or another folder")
    theirs = json.loads(path.read_text(encoding="utf-8"))
    for key, value in mine.items():
      if theirs.get(key) != value:
        raise CommandError(f"resume: {str(parts)!r} has {key} {theirs.get(key)}, not {value}")
    for left in parts.glob(".*.part"):  # by a process that was ended
      left.unlink()
    return
  console.output_folder("out", parts)
  console.write(path, json.dumps(mine, indent=1))


def _run(jobs: list[Job], crew: workers.Workers) -> tuple[list[Kept], bool]:
  """Runs the jobs; returns what came of them, and whether it was interrupted."""
  progress, kept = console.Progress(), []
  with console.Interrupt() as interrupt:
    try:
      for job, done in zip(jobs, workers.parallel(keep, jobs, crew, interrupt), strict=False):
        kept.append(done or Kept(job.name, None, why="a process died in it"))
        progress.show(f"{len(kept)} of {len(jobs)} episodes")
    except CommandError as error:
      progress.clear()
      raise CommandError(f"{error}; {len(kept)} of {len(jobs)} episodes are done, go on with "
                         "--resume", code=1) from None  # fmt: skip
  progress.clear()
  return kept, len(kept) < len(jobs)


def keep(job: Job) -> Kept:
  """Makes an episode and keeps it, unless it is there."""
  palpate.register()
  from palpate.tasks.core import episode, performer
  from palpate.tasks.learn import demonstrations
  from palpate.tasks.recording import Recording

  path = pathlib.Path(job.path)
  if path.exists():
    demo = demonstrations.Demonstration.load(path)
    return Kept(job.name, demo.info["outcome"], len(demo))
  env = options.environment(job.task, job.kwargs)
  try:
    if job.recording:
      demo = demonstrations.repeat(env, Recording.load(job.recording))
    else:
      info = {"task_kwargs": json.loads(job.kwargs), "performer": job.performer}
      act = performer.make(env, job.performer, job.seed)
      demo = demonstrations.perform(env, act, job.seed, info, job.noise)
  except (ValueError, OSError, episode.EpisodeError) as error:
    return Kept(job.name, None, why=str(error))
  if not len(demo):
    return Kept(job.name, None, why="it has no steps")
  steps, outcome = len(demo), demo.info["outcome"]
  with console.writing(path):
    demo.save(path)
  return Kept(job.name, outcome, steps)


def _assemble(
  out: pathlib.Path,
  parts: pathlib.Path,
  args: argparse.Namespace,
  about: datasets.About,
  done: list[tuple[Job, Kept]],
) -> list[str]:
  """Makes the data set, puts it in place, and returns what is said of it."""
  good = [(j, k) for j, k in done if k.outcome == "success" or (k.outcome and args.failures)]
  left = [f"{k.name} ({k.outcome or k.why})" for j, k in done if (j, k) not in good]
  if not good:
    raise CommandError(f"no episode succeeded, the first: {left[0]}; --failures takes them", code=1)
  folder = parts / "dataset"
  with console.writing(out):
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
      form = datasets.of(args.format)
      without = form.write(folder, [pathlib.Path(job.path) for job, _ in good], about)
    except ValueError as error:
      raise CommandError(f"out: {error}", code=1) from None
    lines = _lines(args, about, [kept for _, kept in good], left, without)
    card = datasets.card(about, args.format, lines, pathlib.Path(good[0][0].path))
    (folder / "README.md").write_text(card, encoding="utf-8")
    os.replace(folder, out)
    shutil.rmtree(parts)
  return [str(out), *lines]


def _lines(
  args: argparse.Namespace,
  about: datasets.About,
  good: list[Kept],
  left: list[str],
  without: list[str],
) -> list[str]:
  """Returns what is in the data set and what is not."""
  lines = [f"{len(good)} episodes of {about.task}, {sum(k.steps for k in good)} steps, by "
           f"{about.performer}; licence {about.licence}"]  # fmt: skip
  if not args.recordings:
    lines.append(f"seeds {args.seed} to {args.seed + args.episodes - 1}")
  failed = [f"{k.name} ({k.outcome})" for k in good if k.outcome != "success"]
  if failed:
    lines.append(f"without success: {', '.join(failed)}")
  if left:
    lines.append(f"left out: {', '.join(left)}")
  without = ["events, metrics and the organ's surface, which recordings have", *without]
  if args.recordings and about.task_kwargs.get("input") == "handle":
    without.insert(0, "a hand's path between two control steps")
  lines.append(f"not in it: {'; '.join(without)}")
  return lines
