"""Pictures of a single environment, drawn as those of batches are, without OpenGL."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from palpate.camera import Camera
from palpate.camera.host import Single
from palpate.tissue import device as devices

from .scenes import CAMERA

OPENGL = "opengl"


def check(renderer: Any) -> str:
  """Returns a renderer that there is; ValueError names the others."""
  known = (OPENGL, "cpu", *devices.cuda()) if renderer != OPENGL else (OPENGL,)
  if renderer not in known:
    raise ValueError(f"renderer is {renderer!r}, expected one of {', '.join(known)}")
  return renderer


class Eyes:
  """The laparoscope in the data of a physics.

  Attributes:
    data: that is drawn
    asked: for what, see `see`
  """

  def __init__(self, physics: Any, labels: Mapping[tuple[int, int], int], asked: tuple):
    self.data, self.asked = physics.data.ptr, asked
    device, (height, width), outputs, shift = asked
    host = Single(physics.model.ptr, self.data, device)
    lenses = [0] * len(shift)  # a row a lens
    self._camera = Camera(host, CAMERA, height, width, outputs, lenses, labels, shift)
    self._shown = dict[str, np.ndarray]()

  def see(self, physics: Any, begins: bool) -> dict[str, np.ndarray]:
    """Returns what each lens sees now, by what `Camera` calls it  (lens, height, width, ...).

    Args:
      physics: with the data
      begins: whether nothing has moved yet
    """
    camera, model = self._camera, physics.model.ptr
    rows = np.arange(len(camera.worlds))
    for name, value in (camera.look(model) | camera.sites(model)).items():
      if not np.array_equal(value, self._shown.get(name, ())):
        self._shown[name] = np.array(value)
        camera.show(rows, {name: np.stack([value] * len(rows))})
    if begins:
      camera.place()
    return {name: array.numpy().copy() for name, array in camera.draw().items()}


def see(
  physics: Any, labels: Mapping[tuple[int, int], int], device: str, size: tuple[int, int],
  outputs: Sequence[str], shift: Sequence[float], begins: bool,
) -> dict[str, np.ndarray]:  # fmt: skip
  """Returns what lenses of the laparoscope see now, see `Eyes.see`.

  Args:
    physics: keeps the `Eyes` for the next time
    labels: see `observation.labels`
    device: that draws
    size: height and width [pixels]
    outputs: of `Camera`
    shift: of each lens to the right [m]
    begins: whether nothing has moved yet
  """
  asked, eyes = (device, size, tuple(outputs), tuple(shift)), physics.eyes
  if eyes is None or eyes.data is not physics.data.ptr or eyes.asked != asked:
    physics.eyes = eyes = Eyes(physics, labels, asked)
  return eyes.see(physics, begins)
