"""Domain randomisation: quantities drawn from ranges at the start of every episode.

    tasks.load("touch", "easy", task_kwargs={"randomise": {"stiffness": (0.5, 2.0)}})

Numbers are drawn uniformly from the task's random state, in the order of `QUANTITIES`; what was
drawn is `task.drawn`, and in Gymnasium `info["randomised"]`.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco as mj
import numpy as np
import warp as wp
from palpate.camera import lens
from palpate.camera.lens import DROPS
from palpate.camera.view import Pictures
from palpate.tissue.types import allocate, fill

from . import stage
from .physics import Physics
from .scenes import CAMERA, LIGHT

TEXTURES = 16  # of an organ
Ranges = Mapping[str, tuple[float, float]]


@dataclasses.dataclass(frozen=True)
class Quantity:
  """What may be drawn.

  Attributes:
    what: it is, in Markdown
    unit: of its numbers
    low: least value allowed
    high: greatest value allowed
    count: how many numbers are drawn
    apply: takes physics, stage and the numbers, and changes the model
    seen: whether pictures alone show it: vectorised exercises draw that
  """

  what: str
  unit: str
  low: float
  high: float
  count: int
  apply: Callable[[Physics, stage.Stage, np.ndarray], None]
  seen: bool = True


def _stiffness(physics: Physics, place: stage.Stage, factor: np.ndarray) -> None:
  foundation = float(factor[0]) * place.config.foundation
  physics.organ.configure(young_scale=float(factor[0]), foundation=foundation)
  stage.settle(physics.organ, [hand.prefix for hand in physics.hands])


def _friction(physics: Physics, place: stage.Stage, factor: np.ndarray) -> None:
  place.model.flex_friction[:, 0] *= factor[0]
  place.model.geom_friction[:, 0] *= factor[0]


def _camera_pos(physics: Physics, place: stage.Stage, shift: np.ndarray) -> None:
  place.model.camera(CAMERA).pos[:] += shift
  lamp = mj.mj_name2id(place.model, mj.mjtObj.mjOBJ_LIGHT, LIGHT)
  if lamp >= 0:  # an endoscope's light goes with it
    place.model.light_pos[lamp] += shift


def _camera_turn(physics: Physics, place: stage.Stage, angles: np.ndarray) -> None:
  turn = np.zeros(4)
  angle = math.radians(np.linalg.norm(angles))
  mj.mju_axisAngle2Quat(turn, angles / max(np.linalg.norm(angles), 1e-12), angle)
  quat = place.model.camera(CAMERA).quat
  mj.mju_mulQuat(quat, quat.copy(), turn)


def _light(physics: Physics, place: stage.Stage, factor: np.ndarray) -> None:
  model, head = place.model, place.model.vis.headlight
  for owner, prefix in ((model, "light_"), (head, "")):
    for kind in ("ambient", "diffuse", "specular"):
      getattr(owner, prefix + kind)[:] *= factor[0]


def _light_pos(physics: Physics, place: stage.Stage, shift: np.ndarray) -> None:
  place.model.light_pos[:] += shift


def _fovy(physics: Physics, place: stage.Stage, change: np.ndarray) -> None:
  place.model.cam_fovy[place.model.camera(CAMERA).id] += change[0]


def _of_lens(physics: Physics, place: stage.Stage, value: np.ndarray) -> None:
  """Leaves the scene: `see` changes the pictures."""


def _texture(physics: Physics, place: stage.Stage, value: np.ndarray) -> None:
  model, k = place.model, min(int(value[0]), TEXTURES - 1)
  for of in (model.flex_matid, model.skin_matid) if k else ():
    for owner, material in enumerate(of):
      name = f"{mj.mj_id2name(model, mj.mjtObj.mjOBJ_MATERIAL, material)}_{k}"
      found = mj.mj_name2id(model, mj.mjtObj.mjOBJ_MATERIAL, name)
      of[owner] = found if found >= 0 else material


def _colour(physics: Physics, place: stage.Stage, change: np.ndarray) -> None:
  model = place.model
  flex, skin = mj.mj_name2id(model, mj.mjtObj.mjOBJ_FLEX, physics.organ_name), physics.organ.skin
  shown = {int(model.flex_matid[flex]): model.flex_rgba[flex]}
  if skin is not None:
    shown[int(model.skin_matid[skin])] = model.skin_rgba[skin]
  for material, own in shown.items():
    rgba = own if material < 0 else model.mat_rgba[material]
    rgba[:3] = np.clip(rgba[:3] + change, 0, 1)


QUANTITIES = {
  "stiffness": Quantity(
    "factor on the organ's Young's modulus and foundation; it is let sink under its weight anew",
    "-", 0.1, 10.0, 1, _stiffness, False,
  ),
  "friction": Quantity(
    "factor on the sliding friction of organ and instrument", "-", 0.0, 10.0, 1, _friction, False
  ),
  "camera_pos": Quantity(
    "shift of the laparoscope along each axis of its body, the world's in the exercises' scenes",
    "m", -0.05, 0.05, 3, _camera_pos,
  ),
  "camera_turn": Quantity(
    "turn of the laparoscope, a rotation vector in its axes", "deg", -30.0, 30.0, 3, _camera_turn
  ),
  "camera_fovy": Quantity(
    "change of the laparoscope's vertical field of view", "deg", -20.0, 20.0, 1, _fovy
  ),
  "light": Quantity("factor on the brightness of all lights", "-", 0.0, 5.0, 1, _light),
  "light_pos": Quantity(
    "shift of the lights along each axis", "m", -0.2, 0.2, 3, _light_pos
  ),
  "texture": Quantity(
    f"number of the organ's texture, rounded down, one of {TEXTURES}; in the abdomen", "-", 0.0,
    float(TEXTURES), 1, _texture,
  ),
  "colour": Quantity(
    "change of the organ's red, green and blue, which are in [0, 1]", "-", -1.0, 1.0, 3, _colour
  ),
  "lens_k1": Quantity(
    "distortion of the lens by Brown and Conrady, k1 as in OpenCV; below 0 it is a barrel. What is "
    "beyond the scene's picture is black", "-", -0.5, 0.5, 1, _of_lens,
  ),
  "lens_k2": Quantity("the same, k2", "-", -0.5, 0.5, 1, _of_lens),
  "blur": Quantity(
    "way of the picture during an exposure, right and down", "heights", -0.2, 0.2, 2, _of_lens
  ),
  "veil": Quantity("share of light grey smoke in `pixels`", "-", 0.0, 1.0, 1, _of_lens),
  "blood": Quantity(
    "number of blood drops on the lens, rounded down; its digits say where they are", "-", 0.0,
    float(DROPS), 1, _of_lens,
  ),
  "exposure": Quantity("factor on `pixels`, after smoke and blood", "-", 0.0, 5.0, 1, _of_lens),
  "noise": Quantity(
    "standard deviation of noise on `pixels`, of 1, another in each picture", "-", 0.0, 0.5, 1,
    _of_lens,
  ),
}  # fmt: skip


def check(ranges: Any) -> dict[str, tuple[float, float]]:
  """Returns the ranges in the order they are drawn in; ValueError says what is wrong with one."""
  if not isinstance(ranges, Mapping):
    raise ValueError(f"randomise is {ranges!r}, expected ranges by name")
  for name in ranges:
    if name not in QUANTITIES:
      raise ValueError(f"randomise has {name!r}, expected some of {', '.join(QUANTITIES)}")
  return {name: _check(name, ranges[name]) for name in QUANTITIES if name in ranges}


def _check(name: str, found: Any) -> tuple[float, float]:
  quantity = QUANTITIES[name]
  pair = isinstance(found, Sequence) and len(found) == 2 and not isinstance(found, str)
  if pair and all(isinstance(value, int | float) for value in found):
    low, high = float(found[0]), float(found[1])
    if quantity.low <= low <= high <= quantity.high:
      return low, high
  raise ValueError(
    f"randomise: {name} is {found!r}, expected low and high, low <= high, both in "
    f"[{quantity.low:g}, {quantity.high:g}] [{quantity.unit}]"
  )


def apply(
  ranges: Ranges, random: np.random.RandomState, physics: Physics, place: stage.Stage
) -> dict[str, Any]:
  """Draws the numbers of an episode, changes its model, and returns them, JSON.

  Args:
    ranges: of the quantities that are drawn
    random: state to draw from
    physics: at the start of the episode, the model as compiled
    place: its stage
  """
  drawn = {}
  for name, (low, high) in ranges.items():
    quantity = QUANTITIES[name]
    values = random.uniform(low, high, quantity.count)
    quantity.apply(physics, place, values)
    drawn[name] = values.tolist() if quantity.count > 1 else float(values[0])
  return drawn


def through(ranges: Ranges) -> bool:
  """Returns whether pictures are seen through a lens that is not perfect."""
  return any(QUANTITIES[name].apply is _of_lens for name in ranges)


def see(
  pictures: Mapping[str, np.ndarray], drawn: Mapping[str, Any], fovy: float, far: float, seed: int
) -> dict[str, np.ndarray]:
  """Returns pictures as lens and sensor make them, of what the scene sends there.

  Args:
    pictures: some of `Pictures`, of one camera
    drawn: what `apply` returned
    fovy: field of view [rad]
    far: depth where nothing is [m]
    seed: of the noise
  """
  height, width = next(iter(pictures.values())).shape[:2]
  values: dict[str, Any] = {name: value[None] for name, value in lens.lens(drawn).items()}
  values |= {"chosen": np.ones(1, bool), "fovy": np.array([fovy]), "seed": np.array([seed])}
  sizes = {"nrow": 1, "height": height, "width": width}
  spare = tuple(name for name in Pictures.vars if name not in pictures)
  sent, seen = (allocate(Pictures, "cpu", sizes, spare) for _ in range(2))
  for name, value in pictures.items():
    getattr(sent, name).assign(value[None])
  view = fill(lens.Lens, "cpu", values | {"far": far, "sent": sent, "seen": seen})
  wp.launch(lens.see, dim=(1, height, width), inputs=[view, height, width], device="cpu")
  return {name: getattr(seen, name).numpy()[0] for name in pictures}


def table() -> str:
  """Returns the quantities as a Markdown table."""
  lines = ["| name | numbers | unit | allowed | what |", "|---|---|---|---|---|"]
  for name, q in QUANTITIES.items():
    lines.append(f"| `{name}` | {q.count} | {q.unit} | [{q.low:g}, {q.high:g}] | {q.what} |")
  return "\n".join(lines) + "\n"
