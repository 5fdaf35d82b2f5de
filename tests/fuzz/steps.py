"""Presses one organ again and again: `python tests/fuzz/steps.py COUPLING STEPS`.

Ends with what the process holds in memory after a fifth and all of the steps [kB], if all of the
motion was that of the first press.
"""

from __future__ import annotations

import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))

import mujoco
import numpy as np
import scenes
from fuzz.life import memory

PRESS = 400  # steps


def main(coupling: str, steps: int):
  """Steps."""
  model, data, organ = scenes.load(scenes.probed(coupling == "window"))
  expected, presses, held = scenes.drive(model, data, PRESS), steps // PRESS, []
  for k in range(1, presses + 1):
    mujoco.mj_resetData(model, data)
    found = scenes.drive(model, data, PRESS)
    if organ.error or not np.array_equal(found, expected):
      raise AssertionError(f"press {k}: {organ.error}, {np.abs(found - expected).max()} N off")
    if k in (max(1, presses // 5), presses):
      held.append(memory())
  print(*held)


if __name__ == "__main__":
  main(sys.argv[1], int(sys.argv[2]))
