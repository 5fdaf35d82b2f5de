"""What is observed: groups and pictures to choose from.

`sensors` is what a robot has. `state` is privileged: what only a simulation knows of the organ, the
targets and the progress, and everything a domain adds. Pictures are what the laparoscope sees,
drawn when they are chosen. docs/environments.md has every name.
"""

import collections
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco as mj
import numpy as np
from dm_env import specs
from palpate.camera import lens
from palpate.models import trocar

from . import randomisation
from .engine import Camera
from .eyes import OPENGL, see
from .instrument import jawed
from .physics import COARSE, NEAR, Physics
from .scenes import CAMERA

GROUPS = ("sensors", "state")
TRUTH = "truth"  # group of the labels of pictures, only on request
SIZE = (84, 84)  # of pictures, height and width [pixels]
BASE = 0.005  # between the lenses of a stereo laparoscope [m]
LABELS = {"organ": 1, "instrument": 2, "target": 3}  # of `segmentation`, 0 is anything else
_MOST = 4096  # [pixels]


@dataclasses.dataclass(frozen=True)
class Row:
  """An observation that every exercise has.

  Attributes:
    group: it belongs to
    shape: of the array
    unit: of its numbers
    what: it is
    measure: takes task and physics, or the other hand's instrument for a sensor, returns it; None
      where physics and instruments have a method of the row's name that does
    only: what instruments have that have it: `jaws` or a `laparoscope`; empty for all
  """

  group: str
  shape: tuple[int, ...]
  unit: str
  what: str
  measure: Callable[[Any, Physics], np.ndarray] | None = None
  only: str = ""


ROWS = {
  "joints": Row(
    "sensors", (4,), "rad, m",
    "pitch, yaw, roll, insertion; (6,) with `wrist_pitch` and `wrist_yaw` of one with a wrist"),
  "joint_vel": Row("sensors", (4,), "rad/s, m/s", "their velocities"),
  "drive": Row(
    "sensors", (4,), "rad, m", "target of the drives minus position: what the hand feels",
    lambda t, p: p.drive_targets() - p.joints()),
  "tip_pos": Row("sensors", (3,), "m", "the tip, in the world"),
  "tip_quat": Row("sensors", (4,), "-", "its orientation, w x y z"),
  "tip_vel": Row("sensors", (3,), "m/s", "its velocity, in the world"),
  "contact_force": Row("sensors", (3,), "N", "on the instrument below the shaft, in the world"),
  "shaft_force": Row("sensors", (3,), "N", "on the shaft, in the world"),
  "peak_force": Row(
    "sensors", (1,), "N",
    "largest force since the last observation, or a jaw's mean if that is more",
    lambda t, p: np.array([p.peak_force])),
  "gripper": Row(
    "sensors", (4,), "rad, rad, N, N",
    "opening of the jaws, its target, force on the left and right jaw", only="jaws"),
  "camera_head": Row(
    "sensors", (1,), "rad", "how far the camera is turned against the laparoscope",
    lambda t, p: p.head(), "laparoscope"),
  "nodes_near": Row(
    "state", (NEAR, 3), "m",
    f"the {NEAR} nodes of the organ nearest to the tip, from the tip, nearest first"),
  "surface": Row(
    "state", (COARSE, 3), "m", f"displacement from rest of {COARSE} nodes spread over the organ"),
  "progress": Row("state", (1,), "-", "of the task", lambda t, p: np.array([t.progress])),
  "camera_matrix": Row(
    TRUTH, (3, 3), "pixels",
    "of the pictures' pinhole, as OpenCV has it; 0 is the middle of the first pixel",
    lambda t, p: camera_matrix(t, p)),
  "camera_distortion": Row(
    TRUTH, (2,), "-", "k1, k2 of the lens", lambda t, p: lens.lens(t.drawn)["bend"]),
  "camera_pose": Row(
    TRUTH, (4, 4), "-, m", "from the world to the camera's frame, x right, y down, z forward",
    lambda t, p: camera_pose(p)),
  "keypoints": Row(
    TRUTH, (4, 3), "pixels, -",
    "right, down, and 1 where the picture has it and the organ does not hide it: the tip, the tips "
    "of the left and right jaw, the shaft in the trocar; then the same of the other hand's",
    lambda t, p: keypoints(t, p)),
}  # fmt: skip


def camera_matrix(task: Any, physics: Physics) -> np.ndarray:
  """Returns the matrix of a picture's pinhole [pixels]  (3, 3)."""
  height, width = task.observed.size
  focal = 0.5 * height / math.tan(0.5 * math.radians(physics.camera()[2]))
  return np.array([[focal, 0, 0.5 * (width - 1)], [0, focal, 0.5 * (height - 1)], [0, 0, 1.0]])


def camera_pose(physics: Physics) -> np.ndarray:
  """Returns what takes points of the world to the camera's frame  (4, 4)."""
  pos, mat, _ = physics.camera()
  out = np.eye(4)
  out[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ mat.T
  out[:3, 3] = -out[:3, :3] @ pos
  return out


def keypoints(task: Any, physics: Physics) -> np.ndarray:
  """Returns where pictures have the instruments' points, and whether these are seen  (n, 3)."""
  points, pose = np.concatenate([hand.landmarks() for hand in physics.hands]), camera_pose(physics)
  x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
  k1, k2 = lens.lens(task.drawn)["bend"]
  r2 = (x / z) ** 2 + (y / z) ** 2
  bent = (1 + r2 * (k1 + r2 * k2)) / z
  size, at = task.observed.size, np.stack([x * bent, y * bent, np.ones_like(z)])
  right, down, _ = camera_matrix(task, physics) @ at
  inside = (z > 0) & (np.abs(right - (size[1] - 1) / 2) <= size[1] / 2)
  inside &= np.abs(down - (size[0] - 1) / 2) <= size[0] / 2
  return np.stack([right, down, inside & ~physics.hidden(points)], axis=1)


def _pixels(camera: Camera, physics: Physics) -> np.ndarray:
  return camera.render().copy()  # the next picture is drawn into the same array


def _depth(camera: Camera, physics: Physics) -> np.ndarray:
  # The sky is written into the depth too, and colours alone are smoothed when labels are drawn.
  flags: Any = camera.scene.flags
  flags[mj.mjtRndFlag.mjRND_SKYBOX], flags[mj.mjtRndFlag.mjRND_SEGMENT] = 0, 1
  depth = camera.render(depth=True).copy()
  flags[mj.mjtRndFlag.mjRND_SKYBOX], flags[mj.mjtRndFlag.mjRND_SEGMENT] = 1, 0
  return depth


def _points(camera: Camera, physics: Physics) -> np.ndarray:
  depth = _depth(camera, physics)
  height, width = depth.shape
  model = physics.model.ptr
  fovy = float(model.cam_fovy[model.camera(CAMERA).id])
  pixel = 2 * np.tan(np.radians(fovy) / 2) / height  # at a distance of 1
  x = (np.arange(width) + 0.5 - width / 2) * pixel
  y = (np.arange(height) + 0.5 - height / 2) * pixel
  points = np.stack([depth * x, depth * y[:, None], depth], axis=2).astype(np.float32)
  points[depth > 0.999 * far(physics)] = 0
  return points


def labels(physics: Physics) -> dict[tuple[int, int], int]:
  """Returns the labels of what has one in `segmentation`, by its `mjtObj` and number."""
  model, kinds = physics.model.ptr, mj.mjtObj
  flex, skin, site, geom = (
    int(kind) for kind in (kinds.mjOBJ_FLEX, kinds.mjOBJ_SKIN, kinds.mjOBJ_SITE, kinds.mjOBJ_GEOM)
  )
  organ = [(flex, mj.mj_name2id(model, flex, physics.organ_name + s)) for s in ("", "_inside")]
  organ += [] if physics.organ.skin is None else [(skin, physics.organ.skin)]
  hands = tuple(hand.prefix for hand in physics.hands)
  bodies = np.array([model.body(i).name.startswith(hands) for i in range(model.nbody)])
  own = np.flatnonzero(bodies[model.geom_bodyid]).tolist()
  return (
    dict.fromkeys(organ, LABELS["organ"])
    | dict.fromkeys(((site, k) for k in physics.target_sites), LABELS["target"])
    | dict.fromkeys(((geom, k) for k in own), LABELS["instrument"])
  )


def _segmentation(camera: Camera, physics: Physics) -> np.ndarray:
  found = camera.render(segmentation=True)
  out = np.zeros(found.shape[:2], np.uint8)
  for (what, number), label in labels(physics).items():
    out[(found[..., 1] == what) & (found[..., 0] == number)] = label
  return out


def _flow(camera: Camera, physics: Physics) -> np.ndarray:
  raise NotImplementedError("MuJoCo's renderer has no flow")


def _soiling(camera: Camera, physics: Physics) -> np.ndarray:
  return np.zeros((*camera.render().shape[:2], 2), np.uint8)  # what a lens adds comes later


@dataclasses.dataclass(frozen=True)
class Picture:
  """What the laparoscope sees.

  Attributes:
    unit: of its numbers
    what: it is
    dtype: of its numbers
    shape: what follows height and width
    low: least value
    high: greatest value
    draw: takes camera and physics, returns it
    of: what a camera of a batch calls it, see `palpate.camera`
    eye: how far the lens is to the right of the laparoscope's [m]
  """

  unit: str
  what: str
  dtype: type
  shape: tuple[int, ...]
  low: float
  high: float
  draw: Callable[[Camera, Physics], np.ndarray]
  of: str
  eye: float = 0.0


def _stereo(side: str, eye: float) -> Picture:
  what = f"what a lens {1000 * BASE / 2:g} mm to the {side} sees: red, green, blue"
  return Picture("-", what, np.uint8, (3,), 0, 255, _pixels, "pixels", eye)


PICTURES = {
  "pixels": Picture("-", "red, green, blue", np.uint8, (3,), 0, 255, _pixels, "pixels"),
  "pixels_left": _stereo("left", -BASE / 2),
  "pixels_right": _stereo("right", BASE / 2),
  "depth": Picture(
    "m", "distance from the camera's plane, the far plane's where nothing is",
    np.float32, (), 0, np.inf, _depth, "depth"),
  "segmentation": Picture(
    "-", ", ".join(f"{value} {name}" for name, value in LABELS.items()) + ", 0 anything else",
    np.uint8, (), 0, max(LABELS.values()), _segmentation, "labels"),
  "points": Picture(
    "m", "place in the camera's frame, x right, y down, z forward; 0 0 0 where nothing is",
    np.float32, (3,), -np.inf, np.inf, _points, "points"),
  "flow": Picture(
    "pixels",
    "way of what a pixel shows since the last observation, right and down; not with `opengl`",
    np.float32, (2,), -np.inf, np.inf, _flow, "flow"),
  "soiling": Picture(
    "-", "share of smoke, and of blood on the lens, before a pixel, of 255; see `randomise`",
    np.uint8, (2,), 0, 255, _soiling, "soiling"),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Choice:
  """What is observed.

  Attributes:
    names: groups, pictures and single observations
    size: of pictures, height and width [pixels]
  """

  names: tuple[str, ...]
  size: tuple[int, int]

  def has(self, name: str, group: str) -> bool:
    """Returns whether an observation of a group was chosen."""
    return name in self.names or group in self.names

  @property
  def pictures(self) -> list[str]:
    """Names of the pictures that were chosen."""
    return [name for name in PICTURES if name in self.names]


def choose(names: Sequence[str] | None, size: Any) -> Choice:
  """Returns what is observed; single names are known to `check` only.

  Args:
    names: groups, pictures and single observations; None for the groups
    size: height and width of pictures; `pixels` is observed if it is given and no picture named
  """
  if isinstance(names, str) or not all(isinstance(name, str) for name in names or ()):
    raise ValueError(f"observations is {names!r}, expected a list of names")
  chosen = GROUPS if names is None else tuple(names)
  if size is not None and not set(chosen) & set(PICTURES):
    chosen = (*chosen, "pixels")
  if not chosen:
    raise ValueError(f"observations is empty, expected some of {_known()}")
  size = SIZE if size is None else size
  whole = isinstance(size, Sequence) and len(size) == 2 and all(isinstance(n, int) for n in size)
  if not whole or not all(1 <= n <= _MOST for n in size):
    raise ValueError(
      f"pixels is {size!r}, expected height and width, both whole numbers in [1, {_MOST}]"
    )
  return Choice(chosen, (size[0], size[1]))


def _known() -> str:
  return ", ".join((*GROUPS, *PICTURES, TRUTH)) + " or single observations"


def check(task: Any, physics: Physics) -> None:
  """Raises ValueError for a name that is no group, picture or observation of a task."""
  single = [*(name for name, *_ in _rows(task.prefix, task.second)), *task.observe(physics)]
  for name in task.observed.names:
    if name not in (*GROUPS, TRUTH, *PICTURES, *single):
      raise ValueError(
        f"{task.name}: observations has {name!r}, expected some of {_known()}: {', '.join(single)}"
      )
  model, (height, width) = physics.model.ptr, task.observed.size
  most = model.vis.global_.offheight, model.vis.global_.offwidth
  if task.renderer != OPENGL:
    return
  if "flow" in task.observed.names:
    raise ValueError(f"{task.name}: observations has 'flow', which renderer opengl cannot draw")
  if task.observed.pictures and (height > most[0] or width > most[1]):
    raise ValueError(
      f"pixels is {height}, {width}, expected at most {most[0]}, {most[1]}: the model's offscreen "
      "buffer"
    )


def take(task: Any, physics: Physics) -> collections.OrderedDict:
  """Returns what a task observes."""
  out = _numbers(task, physics)
  pictures = {name: PICTURES[name] for name in task.observed.pictures}
  if not pictures:
    return out
  draw = _render if task.renderer == OPENGL else _draw
  sent = draw(task, physics, list(pictures.values()))
  if randomisation.through(task.ranges):
    fovy, seed = math.radians(physics.camera()[2]), round(1e4 * physics.time())
    for eye in {picture.eye for picture in pictures.values()}:
      own = {of: value for (of, of_eye), value in sent.items() if of_eye == eye}
      own = randomisation.see(own, task.drawn, fovy, far(physics), seed + round(1e6 * eye))
      sent |= {(of, eye): value for of, value in own.items()}
  out |= {name: sent[picture.of, picture.eye] for name, picture in pictures.items()}
  return out


def _render(task: Any, physics: Physics, pictures: list[Picture]) -> dict[Any, np.ndarray]:
  """Returns what MuJoCo's renderer draws, by what it is of and the shift of the lens."""
  model, place = physics.model.ptr, physics.data.ptr.cam_xpos
  number = model.camera(CAMERA).id
  height, width = task.observed.size
  camera = Camera(physics, height, width, number)
  (middle, mat, _), sent = physics.camera(), {}
  for picture in pictures:
    place[number] = middle + picture.eye * mat[:, 0]
    sent[picture.of, picture.eye] = picture.draw(camera, physics)
  place[number] = middle
  camera.scene.free()
  return sent


def _draw(task: Any, physics: Physics, pictures: list[Picture]) -> dict[Any, np.ndarray]:
  """Returns what a device draws, see `_render`."""
  shift = sorted({picture.eye for picture in pictures})
  of = list(dict.fromkeys(picture.of for picture in pictures))
  begins, size = physics.time() == 0, task.observed.size
  seen = see(physics, labels(physics), task.renderer, size, of, shift, begins)
  return {(name, eye): seen[name][k] for name in of for k, eye in enumerate(shift)}


def _numbers(task: Any, physics: Physics) -> collections.OrderedDict:
  rows, own = _plan(task.observed, task.prefix, task.second)
  hands = physics.hands
  out = collections.OrderedDict((name, measure(task, hands[k])) for name, measure, k in rows)
  if own:
    observed: Mapping[str, np.ndarray] = task.observe(physics)
    out |= {name: value for name, value in observed.items() if own == "all" or name in own}
  return out


def _rows(first: str, second: str) -> list[tuple[str, str, int]]:
  """Returns names, their rows' names, and hands, by prefixes; the second hand has sensors alone."""
  out = [(name, name, 0) for name, row in ROWS.items() if _has(first, row.only)]
  for name, row in ROWS.items() if second else ():
    if row.group == "sensors" and _has(second, row.only):
      out.append((f"{second.rstrip('/')}_{name}", name, 1))
  return out


def _has(prefix: str, only: str) -> bool:
  """Returns whether an instrument with a prefix has what a row is of."""
  return not only or only == trocar.kind(prefix) or (only == "jaws" and jawed(prefix))


def _asking(name: str) -> Callable[[Any, Physics], np.ndarray]:
  """Returns what asks physics, or the other hand's instrument, by its method of a name."""
  return lambda task, physics: getattr(physics, name)()


@functools.lru_cache
def _plan(choice: Choice, first: str, second: str) -> tuple[list, Any]:
  """Returns names, measures, hands of the chosen rows, and the domain's own names or "all"."""
  known = _rows(first, second)
  rows = [
    (name, ROWS[of].measure or _asking(of), k)
    for name, of, k in known
    if choice.has(name, ROWS[of].group)
  ]
  own = set(choice.names) - {name for name, *_ in known} - set(PICTURES) - {"sensors", TRUTH}
  return rows, "all" if "state" in own else own


def spec(task: Any, physics: Physics) -> collections.OrderedDict:
  """Returns the specs of what a task observes; no picture is drawn for it."""
  out = collections.OrderedDict()
  for name, value in _numbers(task, physics).items():
    out[name] = specs.Array(value.shape, value.dtype, name=name)
  for name in task.observed.pictures:
    p = PICTURES[name]
    shape = (*task.observed.size, *p.shape)
    out[name] = specs.BoundedArray(shape, p.dtype, p.low, p.high, name=name)
  return out


def far(physics: Physics) -> float:
  """Returns how far the camera sees [m]."""
  model = physics.model.ptr
  return float(model.vis.map.zfar * model.stat.extent)


def table() -> str:
  """Returns what every exercise has as a Markdown table."""
  lines = ["| name | group | shape | type | unit | what |", "|---|---|---|---|---|---|"]
  for name, row in ROWS.items():
    what = f"{row.what}; {row.only} only" if row.only else row.what
    cells = f"`{row.group}` | {_text(*row.shape)} | float64 | {row.unit} | {what}"
    lines.append(f"| `{name}` | {cells} |")
  for name, p in PICTURES.items():
    shape = _text("height", "width", *p.shape)
    lines.append(f"| `{name}` | picture | {shape} | {p.dtype.__name__} | {p.unit} | {p.what} |")
  return "\n".join(lines) + "\n"


def _text(*shape: int | str) -> str:
  return f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
