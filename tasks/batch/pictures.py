"""What the laparoscopes of worlds see: pictures as the single environment has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco as mj
import numpy as np
import warp as wp
from palpate.camera import Camera
from palpate.tasks.core import observation, randomisation, scenes
from palpate.tissue.types import fill

from .marks import Films, Marks, film, marking


class Pictures:
  """Pictures of worlds.

  Args:
    worlds: the worlds of an exercise
    names: of `observation.PICTURES`
    size: height and width [pixels]
    chosen: numbers of the worlds; None for all

  Attributes:
    arrays: the pictures by name, which keep their place
  """

  def __init__(
    self,
    worlds: Any,
    names: Sequence[str],
    size: tuple[int, int],
    chosen: Sequence[int] | None = None,
  ):
    task, physics, batch = worlds.task, worlds.episodes.physics, worlds.batch
    self._worlds, self._all = worlds, chosen is None
    seen = {name: observation.PICTURES[name] for name in names}
    eyes = sorted({picture.eye for picture in seen.values()})
    outputs = list(dict.fromkeys(picture.of for picture in seen.values()))
    every = [*range(batch.nworld)] if chosen is None else [*chosen]
    self._count, n = len(eyes), len(every)
    self._camera = Camera(
      batch, scenes.CAMERA, *size, outputs, every * self._count, observation.labels(physics),
      np.repeat(eyes, n).tolist(), randomisation.through(task.ranges),
    )  # fmt: skip
    found = self._camera.pictures
    self.arrays = {
      name: found[picture.of][eyes.index(picture.eye) * n :][:n] for name, picture in seen.items()
    }
    view, site = self._camera.view, int(mj.mjtObj.mjOBJ_SITE)
    own = {"world": view.world, "pos": view.part_pos, "rgba": view.rgba}
    parts = [self._camera.part(k) for k in physics.target_sites]
    things = [self._camera.thing(site, k) for k in physics.target_sites]
    size_of = view.part_size.numpy()
    for k, part in enumerate(parts):
      size_of[:, part] = task.mark_size(k)
    view.part_size.assign(size_of)
    if self._all:
      worlds.episodes.look = self._camera.look
    self._mark = marking(task.rules) if task.rules.mark else None
    index = {"part": np.array(parts, int), "thing": np.array(things, int)}
    self._marks = fill(Marks, batch.device, own | index)
    bonds = physics.organ.bonds
    which, films = scenes.films(batch.model, bonds.vertices if len(bonds) else np.zeros(0))
    index = {"bond": which, "thing": np.array([self._camera.thing(site, k) for k in films], int)}
    self._films = fill(Films, batch.device, own | index)

  def show(self, worlds: np.ndarray, rows: Mapping[str, np.ndarray]):
    """Gives the camera of worlds what was drawn for their episodes, see `Episodes`."""
    first = np.arange(self._count)[:, None] * (len(self._camera.worlds) // self._count)
    own = {
      name.removeprefix("look_"): np.tile(value[worlds], (self._count, *[1] * (value.ndim - 1)))
      for name, value in rows.items() if name.startswith("look_")
    }  # fmt: skip
    self._camera.show((first + worlds).ravel(), own)

  def draw(self, mask: wp.array | None = None):
    """Draws all worlds, or those of a mask on the device, where episodes begin."""
    self._camera.follow()
    if mask is not None and "flow" in self.arrays:  # nothing has moved yet
      self._put_marks()
      self._camera.place()
    self._camera.choose(mask)
    if self._all:
      self._worlds.run(self.launch)
    else:
      self.launch()

  def launch(self):
    """Launches what draws."""
    self._put_marks()
    self._camera.launch()

  def _put_marks(self):
    """Launches what moves and colours the marks of the exercise."""
    w, n = self._worlds, len(self._camera.worlds)
    if self._mark and len(self._marks.part):
      w.launch(self._mark, (n, len(self._marks.part)), [w.fields, w.states.records, self._marks])
    if len(self._films.bond):
      w.launch(film, (n, len(self._films.bond)), [w.fields, self._films])
