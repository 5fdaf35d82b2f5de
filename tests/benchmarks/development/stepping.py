"""Steps a scene as often as it is asked to: what `uncut` starts, with the code of any state.

So it knows nothing of the tests beside it, which are of the present state; surfaces come in a file.
"""

from __future__ import annotations

import math
import sys
import time

import mujoco
import numpy as np
import palpate

H = 2e-3  # time step [s]
WARM = 150  # steps before the first ones that count
# Tight, so that `iterations` bounds a solve: sheets that bend take a tenth fewer to a looser one
# since, for a reason that is no cuts. Not so with nodal coupling, which takes fewer: see results.
TOLERANCE = 1e-10
# Shape, vertices about, keys of the organ.
SCENES = {
  "membrane, windows": ("sheet", 1000, {"windows": True, "bend": 0.0, "iterations": 40}),
  "membrane, windows, 4000 nodes": (
    "sheet",
    4000,
    {"windows": True, "bend": 0.0, "iterations": 60},
  ),
  "plate, windows": ("sheet", 1000, {"windows": True, "iterations": 9}),
  "plate, windows, 4000 nodes": ("sheet", 4000, {"windows": True, "iterations": 9}),
  "closed, windows": ("ball", 642, {"windows": True, "bulk": 1e4, "iterations": 20}),
  "closed, nodal": ("ball", 162, {"bulk": 1e4, "iterations": 20}),
}


def scene(name: str, points: np.ndarray, elem: np.ndarray):
  """Returns model and data of an organ that a ball presses."""
  shape, _, keys = SCENES[name]
  if shape == "sheet":
    pin = np.flatnonzero(np.abs(np.abs(points[:, 1]) - 0.05) < 1e-9)
  else:
    pin = np.flatnonzero(points[:, 2] < -0.8 * points[:, 2].max())
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = H, (0, 0, 0)
  place = [points[:, 0].mean(), 0, points[:, 2].max() + 0.012]
  body = spec.worldbody.add_body(name="ball", pos=place)
  body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], name="z", damping=4)
  body.add_geom(size=[0.008, 0, 0], mass=0.1)
  spec.add_actuator(name="z", target="z", trntype=mujoco.mjtTrn.mjTRN_JOINT,
                    biastype=mujoco.mjtBias.mjBIAS_AFFINE, gainprm=[2000] + 9 * [0],
                    biasprm=[0, -2000, 0] + 7 * [0])  # fmt: skip
  palpate.add_organ(spec, (points, elem), "organ", mass=0.05, young=2e5, pin=pin, thickness=2e-3,
                    device="cpu", tolerance=TOLERANCE, **keys)  # fmt: skip
  model = spec.compile()
  return model, mujoco.MjData(model)


def serve(name: str, file: str):
  """Steps a scene as often as each line of the input says, and answers with CPU time [ns]."""
  with np.load(file) as surface:
    model, data = scene(name, surface["points"], surface["elem"])
  done = 0

  def advance(count: int):
    nonlocal done
    for _ in range(count):
      data.ctrl[0] = -0.012 * min(1.0, done / 100) + 0.001 * math.sin(done / 7)
      mujoco.mj_step(model, data)
      done += 1

  advance(WARM)
  print("ready", flush=True)
  for line in sys.stdin:
    start = time.process_time_ns()
    advance(int(line))
    print(time.process_time_ns() - start, flush=True)


if __name__ == "__main__":
  serve(*sys.argv[1:])
