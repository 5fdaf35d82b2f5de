"""What each organ of the catalogue is made of and what its scene holds.

Everything is in SI units. Organ frame as in `shapes`: x to the patient's right, y anterior,
z superior. World of the scenes: the patient lies on the back, x to the right, z anterior (up),
-y superior (towards the head).
"""

import dataclasses

import numpy as np

RESOLUTIONS = (250, 1000, 4000, 16000)  # nodes
GRIDS = (16, 32, 64, 128, 256)  # nodes along a side of the regular sheet
DEFAULT = 1000


@dataclasses.dataclass(frozen=True)
class Inclusion:
  """A stiff lump under the surface, felt as a bell of Young's modulus over the nodes above it.

  Attributes:
    landmark: place on the surface above it
    radius: width of the bell [m]
    young: Young's modulus at its middle [Pa]
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
    young: Young's modulus of the surface [Pa]
    poisson: Poisson's ratio [-]
    thickness: thickness of the surface [m]
    foundation: Winkler foundation [Pa/m]
    bulk: volume preservation [Pa]
    damping: Rayleigh coefficient on the stiffness [s]
    density: of the whole organ [kg/m^3]; its mass is spread over the nodes
    rgba: colour
    specular, shininess: of the wet surface
    camera: position of the laparoscope in the world [m]
    target: point in the world that the laparoscope looks at [m]
    ports: one an instrument, left and right hand
    inclusion: hidden stiff lump, or None
    backdrop: another organ that is only drawn behind this one, and where it is in this one's frame
  """

  shape: str
  title: str
  young: float
  poisson: float
  thickness: float
  foundation: float
  bulk: float
  damping: float
  density: float
  rgba: tuple[float, float, float, float]
  camera: tuple[float, float, float]
  target: tuple[float, float, float]
  ports: tuple[Port, Port]
  specular: float = 0.5
  shininess: float = 0.6
  inclusion: Inclusion | None = None
  backdrop: tuple[str, tuple[float, float, float]] | None = None


_LIVER = Entry(
  shape="liver",
  title="Liver of an adult, 22 x 12 x 15 cm",
  young=5220.0,
  poisson=0.45,
  thickness=0.008,
  foundation=7e4,
  bulk=1e4,
  damping=0.005,
  density=1060.0,
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
    title="Stomach, moderately filled, 20 x 11 x 21 cm",
    young=1860.0,
    poisson=0.45,
    thickness=0.005,
    foundation=2e4,
    bulk=1e4,
    damping=0.005,
    density=1058.0,
    rgba=(0.80, 0.50, 0.44, 1.0),
    specular=0.6,
    shininess=0.7,
    camera=(0.02, 0.14, 0.17),
    target=(-0.012, -0.004, 0.005),
    ports=(Port("antrum", (0.5, 0.5, 0.8)), Port("body", (-0.4, 0.5, 0.8))),
  ),
  "gallbladder": Entry(
    shape="gallbladder",
    title="Gallbladder down to its neck, 5 x 8 x 5 cm",
    young=246000.0,
    poisson=0.45,
    thickness=0.002,
    foundation=1e4,
    bulk=1e4,
    damping=0.002,
    density=1060.0,
    rgba=(0.42, 0.52, 0.30, 1.0),
    backdrop=("liver", (-0.020, -0.008, 0.066)),
    specular=0.8,
    shininess=0.8,
    camera=(0.01, 0.085, 0.05),
    target=(0.004, 0.0, 0.008),
    ports=(
      Port("fundus", (0.6, 0.5, 0.7), gap=0.02),
      Port("body", (-0.6, 0.8, 0.2), gap=0.02),
    ),
  ),
  "kidney": Entry(
    shape="kidney",
    title="Right kidney with its renal pelvis, 8 x 4 x 11 cm",
    young=5250.0,
    poisson=0.45,
    thickness=0.006,
    foundation=1e5,
    bulk=1e4,
    damping=0.004,
    density=1060.0,
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

# Rotation from the organ's frame to the world of the scenes: anterior is up, superior is -y.
SUPINE_QUAT = (float(np.sqrt(0.5)), float(np.sqrt(0.5)), 0.0, 0.0)


def to_world(point) -> np.ndarray:
  """Returns points of the organ's frame in the world of the scenes (..., 3)."""
  x, y, z = np.moveaxis(np.asarray(point, dtype=float), -1, 0)
  return np.stack([x, -z, y], axis=-1)


def entry(name: str) -> Entry:
  """Returns an organ of the catalogue."""
  if name not in ENTRIES:
    raise ValueError(f"organ is {name!r}, expected one of {', '.join(NAMES)}")
  return ENTRIES[name]
