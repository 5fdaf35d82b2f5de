"""What lens and sensor make of a picture, in one text for batches and for a single environment.

The order is that of the light: distortion and motion, smoke, blood on the lens, exposure, noise.
What is known of a pixel (depth, labels, points) goes through the distortion too, but is not mixed.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp
from palpate.tissue.types import Array, also, struct

from .view import Pictures, View

SMOKE = 0.75  # its grey
DROPS = 16  # of blood, at most
_SMOKE, _DROPS = wp.constant(SMOKE), wp.constant(DROPS)
_BLOOD = wp.constant(wp.vec3(0.30, 0.02, 0.02))
_THICK = wp.constant(0.92)  # share of a drop's colour in its middle
_TAPS = wp.constant(9)  # of a blurred pixel
_OUTSIDE = wp.constant(-1e6)


@struct
@also(View, "chosen", "fovy", "seed", "far")
class Lens:
  """Pictures of rows as a scene sends them, and as they are seen."""

  film: Array(wp.vec3, ("nrow",))  # share of smoke, exposure, deviation of noise
  bend: Array(wp.vec2, ("nrow",))  # k1, k2 of Brown and Conrady
  shake: Array(wp.vec2, ("nrow",))  # way during an exposure, right and down [heights]
  drop: Array(wp.vec3, ("nrow", DROPS))  # middle, right and down of the picture's; radius [heights]
  sent: Pictures  # by the scene
  seen: Pictures


def lens(drawn: Mapping[str, Any]) -> dict[str, np.ndarray]:
  """Returns fields of a row of a `Lens`.

  Args:
    drawn: numbers by their names in `palpate.tasks.core.randomisation`
  """
  blood = float(drawn.get("blood", 0.0))
  random, drop = np.random.default_rng(int(blood * 2**40)), np.zeros((DROPS, 3))
  drop[:, :2] = random.uniform(-0.6, 0.6, (DROPS, 2))
  drop[:, 2] = random.uniform(0.03, 0.14, DROPS) * (np.arange(DROPS) < int(blood))
  return {
    "film": np.array([drawn.get("veil", 0.0), drawn.get("exposure", 1.0), drawn.get("noise", 0.0)]),
    "bend": np.array([drawn.get("lens_k1", 0.0), drawn.get("lens_k2", 0.0)]),
    "shake": np.array(drawn.get("blur", (0.0, 0.0))),
    "drop": drop,
  }


@wp.func
def bent(k: wp.vec2, at: wp.vec2):
  """Returns where a lens shows what is at a place of the plane at distance 1 (Brown 1966)."""
  r2 = wp.dot(at, at)
  return at * (1.0 + r2 * (k[0] + r2 * k[1]))


@wp.func
def straight(k: wp.vec2, at: wp.vec2):
  """Returns what a lens shows at a place: the inverse of `bent`, far outside where there is none.

  Newton's method from the middle out: before the fold of `bent` it is monotonic.
  """
  way = wp.length(at)
  r, slope = wp.float32(way), wp.float32(1.0)
  if way == 0.0:
    return at
  for _ in range(12):
    r2 = r * r
    slope = 1.0 + r2 * (3.0 * k[0] + 5.0 * r2 * k[1])
    if slope > 0.05:
      r -= (r * (1.0 + r2 * (k[0] + r2 * k[1])) - way) / slope
    else:
      r *= 0.7
  r2 = r * r
  if slope <= 0.05 or wp.abs(r * (1.0 + r2 * (k[0] + r2 * k[1])) - way) > 1e-4:
    return wp.vec2(_OUTSIDE, _OUTSIDE)
  return at * (r / way)


@wp.func
def byte_at(s: Lens, r: int, i: int, j: int):
  """Returns the colour of a pixel, or of the nearest one at the rim."""
  a = wp.clamp(i, 0, s.sent.pixels.shape[1] - 1)
  b = wp.clamp(j, 0, s.sent.pixels.shape[2] - 1)
  red, green, blue = s.sent.pixels[r, a, b, 0], s.sent.pixels[r, a, b, 1], s.sent.pixels[r, a, b, 2]
  return wp.vec3(float(red), float(green), float(blue)) / 255.0


@wp.func
def blood(s: Lens, r: int, at: wp.vec2):
  """Returns how much blood is before a place of the picture, which is in heights."""
  most = wp.float32(0.0)
  for k in range(_DROPS):
    drop = s.drop[r, k]
    x, y = at[0] - drop[0], at[1] - drop[1]
    turn, phase = wp.atan2(y, x), 2.4 * float(k)
    edge = drop[2] * (1.0 + 0.15 * wp.sin(3.0 * turn + phase) + 0.1 * wp.sin(5.0 * turn - phase))
    if edge > 0.0:  # blurred: it is too near to be in focus
      deep = wp.clamp((1.15 - wp.sqrt(x * x + y * y) / edge) / 0.4, 0.0, 1.0)
      most = wp.max(most, deep * deep * (3.0 - 2.0 * deep))
  return _THICK * most


@wp.kernel(enable_backward=False)
def see(s: Lens, height: int, width: int):
  """Shows a pixel of a row."""
  r, i, j = wp.tid()
  if not s.chosen[r]:
    return
  h, x, y = float(height), float(j), float(i)
  middle = wp.vec2(0.5 * float(width) - 0.5, 0.5 * h - 0.5)
  pixel = 2.0 * wp.tan(0.5 * s.fovy[r]) / h
  if wp.length_sq(s.bend[r]) > 0.0:
    from_ = straight(s.bend[r], (wp.vec2(x, y) - middle) * pixel) / pixel + middle
    x, y = from_[0], from_[1]
  ni, nj = int(wp.floor(y + 0.5)), int(wp.floor(x + 0.5))
  inside = ni >= 0 and nj >= 0 and ni < height and nj < width
  if s.seen.depth.shape[0] > 0:
    s.seen.depth[r, i, j] = s.far
    if inside:
      s.seen.depth[r, i, j] = s.sent.depth[r, ni, nj]
  if s.seen.points.shape[0] > 0:
    s.seen.points[r, i, j] = wp.vec3()
    if inside:
      s.seen.points[r, i, j] = s.sent.points[r, ni, nj]
  if s.seen.segmentation.shape[0] > 0:
    s.seen.segmentation[r, i, j] = wp.vec2i(-1, -1)
    if inside:
      s.seen.segmentation[r, i, j] = s.sent.segmentation[r, ni, nj]
  if s.seen.labels.shape[0] > 0:
    s.seen.labels[r, i, j] = wp.uint8(0)
    if inside:
      s.seen.labels[r, i, j] = s.sent.labels[r, ni, nj]
  if s.seen.flow.shape[0] > 0:
    s.seen.flow[r, i, j] = wp.vec2()
    if inside:  # where the lens would have shown it before
      was = (wp.vec2(x, y) - s.sent.flow[r, ni, nj] - middle) * pixel
      s.seen.flow[r, i, j] = wp.vec2(float(j), float(i)) - (bent(s.bend[r], was) / pixel + middle)
  film, before = s.film[r], blood(s, r, (wp.vec2(float(j), float(i)) - middle) / h)
  if s.seen.soiling.shape[0] > 0:
    s.seen.soiling[r, i, j, 0] = wp.uint8(255.0 * film[0] + 0.5)
    s.seen.soiling[r, i, j, 1] = wp.uint8(255.0 * before + 0.5)
  if s.seen.pixels.shape[0] == 0:
    return
  shake, taps, out = s.shake[r] * h, wp.int32(1), wp.vec3()
  if wp.length_sq(shake) > 0.0:
    taps = _TAPS
  for k in range(taps):
    share = (float(k) + 0.5) / float(taps) - 0.5
    px, py = x + share * shake[0], y + share * shake[1]
    fj, fi = wp.floor(px), wp.floor(py)
    u, v, a, b = px - fj, py - fi, int(fi), int(fj)
    low = (1.0 - u) * byte_at(s, r, a, b) + u * byte_at(s, r, a, b + 1)
    high = (1.0 - u) * byte_at(s, r, a + 1, b) + u * byte_at(s, r, a + 1, b + 1)
    out += ((1.0 - v) * low + v * high) / float(taps)
  out = (1.0 - film[0]) * out + film[0] * _SMOKE * wp.vec3(1.0)
  if not inside:
    out = wp.vec3()
  out = film[1] * ((1.0 - before) * out + before * _BLOOD)
  if film[2] > 0.0:
    grain = wp.rand_init(s.seed[r], (r * height + i) * width + j)
    out += film[2] * wp.vec3(wp.randn(grain), wp.randn(grain), wp.randn(grain))
  for l in range(3):
    s.seen.pixels[r, i, j, l] = wp.uint8(wp.clamp(255.0 * out[l] + 0.5, 0.0, 255.0))
