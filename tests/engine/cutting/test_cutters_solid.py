"""What cuts a solid in a scene: the force grows with how deep it is."""

import mujoco
import numpy as np
import palpate
import pytest
import scenes
from palpate.models import trocar

ENERGY, WIDTH = 160.0, 1e-3  # [J/m^2], of the blade [m]
SLIDE = mujoco.mjtJoint.mjJNT_SLIDE


def scene(windows=True, x=-0.033, z=0.01, half=0.006, young=5e5, cutters=f"edge {ENERGY}"):
  """Returns a block whose long sides are pinned, under a blade that slides along x and z."""
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = 2e-3, (0, 0, 0)
  body = spec.worldbody.add_body(name="scalpel", pos=[x, 0, z])
  for name, axis in (("x", [1, 0, 0]), ("z", [0, 0, 1])):
    body.add_joint(type=SLIDE, axis=axis, name=name, damping=4)
    scenes.servo(spec, name, 2000)
  spec.add_actuator(name="power", target="x", trntype=mujoco.mjtTrn.mjTRN_JOINT)
  spec.actuator("power").gainprm = 10 * [0]
  free = {"contype": 0, "conaffinity": 0}
  size = [WIDTH / 2, half, 0]
  body.add_geom(name="edge", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=size, mass=0.1, **free)
  points, elem = scenes.box((0.05, 0.03, 0.018), 0.005)
  points[:, 2] += 0.001  # its top is at 10 mm
  pin = np.flatnonzero(np.abs(np.abs(points[:, 1]) - 0.015) < 1e-9)
  given = {"mass": 0.05, "young": young, "spare": 300, "pin": pin, "cutters": cutters}
  palpate.add_organ(spec, (points, elem), windows=windows, elements="solid", device="cpu", **given)
  return scenes.load(spec)


@pytest.mark.parametrize("deep", [0.006, 0.009])  # of 12 mm
@pytest.mark.parametrize("windows", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_blade_needs_the_toughness_times_its_depth(windows, deep):
  model, data, organ = scene(windows, z=0.016 - deep)
  speed = 0.1
  force = scenes.follow(model, data, organ, lambda t: (speed * t, 0, 0), 0.075 / speed)
  (cutter,), reports = organ.cutters, organ.cuts
  steady = force[120:210]
  assert steady[:, 0].mean() == pytest.approx(ENERGY * deep, rel=0.02)
  assert cutter.energy == pytest.approx(ENERGY * deep * 0.05, rel=0.12)
  assert cutter.length == pytest.approx(0.05, rel=0.02) and not cutter.inside
  # The mesh came apart along it, as deep, in one groove.
  area = sum(report.area for report in reports)
  assert 0.7 < area / (deep * 0.05) < 1.6 and len(organ.pieces) == 1  # of edges of 5 mm and more
  depths = [report.depth for report in reports]
  assert np.median(depths) == pytest.approx(deep, rel=0.02)
  assert max(depths) < 1.1 * deep
  line = np.concatenate([line for report in reports for line in report.path])
  assert np.abs(line[:, 1]).max() < 2e-3 and np.ptp(line[:, 0]) > 0.044


def test_a_blade_from_above_goes_in_and_then_along():
  model, data, organ = scene(x=-0.012, z=0.0165)
  scenes.follow(model, data, organ, lambda t: (0, -0.005 * min(1, 5 * t), 0), 0.3)
  assert organ.cutters[0].inside and not organ.cuts
  assert organ.cutters[0].energy == pytest.approx(ENERGY * WIDTH * 1e-3, rel=1e-6)
  force = scenes.follow(model, data, organ, lambda t: (0.08 * (t - 0.3), -0.005, 0), 0.3)
  assert force[-30:, 0].mean() == pytest.approx(ENERGY * 0.0045, rel=0.05)
  assert organ.cuts and organ.cuts[0].depth < 0.0065

  def drive(each):  # in the middle of a cut
    own = palpate.Organ(model, each, "organ")
    scenes.follow(model, each, own, lambda t: (0.08 * (t - 0.3), -0.005, 0), 0.1)
    return np.append(own.xpos, own.cutters[0].energy)

  scenes.goes_on(model, data, drive)


def test_a_blade_cuts_soft_tissue_as_deep_as_it_is_pressed_in():
  deep = 0.009  # of a blade of 12 mm
  model, data, organ = scene(x=-0.012, z=0.0165, young=5e4)
  down = -(deep + 0.0005)
  scenes.follow(model, data, organ, lambda t: (0, down * min(1, 2 * t), 0), 0.6)
  force = scenes.follow(model, data, organ, lambda t: (0.05 * (t - 0.6), down, 0), 0.55)
  assert np.linalg.norm(force[-30:], axis=1).mean() == pytest.approx(ENERGY * deep, rel=0.02)
  assert organ.cuts
  for report in organ.cuts:
    assert report.depth == pytest.approx(deep, rel=0.05)
  assert organ.cutters[0].length > 0.015  # of 27 mm: tissue gives way by some 10 before it parts


def test_a_current_cuts_by_its_power_and_depth():
  burn, deep = 1.1e6, 0.001 + WIDTH / 2 + 0.001  # [J/m^2, m], with what it reaches beyond itself
  model, data, organ = scene(x=-0.02, z=0.0095, half=0.0005, cutters=f"edge {burn} by power")
  power = 0.04 * burn * deep  # [W], for 40 mm/s
  scenes.follow(model, data, organ, lambda t: (0.036 * t, 0, power), 0.5)
  assert organ.cutters[0].length == pytest.approx(0.018, rel=0.1)
  assert organ.cutters[0].energy == pytest.approx(burn * deep * organ.cutters[0].length, rel=0.15)
  assert organ.cuts and organ.cuts[0].depth < deep + 1e-3


def slab(thick, young, energy, torque):
  """Returns a slab of 12 mm between scissors, open, that close over it to beyond its end."""
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = 2e-3, (0, 0, 0)
  turn = (np.sqrt(0.5), 0, -np.sqrt(0.5), 0)
  trocar.attach(spec, "scissors", "s/", pos=(0.01 - 0.12, 0, 0), quat=turn)
  for geom in spec.geoms:
    geom.contype = geom.conaffinity = 0
  points, elem = scenes.box((0.012, 0.02, thick), 0.003)
  pin = np.flatnonzero(np.abs(np.abs(points[:, 1]) - 0.01) < 1e-9)
  given = {"mass": 0.005, "young": young, "spare": 600, "pin": pin, "windows": True}
  given |= {"cutters": f"s/edge_left s/edge_right {energy}", "elements": "solid", "device": "cpu"}
  palpate.add_organ(spec, (points, elem), **given)
  model = spec.compile()
  model.actuator("s/jaw").forcerange[:] = -torque, torque
  data = mujoco.MjData(model)
  data.joint("s/jaw_left").qpos[0] = data.joint("s/jaw_right").qpos[0] = 0.4
  return model, data, palpate.Organ(model, data, "organ")


def close(model, data, organ):
  """Closes the scissors; returns the forces on the slab while they are in it [N]."""
  forces = []
  for opening in [*np.full(50, 0.8), *np.linspace(0.8, -0.1, 300), *np.full(300, -0.1)]:
    data.actuator("s/jaw").ctrl[0] = opening
    mujoco.mj_step(model, data)
    (cutter,) = organ.cutters
    if cutter.inside:
      forces.append(np.linalg.norm(cutter.force))
  return np.array(forces)


JAW = 0.12  # the instrument's [N m]


@pytest.mark.parametrize(
  "thick, young, energy, torque",
  [
    (0.004, 5e5, ENERGY, JAW),
    (0.005, 5e5, ENERGY, JAW),
    (0.006, 5e5, ENERGY, JAW),
    (0.008, 5e5, ENERGY, 0.4),
    (0.004, 2e4, 6.4, JAW),
    (0.007, 2e4, 6.4, JAW),
  ],
)
def test_scissors_part_the_slab_that_they_close_over(thick, young, energy, torque):
  model, data, organ = slab(thick, young, energy, torque)
  forces = close(model, data, organ)
  (cutter,) = organ.cutters
  assert len(organ.pieces) == 2 and organ.error is None
  sides = [organ.xpos[piece.vertices, 1].mean() for piece in organ.pieces]
  assert min(sides) < -0.003 and max(sides) > 0.003
  area = sum(report.area for report in organ.cuts)
  assert area == pytest.approx(thick * 0.012, rel=0.02)  # the slab's section
  assert cutter.energy == pytest.approx(energy * area, rel=0.05)
  assert np.median(forces) == pytest.approx(energy * thick, rel=0.1)


def test_jaws_that_are_too_weak_stop_in_the_slab():
  thick = 0.008
  model, data, organ = slab(thick, 5e5, ENERGY, JAW)
  force = close(model, data, organ)[-1]
  assert organ.cutters[0].inside and len(organ.pieces) == 1
  assert 0.7 < force / (ENERGY * thick) < 1.05
