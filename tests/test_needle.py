"""`palpate.add_needle`: a rigid needle along an arc, in plain MJCF."""

import mujoco
import numpy as np
import palpate
import pytest
import trimesh

LENGTH, DIAMETER = 0.026, 7e-4


def load(spec):
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  return model, data


def suture(swage, edge=2e-3):
  """Returns the nodes of a straight thread from a place on, down the y axis [m]."""
  return np.asarray(swage) - np.arange(20)[:, None] * (0, edge, 0)


@pytest.mark.parametrize(("arc", "share"), [("3/8", 0.375), ("1/2", 0.5)])
def test_its_arc_is_a_part_of_a_circle(arc, share):
  """Ends, tangents, mass and size are those of an arc of wire."""
  spec = mujoco.MjSpec()
  palpate.add_needle(spec, "needle", arc=arc, length=LENGTH, diameter=DIAMETER, tip="cutting")
  model, data = load(spec)
  tip, swage = data.site("needle_tip"), data.site("needle_swage")
  circle = LENGTH / (2 * np.pi * share)
  chord = 2 * circle * np.sin(np.pi * share)
  assert np.linalg.norm(tip.xpos - swage.xpos) == pytest.approx(chord)
  along = tip.xmat.reshape(3, 3)[:, 2]
  assert along @ tip.xpos == pytest.approx(0, abs=1e-12)
  assert along[1] * np.cross(swage.xpos, tip.xpos)[2] >= -1e-12
  middle = circle * np.sin(np.pi * share) / (np.pi * share)  # of an arc's mass
  assert model.body("needle").ipos == pytest.approx([middle, 0, 0], abs=0.01 * middle)
  assert model.body("needle").mass[0] == pytest.approx(7800 * np.pi / 4 * DIAMETER**2 * LENGTH)
  assert model.site("needle_tip").size[0] == pytest.approx(DIAMETER / 2)


def test_its_picture_is_a_smooth_surface_around_its_capsules():
  spec = mujoco.MjSpec()
  palpate.add_needle(spec, "needle", length=LENGTH, diameter=DIAMETER)
  model, data = load(spec)
  drawn = [model.geom(g).name for g in range(model.ngeom) if model.geom_group[g] < 3]
  assert drawn == ["needle"] and not model.geom("needle").contype[0]
  turn = data.geom("needle").xmat.reshape(3, 3)
  x = model.mesh_vert @ turn.T + data.geom("needle").xpos
  surface = trimesh.Trimesh(x, model.mesh_face, process=False)
  assert surface.is_watertight and surface.volume > 0
  far = np.hypot(np.hypot(x[:, 0], x[:, 1]) - LENGTH / np.pi, x[:, 2])  # from the wire's middle
  around = np.degrees(np.arctan2(x[:, 1], x[:, 0]))
  wire = (np.abs(around) < 60) & (far > 0)
  assert far[wire] == pytest.approx(DIAMETER / 2, rel=1e-3)
  assert far[around > 89].max() < 0.1 * DIAMETER  # a point


def test_its_thread_hangs_on_the_swage():
  """The first node stays at the swage of a needle that falls and is thrown about."""
  spec = mujoco.MjSpec()
  swage = (0, -LENGTH / np.pi, 0.01)
  palpate.add_thread(spec, suture(swage), "suture")
  palpate.add_needle(spec, "needle", length=LENGTH, pos=(0, 0, 0.01), thread="suture")
  model, data = load(spec)
  data.joint("needle").qvel[:] = 0.1, 0, 0, 0, 0, 10
  off = []
  for _ in range(200):
    mujoco.mj_step(model, data)
    off.append(np.linalg.norm(data.site("needle_swage").xpos - data.body("suture_0").xpos))
  assert max(off) < 1e-3  # the thread was at rest
  assert max(off[100:]) < 2e-4
  assert not data.warning.number.any()


def test_a_needle_that_spins_a_third_of_a_radian_a_step_is_not_spun_up():
  """As one does that slips out of jaws; without an armature it is not finite after 80 steps."""
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = 1e-3, (0, 0, 0)
  palpate.add_needle(spec, "needle")
  model, data = load(spec)
  data.qvel[3:] = 200.0, 150.0, 180.0  # [rad/s]
  fast = np.linalg.norm(data.qvel[3:])
  for _ in range(300):
    mujoco.mj_step(model, data)
    assert np.linalg.norm(data.qvel[3:]) < 1.5 * fast
  assert not data.warning.number.any()


@pytest.mark.parametrize(
  ("given", "message"),
  [
    ({"arc": "1/3"}, "arc is '1/3', expected one of 1/4, 3/8, 1/2, 5/8"),
    ({"tip": "blunt"}, "tip is 'blunt', expected one of taper, cutting"),
    ({"length": -1.0}, "length is -1, expected above 0"),
    ({"diameter": 0.01}, "diameter is 0.01, expected above 0, below 0.0065"),
    ({"name": "suture"}, "expected a name that no body of the spec has"),
    ({"thread": "suture"}, "first node of thread 'suture' is at .* expected at the swage"),
    ({"thread": "silk"}, "thread is 'silk', expected one of the spec's"),
    ({"thread": "long", "pos": (0, LENGTH / np.pi, 0.1)}, "edges of thread 'long' are 30 mm long"),
    ({"parent": "hand"}, "no body 'hand'"),
  ],
)
def test_errors_say_what_is_allowed(given, message):
  spec = mujoco.MjSpec()
  palpate.add_thread(spec, suture((0, 0, 0)), "suture")
  palpate.add_thread(spec, suture((0, 0, 0.1), 0.03), "long")
  with pytest.raises(ValueError, match=message):
    palpate.add_needle(spec, **({"length": LENGTH} | given))
  assert spec.body("needle") is None
