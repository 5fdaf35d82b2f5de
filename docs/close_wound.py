"""Draws pictures/close_wound.webp: a gallbladder that is cut open and sewn up again.

python docs/close_wound.py

Stay sutures pull at both sides of the cut. A hand drives a needle through both lips three times,
and pulls its thread, which ends in a bead, until the cut is closed. The lips do not touch each
other: they may overlap where the thread pulls more than the wall does.
"""

import pathlib

import mujoco
import numpy as np
import palpate
import trimesh
from palpate import models
from PIL import Image

ORGAN, STEP = "gallbladder/gallbladder", 1e-3  # [s]
LENGTH, EDGE, THREAD = 0.016, 1.5e-3, 0.1  # of the needle, and of the thread and its edges [m]
RADIUS = LENGTH / np.pi  # of the needle's circle [m]
HALF, BITE, PITCH = 0.009, 0.004, 0.005  # half of the cut; of stitches, from it and between [m]
STITCHES = 3
OPEN, MORE = 0.4, 0.8  # what the stay sutures pull with, and later [N]
PULL, CLOSED = 0.6, 4e-4  # of the thread [N]; gap at which it is closed enough [m]
TURN, MOVE, DRAW, SLOW = 6.0, 0.1, 0.12, 0.01  # of the hand [rad/s, m/s]
AHEAD, ABOVE = 0.3, 0.015  # of the needle's way before it is in the wall [rad, m]
APART = 0.15  # height of the hand at first [m]
SIZE = 640, 640  # of each picture


def scene() -> mujoco.MjModel:
  """Returns the gallbladder that ships, with room for a cut, and a hand with needle and thread."""
  spec = models.load("gallbladder", instruments=())
  (plugin,) = spec.plugins
  plugin.config = plugin.config | {"needles": "needle 400 10"}
  palpate.add_spare(spec, ORGAN, 60)
  spec.worldbody.add_body(name="hand_to", mocap=True, pos=(0, 0, APART))
  hand = spec.worldbody.add_body(name="hand", pos=(0, 0, APART))
  hand.add_freejoint(name="hand")
  hand.add_geom(size=[0.002] * 3, mass=0.1, contype=0, conaffinity=0, rgba=[0] * 4)
  spec.add_equality(
    type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1="hand_to", name2="hand",
    data=[0] * 6 + [1, 0, 0, 0, 1, 0], solref=[0.004, 1], solimp=[0.999, 0.9999, 0.001, 0.5, 2],
  )  # fmt: skip
  nodes = [(0, -RADIUS - EDGE * k, APART) for k in range(round(THREAD / EDGE) + 1)]
  meets = {"contype": 0, "conaffinity": 0}
  palpate.add_thread(spec, nodes, "suture", strength=0, bead=1e-3, contact=meets)
  palpate.add_needle(spec, length=LENGTH, diameter=5e-4, parent="hand", thread="suture")
  spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
  return spec.compile()


class Surgery:
  """A gallbladder with a cut in its wall, the hand that sews it up, and stay sutures.

  Attributes:
    organ: the gallbladder
    thread: the thread
    frame: columns along the cut, across it and out of the wall  (3, 3)
  """

  def __init__(self):
    self.model = scene()
    self.data = data = mujoco.MjData(self.model)
    mujoco.mj_forward(self.model, data)
    self.organ = palpate.Organ(self.model, data, ORGAN)
    self.thread = palpate.Thread(self.model, data, "suture")
    at, top, end = (
      data.site(f"{ORGAN}_{place}").xpos for place in ("body", "fundus", "infundibulum")
    )
    surface = self._surface(self.organ.xpos)
    (self.middle,), _, (near,) = trimesh.proximity.closest_point_naive(surface, at[None])
    out = surface.face_normals[near]
    along = top - end - (top - end) @ out * out
    along /= np.linalg.norm(along)
    self.frame = np.column_stack([along, np.cross(out, along), out])
    line = self.middle + np.linspace(-HALF, HALF, 20)[:, None] * along
    self.organ.cut(trimesh.proximity.closest_point_naive(surface, line)[0])
    self._look()

  def _surface(self, x: np.ndarray) -> trimesh.Trimesh:
    """Returns the surface with vertices at places (nvert, 3) [m]; spare ones have none."""
    return trimesh.Trimesh(np.where(np.isfinite(x), x, 1.0), self.organ.elem, process=False)

  def _look(self):
    """Finds both lips, where stay sutures pull, and the marks of the stitches."""
    rest, elem = self.organ.xpos0, self.organ.elem
    place = (rest - self.middle) @ self.frame
    middle = place[elem].mean(axis=1)
    same = np.linalg.norm(rest[:, None] - rest, axis=2) < 1e-9
    pairs = np.argwhere(np.triu(same, 1))
    side = [[middle[(elem == v).any(axis=1), 1].mean() for v in pair] for pair in pairs]
    self.lips = np.take_along_axis(pairs, np.argsort(side, axis=1), axis=1)  # -y, +y
    near = (np.abs(place[:, 0]) < HALF) & (np.abs(place[:, 2]) < 0.008)
    far = (np.abs(place[:, 1]) > 0.0075) & (np.abs(place[:, 1]) < 0.0115)
    self.stays = [np.flatnonzero(near & far & (s * place[:, 1] > 0)) for s in (-1, 1)]
    rows = PITCH * (np.arange(STITCHES) - (STITCHES - 1) / 2)
    marks = np.array([(row, s * BITE, 0.0) for row in rows for s in (1, -1)]) @ self.frame.T
    surface = self._surface(rest)
    at, _, self.seat = trimesh.proximity.closest_point_naive(surface, self.middle + marks)
    self.share = trimesh.triangles.points_to_barycentric(surface.triangles[self.seat], at)

  @property
  def gaps(self) -> np.ndarray:
    """How far the lips are apart across the cut, at its vertices; below 0 they overlap [m]."""
    low, high = self.organ.xpos[self.lips.T]
    return (high - low) @ self.frame[:, 1]

  def stay(self, force: float):
    """Pulls at both sides of the cut, with a force each [N]."""
    for sign, nodes in zip((-1, 1), self.stays, strict=True):
      for v in nodes:
        pull = sign * force / len(nodes) * self.frame[:, 1]
        self.data.body(f"{ORGAN}_{v}").xfrc_applied[:3] = pull

  def wait(self, steps: int):
    """Takes steps."""
    mujoco.mj_step(self.model, self.data, steps)

  def _ends(self, stitch: int) -> np.ndarray:
    """Returns where the two marks of a stitch are now [m]  (2, 3)."""
    x = self.organ.xpos[self.organ.elem[self.seat]]
    return (self.share[:, None] @ x)[2 * stitch : 2 * stitch + 2, 0]

  def _pose(self, ends: np.ndarray, tip: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the needle's circle through two marks, by the angle of its tip from the bottom."""
    way, out = ends[1] - ends[0], self.frame[:, 2]
    way /= np.linalg.norm(way)
    up = out - out @ way * way
    up /= np.linalg.norm(up)
    height = RADIUS * np.cos(self._half(ends))
    x = -np.sin(tip) * up - np.cos(tip) * way
    axis, quat = np.cross(way, up), np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.column_stack([x, np.cross(axis, x), axis]).ravel())
    return ends.mean(axis=0) + height * up, quat

  def _half(self, ends: np.ndarray) -> float:
    """Returns half of the angle between two marks on the needle's circle [rad]."""
    return float(np.arcsin(min(0.5 * np.linalg.norm(ends[1] - ends[0]) / RADIUS, 0.9)))

  def _move(self, pos: np.ndarray, quat: np.ndarray):
    """Moves the hand to a pose in a line."""
    target = self.model.body("hand_to").mocapid[0]
    start, first = self.data.mocap_pos[target].copy(), self.data.mocap_quat[target].copy()
    quat = quat * (1 if quat @ first > 0 else -1)
    turned = 2 * np.arccos(min(1.0, quat @ first)) / TURN
    steps = max(1, round(max(np.linalg.norm(pos - start) / MOVE, turned) / STEP))
    for k in range(steps):
      share = (k + 1) / steps
      self.data.mocap_pos[target] = start + share * (pos - start)
      self.data.mocap_quat[target] = first + share * (quat - first)  # MuJoCo makes it a unit
      self.wait(1)

  def take_needle(self):
    """Puts the needle over the first stitch, its thread straight behind it."""
    target, ends = self.model.body("hand_to").mocapid[0], self._ends(0)
    pos, quat = self._pose(ends, -self._half(ends) - AHEAD)
    pos = pos + ABOVE * self.frame[:, 2]
    self.data.mocap_pos[target], self.data.mocap_quat[target] = pos, quat
    self.data.joint("hand").qpos[:] = np.concatenate([pos, quat])
    mujoco.mj_forward(self.model, self.data)
    swage = self.data.site("needle_swage").xpos
    self.thread.lay(np.array([swage, swage + self.frame @ (0, 0.25, 0.5)]))

  def drive(self, stitch: int):
    """Drives the needle down through one lip, up through the other one, and out."""
    ends = self._ends(stitch)
    pos, quat = self._pose(ends, -self._half(ends) - AHEAD)
    self._move(pos + ABOVE * self.frame[:, 2], quat)
    self._move(pos, quat)
    ends, target = self._ends(stitch), self.model.body("hand_to").mocapid[0]
    half = self._half(ends)
    for tip in np.arange(-half - AHEAD, half + np.pi + 0.5, TURN * STEP):
      self.data.mocap_pos[target], self.data.mocap_quat[target] = self._pose(ends, tip)
      self.wait(1)

  def pull(self):
    """Draws the thread through, until it pulls or the cut is closed."""
    way, target = self.frame @ (0.5, -0.3, 0.8), self.model.body("hand_to").mocapid[0]
    tight = 0.0
    while tight < PULL and self.gaps.max() > CLOSED:
      tight = self.thread.tension[:8].max()
      self.data.mocap_pos[target] += (DRAW if tight < 0.4 * PULL else SLOW) * STEP * way
      self.wait(1)


def main():
  """Cuts, sews and draws: open, the first stitch, closed, and pulled with twice the force."""
  surgery, pictures = Surgery(), []
  with mujoco.Renderer(surgery.model, SIZE[1], SIZE[0]) as renderer:

    def draw():
      camera, out = mujoco.MjvCamera(), surgery.frame @ (-0.25, 0.0, 1.0)
      camera.lookat, camera.distance = surgery.middle + 0.002 * out, 0.06
      camera.azimuth = np.degrees(np.arctan2(-out[1], -out[0]))
      camera.elevation = np.degrees(np.arcsin(-out[2] / np.linalg.norm(out)))
      renderer.update_scene(surgery.data, camera)
      pictures.append(renderer.render().copy())
      print(f"gap {1e3 * surgery.gaps.max():.2f} mm")

    surgery.stay(OPEN)
    surgery.wait(300)
    surgery.take_needle()
    draw()
    for stitch in range(STITCHES):
      surgery.drive(stitch)
      if stitch == 0:
        draw()
      surgery.pull()
    draw()
    surgery.stay(MORE)
    surgery.wait(300)
    draw()
  rows = [np.concatenate(pictures[k : k + 2], axis=1) for k in (0, 2)]
  image = Image.fromarray(np.concatenate(rows))
  image.save(pathlib.Path(__file__).parent / "pictures" / "close_wound.webp", quality=85)


if __name__ == "__main__":
  main()
