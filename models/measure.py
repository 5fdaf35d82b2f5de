"""Measures a scene: `python -m palpate.models.measure [NAME ...] [--nodes N ...]`.

The first instrument, a probe of 2.5 mm radius, is pressed along the surface's normal at the place
it points at, at 20 mm/s to 10 mm, and held.
"""

import argparse
import dataclasses
import math
import time
from collections.abc import Sequence

import mujoco
import numpy as np
from palpate import Organ

from . import catalog, scene, trocar

SPEED, DEPTH, AWAY, HOLD = 0.02, 0.01, 0.003, 0.3  # [m/s], [m], [m], [s]


@dataclasses.dataclass(frozen=True)
class Press:
  """What a press gave.

  Attributes:
    force: of the probe on the organ at the end [N]
    depth: of the tip under the place it touched [m]
    touch: of the tip over that place at the first contact, as the surface is thick [m]
    penetration: deepest overlap of probe and organ's surface at any time [m]
    contacts: most at a time
    realtime: simulated time over processor time of the steps [-]
  """

  force: float
  depth: float
  touch: float
  penetration: float
  contacts: int
  realtime: float


def press(model: mujoco.MjModel, name: str, depth: float = DEPTH, speed: float = SPEED) -> Press:
  """Returns what a press on organ `name` of a scene with a probe gives."""
  data = mujoco.MjData(model)
  organ = Organ(model, data, f"{name}/{name}")
  landmark = catalog.entry(name).ports[0].landmark
  mujoco.mj_forward(model, data)
  target = data.site(f"{name}/{name}_{landmark}").xpos.copy()
  normal = surface_normal(organ, target)
  tool = trocar.trocar(model, "probe/")
  start = trocar.inverse(tool, target + AWAY * normal, check=False)
  data.joint("probe/pitch").qpos, data.joint("probe/yaw").qpos = start[:2]
  data.joint("probe/insertion").qpos = start[2]
  penetration, contacts, elapsed, touch = 0.0, 0, 0.0, math.nan
  steps = round(((AWAY + depth) / speed + HOLD) / model.opt.timestep)
  for i in range(steps):
    at = max(AWAY - speed * i * model.opt.timestep, -depth)
    data.ctrl[:3] = trocar.inverse(tool, target + at * normal, check=False)
    begin = time.thread_time()
    mujoco.mj_step(model, data)
    elapsed += time.thread_time() - begin
    if data.ncon:
      touch = float((data.site("probe/tip").xpos - target) @ normal) if contacts == 0 else touch
      penetration = max(penetration, -float(data.contact.dist.min()))
      contacts = max(contacts, data.ncon)
  if organ.error:
    raise RuntimeError(organ.error)
  return Press(
    force=float(np.linalg.norm(data.sensor("probe/tip_force").data)),
    depth=float((target - data.site("probe/tip").xpos) @ normal),
    touch=touch,
    penetration=penetration,
    contacts=contacts,
    realtime=steps * model.opt.timestep / elapsed,
  )


def surface_normal(organ: Organ, point: np.ndarray, radius: float = 0.01) -> np.ndarray:
  """Returns the outward normal of an organ's surface around a point  (3,)."""
  corners = organ.xpos[organ.elem]
  area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
  distance = np.linalg.norm(corners.mean(axis=1) - point, axis=1)
  normal = area[distance <= max(radius, distance.min())].sum(axis=0)
  return normal / np.linalg.norm(normal)


def main(arguments: Sequence[str] | None = None):
  """Prints one line a scene."""
  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(catalog.NAMES))
  parser.add_argument("--nodes", type=int, nargs="+", default=[catalog.DEFAULT], metavar="N")
  args = parser.parse_args(arguments)
  print("scene            nodes  force [N]  penetration [mm]  contacts  real time")
  for name in args.names or catalog.NAMES:
    for nodes in args.nodes:
      got = press(scene.load(name, nodes).compile(), name)
      print(
        f"{name:<16} {nodes:>5}  {got.force:>9.3f}  {1e3 * got.penetration:>16.2f}  "
        f"{got.contacts:>8}  {got.realtime:>8.2f}x",
        flush=True,
      )


if __name__ == "__main__":
  main()
