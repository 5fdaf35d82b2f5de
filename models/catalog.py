"""What each organ of the catalogue is made of and what its scene holds.

Everything is in SI units. Organ frame as in `shapes`: x to the patient's right, y anterior,
z superior. World of the scenes: the patient lies on the back, x to the right, z anterior (up),
-y superior (towards the head).
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from palpate.tissue.reading import choices

RESOLUTIONS = (250, 1000, 4000, 16000)  # nodes
GRIDS = (16, 32, 64, 128, 256)  # nodes along a side of the regular sheet
DEFAULT = 1000


@dataclasses.dataclass(frozen=True)
class Tissue:
  """What an organ's surface is made of, with the source of every number.

  Attributes:
    title: which organ this is, and which part of it
    young: Young's modulus of the surface [Pa]
    poisson: Poisson's ratio [-]
    thickness: thickness of the surface [m]
    foundation: Winkler foundation [Pa/m]
    bulk: volume preservation [Pa]
    damping: Rayleigh coefficient on the stiffness [s]
    density: mass over the enclosed volume [kg/m^3]; None where the mass is given
    mass: of the organ, spread over its nodes [kg]; None for density times volume
    sources: where each number is from, by its name
  """

  title: str
  young: float
  poisson: float
  thickness: float
  foundation: float
  bulk: float
  damping: float
  density: float | None
  mass: float | None
  sources: Mapping[str, str]

  def keys(self, solid: bool = False) -> dict[str, float]:
    """Returns the plugin's configuration keys, of the surface or of a solid."""
    skin = () if solid else ("thickness", "foundation", "bulk")
    return {name: getattr(self, name) for name in ("young", "poisson", *skin, "damping")}

  def mass_of(self, volume: float) -> float:
    """Returns the mass [kg] of an organ that encloses a volume [m^3]."""
    return self.mass if self.density is None else self.density * volume  # pyright: ignore


def _tissue(title: str, **numbers: tuple[float, str]) -> Tissue:
  values = {"density": None, "mass": None} | {name: value for name, (value, _) in numbers.items()}
  return Tissue(title, sources={name: source for name, (_, source) in numbers.items()}, **values)  # type: ignore


_SKIN = "ours: with the foundation, a 5 mm probe 10 mm deep gives what a half space gives it"
_WALL = "ours: of the wall"
_AROUND = "ours: stands for what lies around it"
_NU = (0.45, "nearly incompressible; ours")
_BULK = (1e4, "ours: keeps the volume")
_NO_BULK = (0.0, "ours: off, the foundation stands for the inside")
_UNKNOWN = "ours; not measured in the literature found"
_REACH = "ours: 0.3 to 1 N at 5 mm under the probe's 2.5 mm tip"

# `<organ>` is the whole organ of the catalogue's scenes, `<organ>_field` what an exercise's
# instrument feels of it in the field of view. They differ on purpose: experts and references of
# the exercises were recorded with theirs, so a change of one of those wants them recorded anew.
TISSUES: dict[str, Tissue] = {
  "liver": _tissue(
    "Whole liver: a skin with bending on a foundation stands for the solid organ",
    young=(5220.0, "2 G (1 + nu) with G = 1.8 kPa: PMC6925591"),
    poisson=_NU,
    thickness=(0.008, _SKIN),
    foundation=(7e4, _SKIN),
    bulk=_BULK,
    damping=(0.005, _UNKNOWN),
    density=(1060.0, "PMC6925591"),
  ),
  "stomach": _tissue(
    "Whole stomach, moderately filled: a wall around a filling",
    young=(1860.0, "2 G (1 + nu) with G = 0.64 kPa: PMC6925591"),
    poisson=_NU,
    thickness=(0.005, _WALL),
    foundation=(2e4, _AROUND),
    bulk=_BULK,
    damping=(0.005, _UNKNOWN),
    density=(1058.0, "PMC6925591"),
  ),
  "gallbladder": _tissue(
    "Whole gallbladder: a thin stiff wall around bile",
    young=(246000.0, "2 G (1 + nu) with G = 85 kPa: PMC6925591"),
    poisson=_NU,
    thickness=(0.002, _WALL),
    foundation=(1e4, _AROUND),
    bulk=_BULK,
    damping=(0.002, _UNKNOWN),
    density=(1060.0, "PMC6925591"),
  ),
  "kidney": _tissue(
    "Whole kidney: a skin with bending on a foundation stands for the solid organ",
    young=(5250.0, "2 G (1 + nu), G = 1.81 kPa, pig cortex: Amador et al., IEEE UFFC 58 (2011)"),
    poisson=_NU,
    thickness=(0.006, _SKIN),
    foundation=(1e5, _SKIN),
    bulk=_BULK,
    damping=(0.004, _UNKNOWN),
    density=(1060.0, "as liver: PMC6925591"),
  ),
  "liver_field": _tissue(
    "Liver in the field of view: the layer of 5 mm that moves under an instrument",
    young=(5400.0, "3 G (incompressible) with G = 1.8 kPa: PMC6925591"),
    poisson=_NU,
    thickness=(0.003, _REACH),
    foundation=(4e5, _REACH),
    bulk=_NO_BULK,
    damping=(0.005, _UNKNOWN),
    mass=(0.4, "ours: 5 mm under the whole surface of 0.078 m^2, of a liver of 1.7 kg"),
  ),
  "kidney_field": _tissue(
    "Kidney in the field of view: stiffer than excised cortex",
    young=(1e4, "ours: chosen for palpation; excised cortex has 5250 Pa, see `kidney`"),
    poisson=_NU,
    thickness=(0.006, _REACH),
    foundation=(1e5, _REACH),
    bulk=_NO_BULK,
    damping=(0.005, _UNKNOWN),
    mass=(0.15, "ours: the whole organ of 151 ml, rounded"),
  ),
  "stomach_field": _tissue(
    "Stomach in the field of view: the wall without a filling",
    young=(2e4, "ours: chosen for tracing; tougher than `stomach`, whose source looks low"),
    poisson=_NU,
    thickness=(0.003, _REACH),
    foundation=(2e5, _REACH),
    bulk=_NO_BULK,
    damping=(0.005, _UNKNOWN),
    mass=(0.2, "ours: 3 mm of wall on 0.069 m^2"),
  ),
  "gallbladder_field": _tissue(
    "Gallbladder in the field of view: soft enough to be lifted and held aside",
    young=(1.5e4, "ours: chosen for grasping; the wall alone has 246 kPa, see `gallbladder`"),
    poisson=_NU,
    thickness=(0.002, _WALL),
    foundation=(1.5e4, _AROUND),
    bulk=_BULK,
    damping=(0.005, _UNKNOWN),
    mass=(0.05, "ours: the whole organ of 46 ml, rounded"),
  ),
}


@dataclasses.dataclass(frozen=True)
class Inclusion:
  """A stiff lump under the surface, felt as a bell of Young's modulus over the nodes above it.

  Attributes:
    landmark: place on the surface above it
    radius: width of the bell [m]; ours
    young: Young's modulus at its middle [Pa]; ten times the liver's: ours
  """

  landmark: str
  radius: float
  young: float


@dataclasses.dataclass(frozen=True)
class Port:
  """Where an instrument of the scene enters and what it points at when every joint is zero.

  Attributes:
    landmark: place on the organ
    away: direction from the landmark to the trocar in the world; its length does not matter
    gap: from the landmark to the tip [m]
  """

  landmark: str
  away: tuple[float, float, float]
  gap: float = 0.025


@dataclasses.dataclass(frozen=True)
class Entry:
  """One organ of the catalogue.

  Attributes:
    shape: name of the shape in `shapes`
    title: what it is, for the head of the files
    tissue: what it is made of
    rgba: colour
    specular, shininess: of the wet surface
    camera: position of the laparoscope in the world [m]
    target: point in the world that the laparoscope looks at [m]
    ports: one an instrument, left and right hand
    inclusion: hidden stiff lump, or None
    backdrop: another organ that is only drawn behind this one, and where it is in this one's frame
    hollow: whether there is no tissue inside
  """

  shape: str
  title: str
  tissue: Tissue
  rgba: tuple[float, float, float, float]
  camera: tuple[float, float, float]
  target: tuple[float, float, float]
  ports: tuple[Port, Port]
  specular: float = 0.5
  shininess: float = 0.6
  inclusion: Inclusion | None = None
  backdrop: tuple[str, tuple[float, float, float]] | None = None
  hollow: bool = False


_LIVER = Entry(
  shape="liver",
  title="Liver of an adult, 22 x 12 x 15 cm",
  tissue=TISSUES["liver"],
  rgba=(0.52, 0.17, 0.13, 1.0),
  camera=(0.01, 0.16, 0.12),
  target=(0.0, -0.005, 0.012),
  ports=(Port("right_lobe", (0.35, 0.7, 0.75)), Port("left_lobe", (-0.3, 0.75, 0.7))),
)

ENTRIES: dict[str, Entry] = {
  "liver": _LIVER,
  "liver_inclusion": dataclasses.replace(
    _LIVER,
    title="Liver with a stiff lump hidden in the right lobe",
    inclusion=Inclusion("right_lobe", radius=0.02, young=52200.0),
  ),
  "stomach": Entry(
    shape="stomach",
    hollow=True,
    title="Stomach, moderately filled, 20 x 11 x 21 cm",
    tissue=TISSUES["stomach"],
    rgba=(0.80, 0.50, 0.44, 1.0),
    specular=0.6,
    shininess=0.7,
    camera=(0.02, 0.14, 0.17),
    target=(-0.012, -0.004, 0.005),
    ports=(Port("antrum", (0.5, 0.5, 0.8)), Port("body", (-0.4, 0.5, 0.8))),
  ),
  "gallbladder": Entry(
    shape="gallbladder",
    hollow=True,
    title="Gallbladder down to its neck, 5 x 8 x 5 cm",
    tissue=TISSUES["gallbladder"],
    rgba=(0.42, 0.52, 0.30, 1.0),
    backdrop=("liver", (-0.020, -0.008, 0.066)),
    specular=0.8,
    shininess=0.8,
    camera=(0.01, 0.085, 0.05),
    target=(0.004, 0.0, 0.008),
    ports=(Port("fundus", (0.6, 0.5, 0.7), gap=0.02), Port("body", (-0.6, 0.8, 0.2), gap=0.02)),
  ),
  "kidney": Entry(
    shape="kidney",
    title="Right kidney with its renal pelvis, 8 x 4 x 11 cm",
    tissue=TISSUES["kidney"],
    rgba=(0.50, 0.20, 0.17, 1.0),
    specular=0.6,
    shininess=0.7,
    camera=(0.0, 0.09, 0.10),
    target=(-0.004, 0.002, 0.006),
    ports=(
      Port("anterior", (0.5, 0.5, 0.8), gap=0.02),
      Port("lower_pole", (-0.5, 0.6, 0.7), gap=0.02),
    ),
  ),
}
NAMES = tuple(ENTRIES)

# Where organs are in the abdomen [m], in the liver's frame, with the source of each.
PLACES: Mapping[str, tuple[tuple[float, float, float], str]] = {
  "liver": ((0.0, 0.0, 0.0), "the frame: by vena cava and falciform ligament, midline 1 cm left"),
  "gallbladder": ((0.020, 0.008, -0.066), "ours: in the fossa of the liver's shape"),
  "stomach": (
    (-0.045, -0.040, -0.030),
    "cardia 2.5 cm left of the sternum's edge, pylorus 1 cm right of the midline at L1: Gray 1918, "
    "p. 1318; as near to both as the shape's width of 9 cm between them allows",
  ),
  "kidney": ((0.062, -0.078, -0.060), "ours: at the renal impression of the liver's shape"),
}


@dataclasses.dataclass(frozen=True)
class Duct:
  """A duct or vessel between organs.

  Attributes:
    points: of its curve in the liver's frame [m]; the way is ours
    diameter: [m]
    rgba: colour
    source: of length and diameter
  """

  points: tuple[tuple[float, float, float], ...]
  diameter: float
  rgba: tuple[float, float, float, float]
  source: str


_BILE, _BLOOD = (0.62, 0.60, 0.36, 1.0), (0.72, 0.22, 0.18, 1.0)
_MARNIOK = "Marniok et al., Med Sci Monit 5 (1999) BR395"
_GRAY = "about 25 cm in all, 5 cm in its first part: Gray 1918; its width is ours"
DUCTS: Mapping[str, Duct] = {
  "cystic_duct": Duct(
    ((0.005, -0.026, -0.049), (-0.004, -0.030, -0.052), (-0.008, -0.036, -0.062),
     (-0.0075, -0.0375, -0.0665)),
    0.00284, _BILE, f"27.4 mm long, 2.84 mm wide: {_MARNIOK}",
  ),
  "cystic_artery": Duct(
    ((-0.006, -0.034, -0.046), (0.0, -0.0275, -0.0455), (0.006, -0.020, -0.048),
     (0.011, -0.0125, -0.053)),
    0.00117, _BLOOD, f"27.1 mm long, 1.17 mm wide: {_MARNIOK}",
  ),
  "duodenum": Duct(
    ((0.036, -0.048, -0.060), (0.058, -0.056, -0.058), (0.070, -0.064, -0.078),
     (0.068, -0.066, -0.12), (0.05, -0.06, -0.15)),
    0.028, (0.82, 0.56, 0.46, 1.0), _GRAY,
  ),
}  # fmt: skip

# Rotation from the organ's frame to the world of the scenes: anterior is up, superior is -y.
SUPINE_QUAT = (float(np.sqrt(0.5)), float(np.sqrt(0.5)), 0.0, 0.0)


def to_world(point) -> np.ndarray:
  """Returns points of the organ's frame in the world of the scenes (..., 3)."""
  x, y, z = np.moveaxis(np.asarray(point, dtype=float), -1, 0)
  return np.stack([x, -z, y], axis=-1)


def entry(name: str) -> Entry:
  """Returns an organ of the catalogue."""
  if name not in ENTRIES:
    raise ValueError(f"organ is {name!r}, {choices(name, NAMES)}")
  return ENTRIES[name]
