"""What batches need of mujoco_warp's private modules, since its public ones lack it."""

import contextlib
from collections.abc import Iterator
from typing import Any

import warp as wp
from mujoco_warp._src import (
  collision_flex,
  collision_gjk,
  passive,
  sensor,
  solver,
  support,
  warp_util,
)
from mujoco_warp._src.collision_core import Geom
from mujoco_warp._src.collision_gjk import ccd
from mujoco_warp._src.collision_primitive_core import (
  box_triangle,
  capsule_triangle,
  sphere_triangle,
)
from mujoco_warp._src.constraint import _contact_kbimp as contact_kbimp
from mujoco_warp._src.ray import ray_geom
from mujoco_warp._src.support import jac_dof
from mujoco_warp._src.types import (
  MJ_MAX_EPAFACES,
  MJ_MAX_EPAHORIZON,
  ConstraintState,
  ConstraintType,
  ContactType,
  DeterminismType,
  GeomType,
  OverflowType,
  vec5,
)

__all__ = [
  "MJ_MAX_EPAFACES", "MJ_MAX_EPAHORIZON", "ConstraintState", "ConstraintType", "ContactType",
  "DeterminismType", "Geom", "GeomType", "OverflowType", "box_triangle", "capsule_triangle", "ccd",
  "contact_kbimp", "instead", "jac_dof", "of_threads", "passive", "ray_geom", "sensor", "solver",
  "sphere_triangle", "vec5",
]  # fmt: skip

# Large functions with many callers: inlined, they made kernels of contacts with flexes, of which we
# need no boxes of rods, and of convex geoms take a minute or two to compile on CUDA.
for _each in (
  support.contact_bodies_and_weights,
  collision_flex._collide_geom_box_rod_detect, collision_flex._collide_geom_capsule_detect,
  collision_flex._collide_geom_triangle_detect, collision_flex._collide_mesh_convex,
  collision_flex._write_candidate, collision_gjk._epa, collision_gjk.ccd, collision_gjk.gjk,
  collision_gjk.multicontact, collision_gjk.support,
):  # fmt: skip
  _each.inline_hint = "noinline"


@contextlib.contextmanager
def instead(changes: list[tuple[Any, str, Any]]) -> Iterator[None]:
  """Gives attributes of modules other values within: (owner, name, value)."""
  kept = [(owner, name, getattr(owner, name)) for owner, name, _ in changes]
  try:
    for change in changes:
      setattr(*change)
    yield
  finally:
    for change in kept:
      setattr(*change)


_kernels: dict[Any, Any] = {}  # those made within `of_threads`


@wp.func
def _add_none(nb: int, body: Any, weight: Any, b: int, w: float):
  return nb, body, weight


def of_threads() -> contextlib.AbstractContextManager[None]:
  """Lets mujoco_warp find contacts with flexes within as threads need them.

  All of them count: of those with a geom that are less than 1 mm from a deeper one it keeps none,
  and a thread whose edges are shorter would hang over an instrument on a single one.

  Its kernels know no interpolated flexes. Each thread of those of contacts with flexes has lists of
  64 nodes for them, in slow memory, which it fills whether there are any or not. Slots and threads
  are never interpolated. Without the lists the Jacobian of contacts takes 0.4 times as long.
  Kernels that others have of mujoco_warp stay as they are.
  """
  return instead([
    (warp_util, "_KERNEL_CACHE", _kernels),
    (support, "add_interp_weight", _add_none),
    (collision_flex, "_FLEX_CONTACT_DEDUP_TOLERANCE", 0.0),
  ])  # fmt: skip
