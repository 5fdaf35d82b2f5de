"""Configurations of random keys: refused by name, or a motion that is finite or says it is not."""

from __future__ import annotations

import mujoco
import numpy as np
import scenes
from palpate.tissue import config

KEPT: tuple[int, ...] = ()  # seeds that once failed
# Seeds that fail, and why.
OPEN: dict[int, str] = {}
# Spans of what is sensible, on a logarithmic scale; an organ within them must move without error.
SENSIBLE = {
  "young": (1e2, 1e6),
  "thickness": (5e-4, 1e-2),
  "foundation": (1e3, 1e6),
  "bulk": (1e2, 1e5),
  "damping": (1e-4, 1e-2),
  "tolerance": (1e-8, 1e-1),
  "bend": (0.1, 2.0),
  "poisson": (0.01, 0.49),
}
WORDS = {
  "elements": ("membrane", "spring"),
  "integrator": ("implicit", "midpoint", "neumann", "explicit"),
  "resident": ("true", "false"),
  "newton": (1, 2, 3),
  "iterations": (1, 10, 200),
  "device": ("cpu", "auto"),
  "pin": ("0", "0 1 2", "3 3", "0 5"),
  "follow": ("tool", ""),
}
ODD = (
  "", " ", "-1", "0", "-0.0", "nan", "inf", "-inf", "1e400", "1e30", "1e-30", "abc", "1 2", "1,5",
  "0x10", "1_0", "²", "٣", "true", "1" * 400, "&lt;", "implicit ", "cuda:99", "-1e30", "4294967297",
)  # fmt: skip


def draw(seed: int) -> tuple[bool, bool, dict]:
  """Returns whether the organ is windowed, whether all values are sensible, and its keys."""
  random = np.random.RandomState(seed)
  window, sensible = bool(random.randint(2)), bool(random.randint(2))
  keys: dict = {}
  for key in random.permutation(config.KEYS)[: random.randint(0, 9)]:
    given = key in ("window", "mass") or (key == "pin" and not window)  # by the scene
    if given and (sensible or not window):
      continue
    if sensible and (key == "stiffness" or (key in ("follow", "pin", "resident") and not window)):
      continue
    if not sensible and random.rand() < 0.3:
      keys[key] = ODD[random.randint(len(ODD))]
    elif key in SENSIBLE:
      low, high = SENSIBLE[key]
      keys[key] = f"{low * (high / low) ** random.rand():.6g}"
    elif key in WORDS:
      keys[key] = WORDS[key][random.randint(len(WORDS[key]))]
  if sensible and keys.get("elements") == "spring":
    keys["stiffness"] = f"{10 ** random.uniform(1, 3):.6g}"
  if not sensible and random.rand() < 0.1:
    keys[f"k{random.randint(9)}"] = "1"
  return window, sensible, {"device": "cpu"} | keys


def check(seed: int):
  """Checks the configuration of a seed."""
  window, sensible, keys = draw(seed)
  # The schemes that are explicit in some part are stable for soft tissue and short steps alone.
  sensible &= keys.get("integrator", "implicit") in ("implicit", "midpoint")
  mujoco.set_mju_user_warning(lambda _: None)
  try:
    model, data, organ = scenes.load(scenes.probed(window, keys=keys))
  except ValueError as error:
    assert not sensible, error
    text = str(error)
    assert "organ" in text or any(key in text for key in keys), text
    assert "Traceback" not in text and "invalid literal" not in text, text
    return
  finally:
    mujoco.set_mju_user_warning(None)
  mujoco.set_mju_user_warning(lambda _: None)
  try:
    scenes.drive(model, data, 60)
  finally:
    mujoco.set_mju_user_warning(None)
  finite = all(np.isfinite(x).all() for x in (organ.displacement, organ.xvel, data.qpos))
  assert finite or "'organ'" in str(organ.error), f"{keys}: not finite, and nobody says so"
  if sensible:
    assert organ.error is None, (keys, organ.error)
    assert np.abs(organ.displacement).max() < 0.05, keys
