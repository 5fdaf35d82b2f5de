"""Pictures and films: drawn without a screen, and written in this one place."""

from __future__ import annotations

import contextlib
import math
import pathlib
import tempfile
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ..console import CommandError, Progress, need, writing

if TYPE_CHECKING:
  import mujoco

FILMS = (".mp4", ".gif")
PICTURES = (".png", ".webp", ".jpg")
_FPS = 25  # of the laparoscope
_SMALL = (320, 240)  # each picture of a strip [pixels]
_COUNT = 5  # of these
_MOST_PIXELS = 8192


def size(text: str) -> tuple[int, int]:
  """Returns width and height [pixels] of a text such as 1280x960."""
  words = text.lower().split("x")
  if len(words) != 2 or not all(w.isdigit() and 16 <= int(w) <= _MOST_PIXELS for w in words):
    span = f"[16, {_MOST_PIXELS}]"
    raise CommandError(f"size is {text!r}, expected WxH such as 1280x960, both in {span}")
  return int(words[0]), int(words[1])


@contextlib.contextmanager
def write(path: pathlib.Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
  """Gives a function that takes the frames of a film, or a picture.

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


@contextlib.contextmanager
def laparoscope(path: pathlib.Path, size: tuple[int, int]) -> Iterator[Callable[[Any], None]]:
  """Gives a function that takes the laparoscope's picture of an environment, for a film.

  Args:
    path: of the film
    size: width and height [pixels]
  """
  due, look = -math.inf, Look(size)
  with write(path, _FPS) as frame:

    def shoot(env: Any) -> None:
      nonlocal due
      if env.physics.time() >= due - 1e-9:
        due = env.physics.time() + 1 / _FPS
        frame(look(env))

    yield shoot


class Look:
  """Draws what the laparoscope of an environment sees: call it with that.

  MuJoCo's renderer does, or where there is no OpenGL that of batches, on the CPU.

  Args:
    size: width and height [pixels]
  """

  def __init__(self, size: tuple[int, int]):
    self._size, self._opengl = size, True

  def __call__(self, env: Any) -> np.ndarray:
    """Returns the picture  (height, width, 3) uint8."""
    from palpate.tasks.core import eyes, observation, scenes

    physics, (width, height) = env.physics, self._size
    if self._opengl:
      try:
        return physics.render(height, width, camera_id=physics.model.ptr.camera(scenes.CAMERA).id)
      except Exception:  # each backend of OpenGL has its own
        self._opengl = False
    labels, begins = observation.labels(physics), physics.time() == 0
    seen = eyes.see(physics, labels, "cpu", (height, width), ("pixels",), (0.0,), begins)
    return seen["pixels"][0]


class Strip:
  """Pictures of an exercise, evenly over its time, for a report: call it after every step.

  Args:
    end: when the exercise ends, None where nobody knows [s]
  """

  def __init__(self, end: float | None = None):
    self._look = Look(_SMALL)
    self._frames: list[np.ndarray] = []
    self._every, self._due = 0.5 if end is None else end / (_COUNT - 1), 0.0  # [s]

  def __call__(self, env: Any) -> None:
    """Takes the laparoscope's picture if it is due."""
    time = env.physics.time()
    if time < self._due - 1e-9:
      return
    self._frames.append(self._look(env))
    if len(self._frames) == 4 * _COUNT:  # the exercise is a long one
      self._frames, self._every = self._frames[::2], 2 * self._every
    self._due += self._every

  def pictures(self) -> np.ndarray | None:
    """Returns the pictures  (n, height, width, 3) uint8; None without any."""
    if not self._frames:
      return None
    last = len(self._frames) - 1
    chosen = np.unique(np.linspace(0, last, _COUNT).round().astype(int))
    return np.stack([self._frames[k] for k in chosen])


def of_recording(recording: Any, size: tuple[int, int]) -> bytes:
  """Returns the MP4 of a recorded exercise, see `again`."""
  check(".mp4")
  with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / "film.mp4"
    with laparoscope(path, size) as shoot:
      again(recording, shoot)
    return path.read_bytes()


def strip(recording: Any) -> np.ndarray | None:
  """Returns pictures of a recorded exercise, see `Strip` and `again`."""
  if not len(recording.time):
    return None
  views = Strip(end=float(recording.time[-1]))
  again(recording, views)
  return views.pictures()


def again(recording: Any, shoot: Callable[[Any], None]) -> None:
  """Runs a recorded exercise anew, to take its pictures after every step.

  Raises:
    CommandError: it is none that can be run, or it comes out differently.
  """
  from palpate.tasks.core import episode

  progress, end = Progress(), recording.time[-1] if len(recording.time) else 0.0

  def watch(env: Any) -> None:
    shoot(env)
    progress.show(f"pictures: {env.physics.time():.1f} of {end:.1f} s")

  try:
    made = episode.replay(recording, watch)
  except (ValueError, episode.EpisodeError) as error:
    raise CommandError(f"no pictures: {error}", code=1) from None
  finally:
    progress.clear()
  if changed := episode.differences(recording, made):
    raise CommandError(f"no pictures: the replay differs in {', '.join(changed)}", code=1)


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
