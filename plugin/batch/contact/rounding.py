"""What float32 leaves of mujoco_warp's Newton method.

Where no row has changed its state, mujoco_warp takes a step for exact and does not find the
gradient again. But with firm contacts a step is off by what its factors are rounded, so forces by
up to 1 % of their peak (`refined`).

Bodies may be light, as threads' nodes are (`Rounding`). A tool's contact with a thread is a million
times as stiff as its nodes are heavy. So an iteration's matrix may come out of its rounding as not
positive, and has no factors: the search then goes down the gradient, each dof by its own curvature.
And costs fall by less than they are rounded long before they fall by less than the tolerance that
threads at rest need: then a world has arrived.
"""

# pyright: reportIndexIssue=false, reportCallIssue=false
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportAssignmentType=false
# pyright: reportGeneralTypeIssues=false
import contextlib
from typing import Any

import warp as wp
from palpate.tissue.types import Array, fill, floats, ints, struct

from ..mjw import private
from ..mjw.private import ConstraintState

_BLOCK = 32  # threads of a world
_SATISFIED = wp.constant(int(ConstraintState.SATISFIED))
_ROUNDED = wp.constant(2.0**-48)  # square of what float32 rounds off


@struct
class Search:
  """What an iteration of mujoco_warp's solver has found."""

  done: Array(wp.bool, ("nworld",))  # worlds that have arrived
  h: floats("nworld", "npad", "npad")  # the matrix, before its factors take its place
  diagonal: floats("nworld", "nv")  # of that
  grad: floats("nworld", "nv")
  search: floats("nworld", "nv")
  square: floats("nworld")  # of the search
  decrement: floats("nworld")  # twice what the search is to gain
  # Rows of constraints:
  nefc: ints("nworld")
  state: ints("nworld", "njmax")
  D: floats("nworld", "njmax")
  aref: floats("nworld", "njmax")


@wp.kernel(enable_backward=False)
def _keep_diagonal(s: Search):
  """Keeps the diagonal of the matrix."""
  w, i = wp.tid()
  if not s.done[w]:
    s.diagonal[w, i] = s.h[w, i, i]


@wp.kernel(enable_backward=False)
def _check(s: Search):
  """Gives worlds whose matrix had no factors another search, and tells those that have arrived.

  Forces D (J a - aref) are off by their reference's last digit, and so is the gradient: what is to
  be gained by that is no more than the sum of D aref^2 times the square of the digit.
  """
  w, lane = wp.tid()
  if s.done[w]:
    return
  lanes = wp.block_dim()
  found = wp.isfinite(s.square[w]) and wp.isfinite(s.decrement[w])
  mine = wp.vec2(0.0, 0.0)
  if found:
    for k in range(lane, wp.min(s.nefc[w], s.D.shape[1]), lanes):
      if s.state[w, k] != _SATISFIED:
        mine[0] += s.D[w, k] * s.aref[w, k] * s.aref[w, k]
  else:
    for i in range(lane, s.diagonal.shape[1], lanes):
      step = -s.grad[w, i] / s.diagonal[w, i]
      s.search[w, i] = step
      mine += wp.vec2(step * step, -step * s.grad[w, i])
  total = wp.tile_reduce(wp.add, wp.tile(mine, preserve_type=True))[0]
  if lane > 0:
    return
  if not found:
    s.square[w] = total[0]
    s.decrement[w] = total[1]
  elif s.decrement[w] < _ROUNDED * total[0]:
    s.decrement[w] = 0.0


def refined() -> contextlib.AbstractContextManager[None]:
  """Lets mujoco_warp's solver find the gradient in each iteration."""

  def always(update):
    return lambda *args, stable_fast=False, **kwargs: update(*args, **kwargs)

  solver, names = private.solver, ("_update_constraint", "_update_gradient_incremental")
  return private.instead([(solver, name, always(getattr(solver, name))) for name in names])


class Rounding:
  """Lets mujoco_warp's solver see what is rounded off."""

  def __init__(self, m: Any, d: Any):
    self._diagonal = wp.empty((d.nworld, m.nv), dtype=float, device=d.qacc.device)

  def adding(self) -> contextlib.AbstractContextManager[None]:
    """Lets what mujoco_warp launches within see to it."""
    factorize = private.solver._cholesky_factorize_solve

    def checked(m, d, ctx, *args, **kwargs):
      kept, efc = self._diagonal, d.efc
      found = fill(Search, kept.device, dict(
        done=ctx.done, h=ctx.h, diagonal=kept, grad=ctx.grad, search=ctx.search,
        square=ctx.search_dot, decrement=ctx.newton_decrement, nefc=d.nefc, state=efc.state,
        D=efc.D, aref=efc.aref,
      ))  # fmt: skip
      wp.launch(_keep_diagonal, dim=kept.shape, inputs=[found], device=kept.device)
      factorize(m, d, ctx, *args, **kwargs)
      wp.launch_tiled(_check, dim=d.nworld, inputs=[found], device=kept.device, block_dim=_BLOCK)

    return private.instead([(private.solver, "_cholesky_factorize_solve", checked)])
