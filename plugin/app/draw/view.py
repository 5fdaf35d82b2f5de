"""`palpate view`: MuJoCo's viewer on a scene, the instruments' handles draggable."""

import argparse
import math
from typing import Any

from palpate import register
from palpate.screen import has_display

from ..console import CommandError


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  from . import scenes

  parser.epilog = (
    "Double-click the yellow ball at an instrument's tip, then hold Ctrl and drag with the right "
    "button: the tip follows. Space pauses, Backspace starts anew, [ and ] change the camera; Esc "
    "frees it from the laparoscope, for the mouse to turn."
  )
  scenes.add_arguments(parser)


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  if not has_display():
    raise CommandError("no display to open a window on; `palpate render` makes pictures", code=1)
  register()
  loaded = [_load(args)]
  import mujoco.viewer

  def load() -> Any:  # the viewer also takes a name, which its type leaves out
    return (*(loaded.pop() if loaded else _load(args)), args.scene)

  # The viewer points its camera at a scene only if it is loaded under a name.
  mujoco.viewer.launch(loader=load)
  return 0


def _load(args: argparse.Namespace):
  """Returns model and data; the viewer starts with the laparoscope."""
  from . import scenes

  model, data, _ = scenes.load(args, handle=True)
  first = scenes.first_camera(model)
  if first >= 0:
    look = model.vis.global_
    look.cameraid = first
    # The free camera starts on the same side.
    x, y, z = -data.cam_xmat[first].reshape(3, 3)[:, 2]
    look.azimuth = math.degrees(math.atan2(y, x))
    look.elevation = math.degrees(math.asin(max(-1.0, min(1.0, z))))
  return model, data
