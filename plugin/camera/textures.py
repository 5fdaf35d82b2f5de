"""Textures of a model in one array, each with pictures half as large, a quarter, ... of it."""

import mujoco
import numpy as np

LEVELS = 12
FLAT, CUBE = 0, 1
_FACES = 6


def pack(images: list[tuple[int, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
  """Returns texels of images and where they are.

  Args:
    images: of each FLAT or CUBE, and red, green, blue in [0, 255], (height, width, 3); of a cube
      its faces one below the other

  Returns:
    Texels, blue the highest byte  (n,) uint32; and a row an image: kind, width and height, and
    where each level starts  (nimage, 3 + LEVELS) int32; those after the smallest repeat it.
  """
  rows, parts, used = [], [], 0
  for kind, image in images:
    sides = image.reshape(_FACES if kind == CUBE else 1, -1, *image.shape[1:]).astype(float)
    row = [kind, sides.shape[2], sides.shape[1]]
    while len(row) < 3 + LEVELS and min(sides.shape[1:3]) > 0:
      byte = np.clip(sides + 0.5, 0, 255).astype(np.uint32).reshape(-1, 3)
      parts.append(byte[:, 0] | byte[:, 1] << 8 | byte[:, 2] << 16)
      row.append(used)
      used += len(byte)
      sides = _half(sides)
    rows.append(row + (3 + LEVELS - len(row)) * row[-1:])
  texels = np.concatenate(parts) if parts else np.zeros(1, np.uint32)
  return texels, np.array(rows, np.int32).reshape(-1, 3 + LEVELS)


def _half(sides: np.ndarray) -> np.ndarray:
  """Returns images of half the size, means of two by two."""
  n, height, width, _ = sides.shape
  even = sides[:, : height // 2 * 2, : width // 2 * 2]
  return even.reshape(n, height // 2, 2, width // 2, 2, 3).mean(axis=(2, 4))


def image(model: mujoco.MjModel, k: int) -> tuple[int, np.ndarray]:
  """Returns a texture of a model as `pack` wants it.

  Raises:
    ValueError: it is neither of three nor of four bytes a texel.
  """
  height, width, channels = model.tex_height[k], model.tex_width[k], model.tex_nchannel[k]
  if channels not in (3, 4):
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TEXTURE, k)
    raise ValueError(f"texture {name!r} has {channels} bytes a texel, expected 3 or 4")
  start = int(model.tex_adr[k])
  data = model.tex_data[start : start + height * width * channels]
  found = data.reshape(height, width, channels)[..., :3].astype(float)
  if model.tex_colorspace[k] == mujoco.mjtColorSpace.mjCOLORSPACE_SRGB:
    found = 255 * np.where(found <= 10.31, found / 3294.6, ((found / 255 + 0.055) / 1.055) ** 2.4)
  flat = model.tex_type[k] == mujoco.mjtTexture.mjTEXTURE_2D
  return FLAT if flat else CUBE, found
