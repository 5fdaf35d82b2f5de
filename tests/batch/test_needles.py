"""Needles in batches: they pierce, hold and are drawn out as under the plugin."""

import mujoco
import numpy as np
import palpate.batch
import pytest
from devices import needs_cuda
from scenes import needles as one
from scenes import press

DEVICES = ["warp-cpu", pytest.param("cuda:0", marks=needs_cuda)]
SLOW = pytest.mark.slow
COARSE = {"mesh": one.sheet(9)[0], "pin": one.sheet(9)[1], "tilt": 1.1}  # edges of 5 mm
APART = {"contype": 1, "conaffinity": 0}  # organs that touch needles, and not each other


def scene(device: str, nworld: int = 2, **given):
  """Returns a model, its data, its organ, and a batch of it."""
  spec = one.scene(**given)
  return *one.load(spec), palpate.batch.make(spec, nworld, device)


def drive(model, data, worlds, turns, speed=20.0):
  """Turns the hands to some angles [rad] in turn, in the plugin and in all worlds."""
  for angle in turns:
    start = data.ctrl[0]
    steps = max(1, round(abs(angle - start) / (speed * one.STEP)))
    for k in range(steps):
      data.ctrl[0] = start + (angle - start) * (k + 1) / steps
      mujoco.mj_step(model, data)
      if worlds:
        worlds.ctrl = np.tile(data.ctrl, (worlds.nworld, 1))
        worlds.step()
      yield k


def compare(organ, worlds, limit: float, which=slice(None)):
  """Compares what the needle does in some worlds with the plugin; forces to a limit [N]."""
  tissue, (needle,) = worlds.organ(organ.name), organ.needles
  found = {name: array.numpy()[which, 0] for name, array in tissue.needles._asdict().items()}
  n = len(needle.holes)
  assert (found["count"] == n).all()
  for name in ("touches", "inside"):
    assert (found[name] == getattr(needle, name)).all()
  np.testing.assert_allclose(found["energy"], needle.energy, rtol=1e-3, atol=1e-7)
  near = {name: (np.array([getattr(hole, name) for hole in needle.holes]), f"hole_{name}")
          for name in ("inside", "thread", "along", "rest", "at", "force", "torn")}  # fmt: skip
  near = {told: (found[told][:, :n], expected) for expected, told in near.values() if n}
  x = [row[np.isfinite(row[:, 0])] for row in tissue.xpos.numpy()[which]]  # spare ones wait
  near["x"] = x, organ.xpos[np.isfinite(organ.xpos[:, 0])]
  for name in ("force", "tip_force"):
    near[name] = found[name], getattr(needle, name)
  for name, (values, expected) in near.items():
    for row in values:
      atol = limit if name.endswith("force") else 1e-5
      np.testing.assert_allclose(row, expected, atol=atol, err_msg=name)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("free", [True, pytest.param(False, marks=SLOW)])
def test_a_needle_goes_through_a_sheet_and_back_as_under_the_plugin(device, free):
  """It dents the sheet, pierces it, slides in its hole, and is drawn out again."""
  model, data, organ, worlds = scene(device, free=free, **COARSE)
  seen = []
  for k in drive(model, data, worlds, [0.85, -0.3]):
    if k % 10 == 9:
      compare(organ, worlds, 5e-4)
      (needle,) = organ.needles
      seen.append((bool(needle.touches), len(needle.holes)))
  assert {(True, 0), (False, 1)} <= set(seen)
  assert not organ.pinholes
  assert not worlds.failures.numpy().any()


@pytest.mark.parametrize("device", DEVICES)
def test_a_needle_goes_through_a_wall_of_two_layers_as_under_the_plugin(device):
  """Each layer has its own toughness and holes."""
  spec = one.wall(free=True, contact=APART, **COARSE)
  model, data, organ = one.load(spec)
  worlds, lower = palpate.batch.make(spec, 2, device), palpate.Organ(model, data, "lower")
  for k in drive(model, data, worlds, [1.5]):
    if k % 10 == 9:
      compare(organ, worlds, 5e-4)
      compare(lower, worlds, 5e-4)
  assert len(organ.pinholes) == len(lower.pinholes) == 1
  assert not worlds.failures.numpy().any()


@SLOW
@pytest.mark.parametrize("device", DEVICES)
def test_a_thread_through_both_layers_of_a_wall_is_held_as_under_the_plugin(device):
  """Both hold it by a hole; the thread meets neither, as batches find fewer of such contacts."""
  spec = one.wall(nodes=16, pos=(0.0172, 0, 0), contact=APART)
  spec.flex("suture").conaffinity = 0
  model, data, organ = one.load(spec)
  lower = palpate.Organ(model, data, "lower")
  one.drive(model, data, organ, [4.6])
  mujoco.mj_step(model, data, 300)
  worlds = palpate.batch.make(spec, 2, device)
  worlds.set_state(1, data)
  worlds.ctrl = np.stack([0 * data.ctrl, data.ctrl])
  at = worlds.bare.body("suture_15").id
  for k in range(30):
    data.body("suture_15").xfrc_applied[1] = 5e-3 * k
    applied = worlds.d.xfrc_applied.numpy()
    applied[1, at, 1] = 5e-3 * k
    worlds.d.xfrc_applied.assign(applied)
    mujoco.mj_step(model, data)
    worlds.step()
    for each in (organ, lower):
      (hole,) = each.pinholes
      assert hole.thread
      found = worlds.organ(each.name).needles
      np.testing.assert_allclose(found.hole_force.numpy()[1, 0, 0], hole.force, atol=2e-3)
      np.testing.assert_allclose(found.hole_along.numpy()[1, 0, 0], hole.along, atol=5e-5)
  assert worlds.organ("lower").needles.count.numpy().tolist() == [[0], [1]]


@pytest.mark.parametrize("device", DEVICES)
def test_a_needle_tears_a_sheet_as_under_the_plugin(device):
  """Levered sideways, it tears its hole as far, by the same force."""
  model, data, organ, worlds = scene(device, **COARSE)
  for _ in drive(model, data, worlds, [1.1]):
    pass
  for k in range(130):
    data.ctrl[1] += 5e-5
    mujoco.mj_step(model, data)
    worlds.ctrl = np.tile(data.ctrl, (worlds.nworld, 1))
    worlds.step()
    if k % 10 == 9:
      compare(organ, worlds, 0.02)
  assert organ.pinholes[0].torn > 1e-3


@SLOW
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("windows", [False, True])
def test_a_needle_goes_through_a_solid_as_under_the_plugin(device, windows):
  tools = {"tools": ["needle"]} if windows else False
  given = {"solid": True, "free": True, "windows": tools}
  model, data, organ, worlds = scene(device, **given)
  for k in drive(model, data, worlds, [2.4], 12.0):
    if k % 20 == 19:
      compare(organ, worlds, 1e-3)
  assert len(organ.needles[0].holes) > 8


@pytest.mark.parametrize("device", DEVICES)
def test_a_world_goes_on_where_a_state_says(device):
  """There and back, beside one that has no hole, and after a reset."""
  model, data, organ, worlds = scene(device, free=True, **COARSE)
  for _ in drive(model, data, None, [1.0]):
    pass
  assert organ.pinholes
  worlds.set_state(1, data)
  for _ in drive(model, data, worlds, [1.1]):
    pass
  compare(organ, worlds, 5e-4, slice(1, 2))
  assert worlds.organ("organ").needles.count.numpy().tolist() == [[0], [1]]
  other = mujoco.MjData(model)
  worlds.get_state(1, other)
  mujoco.mj_forward(model, other)
  (hole,) = palpate.Organ(model, other, "organ").pinholes
  np.testing.assert_allclose(hole.rest, organ.pinholes[0].rest, atol=1e-7)
  worlds.reset(np.array([False, True]))
  assert not worlds.organ("organ").needles.count.numpy().any()
  worlds.start(other)
  worlds.reset(np.array([True, False]))
  assert worlds.organ("organ").needles.count.numpy().tolist() == [[1], [0]]


@pytest.mark.parametrize("device", DEVICES)
def test_runs_that_repeat_to_the_bit_go_as_under_the_plugin(device):
  spec = one.scene(free=True, **COARSE)
  model, data, organ = one.load(spec)
  runs = [palpate.batch.make(spec, 2, device, deterministic=True) for _ in range(2)]
  for worlds in runs:
    mujoco.mj_resetData(model, data)
    for _ in drive(model, data, worlds, [1.1]):
      pass
    compare(organ, worlds, 5e-4)
  assert organ.pinholes
  for name in ("qpos", "qvel"):
    first, second = (getattr(worlds, name).numpy() for worlds in runs)
    np.testing.assert_array_equal(first, second, err_msg=name)
  told = [worlds.organ("organ").needles._asdict() for worlds in runs]
  for name, array in told[0].items():
    np.testing.assert_array_equal(array.numpy(), told[1][name].numpy(), err_msg=name)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
  ("solid", "deterministic"), [(False, True), pytest.param(True, False, marks=SLOW)]
)
def test_pinholes_stay_beside_a_cut_or_open_as_under_the_plugin(device, solid, deterministic):
  """A world is cut beside its holes, the other one through the first of them."""
  given = {"solid": True, "spare": 120, "height": 0.0175}
  if not solid:
    (mesh, pin), law = one.sheet(), f"needle {one.ENERGY} 10"
    given = {"mesh": mesh, "pin": pin, "spare": 40, "young": 1e5, "tilt": 1.1, "needles": law}
  spec = one.scene(**given)
  worlds = palpate.batch.make(spec, 2, device, deterministic=deterministic)
  plugins = [one.load(spec) for _ in range(2)]
  for model, data, _ in plugins:
    for _ in drive(model, data, worlds if data is plugins[0][1] else None, [2.4 if solid else 1.1]):
      pass
  before = plugins[0][2].needles[0].holes
  first = before[0].rest
  y, paths = np.linspace(-0.008, 0.008, 12), []
  for x in (first[0] + (6e-3 if solid else 6e-4), first[0]):
    z = 0.015 * np.sqrt(1 - (x / 0.025) ** 2 - (y / 0.02) ** 2) if solid else 0 * y
    paths.append(np.stack([0 * y + x, y, z], axis=1))
  how = {"depth": 0.004} if solid else {}
  worlds.organ("organ").cut(paths, **how)
  for path, (_, _, organ) in zip(paths, plugins, strict=True):
    organ.cut(path, **how)
  kept, opened = (len(organ.needles[0].holes) for _, _, organ in plugins)
  assert opened <= kept == len(before)
  assert solid or opened == 0
  for _ in range(20):
    for model, data, _ in plugins:
      mujoco.mj_step(model, data)
    worlds.step()
  now = [len(organ.needles[0].holes) for _, _, organ in plugins]
  assert worlds.organ("organ").needles.count.numpy()[:, 0].tolist() == now
  if solid:  # its facets may lie otherwise, by states that differ in their last digits
    rest = worlds.organ("organ").needles.hole_rest.numpy()
    for row, (_, _, organ), n in zip(rest, plugins, now, strict=True):
      expected = [hole.rest for hole in organ.needles[0].holes]
      np.testing.assert_allclose(row[0, :n], expected, atol=1e-4)
  else:
    compare(plugins[0][2], worlds, 5e-4, slice(0, 1))
  assert not worlds.failures.numpy().any()


@SLOW
@pytest.mark.parametrize("device", DEVICES)
def test_worlds_have_walls_of_their_own(device):
  """What piercing takes goes by the thickness of each, as under the plugin."""
  thick = one.THICK * np.array([0.7, 1.2])
  worlds = palpate.batch.make(one.scene(free=True, **COARSE), 2, device)
  worlds.organ("organ").configure(thickness=thick)
  for k, each in enumerate(thick):
    model, data, organ = one.load(one.scene(free=True, **COARSE))
    organ.configure(thickness=each)
    for _ in drive(model, data, None if k else worlds, [1.2]):
      pass
    compare(organ, worlds, 5e-4, slice(k, k + 1))


def test_needles_on_the_cpu_are_those_of_the_plugin():
  model, data, organ, worlds = scene("cpu", **COARSE)
  for _ in drive(model, data, worlds, [0.9]):
    pass
  assert organ.pinholes
  compare(organ, worlds, 1e-6)


def test_an_organ_without_needles_says_so():
  worlds = palpate.batch.make(mujoco.MjSpec.from_string(press(subdivisions=1)), 1, "cpu")
  with pytest.raises(ValueError, match="nothing goes through it, expected the key needles"):
    worlds.organ("organ").needles  # noqa: B018


@SLOW
@pytest.mark.parametrize("device", DEVICES)
def test_a_thread_slides_through_its_hole_as_under_the_plugin(device):
  """It is held up to what the capstan's law says, and slides from there on."""
  mu, nodes = 0.3, 24
  suture = {"contact": {"friction": mu}}
  given = {"pos": (0.017, 0, 0), "needles": f"needle {one.ENERGY}", "foundation": 3e7}
  spec = one.scene(nodes=nodes, suture=suture, **given)
  spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # the hole alone
  model, data, organ = one.load(spec)
  one.drive(model, data, organ, [5.0])
  worlds = palpate.batch.make(spec, 2, device)
  tail = np.array([0.2, 0, 0.98])
  for _ in one.pull(model, data, {nodes - 1: 0.3 * tail}, 0.001, 1.0, 400):
    pass
  ends = [data.body(f"suture_{node}").xpos for node in range(2)]
  head = (ends[0] - ends[1]) / np.linalg.norm(ends[0] - ends[1])
  data.eq_active[:] = 0
  for _ in one.pull(model, data, {0: 0.3 * head}, 1.0, 1.0, 100):
    pass
  worlds.set_state(1, data)
  worlds.ctrl = np.stack([0 * data.ctrl, data.ctrl])
  at = [worlds.bare.body(f"suture_{node}").id for node in (0, nodes - 1)]
  tissue, start, slid = worlds.organ("organ"), organ.pinholes[0].along, [0.0, 0.0]
  for k, _ in enumerate(one.pull(model, data, {0: 0.3 * head}, 1.0, 1.8, 300)):
    held = 1.0 + 0.8 * k / 300
    applied = worlds.d.xfrc_applied.numpy()
    applied[1, at, :3] = 0.3 * held * head, 0.3 * tail
    worlds.d.xfrc_applied.assign(applied)
    worlds.step()
    found = float(tissue.needles.hole_along.numpy()[1, 0, 0])
    for each, along in enumerate((organ.pinholes[0].along, found)):
      slid[each] = slid[each] or held * (abs(along - start) > 2e-4)
    if all(slid):
      break
    force = tissue.needles.hole_force.numpy()[1, 0, 0]
    np.testing.assert_allclose(force, organ.pinholes[0].force, atol=0.02)
  angle = np.arccos(-(tail @ head) / np.linalg.norm(tail))
  assert angle > 1.0
  np.testing.assert_allclose(slid, np.exp(mu * angle), rtol=0.03)
  assert worlds.organ("organ").needles.count.numpy().tolist() == [[0], [1]]
