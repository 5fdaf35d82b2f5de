"""Random and defective meshes: refused by name, or a motion that is finite or says it is not."""

from __future__ import annotations

import mujoco
import numpy as np
import scenes

KEPT: tuple[int, ...] = ()  # seeds that once failed
# Seeds that fail, and why.
OPEN: dict[int, str] = {}


def _smooth(random):
  points, elem = scenes.sphere(random.randint(0, 3))
  return points * random.uniform(0.3, 2.0, 3), elem


def _strip(random):
  return scenes.triangular(0.1, 0.05, random.randint(1, 8), random.randint(1, 6), 0.2, 1)


def _soup(random):
  n = random.randint(3, 20)
  return random.uniform(-0.05, 0.05, (n, 3)), random.randint(0, n, (random.randint(1, 30), 3))


def jitter(random, points, elem):
  return points + random.normal(0, 10.0 ** random.uniform(-6, -1.5), points.shape), elem


def flip(random, points, elem):
  elem = elem.copy()
  some = random.rand(len(elem)) < random.rand()
  elem[some] = elem[some][:, ::-1]
  return points, elem


def drop(random, points, elem):
  keep = random.rand(len(elem)) < random.rand()
  return points, elem[keep] if keep.any() else elem[:1]


def double(random, points, elem):
  return points, np.concatenate([elem, elem[: random.randint(1, 4)]])


def merge(random, points, elem):
  i, j = random.randint(0, len(points), 2)
  return np.where(np.arange(len(points))[:, None] == i, points[j], points), elem


def weld(random, points, elem):
  i, j = random.randint(0, len(points), 2)
  return points, np.where(elem == i, j, elem)


def spare(random, points, elem):
  return np.concatenate([points, random.uniform(-1, 1, (random.randint(1, 4), 3))]), elem


def flatten(random, points, elem):
  thin = np.ones(3)
  thin[random.randint(3)] = 10.0 ** random.uniform(-12, 0)
  return points * thin, elem


def resize(random, points, elem):
  return points * 10.0 ** random.uniform(-6, 5), elem


def shift(random, points, elem):
  return points + 10.0 ** random.uniform(-3, 5) * random.uniform(-1, 1, 3), elem


def poison(random, points, elem):
  points = points.copy()
  points[random.randint(len(points)), random.randint(3)] = random.choice([np.nan, np.inf, 1e300])
  return points, elem


def stray(random, points, elem):
  elem = elem.copy()
  elem[random.randint(len(elem)), random.randint(3)] = random.choice([-1, len(points), 10**6])
  return points, elem


def twin(random, points, elem):
  other = points + np.array([random.uniform(0, 0.2), 0, 0])
  return np.concatenate([points, other]), np.concatenate([elem, elem + len(points)])


def spike(random, points, elem):
  points = points.copy()
  points[random.randint(len(points))] *= 10.0 ** random.uniform(0, 3)
  return points, elem


SHAPES = (_smooth, _smooth, _strip, _soup)
DEFECTS = (jitter, flip, drop, double, merge, weld, spare, flatten, resize, shift, poison, stray,
           twin, spike)  # fmt: skip


def draw(seed: int):
  """Returns points, triangles, the names of the defects, and whether the organ is windowed."""
  random = np.random.RandomState(seed)
  points, elem = SHAPES[random.randint(len(SHAPES))](random)
  names = []
  for k in random.randint(0, len(DEFECTS), random.randint(0, 3)):
    points, elem = DEFECTS[k](random, points, elem)
    names.append(DEFECTS[k].__name__)
  return points, elem, names, bool(random.randint(2))


def check(seed: int):
  """Checks the mesh of a seed."""
  points, elem, names, window = draw(seed)
  build = scenes.windowed if window else scenes.organ
  made = build(points, elem, young=2e4, foundation=1e4)
  mujoco.set_mju_user_warning(lambda _: None)
  try:
    try:
      model, data, organ = scenes.load(scenes.world(made, scenes.ball(0.3), gravity=(0, 0, -9.81)))
    except ValueError as error:
      assert names or len(points) < 20, error  # a sound mesh is accepted
      assert "organ" in str(error) or "flex" in str(error) or "element" in str(error), error
      return
    random = np.random.RandomState(seed)
    organ.set_state(xvel=0.01 * random.uniform(-1, 1, (organ.nvert, 3)))
    mujoco.mj_step(model, data, 20)
  finally:
    mujoco.set_mju_user_warning(None)
  assert names or organ.error is None, organ.error
  finite = all(np.isfinite(x).all() for x in (organ.displacement, organ.xvel, data.qpos))
  assert finite or "'organ'" in str(organ.error), f"{names}: not finite, and nobody says so"
