"""Draws pictures/close_wound.webp: a gallbladder that is cut open and sewn up again.

python docs/close_wound.py

Stay sutures pull at both sides of the cut. A hand drives a needle through both lips three times and
pulls its thread, which ends in a bead, until the cut is closed. A clip on the thread, over the last
hole, ends the suture, and the hand lets go.
"""

import pathlib

import mujoco
import numpy as np
import palpate
import trimesh
from palpate import models
from PIL import Image

ORGAN = "gallbladder/gallbladder"
LENGTH, DIAMETER = 0.016, 3.5e-4  # of the needle [m]
RADIUS = LENGTH / np.pi  # of its circle [m]
THREAD, EDGE = 0.1, 1e-3  # lengths of the thread, and of its edges [m]
HALF, BITE, PITCH = 0.009, 0.004, 0.005  # half of the cut; of stitches, from it and between [m]
STITCHES = 3
OPEN, MORE = 0.4, 0.8  # what the stay sutures pull with, and later [N]
PULL, CLOSED = 0.6, 4e-4  # of the thread [N]; gap at which it is closed enough [m]
TURN, MOVE, DRAW, SLOW = 6e-3, 1e-4, 1.2e-4, 1e-5  # of the hand in a step [rad, m]
AHEAD, ABOVE = 0.3, 0.015  # of the needle's way before it is in the wall [rad, m]
CLIP = 1.2e-3  # radius of the bead and of the clip [m]
SIZE = 640, 640  # of each picture


def scene() -> mujoco.MjModel:
  """Returns the gallbladder that ships, with room for a cut, and a hand with needle and thread."""
  spec = models.load("gallbladder", instruments=())
  (plugin,) = spec.plugins
  plugin.config = plugin.config | {"needles": "needle 400 10"}
  palpate.add_spare(spec, ORGAN, 60)
  apart = np.array([0, 0, 0.15])  # until the cut is made
  spec.worldbody.add_body(name="hand", mocap=True, pos=apart)
  nodes = apart - [(0, RADIUS + EDGE * k, 0) for k in range(round(THREAD / EDGE) + 1)]
  nothing = {"contype": 0, "conaffinity": 0}
  palpate.add_thread(spec, nodes, "suture", strength=0, bead=CLIP, contact=nothing)
  palpate.add_needle(spec, length=LENGTH, diameter=DIAMETER, pos=apart, thread="suture")
  clip = spec.worldbody.add_body(name="clip", pos=-apart)
  clip.add_freejoint(name="clip").damping = [0.3, 0, 0]  # [N s/m]
  clip.add_geom(size=[CLIP, 0, 0], mass=1e-3, rgba=spec.flex("suture").rgba)
  eq = mujoco.mjtEq
  for kind, one, other in ((eq.mjEQ_WELD, "hand", "needle"), (eq.mjEQ_CONNECT, "clip", "suture_0")):
    spec.add_equality(
      name=one, type=kind, objtype=mujoco.mjtObj.mjOBJ_BODY, name1=one, name2=other,
      active=one == "hand", solref=[0.004, 1], solimp=[0.999, 0.9999, 1e-3, 0.5, 2],
      data=[0] * 6 + [1, 0, 0, 0, 1, 0],
    )  # fmt: skip
  spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
  return spec.compile()


def on(organ: palpate.Organ, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns the places [m] on a surface at rest nearest to points, their triangles and shares."""
  used = np.isfinite(organ.xpos0).all(axis=1)
  surface = trimesh.Trimesh(np.where(used[:, None], organ.xpos0, 1.0), organ.elem, process=False)
  at, _, seat = trimesh.proximity.closest_point_naive(surface, points)
  return at, seat, trimesh.triangles.points_to_barycentric(surface.triangles[seat], at)


class Surgery:
  """A gallbladder with a cut in its wall, the hand that sews it up, and stay sutures.

  Attributes:
    organ: the gallbladder
    thread: the thread
    frame: columns along the cut, across it and out of the wall  (3, 3)
  """

  def __init__(self):
    self.model = model = scene()
    self.data = data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    self.organ = organ = palpate.Organ(model, data, ORGAN)
    self.thread = palpate.Thread(model, data, "suture")
    body, top, end = (
      data.site(f"{ORGAN}_{place}").xpos for place in ("body", "fundus", "infundibulum")
    )
    (self.middle,), (near,), _ = on(organ, body[None])
    a, b, c = organ.xpos0[organ.elem[near]]
    out = _unit(np.cross(b - a, c - a))
    along = _unit(top - end - (top - end) @ out * out)
    self.frame = np.column_stack([along, np.cross(out, along), out])
    organ.cut(on(organ, self.middle + np.linspace(-HALF, HALF, 20)[:, None] * along)[0])
    # Both lips, where stay sutures pull, and the marks of the stitches.
    place = (organ.xpos0 - self.middle) @ self.frame
    pairs = np.argwhere(np.triu(np.linalg.norm(place[:, None] - place, axis=2) < 1e-9, 1))
    side = [[place[organ.elem[(organ.elem == v).any(axis=1)], 1].mean() for v in p] for p in pairs]
    self.lips = np.take_along_axis(pairs, np.argsort(side, axis=1), axis=1)  # -y, +y
    near = (np.abs(place[:, [0, 2]]) < (HALF, 0.008)).all(axis=1)
    near &= np.abs(np.abs(place[:, 1]) - 0.0095) < 0.002
    self.stays = [np.flatnonzero(near & (sign * place[:, 1] > 0)) for sign in (-1, 1)]
    rows = PITCH * (np.arange(STITCHES) - (STITCHES - 1) / 2)
    marks = np.array([(row, sign * BITE, 0.0) for row in rows for sign in (1, -1)])
    _, self.seat, self.share = on(organ, self.middle + marks @ self.frame.T)

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

  def _circle(self, stitch: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns a needle's circle through the marks of a stitch now.

    Its middle [m], its axes (across, up and its own as columns), and half of the angle between the
    marks [rad].
    """
    x = (self.share[:, None] @ self.organ.xpos[self.organ.elem[self.seat]])[2 * stitch :, 0]
    half = np.arcsin(min(0.5 * np.linalg.norm(x[1] - x[0]) / RADIUS, 0.9))
    way, out = _unit(x[1] - x[0]), self.frame[:, 2]
    up = _unit(out - out @ way * way)
    axes = np.column_stack([way, up, np.cross(way, up)])
    return 0.5 * (x[0] + x[1]) + RADIUS * np.cos(half) * up, axes, half

  def _pose(self, circle, tip: float, high: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Returns place and turn of a needle on a circle, by the angle of its tip from the bottom."""
    middle, axes, _ = circle
    c, s, quat = np.cos(tip), np.sin(tip), np.zeros(4)
    mujoco.mju_mat2Quat(quat, (axes @ [[-c, s, 0], [-s, -c, 0], [0, 0, 1]]).ravel())
    return middle + high * self.frame[:, 2], quat

  def _hold(self, pos: np.ndarray, quat: np.ndarray):
    """Puts the hand somewhere."""
    self.data.mocap_pos[0], self.data.mocap_quat[0] = pos, quat  # MuJoCo makes it a unit

  def _move(self, pos: np.ndarray, quat: np.ndarray):
    """Moves the hand somewhere in a line."""
    start, first = self.data.mocap_pos[0].copy(), self.data.mocap_quat[0].copy()
    quat = quat * (1 if quat @ first > 0 else -1)
    turned = 2 * np.arccos(min(1.0, quat @ first))
    for share in np.linspace(0, 1, 1 + int(max(np.linalg.norm(pos - start) / MOVE, turned / TURN))):
      self._hold(start + share * (pos - start), first + share * (quat - first))
      self.wait(1)

  def take_needle(self):
    """Puts the needle over the first stitch, its thread straight behind it."""
    circle = self._circle(0)
    pos, quat = self._pose(circle, -circle[2] - AHEAD, ABOVE)
    self._hold(pos, quat)
    self.data.joint("needle").qpos[:] = np.concatenate([pos, quat])
    mujoco.mj_forward(self.model, self.data)
    swage = self.data.site("needle_swage").xpos
    self.thread.lay(np.array([swage, swage + self.frame @ (0, 0.25, 0.5)]))

  def drive(self, stitch: int):
    """Drives the needle down through one lip, up through the other one, and out."""
    for high in (ABOVE, 0.0):
      circle = self._circle(stitch)
      self._move(*self._pose(circle, -circle[2] - AHEAD, high))
    circle = self._circle(stitch)
    for tip in np.arange(-circle[2] - AHEAD, circle[2] + np.pi + 0.5, TURN):
      self._hold(*self._pose(circle, tip))
      self.wait(1)

  def pull(self):
    """Draws the thread through, until it pulls or the cut is closed."""
    tight = 0.0
    while tight < PULL and self.gaps.max() > CLOSED:
      tight = self.thread.tension[:8].max()
      step = DRAW if tight < 0.4 * PULL else SLOW
      self.data.mocap_pos[0] += step * self.frame @ (0.5, -0.3, 0.8)
      self.wait(1)

  def clip(self):
    """Puts a clip on the thread where it leaves the wall, and cuts the needle off."""
    data, clip, swage = self.data, self.model.equality("clip"), self.model.equality("needle_suture")
    node = int((-self.organ.pinholes[-1].along - 2 * CLIP) / EDGE)
    data.joint("clip").qpos[:3] = self.thread.positions[node]
    clip.obj2id, clip.data[:6] = self.model.body(f"suture_{node}").id, 0
    data.eq_active[[clip.id, swage.id]] = 1, 0


def _unit(vector: np.ndarray) -> np.ndarray:
  """Returns a vector of length 1."""
  return vector / np.linalg.norm(vector)


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
    surgery.clip()
    surgery.wait(500)
    draw()
    surgery.stay(MORE)
    surgery.wait(300)
    draw()
  rows = [np.concatenate(pictures[k : k + 2], axis=1) for k in (0, 2)]
  image = Image.fromarray(np.concatenate(rows))
  image.save(pathlib.Path(__file__).parent / "pictures" / "close_wound.webp", quality=85)


if __name__ == "__main__":
  main()
