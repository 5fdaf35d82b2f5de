"""`palpate view`: MuJoCo's viewer on a scene, the instruments' handles draggable."""

from __future__ import annotations

import argparse
from typing import Any

from palpate import register
from palpate.tasks.display import has_display

from .console import CommandError


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  from . import scenes

  parser.epilog = (
    "Double-click the yellow ball at an instrument's tip, then hold Ctrl and drag with the right "
    "button: the tip follows. Space pauses, Backspace starts anew, [ and ] change the camera."
  )
  scenes.add_arguments(parser)


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  if not has_display():
    raise CommandError("no display to open a window on; `palpate render` makes pictures", code=1)
  register()
  from . import scenes

  model, data = scenes.load(args, handle=True)
  import mujoco.viewer

  loaded = [(model, data, args.scene)]

  def load() -> Any:  # the viewer also takes a name, which its type leaves out
    return loaded.pop() if loaded else (*scenes.load(args, handle=True), args.scene)

  # The viewer points its camera at a scene only if it is loaded under a name.
  mujoco.viewer.launch(loader=load)
  return 0
