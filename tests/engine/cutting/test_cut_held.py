"""Cutting what is bonded, tied, carried or grasped: what holds it follows."""

import copy

import mujoco
import numpy as np
import palpate
import pytest
import scenes
from devices import needs_cuda
from scipy import ndimage

FULL = mujoco.mjtState.mjSTATE_INTEGRATION
HAND = '<body name="hand" mocap="true"/>'
KEYS = {"young": 2e4, "thickness": 0.002, "mass": 0.02, "spare": 60}
LINE = np.linspace([0.02, -0.012, 0], [0.06, 0.011, 0], 50)


@pytest.fixture(params=["nodal", "window"])
def make(request):
  """Returns a function that returns model, data and organ: a strip in the plane z = 0."""

  def make(bodies=HAND, **keys):
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    spec.option.gravity = [0, 0, 0]
    strip = scenes.triangular(0.08, 0.04, 16, 9, 0.2)
    windows = request.param == "window"
    palpate.add_organ(spec, strip, "organ", windows=windows, **KEYS | {"device": "cpu"} | keys)
    if windows:
      spec.worldbody.add_geom(name="ball", size=[0.001, 0, 0], pos=[0, 0, 0.5])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data, palpate.Organ(model, data, "organ")

  return make


def lift(model, data, speed, steps):
  for _ in range(steps):
    data.mocap_pos[0, 2] += speed * model.opt.timestep
    mujoco.mj_step(model, data)


def test_bonds_of_an_organ_at_rest_are_divided_by_a_cut(make):
  model, data, organ = make(bonds="none")
  organ.bond("world", 1e6, 1e3, 1.0, vertices=np.arange(organ.nvert))
  area, count = organ.bonds.area.sum(), organ.bonds.count
  mujoco.mj_step(model, data, 2)
  organ.cut(LINE)
  assert organ.bonds.count == organ.nvert > count + 5
  assert organ.bonds.area.sum() == pytest.approx(area, rel=1e-12)
  assert set(organ.bonds.vertices) == set(range(organ.nvert))
  mujoco.mj_step(model, data, 10)
  assert organ.error is None and np.abs(organ.displacement).max() < 1e-9
  assert organ.bonds.stored < 1e-18 and not organ.bonds.damage.any()


def test_a_cut_keeps_the_damage_and_what_it_took(make):
  model, data, organ = make(bonds="none")
  organ.bond("world", 1e6, 300.0, 0.5, vertices=np.arange(organ.nvert))
  corner = np.flatnonzero(np.linalg.norm(organ.xpos0 - [0.05, 0.0, 0], axis=1) < 0.012)
  organ.attach(corner, "hand")
  lift(model, data, 0.02, 100)
  mujoco.mj_forward(model, data)
  before, pull = organ.bonds, organ.bonds.force.sum(axis=0)
  freed, energy, stored = before.share_freed, before.energy, before.stored + organ.energy
  assert 0.01 < before.damage.max() and energy > 0
  organ.cut(LINE)
  mujoco.mj_forward(model, data)
  after = organ.bonds
  assert after.energy == pytest.approx(energy, rel=1e-9)
  assert after.share_freed == pytest.approx(freed, abs=0.02)
  assert after.stored + organ.energy < 1.02 * stored
  np.testing.assert_allclose(after.force.sum(axis=0), pull, atol=0.03 * np.abs(pull).max())
  # And goes on the same from a state and in a copy, also after a reset.
  saved, twin = scenes.state(model, data), copy.copy(data)
  lift(model, data, 0.02, 40)
  goal, released = organ.xpos, organ.bonds.energy
  assert released > energy and organ.error is None
  lift(model, twin, 0.02, 40)
  assert np.array_equal(palpate.Organ(model, twin, "organ").xpos, goal)
  mujoco.mj_setState(model, data, saved, FULL)
  lift(model, data, 0.02, 40)
  assert np.array_equal(organ.xpos, goal) and organ.bonds.energy == released
  mujoco.mj_resetData(model, data)
  assert organ.bonds.count == 0
  mujoco.mj_step(model, data)
  assert organ.error is None


def test_ties_are_divided_by_a_cut_and_hold_both_sides(make):
  bodies = '<body name="hand" mocap="true" pos="0.01 0.02 0.03" quat="0.8 0.2 0.4 0.4"/>'
  near = np.flatnonzero(np.abs(scenes.triangular(0.08, 0.04, 16, 9, 0.2)[0][:, 0] - 0.04) < 0.02)
  model, data, organ = make(bodies, attach="hand 200 " + " ".join(map(str, near)))
  mujoco.mj_step(model, data, 2)
  organ.cut(LINE)
  mujoco.mj_step(model, data, 10)
  assert organ.error is None and np.abs(organ.displacement).max() < 1e-9
  data.mocap_pos[0] += [0, 0, 0.01]
  mujoco.mj_step(model, data, 400)
  cut = np.arange(len(scenes.triangular(0.08, 0.04, 16, 9)[0]), organ.nvert)
  assert len(cut) > 5 and organ.displacement[cut, 2].min() > 0.008
  saved = scenes.state(model, data)
  mujoco.mj_step(model, data, 5)
  goal = organ.xpos
  mujoco.mj_resetData(model, data)
  mujoco.mj_step(model, data, 5)
  assert np.abs(organ.displacement).max() < 1e-9  # healed
  mujoco.mj_setState(model, data, saved, FULL)
  mujoco.mj_step(model, data, 5)
  assert np.array_equal(organ.xpos, goal)


def test_a_carrier_lets_go_of_what_is_cut_free(make):
  model, data, organ = make(carrier="hand", foundation=4e4)
  t = np.linspace(0, 2 * np.pi, 60)
  disc = np.stack([0.04 + 0.01 * np.cos(t), 0.01 * np.sin(t), 0 * t], axis=1)
  organ.cut(disc)
  mujoco.mj_step(model, data, 5)
  assert np.abs(organ.displacement).max() < 1e-9
  large, small = organ.pieces
  assert large.held and not small.held
  lift(model, data, 0.01, 100)
  assert organ.displacement[large.vertices, 2].min() > 0.001
  assert np.abs(organ.displacement[small.vertices]).max() < 1e-9 and organ.error is None


def test_two_organs_that_are_tied_and_bonded_stay_at_rest_when_either_is_cut():
  spec = mujoco.MjSpec()
  spec.option.gravity = [0, 0, 0]
  points, elem = scenes.triangular(0.08, 0.04, 16, 9, 0.2)
  keys = KEYS | {"device": "cpu"}
  palpate.add_organ(spec, (points, elem), "bed", windows=False, **keys)
  bonds = "bed 1e6 1000 1 near 0.004"
  palpate.add_organ(
    spec, (points + np.array([0.001, 0.001, 0.003]), elem), "top", windows=False, bonds=bonds,
    attach="bed 50 20 21 22 60 61", **keys
  )  # fmt: skip
  model = spec.compile()
  data = mujoco.MjData(model)
  top, bed = (palpate.Organ(model, data, name) for name in ("top", "bed"))
  mujoco.mj_step(model, data, 2)
  area = top.bonds.area.sum()
  for organ, height in ((top, 0.003), (bed, 0.0)):
    organ.cut(LINE + np.array([0, 0, height]))
    mujoco.mj_step(model, data, 20)
    assert organ.error is None and organ.cuts
    for each in (top, bed):
      assert np.abs(each.displacement).max() < 1e-4
  assert top.bonds.area.sum() == pytest.approx(area) and not top.bonds.damage.any()


def test_stress_relaxes_on_both_sides_of_a_cut(make):
  model, data, organ = make(relax_share=0.5, relax_time=0.05)
  x = organ.xpos
  organ.set_state(x + 0.003 * np.sin(60 * x[:, [1, 0, 0]]))
  mujoco.mj_step(model, data, 5)
  momentum = (organ.mass[:, None] * organ.xvel).sum(axis=0)
  energy = organ.energy + 0.5 * (organ.mass[:, None] * organ.xvel**2).sum()
  organ.cut(LINE + organ.displacement.mean(axis=0))
  mujoco.mj_step(model, data, 50)
  after = (organ.mass[:, None] * organ.xvel).sum(axis=0)
  np.testing.assert_allclose(after, momentum, atol=1e-6)
  assert organ.energy + 0.5 * (organ.mass[:, None] * organ.xvel**2).sum() < energy
  assert organ.error is None and organ.nvert > len(x) + 5


@pytest.mark.parametrize("below", ["floor", "lower"])
def test_what_is_cut_off_rests_on_what_the_organ_rested_on(below):
  spec = mujoco.MjSpec()
  spec.option.timestep = 5e-3
  away = {"contype": 0, "conaffinity": 0}
  spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], **away)
  spec.worldbody.add_body(name="tool").add_geom(size=[0.001, 0, 0], pos=[0, 0, 0.5])
  points, elem = scenes.triangular(0.08, 0.04, 12, 7, 0.2)
  keys = KEYS | {"device": "cpu", "windows": {"tools": ["tool"]}, "damping": 0.05, "mass": 1.0}
  if below == "lower":
    palpate.add_organ(spec, (points, elem), "lower", support="floor", **keys | {"thickness": 0.01})
  high = 0.002 * (below == "lower")
  palpate.add_organ(spec, (points + np.array([0, 0, high]), elem), "organ", support=below, **keys)
  model, data, organ = scenes.load(spec)
  mujoco.mj_step(model, data, 100)
  x = organ.xpos
  organ.cut([[0.04, -0.02, x[:, 2].mean()], [0.042, 0.02, x[:, 2].mean()]])
  if below == "lower":
    palpate.Organ(model, data, "lower").cut([[0.02, -0.015, 0], [0.06, 0.015, 0]])
  assert len(organ.pieces) == 2
  mujoco.mj_step(model, data, 60)
  assert organ.error is None and organ.support_force[2] > 0
  assert np.abs(organ.xpos[:, 2] - x[:, 2].mean()).max() < 1.5e-3


@pytest.mark.parametrize("where", ["cpu", pytest.param("cuda:0", marks=needs_cuda)])
def test_a_motion_that_stays_on_the_device_is_cut_there(where):
  spec = mujoco.MjSpec()
  spec.option.gravity = [0, 0, 0]
  spec.worldbody.add_body(name="tool", mocap=True, pos=[0.045, 0.006, 0.05]).add_geom(
    size=[0.008, 0, 0]
  )
  strip = scenes.triangular(0.08, 0.04, 16, 9, 0.2)
  keys = KEYS | {"windows": {"tools": [["tool"]], "nodes": 60}, "foundation": 4e4}
  organs = []
  for resident in (False, True):
    each = spec.copy()
    palpate.add_organ(each, strip, "organ", resident=resident, device=where, **keys)
    model, data, organ = scenes.load(each)
    for k in range(100):
      data.mocap_pos[0, 2] = 0.012 - 6e-5 * k
      mujoco.mj_step(model, data)
      if k == 60:
        organ.cut(LINE)
    organs.append((organ.xpos, organ.xvel, organ.force, organ.error))
  (x, v, force, error), (other, speed, felt, trouble) = organs
  assert error is None and trouble is None and len(x) > 160 and force[2] < -0.01
  np.testing.assert_allclose(other, x, atol=1e-8)
  np.testing.assert_allclose(speed, v, atol=1e-5)
  np.testing.assert_allclose(felt, force, atol=1e-4 * np.abs(force).max())


JAWS = """<mujoco><option timestep="0.002"/><worldbody><body name="hand" pos="0.068 0 0">
  <joint name="lift" type="slide" axis="0 0 1"/><inertial pos="0 0 0" mass=".1" diaginertia="1 1 1"
  />
  <body name="upper" pos="0 0 0.009"><joint name="upper" type="slide" axis="0 0 1"/>
    <geom type="box" size="0.006 0.006 0.002" mass="0.02"/></body>
  <body name="lower" pos="0 0 -0.009"><joint name="lower" type="slide" axis="0 0 -1"/>
    <geom type="box" size="0.006 0.006 0.002" mass="0.02"/></body>
  </body></worldbody><actuator><position joint="lift" kp="400" kv="20"/>
  <position joint="upper" kp="200" kv="5"/><position joint="lower" kp="200" kv="5"/>
</actuator></mujoco>"""


def parts_in_a_picture(model, data):
  """Returns how many parts of tissue a viewer sees; skips without OpenGL."""
  camera = mujoco.MjvCamera()
  camera.lookat, camera.distance, camera.azimuth, camera.elevation = [0.04, 0, 0.02], 0.16, 120, -20
  try:
    renderer = mujoco.Renderer(model, 120, 160)
  except Exception as error:
    pytest.skip(f"no OpenGL here: {error}")
  with renderer:
    renderer.enable_segmentation_rendering()
    renderer.update_scene(data, camera)
    return ndimage.label(renderer.render()[..., 1] == mujoco.mjtObj.mjOBJ_FLEX)[1]


def test_jaws_take_away_what_was_cut_off_and_a_picture_shows_it():
  spec = mujoco.MjSpec.from_string(JAWS)
  points, elem = scenes.triangular(0.08, 0.03, 24, 10, 0.2)
  pin = np.flatnonzero(points[:, 0] < 0.03)
  keys = {"mass": 0.01, "young": 2e5, "thickness": 0.002, "damping": 0.02, "device": "cpu"}
  palpate.add_organ(spec, (points, elem), "organ", windows=True, pin=pin, spare=60, **keys)
  model, data, organ = scenes.load(spec)

  def hold(steps, height):
    data.ctrl[:] = height, -0.0085, -0.0085
    mujoco.mj_step(model, data, steps)

  hold(100, 0.0)
  x = organ.xpos[:, 2].mean()
  organ.cut([[0.05, -0.015, x], [0.052, 0.015, x]])
  large, small = organ.pieces
  for height in np.linspace(0, 0.04, 20):
    hold(10, height)
  hold(60, 0.04)
  assert organ.error is None and organ.xpos[small.vertices, 2].min() > 0.03
  assert organ.xpos[large.vertices, 2].max() < 0.005
  assert parts_in_a_picture(model, data) == 2
