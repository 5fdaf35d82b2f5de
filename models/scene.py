"""Models to load: an organ alone, or a scene of organ, instruments, light and laparoscope.

The files under `models/<organ>/` are what this module writes at the default resolution; other
resolutions, variants and instruments are made when they are asked for.
"""

import pathlib
from collections.abc import Sequence

import mujoco
from palpate import windows as author
from palpate.tissue.reading import choices

from . import catalog, markup, organs, shapes, trocar
from .catalog import DEFAULT, GRIDS, RESOLUTIONS
from .organs import Build

INSTRUMENTS = (*trocar.NAMES, *trocar.WRISTED)
COUPLINGS = ("nodal", "window")
_ROOM = 300  # vertices of a window where triangles are finer under the instruments
# Of contacts there: those of light vertices are soft, and a tool would sink in.
_FIRM = (0.99, 0.999, 1e-4)


def path(name: str, scene: bool = True) -> pathlib.Path:
  """Returns the MJCF file of a scene, or of the organ alone, at the default resolution."""
  catalog.entry(name)
  folder = markup.ROOT / ("liver" if name == "liver_inclusion" else name)
  if scene:
    return folder / ("scene_inclusion.xml" if name == "liver_inclusion" else "scene.xml")
  return folder / f"{name}.xml"


def load(
  name: str,
  nodes: int = DEFAULT,
  seed: int | None = None,
  instruments: Sequence[str] = ("probe", "grasper"),
  handle: bool = False,
  grid: int | None = None,
  coupling: str = "nodal",
  interior: str = "none",
  fine: float | None = None,
) -> mujoco.MjSpec:
  """Returns a scene: the organ, instruments, light, laparoscope, targets and keyframes.

  Args:
    name: organ, one of `NAMES`
    nodes: resolution, one of `RESOLUTIONS`
    seed: a number for a variant of the shape, None for the mean shape
    instruments: of `INSTRUMENTS`, at most two: the right hand's first
    handle: whether mocap handles pull the instruments in place of position actuators
    grid: a regular sheet of grid x grid nodes in place of `nodes`, one of `GRIDS`
    coupling: `nodal`, or `window` where MuJoCo knows the nodes near the instruments alone
    interior: `solid` for tetrahedra inside; `none` for the surface alone,
      on a foundation and with a bulk modulus that stand for what is inside
    fine: longest edge of the triangles within 6 mm of the places that instruments point at [m], for
      forces of small tools, with contacts that do not let them sink in; a skin wants it longer than
      it is thick; None for triangles of one size
  """
  build = _build(name, nodes, seed, grid, fine)
  check_instruments(instruments, handle)
  spec = mujoco.MjSpec.from_string(markup.scene(build, name, instruments, handle, root=None))
  spec.attach(_organ(build, name, coupling, interior), prefix=f"{name}/", frame=spec.frame(name))
  if fine is not None:
    spec.flex(f"{name}/{name}").solimp[: len(_FIRM)] = _FIRM
  free = None
  if coupling == "window":
    room = None if fine is None else _ROOM
    window = author.add_windows(spec, f"{name}/{name}", nodes=room)[0]
    free = 3 * len(spec.flex(window).vertbody)
    spec.memory = markup.megabytes(free // 3) << 20
  for key, (qpos, ctrl, mocap) in markup.keyframes(build, instruments, handle, free).items():
    spec.add_key(name=key, qpos=qpos, ctrl=ctrl, mpos=mocap)
  return spec


def organ(
  name: str,
  nodes: int = DEFAULT,
  seed: int | None = None,
  grid: int | None = None,
  coupling: str = "nodal",
  interior: str = "none",
) -> mujoco.MjSpec:
  """Returns the organ alone, to attach to a scene of your own; arguments as for `load`.

  With `coupling="window"` its window is sized for one 5 mm instrument;
  `palpate.add_windows(spec, name)` of the scene's own nodal organ sizes it for the tools there.
  """
  spec = _organ(_build(name, nodes, seed, grid), name, coupling, interior)
  if coupling == "window":
    author.add_windows(spec, name)
  return spec


def _organ(build: Build, name: str, coupling: str, interior: str) -> mujoco.MjSpec:
  if coupling not in COUPLINGS:
    raise ValueError(f"organ {name!r}: coupling is {coupling!r}, expected nodal or window")
  solid = interior == "solid"
  if not solid and interior != "none":
    raise ValueError(f"organ {name!r}: interior is {interior!r}, expected none or solid")
  if solid and build.entry.hollow:
    raise ValueError(f"organ {name!r}: interior is 'solid', expected none: it is hollow")
  made = markup.catalogued(build, name, None, coupling == "window", solid)
  return mujoco.MjSpec.from_string(made)


def targets(name: str) -> tuple[str, ...]:
  """Returns the places on an organ that have names; their sites are `<name>_<place>`."""
  return tuple(shapes.anatomy(catalog.entry(name).shape).landmarks)


def _build(
  name: str, nodes: int, seed: int | None, grid: int | None, fine: float | None = None
) -> Build:
  catalog.entry(name)
  if nodes not in RESOLUTIONS:
    known = ", ".join(map(str, RESOLUTIONS))
    raise ValueError(f"organ {name!r}: nodes is {nodes!r}, expected one of {known}")
  if grid is not None and grid not in GRIDS:
    known = ", ".join(map(str, GRIDS))
    raise ValueError(f"organ {name!r}: grid is {grid!r}, expected one of {known}, or None")
  if seed is not None and not 0 <= seed < 2**32:
    raise ValueError(f"organ {name!r}: seed is {seed!r}, expected a number in [0, 2^32), or None")
  built = organs.build(name, 0 if grid else nodes, grid or 0, seed)
  return built if fine is None else built.finer(fine)


def check_instruments(instruments: Sequence[str], handle: bool = False):
  """Raises ValueError where a scene cannot have these instruments, with handles or without."""
  if isinstance(instruments, str):
    raise ValueError(f"instruments is {instruments!r}, expected a tuple such as ({instruments!r},)")
  for instrument in instruments:
    known = trocar.NAMES if handle else INSTRUMENTS
    if instrument not in known:
      raise ValueError(f"instrument is {instrument!r}, {choices(instrument, known)}")
  if len(instruments) > 2:
    raise ValueError(f"instruments has {len(instruments)} names, expected at most two")
