"""Marks of exercises in the pictures of many worlds: sites, and films of bonds."""

import functools
from typing import Any

import warp as wp
from palpate.tasks.core import rules, scenes
from palpate.tasks.core.rules import Rules
from palpate.tissue.types import Array, ints, struct

from .fields import Common
from .words import WORDS, compiled, translate


@struct
class Marks:
  """Marks of the pictures of rows, a row a world that is drawn."""

  world: ints("nrow")
  part: ints("nmark")  # of a camera, see `palpate.camera.view.View`
  thing: ints("nmark")
  pos: Array(wp.vec3, ("nrow", "npart"))
  rgba: Array(wp.vec4, ("nrow", "nthing"))


@struct
class Films:
  """Films of bonds in the pictures of rows, see `Marks`."""

  world: ints("nrow")
  bond: ints("nfilm")
  thing: ints("nfilm")
  rgba: Array(wp.vec4, ("nrow", "nthing"))


_FILM, _RAW = wp.constant(wp.vec4(*scenes.FILM)), wp.constant(wp.vec4(*scenes.RAW))


@wp.kernel(enable_backward=False)
def film(s: Common, f: Films):
  """Colours films by whether their bonds hold."""
  r, k = wp.tid()
  held = s.bond_damage[f.world[r], f.bond[k]] < 1.0
  f.rgba[r, f.thing[k]] = _FILM if held else _RAW


_HIDDEN = wp.constant(rules.HIDDEN)
_COLOURS = wp.constant(wp.mat33(0.0, 0.0, 0.0, *scenes.LATER, *scenes.NOW))  # by their look


@functools.cache
def marking(own: Rules) -> Any:
  """Returns the kernel of a domain's marks."""
  # A module of its own: that of the rules, which is loaded, would be compiled anew.
  state, module = compiled(own)[0], wp.get_module(f"{own.state.__module__}.marks")
  assert own.mark
  rule = translate(own.mark, module, dict(WORDS), set())

  def mark(s: Common, states: wp.array(dtype=state), m: Marks):
    r, k = wp.tid()
    s.world = m.world[r]
    place, look = rule(s, states[s.world], k)
    colour = _COLOURS[look]
    m.pos[r, m.part[k]] = place
    alpha = 0.0 if look == _HIDDEN else 0.9
    m.rgba[r, m.thing[k]] = wp.vec4(colour[0], colour[1], colour[2], alpha)

  return wp.kernel(mark, module=module, enable_backward=False)
