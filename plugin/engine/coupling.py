"""What a coupling does in a step, and the memory that it shares with MuJoCo and with the solver.

An organ's new velocity v + dv reaches MuJoCo as a force, see `coupling/node.h`: on all of its
nodes (`nodal`), or on those that windows hold (`windowed`). Where tissue is stiff for the time step
(`inertia.stiffness`) what contacts add to it is put right after MuJoCo's step: it becomes
A^-1 h (f_c_new - f_c), the organ's own response, so that the organ has taken an implicit step under
the forces that act in it, and gains no more energy than they give. The inertia that MuJoCo meets
then is a guess of what a tool meets, and follows the organ's answers.
"""

import collections
import ctypes
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue import types
from palpate.tissue.body import Body
from palpate.tissue.kernels import Kernel, kernel
from palpate.tissue.types import DIMS, Array, State, System, also, lent, struct

from . import layout
from .layout import NodalState, WindowState
from .model import mjstruct, shared

if TYPE_CHECKING:
  from .model.declare import Declaration

MOST_TIES = 64  # of a thread
_HUGE = 1e6  # more than any displacement, velocity or force of an organ [m, m/s, N]


# Gives vertices, all or some, their part of what they were of values by mass, see `Cuts.share`.
Share = Callable[..., np.ndarray]


class Phases:
  """What a coupling launches around the solve, in the order of a step.

  Each is recorded as a graph, or part of one; those that do not say where run on the CPU. What a
  coupling has no use for launches nothing.

  Attributes:
    side: device of the phases that are not on the CPU
    boxes: blocks of the plugin state and of what crosses in a step, see `layout`; windows
    resident: keeper of a motion that stays on `side`, or None
  """

  side: Any
  boxes: Mapping[str, Any] = MappingProxyType({})
  resident: Any = None

  def place(self):
    """Makes the model fit the plugin state, before a step whose state came from outside."""

  def gather(self):
    """Reads MuJoCo's arrays."""

  def enter(self):
    """Fills the solver's state, on `side`; the solve follows."""

  def look(self):
    """Looks at the solution, on `side`."""

  def scatter(self):
    """Adds the passive force; MuJoCo's step follows."""

  def leave(self):
    """Takes the contact forces that MuJoCo found, and what they changed by."""

  def push(self):
    """Fills the solver's right-hand side with these impulses, on `side`; its response follows."""

  def answer(self):
    """Ends the step with the response, on `side`."""

  def end(self):
    """Ends the step where there was none."""

  def advance(self):
    """Steps the plugin state."""

  def motion(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns displacement and velocity of the vertices, in the organ's frame, (nvert, 3) each."""
    raise NotImplementedError

  def contact_force(self) -> np.ndarray:
    """Returns the contact force that the organ took in the last step, there [N], (nvert, 3)."""
    raise NotImplementedError

  def reshape(self, touched: np.ndarray | None = None):
    """Takes the mesh and the masses that the organ has now; `touched` as in `cut`, None for all."""

  def put(self, vert: np.ndarray, disp: np.ndarray | None, vel: np.ndarray | None):
    """Gives vertices that move a displacement and a velocity, None for what they have.

    Args:
      vert: the vertices
      disp: displacement of all vertices [m]  (nvert, 3)
      vel: velocity of all vertices [m/s]     (nvert, 3)
    """

  def divide(self, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """Gives vertices that a cut has divided their part of what there is from the last steps.

    Args:
      group: of vertices that were one, which  (n,)
      member: those vertices                   (n,)
      share: their part of its mass            (n,)
    """

  def carry(
    self, changed: np.ndarray, disp: np.ndarray, vel: np.ndarray,
    group: np.ndarray, member: np.ndarray, share: np.ndarray,
  ):  # fmt: skip
    """Gives vertices the motion that they have after a cut; see `put` and `divide`."""
    self.put(changed, disp, vel)
    self.divide(group, member, share)

  def foresee(self):
    """Guesses what the next `gather` reads."""

  def enter_ahead(self):
    """Fills the solver's state with that, on `side`; the solve follows."""

  def look_ahead(self):
    """Looks at the solution that was begun so, on `side`."""


def memory(*names: str) -> Callable[[type], Any]:
  """Returns a decorator: a struct has MuJoCo's own memory under its own names as well.

  What type and shape that has MuJoCo says itself, see `mjstruct.declared`.
  """
  kinds = {ctypes.c_double: wp.float64, ctypes.c_int: wp.int32}
  known = {name: mjstruct.declared(name) for name in names}
  return lent({name: Array(kinds[kind], shape) for name, (kind, shape) in known.items()})


@memory(
  *("timestep", "gravity", "disableflags", "qpos0", "body_mass", "body_invweight0"),
  *("dof_armature", "dof_M0", "dof_invweight0", "geom_type", "geom_size", "geom_aabb"),
  *("geom_rbound", "flex_elem", "qpos", "qvel", "qfrc_applied", "qfrc_passive", "qfrc_constraint"),
  *("xfrc_applied", "geom_xpos", "geom_xmat", "body_awake", "M", "qLD", "qLDiagInv"),
)
class Mujoco:
  """What a coupling reads and writes of MuJoCo's own memory."""


@struct
@also(State, "step", "disp", "vel", "mass", "force_ext", "dvel_warm", "dvel", "expected")
@also(System, "rhs", "sol", "status", "ratio")
class Crossing:
  """What of a body's `State` and `System` a coupling reads and writes, for one world."""


CONSTANTS = {
  "MOST_TIES": MOST_TIES,
  "DISABLE_GRAVITY": int(mujoco.mjtDisableBit.mjDSBL_GRAVITY),
  **{f"GEOM_IS_{name}": int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in (
    "PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER"
  )},
  **types.CONSTANTS,
  **layout.CONSTANTS,
}  # fmt: skip


def kernels(header: str, kind: Any, *names: str, own: bool = False) -> list[Kernel]:
  """Returns the kernels of a header that take a struct, `own` as `kernel` does."""
  return [kernel(name, header, kind, CONSTANTS, own=own) for name in names]


def wrap(address: int, shape: Any, dtype: type = wp.float64) -> wp.array:
  """Returns MuJoCo's own memory as a Warp array."""
  return wp.array(ptr=address, dtype=dtype, shape=shape, device="cpu")


def mujoco_arrays(model: int, data: int, kind: Any = Mujoco):
  """Returns `Mujoco`, or what has MuJoCo's names in another struct, for an mjModel and mjData."""
  m = mjstruct.Model.from_address(shared.of(model, data).model(model))
  d = mjstruct.Data.from_address(data)
  option, start = type(m.opt), model + mjstruct.Model.opt.offset
  out = kind()
  for name, dims in DIMS[kind.key].items():
    if hasattr(option, name):
      address = start + getattr(option, name).offset
    elif hasattr(m, name) or hasattr(d, name):
      address = getattr(m if hasattr(m, name) else d, name)
    else:
      continue
    shape = [getattr(m, n) if isinstance(n, str) else n for n in dims]
    setattr(out, name, wrap(address, shape, kind.vars[name].type.dtype))
  return out


class Ties:
  """What holds a thread, in one mjData or in all worlds of a batch, filled anew for each step.

  Attributes:
    arrays: arrays of `Rod` by name, a row a world
    span: the least and the greatest place on it that is held [m]  (nworld, 2)
    aims: by who holds it, what adds to these, and what follows once all have
    lead: lets the thread take its step before an organ's, given that's instance
    led: whether it has
    moved: how far its nodes have moved along it [m]  (nworld, nnode); None where they do not
    again: lets it take that anew for the same, which has found the contacts again
  """

  def __init__(self, nworld: int = 1, device: Any = "cpu"):
    kinds: dict[str, tuple[tuple[int, ...], Any]]
    kinds = {"tie_count": ((1,), int), "tie_edge": ((MOST_TIES,), int)}
    kinds["tie_value"] = (MOST_TIES, len(layout.TIE)), wp.float64
    self.arrays = {
      name: wp.zeros((nworld, *shape), dtype=kind, device=device)
      for name, (shape, kind) in kinds.items()
    }
    self._none = wp.array(np.tile([np.inf, -np.inf], (nworld, 1)), dtype=wp.float64, device=device)
    self.span = wp.clone(self._none)
    self.aims: dict[Any, tuple[Callable[[], None], Callable[[], None]]] = {}
    self.lead: Callable[[int], None] = lambda instance: None
    self.led = False
    self.moved: wp.array | None = None
    self.again: Callable[[int], None] = lambda instance: None

  def track(self, nnode: int) -> wp.array:
    """Returns `moved`, which the thread writes as its step begins."""
    if self.moved is None:
      shape = len(self._none), nnode
      self.moved = wp.zeros(shape, dtype=wp.float64, device=self._none.device)
    return self.moved

  def aim(self):
    """Fills the arrays."""
    if self.aims:
      self.arrays["tie_count"].zero_()
      wp.copy(self.span, self._none)
      for phase in range(2):
        for each in self.aims.values():
          each[phase]()


_ties: dict[tuple[int, int], Ties] = collections.defaultdict(Ties)


def ties(data: int, flex: int) -> Ties:
  """Returns what holds the thread of a flex in an mjData."""
  return _ties[data, flex]


def again(data: int, instance: int):
  """Lets threads of an mjData take their steps anew that they have taken before an organ's."""
  for tied in [each for key, each in _ties.items() if key[0] == data]:
    tied.again(instance)


def forget(data: int):
  """Forgets what holds threads in an mjData that is freed."""
  for key in [key for key in _ties if key[0] == data]:
    del _ties[key]


def on_body(body: Body) -> dict[str, wp.array]:
  """Returns a body's arrays of `Crossing`."""
  return {
    name: getattr(body.state if hasattr(body.state, name) else body.system, name)
    for name in Crossing.vars
  }


def crossing(arrays: dict[str, wp.array]):
  """Returns `Crossing` of these arrays."""
  out = Crossing()
  for name in Crossing.vars:
    setattr(out, name, arrays[name])
  return out


def mass_addresses(m: mjstruct.Struct, dofs: np.ndarray) -> np.ndarray:
  """Returns where the diagonal of each dof lies in mjData.M, the inertia that MuJoCo uses."""
  return m.M_rowadr[dofs] + m.M_rownnz[dofs] - 1


def outer(organ: "Declaration") -> int:
  """Returns how many vertices there are on an organ's surface, or may be by cuts."""
  return organ.mesh.nskin


def sizes(organ: "Declaration") -> dict[str, int]:
  """Returns what the blocks of an organ's plugin state need."""
  relaxes = organ.config.relax_share > 0
  out = {"nrelax": int(organ.free.sum()) if relaxes else 0}
  whole = organ.mesh.whole
  out |= cut_sizes(whole.nelem, whole.nvert, whole.spare, bool(len(whole.tet)))
  out["nbond"] = int(organ.free[: outer(organ)].sum()) if organ.config.bonded else 0
  out |= {"nblade": len(organ.config.cutters), "nneedle": len(organ.config.needles)}
  solid = len(organ.mesh.tet) > 0
  if organ.windows is None:
    return out | nodal_sizes(organ.nfree, 3 * (organ.mesh.nvert - organ.mesh.nskin) * solid)
  win = organ.windows
  out["nrest"] = outer(organ) if organ.config.support else 0
  followed = win.geom.size + win.line.size
  return out | {"nvert": organ.mesh.nvert, "nslot": win.nslot, "ngeom": followed}


def nodal_sizes(nfree: int, ninner: int) -> dict[str, int]:
  """Returns what dofs of MuJoCo, and numbers of nodes inside, need in the plugin state."""
  return {"nfree": nfree, "ninner": ninner, "nmoving": nfree + ninner}


def cut_sizes(nelem: int, nvert: int, spare: int, solid: bool) -> dict[str, int]:
  """Returns what the mesh of an organ needs in the plugin state: nothing without room for cuts."""
  if not spare:
    return dict(layout.NO_CUTS)
  walls = layout.WALLS * spare * solid
  return {"ncorner": nelem + walls, "nplace": nvert, "nspare": spare, "ncuts": 1}


def spans(organ: "Declaration") -> dict[str, slice]:
  """Returns where the blocks of an organ's plugin state lie."""
  return layout.spans(WindowState if organ.windows else NodalState, sizes(organ))


def check_state(organ: "Declaration", state: np.ndarray):
  """Makes sure that a plugin state that was set from outside is one of this organ.

  Raises:
    ValueError: it is not, or its numbers cannot be.
  """
  where = spans(organ)
  if state[where["signature"]].any():
    raise ValueError(
      "plugin_state is not one of this organ, but saved from another model or damaged; reset the "
      "data, or set a state that was saved from it"
    )
  # Forces come last of what is bounded.
  last = "force" if organ.windows else "before"
  if not (np.abs(state[: where[last].stop]) < _HUGE).all():
    raise ValueError(
      f"plugin_state has a number that is not finite or over {_HUGE:g}, expected what was saved"
    )


def plugin_state(model: int, data: int, instance: int, size: int) -> wp.array:
  """Returns an organ's part of mjData.plugin_state."""
  m, d = mjstruct.both(model, data)
  start = int(m.plugin_stateadr[instance])
  return wrap(d.raw.plugin_state + 8 * start, size)
