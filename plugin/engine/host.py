"""One organ in one mjData, as its passive forces and its coupling see it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from palpate.tissue import body as bodies
from palpate.tissue.body import Body
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import fill

from ..forces import host
from ..forces.host import Bodies, Input, Nodes, Twin
from . import contacts, coupling, layout
from .layout import FLAG, TAIL, NodalState, WindowState
from .model import mjstruct
from .model.declare import Declaration


class Host(host.Host):
  """An organ in one mjData: the host of one world.

  Args:
    organ: constants
    body: shape, tissue and state on the organ's device
    data: address of the mjData
    model: address of the mjModel
    instance: number of the plugin instance

  Attributes:
    body: shape, tissue and state on the organ's device
    arrays: those of its state that MuJoCo's side reads and writes, on the CPU; `lagged`,
      external and lagged contact force [N] (nodes or slots, 3); `heaviest`, most times its inertia
      that a node in contact may have (1,)
    state: its numbers in mjData.plugin_state
    own: their blocks
    lift: opens those of its contacts that are not to be
  """

  alone, nworld = True, 1
  lift: Any = None

  def __init__(self, organ: Declaration, body: Body, data: int, model: int, instance: int):
    self.organ, self.config, self.body = organ, organ.config, body
    self.data, self.model, self.instance = data, model, instance
    self.device = wp.get_device("cpu")
    self.arrays = dict(coupling.on_body(body))
    if body.device.is_cuda:
      for name, there in self.arrays.items():
        self.arrays[name] = wp.zeros(there.shape, dtype=float, device="cpu", pinned=True)
    size = organ.windows.nslot if organ.windows else body.shape.nnode
    self.arrays["lagged"] = wp.zeros((size, 3), dtype=wp.float64, device="cpu")
    self.arrays["heaviest"] = wp.ones(1, dtype=wp.float64, device="cpu")
    self.number, self._flags = body.numbers, wp.zeros(len(FLAG), dtype=int, device="cpu")
    self._rest = wp.array(self._from(), dtype=wp.float64, device="cpu")  # that of all `nodes`
    self._surface: dict[str, Any] = {}
    self._there: dict[str, np.ndarray] = {}  # arrays of it
    self.bind(model)

  def bind(self, model: int):
    """See `Host`."""
    organ, self.model = self.organ, model
    kind, sizes = WindowState if organ.windows else NodalState, coupling.sizes(organ)
    size = layout.size(kind, sizes)
    self.state = coupling.plugin_state(model, self.data, self.instance, size)
    self.own = layout.carve(kind, self.state, sizes)
    self.bodies = coupling.mujoco_arrays(model, self.data, Bodies)
    motion = self.own.motion if organ.windows else self.own
    disp, vel = (array.reshape((-1, 3)) for array in (motion.disp, motion.vel))
    values = dict(
      windowed=int(organ.windows is not None), inner=organ.mesh.nskin,
      rest=self._rest, disp=disp, vel=vel, qposadr=organ.qposadr, dofadr=organ.dofadr,
      frame=organ.frame, origin=organ.origin,
    )  # fmt: skip
    self.nodes = fill(Nodes, "cpu", values)
    self._rest.assign(self._from())
    self._fill_input()

  def _from(self) -> np.ndarray:
    """Returns what displacements are from: of dofs, qpos0 whatever was cut [m], (nvert, 3)."""
    mesh = self.organ.mesh
    if self.organ.windows:
      return mesh.rest
    return np.concatenate([mesh.whole.rest[: mesh.nskin], mesh.rest[mesh.nskin :]])

  def _fill_input(self):
    values = {name: self.arrays[name] for name in ("force_ext", "vel", "dvel", "status")}
    quiet = np.zeros(1)
    if self.organ.windows:
      quiet = coupling.wrap(self.own.tail.ptr + 8 * TAIL.quiet, 1)
    hold = np.zeros((0, 0, 6, 8)) if self.springs is None else self.springs
    node = self.body.shape.node.numpy()
    self.input = fill(Input, "cpu", values | {"node": node, "quiet": quiet, "hold": hold})

  def become(self, organ: Declaration):
    """Takes the organ that a cut has made, or a state that was set."""
    self.organ = organ
    self._rest.assign(self._from())
    for name, values in self._meshes().items() if self._there else ():
      self._there[name][:] = values

  def _meshes(self) -> dict[str, np.ndarray]:
    mesh = self.organ.mesh
    return {"elem": mesh.elem[None, : mesh.whole.nelem], "tet": mesh.tet[None],
            "flat": mesh.rest[None]}  # fmt: skip

  def surface(self) -> dict[str, Any]:
    """See `Host`."""
    if not self._surface:
      mesh, kinds = self.organ.mesh, {"elem": int, "tet": int, "flat": wp.float64}
      self._surface = {"nelem": mesh.whole.nelem, "ntet": len(mesh.tet), "mesh": np.zeros(1)}
      for name, values in self._meshes().items():
        self._surface[name] = wp.array(values, dtype=kinds[name], device="cpu")
        self._there[name] = self._surface[name].numpy()
    return self._surface

  def open_contacts(self):
    """See `Host`."""
    self.lift.launch()

  def ties(self, flex: int) -> coupling.Ties:
    """See `Host`."""
    return coupling.ties(self.data, flex)

  def lifted(self) -> wp.array:
    """See `Host`."""
    flex = self.organ.windows.flex if self.organ.windows else self.organ.flex
    row = contacts.lifted(self.model, self.data)[flex : flex + 1]
    return wp.array(row, dtype=int, device="cpu", copy=False)

  def tools(self, name: str) -> np.ndarray:
    """See `Host`."""
    found = getattr(self.d, name)[None]
    return found.reshape(1, -1, 3, 3) if name == "geom_xmat" else found

  def need_springs(self):
    """See `Host`."""
    if self.springs is None:
      there = bodies.hold(self.body)
      cuda = self.body.device.is_cuda
      self.springs = wp.zeros_like(there, device="cpu", pinned=True) if cuda else there
      self._fill_input()

  def need_pairs(self):
    """See `Host`."""
    cuda = self.body.device.is_cuda
    for name, there in bodies.pairs(self.body).items():
      self.arrays[name] = wp.clone(there, device="cpu", pinned=True) if cuda else there

  def send_springs(self):
    """Brings the springs to the device of the solve."""
    state = self.body.state
    if not self.body.device.is_cuda:
      return
    if self.springs is not None:
      wp.copy(state.hold, self.springs)
    for name in bodies.PAIRS if "paired" in self.arrays else ():
      wp.copy(getattr(state, name), self.arrays[name])

  def flags(self) -> wp.array:
    """See `Host`."""
    return self._flags

  def rows(self, block: str, width: int) -> wp.array:
    """See `Host`."""
    array = getattr(self.own, block)
    return array.reshape((1, *array.shape))

  def mesh(self, world: int) -> Mesh:
    """See `Host`."""
    return self.organ.mesh

  def load(self, kernel: Twin):
    """See `Host`."""
    kernel.one.load(self.device)

  def launch(self, kernel: Twin, fields: Any, count: int = 0, arg: int = 0):
    """See `Host`."""
    kernel.one.launch(self.device, 1, 1, arg, fields)

  def command(self, kernel: Twin, fields: Any, count: int = 0, arg: int = 0) -> Callable[[], None]:
    """See `Host`."""
    return kernel.one.command(fields, arg).launch

  # What there is now.

  @property
  def d(self) -> mjstruct.Struct:
    """The mjData."""
    return mjstruct.both(self.model, self.data)[1]

  def body_frame(self, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns rotation (3, 3) and place [m] (3,) of a body now."""
    d = self.d
    return d.xmat[body].reshape(3, 3), d.xpos[body]

  def places(self, vert: np.ndarray, now: bool = True) -> np.ndarray:
    """Returns where vertices are in the world, now or at rest [m], (n, 3)."""
    organ = self.organ
    if not now:
      return organ.origin + organ.mesh.rest[vert] @ organ.frame.T
    if organ.windows:
      u = self.own.motion.disp.numpy()[vert]
    else:
      qpos = np.maximum(organ.qposadr[vert], 0)[:, None] + np.arange(3)
      u = self.d.qpos[qpos] - self.m.qpos0[qpos]
      u = (organ.dofadr[vert] >= 0)[:, None] * u
    return organ.origin + (self._from()[vert] + u) @ organ.frame.T
