"""Batches on any backend: many worlds of a scene, each as if it were alone."""

import mujoco
import numpy as np
import palpate.batch
import pytest
from devices import needs_cuda
from scenes import RADIUS, abreast, drive, load, masses, off, press, probed
from scenes.resting import block, resting

BACKENDS = ["cpu", "warp-cpu", pytest.param("cuda:0", marks=needs_cuda)]
SKIN = {"capsule_young": 1e5, "thickness": 3e-4}


def spec(made):
  return mujoco.MjSpec.from_string(made)


@pytest.fixture(params=BACKENDS)
def make(request):
  """Returns what makes a batch of MJCF on a backend."""

  def on_backend(made, nworld, **options):
    return palpate.batch.make(spec(made), nworld, device=request.param, **options)

  on_backend.device = request.param
  return on_backend


def driven(batch, steps):
  """Presses and slides the probes of `probed` with depths of their own; returns their forces."""
  depth = np.linspace(0.004, 0.008, batch.nworld)
  out = []
  for k in range(steps):
    t = k * batch.model.opt.timestep
    aside = np.full(batch.nworld, 0.01 * np.clip(t / 0.1 - 1, 0, 1))
    batch.ctrl = np.stack([-depth * min(1, t / 0.04), aside], 1)
    batch.step()
    out.append(batch.organ("organ").contact_force.numpy().sum(axis=1))
  return np.array(out)


def slid_beside(make, made, steps, aside, wait):
  """Presses a probe in and moves it aside in a batch and under the plugin alone.

  Returns:
    the batch, the plugin's organ, what `abreast` returns
  """
  model, data, organ = load(made)
  batch, k = make(made, 2), np.arange(steps)
  ways = -0.007 * np.minimum(1, k / 60), aside * np.clip(k / wait - 1, 0, 1)
  return batch, organ, abreast(model, data, organ, batch, np.stack(ways, axis=1))


@pytest.mark.parametrize("window", [True, False])
def test_a_world_is_what_the_plugin_makes_of_it_alone(make, window):
  model, data, organ = load(probed(window))
  batch = make(probed(window), 3)
  for _ in range(40):
    data.ctrl[:] = -0.004, 0.001
    batch.ctrl = np.outer([1, 0.5, 0], data.ctrl)
    mujoco.mj_step(model, data)
    batch.step()
  own = slice(None) if make.device == "cpu" or not window else slice(-2, None)
  np.testing.assert_allclose(batch.qpos.numpy()[0, own], data.qpos[own], atol=1e-6)
  np.testing.assert_allclose(batch.qvel.numpy()[0, own], data.qvel[own], atol=1e-4)
  np.testing.assert_allclose(batch.time.numpy(), data.time, rtol=1e-6)
  tissue = batch.organ("organ")
  for name in ("xpos", "xvel", "contact_force"):
    np.testing.assert_allclose(getattr(tissue, name).numpy()[0], getattr(organ, name), atol=1e-4)
  force = np.linalg.norm(tissue.contact_force.numpy().sum(axis=1), axis=1)
  assert force[0] > 1.5 * force[1] > 0 == force[2]
  assert tissue.iterations.numpy()[0] == organ.iterations > 0
  np.testing.assert_allclose(tissue.residual.numpy()[0], organ.residual, rtol=0.3)


def test_worlds_do_not_depend_on_the_threads():
  made = [palpate.batch.make(spec(probed()), n, nthread=k) for n, k in ((3, 1), (3, 2), (3, 2))]
  a, b, c = (driven(each, 60) for each in made)
  assert np.array_equal(a, b) and np.array_equal(b, c) and np.abs(a[-1]).max() > 0.01


def test_a_world_does_not_depend_on_how_many_others_there_are(make):
  few, many = (make(probed(), n, deterministic=True) for n in (2, 5))
  for k in range(40):
    ctrl = np.array([[-0.0001 * k, 0.0], [-0.0002 * k, 0.0001 * k]])
    few.ctrl, many.ctrl = ctrl, np.concatenate([ctrl, ctrl[:1], ctrl])
    few.step()
    many.step()
  found = [each.organ("organ").xpos.numpy() for each in (few, many)]
  assert np.array_equal(found[0], found[1][:2]) and np.array_equal(found[0], found[1][3:])


def test_steps_at_once_are_those_one_by_one(make):
  a, b = (make(probed(), 2, deterministic=True) for _ in range(2))
  for batch in (a, b):
    batch.ctrl = np.array([[-0.004, 0.0], [-0.006, 0.001]])
  a.step(30)
  for _ in range(30):
    b.step()
  assert np.array_equal(a.qpos.numpy(), b.qpos.numpy())


def test_a_masked_reset_leaves_other_worlds_alone(make):
  batch = make(probed(), 3, deterministic=True)
  first = driven(batch, 30)
  before = batch.qpos.numpy().copy()
  batch.reset(np.array([True, False, True]))
  after, tissue = batch.qpos.numpy(), batch.organ("organ")
  assert np.array_equal(after[1], before[1]) and batch.ctrl.numpy()[1].any()
  assert not after[::2, -2:].any() and not batch.ctrl.numpy()[::2].any()
  assert not tissue.xvel.numpy()[::2].any() and tissue.xvel.numpy()[1].any()
  np.testing.assert_allclose(batch.time.numpy(), [0, 0.03, 0], atol=1e-6)
  batch.reset()
  assert np.array_equal(driven(batch, 30), first)


def test_an_organ_too_large_for_a_block_steps_as_others_do(make, monkeypatch):
  if make.device == "cpu":
    pytest.skip("it has no blocks")
  batches = [make(probed(), 2, deterministic=True)]
  monkeypatch.setattr("palpate.tissue.device.plan", lambda *args, **kinds: None)
  batches.append(make(probed(), 2, deterministic=True))
  one, several = (driven(batch, 40) for batch in batches)
  np.testing.assert_allclose(several, one, atol=1e-4 * np.abs(one).max())


@needs_cuda
@pytest.mark.parametrize("keys", [{"bend": 1}, {"elements": "solid", "poisson": 0.4}])
def test_a_large_organ_is_that_of_the_plugin(keys):
  made = press(subdivisions=4, foundation=2e4, **keys)  # 2562 nodes on the surface
  batch = palpate.batch.make(spec(made), 2, device="cuda:0")
  model, data, organ = load(made)
  *found, expected = abreast(model, data, organ, batch, -0.0001 * np.arange(60))[-1]
  np.testing.assert_allclose(found, [expected] * 2, atol=0.01 * np.abs(expected).max())


@pytest.mark.parametrize("window", [True, False])
def test_a_world_goes_out_to_the_plugin_and_back(make, window):
  batch = make(probed(window), 2)
  driven(batch, 50)
  data = mujoco.MjData(batch.model)
  batch.get_state(1, data)
  organ = palpate.Organ(batch.model, data, "organ")
  np.testing.assert_allclose(organ.xpos, batch.organ("organ").xpos.numpy()[1], atol=1e-7)
  alone = drive(batch.model, data, 5)
  batch.set_state(0, data)
  np.testing.assert_allclose(batch.qpos.numpy()[0, -2:], data.qpos[-2:], atol=1e-7)
  np.testing.assert_allclose(batch.organ("organ").xvel.numpy()[0], organ.xvel, atol=1e-7)
  assert np.isfinite(alone).all()


@pytest.mark.parametrize("h", [1e-3, 5e-3])
def test_a_spinning_organ_keeps_its_angular_momentum(make, h):
  _, data, organ = load(scene := probed(keys={"foundation": 0}, h=h))
  batch, mass = make(scene, 2), masses(organ)[:, None]
  organ.set_state(organ.xpos, np.cross([1.0, 2.0, 6.0], organ.xpos))
  batch.set_state(1, data)
  before, tissue = (mass * np.cross(organ.xpos, organ.xvel)).sum(axis=0), batch.organ("organ")
  batch.step(round(0.3 / h))  # Euler's step alone loses 1 % of it in that time at 1 ms
  after = (mass * np.cross(tissue.xpos.numpy()[1], tissue.xvel.numpy()[1])).sum(axis=0)
  np.testing.assert_allclose(after, before, atol=2e-3 * np.linalg.norm(before))


def test_a_block_comes_to_rest_under_a_plate(make):
  made, _ = resting("plate", h=2e-3, mesh=block(edge=0.02))
  room = {} if make.device == "cpu" else {"nodes": 48}
  batch = palpate.batch.make(made, 2, device=make.device, **room)
  depth, forces = batch.model.actuator_ctrlrange[0, 0], []
  for k in range(400):
    batch.ctrl = np.full((2, 1), depth * min(1, k / 150))
    batch.step()
    forces.append(batch.organ("organ").contact_force.numpy().sum(axis=1)[:, 2])
  last = np.abs(forces[-150:])
  np.testing.assert_allclose(last.mean(axis=0), 2.2, rtol=0.02)  # that of the plugin alone
  assert np.all(last.std(axis=0) < 0.006 * last.mean(axis=0))


@pytest.mark.parametrize("h", [pytest.param(1e-3, marks=pytest.mark.slow), 2e-3])
def test_a_plate_over_more_nodes_than_slots_comes_to_rest_and_is_told(make, h):
  if make.device == "cpu":
    pytest.skip("its windows have room")
  made, _ = resting("plate", h=h, mesh=block(edge=0.01))
  batch = palpate.batch.make(made, 2, device=make.device, deterministic=True)
  tissue, depth, forces = batch.organ("organ"), batch.model.actuator_ctrlrange[0, 0], []
  for k in range(round(0.6 / h)):
    batch.ctrl = np.full((2, 1), depth * min(1, k * h / 0.3))
    batch.step()
    forces.append(tissue.contact_force.numpy().sum(axis=1)[:, 2])
  last = -np.array(forces[-50:])
  # On CUDA each world has its contacts in another order, and the solver stops early.
  assert np.all(last.std(axis=0) < 0.02 * last.mean(axis=0)) and last.min() > 1.0
  assert np.abs(tissue.xvel.numpy()).max() < 0.01 and not batch.failures.numpy().any()
  with pytest.warns(UserWarning, match="windows had no room"):
    assert (batch.overflow.numpy() > 0).all()


def test_each_world_has_a_tissue_of_its_own(make):
  batch = make(press(bend=0, foundation=2e4), 3)
  tissue = batch.organ("organ")
  tissue.configure(young_scale=[0.5, 1.0, 2.0])
  tissue.configure(mask=[False, False, True], foundation=4e4, damping=0.004)
  batch.ctrl = np.full((3, 1), -0.006)
  batch.step(400)
  force = np.linalg.norm(tissue.contact_force.numpy().sum(axis=1), axis=1)
  assert 0 < force[0] < 0.95 * force[1] < 0.9 * force[2]


def test_a_new_tissue_leaves_the_state_as_it_is(make):
  # On CUDA a first tissue a triangle asks for other graphs.
  batch = make(press(bend=0, foundation=2e4), 2)
  tissue = batch.organ("organ")
  batch.ctrl = np.full((2, 1), -0.006)
  batch.step(60)
  before = tissue.xpos.numpy().copy(), tissue.xvel.numpy().copy(), batch.time.numpy().copy()
  tissue.configure([False, True], young=np.linspace(2e4, 4e4, 2 * len(tissue.elem)).reshape(2, -1))
  for was, now in zip(before, (tissue.xpos, tissue.xvel, batch.time), strict=True):
    np.testing.assert_array_equal(was, now.numpy())
  assert np.ptp(before[0], axis=0).max() == 0 < batch.time.numpy().min()


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_sliding_is_that_of_the_plugin(make, cone):
  _, _, found = slid_beside(make, probed(cone=cone), 220, aside=0.01, wait=100)
  assert off(found) < 0.005
  assert np.abs(found[:, -1, 0]).max() > 0.2 * np.abs(found[:, -1]).max()  # it slides


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_contacts_have_the_normal_forces(make, cone):
  batch = make(probed(cone=cone), 2)
  tissue = batch.organ("organ")
  if make.device == "cpu":
    with pytest.raises(ValueError, match=r"batch\.datas"):
      tissue.contacts  # noqa: B018
    return
  batch.ctrl = np.array([[-0.006, 0.0], [-0.004, 0.0]])
  batch.step(150)
  geom, normal, force = (array.numpy() for array in tissue.contacts)
  assert set(geom[geom >= 0]) == {batch.model.geom("tip").id} and not force[geom < 0].any()
  pushed = (normal * force[..., None] * (geom >= 0)[..., None]).sum(axis=1)
  found = tissue.contact_force.numpy().sum(axis=1)
  np.testing.assert_allclose(pushed[:, 2], found[:, 2], rtol=0.03)


@pytest.mark.parametrize(("window", "skin"), [(True, {}), (False, SKIN)])
def test_a_solid_is_that_of_the_plugin(make, window, skin):
  solid = {"elements": "solid", "young": 3e3, "foundation": None} | skin
  batch, organ, found = slid_beside(make, probed(window, keys=solid), 100, aside=0.005, wait=70)
  assert off(found) < 0.005
  np.testing.assert_allclose(batch.organ("organ").xpos.numpy()[0], organ.xpos, atol=2e-5)
  back = mujoco.MjData(batch.model)
  batch.get_state(1, back)
  batch.set_state(0, back)
  assert np.isfinite(batch.organ("organ").xpos.numpy()).all()


TISSUES = [
  ({"bend": 0}, {"poisson": [0.45, 0.2, 0.49], "thickness": [0.002, 0.003, 0.001]}),
  ({"bend": 1}, {"thickness": [0.002, 0.004, 0.0015], "young": [2e4, 3e4, 4e4]}),
  ({"bend": 0}, {"young": "lumps"}),
  ({"bend": 1}, {"young": "lumps"}),
  ({"elements": "solid"}, {"young_scale": [0.3, 1.0, 4.0], "poisson": [0.49, 0.45, 0.3]}),
  ({"elements": "solid", **SKIN}, {"young": "lumps"}),
]


@pytest.mark.parametrize(("scene", "keys"), TISSUES)
def test_tissues_of_worlds_are_those_of_the_plugin(make, scene, keys):
  made, keys = press(foundation=2e4, **scene), dict(keys)
  forces = []
  for device in (make.device, "cpu"):
    batch = palpate.batch.make(spec(made), 3, device=device)
    tissue = batch.organ("organ")
    if isinstance(keys.get("young"), str):
      middle = tissue.xpos.numpy()[0][tissue.elem].mean(axis=1)
      places = [[[0, 0, RADIUS]], [[RADIUS, 0, 0]], [[0.02, 0, 0.045]]]
      lump = np.linalg.norm(middle - places, axis=2)
      keys["young"] = np.where(lump < 0.025, 1.5e5, 3e4)
    tissue.configure(**keys)
    found = []
    for k in range(100):
      batch.ctrl = np.full((3, 1), -0.008 * min(1, k / 60))
      batch.step()
      found.append(tissue.contact_force.numpy().sum(axis=1)[:, 2])
    forces.append(np.array(found))
  peak = np.abs(forces[1]).max(axis=0)
  assert (np.sqrt(np.mean((forces[0] - forces[1]) ** 2, axis=0)) < 0.003 * peak).all()
  assert np.ptp(peak) > 0.1 * peak.max()


def test_a_mass_of_its_own_is_that_of_a_world(make):
  if make.device == "cpu":
    pytest.skip("the CPU's models have their masses")
  batch = make(press(bend=0, foundation=2e4), 2)
  batch.organ("organ").configure(mass=[0.05, 0.3])
  models = [load(press(bend=0, foundation=2e4).replace('mass="0.1"', f'mass="{m}"'))
            for m in (0.05, 0.3)]  # fmt: skip
  for k in range(60):
    batch.ctrl = np.full((2, 1), -0.0001 * k)
    batch.step()
    for model, data, _ in models:
      data.ctrl[0] = -0.0001 * k
      mujoco.mj_step(model, data)
  found = batch.organ("organ").contact_force.numpy().sum(axis=1)
  expected = [organ.contact_force.sum(axis=0) for _, _, organ in models]
  np.testing.assert_allclose(found, expected, atol=0.005 * np.abs(expected).max())


def test_gravity_is_that_of_a_world(make):
  batch = make(press(bend=0, foundation=1e4), 3)
  batch.configure([False, True, True], gravity=[[0, 0, 1], [0, 0, -9.81], [9.81, 0, 0]])
  batch.ctrl = np.full((3, 1), 0.02)
  batch.step(200)
  moved = (batch.organ("organ").xpos.numpy() - batch.organ("organ").xpos.numpy()[:1]).mean(axis=1)
  assert moved[1, 2] < -1e-3 and moved[2, 0] > 1e-3
  assert abs(moved[1, 2] + moved[2, 0]) < 1e-4


@pytest.mark.parametrize("side", ["organ", "probe"])
def test_friction_is_that_of_a_world(make, side):
  batch = make(probed(condim=3), 2)
  if side == "organ":
    batch.organ("organ").configure(friction=[0.5, 1.5])  # the probe's is 0.5, the greater counts
  else:
    batch.configure(friction={"tip": [0.5, 1.5]})
  most = np.zeros(2)
  for k in range(100):
    batch.ctrl = np.tile([-0.006, 0.01 * max(0, k / 50 - 1)], (2, 1))
    batch.step()
    force = batch.organ("organ").contact_force.numpy().sum(axis=1)
    most = np.maximum(most, force[:, 0])
  assert most[1] > 1.3 * most[0] > 0


def test_a_world_that_is_not_finite_is_reset_and_counted(make):
  batch, other = (make(probed(), 3, deterministic=True) for _ in range(2))
  ctrl = np.tile([-0.004, 0.0], (3, 1))
  for each, broken in ((batch, np.nan), (other, 0.0)):
    each.ctrl = ctrl
    each.step(5)
    each.ctrl = ctrl + np.array([[0, 0], [broken, 0], [0, 0]])
    each.step(5)
  assert batch.failures.numpy().tolist() == [0, 1, 0] and not other.failures.numpy().any()
  assert np.isfinite(batch.qpos.numpy()).all()
  assert np.array_equal(batch.qpos.numpy()[::2], other.qpos.numpy()[::2])
  batch.ctrl = ctrl
  batch.step(5)
  assert np.isfinite(batch.qpos.numpy()).all() and batch.failures.numpy()[1] == 1


def test_what_windows_had_no_room_for_is_counted_a_world():
  for count, missing in (("9 6 1", False), ("2 3 1", True)):
    batch = palpate.batch.make(spec(probed(count=count)), 2)
    batch.ctrl = np.array([[-0.006, 0.0], [-0.006, 0.0]])
    batch.step(60)
    assert (batch.overflow.numpy() > 0).tolist() == [missing, missing]


def test_bad_input_is_named():
  made = spec(probed())
  for nworld in (0, -1, 1.5, True):
    with pytest.raises(ValueError, match="nworld is"):
      palpate.batch.make(made, nworld)
  with pytest.raises(ValueError, match="scene is a str"):
    palpate.batch.make("scene.xml", 2)
  with pytest.raises(ValueError, match="device is 'tpu'"):
    palpate.batch.make(made, 2, device="tpu")
  with pytest.raises(ValueError, match=r"expected at most \d+"):
    palpate.batch.make(made, 10**9)
  batch = palpate.batch.make(made, 2)
  with pytest.raises(ValueError, match=r"ctrl has shape \(2,\), expected \(2, 2\)"):
    batch.ctrl = [0, 0]
  for mask in ([0, 1], [True], np.ones(2), "yes"):
    with pytest.raises(ValueError, match="expected \\(2,\\) of bool"):
      batch.reset(mask)
  for n in (0, 1.5, True):
    with pytest.raises(ValueError, match="n is"):
      batch.step(n)
  with pytest.raises(ValueError, match="world is 2"):
    batch.get_state(2, mujoco.MjData(batch.model))
  with pytest.raises(ValueError, match="another model"):
    batch.set_state(0, load(press())[1])
  with pytest.raises(ValueError, match="no organ 'liver'"):
    batch.organ("liver")
  tissue = batch.organ("organ")
  with pytest.raises(ValueError, match="cannot change while running"):
    tissue.configure(bend=0.5)
  with pytest.raises(ValueError, match="young_scale has shape"):
    tissue.configure(young_scale=[1.0, 2.0, 3.0])
  with pytest.raises(ValueError, match="friction"):
    tissue.configure(friction=-1)


def test_reset_goes_to_the_state_it_was_given_and_joints_and_bodies_to_theirs():
  made = spec(probed())
  made.worldbody.add_body(name="mark", pos=[0, 0, 0])
  loose = made.worldbody.add_body(name="loose", pos=[1, 0, 0])
  loose.add_freejoint(name="loose")
  loose.add_geom(size=[0.01, 0, 0], contype=0, conaffinity=0)
  batch = palpate.batch.make(made, 3)
  model, data = batch.model, mujoco.MjData(batch.model)
  drive(model, data, 60)
  batch.start(data)
  batch.step(5)
  mask = np.array([True, False, True])
  before = batch.qpos.numpy().copy()
  batch.reset(mask)
  np.testing.assert_allclose(batch.qpos.numpy()[::2], np.tile(data.qpos, (2, 1)), atol=1e-7)
  assert np.array_equal(batch.qpos.numpy()[1], before[1]) and batch.time.numpy()[0] == 0
  adr = [int(model.joint(name).qposadr[0]) for name in "zx"]
  batch.pose("zx", np.arange(6.0).reshape(3, 2) * 1e-3, mask)
  assert batch.qpos.numpy()[2, adr] == pytest.approx([0.004, 0.005])
  assert np.array_equal(batch.qpos.numpy()[1], before[1])
  with pytest.raises(ValueError, match=r"values has shape \(2,\), expected \(3, 2\)"):
    batch.pose("zx", [0, 0])
  place = np.array([0.5, 0.4, 0.3, 0.8, 0.6, 0.0, 0.0, 0.002])  # of the free body, then of x
  batch.pose(["loose", "x"], np.tile(place, (3, 1)), mask)
  start = int(model.joint("loose").qposadr[0])
  now = batch.qpos.numpy()
  assert now[0, start : start + 7] == pytest.approx(place[:7])
  assert now[0, adr[1]] == pytest.approx(0.002)
  assert np.array_equal(now[1], before[1])
  batch.place("mark", np.tile([1.0, 2, 3], (3, 1)), np.tile([1.0, 0, 0, 0], (3, 1)), mask)
  assert not batch.model.body("mark").pos.any()
  with pytest.raises(ValueError, match="body 'tool' has joints"):
    batch.place("tool", np.zeros((3, 3)), np.zeros((3, 4)))


def hung():
  """Returns `probed` with its probe on a post that has no joint, and sensors of the probe."""
  post = '<body name="post" pos="0 0 0.001"><body name="tool"'
  made = probed().replace('<body name="tool"', post)
  made = made.replace('friction="0.5"/></body>', 'friction="0.5"/><site name="tip"/></body></body>')
  sensors = '<sensor><force site="tip"/><framelinvel objtype="site" objname="tip"/></sensor>'
  return made.replace("</mujoco>", sensors + "</mujoco>")


@pytest.fixture
def both(make):
  """Returns what makes a batch on the backend and one on the CPU."""
  return lambda made, n: [
    palpate.batch.make(spec(made), n, device=device) for device in (make.device, "cpu")
  ]


def test_worlds_start_where_they_are_told(both):
  made = hung()
  model, data, _ = load(made)
  data.ctrl[:] = -0.007, 0.002
  mujoco.mj_step(model, data, 60)
  data.ctrl[:] = 0
  found = []
  for batch in both(made, 3):
    batch.start(data)
    batch.reset(np.array([True, False, True]))
    at = batch.organ("organ").xpos.numpy().copy()
    batch.ctrl = np.array([[-0.007, 0.0], [-0.007, 0.0], [-0.005, 0.001]])
    batch.step(20)
    found.append((at, batch.organ("organ").xpos.numpy(), batch.time.numpy()))
  np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-7)
  np.testing.assert_allclose(found[0][1], found[1][1], atol=2e-6)
  np.testing.assert_allclose(found[0][2], found[1][2], rtol=1e-5)
  assert np.abs(found[0][0][0] - found[0][0][1]).max() > 1e-3


def test_joints_and_bodies_are_put_somewhere_a_world(both):
  found = []
  for batch in both(hung(), 3):
    mask = np.array([True, True, False])
    turned = np.array([[1, 0, 0, 0], [0.9848, 0, 0.1736, 0], [1, 0, 0, 0]])
    batch.place("post", [[0, 0, 0.001], [0, 0.002, 0.002], [1, 1, 1]], turned, mask)
    batch.pose(["x", "z"], [[0.001, -0.001], [0.0, -0.002], [9, 9]], mask)
    at = batch.qpos.numpy()[:, -2:].copy()
    batch.ctrl = np.tile([-0.008, 0.001], (3, 1))
    batch.step(60)
    found.append((at, batch.organ("organ").contact_force.numpy().sum(axis=1), batch.qpos.numpy()))
  np.testing.assert_allclose(found[0][0], [[-0.001, 0.001], [-0.002, 0], [0, 0]], atol=1e-7)
  np.testing.assert_allclose(found[0][1], found[1][1], atol=2e-4)
  np.testing.assert_allclose(found[0][2][:, -2:], found[1][2][:, -2:], atol=1e-6)
  assert np.abs(found[0][1][:, 2]).min() > 0.02 and np.ptp(found[0][1][:, 2]) > 0.004


def test_sensors_are_summed_up_over_the_steps_of_a_call(both):
  batch, one = both(hung(), 2)
  for each in (batch, one):
    each.ctrl = np.array([[-0.008, 0.0], [-0.004, 0.001]])
    each.step(30)
  batch.step(20)
  seen = []
  for _ in range(20):
    one.step()
    seen.append(one.sensordata.numpy().reshape(2, 2, 3).copy())  # two of three numbers each
  peak, mean = np.linalg.norm(seen, axis=3).max(axis=0), np.mean(seen, axis=0).reshape(2, 6)
  for found, expected in zip(
    (batch.sensor_peak, batch.sensor_mean, batch.sensordata),
    (peak, mean, seen[-1].reshape(2, 6)), strict=True,
  ):  # fmt: skip
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-3, atol=1e-4)
  assert peak.min() > 0


def test_an_equality_is_switched_in_each_world(make):
  scene = spec(probed())
  weight = scene.worldbody.add_body(name="weight", pos=(0.1, 0.0, 0.1))
  weight.add_freejoint()
  weight.add_geom(size=(0.005, 0, 0), contype=0, conaffinity=0)
  hook = scene.add_equality(
    name="hook", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY, name1="weight"
  )
  hook.data[:3] = 0.0
  scene.option.gravity = (0.0, 0.0, -10.0)
  batch = palpate.batch.make(scene, 2, device=make.device)
  height = int(batch.model.joint(batch.model.body("weight").jntadr[0]).qposadr[0]) + 2
  batch.switch("hook", [True, False])
  batch.step(20)
  held, fallen = batch.qpos.numpy()[:, height]
  assert held == pytest.approx(0.1, abs=3e-4) and fallen < 0.1 - 1e-3
  batch.reset()
  batch.step(20)
  np.testing.assert_allclose(batch.qpos.numpy()[:, height], 0.1, atol=3e-4)
  for wrong, message in (((True,), "active has shape"), ((1.0, 0.0), "active has shape")):
    with pytest.raises(ValueError, match=message):
      batch.switch("hook", wrong)
  with pytest.raises(ValueError, match="no equality 'rope'"):
    batch.switch("rope", [True, False])
