"""A step of a body: the linear system, its solve, and the time stepping schemes by name.

`implicit` takes Newton iterations on A dv = b, the first one with the present velocity's way ahead
in it; see tissue/elastic.h for the equations and solver/pcg.h for the solve.

`midpoint` is of second order in h. MuJoCo moves x by h v after each step, so that its v is that of
the middle of a step; about the time of x the step is centred, and stable for every h:

    A dv = h (F + f_ext + f_c) - h damping K v,    A = M + (h^2 + h damping) K / 2

(Newmark's family, with beta = 1/2 so that a step's stiffest motions fade with the damping). Newton
iterations matter where the matrix is not that of the forces, as in solids: they stand at
x + h dv / 2 and v + dv / 2. A step
after which v is yet that of the time of x, the first one, makes half of it. It damps no more than
the tissue does, but by h / 20 at least: its forces are those of the mean of the places before and
after, which of tissue that turns at omega is strained as if the damping were less by up to
omega h^2. `implicit` adds h / 2 to the damping, which solids take off theirs. See
docs/accuracy.md.

`explicit` is the scheme of the Virtual Training Environment, semi-implicit Euler on the same
forces: dv = M^-1 h (F + f_ext). `neumann` is the thesis scheme (eq. 5.19-5.26): the constant
Hessian H of springs along the edges, and the inverse of W = I - (h^2 + h damping) H / m replaced by
its first-order Neumann polynomial about D = diag W,

    dv = (2 D^-1 - D^-1 W D^-1) (h (F + f_ext) + (h^2 + h damping) H v) / m.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import warp as wp

from .body import Body
from .device import BLOCK, SPLIT, Plan, block, group_size, reserve, threads
from .kernels import Kernel, kernel
from .types import CONSTANTS, Cycle, Fields, Stage

# A right-hand side below this share of the weight's impulse is at rest: residuals count against it.
REST = 1e-3

# The first Newton iteration stands where the present velocity leads, but no edge changes by more
# than this share of its length on the way: forces far off would be those of another shape.
AHEAD = 0.1

# Relative residual at which the response to a change of the contact forces is good enough: it is
# part of the step, whose tolerance holds too where that is looser.
ENOUGH = 0.03

# Condition numbers: below this one a mesh is solved by a few steps of the smoother, and above that
# one float32 residuals are noise to the slowest modes, which only cycles would act on.
EASY, WORST = 8.0, 2e5

# Share of a solid's mu that each tetrahedron has for itself; the means over nodes have the rest,
# and lambda. With less contacts are too soft, with more bending locks (docs/accuracy.md).
OWN_SHARE = 0.3

_FIRST, _MORE, _CENTRED = 1, 2, 4  # flags of `newton_update`
_CYCLES_PER_SM = 2  # blocks on one multiprocessor
_CONSTANTS = CONSTANTS | {
  "AHEAD": AHEAD,
  "ENOUGH": ENOUGH,
  "EASY": EASY,
  "WORST": WORST,
  "IS_FIRST": _FIRST,
  "IS_MORE": _MORE,
  "IS_CENTRED": _CENTRED,
}


def _elastic(name: str) -> Kernel:
  return kernel(name, "tissue/elastic.h", Fields, CONSTANTS)


def _solid(name: str) -> Kernel:
  return kernel(name, "tissue/solid.h", Fields, CONSTANTS | {"OWN_SHARE": OWN_SHARE})


def _scheme(name: str, bounds: int | None = None) -> Kernel:
  return kernel(name, "solver/schemes.h", Fields, _CONSTANTS, bounds)


_elem_normal = _elastic("elem_normal")
_hinge_angle = _elastic("hinge_angle")
_hinge_moment = _elastic("hinge_moment")
_elem_corner = _elastic("elem_corner")
_row = _elastic("row")
_node_stress = _solid("node_stress")
_tet_stress = _solid("tet_stress")
_edge_block = _solid("edge_block")
_solid_row = _solid("solid_row")
_capsule_row = kernel("capsule_row", "tissue/capsule.h", Fields, CONSTANTS)
_edge_change = _scheme("edge_change")
_predict = _scheme("predict")
_stay = _scheme("stay")
_newton_update = _scheme("newton_update")
_centre_step = _scheme("centre", BLOCK)
_direct_step = _scheme("direct", BLOCK)
_solve = kernel("solve", "solver/pcg.h", Fields, _CONSTANTS, (BLOCK, 1))
_solve_solid = kernel("solve_solid", "solver/solid_solve.h", Fields, _CONSTANTS, (BLOCK, 1))
_solve_solids = kernel("solve_solids", "solver/solid_solve.h", Fields, _CONSTANTS, (BLOCK, 1))
_keep_spin = kernel("keep_spin", "solver/momentum.h", Fields, _CONSTANTS, (BLOCK, 1))
_sample = kernel("sample", "solver/multigrid.h", Cycle, _CONSTANTS)
_solve_cycles = kernel(
  "solve_cycles", "solver/multigrid.h", Cycle, _CONSTANTS, (BLOCK, _CYCLES_PER_SM)
)


def _over(kernel: Kernel, body: Body, nslice: int, arg: int = 0, fields: Any = None):
  """Launches a kernel over `nslice` slices of every world; it takes the body's fields or others."""
  size = threads(body.device, nslice)
  kernel.launch(body.device, body.nworld, size, arg, body.fields if fields is None else fields)


def _together(
  kernel: Kernel, body: Body, arg: int, fields: Any = None, per_sm: int = 1, split: int = 1
):
  """Launches a kernel in which the threads of a world work together; see core/group.h.

  Args:
    kernel: the kernel
    body: the body
    arg: its number
    fields: what it takes, the body's where None
    per_sm: blocks on one multiprocessor that the kernel's bounds allow
    split: threads of a node
  """
  nslice = split * body.shape.nslice
  size = group_size(body.device, nslice, body.nworld, per_sm)
  fields = body.fields if fields is None else fields
  kernel.launch(body.device, body.nworld, size, arg, fields, block(body.device, nslice))


def kernels(body: Body) -> list[Kernel]:
  """Returns a kernel of each module that a body's step needs."""
  if body.plan:
    return [_world_step(body.plan)]
  found = [_predict, *([_solid_row, _solve_solid] if body.is_solid else [_row, _solve])]
  found += [_hinge_moment, _capsule_row] if body.shape.ncapsule else []
  return found if body.levels is None else [*found, _sample]


def _world_step(plan: Plan) -> Kernel:
  """Returns the kernel of a world's whole step by one block."""
  return _world_kernel(dataclasses.replace(plan, nbytes=0))


@functools.cache
def _world_kernel(plan: Plan) -> Kernel:
  kinds = {"BENDING": plan.bends, "SPRINGS": plan.springs, "VOLUMES": plan.volumes}
  kinds |= {"TENSIONS": plan.tensions, "MESHES": plan.meshes}
  constants = _CONSTANTS | {"OWN": plan.own} | {name: int(kind) for name, kind in kinds.items()}
  tag = f".{plan.own}.{plan.threads}.{plan.per_sm}." + "".join(str(int(k)) for k in kinds.values())
  bounds = (plan.threads, plan.per_sm)
  return kernel("step_world", "solver/step.h", Fields, constants, bounds, tag, fast=plan.own > 0)


def _by_block(body: Body, plan: Plan, stage: Stage):
  """Takes the step of `implicit`, or the answer to it, a block a world."""
  step_world = _world_step(plan)
  reserve(step_world.on(body.device), body.device, plan)
  step_world.launch(body.device, body.nworld, plan.threads, stage, body.fields, plan.threads)


# The linear system.


def assemble(body: Body, stage: Stage):
  """Writes the right-hand side, and for an implicit stage the matrix, at the trial state.

  Args:
    body: `state.step`, `mass`, `force_ext` and, after the first iteration, `dvel` are read too
    stage: what the right-hand side is for
  """
  shape = body.shape
  if body.has_bending:
    _hinge_angles(body, stage)
    _over(_hinge_moment, body, shape.nhingeslice)
    _over(_elem_corner, body, shape.nelemslice)
  if body.is_solid:
    _over(_node_stress, body, shape.nslice, stage)
    _over(_tet_stress, body, shape.ntetslice, stage)
    if stage in (Stage.FIRST, Stage.LATER):
      _over(_edge_block, body, shape.nedgeslice)
    if shape.ncapsule:
      _over(_capsule_row, body, shape.nslice, stage)
    _over(_solid_row, body, shape.nslice, stage)
    return
  _over(_row, body, shape.nslice, stage)
  if body.levels is not None and stage in (Stage.FIRST, Stage.LATER):
    coarse = body.levels.body
    nslice = coarse.shape.nslice
    _over(_sample, body, nslice, fields=body.levels.cycle)
    _over(_row, coarse, nslice, Stage.FIRST)


def _hinge_angles(body: Body, stage: Stage):
  _over(_elem_normal, body, body.shape.nelemslice)
  _over(_hinge_angle, body, body.shape.nhingeslice, stage)


def calibrate(body: Body):
  """Stores the rest angles as the kernels see them, so that a rest shape is at rest to the bit."""
  if not body.has_bending:
    return
  angle0 = body.shape.hinge_angle0
  angle0.zero_()
  wp.copy(angle0, rest_angles(body), count=angle0.size)


def rest_angles(body: Body) -> wp.array:
  """Returns how much more than its rest angle each hinge has at rest, in memory of a step's."""
  state, system = body.state, body.system
  system.disp_trial.zero_()
  system.vel_trial.zero_()
  state.step.fill_(1.0)
  _hinge_angles(body, Stage.EXPLICIT)
  return system.hinge_angle


def solve(body: Body, stage: Stage):
  """Solves A sol = rhs to the body's tolerance; writes `system.sol` and `status`.

  Args:
    body: the body, with A as `assemble` wrote it
    stage: FIRST, LATER or RESPONSE
  """
  if body.is_solid and body.nworld == 1:
    _together(_solve_solid, body, stage, split=SPLIT)
  elif body.is_solid:
    _together(_solve_solids, body, stage)
  elif body.levels is None:
    _together(_solve, body, stage)
  else:
    _together(_solve_cycles, body, stage, body.levels.cycle, _CYCLES_PER_SM)


# The schemes.


def _implicit(body: Body):
  if body.plan:
    _by_block(body, body.plan, Stage.FIRST)
    _keep_momentum(body)
    return
  body.system.change.zero_()
  nslice = body.shape.nslice
  _over(_edge_change, body, nslice)
  _over(_predict, body, nslice)
  _iterate(body)


def _iterate(body: Body, kind: int = 0):
  """Takes the Newton iterations from the trial state on."""
  for it in range(body.newton):
    stage = Stage.FIRST if it == 0 else Stage.LATER
    assemble(body, stage)
    solve(body, stage)
    flags = kind + _FIRST * (it == 0) + _MORE * (it + 1 < body.newton)
    _over(_newton_update, body, body.shape.nslice, flags)
  _keep_momentum(body)


def _keep_momentum(body: Body):
  """Gives an organ that nothing holds the angular momentum that the forces on it leave it."""
  if body.shape.unheld:
    _together(_keep_spin, body, 0)


def _midpoint(body: Body):
  _over(_stay, body, body.shape.nslice)
  _centre(body)
  _iterate(body, _CENTRED)
  _centre(body, undo=True)


def _centre(body: Body, undo: bool = False):
  """Makes `state.step` that of the midpoint step, or puts it back."""
  _together(_centre_step, body, undo)


def _explicit(body: Body):
  _direct(body, Stage.EXPLICIT)


def _neumann(body: Body):
  _direct(body, Stage.NEUMANN)


def _direct(body: Body, stage: Stage):
  _over(_stay, body, body.shape.nslice)
  assemble(body, stage)
  _together(_direct_step, body, stage)
  wp.copy(body.state.dvel, body.system.sol)


def _respond(body: Body):
  if body.plan:
    _by_block(body, body.plan, Stage.RESPONSE)
  else:
    solve(body, Stage.RESPONSE)


def _respond_centred(body: Body):
  _centre(body)
  solve(body, Stage.RESPONSE)
  _centre(body, undo=True)


@dataclasses.dataclass(frozen=True)
class Scheme:
  """A time stepping scheme.

  Attributes:
    step: computes `state.dvel`, the change of velocity in one step, from `state.step`, `disp`,
      `vel`, `mass`, `force_ext` and `dvel_warm`; capturable in a graph
    gain: factor of K in the matrix of a step, from h and damping [s] to [s^2]; 0 where nodes move
      with their own mass
    respond: writes to `system.sol` how the impulses in `system.rhs` [N s] change the velocity in
      the step just computed; None where the scheme has no such answer
    levels: whether coarser meshes serve its solve
    whole: whether a block of threads can take a world's whole step
    ahead: whether it takes forces where the present velocity leads
    damps: the share of h by which it damps beyond `damping`, as Euler's does; negative where
      `damping` is no less than that share of h
    solids: whether it can step tetrahedra, and springs that hold nodes
  """

  step: Callable[[Body], None]
  gain: Callable[[float, float], float]
  respond: Callable[[Body], None] | None = None
  levels: bool = False
  whole: bool = False
  ahead: bool = False
  damps: float = 0.0
  solids: bool = True

  @property
  def spreads(self) -> bool:
    """Whether a push on one node moves others within a step."""
    return self.gain(1.0, 0.0) > 0


def _whole(h: float, damping: float) -> float:
  return h * h + h * damping


SCHEMES = {
  "implicit": Scheme(_implicit, _whole, _respond, levels=True, whole=True, ahead=True, damps=0.5),
  "midpoint": Scheme(
    _midpoint, lambda h, b: 0.5 * _whole(h, b), _respond_centred, levels=True, damps=-0.05
  ),
  "neumann": Scheme(_neumann, _whole, solids=False),
  "explicit": Scheme(_explicit, lambda h, b: 0.0),
}


def step(body: Body, scheme: str = "implicit"):
  """Computes `state.dvel` by the scheme of that name, see `Scheme.step`."""
  SCHEMES[scheme].step(body)
