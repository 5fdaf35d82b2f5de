"""What batches need of mujoco_warp: what its public modules lack, and its arrays by name."""

from collections.abc import Callable
from typing import Any

import mujoco_warp as mjw
from mujoco_warp._src import passive, sensor, solver, support
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
from palpate.tissue.types import Array, struct

__all__ = [
  "MJ_MAX_EPAFACES", "MJ_MAX_EPAHORIZON", "ConstraintState", "ConstraintType", "ContactType",
  "DeterminismType", "Geom", "GeomType", "OverflowType", "arrays_of", "box_triangle",
  "capsule_triangle", "ccd", "contact_kbimp", "jac_dof", "passive", "ray_geom", "sensor", "solver",
  "sphere_triangle", "theirs", "vec5",
]  # fmt: skip

# Where mujoco_warp's arrays are: what has them, of a model and its data.
_OWNERS: dict[str, tuple[type, Callable[[Any, Any], Any]]] = {
  "option": (mjw.Option, lambda m, d: m.opt),
  "model": (mjw.Model, lambda m, d: m),
  "data": (mjw.Data, lambda m, d: d),
  "contact": (mjw.Contact, lambda m, d: d.contact),
  "efc": (mjw.Constraint, lambda m, d: d.efc),
}
_THEIRS: dict[str, dict[str, tuple[str, str]]] = {}  # of a struct the owner and name of a field


def theirs(contacts: str = "", **names: str) -> Callable[[type], Any]:
  """Returns a decorator: a struct has arrays of mujoco_warp's as well, under their own names.

  What type and shape they have mujoco_warp says itself.

  Args:
    contacts: what the names of those of contacts begin with
    **names: those of each of `_OWNERS`, apart by spaces
  """

  def made(cls: type) -> Any:
    found, kinds = {}, {}
    for owner, each in names.items():
      for name in each.split():
        field = (contacts if owner == "contact" else "") + name
        found[field], array = (owner, name), _OWNERS[owner][0].__annotations__[name]
        kinds[field] = Array(array.dtype, array.shape)
    _THEIRS[cls.__name__] = found
    cls.__annotations__ = cls.__annotations__ | kinds
    return struct(cls)

  return made


def arrays_of(kind: Any, m: Any, d: Any) -> dict[str, Any]:
  """Returns the arrays of a struct of `theirs` by field, of a model and data of mujoco_warp's."""
  found = _THEIRS[kind.key].items()
  return {field: getattr(_OWNERS[owner][1](m, d), name) for field, (owner, name) in found}


# Large functions with many callers: inlined, they made kernels of contacts with flexes, of which we
# need neither interpolated ones nor boxes of rods, take a minute to compile on CUDA.
for _each in (support.add_flex_interp_weights, support.contact_bodies_and_weights):
  _each.inline_hint = "noinline"
