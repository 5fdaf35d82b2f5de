"""The words of `tasks.core.rules` for many worlds, and what compiles rules that use them."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# Vectors of Warp's are not known to type checkers:
# pyright: reportCallIssue=false, reportArgumentType=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false
import functools
import types
from typing import Any

import warp as wp
from palpate.tasks import instrument
from palpate.tasks.core import rules
from palpate.tasks.core.rules import Rules
from palpate.tissue.types import Array

from . import kernels
from .fields import Common

_CLOSING, _GRIPPING = wp.constant(instrument.CLOSING), wp.constant(instrument.GRIPPING)
_FOLD, _FORCE = wp.constant(instrument.FOLD), wp.constant(instrument.HELD_FORCE)


@wp.func
def tip(s: Common):
  """See `rules`."""
  return kernels.vector(s.tip_pos, s.world)


@wp.func
def point(s: Common, triangle: int):
  """See `rules`."""
  return kernels.point(s, s.world, triangle)


@wp.func
def corner(s: Common, triangle: int, k: int):
  """See `rules`."""
  return kernels.node(s, s.world, s.elem[triangle, k])


@wp.func
def normal(s: Common, triangle: int):
  """See `rules`."""
  return kernels.normal(s, s.world, triangle)


@wp.func
def peak(s: Common):
  """See `rules`."""
  return s.peak_force[s.world, 0]


@wp.func
def force(s: Common):
  """See `rules`."""
  return wp.length(kernels.vector(s.contact_force, s.world))


@wp.func
def miss(s: Common, o: Any, value: float):
  """See `rules`."""
  s.errors[s.world] = s.errors[s.world] + 1


@wp.func
def reach(s: Common, o: Any, value: float):
  """See `rules`."""
  s.targets[s.world] = s.targets[s.world] + 1
  s.missed_by[s.world] = s.missed_by[s.world] + value


@wp.func
def _turn(quat: wp.array2d[float], w: int):
  """Returns the rotation in a row, w x y z."""
  return wp.quat(quat[w, 1], quat[w, 2], quat[w, 3], quat[w, 0])


@wp.func
def from_tip(s: Common, place: wp.vec3):
  """See `rules`."""
  return wp.quat_rotate_inv(_turn(s.tip_quat, s.world), place - tip(s))


@wp.func
def closing(s: Common):
  """See `rules`."""
  opening, target = s.gripper[s.world, 0], s.gripper[s.world, 1]
  return target < wp.min(opening - _CLOSING, _GRIPPING)


@wp.func
def holds(s: Common):
  """See `rules`."""
  both = wp.min(s.inner[s.world, 0], s.inner[s.world, 1])
  return both > _FORCE and s.gripper[s.world, 0] > _FOLD


@wp.func
def grip(s: Common, o: Any, value: float):
  """See `rules`."""
  reach(s, o, value)
  s.grasps[s.world] = s.grasps[s.world] + 1


@wp.func
def slipped(s: Common, o: Any):
  """See `rules`."""
  s.slips[s.world] = s.slips[s.world] + 1


@wp.func
def drop(s: Common, o: Any):
  """See `rules`."""
  s.errors[s.world] = s.errors[s.world] + 1


@wp.func
def reports(s: Common, o: Any):
  """See `rules`."""
  return s.action[s.world, s.action.shape[1] - 1] > 0.5


@wp.func
def visible(s: Common, o: Any):
  """See `rules`."""
  seen = wp.float32(0.0)
  for k in range(s.behind.shape[1]):
    if not s.behind[s.world, k]:
      seen += 1.0
  return seen / float(s.behind.shape[1])


_BUILTIN = {
  rules.rows: wp.matrix_from_rows, rules.length: wp.length,
  rules.dot: wp.dot, rules.root: wp.sqrt, rules.closeness: kernels.closeness, rules.clamp: wp.clamp,
}  # fmt: skip
_WORDS = (
  tip, point, corner, normal, peak, force, miss, reach, from_tip, closing, holds, grip, slipped,
  drop, reports, visible,
)  # fmt: skip
WORDS = _BUILTIN | {getattr(rules, word.key): word for word in _WORDS}  # of Python -> of Warp


def translate(rule: Any, module: Any, known: dict[Any, Any]) -> Any:
  """Returns a rule as a Warp function, with those that it calls and with the words of many worlds.

  Args:
    rule: plain function
    module: of Warp, that it is compiled in
    known: functions that are translated already
  """
  if rule in known:
    return known[rule]
  if rule in rules.INSTEAD:
    known[rule] = translate(rules.INSTEAD[rule], module, known)
    return known[rule]
  names = dict(rule.__globals__)
  for name in rule.__code__.co_names:
    if isinstance(names.get(name), types.FunctionType):
      names[name] = translate(names[name], module, known)
  code = rule.__code__
  copy = types.FunctionType(code, names, rule.__name__, rule.__defaults__, rule.__closure__)
  copy.__annotations__ = dict.fromkeys(code.co_varnames[: code.co_argcount], Any)
  copy.__module__, copy.__qualname__ = rule.__module__, rule.__qualname__
  known[rule] = wp.func(copy, module=module)
  return known[rule]


@functools.cache
def compiled(own: Rules) -> tuple[Any, Any, Any]:
  """Returns the struct of a domain's state, and the kernels of its rules."""
  module, known = wp.get_module(own.state.__module__), dict(WORDS)
  kinds = {
    name: wp.array(dtype=kind.dtype, ndim=len(kind.dims)) if isinstance(kind, Array) else kind
    for name, kind in own.fields.items()
  }
  state: Any = wp.struct(type("State", (), {"__annotations__": kinds, "__module__": module.name}))
  rule, look = (translate(each, module, known) for each in (own.advance, own.observe))
  judge = kernels.judge

  def advance(s: Common, states: wp.array(dtype=state)):
    s.world = wp.tid()
    o, progress, outcome = rule(s, states[s.world])
    states[s.world] = o
    judge(s, s.world, progress, outcome)

  def observe(s: Common, states: wp.array(dtype=state), beginning: bool):
    s.world = wp.tid()
    if not beginning or s.begun[s.world]:
      states[s.world] = look(s, states[s.world])

  after, seen = (wp.kernel(k, module=module, enable_backward=False) for k in (advance, observe))
  return state, after, seen
