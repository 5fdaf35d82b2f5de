"""Nodes that move along a thread: short edges in knots, and nothing else changes."""

import mujoco
import numpy as np
import palpate
import pytest
from palpate.tasks.metrics import knots
from scenes import rods, threads
from scenes.threads import RADIUS, load, masses, overhand, pull_ends

REFINE = 2.2 * RADIUS
STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def uneven(n=41, length=0.06):
  """A straight line whose last edges are three times as long as the first ones."""
  x = np.cumsum(np.append(0.0, np.linspace(1.0, 3.0, n - 1)))
  return np.stack([length * x / x[-1], 0 * x, 0 * x], axis=1)


def test_a_taut_thread_keeps_its_tension_while_nodes_move():
  """Nothing touches, so edges become alike; a node that a hand holds stays where it is."""
  points, along = uneven(), (1, 0, 0)
  model, data, thread = load(points, ((0, (-1, 0, 0)), (40, along), (20, along)), refine=REFINE)
  data.ctrl[:2] = 0.3
  before = thread.rest_lengths
  for _ in range(400):
    mujoco.mj_step(model, data)
    if data.time > 0.1:
      np.testing.assert_allclose(thread.tension, 0.3, rtol=2e-3)
  after = thread.rest_lengths
  for half in (slice(0, 20), slice(20, 40)):
    assert after[half].sum() == pytest.approx(before[half].sum(), rel=1e-12)
    assert np.std(after[half][2:-2]) < 0.1 * np.std(before[half])
  assert thread.error is None


def test_momentum_is_kept_while_nodes_move():
  model, data, thread = load(uneven(), refine=REFINE)
  velocity = data.qvel.reshape(-1, 3)
  velocity[:, 1] = 0.2 * np.sin(50 * uneven()[:, 0])
  start = masses(thread) @ velocity
  for _ in range(50):
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(masses(thread) @ velocity, start, atol=1e-9 * np.abs(start).max())
  assert np.abs(masses(thread) - masses(load(uneven(), refine=REFINE)[2])).max() > 1e-9
  assert np.ptp(velocity[:, 1]) > 1e-3


def test_all_of_a_thread_falls_alike():
  text = rods.document(uneven(), refine=3e-4)
  model, data, thread = rods.loaded(text)
  mujoco.mj_step(model, data, 50)
  np.testing.assert_allclose(data.qvel.reshape(-1, 3)[:, 2], -9.81 * 0.05, rtol=1e-9)
  assert np.std(thread.rest_lengths) < 0.8 * np.std(np.diff(uneven()[:, 0]))


@pytest.mark.parametrize("segment", [6, 10])
def test_an_overhand_knot_with_coarse_edges_is_drawn_tight(segment):
  """With edges that keep their length 4.4 and 5.3 mm stay in the knot, with fine ones 2.5 mm."""
  points = overhand(0.0012, segment * RADIUS, 0.02)
  axis = points[-1] - points[0]
  axis /= np.linalg.norm(axis)
  model, data, thread = load(points, refine=REFINE)
  whole = thread.rest_lengths.sum()
  energies, grew = pull_ends(model, data, thread, axis, 400, masses)
  assert (grew[1:] < 0.01 * energies[1:-1]).all()  # it begins as bent as it is drawn
  places, length = thread.positions, thread.rest_lengths
  assert thread.length - np.linalg.norm(places[-1] - places[0]) < 3.2e-3
  assert knots.name(knots.closed(places, axis)) == "overhand"
  assert length.sum() == pytest.approx(whole, rel=1e-12)
  assert 0.75 * REFINE < length.min() < 1.2 * REFINE
  assert length.max() <= max(2.0 * length.mean(), segment * RADIUS)


def test_a_state_has_where_nodes_are():
  points = overhand(0.0012, 8 * RADIUS, 0.008)
  model, data, thread = load(points, ((0, points[0] - points[-1]),), bend=1e-3, refine=REFINE)
  data.ctrl[:] = 0.2
  mujoco.mj_step(model, data, 60)
  state, other = np.empty(mujoco.mj_stateSize(model, STATE)), mujoco.MjData(model)
  mujoco.mj_getState(model, data, state, STATE)
  mujoco.mj_step(model, other, 3)
  mujoco.mj_setState(model, other, state, STATE)
  twin = palpate.Thread(model, other, "t")
  np.testing.assert_array_equal(twin.tension, thread.tension)
  before = thread.rest_lengths
  for each in (data, other):
    mujoco.mj_step(model, each, 30)
  np.testing.assert_array_equal(other.qpos, data.qpos)
  np.testing.assert_array_equal(twin.rest_lengths, thread.rest_lengths)
  assert np.abs(thread.rest_lengths - before).max() > 1e-5
  mujoco.mj_resetData(model, data)
  np.testing.assert_allclose(thread.rest_lengths, np.linalg.norm(np.diff(points, axis=0), axis=1))


def test_pinholes_keep_their_place_along_a_thread():
  """A stitch whose strands rest in their holes: other edges are there now, at the same place."""
  model, data, thread = threads.stitch(300, segment=4 * RADIUS, refine=2.5 * RADIUS)
  organ = palpate.Organ(model, data, "organ")
  before = thread.rest_lengths
  found = []
  for k in range(200):
    data.ctrl[-2:] = min(1.0, k / 200)
    mujoco.mj_step(model, data)
    found.append([hole.along for hole in organ.pinholes])
  found = np.array(found)
  assert found.shape == (200, 2)
  assert np.ptp(found, axis=0).max() < 1e-4
  assert np.abs(np.cumsum(thread.rest_lengths - before)).max() > 3e-4
  assert thread.error is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 4, 13])
def test_nothing_goes_through_itself_while_nodes_move(seed):
  """Tangles that tighten."""
  points = threads.tangle(seed, 4 * RADIUS)
  before = knots.jones(knots.closed(points))
  thread, clear, through = threads.by_hands(points, 0.5, 250, bend=1e-4, refine=REFINE)
  assert clear and not through
  assert knots.jones(knots.closed(thread.positions)) == before
  assert np.abs(thread.rest_lengths - 4 * RADIUS).max() > RADIUS


@pytest.mark.parametrize(
  ("keys", "message"),
  [
    ({"refine": 3e-3}, "refine is 3 mm and its edges are 2 mm long, expected shorter ones"),
    ({"refine": 5e-5}, "refine is 0.05 mm .* no shorter than the radius, 0.1 mm"),
    ({"refine": 3e-4, "young": "1e9 " * 10}, "young has 10 values, expected one"),
    ({"refine": 3e-4, "pin": (3, 4)}, "edge 3 is between two pinned nodes"),
    ({"refine": 3e-4, "yield_strain": 0.02}, "refine is 0.3 mm and yield_strain is 0.02"),
  ],
)
def test_what_cannot_be_refined_is_named(keys, message):
  with pytest.raises(ValueError, match=f"thread 't': .*{message}"):
    rods.load(rods.line(11, 0.02), **keys)
