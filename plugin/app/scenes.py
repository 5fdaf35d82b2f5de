"""What `palpate view` and `palpate render` share: the scene that is asked for."""

from __future__ import annotations

import argparse
import pathlib

import mujoco

from .console import CommandError


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options that choose a scene."""
  parser.add_argument("scene", metavar="SCENE", help="name of a model or path of an MJCF file")
  parser.add_argument("--nodes", metavar="N", type=int, help="resolution of a named model")
  parser.add_argument("--seed", metavar="N", type=int, help="variant of a named model's shape")
  parser.add_argument(
    "--instruments",
    metavar="NAMES",
    help="of a named model, separated by commas (probe,grasper)",
  )
  parser.add_argument(
    "--coupling",
    choices=("nodal", "window"),
    help="of a named model; window: MuJoCo knows the nodes near the instruments alone (nodal)",
  )
  parser.add_argument("--keyframe", metavar="NAME", help="state to start from (the first keyframe)")


def load(args: argparse.Namespace, handle: bool) -> tuple[mujoco.MjModel, mujoco.MjData]:
  """Returns model and data at the keyframe; `handle` gives named models handles to drag."""
  from palpate import models

  given = [
    option for option in ("nodes", "seed", "instruments", "coupling") if getattr(args, option)
  ]
  path = pathlib.Path(args.scene)
  try:
    if args.scene in models.NAMES:
      options = {"nodes": args.nodes or models.RESOLUTIONS[1], "seed": args.seed, "handle": handle}
      options["coupling"] = args.coupling or "nodal"
      if args.instruments is not None:
        options["instruments"] = [name for name in args.instruments.split(",") if name]
      model = models.load(args.scene, **options).compile()
    elif given:
      raise CommandError(f"--{given[0]} goes with a named model: {', '.join(models.NAMES)}")
    elif not path.is_file():
      names = ", ".join(models.NAMES)
      raise CommandError(f"scene is {args.scene!r}, expected an MJCF file or one of {names}")
    else:
      model = mujoco.MjModel.from_xml_path(str(path.absolute()))
  except ValueError as error:
    raise CommandError(str(error)) from None
  data = mujoco.MjData(model)
  reset(model, data, args.keyframe)
  return model, data


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
