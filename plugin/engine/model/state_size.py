"""How long an organ's part of mjData.plugin_state is, before MuJoCo has filled in the flexes."""

from __future__ import annotations

from palpate.tissue.geometry import fill

from .. import coupling, nodal
from ..windows import windowed
from . import declare, mjstruct


def state_size(model: int, instance: int) -> int:
  """Returns the length of the plugin state.

  Contact force, last dv and the one before of each moving vertex, or what `windowed` says.
  """
  m = mjstruct.Model.from_address(model)
  relaxes, rests, bonded = (
    bool(mjstruct.config(model, instance, key).strip())
    for key in ("relax_share", "support", "bonds")
  )
  spare = mjstruct.config(model, instance, "spare").strip() not in ("", "0")
  # Asked before MuJoCo has filled in the flexes: what is needed is at most this.
  solid = mjstruct.config(model, instance, "elements").strip() == "solid"
  inner = fill.MOST * m.nflexvert if solid else 0
  most = inner + m.nflexvert
  cuts = coupling.cut_sizes(m.nflexelem, most, spare * m.nflexvert, solid)
  cutters = mjstruct.config(model, instance, "cutters").strip()
  cuts |= {"nblade": cutters.count(",") + 1 if cutters else 0}
  if mjstruct.config(model, instance, "window").strip():
    outer = {"nrest": rests * m.nflexvert, "nbond": bonded * m.nflexvert}
    outer |= {"ncreep": relaxes * most} | cuts
    return windowed.state_size(most, 0, m.ngeom, **outer)
  moving = len(declare.moving_bodies(m, instance))
  cuts |= {"ncreep": relaxes * (moving + inner), "nbond": bonded * moving}
  return nodal.state_size(3 * moving, 3 * inner, **cuts)
