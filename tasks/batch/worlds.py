"""The worlds of a vectorised exercise: arrays on a device, stepped and begun anew there."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import mujoco as mj
import numpy as np
import palpate.batch
import warp as wp
from palpate.batch.threads import Threads
from palpate.models import trocar
from palpate.tasks.core import episode, jaws, rules
from palpate.tasks.core.environment import Environment
from palpate.tasks.core.instrument import AROUND, DRIVE_RATES, FIFTH, FORCES, TOUCH, axes, jawed
from palpate.tasks.core.scenes import GUIDED
from palpate.tasks.core.stage import STATE
from palpate.tissue.types import allocate

from . import kernels, tally, throws
from .episodes import FRAME, HAND, Episodes, at_rest, of_physics, put_row, rows_of
from .fields import OBSERVED, Common
from .pictures import Pictures
from .states import States


class Worlds:
  """Worlds of one exercise.

  Attributes:
    fields: what every exercise has, arrays on the device
    other: the same of the other hand's instrument, or None
    guided: the same of one that the exercise itself moves, or None
    states: of the exercise's rules
    tally: what metrics are made of
    batch: the physics
    organ: the organ in it
    device: of the arrays
    task: draws the episodes
    pictures: what laparoscopes see, None where that is not observed
  """

  def __init__(
    self, environment: Environment, nworld: int, device: str, limit: int, **options: Any
  ):
    """Makes the worlds; `reset` is to come first.

    Args:
      environment: a single one of the exercise, whose task is used up by this
      nworld: how many
      device: of `palpate.batch.make`
      limit: control steps of an episode
      **options: of `palpate.batch.make`
    """
    task: Any = environment.task
    self.task, self.nworld = task, nworld
    task.share()
    stage = task.compiled(task.variants[0])
    with warnings.catch_warnings():  # the plugin's passive forces are unknown to the compiler
      warnings.filterwarnings("ignore", ".*has no equality constraints or passive forces")
      scene = task.dressed(task.variants[0])
      self.batch = palpate.batch.make(scene, nworld, device, **options)
    self.device, self._substeps = self.batch.device, episode.substeps(environment)
    self.batch.start(at_rest(self.batch.model, stage.state, STATE))
    self.states = States(task.rules, task, nworld, self.device)
    self.episodes = Episodes(task, self.states.draw, nworld)
    self.organ, self._tissue = self.batch.organ(task.organ), tuple(task.tissue())
    self._holds = list[tuple[int, str]]()  # hands, and by what they hold a thread
    dt = environment.control_timestep()
    self._steps = self.batch.watch(self._substeps)
    self.fields, self.other, self.guided = self._make(task, task.prefix, dt, limit), None, None
    if task.second:
      self.other = self._make(task, task.second, dt, limit)
      self.other.first = len(task.components) - len(axes(task.second)) - len(task.other)
      for name in ("action", "begun", "step"):
        setattr(self.other, name, getattr(self.fields, name))
      for name in ("tip_pos", "tip_quat", "tissue_force", "gripper"):
        setattr(self.fields, f"other_{name}", getattr(self.other, name))
    if self.episodes.physics.guided:
      self.guided = self._make(task, GUIDED, dt, limit)
      self.guided.begun = self.fields.begun
      self.fields.guided_tip_pos, self.fields.guided_drive = self.guided.tip_pos, self.guided.drive
    if self.fields.cutter_inside.shape[1]:
      self.batch.feel(f"{task.prefix}tip_force", task.organ)
    self.tally = self._count(task)
    self._tally = self._count(task) if self.other else None
    self._hows = tally.hows(self.device)
    self._bad = wp.zeros(1, dtype=int, device=self.device)
    self._done, self._graphs = set[str](), dict[str, Any]()
    self._shown: tuple[Any, Any] = (), None  # pictures of `show`, and of what
    seen = task.observed.pictures
    self.pictures = Pictures(self, seen, task.observed.size) if seen else None

  def _write_states(self, at: wp.array, rows: Any, worlds: np.ndarray) -> None:
    """Begins with the states that were drawn for some worlds."""
    for name in self.states.drawn:
      if name in self.states.rows:
        self._write(self.states.rows[name], at, rows[name][worlds])
      else:
        self.states.set(name, rows[name])
    self._write(self.states.records, at, self.states.table()[worlds])

  @property
  def hands(self) -> tuple[Any, ...]:
    """The fields of each hand's instrument."""
    return (self.fields, self.other) if self.other else (self.fields,)

  @property
  def instruments(self) -> dict[str, Any]:
    """The fields of each instrument, by what the names of its rows begin with."""
    all_of = {"": self.fields, "other_": self.other, "guided_": self.guided}
    return {which: s for which, s in all_of.items() if s}

  def _make(self, task: Any, prefix: str, dt: float, limit: int) -> Any:
    physics, model = self.episodes.physics, self.batch.model
    names, port = axes(prefix), trocar.trocar(model, prefix)
    sizes = dict(
      nworld=self.nworld, nvert=self.organ.nvert, nelem=len(self.organ.elem), nq=model.nq,
      nv=model.nv, nu=model.nu, nsensordata=model.nsensordata, nstep=self._substeps,
      naction=len(task.components), naxis=len(names), ncontrol=len(names) + 1,
      nside=model.ngeom + 1, nspot=len(getattr(task, "disc", ())), nbond=len(physics.organ.bonds),
      ncutter=len(physics.organ.cutters), nneedle=len(physics.organ.needles), napplied=0,
      **self._sizes_of_thread(physics if prefix == task.prefix else None),
    )  # fmt: skip
    s = allocate(Common, self.device, sizes)
    s.dt, s.limit, s.sparse = dt, limit, int(task.reward == "sparse")
    s.force_limit, s.damage = task.force_limit, task.damage
    s.depth, s.optics = port.depth, physics.optics
    self._point_at(s, prefix, model)
    drives = [model.actuator(prefix + axis).id for axis in names]
    controls = model.actuator_ctrlrange[[*drives, s.fifth if s.fifth >= 0 else drives[0]]]
    coarse = physics.coarse
    constants = {
      "held_tip": [model.site(f"{hand.prefix}tip").pos for hand in physics.hands[:len(s.held_tip)]],
      "views": throws.views(), "drive": drives, "low": controls[:, 0], "high": controls[:, 1],
      "move": DRIVE_RATES[: len(names)] * dt, "wrist": port.wrist or (0.0, 0.0),
      "elem": self.organ.elem, "coarse": coarse, "coarse0": physics.organ.xpos0[coarse],
    }  # fmt: skip
    bonds = physics.organ.bonds
    if len(bonds):
      constants |= {"bond_vert": bonds.vertices, "bond_share": bonds.area / bonds.area.sum()}
    if s.jaw >= 0:
      constants["side"] = jaws.Jaws(model, prefix).side
    for name, value in constants.items():
      getattr(s, name).assign(np.asarray(value))
    if s.behind.shape[1]:
      s.disc = self.states.rows["disc"]
    batch = self.batch
    s.ctrl, s.failures = batch.ctrl, batch.failures
    s.sensor_mean, s.sensor_steps = batch.sensor_mean, self._steps
    if rules.apply in self.states.words and prefix == task.prefix:
      s.applied = self.organ.applied
    self._read(s)
    return s

  def _sizes_of_thread(self, physics: Any) -> dict[str, int]:
    """Returns how many edges and nodes a thread has, and hands that may hold it."""
    if not physics or not physics.thread:
      return dict.fromkeys(("nedge", "nnode", "nhand", "ncrossing"), 0)
    nnode, holds = len(physics.thread.positions), self.batch.thread(physics.thread.name).holds
    self._holds = [
      (k, name) for k, hand in enumerate(physics.hands)
      if (name := f"{hand.prefix}{physics.thread.name}") in holds
    ]  # fmt: skip
    count = len(self._holds)
    return {"nedge": nnode - 1, "nnode": nnode, "nhand": count, "ncrossing": count and throws.MOST}

  def _hold(self) -> None:
    """Lets jaws hold what rules say."""
    s = self.fields
    for k, name in self._holds:
      (thread,) = self.batch.threads.values()
      thread.hold(name, s.held_node[k], s.held_place[k], s.held_firm[k])

  def _move_needle(self) -> None:
    """Lets the needle be on its thread, or off it, and where rules put it."""
    s, words = self.fields, self.states.words
    if rules.fasten in words:
      (thread,) = self.batch.threads
      self.batch.switch(f"needle_{thread}", s.fastened)
    if rules.put_away in words:
      self.batch.pose(["needle"], s.away, s.gone)
      s.gone.zero_()
      self._read(s)

  def _count(self, task: Any) -> Any:
    """Returns the sums that metrics are made of."""
    t = allocate(tally.Tally, self.device, {"nworld": self.nworld})
    limits = task.settings()
    t.contact, t.limit, t.grips = (
      limits.contact_force, task.force_limit, int(limits.grip_limit is not None)
    )  # fmt: skip
    t.h = self.batch.model.opt.timestep
    return t

  @staticmethod
  def _point_at(s: Any, prefix: str, model: mj.MjModel) -> None:
    """Writes where an instrument's joints and sensors are."""
    jaws = jawed(prefix)
    joints = [model.joint(prefix + axis) for axis in axes(prefix)]
    s.qposadr.assign(np.array([int(joint.qposadr[0]) for joint in joints]))
    s.dofadr.assign(np.array([int(joint.dofadr[0]) for joint in joints]))
    s.jaw = model.actuator(f"{prefix}jaw").id if jaws else -1
    found = [mj.mj_name2id(model, mj.mjtObj.mjOBJ_ACTUATOR, prefix + name) for name in FIFTH]
    s.fifth, head = max(found), mj.mj_name2id(model, mj.mjtObj.mjOBJ_JOINT, f"{prefix}head")
    s.head = int(model.jnt_qposadr[head]) if head >= 0 else -1
    s.opening = int(model.joint(f"{prefix}jaw_left").qposadr[0]) if jaws else -1
    sensors = [model.sensor(prefix + n).id for n in (*FORCES, *(TOUCH if jaws else ()))]
    s.sensoradr.assign(model.sensor_adr[sensors + [0] * (4 - len(sensors))])
    around = mj.mj_name2id(model, mj.mjtObj.mjOBJ_SENSOR, prefix + AROUND[0])
    s.around = int(model.sensor_adr[around]) if around >= 0 else -1  # the shaft's follows
    scrape = mj.mj_name2id(model, mj.mjtObj.mjOBJ_SENSOR, "scrape")
    s.scrape = int(model.sensor_adr[scrape]) if scrape >= 0 else -1
    needle = mj.mj_name2id(model, mj.mjtObj.mjOBJ_JOINT, "needle")
    s.needle = int(model.jnt_qposadr[needle]) if needle >= 0 else -1

  def _read(self, s: Any) -> None:
    """Brings what is of the batch up to date."""
    batch = self.batch
    s.qpos, s.qvel, s.sensordata, s.xpos = (
      batch.qpos, batch.qvel, batch.sensordata, self.organ.xpos
    )  # fmt: skip

  def _read_organ(self) -> None:
    """Brings what holds and cuts the organ up to date."""
    s, organ = self.fields, self.organ
    if s.bond_vert.shape[0]:
      held = organ.bonds
      s.bond_damage, s.bond_force, s.bond_stretch = held.damage, held.force, held.stretch
    if s.cutter_inside.shape[1]:
      found = organ.cutters
      s.cutter_inside, s.cutter_length, s.cutter_seat = found.inside, found.length, found.seat
      s.piece_count = organ.piece_count
    if s.needle_force.shape[1]:
      self.batch.poses()  # by which holes tell how far along the needle they are
      found = organ.needles
      s.needle_force, s.hole_count = found.force, found.count
      s.hole_rest, s.hole_along, s.hole_torn = found.hole_rest, found.hole_along, found.hole_torn
    if s.tension.shape[1]:
      (thread,) = self.batch.threads.values()
      s.tension, s.strand, s.broken = thread.tension, thread.xpos, thread.broken

  # Doing.

  def show(self, worlds: Sequence[int], size: tuple[int, int]) -> np.ndarray:
    """Returns pictures of some worlds  (number of worlds, height, width, 3)."""
    key = (*worlds, *size)
    if self._shown[0] != key:
      self._shown = key, Pictures(self, ["pixels"], size, worlds)
    rows = {name: value[worlds] for name, value in self.episodes.rows.items()}
    self._shown[1].show(np.arange(len(worlds)), rows)
    self._shown[1].draw()
    return self._shown[1].arrays["pixels"].numpy()

  def array(self, name: str) -> wp.array:
    """Returns one of the arrays of `states`, `fields` or `tally`; what rules tell goes first."""
    rules = self.task.rules
    if self.pictures and name in self.pictures.arrays:
      return self.pictures.arrays[name]
    if name in (*rules.observed, *rules.metrics.values()):
      return self.states.array(name)
    if name in Common.vars:
      return getattr(self.fields, name)
    own = name.removeprefix(self.task.second.replace("/", "_")) if self.other else name
    if own != name and OBSERVED.get(own, own) in Common.vars:
      return getattr(self.other, OBSERVED.get(own, own))
    known = name in rules.fields
    return self.states.array(name) if known else getattr(self.tally, name)

  def check(self, action: wp.array, first: int = 0) -> None:
    """Raises ValueError where an action is not in [-1, 1]; it names world and component.

    Args:
      action: of each world
      first: number of the first of these worlds, for people
    """
    self._bad.zero_()
    self.launch(kernels.find_bad, action.shape, [action, self._bad])
    bad = int(self._bad.numpy()[0]) - 1
    if bad >= 0:
      names = self.task.components
      world, k = divmod(bad, len(names))
      value = action.numpy()[world, k]
      raise ValueError(
        f"{self.task.name}: action {names[k]} of world {first + world} is {value}, expected a "
        "number in [-1, 1]"
      )

  def step(self, action: wp.array) -> np.ndarray:
    """Takes a control step; returns in which worlds the episode is over  (nworld,) bool."""
    self.check(action)
    self.launch_step(action)
    return self.wait()

  def launch_step(self, action: wp.array) -> None:
    """Begins a control step with actions that are allowed."""
    wp.copy(self.fields.action, action)
    for hand in self.hands:
      self.launch(kernels.act, self.nworld, [hand])
    if self.states.act:
      self._act()
    self.batch.step(self._substeps)
    self.run(self._judge)
    if self.pictures:
      self.pictures.draw()

  def _act(self) -> None:
    """Does what of an action no drive does."""
    lost = self.fields.bond_loss
    lost.zero_()
    self._over(self.states.act, self.states.records, False)
    if lost.shape[1]:
      self.organ.bonds.weaken(lost)

  def wait(self) -> np.ndarray:
    """Ends a control step; returns in which worlds the episode is over  (nworld,) bool."""
    if self.device.is_cuda:
      done = self.device.stream.record_event()
      self.episodes.draw_ahead(lambda: not done.is_complete)
    return self.fields.terminated.numpy() | self.fields.truncated.numpy()

  def _judge(self) -> None:
    """Launches what follows the steps of the physics."""
    self._measure(False)
    if self.fields.jaw >= 0:
      self._press()
    if self.fields.behind.shape[1]:
      self.launch(kernels.hide, self.fields.behind.shape, [self.fields])
    self._over(self.states.advance, self.states.records)
    self._hold()
    self._move_needle()
    self._over(tally.add, self.tally)
    if self.other:
      self.launch(tally.add, self.nworld, [self.other, self._tally])
      inputs = [self.fields, self.tally, self._tally, self._hows]
      self.launch(tally.join, self.tally.values.shape, inputs)
    self._observe(False)

  def _press(self) -> None:
    """Measures what the jaws have between them."""
    batch, s = self.batch, self.fields
    found = jaws.Jaws(batch.model, self.task.prefix)
    if not isinstance(batch, Threads):
      between: Any = kernels.Between()
      between.left, between.right = (batch.xmat(name) for name in found.names)
      between.geom, between.normal, between.force = self.organ.contacts
      between.side, between.inner = s.side, s.inner
      self.launch(kernels.press, self.nworld, [between])
      return
    inner = s.inner.numpy()

    def work(world: int):
      inner[world] = found.inner_force(batch.models[world], batch.datas[world])

    batch.each(work)

  def _measure(self, beginning: bool) -> None:
    """Measures the instruments, and brings what is of the batch up to date."""
    for hand in self.instruments.values():
      self._read(hand)
      self.launch(kernels.measure, self.nworld, [hand, beginning])
    self._read_organ()
    if self.other:
      self._over(kernels.join, self.other)

  def begin(self, worlds: np.ndarray, seeds: Sequence[int | None] | None = None) -> None:
    """Begins episodes in some worlds, numbers or a mask."""
    mask = np.zeros(self.nworld, bool)
    mask[worlds] = True
    worlds = np.flatnonzero(mask)
    if seeds is not None:
      self.episodes.seed(seeds, worlds)
    rows, s = self.episodes.take(worlds), self.fields
    s.begun.assign(mask)
    at = wp.array(worlds, dtype=int, device=self.device)
    for name in FRAME:
      self._write(getattr(s, name), at, rows[name][worlds])
    for which, hand in self.instruments.items():
      for name, row in zip(HAND, rows_of(which), strict=True) if which else ():
        self._write(getattr(hand, name), at, rows[row][worlds])
    self._write_states(at, rows, worlds)
    self.batch.reset(s.begun)
    names = [hand.prefix for hand in of_physics(self.episodes.physics).values()]
    for (which, hand), of in zip(self.instruments.items(), names, strict=True):
      # The plugin's worlds take them as they were drawn, in float64.
      pos, quat, pose = (
        rows[row] if self.device.is_cpu else getattr(hand, name)
        for name, row in zip(HAND, rows_of(which), strict=True)
      )  # fmt: skip
      if self.task.jitter:
        self.batch.place(f"{of}trocar", pos, quat, s.begun)
      self.batch.pose([of + axis for axis in axes(of)], pose, s.begun)
    for name in self.task.bodies:
      row = rows[put_row(name)]
      self.batch.place(name, row[:, :3], row[:, 3:], s.begun)
    if self.task.joints:
      values = np.concatenate([rows[put_row(name)] for name in self.task.joints], axis=1)
      self.batch.pose([*self.task.joints], values, s.begun)
    for name in self.task.threads:
      self.batch.thread(name).lay(rows[put_row(name)], s.begun)
    if self._tissue:
      self.organ.configure(mask, **{key: rows[key] for key in self._tissue})
    self.run(self._open)
    if self.pictures:
      self.pictures.show(worlds, rows)
      self.pictures.draw(s.begun)

  def _write(self, out: wp.array, at: wp.array, rows: np.ndarray) -> None:
    """Writes rows of some worlds to an array on the device."""
    words = out.size * wp.types.type_size_in_bytes(out.dtype) // 4 // self.nworld
    kind = {"f": np.float32, "V": rows.dtype}.get(rows.dtype.kind, np.int32)
    rows = np.ascontiguousarray(rows, kind)
    rows = rows.view(np.int32).reshape(len(rows), words)
    source = wp.array(rows, dtype=int, device=self.device)
    whole = wp.array(ptr=out.ptr, dtype=int, shape=(self.nworld, words), device=self.device)
    self.launch(kernels.write, rows.shape, [at, source, whole])

  def _open(self) -> None:
    """Launches what follows the beginning of episodes."""
    for hand in self.instruments.values():
      self.launch(kernels.begin, self.nworld, [hand])
    self._measure(True)
    if self.states.begin:
      self._over(self.states.begin, self.states.records, True)
      self._hold()
      self._move_needle()
    self._over(tally.start, self.tally)
    if self.other:
      self.launch(tally.start, self.nworld, [self.other, self._tally])
    self._observe(True)

  def run(self, work: Callable[[], None]) -> None:
    """Launches work; on CUDA it is recorded the second time, and replayed from then on."""
    name = work.__qualname__
    if self.device.is_cuda and name in self._done and name not in self._graphs:
      with wp.ScopedCapture(self.device) as capture:
        work()
      self._graphs[name] = capture.graph
    if name in self._graphs:
      wp.capture_launch(self._graphs[name])
    else:
      work()
    self._done.add(name)

  def _observe(self, beginning: bool) -> None:
    self._over(kernels.look, beginning)
    dim = (self.nworld, self.fields.coarse.shape[0])
    self.launch(kernels.survey, dim, [self.fields, beginning])
    self._over(self.states.observe, self.states.records, beginning)

  def _over(self, kernel: Any, *inputs: Any) -> None:
    self.launch(kernel, self.nworld, [self.fields, *inputs])

  def launch(self, kernel: Any, dim: Any, inputs: list) -> None:
    """Launches a kernel."""
    wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=64)
