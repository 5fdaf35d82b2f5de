"""What float32 leaves of mujoco_warp's Newton method where bodies are light, as threads' nodes are.

A tool's contact with a thread is a million times as stiff as its nodes are heavy. So an iteration's
matrix may come out of its rounding as not positive, and has no factors: the search then goes down
the gradient, each dof by its own curvature. And costs fall by less than they are rounded long
before they fall by less than the tolerance that threads at rest need: then a world has arrived.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportAssignmentType=false
# pyright: reportGeneralTypeIssues=false
import contextlib
from typing import Any

import warp as wp

from .. import private
from ..private import ConstraintState

_BLOCK = 32  # threads of a world
_SATISFIED = wp.constant(int(ConstraintState.SATISFIED))
_ROUNDED = wp.constant(2.0**-48)  # square of what float32 rounds off


@wp.kernel(enable_backward=False)
def _keep_diagonal(h: wp.array3d[float], done: wp.array[bool], diagonal: wp.array2d[float]):
  """Keeps the diagonal of the matrix, which its factors take the place of."""
  w, i = wp.tid()
  if not done[w]:
    diagonal[w, i] = h[w, i, i]


@wp.kernel(enable_backward=False)
def _check(
  nefc: wp.array[int], state: wp.array2d[int], D: wp.array2d[float], aref: wp.array2d[float],
  grad: wp.array2d[float], diagonal: wp.array2d[float], done: wp.array[bool],
  search: wp.array2d[float], square: wp.array[float], decrement: wp.array[float],
):  # fmt: skip
  """Gives worlds whose matrix had no factors another search, and tells those that have arrived.

  Forces D (J a - aref) are off by their reference's last digit, and so is the gradient: what is to
  be gained by that is no more than the sum of D aref^2 times the square of the digit.
  """
  w, lane = wp.tid()
  if done[w]:
    return
  lanes = wp.block_dim()
  found = wp.isfinite(square[w]) and wp.isfinite(decrement[w])
  mine = wp.vec2(0.0, 0.0)
  if found:
    for k in range(lane, wp.min(nefc[w], D.shape[1]), lanes):
      if state[w, k] != _SATISFIED:
        mine[0] += D[w, k] * aref[w, k] * aref[w, k]
  else:
    for i in range(lane, diagonal.shape[1], lanes):
      step = -grad[w, i] / diagonal[w, i]
      search[w, i] = step
      mine += wp.vec2(step * step, -step * grad[w, i])
  total = wp.tile_reduce(wp.add, wp.tile(mine, preserve_type=True))[0]
  if lane > 0:
    return
  if not found:
    square[w] = total[0]
    decrement[w] = total[1]
  elif decrement[w] < _ROUNDED * total[0]:
    decrement[w] = 0.0


class Rounding:
  """Lets mujoco_warp's solver see what is rounded off."""

  def __init__(self, m: Any, d: Any):
    self._diagonal = wp.empty((d.nworld, m.nv), dtype=float, device=d.qacc.device)

  def adding(self) -> contextlib.AbstractContextManager[None]:
    """Lets what mujoco_warp launches within see to it."""
    factorize = private.solver._cholesky_factorize_solve

    def checked(m, d, ctx, *args, **kwargs):
      efc, kept = d.efc, self._diagonal
      wp.launch(_keep_diagonal, dim=kept.shape, inputs=[ctx.h, ctx.done], outputs=[kept])
      factorize(m, d, ctx, *args, **kwargs)
      wp.launch_tiled(
        _check,
        dim=d.nworld,
        inputs=[d.nefc, efc.state, efc.D, efc.aref, ctx.grad, kept, ctx.done],
        outputs=[ctx.search, ctx.search_dot, ctx.newton_decrement],
        block_dim=_BLOCK,
      )

    return private.instead([(private.solver, "_cholesky_factorize_solve", checked)])
