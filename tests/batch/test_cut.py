"""Cuts in batches: in each world its own mesh, and blades that cut there."""

import mujoco
import numpy as np
import palpate
import palpate.batch
import pytest
from devices import needs_cuda
from scenes import abreast, box, off, servo, sphere, triangular

BACKENDS = ["cpu", "warp-cpu", pytest.param("cuda:0", marks=needs_cuda)]
SLIDE = mujoco.mjtJoint.mjJNT_SLIDE
ROUND = np.linspace(0, 2 * np.pi, 60)
CIRCLE = 0.05 * np.stack([0.4 * np.cos(ROUND), 0.4 * np.sin(ROUND), 0 * ROUND + 0.84**0.5], axis=1)
LINE = 0.05 * np.stack([np.sin(ROUND / 4 - 0.7), 0 * ROUND, np.cos(ROUND / 4 - 0.7)], axis=1)
ENERGY, THICKNESS = 160.0, 2e-3  # [J/m^2], [m]


@pytest.fixture(params=BACKENDS)
def device(request):
  return request.param


def slide(body, spec, name, axis, gain):
  body.add_joint(type=SLIDE, axis=axis, name=name, damping=4)
  servo(spec, name, gain)


def pressed(windows, **keys):
  """Returns a ball over an uneven sphere, with room for cuts."""
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.integrator = 2e-3, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
  points, elem = sphere(2)
  points = points + 0.002 * np.random.RandomState(1).randn(*points.shape)
  points *= 0.05 / np.linalg.norm(points, axis=1)[:, None]
  body = spec.worldbody.add_body(pos=[0, 0, 0.062])
  slide(body, spec, "z", [0, 0, 1], 400)
  body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], mass=0.05, condim=1)
  given = {"mass": 0.3, "foundation": 4e4, "spare": 90, "young": 2e4, "thickness": THICKNESS}
  given |= {"damping": 0.01, "device": "cpu", "tolerance": 1e-6, "windows": windows}
  palpate.add_organ(spec, (points, elem), "organ", **given | keys)
  return spec


def strip(x=-0.004, cutters=f"edge {ENERGY}", size=(5e-4, 0.006, 0), **keys):
  """Returns a blade before a strip that its long sides hold."""
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = 2e-3, (0, 0, 0)
  body = spec.worldbody.add_body(pos=[x, 0, 0])
  slide(body, spec, "x", [1, 0, 0], 2000)
  free = {"contype": 0, "conaffinity": 0}
  body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.004, 0, 0], pos=[0, 0, 0.02], mass=0.1,
                **free)  # fmt: skip
  body.add_geom(name="edge", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=size, mass=1e-3,
                **free)  # fmt: skip
  points, elem = triangular(0.03, 0.026, 11, 11, 0.2)
  pin = np.flatnonzero(np.abs(np.abs(points[:, 1]) - 0.013) < 1e-9)
  palpate.add_organ(
    spec, (points, elem), "organ", mass=0.005, young=2e5, thickness=THICKNESS,
    pin=pin, cutters=cutters, device="cpu", **{"spare": 60, "windows": True} | keys,
  )  # fmt: skip
  return spec


def test_each_world_is_cut_for_itself_and_reset_makes_it_whole(device):
  batch = palpate.batch.make(pressed(True), 3, device=device)
  organ = batch.organ("organ")
  reports = organ.cut([LINE, LINE, CIRCLE], np.array([True, False, True]))
  assert [report is not None for report in reports] == [True, False, True]
  assert reports[0].length == pytest.approx(0.07, rel=0.3) and not reports[2].stopped
  assert [len(pieces) for pieces in organ.pieces] == organ.piece_count.numpy().tolist() == [1, 1, 2]
  masses = [sum(piece.mass for piece in pieces) for pieces in organ.pieces]
  np.testing.assert_allclose(masses, 0.3, rtol=1e-6)
  there = np.isfinite(organ.xpos.numpy()).all(axis=2).sum(axis=1)
  assert organ.nvert == len(sphere(2)[0]) + 90
  assert (there == len(sphere(2)[0]) + np.array([reports[0].nodes, 0, reports[2].nodes])).all()
  assert np.array_equal(organ.elem_of(1), organ.elem)
  assert organ.elem_of(0).max() == there[0] - 1
  batch.step(5)
  organ.cut(CIRCLE, np.array([True, False, False]))
  assert [len(cuts) for cuts in organ.cuts] == [2, 0, 1]
  batch.reset(np.array([False, False, True]))
  batch.step(5)
  assert organ.piece_count.numpy().tolist() == [2 + (len(organ.pieces[0]) > 2), 1, 1]
  assert [len(cuts) for cuts in organ.cuts] == [2, 0, 0]
  xpos = organ.xpos.numpy()
  there = np.isfinite(xpos[1]).all(axis=1)
  np.testing.assert_allclose(xpos[2][there], batch_alone(device).numpy()[0][there], atol=1e-7)
  assert not batch.failures.numpy().any()


def batch_alone(device):
  """Returns positions of a world that was stepped as often and never cut."""
  batch = palpate.batch.make(pressed(True), 1, device=device)
  batch.step(5)
  return batch.organ("organ").xpos


@pytest.mark.parametrize(
  ("windows", "keys"), [(True, {"bend": 0.0, "tension": 2.0}), (False, {"bend": 1.0, "bulk": 1e4})],
  ids=["membrane under tension", "nodal shell"],
)  # fmt: skip
def test_a_cut_world_goes_on_as_the_plugin_does(device, windows, keys):
  batch = palpate.batch.make(pressed(windows, **keys), 2, device=device, nodes=40)
  model, data = batch.model, mujoco.MjData(batch.model)
  alone, organ = palpate.Organ(model, data, "organ"), batch.organ("organ")
  alone.cut(LINE)
  batch.set_state(0, data)
  force = abreast(model, data, alone, batch, [-0.013] * 40)[..., 2]
  peak = np.abs(force[:, -1]).max()
  assert peak > 0.1 and np.abs(force[:, -1] - force[:, 1]).max() > 0.1 * peak  # that is whole
  assert off(force) < 1e-3
  batch.get_state(0, data)
  mujoco.mj_forward(model, data)
  xpos = organ.xpos.numpy()[0]
  assert alone.nvert == np.isfinite(xpos).all(axis=1).sum() > np.isfinite(xpos).shape[0] - 90
  np.testing.assert_allclose(alone.xpos, xpos[: alone.nvert], atol=1e-7)
  assert device == "cpu" or not batch.overflow.numpy().any()


@pytest.mark.parametrize("device", BACKENDS[1:])
@pytest.mark.parametrize("kind", ["membrane", "nodal shell", "solid"])
def test_a_lump_stays_through_cuts_and_resets(device, kind):
  """Worlds of one tissue, with a hard place, and with that once they have been cut."""
  solid, forces, places = kind == "solid", [], []
  spec = block(True) if solid else pressed(kind == "membrane", bend=float(kind != "membrane"))
  path = THROUGH - [0.015, 0, 0] if solid else LINE
  how = {"depth": 0.012, "direction": [0, 0, -1]} if solid else {}
  for where in (device, "cpu"):
    # So that it repeats on CUDA, whose contacts are in no order else.
    batch = palpate.batch.make(spec.copy(), 3, device=where, nodes=40, deterministic=True)
    organ, found = batch.organ("organ"), []
    middle = organ.xpos.numpy()[0][organ.elem].mean(axis=1)
    top = middle[:, 2].max()
    hard = np.where(np.linalg.norm(middle - [0, 0, top], axis=1) < 0.02, 8e4, 2e4)
    organ.configure([False, True, solid], young=np.stack([hard] * 3))
    for cuts in (True, False, True):
      if cuts:
        organ.cut([path] * 3, np.array([False, True, True]), **how)
      if not found and not solid:  # whose plugin takes young of the walls too
        organ.configure([False, False, True], young=np.stack([hard] * 3))
      for k in range(40):
        batch.ctrl = np.full((3, 1), -0.013 * k / 40)
        batch.step()
        found.append(organ.contact_force.numpy().sum(axis=1)[:, 2])
      places.append(organ.xpos.numpy().copy())
      batch.reset()
    forces.append(np.array(found))
  peak = np.abs(forces[1]).max(axis=0)
  off = np.abs(forces[0] - forces[1]) / peak
  # A tool that moves meets the mean inertia of a lump, as it does without room for cuts.
  assert (np.sqrt(np.mean(off**2, axis=0)) < 0.03).all() and off[[39, 79, 119]].max() < 0.006
  there = np.isfinite(places[0]).all(axis=2) & np.isfinite(places[3]).all(axis=2)
  assert there.sum() > 400 and np.abs(places[0][there] - places[3][there]).max() < 1e-4
  assert np.abs(places[0][1] - places[0][2])[there[1]].max() < 1e-6  # whenever it was hardened
  whole, again = forces[0][40:80], forces[0][80:]
  np.testing.assert_allclose(again, forces[0][:40], atol=1e-4 * peak[1])
  assert abs(whole[-1, 1]) > 1.05 * abs(whole[-1, 0])  # hard still
  np.testing.assert_allclose(whole[:, 1], whole[:, 2], atol=1e-4 * peak[1])
  assert not any(organ.cuts)


def test_blades_cut_in_each_world(device):
  batch = palpate.batch.make(strip(), 3, device=device)
  model, data = batch.model, mujoco.MjData(batch.model)
  alone, organ = palpate.Organ(model, data, "organ"), batch.organ("organ")
  speed, found = np.array([0.1, 0.1, 0.03]), []
  for _ in range(160):
    data.ctrl[:] = 0.1 * data.time
    batch.ctrl = (speed * data.time)[:, None]
    mujoco.mj_step(model, data)
    batch.step()
    found.append((alone.cutters[0].force[0], *organ.cutters.force.numpy()[:, 0, 0]))
  found = np.array(found)
  assert found[60:, 0].mean() == pytest.approx(ENERGY * THICKNESS, rel=0.02)
  np.testing.assert_allclose(found[:, 1], found[:, 0], atol=1e-3 * ENERGY * THICKNESS)
  assert np.array_equal(found[:, 1], found[:, 2])
  cutters = organ.cutters
  assert cutters.length.numpy()[0, 0] == pytest.approx(alone.cutters[0].length, rel=1e-3)
  assert cutters.energy.numpy()[0, 0] == pytest.approx(alone.cutters[0].energy, rel=1e-3)
  assert cutters.length.numpy()[0, 0] > 3 * cutters.length.numpy()[2, 0] > 0
  assert cutters.inside.numpy().tolist() == [[1], [1], [1]]
  np.testing.assert_allclose(cutters.seat.numpy()[0, 0], alone.cutters[0].seat, atol=1e-5)
  cuts = organ.cuts
  assert len(cuts[0]) == len(alone.cuts) > len(cuts[2])
  batch.reset(np.array([False, True, False]))
  assert organ.cutters.length.numpy()[:, 0].astype(bool).tolist() == [True, False, True]
  assert [bool(each) for each in organ.cuts] == [True, False, bool(cuts[2])]


def test_worlds_with_a_blade_are_made_by_kernels():
  # The short form of what is above, as steps of mujoco_warp on a CPU compile for minutes.
  organ = palpate.batch.make(strip(), 2, device="warp-cpu").organ("organ")
  assert organ.cutters.inside.numpy().tolist() == [[0], [0]]


@pytest.mark.parametrize("device", BACKENDS[1:])
def test_a_current_cuts_in_each_world(device):
  burn = 1.1e6
  spec = strip(0.01, f"edge {burn} by power", (1e-3, 1e-3, 0))
  spec.add_actuator(name="power", target="x", trntype=mujoco.mjtTrn.mjTRN_JOINT, gainprm=10 * [0])
  batch = palpate.batch.make(spec, 3, device=device)
  model, data = batch.model, mujoco.MjData(batch.model)
  alone, organ = palpate.Organ(model, data, "organ"), batch.organ("organ")
  power = 0.04 * burn * THICKNESS * np.array([1, 1, 0])
  for k in range(110):
    given = power * (k < 100)
    data.ctrl[:] = 0.035 * data.time, given[0]
    batch.ctrl = np.stack([np.full(3, 0.035 * data.time), given], 1)
    mujoco.mj_step(model, data)
    batch.step()
  found, expected = organ.cutters, alone.cutters[0]
  assert expected.length == pytest.approx(0.007, abs=1.5e-3)
  np.testing.assert_allclose(found.length.numpy()[:2, 0], expected.length, rtol=1e-3)
  np.testing.assert_allclose(found.energy.numpy()[:2, 0], expected.energy, rtol=1e-3)
  assert [len(cuts) for cuts in organ.cuts] == [len(alone.cuts), len(alone.cuts), 0]
  assert len(alone.cuts) > 0 and not found.length.numpy()[2, 0]


@pytest.mark.parametrize("device", BACKENDS[1:])
def test_tissue_tears_in_each_world(device):
  batch = palpate.batch.make(pressed(True, tear=0.05, foundation=1e4), 3, device=device, nodes=40)
  model, data = batch.model, mujoco.MjData(batch.model)
  alone, organ = palpate.Organ(model, data, "organ"), batch.organ("organ")
  deep = np.array([0.02, 0.02, 0.008])
  for k in range(85):
    data.ctrl[:] = -deep[0] * min(1, k / 80)
    batch.ctrl = -deep[:, None] * min(1, k / 80)
    mujoco.mj_step(model, data)
    batch.step()
  found = [[cut.length for cut in cuts if cut.nodes] for cuts in (alone.cuts, *organ.cuts)]
  assert len(found[0]) == 2 and not found[3]
  for each in found[1:3]:
    np.testing.assert_allclose(each, found[0], rtol=1e-3)


def test_what_cannot_be_cut_is_named():
  batch = palpate.batch.make(pressed(True), 2)
  organ = batch.organ("organ")
  with pytest.raises(ValueError, match=r"world 1: organ 'organ': point 0 of the path is 0\.\d+ m"):
    organ.cut([CIRCLE, CIRCLE + 0.1])
  assert not any(organ.cuts)
  with pytest.raises(ValueError, match=r"world 0 have shape \(60, 2\), expected \(n, 3\)"):
    organ.cut(CIRCLE[:, :2])
  with pytest.raises(ValueError, match=r"points are of 3 worlds, expected .* one a world, 2"):
    organ.cut([CIRCLE] * 3)
  whole = palpate.batch.make(pressed(True, spare=0), 2).organ("organ")
  with pytest.raises(ValueError, match="spare is 0, expected room for cuts"):
    whole.cut(CIRCLE)
  assert whole.piece_count.numpy().tolist() == [1, 1]


@pytest.mark.parametrize("device", BACKENDS[1:])
@pytest.mark.parametrize("spare", [0, 60])
def test_a_current_frees_bonds_in_each_world(device, spare):
  skin, wire = 2e-4, 1.5e-3  # [m]
  spec = strip(-wire - skin - 6e-4, "edge 3e3 by power", (wire, 4e-3, 0), spare=spare, radius=skin,
               bonds="bed 1e7 3000 1 near 0.004")  # fmt: skip
  bed = spec.worldbody.add_body(name="bed", pos=[0, 0, -0.005])
  bed.add_geom(size=[0.02, 0.02, 0.003], type=mujoco.mjtGeom.mjGEOM_BOX, contype=0, conaffinity=0)
  spec.add_actuator(name="power", target="x", trntype=mujoco.mjtTrn.mjTRN_JOINT, gainprm=10 * [0])
  batch = palpate.batch.make(spec, 4, device=device)
  model, data = batch.model, mujoco.MjData(batch.model)
  alone, bonds = palpate.Organ(model, data, "organ"), batch.organ("organ").bonds
  for k in range(60):
    power = -2.0 * (k < 50)  # coagulates: the wall stays whole
    data.ctrl[:] = 0.1 * data.time, power
    goes = *np.full(3, 0.1 * data.time), 0.0  # the last stays in the air
    batch.ctrl = np.stack([goes, power * np.array([1, 1, 0, 1])], 1)
    mujoco.mj_step(model, data)
    batch.step()
  damage = bonds.damage.numpy()
  assert 0.02 < alone.bonds.share_freed < 0.9 and ((damage[0] > 0) & (damage[0] < 1)).any()
  np.testing.assert_allclose(damage[:2], np.tile(alone.bonds.damage, (2, 1)), atol=1e-4)
  whole = damage[:2] < 1
  stretch = np.where(whole[..., None], bonds.stretch.numpy()[:2], 0)
  np.testing.assert_allclose(stretch[0], alone.bonds.stretch * whole[0, :, None], atol=1e-7)
  assert not damage[2:].any() and not any(batch.organ("organ").cuts)
  batch.reset(np.array([True, False, False, False]))
  stretched = np.abs(bonds.stretch.numpy()).any(axis=(1, 2))
  assert stretched.tolist() == [False, True, True, True]


def block(windows=True, x=0.012, z=0.027, size=0.01, **keys):
  """Returns a ball over a block, one end of which is pinned."""
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = 2e-3, (0, 0, -2)
  spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
  body = spec.worldbody.add_body(pos=[x, 0, z], gravcomp=1)
  slide(body, spec, "z", [0, 0, 1], 400)
  body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[size, 0, 0], mass=0.05, condim=1)
  points, elem = box((0.06, 0.05, 0.03), 0.009)
  given = {"mass": 0.1, "young": 2e4, "spare": 260, "device": "cpu", "tolerance": 1e-6}
  given |= {"pin": np.flatnonzero(points[:, 0] < -0.0299), "windows": windows}
  palpate.add_organ(spec, (points, elem), "organ", elements="solid", **given | keys)
  return spec


THROUGH = np.linspace([0, -0.025, 0.015], [0, 0.025, 0.015], 9)


@pytest.mark.parametrize("device", BACKENDS[1:])
def test_a_ball_that_stops_anywhere_presses_as_under_the_plugin(device):
  """Some of these steps take the constraint solver 8 iterations, others one."""
  nworld, force = 8, []
  batch = palpate.batch.make(block(), nworld, device, nodes=40)
  model, organ = batch.model, batch.organ("organ")
  data = [mujoco.MjData(model) for _ in range(nworld)]
  alone = [palpate.Organ(model, each, "organ") for each in data]
  for k in range(30):
    ctrl = (0.01 if k < 6 else -0.008) + 2e-5 * np.arange(nworld)
    for each, goal in zip(data, ctrl, strict=True):
      each.ctrl[:] = goal
      mujoco.mj_step(model, each)
    batch.ctrl = ctrl[:, None]
    batch.step()
    expected = [each.contact_force.sum(axis=0)[2] for each in alone]
    force.append((expected, organ.contact_force.numpy().sum(axis=1)[:, 2]))
  force = np.array(force)
  peak = np.abs(force[:, 0]).max()
  assert peak > 0.5 and np.abs(force[:, 0] - force[:, 1]).max() < 2e-3 * peak


@pytest.mark.parametrize("windows", [True, False])
@pytest.mark.parametrize("device", BACKENDS[1:])
def test_a_cut_solid_goes_on_as_the_plugin_does(device, windows):
  # So that worlds of one state stay equal on CUDA, whose contacts are in no order else.
  batch = palpate.batch.make(block(windows), 3, device, nodes=40, deterministic=True)
  model, data = batch.model, mujoco.MjData(batch.model)
  alone, organ = palpate.Organ(model, data, "organ"), batch.organ("organ")
  first, n = np.array([True, False, False]), alone.nvert
  for path, how in ((THROUGH - [0.015, 0, 0], {"depth": 0.012, "direction": [0, 0, -1]}),
                    (THROUGH, {})):  # fmt: skip
    report, done = alone.cut(path, **how), organ.cut(path, first, **how)[0]
    assert (done.area, done.nodes, done.depth) == (report.area, report.nodes, report.depth)
  whole, used = n, np.unique(alone.elem)  # a vertex may have got another number
  batch.set_state(1, data)
  abreast(model, data, alone, batch, [0.01] * 6)  # before the ball touches it
  xpos = organ.xpos.numpy()
  assert np.isfinite(xpos).all(axis=2).sum(axis=1).tolist() == [len(used), len(used), whole]
  for world in (0, 1):
    assert np.array_equal(organ.elem_of(world), alone.elem)
    np.testing.assert_allclose(xpos[world, used], alone.xpos[used], atol=2e-7)
  np.testing.assert_allclose([piece.mass for piece in organ.pieces[0]],
                             [piece.mass for piece in alone.pieces], rtol=1e-6)  # fmt: skip
  force = abreast(model, data, alone, batch, [-0.008] * 20)[..., 2]
  peak = np.abs(force[:, -1]).max()
  assert peak > 0.1 and off(force) < 1e-3
  np.testing.assert_array_equal(force[:, 0], force[:, 1])
  assert np.abs(force[:, -1] - force[:, 2]).max() > 0.3 * peak  # that is whole
  batch.get_state(0, data)
  mujoco.mj_forward(model, data)
  np.testing.assert_allclose(alone.xpos[used], organ.xpos.numpy()[0, used], atol=2e-7)
  batch.reset(np.array([True, False, True]))
  batch.step(3)
  xpos = organ.xpos.numpy()
  there = np.isfinite(xpos[2]).all(axis=1)
  assert organ.piece_count.numpy().tolist() == [1, 2, 1] and there.sum() == whole
  np.testing.assert_array_equal(xpos[0, there], xpos[2, there])
  assert not batch.failures.numpy().any()


@pytest.mark.parametrize("device", BACKENDS[1:])
def test_blades_cut_solids_in_each_world(device):
  pin = np.flatnonzero(np.abs(box((0.06, 0.05, 0.03), 0.009)[0][:, 1]) > 0.0249)
  spec = block(x=-0.04, z=0.012, size=0.001, young=5e5, cutters=f"edge {ENERGY}", pin=pin)
  body = spec.bodies[1]
  body.geoms[0].contype = body.geoms[0].conaffinity = 0
  slide(body, spec, "x", [1, 0, 0], 2000)
  free = {"contype": 0, "conaffinity": 0}
  body.add_geom(name="edge", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[5e-4, 0.006, 0], mass=0.1,
                **free)  # fmt: skip
  batch = palpate.batch.make(spec, 2, device=device)
  model, data = batch.model, mujoco.MjData(batch.model)
  alone, organ = palpate.Organ(model, data, "organ"), batch.organ("organ")
  for _ in range(170):
    data.ctrl[:] = 0, 0.15 * data.time
    batch.ctrl = np.array([[0, 0.15 * data.time], [0, 0]])
    mujoco.mj_step(model, data)
    batch.step()
  cutters, expected = organ.cutters, alone.cutters[0]
  assert expected.length > 0.008 and alone.cuts
  np.testing.assert_allclose(cutters.length.numpy()[0, 0], expected.length, rtol=0.02)
  np.testing.assert_allclose(cutters.energy.numpy()[0, 0], expected.energy, rtol=0.05)
  depth, own = ([cut.depth for cut in cuts] for cuts in (alone.cuts, organ.cuts[0]))
  assert own and np.median(own) == pytest.approx(np.median(depth), rel=0.1)
  assert not organ.cuts[1] and not cutters.length.numpy()[1, 0]
