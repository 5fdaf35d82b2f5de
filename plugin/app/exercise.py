"""`palpate exercise`: runs one exercise, records it and writes its report."""

from __future__ import annotations

import argparse
import math
import pathlib
import sys
from typing import Any

import numpy as np
import palpate

from .console import CommandError, Interrupt, Progress

_KEYS = {  # GLFW key -> component, sign
  265: ("pitch", 1.0),  # up
  264: ("pitch", -1.0),  # down
  262: ("yaw", 1.0),  # right
  263: ("yaw", -1.0),  # left
  ord("W"): ("insertion", -1.0),
  ord("S"): ("insertion", 1.0),
  ord("A"): ("roll", -1.0),
  ord("D"): ("roll", 1.0),
  ord("O"): ("jaw", 1.0),
  ord("C"): ("jaw", -1.0),
  ord("R"): ("report", 1.0),
}
_HOLD = 0.15  # a key acts for this long [s]


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.epilog = (
    "Keys with --performer keyboard: arrows pitch and yaw, W out, S in, A and D roll, O opens and "
    "C closes the jaws, R reports, Esc ends."
  )
  add = parser.add_argument
  add("task", metavar="TASK", nargs="?", help="such as touch/easy; a domain alone is its standard")
  add("--list", action="store_true", help="list the exercises and performers")
  add(
    "--performer", metavar="NAME", default="expert",
    help="expert, tremor, ..., keyboard, or a policy as module:object",
  )  # fmt: skip
  add("--seed", metavar="N", type=int, default=0, help="of the episode (%(default)s)")
  add("--replay", metavar="FILE", help="repeat a recording and check that it comes out the same")
  add("-o", "--out", metavar="FOLDER", help="where recording and report go (out/TASK)")
  add("--film", metavar="FILE", help="write a film too, .mp4 or .gif")
  add("--states", action="store_true", help="keep the state of every step in the recording")
  add("--no-report", action="store_true", help="write the recording alone")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  if not args.list and not args.task and not args.replay:
    raise CommandError("no TASK; `palpate exercise --list` lists them")
  palpate.register()
  from palpate.tasks import episode, experts, suite
  from palpate.tasks.recording import Recording

  if args.list:
    for domain, task in suite.ALL_TASKS:
      print(f"{f'{domain}/{task}':24} {suite.summary(domain, task)}")
    print(f"performers: {', '.join(experts.STYLES)}, keyboard, module:object")
    return 0
  old = None
  try:
    if args.replay:
      old = Recording.load(args.replay)
      env = episode.environment(old)
      name, seed, options = old.info["task"], old.info["seed"], old.info["task_kwargs"]
    else:
      name, seed, options = "/".join(suite.split(args.task)), args.seed, {}
      if ":" in args.performer:
        episode.find(args.performer)
      elif args.performer not in (*experts.STYLES, "keyboard"):
        names = ", ".join(experts.STYLES)
        raise ValueError(
          f"performer is {args.performer!r}, expected {names}, keyboard or module:object"
        )
      env = suite.load(*suite.split(name), task_kwargs=options)
  except (ValueError, OSError) as error:
    raise CommandError(str(error)) from None
  folder = pathlib.Path(args.out or pathlib.Path("out") / name.replace("/", "_"))
  info = {"task_kwargs": options, "performer": "replay" if old else args.performer}
  progress, code, failure = Progress(), 0, None
  film = _Film(args.film) if args.film else None
  with Interrupt() as interrupt:

    def watch(env) -> bool:
      task: Any = env.task
      progress.show(f"{name} {env.physics.time():.1f} s, {100 * task.best:.0f} % done")
      if film:
        film.take(env)
      return interrupt.seen

    try:
      if old is not None:
        recording, env = episode.replay(old, watch)
      elif args.performer == "keyboard":
        recording = _keyboard(env, seed, info, watch)
      else:
        act = episode.performer(args.performer, env, seed)
        recording = episode.run(env, act, seed, info, args.states, watch)
    except episode.EpisodeError as error:
      recording, failure, code = error.recording, error, 1
    finally:
      progress.clear()
      if film:
        film.close()
  folder.mkdir(parents=True, exist_ok=True)
  path = recording.save(folder / "recording.npz")
  (folder / "metrics.json").write_text(recording.metrics().to_json(1) + "\n", encoding="utf-8")
  end = recording.time[-1] if len(recording.time) else 0.0
  print(f"{name}, seed {seed}: {recording.info['outcome']} after {end:.2f} s")
  print(f"recording  {path}")
  if not args.no_report and len(recording.time):
    from palpate.tasks.report import write_report

    try:
      print(f"report     {write_report(recording, folder, episode.reference(name))}")
    except ImportError as error:
      print(f"no report: {error}; install palpate[plot]", file=sys.stderr)
  if film:
    print(f"film       {args.film}")
  if failure is not None:
    raise CommandError(str(failure), code=1)
  if old is not None:
    changed = episode.differences(old, recording)
    if changed:
      raise CommandError(f"the replay differs in {', '.join(changed)}", code=1)
    print("the replay is the same to the bit")
  return 130 if interrupt.seen else code


class _Film:
  """Writes the laparoscope's picture at 25 frames a second."""

  def __init__(self, path: str):
    suffix = pathlib.Path(path).suffix.lower()
    if suffix not in (".mp4", ".gif"):
      raise CommandError(f"film is {path!r}, expected a name that ends in .mp4 or .gif")
    try:
      import imageio.v2 as imageio
    except ImportError:
      raise CommandError("a film needs imageio; install palpate[video]", code=1) from None
    options: Any = {"fps": 25, "macro_block_size": 8} if suffix == ".mp4" else {"duration": 40}
    self._writer = imageio.get_writer(path, **options)
    self._next = -math.inf

  def take(self, env) -> None:
    if env.physics.time() >= self._next - 1e-9:
      self._next = env.physics.time() + 0.04
      camera = env.physics.model.ptr.camera("laparoscope").id
      self._writer.append_data(env.physics.render(480, 640, camera_id=camera))

  def close(self) -> None:
    self._writer.close()


def _keyboard(env, seed: int, info, watch):
  """Runs an episode with the keyboard in MuJoCo's viewer, in real time."""
  import time

  from palpate.tasks import episode, viewer

  names = env.task.components
  pressed: dict[str, tuple[float, float]] = {}  # component -> sign, until
  jaw = [0.0]

  def key(code: int) -> None:
    if code in _KEYS:
      component, sign = _KEYS[code]
      if component == "jaw":
        jaw[0] = float(np.clip(jaw[0] + 0.1 * sign, -1, 1))
      else:
        pressed[component] = sign, time.monotonic() + _HOLD

  # The episode starts with the first step; the window needs the model that it will have.
  env.task.random = np.random.RandomState(seed)
  env.reset()
  try:
    window = viewer.launch(env.physics, key)
  except RuntimeError as error:
    raise CommandError(f"{error}; use another performer", code=1) from None
  with window:
    look = window.opt.flags.copy(), window.user_scn.flags.copy()
    due = [time.monotonic()]

    def act(_) -> np.ndarray:
      now = time.monotonic()
      action = [
        jaw[0] if name == "jaw" else pressed[name][0] if pressed.get(name, (0, 0))[1] > now else 0.0
        for name in names
      ]
      return np.array(action)

    def step(env) -> bool:
      with window.lock():  # most letters are switches of the viewer too
        window.opt.flags[:], window.user_scn.flags[:] = look
      window.sync()
      due[0] += env.control_timestep()
      time.sleep(max(0.0, due[0] - time.monotonic()))
      return watch(env) or not window.is_running()

    return episode.run(env, act, seed, info, watch=step)
