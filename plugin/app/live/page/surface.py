"""What a page draws of an organ: its triangles, the finer surface over them, and its look."""

import base64
import functools
from collections.abc import Sequence
from typing import Any

import mujoco as mj
import numpy as np
from palpate import Organ
from palpate.engine.cutting.walls import PROFILE
from palpate.tissue.geometry import subdivide
from scipy.sparse import csr_array

_TINY = 2e-3  # weight below which a vertex does not count in a vertex of the skin


class Surface:
  """An organ of one model.

  Attributes:
    organ: that is drawn
    material: its material, -1 for none
  """

  def __init__(self, model: mj.MjModel, organ: Organ):
    """Takes the organ as it is now."""
    self.organ, self._model, self._whole = organ, model, organ.elem
    self._flex = mj.mj_name2id(model, mj.mjtObj.mjOBJ_FLEX, organ.name)
    skin = organ.skin
    own = model.flex_matid[self._flex] if skin is None else model.skin_matid[skin]
    self.material = int(np.ravel(own)[0])
    self._follow()

  def shape(self) -> dict[str, Any]:
    """Returns its look, its triangles, and the finer surface that is drawn for it, JSON."""
    model, skin = self._model, self.organ.skin
    colour = model.skin_rgba[skin] if skin is not None else model.flex_rgba[self._flex]
    walls = mj.mj_name2id(model, mj.mjtObj.mjOBJ_FLEX, f"{self.organ.name}_inside")
    out = {
      "count": len(self.organ.displacement),
      "look": look(model, self.material, tuple(colour)),
      "inside": (model.flex_rgba[walls] if walls >= 0 else np.array([0.3, 0.05, 0.05])).tolist(),
      "profile": PROFILE.tolist(),
      "topology": self.topology(),
    }
    if skin is None or self.organ.elem is not self._whole:
      return out
    count = int(model.skin_vertnum[skin])
    level = subdivide.LEVELS[subdivide.counts(self._whole).index(count)]
    fine = subdivide.smooth(self._whole, level)
    weight = _weights(self._whole.tobytes(), level)
    rows = {name: pack(getattr(weight, name)) for name in ("indptr", "indices", "data")}
    return out | {"smooth": rows | {"triangles": pack(fine.elem), "uv": self._uv()}}

  def places(self) -> np.ndarray:
    """Returns where the vertices are  (n, 3) [m]; n grows with a cut, up to `count`."""
    return self._rest + self.organ.displacement[: len(self._rest)]

  def cut(self) -> bool:
    """Returns whether the organ was cut since it was looked at; see `topology`."""
    return self.organ.elem is not self._elem

  def topology(self) -> dict[str, Any]:
    """Returns the triangles as they are now, JSON, where a cut has opened them, and places."""
    self._follow()
    lips = _opened(self._whole, self._elem[: len(self._whole)])
    return {
      "triangles": pack(self._elem),
      "outer": len(self._whole),
      "lips": pack(lips.astype(np.int32)),
      "uv": self._uv(),
    }

  def _follow(self) -> None:
    """Takes the organ's rest shape, which a cut changes."""
    self._elem, self._rest = self.organ.elem, self.organ.xpos0

  def _uv(self) -> dict[str, str] | None:
    """Returns where the vertices of what is drawn are on the organ's texture, None for none."""
    model, skin, flex = self._model, self.organ.skin, self._flex
    if skin is not None:
      adr = int(model.skin_texcoordadr[skin])
      at = model.skin_texcoord[adr : adr + int(model.skin_vertnum[skin])]
      return pack(at) if adr >= 0 else None
    adr, first = int(model.flex_texcoordadr[flex]), int(model.flex_elemdataadr[flex])
    if adr < 0:
      return None
    elem = self.organ.elem[: len(self._whole)]
    corners = model.flex_elemtexcoord[first : first + elem.size]
    out = np.zeros((self.organ.nvert, 2), np.float32)
    out[elem.ravel()] = model.flex_texcoord[adr + corners]
    return pack(out)


def pack(values: np.ndarray) -> dict[str, str]:
  """Returns numbers as JSON, base64: `f` are 32 bit floats, `b`, `h` and `u` 8, 16 and 32 bits."""
  if values.dtype.kind == "f":
    letter, kind = "f", np.float32
  else:
    most = int(values.max(initial=0)) if values.dtype != np.uint8 else 0
    letter, kind = next(
      (name, kind)
      for name, kind in (("b", np.uint8), ("h", np.uint16), ("u", np.uint32))
      if most <= np.iinfo(kind).max
    )
  return {letter: base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()}


def paper(model: mj.MjModel, material: int) -> int:
  """Returns the texture of a material, -1 for none that lies flat on a surface."""
  if material < 0:
    return -1
  texture = int(model.mat_texid[material, mj.mjtTextureRole.mjTEXROLE_RGB])
  flat = texture >= 0 and model.tex_type[texture] == mj.mjtTexture.mjTEXTURE_2D
  return texture if flat else -1


def look(model: mj.MjModel, material: int, rgba: Sequence[float]) -> dict[str, Any]:
  """Returns what a surface looks like: a material, where a colour of its own does not count."""
  if material < 0:
    return {"rgba": [round(float(c), 3) for c in rgba], "specular": 0.5, "shininess": 0.5}
  return {
    "rgba": [round(float(c), 3) for c in model.mat_rgba[material]],
    "specular": float(model.mat_specular[material]),
    "shininess": float(model.mat_shininess[material]),
    "texture": paper(model, material),
    "repeat": model.mat_texrepeat[material].tolist(),
  }


@functools.lru_cache(maxsize=4)
def _weights(content: bytes, level: int) -> csr_array:
  """Returns what an organ's vertices count in each of its skin's."""
  elem = np.frombuffer(content, np.int32).reshape(-1, 3)
  return subdivide.smooth(elem, level).weights(_TINY)


def _opened(whole: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns the edges that cuts have opened between an organ's own triangles  (n, 2)."""

  def alone(t: np.ndarray) -> np.ndarray:
    tail, head, n = t.ravel(), np.roll(t, -1, axis=1).ravel(), int(t.max()) + 1
    return ~np.isin(head.astype(np.int64) * n + tail, tail.astype(np.int64) * n + head)

  if elem is whole:
    return np.zeros((0, 2), int)
  half = np.flatnonzero(alone(elem) & ~alone(whole))
  return np.stack([elem[half // 3, (half + k) % 3] for k in range(2)], axis=1)
