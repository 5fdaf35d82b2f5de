"""Structs with mujoco_warp's arrays in them, whose types and shapes it says itself."""

from collections.abc import Callable
from typing import Any

import mujoco_warp as mjw
from palpate.tissue.types import Array, lent

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
  found, kinds = {}, {}
  for owner, each in names.items():
    for name in each.split():
      field = (contacts if owner == "contact" else "") + name
      found[field], array = (owner, name), _OWNERS[owner][0].__annotations__[name]
      kinds[field] = Array(array.dtype, array.shape)

  def made(cls: type) -> Any:
    _THEIRS[cls.__name__] = found
    return lent(kinds)(cls)

  return made


def arrays_of(kind: Any, m: Any, d: Any) -> dict[str, Any]:
  """Returns the arrays of a struct of `theirs` by field, of a model and data of mujoco_warp's."""
  found = _THEIRS[kind.key].items()
  return {field: getattr(_OWNERS[owner][1](m, d), name) for field, (owner, name) in found}
