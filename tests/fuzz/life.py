"""Models, data and organs made, copied, stepped, reset and deleted in any order in one process.

    python tests/fuzz/life.py SEED STEPS

Ends with what the process holds in memory after a half and all of the steps [kB], if all of the
motion was finite and without error.
"""

from __future__ import annotations

import copy
import gc
import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))

import mujoco
import numpy as np
import palpate
import scenes

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
MOST = 4  # models, and data of each


class Zoo:
  """What is alive: pairs of a model and its data, of which a windowed model has one."""

  def __init__(self, seed: int):
    self.random = np.random.RandomState(seed)
    self.alive: list[tuple[mujoco.MjModel, mujoco.MjData]] = []

  def pick(self) -> int:
    return self.random.randint(len(self.alive))

  def make(self):
    """Makes a model of one of a few kinds."""
    kind = self.random.randint(4)
    keys = {"resident": "true"} if kind == 2 else {}
    points, elem = scenes.sphere(1)
    if kind == 3:
      xml = scenes.world(scenes.organ(points, elem, young=3e4, foundation=1e5))
      model = mujoco.MjModel.from_xml_string(xml)
    else:
      model = mujoco.MjModel.from_xml_string(scenes.probed(kind > 0, keys=keys))
    self.alive.append((model, mujoco.MjData(model)))

  def copy_model(self):
    model, _ = self.alive[self.pick()]
    model = copy.copy(model)
    self.alive.append((model, mujoco.MjData(model)))

  def copy_data(self):
    model, data = self.alive[self.pick()]
    palpate.Organ(model, data, "organ").sync()
    model = copy.copy(model)
    twin = mujoco.MjData(model)
    mujoco.mj_copyData(twin, model, data)
    self.alive.append((model, twin))

  def adopt(self):
    """Goes on with a copy of a model, whose buffers are others; the first one goes."""
    k = self.pick()
    model, data = self.alive[k]
    palpate.Organ(model, data, "organ").sync()
    self.alive[k] = copy.copy(model), data
    mujoco.mj_step(*self.alive[k])

  def drop(self):
    del self.alive[self.pick()]
    if self.random.randint(3) == 0:
      gc.collect()

  def step(self):
    model, data = self.alive[self.pick()]
    steps = self.random.randint(1, 12)
    if model.nu:
      scenes.drive(model, data, steps)
    else:
      mujoco.mj_step(model, data, steps)

  def reset(self):
    mujoco.mj_resetData(*self.alive[self.pick()])

  def restore(self):
    model, data = self.alive[self.pick()]
    organ = palpate.Organ(model, data, "organ")
    organ.sync()
    state = np.empty(mujoco.mj_stateSize(model, STATE))
    mujoco.mj_getState(model, data, state, STATE)
    mujoco.mj_step(model, data)
    mujoco.mj_setState(model, data, state, STATE)

  def configure(self):
    organ = palpate.Organ(*self.alive[self.pick()], "organ")
    organ.configure(tolerance=10.0 ** self.random.uniform(-6, -2), damping=0.004)

  def place(self):
    organ = palpate.Organ(*self.alive[self.pick()], "organ")
    organ.set_state(organ.xpos0 + 1e-4 * self.random.uniform(-1, 1, (organ.nvert, 3)))

  def act(self):
    """Does one thing, and checks an organ."""
    acts = [self.copy_model, self.copy_data, self.adopt, self.reset, self.restore]
    acts += [self.configure, self.place]
    acts += 6 * [self.step]
    if len(self.alive) >= MOST:
      self.drop()
    elif not self.alive or self.random.randint(4) == 0:
      self.make()
    else:
      acts[self.random.randint(len(acts))]()
    model, data = self.alive[self.pick()]
    organ = palpate.Organ(model, data, "organ")
    if organ.error or not np.isfinite(organ.displacement).all():
      raise AssertionError(f"organ: {organ.error}, moved {np.abs(organ.displacement).max()} m")


def memory() -> int:
  """Returns the memory of this process [kB]."""
  gc.collect()
  text = pathlib.Path("/proc/self/status").read_text()
  return int(text.partition("VmRSS:")[2].split()[0])


def main(seed: int, steps: int):
  """Acts."""
  zoo, held = Zoo(seed), []
  for k in range(steps):
    zoo.act()
    if k + 1 in (steps // 2, steps):
      zoo.alive.clear()
      held.append(memory())
  print(*held)


if __name__ == "__main__":
  main(*map(int, sys.argv[1:]))
