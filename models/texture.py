"""Textures of organs, made by code: the same seed gives the same bytes.

`python -m palpate.models.texture FOLDER` writes them as pictures; scenes make them when they load.

A texture is a factor on a material's colour. That of an organ lies on half a sphere, which both
halves of the organ show: there is no seam, because the halves meet where they are the same.
"""

import argparse
import dataclasses
import functools
import os
import pathlib
from collections.abc import Sequence

import numpy as np
import scipy
from palpate.tissue import keep
from palpate.tissue.reading import choices
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

SIZE = 256  # [pixels]
_WAVES = 20  # of an octave of noise
_REACH = 0.3  # share of a texture that a tree of vessels spreads over


@dataclasses.dataclass(frozen=True)
class Look:
  """What a kind of tissue looks like, by eye after photographs of operations.

  Attributes:
    round: whether the texture lies on half a sphere; else it is a tile, in both directions
    mottle: change of brightness and of red against blue by slow and fast noise
    pace: waves of slow and fast noise across the texture
    vessels: trees, leaves of each, radius of a trunk in texture widths
    tint: factor of the vessels' colour
    strength: how much of that is seen [-]
    lobules: of fat, across the texture; 0 for none
    streak: how much longer than wide the noise is
  """

  round: bool = True
  mottle: tuple[float, float, float] = (0.06, 0.04, 0.03)
  pace: tuple[float, float] = (3.0, 14.0)
  vessels: tuple[int, int, float] = (0, 0, 0.0)
  tint: tuple[float, float, float] = (0.7, 0.3, 0.3)
  strength: float = 0.7
  lobules: int = 0
  streak: float = 1.0


LOOKS = {
  "liver": Look(mottle=(0.08, 0.035, 0.05), pace=(4.0, 26.0)),
  "gallbladder": Look(
    mottle=(0.06, 0.03, 0.14), pace=(2.0, 9.0), vessels=(6, 40, 0.010), tint=(0.98, 0.40, 0.36),
    strength=0.6,
  ),
  "stomach": Look(
    mottle=(0.05, 0.03, 0.05), vessels=(6, 22, 0.008), tint=(0.82, 0.36, 0.38), strength=0.65
  ),
  "kidney": Look(mottle=(0.06, 0.02, 0.04), vessels=(5, 30, 0.006), tint=(0.8, 0.55, 0.5)),
  "fat": Look(
    round=False, mottle=(0.06, 0.03, 0.03), vessels=(3, 40, 0.006), tint=(0.88, 0.42, 0.34),
    lobules=26,
  ),
  "wall": Look(
    round=False, mottle=(0.035, 0.02, 0.03), vessels=(4, 40, 0.005), tint=(0.84, 0.46, 0.46),
    strength=0.5, streak=3.0,
  ),
}  # fmt: skip


def fold(sphere: np.ndarray) -> np.ndarray:
  """Returns where points of a unit sphere (n, 3) are on a texture, 0 to 1; z is the middle's.

  Octahedral coordinates (Praun and Hoppe 2003, "Spherical parametrization and remeshing") of one
  half of the sphere; the other half is its mirror image.
  """
  x, y = (sphere[:, :2] / np.abs(sphere).sum(axis=1, keepdims=True)).T
  return (np.stack([x + y, y - x], axis=1) + 1) / 2


def _unfold(texcoord: np.ndarray) -> np.ndarray:
  """Returns the points of the half sphere that are at places on a texture  (n, 3)."""
  a, b = 2 * texcoord.T - 1
  x, y = (a - b) / 2, (a + b) / 2
  out = np.stack([x, y, np.maximum(1 - np.abs(x) - np.abs(y), 0)], axis=1)
  return out / np.linalg.norm(out, axis=1, keepdims=True)


@functools.lru_cache(maxsize=32)
def texture(kind: str, seed: int = 0, size: int = SIZE) -> np.ndarray:
  """Returns a texture; do not change it.

  Args:
    kind: one of LOOKS
    seed: another one gives other spots and vessels
    size: of a side [pixels]

  Returns:
    Red, green, blue  (size, size, 3) uint8.
  """
  if kind not in LOOKS:
    raise ValueError(f"texture is {kind!r}, {choices(kind, LOOKS)}")
  if not 16 <= size <= 4096:
    raise ValueError(f"texture {kind!r}: size is {size}, expected a whole number in [16, 4096]")
  what = f"{kind} {seed} {size}".encode() + keep.source(os.path.dirname(__file__))
  made = keep.arrays("texture", what, lambda: {"rgb": _paint(kind, seed, size)})["rgb"]
  made.flags.writeable = False
  return made


def _paint(kind: str, seed: int, size: int) -> np.ndarray:
  look, random = LOOKS[kind], np.random.RandomState([seed, list(LOOKS).index(kind)])
  at = (np.indices((size, size))[::-1].reshape(2, -1).T + 0.5) / size
  points = _unfold(at) if look.round else at
  slow, fast, colour = (
    _noise(points, pace, look, random) for pace in (look.pace[0], look.pace[1], look.pace[0])
  )
  light = 1 + look.mottle[0] * slow + look.mottle[1] * fast
  if look.lobules:
    light *= _lobules(at, look.lobules, random)
  out = light[:, None] * (1 + look.mottle[2] * colour[:, None] * np.array([0.5, -0.1, -0.4]))
  if look.vessels[0]:
    seen = look.strength * _vessels(points, look, random)[:, None]
    out *= 1 - seen * (1 - np.array(look.tint))
  out = np.clip(0.86 * out, 0, 1)
  return (255 * out + 0.5).astype(np.uint8).reshape(size, size, 3)


def _noise(points: np.ndarray, pace: float, look: Look, random) -> np.ndarray:
  """Returns noise of mean 0 and deviation 1 at points: a sum of random waves  (n,)."""
  dim = points.shape[1]
  wave = random.normal(size=(_WAVES, dim))
  wave *= pace * random.uniform(0.6, 1.4, (_WAVES, 1)) / np.linalg.norm(wave, axis=1, keepdims=True)
  phase = random.uniform(0, 2 * np.pi, _WAVES)
  if not look.round:
    wave[:, 0] *= look.streak
    wave = np.round(wave)  # so that tiles fit
  else:
    wave *= 0.5  # a texture is about two radii wide
  angle = points.astype(np.float32) @ (2 * np.pi * wave.T).astype(np.float32)
  return np.sqrt(2 / _WAVES) * np.cos(angle + phase.astype(np.float32)).sum(axis=1)


def _lobules(at: np.ndarray, count: int, random) -> np.ndarray:
  """Returns the brightness of fat: cells that are darker where they meet (Worley 1996)."""
  tree = scipy.spatial.KDTree(random.uniform(size=(count * count, 2)), boxsize=1)
  first, second = tree.query(at, k=2)[0].T
  return 1.03 - 0.10 * np.exp(-(((second - first) * count / 0.3) ** 2)) - 0.06 * first * count


def _vessels(points: np.ndarray, look: Look, random) -> np.ndarray:
  """Returns how much vessels cover points, 0 to 1  (n,)."""
  trees, leaves, trunk = look.vessels
  place, radius = [], []
  for k in range(trees):
    path, size = _tree(look.round, leaves, (k + random.uniform()) / trees, random)
    place.append(path)
    radius.append(trunk * size)
  thin = 1 / SIZE  # thinner ones would be dotted
  place, radius = np.concatenate(place), np.maximum(np.concatenate(radius), thin)
  radius *= 2 if look.round else 1
  boxsize = None if look.round else 1
  tree = scipy.spatial.KDTree(place if look.round else place % 1, boxsize=boxsize)
  away, near = tree.query(points, k=4, distance_upper_bound=3 * radius.max())
  depth = np.append(radius, 1.0)[near] - away  # none is near where the index is the tree's size
  soft = 0.35 * np.append(radius, 1.0)[near] + 0.8 / SIZE
  return np.clip(0.5 + depth / (2 * soft), 0, 1).max(axis=1)


def _tree(is_round: bool, leaves: int, way: float, random) -> tuple[np.ndarray, np.ndarray]:
  """Returns points along a tree of vessels (n, d) and their radii, 1 for the trunk's.

  Shortest ways over a random net, the further from the root the thinner: by Murray's law (1926)
  the cube of a radius is the sum of those that branch off.
  """
  if is_round:
    net = random.normal(size=(1600, 3))
    net[:, 2] = np.abs(net[:, 2]) - 0.15
    net /= np.linalg.norm(net, axis=1, keepdims=True)
    side = [np.cos(2 * np.pi * way), np.sin(2 * np.pi * way), -0.1]
    root = int((net @ side).argmax())  # at the hem, which the organ's back hides
  else:
    net = random.uniform(0, 1, size=(1600, 2))
    root = random.randint(len(net))
  away, near = scipy.spatial.KDTree(net).query(net, k=9)
  cost = away[:, 1:] * random.uniform(0.5, 1.5, (len(net), 8))
  row = np.repeat(np.arange(len(net)), 8)
  graph = csr_array((cost.ravel(), (row, np.asarray(near)[:, 1:].ravel())), shape=(len(net),) * 2)
  far, before = dijkstra(graph, directed=False, indices=root, return_predecessors=True)
  reached = np.flatnonzero(np.isfinite(far) & (far < np.quantile(far[np.isfinite(far)], _REACH)))
  flow, main = np.zeros(len(net)), np.full(len(net), -1)
  for node in random.choice(reached, leaves, replace=False):
    while node >= 0 and node != root:
      flow[node] += 1
      node = before[node]
  used = np.flatnonzero(flow)
  for node in used[np.argsort(flow[used])]:
    main[before[node]] = node  # the heaviest child comes last
  inner = used[(main[used] >= 0) & (before[used] >= 0)]
  for _ in range(4):
    net[inner] = 0.5 * net[inner] + 0.25 * (net[before[inner]] + net[main[inner]])
  share = np.linspace(0, 1, 24, endpoint=False)[:, None, None]
  path = (1 - share) * net[used] + share * net[before[used]]
  size = np.broadcast_to((flow[used] / leaves) ** (1 / 3), path.shape[:2])
  path, size = path.reshape(-1, net.shape[1]), size.ravel()
  return (path / np.linalg.norm(path, axis=1, keepdims=True) if is_round else path), size


def main(arguments: Sequence[str] | None = None):
  """Writes every texture into a folder."""
  import imageio.v3 as imageio

  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument("folder", type=pathlib.Path)
  parser.add_argument("--seed", type=int, default=0)
  parser.add_argument("--size", type=int, default=SIZE)
  args = parser.parse_args(arguments)
  args.folder.mkdir(parents=True, exist_ok=True)
  for kind in LOOKS:
    path = args.folder / f"{kind}.png"
    imageio.imwrite(path, texture(kind, args.seed, args.size))
    print(path)


if __name__ == "__main__":
  main()
