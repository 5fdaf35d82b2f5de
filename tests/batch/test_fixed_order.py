"""Batches that repeat to the bit: rows of constraints are in an order of their own."""

import contextlib

import mujoco
import numpy as np
import palpate.batch
import pytest
import warp as wp
from devices import needs_cuda
from palpate.batch.contact.fixed_order import FixedOrder, is_enough, sort_matches
from palpate.batch.mjw.private import ConstraintState, solver
from scenes import probed

ROWS = ("type", "id", "J_rownnz", "J_rowadr", "pos", "margin", "D", "vel", "aref", "frictionloss")


def pressed(device):
  """Returns a batch whose probes press on the organ, and slide."""
  spec = mujoco.MjSpec.from_string(probed())
  spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
  batch = palpate.batch.make(spec, 3, device, deterministic=True)
  for k in range(40):
    batch.ctrl = np.array([[-0.0002 * k, 0.0], [-0.00015 * k, 0.0001 * k], [0.0, 0.0]])
    batch.step()
  return batch


def shuffle(batch, random):
  """Lets contacts have asked for their rows in another order."""
  efc, contact = batch.d.efc, batch.d.contact
  count, adr = batch.d.nefc.numpy(), contact.efc_address.numpy().copy()
  arrays = {name: getattr(efc, name).numpy().copy() for name in ROWS}
  blocks = efc.jtdaj_adr.numpy(), efc.jtdaj_nrow.numpy()
  for w in range(batch.nworld):
    n, number = int(count[w]), int(efc.jtdaj_nblock.numpy()[w])
    own = {first: k for k, first in enumerate(blocks[0][w, :number])}
    mixed = random.permutation(sorted(own))
    order = np.concatenate([first + np.arange(blocks[1][w, own[first]]) for first in mixed] or [[]])
    order = order.astype(int)
    assert len(order) == n
    place = np.argsort(order)
    for values in arrays.values():
      values[w, :n] = values[w, order]
    mine = np.flatnonzero((contact.worldid.numpy() == w) & (adr[:, 0] >= 0))
    mine = mine[mine < batch.d.nacon.numpy()[0]]
    adr[mine] = np.where(adr[mine] >= 0, place[np.maximum(adr[mine], 0)], -1)
  for name, values in arrays.items():
    getattr(efc, name).assign(values)
  contact.efc_address.assign(adr)


def rows(batch):
  """Returns what rows there are, and which contacts have them."""
  efc, contact = batch.d.efc, batch.d.contact
  found = {"address": [contact.efc_address.numpy()[: batch.d.nacon.numpy()[0]].copy()]}
  for name in ROWS:
    worlds = zip(getattr(efc, name).numpy(), batch.d.nefc.numpy(), strict=True)
    found[name] = [values[:n].copy() for values, n in worlds]
  return found


def equal(a, b):
  return all(np.array_equal(x, y) for name in a for x, y in zip(a[name], b[name], strict=True))


def test_rows_come_in_the_same_order_whoever_asked_first():
  batch = pressed("warp-cpu")
  order = FixedOrder(batch.m, batch.d)
  order.sort()
  first = rows(batch)
  assert min(batch.d.nefc.numpy()[:2]) >= 6
  shuffle(batch, np.random.RandomState(0))
  assert not equal(rows(batch), first)
  order.sort()
  assert equal(rows(batch), first)


@pytest.mark.parametrize("device", ["warp-cpu", pytest.param("cuda:0", marks=needs_cuda)])
def test_contacts_of_geoms_come_in_the_same_order_whoever_was_first(device):
  """In each world by geoms and their number, with all that is known of them."""
  batch = palpate.batch.make(mujoco.MjSpec.from_string(probed()), 3, device, deterministic=True)
  order, contact, random = FixedOrder(batch.m, batch.d), batch.d.contact, np.random.RandomState(0)
  key = np.array([(w, 2, g, n) for w in (0, 2) for g in (3, 5) for n in range(3)])
  count = len(key)

  def told(key):
    """Returns what contacts say that are told apart by world, geoms and number."""
    out = {"worldid": key[:, 0], "geom": key[:, 1:3], "geomcollisionid": key[:, 3]}
    return out | {"dist": key @ [1e3, 0, 10, 1], "pos": key[:, [0, 2, 3]]}

  for _ in range(5):
    for name, values in told(random.permutation(key)).items():
      array = getattr(contact, name)
      whole = array.numpy()
      whole[:count] = values
      array.assign(whole)
    batch.d.nacon.fill_(count)
    order.sort_contacts()
    world = contact.worldid.numpy()[:count]
    for name, values in told(key).items():
      found = getattr(contact, name).numpy()[:count]
      for w in (0, 2):
        np.testing.assert_array_equal(found[world == w], values[key[:, 0] == w], err_msg=name)


def test_contacts_of_a_sensor_come_in_the_same_order_whoever_was_first():
  """By the sensor's criterion, then by their places; ~ where its body is the second."""
  random, most = np.random.RandomState(0), 16
  for n in range(most):
    places = random.permutation(40)[:n]
    match = np.full(most, -1)
    match[:n] = np.where(random.rand(n) < 0.5, places, ~places)
    by = np.full(most, 1e32)
    by[:n] = random.randint(3, size=n)
    order = np.lexsort((places, by[:n]))
    found, criterion = (
      wp.array(values[None, None], dtype=kind, device="cpu")
      for values, kind in ((match, int), (by, float))
    )
    sensor = [wp.zeros((1, 3), dtype=int, device="cpu"), wp.zeros(1, dtype=int, device="cpu")]
    count = wp.array([[n]], dtype=int, device="cpu")
    inputs = [*sensor, count, found, criterion, found]
    wp.launch_tiled(sort_matches(most), dim=(1, 1), inputs=inputs, device="cpu", block_dim=64)
    assert found.numpy()[0, 0, :n].tolist() == match[:n][order].tolist()


@pytest.mark.parametrize("device", ["warp-cpu", pytest.param("cuda:0", marks=needs_cuda)])
def test_runs_repeat_to_the_bit(device):
  a, b = (pressed(device) for _ in range(2))
  for name in ("qpos", "qvel", "sensordata"):
    assert np.array_equal(getattr(a, name).numpy(), getattr(b, name).numpy()), name
  found = [each.organ("organ").contact_force.numpy() for each in (a, b)]
  assert np.array_equal(found[0], found[1]) and np.abs(found[0]).max() > 0.01


def test_gradient_and_hessian_are_those_of_mujoco_warp():
  """Of contacts with all kinds of friction that slide, so that forces are on their cones."""
  spec = mujoco.MjSpec.from_string(probed(condim=6, cone="elliptic"))
  for each in (*spec.geoms, *spec.flexes):
    each.friction[0] = 0.05
  batch = palpate.batch.make(spec, 3, "warp-cpu", deterministic=True)
  for k in range(25):
    batch.ctrl = np.array([[-0.0002 * k, 0.0004 * k], [-0.0002 * k, -0.0004 * k], [0.0, 0.0]])
    batch.step()
  m, d, order, found = batch.m, batch.d, FixedOrder(batch.m, batch.d), []
  order.sort()
  for adding in (contextlib.nullcontext, order.adding):
    context = solver._create_solver_context(m, d)
    with adding():
      solver.init_context(m, d, context)
    sums = context.grad, context.grad_dot, d.qfrc_constraint
    matrix = np.triu(context.h.numpy()[:, : m.nv, : m.nv])
    found.append([matrix, *(values.numpy().copy() for values in sums)])
  assert (d.efc.state.numpy()[:2] == ConstraintState.CONE).any(axis=1).all()
  for values in zip(*found, strict=True):
    np.testing.assert_allclose(*values, rtol=1e-5, atol=1e-8)  # digits of float32


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_touch_sensors_feel_what_those_of_mujoco_warp_do(cone):
  felt = []
  for deterministic in (False, True):
    spec = mujoco.MjSpec.from_string(probed(cone=cone))
    for size in (0.02, 1e-6):  # the second one sees no contact
      spec.body("tool").add_site(name=f"skin {size}", size=[size, 0, 0])
      spec.add_sensor(
        name=f"{size}", type=mujoco.mjtSensor.mjSENS_TOUCH, objname=f"skin {size}",
        objtype=mujoco.mjtObj.mjOBJ_SITE,
      )  # fmt: skip
    batch = palpate.batch.make(spec, 2, "warp-cpu", deterministic=deterministic)
    for k in range(30):
      batch.ctrl = np.array([[-0.0002 * k, 0.0001 * k], [0.0, 0.0]])
      batch.step()
    felt.append(batch.sensordata.numpy())
  np.testing.assert_allclose(*felt, rtol=1e-3)
  assert felt[1][0, 0] > 0.01 and felt[1].ravel()[1:].max() == 0.0


def test_what_is_not_known_is_left_to_warp():
  batch = palpate.batch.make(mujoco.MjSpec.from_string(probed()), 1, "warp-cpu", deterministic=True)
  assert is_enough(batch.m, batch.bare)
  batch.bare.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
  assert not is_enough(batch.m, batch.bare)
