"""What every batch is: the worlds of a scene as arrays, a row a world."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import mujoco
import numpy as np
import warp as wp
from palpate.engine import coupling
from palpate.engine.model.declare import Declaration
from palpate.engine.workspace import Workspace
from palpate.organ import instances
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.reading import count_of

from .cutting.fracture import Parting
from .needles import Needles
from .thread import Thread

if TYPE_CHECKING:
  from palpate.camera import Camera

_MOVING = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "plugin_state")


_T = TypeVar("_T")


class Batch(abc.ABC):
  """Worlds of one scene.

  Arrays are Warp arrays of float32 on `device`, a row a world; they keep their place, and torch and
  JAX see the same memory (`torch.from_dlpack(batch.qpos)`). Those that tell a state are brought up
  to date when they are asked for and are not to be written to.

  Attributes:
    model: the compiled scene, whose layout `qpos`, `qvel`, `ctrl` and `sensordata` have
    nworld: number of worlds
    device: Warp device of the arrays
  """

  model: mujoco.MjModel
  nworld: int
  device: Any
  _organs: Mapping[str, Any]
  _threads: Mapping[str, Any]

  def __init__(self, model: mujoco.MjModel, nworld: int, device):
    self.model, self.nworld, self.device = model, nworld, wp.get_device(device)
    self._fresh = False

  def __reduce__(self):
    raise TypeError(
      "a batch cannot be pickled or copied: its worlds are in a device's memory or on threads; "
      "make another and give it the states of this one, see get_state and set_state"
    )

  def _allocate(self):
    """Makes the arrays, once it is known that there is room for them."""
    model, nworld = self.model, self.nworld
    sizes = {"ctrl": model.nu, "qpos": model.nq, "qvel": model.nv}
    sizes |= {"sensordata": model.nsensordata}
    self._arrays = {name: self._make(size) for name, size in sizes.items()}
    self._arrays["time"] = wp.zeros(nworld, dtype=float, device=self.device)
    self._sums = {
      "sensor_peak": self._make(model.nsensor), "sensor_mean": self._make(model.nsensordata)
    }  # fmt: skip
    self._counts = {
      name: wp.zeros(nworld, dtype=int, device=self.device) for name in ("failures", "overflow")
    }

  def _make(self, *size: int) -> wp.array:
    return wp.zeros((self.nworld, *size), dtype=float, device=self.device)

  # States.

  @property
  def ctrl(self) -> wp.array:
    """Controls, (nworld, nu); write into it, or assign an array of that shape."""
    return self._arrays["ctrl"]

  @ctrl.setter
  def ctrl(self, values):
    shape = tuple(np.shape(values))
    if shape != self.ctrl.shape:
      raise ValueError(f"ctrl has shape {shape}, expected {self.ctrl.shape} (nworld, nu)")
    wp.copy(self.ctrl, on_device(values, wp.float32, self.device))

  @property
  def time(self) -> wp.array:
    """Time [s], (nworld,)."""
    return self._state("time")

  @property
  def qpos(self) -> wp.array:
    """Positions in the model's layout, (nworld, nq); see docs/batch.md on windows."""
    return self._state("qpos")

  @property
  def qvel(self) -> wp.array:
    """Velocities in the model's layout, (nworld, nv)."""
    return self._state("qvel")

  @property
  def sensordata(self) -> wp.array:
    """Sensors of the last step, (nworld, nsensordata); zero in a world that was reset since."""
    return self._state("sensordata")

  @property
  def sensor_peak(self) -> wp.array:
    """Largest norm of each sensor in the steps of the last call of `step`, (nworld, nsensor)."""
    return self._summed("sensor_peak")

  @property
  def sensor_mean(self) -> wp.array:
    """Mean of the sensors over the steps of the last call of `step`, (nworld, nsensordata)."""
    return self._summed("sensor_mean")

  def watch(self, steps: int) -> wp.array:
    """Returns where the sensors of each step will be, in calls of `step` of so many steps at most.

    Returns:
      (nworld, steps, nsensordata), which keeps its place
    """
    return self._watch(self._make(count_of("steps", steps), self.model.nsensordata))

  def feel(self, sensor: str, organ: str):
    """Adds the force of what cuts an organ to a sensor of force, in each step from now on.

    MuJoCo's sensors of contacts know nothing of a blade.
    """
    found = self.model.sensor(sensor)
    if found.dim[0] != 3:
      raise ValueError(f"sensor {sensor!r} has {found.dim[0]} numbers, expected 3: a force")
    if not self.organ(organ).cutters.inside.shape[1]:
      raise ValueError(f"organ {organ!r}: nothing cuts it, expected the key cutters")
    self._feel(found.id, organ)

  def _feel(self, sensor: int, organ: str):
    raise ValueError("worlds on several devices cannot feel cutters; their `parts` can")

  def _watch(self, out: wp.array) -> wp.array:
    raise ValueError("worlds on several devices cannot be watched; their `parts` can")

  @property
  def failures(self) -> wp.array:
    """How often each world had numbers that are not finite, and was reset for it, (nworld,)."""
    return self._summed("failures")

  @property
  def overflow(self) -> wp.array:
    """Most touched triangles, or nodes, that windows had no room for so far, (nworld,)."""
    return self._summed("overflow")

  def _summed(self, name: str) -> wp.array:
    """Returns a sum or a count."""
    return (self._sums | self._counts)[name]

  def _state(self, name: str) -> wp.array:
    if not self._fresh:
      self._tell()
      self._fresh = True
    return self._arrays[name]

  @abc.abstractmethod
  def _tell(self):
    """Brings the arrays of the state up to date."""

  @property
  def organs(self) -> dict[str, Any]:
    """The organs by name, each a `Tissue`."""
    return dict(self._organs)

  def organ(self, name: str) -> Tissue:
    """Returns an organ.

    Raises:
      ValueError: the scene has no organ of that name; the message lists those it has.
    """
    return _listed("organ", self.organs, name)

  @property
  def threads(self) -> dict[str, Any]:
    """The threads by name, each a `Thread`."""
    return dict(self._threads)

  def thread(self, name: str) -> Thread:
    """Returns a thread.

    Raises:
      ValueError: the scene has no thread of that name; the message lists those it has.
    """
    return _listed("thread", self.threads, name)

  # Pictures.

  def camera(
    self,
    name: str,
    height: int,
    width: int,
    outputs: Sequence[str] = ("pixels",),
    worlds: Sequence[int] | None = None,
  ) -> Camera:
    """Returns a camera that draws worlds on the device, see docs/pixels.md.

    Args:
      name: of a camera of the scene
      height: of a picture [pixels], at most 1024
      width: the same
      outputs: some of `pixels` (red, green, blue, uint8), `depth` [m], `segmentation` (number and
        `mjtObj` of what is seen, -1 for nothing), `points` [m] (in the camera's frame, x right, y
        down, z forward; 0 where nothing is), `flow` (way of what a pixel shows since the last
        picture, right and down [pixels])
      worlds: which ones; None for all

    Raises:
      ValueError: the model has no such camera, an argument is not allowed, the scene has something
        that such a camera cannot draw, or the device no room for so many pictures.
    """
    raise ValueError("worlds on several devices have no cameras; their `parts` do")

  def poses(self) -> tuple[wp.array, wp.array, np.ndarray]:
    """Returns where bodies are now.

    Returns:
      positions (nworld, n) of vec3 [m] and axes (nworld, n) of mat33, which keep their place, and
      which of the n a body of the model is  (nbody,)
    """
    raise ValueError("worlds on several devices have their bodies in `parts`")

  # Doing.

  def step(self, n: int = 1):
    """Steps all worlds n times with the controls in `ctrl`.

    A world that ends with numbers that are not finite is reset and counted in `failures`.
    """
    n, self._fresh = count_of("n", n), False
    self._step(n)

  @abc.abstractmethod
  def _step(self, n: int):
    """Steps all worlds."""

  def reset(self, mask=None):
    """Puts worlds at rest, or in the state of `start`, their controls at zero.

    Args:
      mask: worlds to reset, (nworld,) of bool; None for all
    """
    self._fresh = False
    self._reset(self.checked(mask))

  @abc.abstractmethod
  def _reset(self, mask: wp.array):
    """Puts the worlds of a mask, which is on the device, at rest."""

  def start(self, data: mujoco.MjData):
    """Lets `reset` put worlds in the state of an mjData of `model` from now on, at time 0."""
    self._check(data)
    self._start(data)

  @abc.abstractmethod
  def _start(self, data: mujoco.MjData):
    """Takes that state."""

  def pose(self, joints: Sequence[str], values, mask=None):
    """Puts joints of worlds at positions, without velocity.

    Args:
      joints: names of hinges, slides and free joints
      values: positions [rad, m], one column each, seven of a free joint (place and orientation, w x
        y z), (nworld, number of columns), here or on the device
      mask: worlds, (nworld,) of bool; None for all
    """
    found = [_named(self.model.joint, "joint", name) for name in joints]
    adr = []
    for joint in found:
      qpos, dof, kind = int(joint.qposadr[0]), int(joint.dofadr[0]), int(joint.type[0])
      if kind == mujoco.mjtJoint.mjJNT_BALL:
        raise ValueError(f"joint {joint.name!r} is a ball, expected a hinge, slide or free joint")
      count = 7 if kind == mujoco.mjtJoint.mjJNT_FREE else 1  # of six dofs
      adr += [(qpos + k, dof + min(k, 5)) for k in range(count)]
    values = self._rows(values, "values", len(adr))
    self._fresh = False
    self._pose(np.array(adr, int).reshape(-1, 2), values, self.checked(mask))

  @abc.abstractmethod
  def _pose(self, adr: np.ndarray, values: Any, mask: wp.array):
    """Puts numbers of qpos, and dofs at rest, whose places are the columns of `adr`."""

  def place(self, body: str, pos, quat, mask=None):
    """Moves a body of worlds in its parent's frame, one that has no joint.

    Args:
      body: name
      pos: positions [m], (nworld, 3), here or on the device
      quat: orientations, w x y z, (nworld, 4)
      mask: worlds, (nworld,) of bool; None for all
    """
    number = _named(self.model.body, "body", body).id
    if not number or self.model.body_jntnum[number]:
      raise ValueError(f"body {body!r} has joints, expected one that is fixed to its parent")
    pos, quat = self._rows(pos, "pos", 3), self._rows(quat, "quat", 4)
    if isinstance(quat, np.ndarray) and not quat.any(axis=1).all():
      raise ValueError("quat is zero, expected orientations, w x y z")
    self._fresh = False
    self._place(number, pos, quat, self.checked(mask))

  @abc.abstractmethod
  def _place(self, body: int, pos: Any, quat: Any, mask: wp.array):
    """Moves a body."""

  def switch(self, equality: str, active):
    """Switches an equality on or off in each world; resets and states do so too.

    Args:
      equality: name
      active: whether it is on, (nworld,) of bool, here or on the device
    """
    number = _named(self.model.equality, "equality", equality).id
    self._switch(number, self.checked(active, "active"))

  @abc.abstractmethod
  def _switch(self, equality: int, active: wp.array):
    """Switches an equality."""

  def _rows(self, values, name: str, count: int) -> Any:
    if not (isinstance(values, wp.array) and self.device.is_cuda):
      values = np.asarray(values, float)
    if values.shape != (self.nworld, count):
      raise ValueError(f"{name} has shape {values.shape}, expected ({self.nworld}, {count})")
    if isinstance(values, np.ndarray) and not np.isfinite(values).all():
      raise ValueError(f"{name} has numbers that are not finite")
    return values

  def configure(self, mask=None, *, gravity=None, friction: Mapping[str, Any] | None = None):
    """Changes what worlds have besides organs; a reset leaves it.

    Args:
      mask: worlds, (nworld,) of bool; None for all
      gravity: gravity [m/s^2], (3,) or (nworld, 3)
      friction: sliding friction of geoms by name, a number or (nworld,)
    """
    worlds = np.flatnonzero(self.checked(mask).numpy())
    if gravity is not None:
      gravity = np.asarray(gravity, float)
      gravity = np.tile(gravity, (self.nworld, 1)) if gravity.shape == (3,) else gravity
      gravity = self._rows(gravity, "gravity", 3)[worlds]
    rough = {}
    for name, values in (friction or {}).items():
      values = np.broadcast_to(np.asarray(values, float), (self.nworld,))
      if not ((values >= 0) & np.isfinite(values)).all():
        raise ValueError(f"geom {name!r}: friction is {values.min()}, expected numbers >= 0")
      rough[_named(self.model.geom, "geom", name).id] = values[worlds]
    self._configure(worlds, gravity, rough)

  @abc.abstractmethod
  def _configure(self, worlds: np.ndarray, gravity: np.ndarray | None, friction: dict):
    """Changes some worlds; values have a row for each of these."""

  def checked(self, mask, name: str = "mask") -> wp.array:
    """Returns a mask of worlds on the device, all of them for None; refuses what is none."""
    if mask is None:
      return wp.full(self.nworld, True, dtype=wp.bool, device=self.device)
    if not isinstance(mask, wp.array):
      mask = mask if hasattr(mask, "__cuda_array_interface__") else np.asarray(mask)
    kind = getattr(mask.dtype, "__name__", str(mask.dtype)).rpartition(".")[2]
    if tuple(mask.shape) != (self.nworld,) or kind != "bool":
      what = f"shape {tuple(mask.shape)} of {kind}"
      raise ValueError(f"{name} has {what}, expected ({self.nworld},) of bool, one a world")
    return on_device(mask, wp.bool, self.device)

  def index(self, world: int) -> int:
    """Returns the number of a world; refuses what is none."""
    if isinstance(world, bool) or not isinstance(world, int | np.integer):
      raise ValueError(f"world is {world!r}, expected a whole number")
    if not 0 <= world < self.nworld:
      raise ValueError(f"world is {world}, expected one in [0, {self.nworld})")
    return int(world)

  def _check(self, data: mujoco.MjData):
    sizes = {"qpos": "nq", "qvel": "nv", "ctrl": "nu", "plugin_state": "npluginstate"}
    if any(getattr(data, name).size != getattr(self.model, size) for name, size in sizes.items()):
      raise ValueError("data is of another model, expected an MjData of the batch's `model`")

  def _check_state(self, data: mujoco.MjData, organs: Mapping[str, Declaration]):
    """Refuses a state with numbers that are not finite, or of another organ."""
    for name in _MOVING:
      if not np.isfinite(getattr(data, name)).all():
        raise ValueError(f"data.{name} has numbers that are not finite")
    for name, number in instances(self.model).items():
      start = self.model.plugin_stateadr[number]
      own = data.plugin_state[start : start + self.model.plugin_statenum[number]]
      if own[coupling.spans(organs[name])["signature"]][0] != organs[name].signature:
        try:
          coupling.check_state(organs[name], own)
        except ValueError as error:
          raise ValueError(f"organ {name!r}: data's {error}") from None

  def get_state(self, world: int, data: mujoco.MjData):
    """Writes the state of a world to an mjData of `model`, where the plugin goes on with it."""
    world = self.index(world)
    self._check(data)
    self._get_state(world, data)

  @abc.abstractmethod
  def _get_state(self, world: int, data: mujoco.MjData):
    """Writes the state of a world to an mjData."""

  def set_state(self, world: int, data: mujoco.MjData):
    """Gives a world the state of an mjData of `model`."""
    world = self.index(world)
    self._check(data)
    self._fresh = False
    self._set_state(world, data)

  @abc.abstractmethod
  def _set_state(self, world: int, data: mujoco.MjData):
    """Gives a world the state of an mjData."""


class Contacts(NamedTuple):
  """Contacts of an organ with geoms in all worlds, as many in each; those that are none have -1.

  Attributes:
    geom: the geom, (nworld, n)
    normal: from the geom to the tissue, (nworld, n, 3)
    force: force along it [N], (nworld, n)
  """

  geom: wp.array
  normal: wp.array
  force: wp.array


class Tissue(Parting):
  """One organ in all worlds of a batch; arrays as those of `Batch`, in world coordinates.

  Vertices that wait for a cut come last, and are at NaN until they are of use.

  Attributes:
    name: name of the flexcomp
    nvert: number of vertices
    elem: triangles, counter-clockwise from outside, (nelem, 3)
    space: its workspace in one mjData
  """

  name: str
  nvert: int
  elem: np.ndarray
  space: Workspace

  @abc.abstractmethod
  def _read(self, name: str) -> wp.array:
    """Returns the array of one of the properties below, brought up to date."""

  @property
  def xpos(self) -> wp.array:
    """Positions [m], (nworld, nvert, 3)."""
    return self._read("xpos")

  @property
  def xvel(self) -> wp.array:
    """Velocities [m/s], (nworld, nvert, 3)."""
    return self._read("xvel")

  @property
  def contact_force(self) -> wp.array:
    """Constraint force on each vertex in the last step [N], (nworld, nvert, 3)."""
    return self._read("contact_force")

  @property
  def residual(self) -> wp.array:
    """Relative residual of the last step's solve, (nworld,)."""
    return self._read("residual")

  @property
  def iterations(self) -> wp.array:
    """PCG iterations of the last step, (nworld,)."""
    return self._read("iterations")

  @property
  def applied(self) -> wp.array:
    """Force applied to each vertex, (nworld, nvert, 3) [N]; write into it.

    It is zero at first and in worlds that were reset, and is not in their state.
    """
    raise ValueError("worlds on several devices have what is applied in `parts`")

  @property
  def contacts(self) -> Contacts:
    """Contacts of the last step; on a GPU alone, on the CPU they are in `Batch.datas`."""
    raise ValueError(f"organ {self.name!r}: contacts are in `batch.datas` on the CPU")

  @property
  @abc.abstractmethod
  def bonds(self) -> Any:
    """What it has grown on to, see `palpate.batch.bonds.Bonds`."""

  @property
  @abc.abstractmethod
  def needles(self) -> Needles:
    """What the needles do that may go through it.

    Raises:
      ValueError: there is none.
    """

  def _no_needles(self) -> ValueError:
    return ValueError(f"organ {self.name!r}: nothing goes through it, expected the key needles")

  def meshes(self) -> Sequence[Mesh]:
    """Returns the mesh of each world; it is another object once it was cut."""
    raise ValueError("worlds on several devices have their meshes in `parts`")

  @abc.abstractmethod
  def configure(self, mask=None, **keys):
    """Changes the tissue of worlds: keys of docs/configuration.md that may change while running.

    A value is one number for all, or has a row a world. `young_scale` stands for `young` as a
    multiple of the compiled one; `young` has one number, or one a triangle. `friction` is the
    sliding friction of the organ's side of contacts. On a GPU also `mass`, of the whole organ [kg].

    Args:
      mask: worlds to change, (nworld,) of bool; None for all
      **keys: new values

    Raises:
      ValueError: a key may not change, or a value is not allowed.
    """


def on_device(values, dtype, device) -> wp.array:
  """Returns values as a Warp array of that type on a device, the same memory where it is one."""
  if isinstance(values, wp.array) and values.dtype is dtype and values.device == device:
    return values
  if isinstance(values, wp.array):
    values = values.numpy()
  if hasattr(values, "__cuda_array_interface__") and device.is_cuda:
    return wp.array(values, dtype=dtype, device=device)
  return wp.array(np.asarray(values), dtype=dtype, device=device)


def spread(tissue: Tissue, key: str, value, nworld: int) -> np.ndarray:
  """Returns a value of a key a world: (nworld,), or (nworld, nelem) where triangles differ."""
  array = np.asarray(value, dtype=float)
  nelem = len(tissue.elem)
  per_triangle = key == "young" and array.ndim and array.shape[-1] == nelem
  rows = array.ndim - int(bool(per_triangle))
  if rows == 0:
    array = np.broadcast_to(array, (nworld, *array.shape))
  if rows > 1 or len(array) != nworld:
    raise ValueError(
      f"organ {tissue.name!r}: {key} has shape {np.shape(value)}, expected one number, or one a "
      f"world ({nworld},)" + (f", each or one a triangle ({nelem},)" if key == "young" else "")
    )
  if key == "friction" and not (array >= 0).all():
    raise ValueError(f"organ {tissue.name!r}: friction is {array.min()}, expected numbers >= 0")
  return array


def _named(find: Any, kind: str, name: str) -> Any:
  """Returns what a model has under a name; ValueError lists those that it has."""
  try:
    return find(name)
  except KeyError as error:
    have = error.args[0].partition(". ")[2]
    raise ValueError(f"no {kind} {name!r} in the model. {have}") from None


def _listed(kind: str, things: Mapping[str, _T], name: str) -> _T:
  """Returns what has a name; ValueError lists the names that there are."""
  if name not in things:
    have = ", ".join(map(repr, things)) or "none"
    raise ValueError(f"no {kind} {name!r} in the batch, it has {have}")
  return things[name]
