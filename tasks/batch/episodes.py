"""Episodes are drawn on the host, by the exercise itself in a scene that rests."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import mujoco as mj
import numpy as np
from palpate.camera import lens
from palpate.models import laparoscope, trocar, wrist
from palpate.tasks.core import randomisation
from palpate.tasks.core.base import Task
from palpate.tasks.core.engine import wrap
from palpate.tasks.core.instrument import Second
from palpate.tasks.core.physics import Physics
from palpate.tasks.core.scenes import ORGAN

# What every exercise draws: trocar and joints of an instrument, the length of the path, and where
# the laparoscope is.
HAND = ("body_pos", "body_quat", "pose")
FRAME = (*HAND, "reference", "eye")


class Posed:
  """An instrument that is where it is said to be: nothing is computed for it."""

  def set_joints(self, pose: np.ndarray) -> None:
    """Takes the instrument's pose at the start of an episode."""
    self.pose = np.array(pose)

  def tip_pos(self: Any) -> np.ndarray:
    """Returns where that puts the tip [m]  (3,)."""
    port = self.trocar()
    if port.wrist:
      return wrist.forward(port, self.pose)[0]
    return trocar.forward(port, self.pose[[0, 1, 3]])

  def lens(self: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns where that puts a laparoscope's lens [m], and its picture's axes in columns."""
    return laparoscope.view(self.trocar(), (*self.pose, 0.0), self.optics)


class Other(Posed, Second):
  """One beside it."""


class Resting(Posed, Physics):
  """The physics of an exercise while its organ rests, which is not stepped to answer."""

  rests = True

  def use(
    self, model: mj.MjModel, prefix: str, targets: int, organ: str = ORGAN, second: str = ""
  ) -> None:
    """Takes a compiled scene, see `Physics.use`."""
    self._rest_normals: np.ndarray | None = None
    super().use(model, prefix, targets, organ, second)
    mj.mj_forward(self.model.ptr, self.data.ptr)  # the camera is where it is

  def beside(self, prefix: str) -> Second:
    """Returns another instrument of the scene."""
    return Other(self, prefix)

  def mark(self, *args: Any, **kwargs: Any) -> None:
    """Does nothing: no picture is made."""

  def put(self, *args: Any) -> None:
    """Does nothing: worlds begin with it."""

  def moved(self) -> None:
    """Does nothing: the organ stays where it is."""

  def normals(self) -> np.ndarray:
    """Returns the outward unit normals of the organ's triangles  (nelem, 3)."""
    if self._rest_normals is None:
      self._rest_normals = super().normals()
    return self._rest_normals


class Episodes:
  """The next episodes of worlds, each drawn from a random state of its own.

  What a world begins with next does not depend on how it plays: it is drawn ahead, while a device
  steps.

  Attributes:
    physics: of the scene at rest
    rows: what the worlds began with by name, (nworld, ...) each
    look: returns what of pictures differs where a model was changed, None without pictures
  """

  def __init__(self, task: Task, draw: Callable[[Task], Mapping[str, np.ndarray]], nworld: int):
    model = task.compiled(task.variants[0]).model
    self.physics: Any = Resting.from_model(wrap(model))
    self.physics.use(model, task.prefix, task.targets, task.organ, task.second)
    self._task, self._draw_own = task, draw
    self._random: list[np.random.RandomState | None] = [None] * nworld
    self.rows: dict[str, np.ndarray] = {}
    self._next: dict[str, np.ndarray] = {}
    self._ready = np.zeros(nworld, bool)
    self._where: tuple[bytes, Any] = (b"", None)
    self.look: Callable[[mj.MjModel], Mapping[str, np.ndarray]] | None = None
    self._place_of_work, task.place_of_work = task.place_of_work, self._remember

  def _remember(self, physics: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Returns the task's place of work, which depends on the trocar alone while the organ rests."""
    port = physics.trocar()
    key = port.pos.tobytes() + port.mat.tobytes()
    if self._where[0] != key:
      self._where = key, self._place_of_work(physics)
    return self._where[1]

  def seed(self, seeds: Sequence[int | None], worlds: np.ndarray) -> None:
    """Seeds worlds as `reset` of a single environment does; with None those that have no state."""
    for world in worlds:
      seed = seeds[world]
      if seed is not None or self._random[world] is None:
        random, _ = gymnasium.utils.seeding.np_random(seed)
        self._random[world] = np.random.RandomState(random.integers(2**31))
        self._ready[world] = False

  def take(self, worlds: np.ndarray) -> dict[str, np.ndarray]:
    """Returns `rows` with the next episodes of some worlds."""
    for world in worlds[~self._ready[worlds]]:
      self._draw(world)
    for name, values in self._next.items():
      self.rows.setdefault(name, np.zeros_like(values))[worlds] = values[worlds]
    self._ready[worlds] = False
    return self.rows

  def draw_ahead(self, waits: Callable[[], bool]) -> None:
    """Draws episodes after these for as long as the caller waits for a device."""
    for world in np.flatnonzero(~self._ready):
      if not waits():
        return
      self._draw(world)

  def _draw(self, world: Any) -> None:
    self._task.random = self._random[world]
    self._task.initialize_episode(self.physics)
    for name, row in self._row().items():
      if name not in self._next:
        count = len(self._random)
        self._next[name] = np.zeros((count, *np.shape(row)), np.asarray(row).dtype)
      self._next[name][world] = row
    self._ready[world] = True

  def _row(self) -> Mapping[str, Any]:
    model, frame = self.physics.model.ptr, dict[str, Any]()
    for which, hand in of_physics(self.physics).items():
      body = model.body(f"{hand.prefix}trocar")
      if body.parentid[0]:
        raise ValueError(f"{self._task.name}: the trocar hangs on a body, expected the world")
      own = body.pos.copy(), body.quat.copy(), hand.pose
      frame |= dict(zip(rows_of(which), own, strict=True))
    if self.look and self._task.ranges:
      if randomisation.through(self._task.ranges):
        frame |= {f"look_{k}": v for k, v in lens.lens(self._task.drawn).items()}
      frame |= {f"look_{k}": v for k, v in self.look(model).items()}
      frame |= {f"drawn_{k}": np.array(v) for k, v in self._task.drawn.items()}
    mj.mj_camlight(model, self.physics.data.ptr)
    frame["eye"] = self.physics.camera()[0]
    frame["reference"] = np.array(self._task.reference_length or 0.0)
    task = self._task
    frame |= dict(self._draw_own(task)) | dict(task.tissue())
    put = task.joints | task.bodies | task.threads
    return frame | {put_row(name): row for name, row in put.items()}


def of_physics(physics: Any) -> dict[str, Any]:
  """Returns the instruments of a scene by what the names of their rows begin with."""
  all_of = {"": physics, "other_": physics.second, "guided_": physics.guided}
  return {which: hand for which, hand in all_of.items() if hand}


def put_row(name: str) -> str:
  """Returns the name of the row of where a joint, body or thread is put."""
  return f"put_{name}"


def rows_of(which: str) -> list[str]:
  """Returns the names of the rows of HAND of one of the instruments of `of_physics`."""
  return [which + name for name in HAND]


def at_rest(model: mj.MjModel, state: np.ndarray, kind: int) -> mj.MjData:
  """Returns data in a state."""
  data = mj.MjData(model)
  mj.mj_setState(model, data, state, kind)
  mj.mj_forward(model, data)
  mj.mj_setState(model, data, state, kind)
  return data
