"""Surgical needles: `add_needle` adds a curved one to an `mujoco.MjSpec`."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from .engine.model import flexes

ARCS = {"1/4": 0.25, "3/8": 0.375, "1/2": 0.5, "5/8": 0.625}  # of a circle
# Width of the slit that a tip opens over the diameter: the edges of a cutting one are as wide, and
# a cone tears a crack of about half (Shergold and Fleck 2004, doi:10.1098/rspa.2004.1315).
TIPS = {"taper": 0.5, "cutting": 1.0}
_STEEL = 7800.0  # density [kg/m^3]
_CAPSULES = 16  # of the arc
_POINT = (0.7, 0.35)  # radius of the last two over that of the others
_RINGS, _SIDES = 49, 12  # of the surface that is drawn
_HIDDEN = 3  # group of the capsules
_NEAR = 1e-4  # from the swage to the first node of a thread [m]
# What joins a thread: MuJoCo's equalities are as firm as what they hold is heavy, unless their
# impedance is near to 1.
_FIRM = {"solref": (0.005, 1.0), "solimp": (0.999, 0.9999, 0.001, 0.5, 2.0)}
# Inertia of turning that a free needle has besides its own, over m r^2. A needle that slips out of
# jaws spins by a radian a step, and MuJoCo's explicit gyroscopic forces would spin it up for ever.
_ARMATURE = 2.0
_RGBA = (0.75, 0.77, 0.8, 1.0)


def add_needle(
  spec: mujoco.MjSpec,
  name: str = "needle",
  *,
  arc: str = "1/2",
  length: float = 0.026,
  diameter: float = 0.0007,
  tip: str = "taper",
  thread: str | None = None,
  parent: mujoco.MjsBody | str | None = None,
  pos: Sequence[float] = (0.0, 0.0, 0.0),
  quat: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
  mass: float | None = None,
  rgba: Sequence[float] = _RGBA,
  contact: Mapping[str, object] | None = None,
) -> mujoco.MjsBody:
  """Adds a surgical needle to a spec: a rigid body of capsules along an arc, in plain MJCF.

  Pictures show a smooth surface, the geom `<name>`, in place of the capsules.

  The body's origin is the centre of the circle and its z axis that of the circle, so a turn about z
  drives the needle along itself, tip first. The middle of the arc is on the x axis. The sites
  `<name>_swage` and `<name>_tip` are its ends, with z axes along it. An organ knows it by its key
  `needles`.

  Args:
    spec: changed in place, unless an error is raised
    name: of the body; the capsules are `<name>_<k>` from the swage on
    arc: share of the circle: `1/4`, `3/8`, `1/2` or `5/8`
    length: along the arc [m]
    diameter: [m]
    tip: `taper`, which tears a slit and spreads it, or `cutting`, with edges as wide as the needle;
      the size of the tip's site is half the slit's width
    thread: a thread of the spec whose first node is at the swage, to which it is joined; the first
      capsule then has no contacts
    parent: body in which it is fixed; None for a free needle
    pos: of the circle's centre in the parent [m]
    quat: orientation in the parent
    mass: [kg]; None for that of the wire in steel, 0.08 g by default
    rgba: colour
    contact: attributes of the geoms that differ from the defaults: condim, friction, contype, ...

  Returns:
    The body.

  Raises:
    ValueError: an argument, the name or the thread is not allowed; the message says what is.
  """
  for what, value, known in (("arc", arc, ARCS), ("tip", tip, TIPS)):
    if value not in known:
      raise ValueError(f"needle {name!r}: {what} is {value!r}, expected one of {', '.join(known)}")
  if mass is None:
    mass = _STEEL * np.pi / 4 * diameter**2 * length
  for what, value, most in (("length", length, 1.0), ("diameter", diameter, length / 4),
                            ("mass", mass, np.inf)):  # fmt: skip
    if not 0 < value < most:
      raise ValueError(f"needle {name!r}: {what} is {value:g}, expected above 0, below {most:g}")
  if not name or name in {body.name for body in spec.bodies}:
    raise ValueError(f"needle {name!r}: expected a name that no body of the spec has")
  where = spec.body(parent) if isinstance(parent, str) else parent or spec.worldbody
  if where is None:
    raise ValueError(f"needle {name!r}: no body {parent!r} in the spec")
  angle = 2 * np.pi * ARCS[arc] * np.linspace(-0.5, 0.5, _CAPSULES + 1)
  circle = length / (2 * np.pi * ARCS[arc])
  points = circle * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
  if thread is not None:
    _check_thread(spec, name, thread, _place(where, pos, quat, points[0]), length)
  body = where.add_body(name=name, pos=pos, quat=quat)
  if parent is None:  # as inertia about all axes: as mass it is nothing
    body.add_freejoint(name=name).armature = _ARMATURE * mass * circle**2
  _draw(spec, body, circle, angle, 0.5 * diameter, rgba)
  look = {"condim": 4, "friction": (1.0, 0.005, 0.0001)} | dict(contact or {})
  for k in range(_CAPSULES):
    point = _CAPSULES - k  # from the tip, 1 for the last
    thick = _POINT[len(_POINT) - point] if point <= len(_POINT) else 1.0
    ends, radius = np.concatenate([points[k], points[k + 1]]), 0.5 * thick * diameter
    meets = {"contype": 0, "conaffinity": 0} if thread is not None and k == 0 else {}
    body.add_geom(
      name=f"{name}_{k}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends,
      size=[radius, 0, 0], mass=mass / _CAPSULES, group=_HIDDEN, rgba=rgba, **(look | meets),
    )  # fmt: skip
  for end, k, half in (("swage", 0, diameter / 2), ("tip", -1, TIPS[tip] * diameter / 2)):
    along = (-np.sin(angle[k]), np.cos(angle[k]), 0.0)
    size = [half, half, half]
    body.add_site(name=f"{name}_{end}", pos=points[k], size=size, zaxis=along, group=4)
  if thread is not None:
    data = [*points[0], *np.zeros(mujoco.mjNEQDATA - 3)]
    spec.add_equality(
      name=f"{name}_{thread}", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY,
      name1=name, name2=f"{thread}_0", data=data, **_FIRM,
    )  # fmt: skip
  return body


def _draw(spec, body, circle: float, angle: np.ndarray, radius: float, rgba) -> None:
  """Adds the surface that is drawn: steel, round, with a point over the last two capsules."""
  along = np.linspace(0.0, 1.0, _RINGS)
  thick = radius * np.clip(0.5 * _CAPSULES * (1 - along), 0.08, 1.0)
  thick[0] *= 0.8  # a blunt edge at the swage
  around = 2 * np.pi * np.arange(_SIDES) / _SIDES
  turn = np.interp(along, np.linspace(0.0, 1.0, len(angle)), angle)[:, None]
  out = circle + thick[:, None] * np.cos(around)
  rings = np.stack(
    [out * np.cos(turn), out * np.sin(turn), thick[:, None] * np.sin(around) + 0 * turn], axis=2
  )
  ends = circle * np.column_stack([np.cos(turn[[0, -1]]), np.sin(turn[[0, -1]]), [0, 0]])
  k = np.arange(_SIDES)
  here, beside = k, (k + 1) % _SIDES
  first = _SIDES * np.arange(_RINGS - 1)[:, None]
  walls = [
    np.stack([first + here, first + _SIDES + here, first + beside], axis=2),
    np.stack([first + beside, first + _SIDES + here, first + _SIDES + beside], axis=2),
  ]
  last, count = _SIDES * (_RINGS - 1), _SIDES * _RINGS
  caps = [
    np.column_stack([here, beside, np.full(_SIDES, count)]),
    np.column_stack([last + beside, last + here, np.full(_SIDES, count + 1)]),
  ]
  faces = np.concatenate([*(wall.reshape(-1, 3) for wall in walls), *caps])
  spec.add_mesh(
    name=body.name, uservert=np.concatenate([rings.reshape(-1, 3), ends]).ravel(),
    userface=faces.ravel(),
  )  # fmt: skip
  spec.add_material(name=body.name, rgba=rgba, specular=0.9, shininess=0.8)
  body.add_geom(
    name=body.name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=body.name, material=body.name,
    contype=0, conaffinity=0, mass=0, group=2,
  )  # fmt: skip


def _place(body, pos, quat, point: np.ndarray) -> np.ndarray:
  """Returns where a point of a body is in the world [m], given its place in its parent."""
  turn = flexes.matrix(np.asarray(quat, float) / np.linalg.norm(quat))
  at = np.asarray(pos, float) + turn @ point
  return at if body.parent is None else _place(body.parent, body.pos, body.quat, at)


def _check_thread(spec, name: str, thread: str, swage: np.ndarray, length: float):
  """Raises ValueError where a thread cannot be that of a needle whose swage is in a place [m]."""
  first, second = (spec.body(f"{thread}_{k}") for k in range(2))
  if first is None or spec.flex(thread) is None:
    raise ValueError(
      f"needle {name!r}: thread is {thread!r}, expected one of the spec's whose first node is free"
    )
  at = _place(first.parent, first.pos, first.quat, np.zeros(3))
  if np.linalg.norm(at - swage) > _NEAR:
    raise ValueError(
      f"needle {name!r}: the first node of thread {thread!r} is at {at.round(4)}, expected at the "
      f"swage, {swage.round(4)}"
    )
  edge = np.linalg.norm(second.pos - first.pos) if second is not None else 0.0
  if edge > length:
    raise ValueError(
      f"needle {name!r}: edges of thread {thread!r} are {1e3 * edge:.3g} mm long, expected no "
      f"longer than the needle, {1e3 * length:.3g} mm"
    )
