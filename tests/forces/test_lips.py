"""Lips of cuts: they carry pressure, open freely, and do not pass through each other."""

import mujoco
import numpy as np
import palpate
import palpate.batch
import pytest
import scenes
from devices import needs_cuda
from scipy.spatial import cKDTree

SIZE, EDGE = (0.06, 0.05, 0.03), 0.01  # a mesh plane is at x = 0
YOUNG, MASS, H = 1e4, 0.3, 2e-3
BOTH = pytest.mark.parametrize("windows", [False, True], ids=["nodal", "windows"])


def block():
  return scenes.box(SIZE, EDGE)


def sheet():
  points, elem = scenes.triangular(0.06, 0.052, 12, 12)
  return points - points.mean(axis=0), elem


def document(mesh=None, h=H, plate=False, **keys):
  """Returns a block, or another organ, with room for cuts, and a plate that can slide."""
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = h, (0, 0, 0)
  if plate:
    body = spec.worldbody.add_body(name="plate", pos=[0.035, 0, 0])
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0], name="x")
    body.add_geom(size=[0.001, 0, 0], mass=0.05, contype=0, conaffinity=0)
  given = {"mass": MASS, "young": YOUNG, "spare": 260, "damping": 0.01, "device": "cpu"}
  given |= {"elements": "solid"} if mesh is None else {}
  palpate.add_organ(spec, mesh or block(), "organ", **given | keys)
  return spec


def scene(mesh=None, plate=False, **keys):
  """Returns model, data and organ of a document; the plate is at the organ's end."""
  model, data, organ = scenes.load(document(mesh, plate=plate, **keys))
  mujoco.mj_forward(model, data)
  if plate:
    organ.attach(np.flatnonzero(block()[0][:, 0] > 0.0299), "plate")
  return model, data, organ


def across(organ):
  """Cuts an organ in two at x = 0."""
  half = 0.5 * np.ptp(organ.xpos0[np.isfinite(organ.xpos0).all(axis=1)], axis=0)
  report = organ.cut([[0, y, half[2]] for y in np.linspace(-half[1], half[1], 9)])
  assert len(organ.pieces) == 2 and not report.stopped


def sides(organ):
  """Returns the vertices left and right of the cut."""
  return sorted((piece.vertices for piece in organ.pieces), key=lambda v: organ.xpos0[v, 0].mean())


def overlap(organ):
  """Returns how far the left part reaches beyond the right one, along x [m]."""
  left, right = sides(organ)
  return organ.xpos[left, 0].max() - organ.xpos[right, 0].min()


def thrown(organ, speed, gap=0.0):
  """Throws both parts of an organ at each other, from some way apart [m/s, m]."""
  toward = np.zeros((organ.nvert, 3))
  for side, vert in zip((1, -1), sides(organ), strict=True):
    toward[vert, 0] = side
  there = np.where(np.isfinite(organ.xpos0), organ.xpos0, 0.0)
  organ.set_state(there - 0.5 * gap * toward, speed * toward)


@BOTH
def test_a_cut_block_under_pressure_carries_it_as_a_whole_one_does(windows, device):
  shorter = []
  for cut in (False, True):
    pin = np.flatnonzero(block()[0][:, 0] < -0.0299)
    model, data, organ = scene(windows=windows, pin=pin, plate=True, device=device)
    if cut:
      across(organ)
    data.qfrc_applied[model.joint("x").dofadr[0]] = -0.5
    mujoco.mj_step(model, data, 600)
    assert np.abs(organ.xvel[organ.free]).max() < 1e-4  # so what presses is borne
    shorter.append(-data.joint("x").qpos[0])
  # 333 Pa over lips ten times as stiff by area as an edge: 3.3 % of a tenth of one, 0.033 mm.
  assert 2e-5 < shorter[1] - shorter[0] < 8e-5
  assert shorter[0] > 1.9e-3
  assert 0 < overlap(organ) < 1.5e-4


@BOTH
def test_lips_open_freely(windows):
  model, data, organ = scene(windows=windows, plate=True)
  across(organ)
  left, _ = sides(organ)
  data.qfrc_applied[model.joint("x").dofadr[0]] = 0.5
  mujoco.mj_step(model, data, 50)
  assert np.abs(organ.displacement[left]).max() < 2e-5
  mass = 0.05 + organ.pieces[0].mass
  assert data.joint("x").qvel[0] == pytest.approx(0.5 / mass * 50 * H, rel=0.1)
  assert overlap(organ) < -1e-3


def test_lips_of_strained_tissue_lie_on_each_other_once_they_are_cut():
  """What a cut has to take of the energy is not taken by pushing one side through the other."""
  _, _, organ = scene(windows=True)
  there = np.where(np.isfinite(organ.xpos0), organ.xpos0, 0.0)
  shorter = np.where(there[:, :1] < 0, 0.9, 0.7) * [1, 0, 0] + [0, 1, 1]
  organ.set_state(there * shorter, 0 * there)
  before = organ.energy
  across(organ)
  assert organ.energy < (1 + 1e-7) * before
  left, right = sides(organ)
  far, twin = cKDTree(organ.xpos0[right]).query(organ.xpos0[left])
  pair = far < 1e-9
  gap = organ.xpos[right[twin[pair]], 0] - organ.xpos[left[pair], 0]
  assert pair.sum() > 10 and gap.min() > -2e-5


SHEET = {"young": 1e5, "thickness": 2e-3, "mass": 0.02}
KINDS = pytest.mark.parametrize(
  ("mesh", "keys"),
  [
    # All of its vertices are on its skin.
    (scenes.box((0.06, 0.02, 0.01), 0.01), {"elements": "solid", "mass": 0.012}),
    (sheet(), SHEET | {"bend": 1.0}),
    (sheet(), SHEET | {"bend": 0.0}),
  ],
  ids=["solid", "plate", "membrane"],
)


@KINDS
@pytest.mark.parametrize("h", [5e-4, 2e-3, 5e-3])
def test_parts_that_are_thrown_at_each_other_stop_or_bounce_and_gain_no_energy(mesh, keys, h):
  model, data, organ = scene(mesh, h=h, windows=True, tolerance=1e-6, **keys)
  across(organ)
  thrown(organ, 0.2, gap=2e-3)
  left, right = sides(organ)
  momentum, energy, most = [], [], 0.0
  for _ in range(round(0.2 / h)):
    mujoco.mj_step(model, data)
    momentum.append(organ.mass @ organ.xvel)
    energy.append(organ.energy + 0.5 * organ.mass @ (organ.xvel**2).sum(axis=1))
    most = max(most, overlap(organ))
  assert max(energy) <= energy[0] * (1 + 1e-6)
  assert 0 < most < 1.5e-3
  np.testing.assert_allclose(momentum, 0 * np.array(momentum) + momentum[0], atol=2e-5 * 0.2)
  assert organ.xvel[left, 0].mean() < 1e-4 and organ.xvel[right, 0].mean() > -1e-4
  assert organ.error is None


def test_lips_that_have_left_each_other_touch_nothing():
  """Two edges deep in each other they feel no force: a flap may be folded over its wound."""
  model, data, organ = scene(windows=True)
  across(organ)
  thrown(organ, 0.0, gap=-2 * EDGE)
  mujoco.mj_step(model, data, 5)
  assert np.abs(organ.xvel[np.isfinite(organ.xpos0).all(axis=1)]).max() < 1e-6


@KINDS
@pytest.mark.parametrize("device", ["cpu", "warp-cpu", pytest.param("cuda:0", marks=needs_cuda)])
def test_lips_in_a_batch_do_as_in_the_plugin(mesh, keys, device):
  batch = palpate.batch.make(document(mesh, windows=True, **keys), 3, device=device, nodes=40)
  model, data, organ = scenes.load(batch.model)
  across(organ)
  thrown(organ, 0.2, gap=1e-3)
  batch.set_state(1, data)
  left, right = sides(organ)
  gone = []
  for _ in range(20):
    mujoco.mj_step(model, data, 2)
    batch.step(2)
    gone.append(overlap(organ))
  assert max(gone) > 0  # they met
  xpos = batch.organ("organ").xpos.numpy()
  np.testing.assert_allclose(xpos[1][: organ.nvert], organ.xpos, atol=2e-5)
  assert xpos[1, left, 0].max() - xpos[1, right, 0].min() < 1e-3
  rest = np.isfinite(xpos[0]).all(axis=1)
  np.testing.assert_allclose(xpos[0][rest], xpos[2][rest], atol=1e-9)
  assert not batch.failures.numpy().any()
  batch.reset(np.array([False, True, False]))
  batch.step(3)
  xpos = batch.organ("organ").xpos.numpy()
  np.testing.assert_allclose(xpos[1][rest], xpos[0][rest], atol=1e-7)
