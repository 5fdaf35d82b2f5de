"""Pictures and films: drawn without a screen, and written in this one place."""

from __future__ import annotations

import contextlib
import pathlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from .console import CommandError, need, writing

if TYPE_CHECKING:
  import mujoco

FILMS = (".mp4", ".gif")
PICTURES = (".png",)


@contextlib.contextmanager
def write(path: pathlib.Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
  """Gives a function that takes the frames of a film, or the picture of a .png.

  Args:
    path: what to write; its suffix says how, see `FILMS` and `PICTURES`
    fps: frames a second
  """
  suffix = path.suffix.lower()
  check(suffix)
  import imageio.v2 as imageio

  with writing(path):
    if suffix in PICTURES:
      yield lambda image: imageio.imwrite(path, image)
      return
    options: dict[str, Any] = {"duration": 1000 / fps, "loop": 0}
    if suffix == ".mp4":
      options = {"fps": fps, "macro_block_size": 2, "quality": 8}
    with imageio.get_writer(path, **options) as writer:
      yield writer.append_data


def check(suffix: str):
  """Raises CommandError where what writes such files is not installed."""
  need("video", "imageio", *(["imageio_ffmpeg"] if suffix == ".mp4" else []))


@contextlib.contextmanager
def renderer(model: mujoco.MjModel, width: int, height: int) -> Iterator[mujoco.Renderer]:
  """Gives a renderer of pictures [pixels] that needs no screen."""
  import mujoco

  model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
  model.vis.global_.offheight = max(model.vis.global_.offheight, height)
  try:
    # Edges of surfaces may be drawn one by one.
    made = mujoco.Renderer(model, height, width, max_geom=10000 + model.nflexedge)
  except Exception as error:  # each backend of OpenGL has its own
    raise CommandError(
      f"no way to draw without a screen ({type(error).__name__}: {error}); install libegl1 or "
      "libosmesa6 and set MUJOCO_GL=egl or osmesa; see palpate doctor",
      code=1,
    ) from None
  try:
    yield made
  finally:
    made.close()
