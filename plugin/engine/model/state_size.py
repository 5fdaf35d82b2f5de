"""How long an organ's part of mjData.plugin_state is, before MuJoCo has filled in the flexes."""

from palpate.tissue.geometry import fill

from .. import coupling, layout
from ..layout import NodalState, RodState, WindowState
from . import declare, mjstruct


def state_size(model: int, instance: int) -> int:
  """Returns the length of the plugin state: at least what `coupling.sizes` will ask for."""
  m = mjstruct.model(model)
  if declare.is_rod(m, instance):
    keys = "refine", "yield_strain"
    refine, yields = (mjstruct.config(m, instance, key).strip() not in ("", "0") for key in keys)
    return layout.size(RodState, layout.rod_sizes(m.nflexvert, m.nv, refine, yields))
  relaxes, rests, bonded = (
    bool(mjstruct.config(m, instance, key).strip()) for key in ("relax_share", "support", "bonds")
  )
  spare = mjstruct.config(m, instance, "spare").strip() not in ("", "0")
  # Asked before MuJoCo has filled in the flexes: what is needed is at most this.
  solid = mjstruct.config(m, instance, "elements").strip() == "solid"
  inner = fill.MOST * m.nflexvert if solid else 0
  most = inner + m.nflexvert
  cuts = coupling.cut_sizes(m.nflexelem, most, spare * m.nflexvert, solid)
  sizes = dict(cuts)
  for name, key in (("nblade", "cutters"), ("nneedle", "needles")):
    rows = mjstruct.config(m, instance, key).strip()
    sizes[name] = rows.count(",") + 1 if rows else 0
  if mjstruct.config(m, instance, "window").strip():
    # A window's vertices count as the organ's, which have more numbers than a slot. Edges of
    # threads that it follows have a vertex that moves, which has two of them at most.
    threads = [k for k in range(m.nplugin) if declare.is_rod(m, k)]
    lines = sum(2 * len(declare.moving_bodies(m, k)) for k in threads)
    sizes |= {"nvert": most, "nslot": 0, "ngeom": m.ngeom + lines, "nrelax": relaxes * most}
    sizes |= {"nrest": rests * m.nflexvert, "nbond": bonded * m.nflexvert}
    return layout.size(WindowState, sizes)
  moving = len(declare.moving_bodies(m, instance))
  sizes |= {"nrelax": relaxes * (moving + inner), "nbond": bonded * moving}
  return layout.size(NodalState, sizes | coupling.nodal_sizes(3 * moving, 3 * inner))
