"""The words of `tasks.core.rules` for many worlds, and what compiles rules that use them.

`rules` says what each of them returns.
"""

# Vectors of Warp's are not known to type checkers:
# pyright: reportCallIssue=false, reportArgumentType=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false
import dis
import functools
import itertools
import types
from typing import Any

import warp as wp
from palpate.tasks.core import instrument, rules
from palpate.tasks.core.rules import Rules
from palpate.tissue.types import Array

from . import kernels, throws
from .fields import Common

_CLOSING, _GRIPPING = wp.constant(instrument.CLOSING), wp.constant(instrument.GRIPPING)
_FOLD, _FORCE = wp.constant(instrument.FOLD), wp.constant(instrument.HELD_FORCE)

_POINT = wp.constant(1e-12)  # square of a strand's length that is none, for rounding [m^2]


WORDS: dict[Any, Any] = {  # of Python -> of Warp
  rules.rows: wp.matrix_from_rows, rules.vector: wp.vec3, rules.length: wp.length,
  rules.dot: wp.dot, rules.root: wp.sqrt, rules.angle: wp.atan2, rules.sine: wp.sin,
  rules.clamp: wp.clamp,
}  # fmt: skip


def word(function: Any) -> Any:
  """Makes a Warp function of what a word of the same name in `rules` is for many worlds."""
  WORDS[getattr(rules, function.__name__)] = found = wp.func(function)
  return found


@word
def tip(s: Common):
  return kernels.vector(s.tip_pos, s.world)


@word
def point(s: Common, triangle: int):
  return kernels.point(s, s.world, triangle)


@word
def corner(s: Common, triangle: int, k: int):
  return kernels.node(s, s.world, s.elem[triangle, k])


@word
def normal(s: Common, triangle: int):
  return kernels.normal(s, s.world, triangle)


@word
def peak(s: Common):
  return s.tissue_peak[s.world]


@word
def tissue_force(s: Common):
  return kernels.vector(s.tissue_force, s.world)


@word
def last_component(s: Common, o: Any):
  return s.action[s.world, s.action.shape[1] - 1]


@word
def other_tip(s: Common):
  return kernels.vector(s.other_tip_pos, s.world)


@word
def other_point(s: Common, place: wp.vec3):
  return other_tip(s) + wp.quat_rotate(_turn(s.other_tip_quat, s.world), place)


@word
def other_force(s: Common):
  return wp.length(kernels.vector(s.other_tissue_force, s.world))


@word
def pinch(s: Common):
  return wp.min(s.gripper[s.world, 2], s.gripper[s.world, 3])


@word
def other_pinch(s: Common):
  return wp.min(s.other_gripper[s.world, 2], s.other_gripper[s.world, 3])


@word
def needle_place(s: Common, place: wp.vec3):
  w, k = s.world, s.needle
  turn = wp.quat(s.qpos[w, k + 4], s.qpos[w, k + 5], s.qpos[w, k + 6], s.qpos[w, k + 3])
  return wp.vec3(s.qpos[w, k], s.qpos[w, k + 1], s.qpos[w, k + 2]) + wp.quat_rotate(turn, place)


@word
def scraped(s: Common):
  w, k = s.world, s.scrape
  return wp.length(wp.vec3(s.sensordata[w, k], s.sensordata[w, k + 1], s.sensordata[w, k + 2]))


@word
def pierced(s: Common):
  return s.hole_count[s.world, 0], wp.length(kernels.entry(s.needle_force, s.world, 0))


@word
def pinhole(s: Common, k: int):
  w = s.world
  rest = wp.vec3(s.hole_rest[w, 0, k, 0], s.hole_rest[w, 0, k, 1], s.hole_rest[w, 0, k, 2])
  return rest, s.hole_along[w, 0, k]


@word
def torn_at(s: Common, k: int):
  return s.hole_torn[s.world, 0, k]


@word
def taut(s: Common):
  most = s.tension[s.world, 0]
  for k in range(1, s.tension.shape[1]):
    most = wp.max(most, s.tension[s.world, k])
  return most


@word
def tugged(s: Common, first: int, count: int):
  least = s.tension[s.world, first]
  for k in range(first + 1, first + count):
    least = wp.min(least, s.tension[s.world, k])
  return least


@word
def fasten(s: Common, o: Any, on: bool):
  s.fastened[s.world] = on


@word
def put_away(s: Common, place: wp.vec3):
  w = s.world
  s.gone[w] = True
  for k in range(3):
    s.away[w, k] = place[k]
  for k in range(3, 7):
    s.away[w, k] = s.qpos[w, s.needle + k]


@word
def jaws(s: Common, hand: int):
  if hand == 0:
    return s.gripper[s.world, 0], s.gripper[s.world, 1]
  return s.other_gripper[s.world, 0], s.other_gripper[s.world, 1]


@word
def in_hand(s: Common, hand: int, place: wp.vec3):
  if hand == 0:
    return wp.quat_rotate_inv(_turn(s.tip_quat, s.world), place - tip(s))
  return wp.quat_rotate_inv(_turn(s.other_tip_quat, s.world), place - other_tip(s))


@word
def vertex(s: Common, k: int):
  return kernels.node(s, s.world, k)


@word
def strand(s: Common, k: int):
  return kernels.entry(s.strand, s.world, k)


@word
def strands(s: Common):
  return s.strand.shape[1]


@word
def snapped(s: Common):
  most = wp.float64(0.0)
  for k in range(s.broken.shape[1]):
    most = wp.max(most, s.broken[s.world, k])
  return most > wp.float64(0.0)


@word
def hold(s: Common, hand: int, node: int, place: wp.vec3, firm: bool):
  s.held_node[hand, s.world] = node
  s.held_firm[hand, s.world] = firm
  for k in range(3):
    s.held_place[hand, s.world, k] = place[k] + s.held_tip[hand][k]


@word
def tied(s: Common, turns: wp.array[int]):
  return throws.tied(s, s.world, turns)


@word
def apply(s: Common, k: int, force: wp.vec3):
  for c in range(3):
    s.applied[s.world, k, c] = force[c]


@word
def settle(s: Common):
  """See `rules`: they are given between steps."""


@word
def lens(s: Common):
  return tip(s)


@word
def picture(s: Common):
  half = -0.5 * s.optics
  turn = _turn(s.tip_quat, s.world) * wp.quat(wp.sin(half), 0.0, 0.0, wp.cos(half))
  half = 0.5 * s.camera_head[s.world, 0]
  turn = turn * wp.quat(0.0, 0.0, wp.sin(half), wp.cos(half))
  return wp.transpose(wp.quat_to_matrix(turn))


@word
def guided_tip(s: Common):
  return kernels.vector(s.guided_tip_pos, s.world)


@word
def guide(s: Common, joints: wp.vec3):
  s.ctrl[s.world, s.guided_drive[0]] = joints[0]
  s.ctrl[s.world, s.guided_drive[1]] = joints[1]
  s.ctrl[s.world, s.guided_drive[3]] = joints[2]


@word
def bonds(s: Common):
  return s.bond_vert.shape[0]


@word
def bond(s: Common, k: int):
  return kernels.node(s, s.world, s.bond_vert[k])


@word
def strand_distance(s: Common, k: int, start: wp.vec3, end: wp.vec3):
  strand, organ = kernels.entry(s.bond_stretch, s.world, k), bond(s, k)
  return wp.closest_point_edge_edge(start, end, organ - strand, organ, _POINT)[2]


@word
def is_free(s: Common, k: int):
  return s.bond_damage[s.world, k] >= 1.0


@word
def share_freed(s: Common):
  free = wp.float64(0.0)
  for k in range(bonds(s)):
    if is_free(s, k):
      free += s.bond_share[k]
  return float(free)


@word
def traction(s: Common):
  sum = wp.vec3()
  for k in range(bonds(s)):
    sum += kernels.entry(s.bond_force, s.world, k)
  return wp.length(sum)


@word
def weaken(s: Common, k: int, amount: float):
  s.bond_loss[s.world, k] = s.bond_loss[s.world, k] + amount


@word
def cutter(s: Common):
  seat = kernels.entry(s.cutter_seat, s.world, 0)
  return s.cutter_inside[s.world, 0] > 0.0, s.cutter_length[s.world, 0], seat


@word
def ended(s: Common, o: Any):
  return s.outcome[s.world] != 0


@word
def pieces(s: Common):
  return s.piece_count[s.world]


@word
def tear(s: Common, o: Any, value: float):
  """See `rules`."""

@word
def miss(s: Common, o: Any, value: float):
  kernels.error(s, s.world)


@word
def reach(s: Common, o: Any, value: float):
  s.targets[s.world] = s.targets[s.world] + 1
  s.missed_by[s.world] = s.missed_by[s.world] + value


@wp.func
def _turn(quat: wp.array2d[float], w: int):
  """Returns the rotation in a row, w x y z."""
  return wp.quat(quat[w, 1], quat[w, 2], quat[w, 3], quat[w, 0])


@word
def from_tip(s: Common, place: wp.vec3):
  return wp.quat_rotate_inv(_turn(s.tip_quat, s.world), place - tip(s))


@word
def closing(s: Common):
  opening, target = s.gripper[s.world, 0], s.gripper[s.world, 1]
  return target < wp.min(opening - _CLOSING, _GRIPPING)


@word
def holds(s: Common):
  both = wp.min(s.inner[s.world, 0], s.inner[s.world, 1])
  return both > _FORCE and s.gripper[s.world, 0] > _FOLD


@word
def opening(s: Common):
  return s.gripper[s.world, 0]


@word
def grip(s: Common, o: Any, value: float):
  reach(s, o, value)
  s.grasps[s.world] = s.grasps[s.world] + 1


@word
def slipped(s: Common, o: Any):
  s.slips[s.world] = s.slips[s.world] + 1


@word
def drop(s: Common, o: Any):
  kernels.error(s, s.world)


@word
def visible(s: Common, o: Any):
  seen = wp.float32(0.0)
  for k in range(s.behind.shape[1]):
    if not s.behind[s.world, k]:
      seen += 1.0
  return seen / float(s.behind.shape[1])


def translate(rule: Any, module: Any, known: dict[Any, Any], used: set[Any]) -> Any:
  """Returns a rule as a Warp function, with those that it calls and with the words of many worlds.

  Args:
    rule: plain function
    module: of Warp, that it is compiled in
    known: functions that are translated already
    used: takes those that are met
  """
  used.add(rule)
  if rule in known:
    return known[rule]
  if rule in rules.INSTEAD:
    known[rule] = translate(rules.INSTEAD[rule], module, known, used)
    return known[rule]
  names = dict(rule.__globals__)
  for step, following in itertools.pairwise(dis.get_instructions(rule)):
    name, part = step.argval, following.argval
    found = names.get(name) if step.opname == "LOAD_GLOBAL" else None
    if isinstance(found, types.FunctionType):
      names[name] = translate(found, module, known, used)
    elif isinstance(found, types.ModuleType):
      word = getattr(found, part)
      if isinstance(word, types.FunctionType):
        names[name] = types.ModuleType(name)
        vars(names[name]).update(vars(found) | {part: translate(word, module, known, used)})
  code = rule.__code__
  copy = types.FunctionType(code, names, rule.__name__, rule.__defaults__, rule.__closure__)
  copy.__annotations__ = dict.fromkeys(code.co_varnames[: code.co_argcount], Any)
  copy.__module__, copy.__qualname__ = rule.__module__, rule.__qualname__
  # Domains that build on others have rules of the same names.
  name = f"{rule.__module__.rpartition('.')[2]}_{rule.__name__}"
  known[rule] = wp.func(copy, name=name, module=module)
  return known[rule]


@functools.cache
def compiled(own: Rules) -> tuple[Any, Any, Any, Any, Any, set[Any]]:
  """Returns the struct of a domain's state, the kernels of its rules, and the words in these."""
  module, known, used = wp.get_module(own.state.__module__), dict(WORDS), set[Any]()
  kinds = {
    name: wp.array(dtype=kind.dtype, ndim=len(kind.dims)) if isinstance(kind, Array) else kind
    for name, kind in own.fields.items()
  }
  state: Any = wp.struct(type("State", (), {"__annotations__": kinds, "__module__": module.name}))
  rule, shaping = (translate(found, module, known, used) for found in (own.advance, own.shaping))
  judge = kernels.judge

  def advance(s: Common, states: wp.array(dtype=state)):
    s.world = wp.tid()
    o, progress, outcome = rule(s, states[s.world])
    states[s.world] = o
    judge(s, s.world, progress, shaping(s, o), outcome)

  def following(name: str, rule: Any) -> Any:
    """Returns the kernel of a rule that returns the state alone."""

    def follow(s: Common, states: wp.array(dtype=state), beginning: bool):
      s.world = wp.tid()
      if not beginning or s.begun[s.world]:
        states[s.world] = rule(s, states[s.world])

    follow.__qualname__ = name
    return wp.kernel(follow, module=module, enable_backward=False)

  after = wp.kernel(advance, module=module, enable_backward=False)
  look = following("observe", translate(own.observe, module, known, used))
  act, begin = (
    following(name, translate(rule, module, known, used)) if rule else None
    for name, rule in (("act", own.act), ("begin", own.begin))
  )
  return state, after, look, act, begin, used
