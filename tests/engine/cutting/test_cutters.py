"""What cuts in a scene: blades and scissors, the force that they need, and what is refused."""

import mujoco
import numpy as np
import palpate
import pytest
import scenes
from palpate.models import trocar

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
BOTH = pytest.mark.parametrize("windows", [False, True], ids=["nodal", "windows"])
ENERGY, THICKNESS, WIDTH = 160.0, 2e-3, 1e-3  # [J/m^2], of the wall, of the blade [m]
FORCE = ENERGY * THICKNESS  # [N]
HINGE, SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
CAPSULE, SPHERE = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE


def strip():
  """Returns a strip along x whose long sides are to be pinned."""
  points, elem = scenes.triangular(0.05, 0.026, 18, 11, 0.2)
  return points, elem, np.flatnonzero(np.abs(np.abs(points[:, 1]) - 0.013) < 1e-9)


def scalpel(spec, x, z):
  """Adds an upright blade that slides along x and z, 2000 N/m each."""
  body = spec.worldbody.add_body(name="scalpel", pos=[x, 0, z])
  for name, axis in (("x", [1, 0, 0]), ("z", [0, 0, 1])):
    body.add_joint(type=SLIDE, axis=axis, name=name, damping=4)
    scenes.servo(spec, name, 2000)
  free = {"contype": 0, "conaffinity": 0}
  body.add_geom(type=SPHERE, size=[0.004, 0, 0], pos=[0, 0, 0.02], mass=0.1, **free)
  body.add_geom(name="edge", type=CAPSULE, size=[WIDTH / 2, 0.006, 0], mass=1e-3, **free)


def scene(windows=False, x=-0.004, z=0.0, add=scalpel, **keys):
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = 2e-3, (0, 0, 0)
  add(spec, x, z)
  points, elem, pin = strip()
  given = {"mass": 0.005, "young": 2e5, "thickness": THICKNESS, "spare": 60, "pin": pin}
  given |= {"cutters": f"edge {ENERGY}", "device": "cpu"}
  palpate.add_organ(spec, (points, elem), "organ", windows=windows, **given | keys)
  return scenes.load(spec)


@BOTH
def test_a_blade_needs_the_toughness_times_the_thickness(windows):
  model, data, organ = scene(windows)
  speed = 0.04
  force = scenes.follow(model, data, organ, lambda t: (speed * t, 0), 0.06 / speed)
  (cutter,), reports = organ.cutters, organ.cuts
  steady = force[len(force) // 3 : 2 * len(force) // 3]
  assert steady[:, 0].mean() == pytest.approx(FORCE, rel=0.02)
  # Energy is of the area as it was stretched; a hundredth of the strip is between two steps.
  assert cutter.energy == pytest.approx(FORCE * 0.05, rel=0.04)
  assert cutter.length == pytest.approx(0.05, rel=0.02)
  assert len(organ.pieces) == 2 and not cutter.inside
  line = np.concatenate([line for report in reports for line in report.path])
  assert np.abs(line[:, 1]).max() < 1e-3  # of edges of 2.8 mm
  assert sum(report.length for report in reports) == pytest.approx(0.05, rel=0.05)


@pytest.mark.parametrize(("speed", "beside"), [(0.05, 0.0), (0.1, 4e-4)])
def test_a_blade_notches_a_free_edge_that_would_fold(speed, beside):
  # A vertex of a fine mesh bears 0.23 N at the edge, less than cutting takes.
  points, elem = scenes.strip(0.04, 0.05, 18, 22)
  points[:, 1] += beside
  pin = (np.abs(points[:, 1] - beside) > 0.0249) | (points[:, 0] > points[:, 0].max() - 1e-6)
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = 1e-3, (0, 0, 0)
  scalpel(spec, points[:, 0].min() - 0.002, 0.0)
  given = {"mass": 0.005, "young": 2e5, "poisson": 0.4, "thickness": THICKNESS, "spare": 60}
  given |= {"pin": np.flatnonzero(pin), "cutters": f"edge {ENERGY}", "device": "cpu"}
  palpate.add_organ(spec, (points, elem), "organ", **given)
  model = spec.compile()
  data = mujoco.MjData(model)
  organ, pushed = palpate.Organ(model, data, "organ"), 0.0
  for _ in range(8):
    force = scenes.follow(model, data, organ, lambda t: (speed * t, 0), 0.003 / speed)
    pushed = max(pushed, np.abs(organ.displacement).max())
  assert pushed < 0.004 and len(organ.cuts) > 2
  assert organ.cutters[0].length == pytest.approx(0.022, abs=0.002)
  assert force[:, 0].mean() == pytest.approx(FORCE, rel=0.05)


def test_the_blade_feels_what_the_tissue_feels():
  model, data, organ = scene()
  scenes.follow(model, data, organ, lambda t: (0.04 * t, 0), 0.5)
  joint = data.qvel[model.joint("x").dofadr[0]]
  felt = data.actuator("x").force[0] - 4 * joint  # less the joint's damping
  assert felt == pytest.approx(organ.cutters[0].force[0], rel=0.1)


def test_what_is_pushed_too_little_does_not_cut():
  model, data, organ = scene(x=-0.0003)
  model.actuator("x").biasprm[:] = 0
  model.actuator("x").gainprm[0] = 1.0  # the control is a force [N]
  force = scenes.follow(model, data, organ, lambda t: (0.8 * FORCE * min(t, 1), 0), 1.4)
  assert organ.cutters[0].inside and not organ.cuts and organ.cutters[0].energy == 0
  assert force[-100:, 0].mean() == pytest.approx(0.8 * FORCE, rel=0.02)
  scenes.follow(model, data, organ, lambda t: (1.3 * FORCE, 0), 0.5)
  assert organ.cutters[0].length > 0.005


def test_a_blade_from_above_pierces_the_wall_first():
  model, data, organ = scene(x=0.025, z=0.0062)
  model.actuator("z").biasprm[:] = 0
  model.actuator("z").gainprm[0] = 1.0
  pierce = ENERGY * WIDTH
  force = scenes.follow(model, data, organ, lambda t: (0, -0.7 * pierce * min(2 * t, 1)), 0.7)
  assert force[-1, 2] == pytest.approx(-0.7 * pierce, rel=0.05)
  assert organ.cutters[0].energy == 0
  scenes.follow(model, data, organ, lambda t: (0, -1.5 * pierce if t < 0.85 else 0.0), 0.4)
  assert organ.cutters[0].energy == pytest.approx(pierce * THICKNESS, rel=1e-6)
  assert not organ.cuts  # it has gone through, but nowhere along


def test_a_state_in_the_middle_of_a_cut_goes_on_to_the_bit():
  model, data, organ = scene()

  def drive(each, seconds=0.2):
    own = palpate.Organ(model, each, "organ")
    scenes.follow(model, each, own, lambda t: (0.04 * t, 0), seconds)
    return np.append(own.xpos, own.cutters[0].energy)

  drive(data, 0.5)
  assert scenes.goes_on(model, data, drive)[-1] > 0
  mujoco.mj_resetData(model, data)
  assert not organ.cutters[0].inside and organ.cutters[0].energy == 0


@BOTH
def test_pinned_tissue_stays_whole_and_is_cut_beyond(windows):
  points, _, _ = strip()
  rim = np.abs(points - [0.025, 0, 0]) > [0.0249, 0.0129, 1]
  model, data, organ = scene(windows, pin=np.flatnonzero(rim.any(axis=1)))
  scenes.follow(model, data, organ, lambda t: (0.04 * t, 0), 1.6)
  line = np.concatenate([line for report in organ.cuts for line in report.path])
  assert 0.001 < line[:, 0].min() < 0.01 and 0.04 < line[:, 0].max() < 0.049
  assert len(organ.pieces) == 1 and (organ.mass > 0).sum() > len(points) - rim.any(axis=1).sum()


def test_scissors_cut_as_far_as_they_close():
  def add(spec, x, z):
    turn = (np.sqrt(0.5), 0, -np.sqrt(0.5), 0)
    trocar.attach(spec, "scissors", "s/", pos=(x - 0.12, 0, z), quat=turn)

  none = {"contype": 0, "conaffinity": 0}
  cutters = f"s/edge_left s/edge_right {ENERGY}"
  model, data, organ = scene(x=0.025, add=add, cutters=cutters, contact=none)
  jaw = data.actuator("s/jaw")

  def close(opening, seconds):
    for _ in range(round(seconds / model.opt.timestep)):
      jaw.ctrl[0] += np.clip(opening - jaw.ctrl[0], -0.004, 0.004)
      mujoco.mj_step(model, data)

  data.joint("s/jaw_left").qpos[0] = data.joint("s/jaw_right").qpos[0] = 0.4
  jaw.ctrl[0] = 0.8
  close(0.8, 0.1)
  assert not organ.cutters[0].inside  # they are open
  close(0.1, 0.9)
  (cutter,) = organ.cutters
  assert cutter.inside and 0.002 < cutter.length < 0.017
  np.testing.assert_allclose(cutter.force, [FORCE, 0, 0], atol=0.03 * FORCE)  # away from the hand
  # The edges run from 1.1 mm off the middle, 3 mm from the pivot, to 0.2 mm at 21.8 mm: they cross
  # at 1.244 mm / (angle + 0.0479), and what the jaws feel is the force on that way.
  angle = data.joint("s/jaw_left").qpos[0] + 0.0479
  felt = -data.actuator("s/jaw").force[0]
  assert felt == pytest.approx(FORCE * 0.5 * 1.244e-3 / angle**2, rel=0.05)
  close(-0.1, 0.3)
  assert organ.cutters[0].energy == pytest.approx(FORCE * organ.cutters[0].length, rel=0.1)
  line = np.concatenate([line for report in organ.cuts for line in report.path])
  assert line[:, 0].max() == pytest.approx(0.0235, abs=2e-3)  # nearly to the tips, at 0.025
  before = organ.cutters[0].energy
  close(0.8, 0.4)
  assert organ.cutters[0].energy == before  # nothing as they open


def current(spec, x, z):
  """Adds a ball on slides with a power."""
  scalpel(spec, x, z)
  spec.geom("edge").size = [0.001, 0.001, 0]
  spec.add_actuator(name="power", target="x", trntype=mujoco.mjtTrn.mjTRN_JOINT)
  spec.actuator("power").gainprm = 10 * [0]


def test_a_current_cuts_as_fast_as_its_power_allows():
  burn = 1.1e6  # [J/m^2]
  power = 0.01 * burn * THICKNESS  # [W], for 10 mm/s
  given = {"add": current, "x": 0.01, "cutters": f"edge {burn} by power"}
  for share, length in ((1.0, 0.01), (0.0, 0.0), (-1.0, 0.0)):
    model, data, organ = scene(**given)
    scenes.follow(model, data, organ, lambda t, p=share * power: (0.009 * t, 0, p), 1.2)
    assert organ.cutters[0].length == pytest.approx(length, abs=1.2e-3)
    assert bool(organ.cuts) == (length > 0)


@pytest.mark.parametrize("gap", [0.0002, 0.0005])  # [m]
def test_a_current_frees_bonds_where_it_touches_or_a_spark_leaps(gap):
  skin, wire = 0.0003, 0.001  # [m]
  model, data, organ = scene(
    add=current, x=0.0, spare=0, radius=skin, bonds="none", cutters="edge 1e6 by power"
  )
  mujoco.mj_forward(model, data)
  vertices = np.flatnonzero(organ.free)
  under = vertices[np.abs(organ.xpos[vertices, 1]).argmin()]
  x, y, _ = organ.xpos[under]
  place = data.qpos[:2] = x, 0.001 + np.sqrt((wire + skin + gap) ** 2 - y**2)
  organ.bond("world", 1e7, 6e3, 6.0, vertices=vertices)
  scenes.follow(model, data, organ, lambda t: (*place, -80.0), 0.4)
  free = organ.bonds.vertices[organ.bonds.free]
  assert free.tolist() == ([under] if gap < 0.0003 else [])


def test_a_current_frees_a_bond_by_its_strand():
  def add(spec, x, z):
    current(spec, x, z)
    spec.worldbody.add_body(name="bed", mocap=True)

  model, data, organ = scene(
    add=add, x=0.025, z=-0.0045, spare=0, bonds="none", cutters="edge 1e6 by power"
  )
  mujoco.mj_forward(model, data)
  organ.bond("bed", 1e5, 6e3, 400.0, vertices=np.flatnonzero(organ.free))
  near = np.linalg.norm(organ.bonds.positions[:, :2] - [0.025, 0], axis=1) < 0.002
  scenes.follow(model, data, organ, lambda t: (0, 0, -80.0), 0.2)
  assert near.any() and not organ.bonds.damage.any()  # it is 3.5 mm below the vertices
  data.mocap_pos[0, 2] = -0.005
  scenes.follow(model, data, organ, lambda t: (0, 0, -80.0), 0.4)
  assert organ.bonds.free[near].all() and not organ.bonds.free[~near].any()


def test_where_no_vertex_is_left_a_blade_goes_on_without_cutting():
  model, data, organ = scene(spare=3)
  for _ in range(700):
    data.ctrl[0] = 0.04 * data.time
    mujoco.mj_step(model, data)
  assert "no spare vertices are left" in organ.error
  assert np.isfinite(organ.xpos).all() and len(organ.pieces) == 1


@pytest.mark.parametrize(
  ("keys", "match"),
  [
    ({"cutters": "knife 160"}, "cutters names 'knife', which is no geom"),
    ({"cutters": "edge"}, "cutters is 'edge', expected a geom"),
    ({"cutters": "edge -1"}, "expected a geom, or two of scissors, and an energy > 0"),
    ({"cutters": "edge 160 by current"}, "cutters names 'current', which is no actuator"),
    ({"spare": 0}, "cutters is set, allowed only with spare"),
    ({"integrator": "neumann"}, "allowed only without cutters"),
  ],
)
def test_what_cannot_cut_is_named(keys, match):
  with pytest.raises(ValueError, match=match):
    scene(**keys)


@pytest.mark.parametrize(
  ("geom", "match"),
  [
    ({"contype": 1}, "which collides with it, expected"),
    ({"type": SPHERE}, "expected a capsule, cylinder or box"),
  ],
)
def test_a_geom_that_cannot_be_an_edge_is_named(geom, match):
  def add(spec, x, z):
    scalpel(spec, x, z)
    for name, value in geom.items():
      setattr(spec.geom("edge"), name, value)

  with pytest.raises(ValueError, match=match):
    scene(add=add)
