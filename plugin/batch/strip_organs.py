"""What mujoco_warp gets of a scene: all but the organs, and slots in their place.

The slots of an organ are the vertices of one flex whose triangles are all triples of slots, since
mujoco_warp shares triangles between worlds: whichever nodes a window has, each of its triangles has
an element.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from palpate import windows
from palpate.engine import contacts
from palpate.engine.contacts import TISSUE
from palpate.engine.model import flexes, mjstruct, prepare
from palpate.thread import holds_of

from .contact.contacts import KINDS

if TYPE_CHECKING:
  from palpate.engine.model.declare import Declaration

# Slots of an organ: all triples of more are too many.
LEAST, MOST = 4, 48
_USUAL = 24  # at most, unless told
_INERTIA = 1e-8  # of a slot's body, which does not turn [kg m^2]
_COUNTED = ("nu", "na", "nsensor", "nsensordata", "neq", "ntendon", "npair", "nexclude", "nmocap")


@dataclasses.dataclass(frozen=True)
class Slots:
  """Where the stripped model has the slots of an organ."""

  nslot: int
  flex: int
  body: int
  dofadr: int
  qposadr: int
  mass: float


def tools_of(model: mujoco.MjModel, organ: Declaration) -> np.ndarray:
  """Returns the geoms that an organ's slots follow.

  Raises:
    ValueError: one is not a tool that a batch knows.
  """
  flex = organ.windows.flex if organ.windows else organ.flex
  contype, conaffinity = model.flex_contype[flex], model.flex_conaffinity[flex]
  found = np.flatnonzero((model.geom_contype & conaffinity) | (model.geom_conaffinity & contype))
  if organ.windows:  # which follow tips of needles that meet nothing too
    found = np.intersect1d(found, organ.windows.geom)
  for g in found:
    if int(model.geom_type[g]) not in KINDS:
      raise ValueError(
        f"organ {organ.name!r} collides with {_geom(model, int(g))}, of type "
        f"{_kind(model.geom_type[g])}; a batch on a GPU knows {', '.join(map(_kind, KINDS))}"
      )
  return found


def slots_for(model, organ: Declaration, tools: np.ndarray, lines: list[int], nodes) -> int:
  """Returns how many slots an organ has.

  Args:
    model: the compiled scene
    organ: the organ's declaration
    tools: geoms that the slots follow
    lines: threads that they follow, which lie on as many nodes as there can be
    nodes: a number, or one by name, or None for what the tools' sizes ask for
  """
  given = nodes.get(organ.name) if isinstance(nodes, dict) else nodes
  nvert = organ.mesh.nvert
  if given is not None:
    if isinstance(given, bool) or not isinstance(given, int) or not LEAST <= given <= MOST:
      raise ValueError(f"organ {organ.name!r}: nodes is {given!r}, expected [{LEAST}, {MOST}]")
    return min(given, nvert)
  if lines:
    return min(MOST, nvert)
  # About the nodes that each tool touches, and their neighbours.
  edge = organ.mesh.rest[organ.mesh.elem[:, [1, 2, 0]]] - organ.mesh.rest[organ.mesh.elem]
  edge = float(np.linalg.norm(edge, axis=2).mean())
  low, middle, large = np.sort(model.geom_aabb[tools, 3:], axis=1).T
  r = 0.5 * (low + middle) + edge
  area = math.pi * r * r + 2 * r * 2 * (large - middle)
  many = (area / (math.sqrt(3) / 2 * edge * edge)).sum()
  return int(min(np.clip(math.ceil(many), 8, _USUAL), nvert))


def lines_of(model, organ: Declaration, threads: list) -> list[int]:
  """Returns the numbers of the threads that an organ's slots follow."""
  kind, meets = model.flex_contype, model.flex_conaffinity
  a = organ.windows.flex if organ.windows else organ.flex
  found = [thread.flex for thread in threads]
  return [k for k, b in enumerate(found) if kind[a] & meets[b] or kind[b] & meets[a]]


def _kind(kind: int) -> str:
  return mujoco.mjtGeom(int(kind)).name.removeprefix("mjGEOM_").lower()


def _geom(model, g: int) -> str:
  name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g)
  body = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.geom_bodyid[g]))
  return f"geom {name!r}" if name else f"a geom of body {body!r}"


def strip(
  spec: mujoco.MjSpec, model: mujoco.MjModel, organs: list, nslots: list[int], threads: list
) -> tuple[mujoco.MjModel, list[Slots]]:
  """Returns the model without organs and with slots, and where it has these.

  Threads are flexes without forces of their own, the first ones.

  Args:
    spec: the scene
    model: compiled from it
    organs: its organs' declarations
    nslots: slots of each
    threads: its threads' declarations
  """
  bare = spec.copy()
  for key in list(bare.keys):
    bare.delete(key)
  bodies = {body.name: body for body in bare.bodies}
  instances = _release_plugins(bare)
  for organ in organs:
    _take_out(bare, bodies, organ, model)
  for instance in instances:
    bare.delete(instance)
  # Of a slot's body, lighter than a node whatever its world's masses [kg].
  masses = [0.1 * float(organ.mass[organ.free & (organ.mass > 0)].min()) for organ in organs]
  for organ, nslot, mass in zip(organs, nslots, masses, strict=True):
    _add_slots(bare, organ, nslot, mass, model)
  for thread in threads:
    _add_holds(bare, thread, model)
  if any(sensor.type == mujoco.mjtSensor.mjSENS_TOUCH for sensor in bare.sensors):
    # They take the other side of a flex's contact, geom -1, for the last geom: it touches nothing.
    last = bare.body(f"{organs[-1].name}_slot_{nslots[-1] - 1}")
    last.add_geom(size=[1e-6, 0, 0], mass=0.0, contype=0, conaffinity=0)
  bare.option.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
  _check_option(bare.option)
  made = bare.compile()
  for flex in range(len(threads), made.nflex):  # slots' vertices are where their bodies are
    start = made.flex_vertadr[flex]
    made.flex_vert[start : start + made.flex_vertnum[flex]] = 0.0
    made.flex_centered[flex] = True
  if made.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
    tissues = [contacts.tissue_of(model, organ) for organ in organs]
    sticks = [1 / tissue[TISSUE.stuck] for tissue in tissues if tissue[TISSUE.firm]]
    made.opt.impratio = max(made.opt.impratio, *sticks, 0)
  if made.nv <= 60 and made.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON:
    made.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
  _check(model, made, organs, nslots, threads)
  for flex, thread in enumerate(threads):
    assert flex == mujoco.mj_name2id(made, mujoco.mjtObj.mjOBJ_FLEX, thread.name)
    start = made.flex_vertadr[flex]
    body = made.flex_vertbodyid[start : start + made.flex_vertnum[flex]]
    prepare.fit_thread(made, flex, body[thread.free])
  slots = []
  for organ, nslot, mass in zip(organs, nslots, masses, strict=True):
    first = made.body(f"{organ.name}_slot_0").id
    slots.append(
      Slots(
        nslot,
        mujoco.mj_name2id(made, mujoco.mjtObj.mjOBJ_FLEX, f"{organ.name}_slots"),
        first,
        int(made.body_dofadr[first]),
        int(made.jnt_qposadr[made.body_jntadr[first]]),
        mass,
      )
    )
  return made, slots


def _release_plugins(bare) -> list:
  """Deletes the instances of the plugin, which no body refers to from now on.

  Returns:
    those without a name, which are a body's own: bodies can be deleted safely as long as they are
    there, but not where those with a name were left, which many refer to
  """
  mine = [b for b in bare.bodies if b.plugin.active and b.plugin.plugin_name == mjstruct.NAME]
  numbers = {body.plugin.id for body in mine}  # some have no name
  for body in mine:
    body.plugin.active = False
  instances = [instance for instance in bare.plugins if instance.id in numbers]
  for instance in instances:
    if instance.name:
      bare.delete(instance)
  return [instance for instance in instances if not instance.name]


def _check_option(option):
  if option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICIT:
    raise ValueError("integrator is implicit, expected Euler or implicitfast for a batch on a GPU")
  if option.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
    raise ValueError("sleep is enabled, which a batch on a GPU does not know")


def _take_out(bare, bodies: dict, organ: Declaration, model):
  """Deletes an organ's flexes and the bodies of its nodes or windows."""
  names = [flex.name for flex in bare.flexes]
  walls = flexes.resolve(organ.config.walls, organ.name, names) if organ.config.walls else None
  if walls is not None:
    bare.delete(bare.flex(walls))
  for number in {organ.flex, *organ.flexes}:
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, int(number))
    flex = bare.flex(name)
    mine = [bodies[body] for body in dict.fromkeys(flex.vertbody)]
    bare.delete(flex)
    moving = [body for body in mine if body.first_joint() is not None]
    if not moving:
      continue
    # One by one they take MuJoCo quadratic time to delete.
    doomed = moving[0].parent.add_frame()
    for body in moving:
      body.set_frame(doomed)
    bare.delete(doomed)


def _add_slots(bare, organ: Declaration, nslot: int, mass: float, model):
  flex = organ.windows.flex if organ.windows else organ.flex
  names = [f"{organ.name}_slot_{k}" for k in range(nslot)]
  for name in names:
    windows.add_node(bare.worldbody, name, np.zeros(3), mass, _INERTIA)
  # No three points of a circle are in line, which MuJoCo wants of triangles.
  angle = 2 * math.pi * np.arange(nslot) / nslot
  points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
  elem = np.array(list(itertools.combinations(range(nslot), 3)))
  made = windows.make_flex(bare, f"{organ.name}_slots", points, names, elem)
  made.contype = made.conaffinity = 0
  made.selfcollide = mujoco.mjtFlexSelf.mjFLEXSELF_NONE
  made.condim = int(model.flex_condim[flex])


def _add_holds(bare, thread, model):
  """Adds equalities of each node of a thread for each that can hold any of them.

  mujoco_warp has the two bodies of an equality in all worlds.
  """
  for which in holds_of(model, thread.body).values():
    holder = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.eq_obj1id[which]))
    for body in thread.body:
      node = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(body))
      bare.add_equality(
        type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY, name1=holder, name2=node,
        active=False,
      )  # fmt: skip


def holds_count(model, threads: list) -> int:
  """Returns how many equalities there are of `_add_holds`."""
  return sum(len(holds_of(model, thread.body)) * len(thread.body) for thread in threads)


def _check(model, made, organs: list, nslots: list[int], threads: list):
  """Raises ValueError where something of the scene hung on what was taken out."""
  more = {"neq": holds_count(model, threads)}
  for name in _COUNTED:
    before, after = getattr(model, name), getattr(made, name) - more.get(name, 0)
    if before != after:
      raise ValueError(
        f"{name} is {before} and would be {after} without the organs' nodes: an actuator, sensor, "
        "equality, tendon or pair refers to them, which a batch on a GPU cannot do"
      )
  gone = sum(organ.nfree if organ.windows is None else 3 * organ.windows.nslot for organ in organs)
  more = made.ngeom - model.ngeom
  if model.nv - gone != made.nv - 3 * sum(nslots) or more not in (0, 1):
    raise ValueError("the scene has other flexes or plugins, which a batch on a GPU cannot do")


def tools_meet(bare: mujoco.MjModel) -> bool:
  """Returns whether two geoms can touch, one of which moves."""
  kind, meets, body = bare.geom_contype, bare.geom_conaffinity, bare.body_weldid[bare.geom_bodyid]
  pairs = (kind[:, None] & meets) | (meets[:, None] & kind)
  return bool((pairs.astype(bool) & (body[:, None] != body)).any()) or bare.npair > 0


def rows_of(bare: mujoco.MjModel) -> int:
  """Returns the most rows of constraints that a world has besides those of contacts."""
  limits = int(bare.jnt_limited.sum()) + 2 * int(bare.tendon_limited.sum())
  friction = int((bare.dof_frictionloss > 0).sum() + (bare.tendon_frictionloss > 0).sum())
  return 2 * limits + friction + 6 * bare.neq


def kept(model: mujoco.MjModel, organs: list) -> tuple[np.ndarray, np.ndarray]:
  """Returns the numbers of qpos and of qvel that are not an organ's; they come first in both."""
  qpos, dofs = np.ones(model.nq, bool), np.ones(model.nv, bool)
  for organ in organs:
    qpos[organ.qposs] = dofs[organ.dofs] = False
  return np.flatnonzero(qpos), np.flatnonzero(dofs)
