"""Attributes as MJCF has them, for specs and for texts."""

from collections.abc import Mapping

import numpy as np

from .engine.contacts import SOLIMP, SOLREF

# Of an organ under instruments. solmix: its solref counts, not theirs, for its nodes are light.
CONTACT: Mapping[str, object] = {
  "condim": 3,
  "friction": 0.3,
  "solref": SOLREF,
  "solimp": SOLIMP,
  "solmix": 1000,
  "selfcollide": "none",
}


def text(value, digits: int = 9) -> str:
  """Returns a text, flag, number or array of numbers as MJCF has it; 17 digits are all."""
  if isinstance(value, str):
    return value
  if isinstance(value, bool | np.bool_):
    return "true" if value else "false"
  array = np.asarray(value)
  if array.dtype.kind in "iu":
    return " ".join(map(str, array.ravel()))
  short = "{!r}" if digits >= 17 else f"{{:.{digits}g}}"  # repr: no more than tell it from others
  return " ".join(short.format(float(v) + 0.0).removesuffix(".0") for v in array.ravel())
