"""The organ's configuration: one row a `<config>` key says what it means and what it may hold."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from . import reading
from .reading import BondRow, CutterRow, NeedleRow
from .step import SCHEMES

# What takes a change while running: a number in the device's memory, the tissue's arrays, the graph
# of the step anew. Other keys shape arrays or the model, and stay.
NUMBER, TISSUE, GRAPH, FIXED = "number", "tissue", "graph", ""
OWN = "own"  # as a carrier: the organ's own rigid motion
_SHOWN = 40  # letters of a value in a message
_SCALE = "young_scale"  # a key of `change` alone


@dataclasses.dataclass(frozen=True)
class Row:
  """What is known of a key.

  Attributes:
    meaning: what it is, in Markdown
    unit: its unit
    read: returns the value of a text, for a number of elements; raises ValueError
    allowed: what it may hold
    change: what takes a change while running, FIXED if none is possible
  """

  meaning: str
  unit: str
  read: Callable[[str, int], Any]
  allowed: str
  change: str


def _row(default, kind: tuple, meaning: str, unit: str = "-", change: str = FIXED) -> Any:
  read, allowed = kind
  row = Row(meaning, unit, read, allowed, change)
  return dataclasses.field(default=default, metadata={"row": row})


@dataclasses.dataclass(frozen=True)
class Config:
  """Configuration of one organ, one field a `<config>` key; see its row for what it means."""

  elements: str = _row(
    "membrane",
    reading.words("membrane", "spring", "solid", "rod"),
    "`membrane` (St. Venant-Kirchhoff triangles, plane stress), `spring` (edge springs), `solid` "
    "(neo-Hookean tetrahedra inside, made when the model is compiled) or `rod` (a thread, of a "
    "flexcomp of dim 1)",
  )
  tetrahedra: str = _row(
    "",
    reading.PATH,
    "Gmsh file (text) with the tetrahedra of a solid: their nodes on the surface are its vertices, "
    "in its frame [m]; left out, they are made",
  )
  young: tuple[float, ...] = _row(
    (5000.0,),
    (reading.numbers, "a number > 0"),
    "Young's modulus of membrane and plate; one value, or one for each triangle",
    "Pa",
    TISSUE,
  )
  poisson: float = _row(0.45, reading.number(0.0, 0.5), "Poisson's ratio", "-", TISSUE)
  thickness: float = _row(
    0.002, reading.POSITIVE, "thickness of membrane and plate, also on a solid", "m", TISSUE
  )
  tension: float = _row(
    0.0,
    reading.NOT_NEGATIVE,
    "of the membrane in the rest shape, force by length in all directions: a wall pinned at "
    "its rim gapes where it is cut ([cutting](cutting.md#sheets-under-tension))",
    "N/m",
    NUMBER,
  )
  capsule_young: tuple[float, ...] = _row(
    (),
    (reading.numbers, "a number > 0"),
    "Young's modulus of the skin on a solid (capsule, serosa): membrane and plate of `thickness`; "
    "one value, or one for each triangle; none for a bare solid",
    "Pa",
    TISSUE,
  )
  stiffness: float = _row(
    0.0,
    reading.POSITIVE,
    'constant of the edge springs, with `elements="spring"` alone',
    "N/m",
    TISSUE,
  )
  bend: float = _row(
    1.0,
    reading.NOT_NEGATIVE,
    "factor on the plate's rigidity E t^3 / (12 (1 - nu^2)), or on a rod's, E I; 0 switches "
    "bending off",
  )
  twist: float = _row(
    1.0,
    reading.NOT_NEGATIVE,
    "factor on a rod's rigidity against twisting, G J, G = E / (2 (1 + nu)); 0 switches it off; "
    'with `elements="rod"` alone',
  )
  strength: float = _row(
    0.0,
    reading.NOT_NEGATIVE,
    "tension at which an edge of a rod breaks, the one with the highest first; 0: none breaks; "
    'with `elements="rod"` alone',
    "N",
  )
  yield_strain: float = _row(
    0.0,
    reading.NOT_NEGATIVE,
    "strain at a rod's surface beyond which it keeps its bend: it yields at a curvature of "
    "`yield_strain` / radius ([threads](physics.md#plastic-bending)); 0: never; with "
    '`elements="rod"` alone',
  )
  drag: float = _row(
    0.0,
    reading.NOT_NEGATIVE,
    "drag of the medium on a rod, by length and velocity ([threads](physics.md#drag-and-damping)); "
    'with `elements="rod"` alone',
    "N s/m²",
  )
  refine: float = _row(
    0.0,
    reading.NOT_NEGATIVE,
    "length of a rod's edges where it touches itself: nodes move along it to there "
    "([threads](physics.md#refinement)); 0: edges keep their lengths; with "
    '`elements="rod"` alone',
    "m",
  )
  foundation: float = _row(
    0.0,
    reading.NOT_NEGATIVE,
    "restoring force per area and displacement: represents the interior and ligaments",
    "Pa/m",
    NUMBER,
  )
  bulk: float = _row(
    0.0,
    reading.NOT_NEGATIVE,
    "volume preservation, energy bulk/2 (V - V0)^2 / V0; closed surfaces",
    "Pa",
    NUMBER,
  )
  pressure: float = _row(
    0.0, reading.number(-math.inf), "inside minus outside; closed surfaces", "Pa", NUMBER
  )
  damping: float = _row(
    0.002, reading.NOT_NEGATIVE, "Rayleigh coefficient on the stiffness", "s", NUMBER
  )
  relax_share: float = _row(
    0.0,
    reading.number(0.0, 1.0),
    "share of the elastic forces that relaxes under a constant strain; `young` is instantaneous",
    "-",
    NUMBER,
  )
  relax_time: float = _row(
    0.5, reading.POSITIVE, "time constant of the relaxation, exp(-t / relax_time)", "s", NUMBER
  )
  integrator: str = _row(
    "implicit",
    reading.words(*SCHEMES),
    "`implicit`; `midpoint` for free motion ([accuracy](accuracy.md)); `neumann`, `explicit` to "
    "compare with",
    change=GRAPH,
  )
  iterations: int = _row(
    200,
    reading.whole(1, 10000),
    "limit of PCG iterations of a solve, or of Newton iterations of a rod's step",
    change=NUMBER,
  )
  tolerance: float = _row(
    1e-4, reading.number(1e-10, 1.0), "relative residual at which PCG stops", change=NUMBER
  )
  newton: int = _row(1, reading.whole(1, 100), "Newton iterations a step", change=GRAPH)
  window: str = _row(
    "",
    (reading.name, "the name of a flexcomp"),
    "flexcomp that follows the tools over the organ, which must be rigid (`add_windows` sets it); "
    "left out, the vertices are MuJoCo's dofs",
  )
  follow: tuple[str, ...] = _row(
    (),
    (reading.names, "names of bodies"),
    "bodies that the window follows; left out, all that move and collide",
  )
  mass: float = _row(0.0, reading.POSITIVE, "mass of the organ, with `window` alone", "kg")
  pin: tuple[int, ...] = _row(
    (), (reading.vertices, "vertex numbers"), "vertices that do not move, with `window` alone"
  )
  carrier: str = _row(
    "",
    (reading.name, "the name of a body, or 'own'"),
    "body that carries foundation and pins ([attachments](authoring.md#attachments)); `own`: the "
    "foundation follows the organ's own rigid motion",
  )
  attach: tuple[tuple[str, float, tuple[int, ...]], ...] = _row(
    (),
    (
      reading.attachments,
      "a body or organ, a stiffness > 0 and vertices, a comma between such groups",
    ),
    "springs from vertices to a body, or to the nearest vertices of another organ: "
    "`rib 500 3 17 18, stomach 200 40 41`; the stiffness is that of the whole group",
    "-, N/m, -",
  )
  bonds: tuple[BondRow, ...] | None = _row(
    None,
    (
      reading.bonds,
      "'none', or a body or organ, stiffness, strength, energy, and 'near' and a distance or 'at' "
      "and vertices, a comma between such groups",
    ),
    "springs from vertices to points of a body or of another organ's surface, which soften and "
    "break ([bonds](authoring.md#bonds)): `liver 1e7 3e3 5 near 0.003, rib 1e7 3e3 5 at 17 18`; "
    "`none` lets `Organ.bond` make some",
    "-, N/m³, Pa, J/m², m",
  )
  support: tuple[str, ...] = _row(
    (),
    (reading.names, "names of geoms and organs"),
    "with `window` alone: geoms and organs that support the organ, with friction, by springs of "
    "its surface in place of MuJoCo's contacts ([lying](authoring.md#lying-on-something))",
  )
  spare: int = _row(
    0,
    (reading.spare, "a whole number >= 0 or 'auto'"),
    "number of vertices without triangles, after the others, for cuts ([cutting](cutting.md)); "
    "`auto`: as many as there are; `add_organ` and `add_spare` make them",
  )
  walls: str = _row(
    "", (reading.name, "the name of a flexcomp"), "draws the walls of cuts (`add_organ` sets it)"
  )
  tear: float = _row(
    0.0,
    reading.NOT_NEGATIVE,
    "largest principal strain, length over rest length less 1, beyond which tissue tears across "
    "it, with `spare` ([cutting](cutting.md#tearing)); 0: never",
  )
  cutters: tuple[CutterRow, ...] = _row(
    (),
    (
      reading.cutters,
      "a geom, or two of scissors, and an energy > 0, and for a current 'by' and an actuator, a "
      "comma between such groups",
    ),
    "geoms that cut the wall where they are driven through it (with `spare`), and the energy that "
    "opens a unit area, or that cut and free bonds by a current ([cutters](cutting.md#cutters)): "
    "`scalpel/edge 160, scissors/edge_left scissors/edge_right 160, hook/hook_toe 1.1e6 by "
    "current`",
    "-, J/m²",
  )
  needles: tuple[NeedleRow, ...] = _row(
    (),
    (
      reading.needles,
      "a body, an energy > 0, and if wanted a friction >= 0 and an energy > 0 of the surface, a "
      "comma between such groups",
    ),
    "needles (`add_needle`) that may pass through the organ, the energy that opens a unit area, "
    "friction by length of needle in tissue, and the energy of a solid's surface if it differs "
    "([needles](authoring.md#needles)): `needle 800 15 1600`",
    "-, J/m², N/m, J/m²",
  )
  resident: bool = _row(
    False,
    reading.choice({"true": True, "false": False}),
    "with `window` alone: the motion stays on the CUDA device between steps, and the plugin state "
    "is brought up to date by `Organ.sync` alone ([internals](internals.md#resident))",
  )
  subgrid: str = _row(
    "auto",
    reading.words("auto", "true", "false"),
    "whether contacts of tools smaller than an edge get the compliance that the mesh lacks "
    "([small tools](authoring.md#small-tools)); `auto`: on bare solids",
  )
  skin: str = _row(
    "",
    (reading.name, "the name of a skin"),
    "draws the organ as a smooth surface (`add_skin` sets it)",
  )
  device: str = _row(
    "auto",
    (reading.device, "'cpu', 'cuda:0' or 'auto'"),
    "`cpu`, `cuda:N`, or `auto`: CUDA where there is a device and enough nodes",
  )

  @property
  def held(self) -> bool:
    """Whether something holds the organ in place, so that it does not fall."""
    return any(getattr(self, key) for key in holders(self.carrier))

  @property
  def bonded(self) -> bool:
    """Whether there are bonds, or room for some."""
    return self.bonds is not None


ROWS: dict[str, Row] = {each.name: each.metadata["row"] for each in dataclasses.fields(Config)}
KEYS = tuple(ROWS)
RUNNING = tuple(key for key, row in ROWS.items() if row.change)
MATERIAL = tuple(key for key, row in ROWS.items() if row.change == TISSUE)
# All that a rod may have:
ROD = (
  *("elements", "young", "poisson", "bend", "twist", "strength", "yield_strain", "drag"),
  *("refine", "iterations"),
)
_ONLY_RODS = {"twist", "strength", "yield_strain", "drag", "refine"}
RECORDED = tuple(key for key, row in ROWS.items() if row.change == GRAPH)


def table() -> str:
  """Returns the keys as a Markdown table."""
  lines = ["| key | meaning | unit | allowed | default | while running |", "|---" * 6 + "|"]
  for key, row in ROWS.items():
    cells = [f"`{key}`", row.meaning, row.unit, row.allowed.replace("'", "`"), _default(key)]
    lines.append(f"| {' | '.join(cells)} | {'may change' if row.change else '-'} |")
  return "\n".join(lines) + "\n"


def holders(carrier: str) -> tuple[str, ...]:
  """Returns the keys that hold an organ in place; its own rigid motion, as `carrier`, does not."""
  keys = ("pin", "attach", "bonds", "support")
  return keys if carrier == OWN else (*keys, "foundation", "carrier")


def _default(key: str) -> str:
  """Returns the default as a text, - where there is none."""
  value = getattr(Config, key)
  if isinstance(value, tuple):
    return " ".join(f"{each:g}" for each in value) or "-"
  if isinstance(value, float):
    try:
      ROWS[key].read(str(value), 1)
    except ValueError:
      return "-"
    return f"{value:g}"
  return "-" if value is None else str(value).lower() or "-"


def parse(organ: str, texts: dict[str, str], nelem: int, closed: bool) -> Config:
  """Returns the configuration that `texts` declares.

  Args:
    organ: name of the flexcomp, for messages
    texts: value of each key that is set; unset keys are absent or empty
    nelem: number of triangles
    closed: whether the surface encloses a volume

  Raises:
    ValueError: a value is not allowed; the message names organ, key, value and what is allowed.
  """
  values = _values(organ, texts, nelem)
  config = Config(**values)
  _check_combination(organ, config, values, closed)
  if config.capsule_young and "thickness" not in values:
    raise ValueError(f"organ {organ!r}: capsule_young is set and thickness is missing [m]")
  return config


def change(
  organ: str, config: Config, texts: dict[str, str], nelem: int, closed: bool, compiled: Config
) -> Config:
  """Returns `config` with the keys in `texts` changed, which must be ones that may change.

  Args:
    organ: name of the flexcomp, for messages
    config: configuration in force
    texts: value of each key that changes; `young_scale` stands for `young` as a multiple of the
      compiled one
    nelem: number of triangles
    closed: whether the surface encloses a volume
    compiled: the configuration that the model was compiled with

  Raises:
    ValueError: a key may not change while running or its value is not allowed.
  """
  for key in texts:
    if key not in (*RUNNING, _SCALE):
      raise ValueError(
        f"organ {organ!r}: {key!r} cannot change while running, expected one of "
        f"{', '.join((*RUNNING, _SCALE))}"
      )
  texts = dict(texts)
  scale = texts.pop(_SCALE, None)
  values = _values(organ, texts, nelem)
  if scale is not None:
    factor = _value(organ, _SCALE, scale, *reading.POSITIVE)
    values["young"] = tuple(factor * young for young in compiled.young)
  changed = dataclasses.replace(config, **values)
  for key in ("relax_share", "capsule_young"):
    now, first = (np.ravel(getattr(each, key)) for each in (changed, compiled))
    if now.any() != first.any():
      now, first = (" ".join(f"{x:g}" for x in values) or "none" for values in (now, first))
      raise ValueError(
        f"organ {organ!r}: {key} is {now}, compiled as {first}: it cannot begin or end while "
        "running"
      )
  given = values | ({"stiffness": 0} if config.stiffness else {})
  _check_combination(organ, changed, given, closed)
  return changed


def _values(organ: str, texts: dict[str, str], nelem: int) -> dict[str, Any]:
  values = {}
  for key, text in texts.items():
    if key not in ROWS:
      raise ValueError(f"organ {organ!r}: unknown key {key!r}, {reading.choices(key, KEYS)}")
    if text.strip():
      values[key] = _value(organ, key, text, ROWS[key].read, ROWS[key].allowed, nelem)
  return values


def _value(organ: str, key: str, text: str, read: Callable, allowed: str, nelem: int = 1) -> Any:
  text = text.strip()
  try:
    return read(text, nelem)
  except ValueError as error:
    if str(error).startswith("has "):
      raise ValueError(f"organ {organ!r}: {key} {error}") from None
    shown = text if len(text) <= _SHOWN else text[:_SHOWN] + "..."
    raise ValueError(f"organ {organ!r}: {key} is {shown!r}, expected {allowed}") from None


def _check_combination(organ: str, config: Config, given: dict, closed: bool):
  if config.elements == "rod":
    for key in given:
      if key not in ROD:
        raise ValueError(
          f"organ {organ!r}: {key} is set and elements is 'rod', expected {', '.join(ROD)}"
        )
  elif only_rods := _ONLY_RODS & set(given):
    key = min(only_rods)
    raise ValueError(f"organ {organ!r}: {key} is set, allowed only with elements='rod'")
  if config.yield_strain and not config.twist:
    raise ValueError(
      f"organ {organ!r}: yield_strain is {config.yield_strain:g}, allowed only where twist is not "
      "0: a bend that is kept turns with the thread"
    )
  spring = config.elements == "spring"
  if spring and "stiffness" not in given:
    raise ValueError(f"organ {organ!r}: elements is 'spring' and stiffness is missing [N/m]")
  if not spring and "stiffness" in given:
    raise ValueError(
      f"organ {organ!r}: stiffness is {config.stiffness:g}, allowed only with elements='spring'"
    )
  for key in ("follow", "mass", "pin", "resident", "support"):
    if key in given and not config.window:
      raise ValueError(f"organ {organ!r}: {key} is set, allowed only with window")
  if config.tension and config.elements != "membrane":
    raise ValueError(
      f"organ {organ!r}: tension is {config.tension:g}, allowed only with elements='membrane'"
    )
  if config.elements == "solid":
    _check_solid(organ, config, given)
  for key in () if config.elements == "solid" else ("tetrahedra", "capsule_young"):
    if value := getattr(config, key):
      raise ValueError(f"organ {organ!r}: {key} is {value!r}, allowed only with elements='solid'")
  _check_ties(organ, config)
  _check_spare(organ, config)
  if config.window and "mass" not in given and not config.mass:
    raise ValueError(f"organ {organ!r}: window is set and mass is missing [kg]")
  for key in ("bulk", "pressure"):
    value = getattr(config, key)
    if value and not closed:
      raise ValueError(f"organ {organ!r}: {key} is {value:g}, allowed only on a closed surface")


def _check_solid(organ: str, config: Config, given: dict):
  other = "where elements is not 'solid'"
  only = dict.fromkeys(("bulk", "pressure"), f"{other}: poisson says how it keeps its volume")
  if not config.capsule_young:
    only |= dict.fromkeys(("thickness", "bend"), "on a solid with capsule_young")
  for key, where in only.items():
    if given.get(key):
      raise ValueError(f"organ {organ!r}: {key} is {given[key]:g}, allowed only {where}")
  if not SCHEMES[config.integrator].solids:
    raise ValueError(f"organ {organ!r}: integrator is {config.integrator!r}, allowed only {other}")


def spare(organ: str, text: str, there: int) -> int:
  """Returns how many vertices `spare` sets aside, `auto` meaning those that are there."""
  row = ROWS["spare"]
  value = _value(organ, "spare", text, row.read, row.allowed) if text else 0
  return there if value == reading.AUTO else value


def _check_spare(organ: str, config: Config):
  if config.tear and (not config.spare or config.elements == "solid"):
    allowed = "allowed only with spare and not for a solid"
    raise ValueError(f"organ {organ!r}: tear is {config.tear:g}, {allowed}")
  if config.cutters and not config.spare and not config.bonded:
    raise ValueError(f"organ {organ!r}: cutters is set, allowed only with spare, or bonds to free")
  if not config.spare:
    return
  for key, of in (("carrier", OWN), ("capsule_young", config.capsule_young or None)):
    if getattr(config, key) == of:
      raise ValueError(f"organ {organ!r}: {key} is {of!r}, allowed only where spare is 0")


def _check_ties(organ: str, config: Config):
  for key in ("carrier", "attach", "bonds", "relax_share", "support", "cutters", "needles"):
    if not getattr(config, key) and not (key == "bonds" and config.bonded):
      continue
    if config.resident:
      raise ValueError(f"organ {organ!r}: {key} is set, allowed only without resident")
    if not SCHEMES[config.integrator].solids:
      raise ValueError(
        f"organ {organ!r}: integrator is {config.integrator!r}, allowed only without {key}"
      )
  for key in ("pressure", "tension"):
    if config.relax_share and getattr(config, key):
      raise ValueError(f"organ {organ!r}: relax_share is set, allowed only where {key} is 0")
  if config.carrier == OWN and config.pin:
    raise ValueError(f"organ {organ!r}: carrier is 'own', allowed only without pin")


def lame(config: Config, nelem: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns the plane stress Lame constants lambda', mu of each element [Pa], (nelem,) each.

  lambda' = E nu / (1 - nu^2), mu = E / (2 (1 + nu)).
  """
  young = np.broadcast_to(np.asarray(config.young), (nelem,))
  nu = config.poisson
  return young * nu / (1 - nu * nu), young / (2 * (1 + nu))


def rigidity(config: Config, nelem: int) -> np.ndarray:
  """Returns the plate bending rigidity bend E t^3 / (12 (1 - nu^2)) [N m], (nelem, ...)."""
  young = np.asarray(config.young)
  young = np.broadcast_to(young, (nelem, *young.shape[1:]))
  return config.bend * young * config.thickness**3 / (12 * (1 - config.poisson**2))
