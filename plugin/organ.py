"""`Organ`: the user's handle on one organ of a model."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt
from palpate.engine import change, penetration, signals, workspace
from palpate.engine import plugin as engine
from palpate.engine.cutting import cuts as cutting
from palpate.engine.layout import FLAG
from palpate.engine.model import mjstruct
from palpate.engine.windows import windowed
from palpate.forces.cutters import Cutter
from palpate.forces.needles import Needle, Pinhole
from palpate.tissue import energy
from palpate.tissue.config import Config
from palpate.tissue.cutting.topology import Piece, Report, pieces
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology

from .bonds import Bonds


class Organ:
  """Positions, forces and measures of an organ, in world coordinates and SI units.

  Reading is cheap and changes nothing; every property is computed when it is asked for.

  Args:
    model: the compiled model
    data: its data
    name: name of the flexcomp

  Raises:
    ValueError: the model has no organ of that name; the message lists those it has.
  """

  def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, name: str):
    self.model, self.data, self.name = model, data, name
    self._space = engine.find(data._address, instance_of(model, "organ", name))

  @property
  def _organ(self):
    """The organ as it is now, cut or not."""
    cutting.follow(self._space)
    return self._space.organ

  @property
  def config(self) -> Config:
    """The configuration in force."""
    return self._space.config

  def configure(self, **keys):
    """Changes configuration keys for this mjData while running, for example `tolerance=1e-5`.

    Those may change that docs/configuration.md says so of; `young_scale` stands for `young` as a
    multiple of the compiled one. The effective inertia follows the material (`young`, `poisson`,
    `thickness`, `stiffness`) and stays that of the compiled configuration otherwise. Of an organ
    without windows it is the armature of the model's joints: give organs of different tissue a
    model each.

    Raises:
      ValueError: a key may not change, or its value is not allowed.
    """
    texts = {}
    for key, value in keys.items():
      texts[key] = value if isinstance(value, str) else " ".join(map(str, np.ravel(value)))
    change.configure(self._space, self.model._address, texts)

  @property
  def integrator(self) -> str:
    """Time stepping scheme: `implicit`, `midpoint`, `neumann` or `explicit`; may be set."""
    return self._space.config.integrator

  @integrator.setter
  def integrator(self, name: str):
    self.configure(integrator=name)

  def attach(
    self, vertices: npt.ArrayLike, to: str | int | Organ, stiffness: float | None = None
  ) -> Attachment:
    """Ties vertices by springs to a body or another organ, where they are now.

    An ideal grasp, a clip, a stitch, a ligament: the body feels the other end of each spring. It
    holds until `detach`, or until the data is reset; a copy of the data has it too.

    Args:
      vertices: numbers of vertices that are not pinned
      to: name or number of a body (fixed, mocap or with joints), or another organ of the same data,
        to whose nearest vertices the springs lead
      stiffness: of all springs together [N/m], spread by area; None for as firm as a step allows

    Raises:
      ValueError: a vertex, the body or the stiffness is not allowed; the message says what is. A
        light body takes less stiffness: it feels springs a step late.
    """
    model, target = self.model._address, self._target(to)
    return Attachment(change.attach(self._space, model, vertices, target, stiffness), model)

  def _target(self, to: str | int | Organ):
    """Returns the workspace of another organ, or the number of a body."""
    if isinstance(to, Organ):
      if to.data is not self.data or to._space is self._space:
        raise ValueError(f"organ {self.name!r}: expected another organ of the same data")
      return to._space
    return self._body(to)

  def _body(self, body: str | int) -> int:
    found = body
    if isinstance(body, str):
      found = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, body)
    if not (isinstance(found, int | np.integer) and 0 <= found < self.model.nbody):
      raise ValueError(f"organ {self.name!r}: the model has no body {body!r}")
    return int(found)

  def bond(
    self,
    to: str | int | Organ,
    stiffness: float,
    strength: float,
    energy: float,
    near: float | None = None,
    vertices: npt.ArrayLike | None = None,
  ):
    """Bonds vertices to a body or another organ, where they are now: springs that break.

    Room for their damage is in the plugin state where the key `bonds` is set, be it to `none`. They
    hold until the data is reset; a copy of the data has them too.

    Args:
      to: name or number of a body, or another organ of the same data, to whose surface they lead
      stiffness: by area [N/m^3]
      strength: traction at which a bond begins to soften [Pa]
      energy: that it takes to free an area [J/m^2]
      near: distance from the body's geoms, or the organ, within which vertices are bonded [m]
      vertices: or their numbers

    Raises:
      ValueError: a vertex, the body or a number is not allowed; the message says what is.
    """
    law, target = (stiffness, strength, energy), self._target(to)
    change.bond(self._space, self.model._address, target, str(to), law, near, vertices)

  @property
  def bonds(self) -> Bonds:
    """What it has grown on to: how much is free, damage, energy, forces."""
    return Bonds(self._space)

  def detach(self):
    """Takes away what `attach` has made; what the model declares stays."""
    held = self._space.attachments
    made = [group for group in held.groups if not group.by]
    for group in made:
      if group.other is not None:
        other = engine.find(self.data._address, group.other.host.instance)
        theirs = [g for g in group.other.groups if g.other is held and not g.by]
        change.detach(other, self.model._address, theirs)
    change.detach(self._space, self.model._address, made)

  @signals.deferred()
  def cut(
    self,
    points: npt.ArrayLike,
    depth: float | npt.ArrayLike | None = None,
    direction: npt.ArrayLike | None = None,
  ) -> Report:
    """Cuts the organ along the path on its surface that is nearest to points.

    A surface is cut through its wall. A solid is cut from the path inward, to a depth or right
    through: faces between its tetrahedra come apart, and are part of its surface from then on.

    Vertices near the path are moved onto it at rest, and the mesh comes apart along its edges:
    vertices are doubled, and triangles keep their numbers. Mass and momentum are kept. What is cut
    free has no foundation any more, and a closed surface that is cut through encloses nothing:
    `bulk` and `pressure` end. A reset of the data heals all cuts; mj_getState and mj_setState,
    and copies of the data, have them.

    Args:
      points: the path in the world, where the organ is now [m], (n, 3); to cut to an edge of an
        open surface, let it begin or end there; the same first and last point cut out a piece
      depth: of the cut in a solid, below its surface at rest [m], one or one a point; None cuts
        right through
      direction: which way a solid is cut from its surface, in the world; None for inward: as the
        surface's normals are in the mean, each by itself where the path goes around the organ, or
        toward the middle of a path that goes around and has no depth

    Returns:
      What the cut has done. With too few spare vertices it ends early: `stopped`, and a warning.

    Raises:
      ValueError: the organ has no `spare`; points are off the surface; the path is too short, or
        goes through pinned vertices; the depth is not above 0, or the organ is no solid.
    """
    inward = (None if v is None else np.asarray(v, dtype=float) for v in (depth, direction))
    report = cutting.cut(self._space, points, 0.0, *inward)
    workspace.place(self._space, self.model._address)
    return report

  @property
  def cuts(self) -> tuple[Report, ...]:
    """What `cut` has done in this data, but not what a state that was set or copied brought."""
    cutting.follow(self._space)
    return tuple(self._space.cuts.reports)

  @property
  def cutters(self) -> tuple[Cutter, ...]:
    """The geoms of the key `cutters`: whether each is in the tissue, force, energy and length."""
    return tuple(self._space.cutters.read())

  @property
  def needles(self) -> tuple[Needle, ...]:
    """The needles of the key `needles`: whether each is in the tissue, its force and energy."""
    return tuple(self._space.needles.read(self._places()))

  def _places(self) -> np.ndarray:
    """Returns places of all vertices, those inside of a solid too, in the world [m]."""
    return self._organ.origin + (self._organ.mesh.rest + self._deformation) @ self._organ.frame.T

  def sew(self, needle: str):
    """Sews a needle's thread: makes a hole wherever it crosses the surface now.

    Lay the thread through the organ before, see `Thread.lay`. Earlier holes of the needle are
    removed.

    Args:
      needle: name of its body

    Raises:
      ValueError: the key `needles` does not name the needle, it has no thread, or the thread
        crosses the surface nowhere or too often; the message says what is allowed.
    """
    mujoco.mj_kinematics(self.model, self.data)
    self._space.needles.sew(needle, self._places())

  @property
  def pinholes(self) -> tuple[Pinhole, ...]:
    """The holes of needles in its surface, by needle, in the order in which they were made."""
    return tuple(hole for needle in self.needles for hole in needle.holes if not hole.inside)

  @property
  def pieces(self) -> tuple[Piece, ...]:
    """The parts of the organ that hang together, the heaviest first."""
    organ = self._organ
    return tuple(pieces(organ.mesh, organ.mass, self.config.thickness))

  @property
  def nvert(self) -> int:
    """Number of vertices, those on the surface of a solid; more where it was cut."""
    return self._organ.mesh.nouter

  @property
  def elem(self) -> np.ndarray:
    """Triangles, counter-clockwise from outside, (nelem, 3)."""
    return self._organ.mesh.elem

  @property
  def mass(self) -> np.ndarray:
    """Mass of each vertex [kg], (nvert,); a cut divides it."""
    return self._organ.mass[: self.nvert].copy()

  @property
  def skin(self) -> int | None:
    """Number of the skin that is drawn for it, None where its own surface is; see `add_skin`."""
    return None if self._space.skin is None else self._space.skin.index

  @property
  def free(self) -> np.ndarray:
    """Whether a vertex moves, (nvert,) bool; the others are pinned."""
    return self._organ.free[: self.nvert]

  @property
  def xpos0(self) -> np.ndarray:
    """Rest positions [m], (nvert, 3)."""
    return self._organ.origin + self._organ.mesh.rest[: self.nvert] @ self._organ.frame.T

  @property
  def displacement(self) -> np.ndarray:
    """Displacement from rest [m], (nvert, 3)."""
    return self._deformation[: self.nvert] @ self._organ.frame.T

  @property
  def _deformation(self) -> np.ndarray:
    """Displacement from rest in the organ's own frame, with the inside [m], (nvert + ., 3)."""
    return self._space.motion()[0]

  @property
  def xpos(self) -> np.ndarray:
    """Positions [m], (nvert, 3)."""
    return self.xpos0 + self.displacement

  @property
  def inside(self) -> np.ndarray:
    """Positions of the nodes inside of a solid [m], (n, 3); no rows of a skin."""
    inner = self._organ.inner
    moved = self._organ.mesh.rest[inner] + self._deformation[inner]
    return self._organ.origin + moved @ self._organ.frame.T

  @property
  def tetrahedra(self) -> np.ndarray:
    """Corners of a solid's tetrahedra, (n, 4): vertices, and from `nvert` on nodes `inside`."""
    tet, inner = self._organ.mesh.tet, self._organ.inner
    return np.where(tet < inner[0], tet, tet - inner[0] + self.nvert) if len(inner) else tet.copy()

  @property
  def xvel(self) -> np.ndarray:
    """Velocities [m/s], (nvert, 3)."""
    return self._space.motion()[1][: self.nvert] @ self._organ.frame.T

  @property
  def contact_force(self) -> np.ndarray:
    """Constraint force on each vertex that the last step took [N], (nvert, 3); at rest MuJoCo's."""
    return self._space.graphs.phases.contact_force()[: self.nvert] @ self._organ.frame.T

  @property
  def window_overflow(self) -> tuple[int, int]:
    """Touched nodes and triangles that the windows had no room for in the last step."""
    flags = self._space.report.flags
    return int(flags[FLAG.missed_nodes]), int(flags[FLAG.missed_elements])

  @property
  def window_warning(self) -> str | None:
    """What the windows were too small for, at the worst moment so far, or None."""
    return windowed.shortage(self._space)

  @property
  def pierced(self) -> tuple[str, ...]:
    """Geoms that move, touch this organ, and have gone through its surface: they are inside.

    Of a long geom some point of the axis is inside, of others the centre. Faster than 1 m/s a tool
    may be in and out again between two looks: one that was stays named until the organ is reset. A
    warning names what comes through while the organ runs; an open surface has no inside.
    """
    m, d = mjstruct.both(self.model._address, self.data._address)
    tools = penetration.Tools(m, self._organ, penetration.tools(m, self._organ))
    found = {*tools.inside(d, self._deformation), *self._space.report.watch.crossed}
    return tuple(self.model.geom(geom).name or f"geom {geom}" for geom in sorted(found))

  @property
  def force(self) -> np.ndarray:
    """Sum of `contact_force` [N], (3,)."""
    return self.contact_force.sum(axis=0)

  @property
  def support_force(self) -> np.ndarray:
    """Sum of the forces of what the organ rests on (`support`) in the last step [N], (3,)."""
    return self._space.supports.force().sum(axis=0)

  @property
  def energy(self) -> float:
    """Elastic energy [J]: membrane, springs or solid, bending, foundation, volume, pressure."""
    return energy.total(self._organ.mesh, self._space.config, self._deformation)

  @property
  def volume(self) -> float:
    """Enclosed volume [m^3]; NaN for an open surface."""
    if not self._organ.mesh.closed:
      return float("nan")
    moved = (self._organ.mesh.rest + self._deformation)[: self.nvert]
    return topology.volume(moved, self.elem)

  @property
  def iterations(self) -> int:
    """PCG iterations of the last step."""
    return int(self._space.seen.status[0])

  @property
  def residual(self) -> float:
    """Relative residual of the last step's solve [-]."""
    return float(self._space.seen.status[1])

  @property
  def asleep(self) -> bool:
    """Whether the organ is at rest with no tool near, so that its step is skipped (windows)."""
    return self._space.asleep

  @property
  def error(self) -> str | None:
    """What went wrong while running since the last reset, or None."""
    return self._space.report.error

  @property
  def device(self) -> str:
    """Device the organ is solved on."""
    return self._organ.still.device.alias

  @signals.deferred()
  def set_state(self, xpos: np.ndarray | None = None, xvel: np.ndarray | None = None):
    """Places the organ; pinned vertices stay, and forces of the past are forgotten.

    The inside of a solid follows its surface smoothly.

    Args:
      xpos: positions [m], (nvert, 3); None leaves them
      xvel: velocities [m/s], (nvert, 3); None leaves them

    Raises:
      ValueError: an array has the wrong shape or holds a number that is not finite.
    """
    xpos = None if xpos is None else self._checked("xpos", xpos)
    xvel = None if xvel is None else self._checked("xvel", xvel)
    frame = self._organ.frame
    u = None if xpos is None else fill.inside(self._organ.mesh, (xpos - self.xpos0) @ frame)
    v = None if xvel is None else fill.inside(self._organ.mesh, xvel @ frame)
    self._space.forget()
    workspace.set_motion(self._space, self.model._address, u, v)

  def sync(self):
    """Brings a motion that stays on a device (`resident`) into mjData.plugin_state.

    Needed before mj_getState and mj_copyData, and only there; a state saved without it is refused.
    """
    workspace.sync(self._space)

  @signals.deferred()
  def reset(self):
    """Puts the organ at rest, its bonds whole; the rest of the model stays as it is."""
    if self._organ.config.bonded:
      self._space.bonds.state[:] = 0.0
    self.set_state(self.xpos0, np.zeros((self.nvert, 3)))

  def _checked(self, what: str, values: np.ndarray) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (self.nvert, 3):
      raise ValueError(
        f"organ {self.name!r}: {what} has shape {array.shape}, expected ({self.nvert}, 3)"
      )
    if not np.isfinite(array).all():
      raise ValueError(f"organ {self.name!r}: {what} holds numbers that are not finite")
    return array


class Attachment:
  """What `Organ.attach` has made."""

  def __init__(self, made: list, model: int):
    self._made = made
    self._model = model

  @property
  def vertices(self) -> np.ndarray:
    """Vertices of the organ that it holds, (n,)."""
    return self._made[0][1].now.vert

  @property
  def force(self) -> np.ndarray:
    """Force on the organ in the last step, in the world [N], (3,); zero when it is detached."""
    space, group = self._made[0]
    return space.attachments.force(group).sum(axis=0)

  def detach(self):
    """Lets go."""
    for space, group in self._made:
      change.detach(space, self._model, [group])


def instances(model: mujoco.MjModel, dim: int = 2) -> dict[str, int]:
  """Returns the plugin instance of each organ of a model, or with `dim` 1 thread, by its name."""
  flexes = np.flatnonzero(model.flex_dim == dim).tolist()
  found = {flex: _instance(model, flex) for flex in flexes}
  return {
    mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, flex) or "": instance
    for flex, instance in found.items()
    if instance is not None
  }


def instance_of(model: mujoco.MjModel, kind: str, name: str) -> int:
  """Returns the plugin instance of an `organ` or a `thread`; ValueError lists those there are."""
  found = instances(model, dim=1 if kind == "thread" else 2)
  if name not in found:
    have = ", ".join(map(repr, found)) or "none"
    raise ValueError(f"no {kind} {name!r} in the model, it has {have}")
  return found[name]


def _instance(model: mujoco.MjModel, flex: int) -> int | None:
  """Returns the palpate plugin instance of a flex, or None."""
  start, stop = np.append(model.flex_vertadr, model.nflexvert)[flex : flex + 2]
  bodies = np.unique(model.flex_vertbodyid[start:stop])
  if not model.flex_rigid[flex]:  # a windowed organ is rigid
    bodies = bodies[model.body_jntnum[bodies] > 0]  # parents of pinned vertices are marked too
  owner = model.body_plugin[bodies]
  slot = engine.register()
  mine = [int(i) for i in np.unique(owner[owner >= 0]) if model.plugin[i] == slot]
  return mine[0] if mine else None
