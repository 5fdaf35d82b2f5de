"""Windows, the nodes' side: the motion of an organ, on the CPU or on a device."""

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from palpate.tissue import order
from palpate.tissue.kernels import Kernel
from palpate.tissue.types import Views, doubles, fill, ints, struct

from .. import coupling, layout
from ..coupling import Crossing
from ..layout import Inbox, Motion, Outbox

if TYPE_CHECKING:
  from ..host import Host

_BLOCK = 128  # threads, whole warps


@struct
class Nodes:
  """A windowed organ's nodes, in the order of its vertices and in its frame."""

  nvert: int  # vertices
  nouter: int  # those on the surface, the first ones, with spare ones that have no mass yet
  nslot: int  # slots
  ngeom: int  # geoms that the window follows
  most: int  # candidates that the outbox has room for
  node: ints("nvert")  # where a vertex starts in vectors of slices
  mass: doubles("nvert")  # mass [kg]
  rest: doubles("nvert", 3)  # rest position [m]
  count: ints(1)  # candidates; 0 between steps
  extent: ints(7)  # squared speed, bounds, as `put_most` has them; nothing put between steps
  motion: Motion
  inbox: Inbox
  outbox: Outbox
  solve: Crossing


commit, move_slots, enter, push_slots, push_impulses, search, report = coupling.kernels(
  "windows/window_nodes.h",
  Nodes,
  *("commit", "move_slots", "enter", "push_slots", "push_impulses", "search", "report"),
)


def make(
  host: "Host",
  side: wp.Device,
  motion: Any,
  boxes: tuple[wp.array, wp.array],
  sizes: dict[str, int],
) -> Any:
  """Returns an organ's nodes on a device.

  Args:
    host: the organ
    side: the device
    motion: where the motion is there, `Motion`
    boxes: numbers of inbox and outbox there
    sizes: what the blocks of `layout` need
  """
  organ, s = host.organ, host.body.shape
  node = s.node.numpy()
  values = dict(
    nvert=sizes["nvert"],
    nouter=coupling.outer(organ),
    nslot=sizes["nslot"],
    ngeom=sizes["ngeom"],
    most=sizes["most"],
    node=order.offset(node),
    mass=organ.mass,
    rest=organ.mesh.rest,
    count=np.zeros(1),
    extent=np.full(7, -(2**31)),  # nothing put
    motion=motion,
    inbox=layout.carve(Inbox, boxes[0], sizes),
    outbox=layout.carve(Outbox, boxes[1], sizes),
    solve=coupling.crossing(coupling.on_body(host.body) if host.config.resident else host.arrays),
  )
  return fill(Nodes, side, values)


class Weights:
  """Rest places and masses of an organ's nodes, which cuts change.

  Args:
    host: the organ
    nodes: `Nodes` of it
  """

  def __init__(self, host: "Host", nodes: Any):
    self._host, self._nodes, self._here = host, nodes, Views(nodes)
    self._number = host.body.shape.node.numpy()
    self._mass = host.arrays["mass"].numpy().reshape(-1)

  def put(self, vert: np.ndarray):
    """Gives the nodes what these vertices have now."""
    host, nodes = self._host, self._nodes
    rest, mass = host.organ.mesh.rest, host.organ.mass
    if nodes.rest.device.is_cuda:
      nodes.rest.assign(rest)
      nodes.mass.assign(mass)
    else:
      self._here.rest[vert], self._here.mass[vert] = rest[vert], mass[vert]
    # Nodes without a mass have one in the solver, so that nothing divides by zero.
    self._mass[self._number[vert]] = np.where(mass[vert] > 0, mass[vert], 1.0)
    if host.body.device.is_cuda:
      wp.copy(host.body.state.mass, host.arrays["mass"])


def launch(kernel: Kernel, nodes: Any, count: int, device: wp.Device):
  """Launches a kernel over `count` items: one thread each on CUDA, one for all on the CPU."""
  nthread = -(-count // _BLOCK) * _BLOCK if device.is_cuda else 1
  kernel.launch(device, 1, nthread, 0, nodes, _BLOCK)
