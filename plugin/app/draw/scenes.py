"""What `palpate view` and `palpate render` share: the scene that is asked for."""

import argparse
import pathlib
from collections.abc import Callable

import mujoco

from ..console import CommandError, compile_error
from ..press import command

# Model, data, and what steps them to a time [s]; that returns whether there is more to come.
Shown = tuple[mujoco.MjModel, mujoco.MjData, Callable[[float], bool]]


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options that choose a scene."""
  from palpate import models

  parser.add_argument(
    "scene", metavar="SCENE",
    help=f"{', '.join(models.NAMES)}, abdomen or press; an exercise such as touch/easy; an MJCF "
    "file; a folder with a scene.xml",
  )  # fmt: skip
  parser.add_argument(
    "--nodes", metavar="N", type=int,
    help=f"resolution of a named organ, {' or '.join(map(str, models.RESOLUTIONS))}",
  )  # fmt: skip
  parser.add_argument("--seed", metavar="N", type=int, help="variant of a named organ's shape")
  parser.add_argument(
    "--instruments", metavar="NAMES",
    help=f"of a named organ, separated by commas ({','.join(models.INSTRUMENTS)})",
  )  # fmt: skip
  parser.add_argument(
    "--coupling", choices=("nodal", "window"),
    help="of a named organ; window: MuJoCo has only the nodes near the instruments (nodal)",
  )  # fmt: skip
  parser.add_argument("--keyframe", metavar="NAME", help="state to start from (the first keyframe)")


def load(args: argparse.Namespace, handle: bool) -> Shown:
  """Returns the scene at its keyframe; in an exercise its expert acts.

  Args:
    args: the options
    handle: whether named organs get handles to drag
  """
  from palpate import models
  from palpate.models import situs

  options = ("nodes", "seed", "instruments", "coupling")
  given = [option for option in options if getattr(args, option) is not None]
  if not given and (found := _exercise(args.scene)):
    return found
  try:
    if args.scene in models.NAMES:
      choices = {"nodes": args.nodes or models.RESOLUTIONS[1], "seed": args.seed, "handle": handle}
      choices["coupling"] = args.coupling or "nodal"
      if args.instruments is not None:
        choices["instruments"] = [name for name in args.instruments.split(",") if name]
      spec = models.load(args.scene, **choices)
      situs.enter(spec, args.scene, choices["nodes"], args.seed)
      model = spec.compile()
    elif args.scene == "abdomen" and not pathlib.Path(args.scene).exists():
      model = _abdomen(args, handle)
    elif given:
      raise CommandError(f"--{given[0]} goes with a named organ: {', '.join(models.NAMES)}")
    else:
      model = _compile(file(args.scene))
  except ValueError as error:
    raise CommandError(compile_error(error)) from None
  data = mujoco.MjData(model)
  reset(model, data, args.keyframe)

  start, done = data.time, 0

  def step(until: float) -> bool:  # counts: MuJoCo sets the time back where a motion diverges
    nonlocal done
    for _ in range(done, round((until - start) / model.opt.timestep)):
      mujoco.mj_step(model, data)
      done += 1
    return True

  return model, data, step


def _exercise(name: str) -> Shown | None:
  """Returns an exercise of seed 0, None where it is none."""
  from palpate import tasks
  from palpate.tasks.core import performer

  domain, _, task = name.partition("/")
  if (domain, task) not in tasks.ALL_TASKS or pathlib.Path(name).exists():
    return None
  env = tasks.load(domain, task, task_kwargs={"random": 0})
  timestep, act = env.reset(), performer.make(env)

  def step(until: float) -> bool:
    nonlocal timestep
    while env.physics.time() < until - 1e-9 and not timestep.last():
      timestep = env.step(act(timestep))
    return not timestep.last()

  return env.physics.model.ptr, env.physics.data.ptr, step


def _abdomen(args: argparse.Namespace, handle: bool) -> mujoco.MjModel:
  from palpate import models

  if args.coupling == "nodal":
    raise CommandError("coupling is 'nodal', expected window: that of the abdomen's organs")
  nodes = args.nodes or models.RESOLUTIONS[1]
  choices: dict = {"soft": {"liver": nodes, "gallbladder": nodes}, "handle": handle}
  if args.instruments is not None:
    choices["instruments"] = [name for name in args.instruments.split(",") if name]
  return models.abdomen(**choices, seed=args.seed).compile()


def file(name: str) -> pathlib.Path:
  """Returns the scene that a name stands for: press, a file, or the scene.xml of a folder."""
  from palpate import models

  path = pathlib.Path(name)
  if name == "press" and not path.exists():
    return command.folder() / "scene.xml"
  if path.is_dir() and (path / "scene.xml").is_file():
    return path / "scene.xml"
  if not path.is_file():
    names = ", ".join((*models.NAMES, "abdomen", "press"))
    raise CommandError(
      f"scene is {name!r}, expected one of {names}, an MJCF file or a folder with a scene.xml"
    )
  return path


def _compile(path: pathlib.Path) -> mujoco.MjModel:
  try:
    return mujoco.MjModel.from_xml_path(str(path.absolute()))
  except (ValueError, mujoco.FatalError) as error:
    raise CommandError(f"scene {path}: {compile_error(error)}") from None


def first_camera(model: mujoco.MjModel) -> int:
  """Returns the camera to look through first: the laparoscope, else the first, else -1 (free)."""
  names = [model.camera(i).name for i in range(model.ncam)]
  return next(
    (i for i, n in enumerate(names) if n.split("/")[-1] == "laparoscope"), 0 if names else -1
  )


def reset(model: mujoco.MjModel, data: mujoco.MjData, keyframe: str | None):
  """Puts the data at a keyframe, the first one where None is given and there is one."""
  if keyframe is None:
    if model.nkey:
      mujoco.mj_resetDataKeyframe(model, data, 0)
  else:
    choices = [model.key(i).name for i in range(model.nkey)]
    if keyframe not in choices:
      have = ", ".join(choices) or "none"
      raise CommandError(f"keyframe is {keyframe!r}, the scene has {have}")
    mujoco.mj_resetDataKeyframe(model, data, choices.index(keyframe))
  mujoco.mj_forward(model, data)
