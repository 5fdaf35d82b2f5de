"""Worlds on a GPU: tools and contacts by mujoco_warp, organs by the tissue's own kernels.

A step, in all worlds at once: the slots stand on the nodes nearest to the tools, the tissue takes
its step, mujoco_warp takes one with the windows' contacts and the force that brings the tissue's
along (`coupling/node.h`), and the nodes take over what contacts made of the slots.
"""

import functools
import warnings
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from palpate.camera import Camera
from palpate.engine import graphs
from palpate.engine import plugin as engine
from palpate.forces.cohesive_bonds import Bonds
from palpate.organ import instances
from palpate.tissue import device as devices

from . import kernels, rods, states, strip_organs
from .base import Batch
from .contact import contacts, convex
from .contact.fixed_order import FixedOrder, is_enough
from .contact.rounding import Rounding, refined
from .mjw.compiling import compile_ahead
from .mjw.private import DeterminismType, OverflowType, of_threads
from .organ import host
from .organ.organ import Organ
from .reset import Rest

_CONTACTS = 16  # of a world, of tools with each other and with what is fixed
# Of the constraint solver, at most: all worlds wait for the one that takes longest. Few take more
# than 6, but a step that ends before its contacts are solved is off by half of its force.
_ITERATIONS = 20
_FINE = 1e-11  # tolerance of the constraint solver where there are threads
_LOST = int(OverflowType.NEFC | OverflowType.NJMAX_NNZ | OverflowType.NARROWPHASE)


class Worlds(Batch):
  """A batch in the memory of one device.

  Args:
    spec: the scene
    nworld: number of worlds
    device: Warp device
    nodes: slots of an organ: the nodes that its tools touch at once, and their neighbours; one
      number, or one by name; None for what the tools' sizes ask for
    deterministic: whether runs repeat to the bit whatever the device does
  """

  def __init__(
    self,
    spec: mujoco.MjSpec,
    nworld: int,
    device: str,
    nodes: int | dict[str, int] | None = None,
    deterministic: bool = False,
  ):
    target = _resolve(device)
    model = spec.compile()
    super().__init__(model, nworld, target)
    self.scratch = mujoco.MjData(model)  # its plugin knows what the organs are
    spaces = {
      name: engine.find(self.scratch._address, number) for name, number in instances(model).items()
    }
    declared = [w.organ for w in spaces.values()]
    sewn = [
      engine.find_thread(self.scratch._address, number)
      for number in instances(model, dim=1).values()
    ]
    if sewn and model.opt.solver != mujoco.mjtSolver.mjSOL_NEWTON:
      kind = mujoco.mjtSolver(model.opt.solver).name.removeprefix("mjSOL_")
      raise ValueError(
        f"thread {sewn[0].organ.name!r}: solver is {kind}, expected Newton in a batch on a GPU"
      )
    tools = [strip_organs.tools_of(model, organ) for organ in declared]
    threads = [w.organ for w in sewn]
    lines = [strip_organs.lines_of(model, organ, threads) for organ in declared]
    nslots = [
      strip_organs.slots_for(model, *each, nodes)
      for each in zip(declared, tools, lines, strict=True)
    ]
    bare, slots = strip_organs.strip(spec, model, declared, nslots, threads)
    self._kept, self.bare = strip_organs.kept(model, declared), bare
    self._graphs: dict[str, tuple[Any, Any]] = {}
    with wp.ScopedDevice(target):
      self._put(bare, nslots, tools, lines, deterministic, spaces, sewn)
      self._allocate()
      self.bad, self.lost = wp.zeros(nworld, dtype=int), wp.zeros(nworld, dtype=int)
      self.mask = wp.zeros(nworld, dtype=wp.bool)
      self.qpos_out, self.qvel_out = self._arrays["qpos"], self._arrays["qvel"]
      self._organs = {
        name: Organ(self, w, s, t, [threads[k] for k in found])
        for (name, w), s, t, found in zip(spaces.items(), slots, tools, lines, strict=True)
      }
      self.rods = rods.Rods(self, sewn)
      self._threads = self.rods.all
      for organ, found in zip(self._organs.values(), lines, strict=True):
        organ.follow([list(self.rods.all.values())[k] for k in found])
      self.aims, self.weighs = self._join()
      self._rest = Rest(self, bare)
      self._teller = states.Teller(self)
      self._alias()
      self._sensed: Any = kernels.Sensed()
      self._sensed.adr = wp.array([*model.sensor_adr, model.nsensordata], dtype=int)
      self._sensed.data, self._sensed.count = self.d.sensordata, wp.zeros(nworld, dtype=int)
      self._sensed.peak, self._sensed.mean = self._sums["sensor_peak"], self._sums["sensor_mean"]
      self._sensed.seen = self._make(0, model.nsensordata)
      self._felt: list[tuple[Organ, int]] = []
      self._callbacks()
      try:
        self.record()
      except (RuntimeError, ValueError) as error:
        if not deterministic:
          raise
        raise ValueError(
          f"nworld is {nworld}, too many for deterministic=True on {device}: mujoco_warp has no "
          f"room to order its sums ({error}); expected fewer"
        ) from None
    self._warned = False
    self.reset()

  def _put(self, bare, nslots, tools, lines, deterministic, spaces, sewn):
    """Makes mujoco_warp's model and data."""
    model, nworld = self.model, self.nworld
    self.paired = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    most = [contacts.most_of(model, *each) for each in zip(tools, lines, nslots, strict=True)]
    condim = int(max([1, *model.flex_condim, *model.geom_condim]))
    each = 1 if condim == 1 else 2 * (condim - 1) if self.paired else condim
    most += [rods.most_contacts(w) for w in sewn]
    between = _CONTACTS if strip_organs.tools_meet(bare) else 0
    held = bare.neq - model.neq  # of which one at a time is active, in place of one of the scene's
    self.njmax = strip_organs.rows_of(bare) - 6 * held + (between + sum(most)) * each
    ncon = between + sum(most)
    times = 3 if deterministic else 1  # rows are kept, and spread over all dofs
    size = states.bytes_of(bare, times * self.njmax, ncon) + sum(
      Organ.bytes_of(w, self.device) for w in spaces.values()
    )
    size += sum(map(rods.bytes_of, sewn))
    size += sum(convex.bytes_of(model.geom_type[t], n) for t, n in zip(tools, nslots, strict=True))
    devices.refuse_crowd(nworld, size, devices.room_of(self.device), str(self.device))
    if deterministic:  # which is what `fixed_order` knows
      bare.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    try:
      own = ("dof_armature", "body_invweight0", "body_pos", "body_quat", "geom_friction")
      own += ("eq_data", "eq_solref", "eq_solimp") if held else ()
      sizes: dict[str, int] = {name: nworld for name in own}
      self.m = mjw.put_model(bare, batch_sizes=sizes)
    except (NotImplementedError, ValueError) as error:
      raise ValueError(f"mujoco_warp cannot have this scene: {error}") from None
    start = mujoco.MjData(bare)
    mujoco.mj_forward(bare, start)
    # A row has the three slots of a triangle, two nodes of a thread, and whatever hangs on a tool.
    nodes = sum(int(w.organ.free.sum()) for w in sewn)
    nonzero = self.njmax * (bare.nv - 3 * (sum(nslots) + nodes) + 9 + 6 * bool(sewn))
    self.d = mjw.put_data(
      bare, start, nworld=nworld, nconmax=ncon, njmax=self.njmax, njmax_nnz=nonzero
    )
    # A contact with an organ has geom -1, of which mujoco_warp looks up the body, counting from the
    # end. Contact sensors take the world's, so that no body of the scene seems touched; force
    # sensors need it as it is, to leave such contacts out as MuJoCo does.
    if (bare.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT).any():
      self.m.geom_bodyid = wp.array([*bare.geom_bodyid, 0], dtype=int)
    self.m.opt.warn_overflow = 0  # counted, see `overflow`
    self.m.opt.iterations = min(self.m.opt.iterations, _ITERATIONS)
    if sewn:  # nodes' inertia is a millionth of that of walls, by whose mean it is measured
      self.m.opt.tolerance.fill_(_FINE)
    ordered = deterministic and not sewn and is_enough(self.m, bare)
    self._order = FixedOrder(self.m, self.d) if ordered else None
    self._rounding = Rounding(self.m, self.d) if sewn else None
    sorted_by_warp = deterministic and not ordered
    self.m.opt.deterministic = int(DeterminismType.ALL if sorted_by_warp else DeterminismType.NONE)
    # The windows' triangles have no forces and contacts of mujoco_warp's own, threads no forces.
    self.m.nflexedge, self.m.nflexelem = 0, sum(len(w.organ.rest) - 1 for w in sewn)
    self.m.nflex = len(sewn) or self.m.nflex
    gravity = np.tile(model.opt.gravity, (nworld, 1)).astype(np.float32)
    self.m.opt.gravity = wp.array(gravity, dtype=wp.vec3)

  @functools.cached_property
  def bodies(self) -> Any:
    """`WorldBodies` of its worlds."""
    return host.bodies_of(self)

  @functools.cached_property
  def numbers(self) -> np.ndarray:
    """Numbers of the model's bodies in mujoco_warp's, see `host.numbers_of`."""
    return host.numbers_of(self)

  def _join(self) -> tuple[bool, bool]:
    """Lets organs have their forces.

    Returns:
      whether these ask where bodies are, and whether they add to the inertia of these
    """
    organs = list(self._organs.values())
    twin = lambda force: self._organs[force.host.organ.name].forces.of(type(force))  # noqa: E731
    for organ in organs:
      organ.forces.take(organ.space.forces, twin)
      currents = organ.space.cutters.by_current.values()
      organ.forces.of(Bonds).currents = [current.burning for current in currents]
    for organ in organs:
      organ.host.bind(organ.host.model)
    for organ in organs:
      organ.forces.bind()
    forces = [each for organ in organs for each in organ.forces]
    return any(each.aims for each in forces), any(each.weighs for each in forces)

  def _alias(self):
    """Lets controls, sensors and time be mujoco_warp's own arrays."""
    for name in ("ctrl", "sensordata", "time"):
      self._arrays[name] = getattr(self.d, name)

  def _callbacks(self):
    organs = list(self._organs.values())
    order = self._order if strip_organs.tools_meet(self.bare) else None

    def touch(m, d):
      if order:
        order.sort_contacts()
      for organ in organs:
        organ.touch()

    def push(m, d):
      if self._order:
        self._order.sort()
      sewn = any(organ.sews for organ in organs)
      if sewn:
        self.rods.begin()
      for organ in organs:
        organ.follow_threads()
        organ.push()
      if not sewn:
        self.rods.begin()
      if self.weighs:
        mjw.factor_m(m, d)

    self.m.callback.contactfilter = touch
    self.m.callback.passive = push

  def begin(self):
    """Launches the part of a step before mujoco_warp's."""
    if self.aims:  # bodies are where the last step found them
      mjw.kinematics(self.m, self.d)
      mjw.com_pos(self.m, self.d)
      mjw.com_vel(self.m, self.d)
    self.rods.aim()
    for organ in self._organs.values():
      organ.begin()

  def step_tools(self):
    """Launches mujoco_warp's step, with the windows' contacts."""
    each = self._order or self._rounding
    with of_threads(), each.adding() if each else refined():
      mjw.step(self.m, self.d)

  def end(self):
    """Launches the part after it."""
    for organ in self._organs.values():
      organ.end()
    for thread in self.rods.all.values():
      thread.end()

  def _once(self):
    self.begin()
    self.step_tools()
    self.end()
    for organ, adr in self._felt:
      organ.feel(adr)
    self._sense(kernels.sum_up)

  def _feel(self, sensor: int, organ: str):
    adr = int(self.model.sensor_adr[sensor])
    self._felt.append((self._organs[organ], adr))
    self.record()

  def _sense(self, kernel):
    if self.model.nsensor:
      wp.launch(kernel, dim=self.nworld, inputs=[self._sensed], device=self.device, block_dim=64)

  def _watch(self, out: wp.array) -> wp.array:
    self._sensed.seen = out
    self.record()
    return out

  def record(self):
    """Records the graphs."""
    with wp.ScopedDevice(self.device):  # where mujoco_warp makes its arrays
      self._record()

  def _record(self):
    # After steps worlds that are not finite are reset and counted.
    work = {"step": self._once, "after": self._rest.find}
    work |= {"reset": self._rest.launch, "look": self._rest.look}
    if not self.device.is_cuda:
      for each in (*self._organs.values(), *self.rods.all.values()):
        each.load()
    elif not self._graphs:  # what this does to the worlds, their first reset undoes
      compile_ahead(self.device, work.values())
      for each in work.values():
        each()
    for name, each in work.items():
      # On the CPU Warp takes a generic kernel's overloads, which resets have, for one another.
      recorded = self.device.is_cuda or name == "step"
      self._graphs[name] = (graphs.record(self.device, each) if recorded else None, each)

  def _run(self, name: str):
    graph, work = self._graphs[name]
    with wp.ScopedDevice(self.device):
      if graph is None or self.device.is_capturing:  # a graph launches no other
        work()
      else:
        wp.capture_launch(graph)

  # Doing.

  def _step(self, n: int):
    for sums in self._sums.values():
      sums.zero_()
    for k in range(n):
      self._run("step")
      for organ in self._organs.values():
        organ.stepped(k + 1 == n)
    self._sense(kernels.average)
    self._run("after")

  def _reset(self, mask: wp.array):
    wp.copy(self.mask, mask)
    self._run("reset")

  def _check_own(self, data: mujoco.MjData):
    organs = {name: organ.declared for name, organ in self._organs.items()}
    self._check_state(data, organs)

  def _start(self, data: mujoco.MjData):
    self._check_own(data)
    states.keep(self, self._rest.starts, data)

  def _pose(self, adr: np.ndarray, values: np.ndarray, mask: wp.array):
    at = [np.searchsorted(kept, numbers) for kept, numbers in zip(self._kept, adr.T, strict=True)]
    wp.copy(self.mask, mask)
    self._rest.pose(np.stack(at, 1), values)
    self._run("look")

  def _switch(self, equality: int, active: wp.array):
    inputs = [active, equality, self.d.eq_active]
    wp.launch(kernels.switch, dim=self.nworld, inputs=inputs, device=self.device)

  def _place(self, body: int, pos: np.ndarray, quat: np.ndarray, mask: wp.array):
    wp.copy(self.mask, mask)
    self._rest.place(self.bare.body(self.model.body(body).name).id, pos, quat)
    self._run("look")

  def _configure(self, worlds: np.ndarray, gravity: np.ndarray | None, friction: dict):
    changes: list[tuple[wp.array, tuple, np.ndarray]] = []
    if gravity is not None:
      changes.append((self.m.opt.gravity, (), gravity))
    for g, values in friction.items():
      changes.append((self.m.geom_friction, (g, 0), values))
      changes += [change for organ in self._organs.values() for change in organ.rubs(g, values)]
    for array, place, values in changes:
      whole = array.numpy()
      whole[(worlds, *place)] = values
      array.assign(whole)
    for organ in self._organs.values():
      organ.wake(worlds)

  def _tell(self):
    self._teller.tell()

  def _get_state(self, world: int, data: mujoco.MjData):
    states.pull(self, world, data)

  def _set_state(self, world: int, data: mujoco.MjData):
    self._check_own(data)
    states.push(self, world, data)

  @property
  def kept(self) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of qpos and qvel in the model that are not an organ's."""
    return self._kept

  def camera(self, *args: Any, **kwargs: Any) -> Camera:
    """Returns a camera, see `Batch`."""
    return Camera(self, *args, **kwargs)

  def poses(self) -> tuple[wp.array, wp.array, np.ndarray]:
    """Returns where bodies are now, see `Batch`."""
    with wp.ScopedDevice(self.device):
      mjw.kinematics(self.m, self.d)
    return self.d.xpos, self.d.xmat, self.numbers

  def xmat(self, body: str) -> wp.array:
    """Returns the axes of a body in the last step, (nworld,) of mat33."""
    found: Any = self.d.xmat
    return found[:, self.bare.body(body).id]

  @property
  def overflow(self) -> wp.array:
    """Most touched triangles, or nodes, that windows had no room for so far, (nworld,)."""
    self._rest.count_lost(_LOST)
    counted = self._counts["overflow"]
    if not self._warned and counted.numpy().any():
      self._warned = True
      warnings.warn(
        f"in {np.count_nonzero(counted.numpy())} worlds windows had no room for what tools touch; "
        "give `make` more nodes",
        stacklevel=2,
      )
    return counted

  @property
  def counted(self) -> wp.array:
    """Memory of `overflow`."""
    return self._counts["overflow"]


def _resolve(device: str):
  devices.init()
  if device == "warp-cpu":  # to test without a GPU
    return wp.get_device("cpu")
  return devices.resolve(device, 0)
