"""Threads through an organ: how they slide, hold cuts closed, and tear the tissue."""

from typing import Any

import mujoco
import numpy as np
import palpate
import pytest
from palpate.tasks.metrics import knots
from scenes import state
from scenes.needles import (
  ENERGY,
  LENGTH,
  LOWER,
  RADIUS,
  SHEET,
  STEP,
  THICK,
  drive,
  load,
  pull,
  scene,
  sheet,
  wall,
)


def test_a_thread_slides_through_a_hole_as_around_a_capstan():
  """It follows the needle, holds up to T exp(mu theta), slides from there on, and tears the hole.

  That bears G by the sheet's thickness of both strands.
  """
  mu, nodes = 0.3, 24
  contact = {"contact": {"friction": mu}}
  one = {"pos": (0.017, 0, 0), "needles": f"needle {ENERGY}", "foundation": 3e7}
  model, data, organ = load(scene(nodes=nodes, suture=contact, **one))
  model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # the hole alone
  drive(model, data, organ, [5.0])
  (hole,) = organ.pinholes
  assert hole.thread and hole.along < -8e-3
  at = state(model, data)
  other = mujoco.MjData(model)
  mujoco.mj_setState(model, other, at, mujoco.mjtState.mjSTATE_INTEGRATION)
  for each in (data, other):
    mujoco.mj_step(model, each, 20)
  assert np.array_equal(data.qpos, other.qpos)
  tail = np.array([0.98, 0, 0.2])
  for _ in pull(model, data, {nodes - 1: 0.3 * tail}, 0.001, 1.0, 400):
    pass
  head = np.array([-0.2, 0, -0.98])
  data.eq_active[:] = 0
  for _ in pull(model, data, {0: 0.3 * head}, 1.0, 1.0, 100):
    pass
  start, held = organ.pinholes[0].along, 1.0
  for k, _ in enumerate(pull(model, data, {0: 0.3 * head}, 1.0, 1.8, 800)):
    held = 1.0 + 0.8 * k / 800
    if not organ.pinholes or abs(organ.pinholes[0].along - start) > 5e-4:
      break
  angle = np.arccos(-(tail @ head) / np.linalg.norm(tail))
  assert held == pytest.approx(np.exp(mu * angle), rel=0.03)
  assert palpate.Thread(model, data, "suture").error is None
  aside = np.array([0.0, 0.8, 0.6])
  (hole,) = tears_at(model, data, organ, {0: aside, nodes - 1: aside * (1, 1, -1)}, 1.2)
  assert np.linalg.norm(hole.force) == pytest.approx(ENERGY * THICK, rel=0.03)


def test_holes_that_meet_on_a_thread_slide_on_together():
  """Two strands draw a bite up until its holes meet, and rest there; they share what friction is.

  Pulled on at one end, the thread goes round both: T exp(mu pi). It slid by itself before.
  """
  mu, edge, up = 0.3, 1e-3, 0.03
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = STEP, (0, 0, 0)
  line = np.array([(1.1e-3, 0, up), (1.1e-3, 0, -2e-4), (-1.1e-3, 0, -2e-4), (-1.1e-3, 0, up)])
  nodes = int(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() / edge) + 1
  straight = line[0] + edge * np.arange(nodes)[:, None] * (0, 0, 1)
  contact = {"friction": mu, "contype": 0, "conaffinity": 0}
  palpate.add_thread(spec, straight, "suture", strength=0, bend=0, contact=contact)
  aside = spec.worldbody.add_body(name="hand", pos=line[0] + (0, RADIUS, 0))
  palpate.add_needle(spec, length=LENGTH, parent=aside, thread="suture")
  spec.equality("needle_suture").active = False
  surface, rim = sheet()
  given = SHEET | {"young": 1e5, "mass": 0.05, "damping": 0.01, "pin": rim, "device": "cpu"}
  palpate.add_organ(spec, surface, needles="needle 8000", **given)
  model, data, organ = load(spec)
  palpate.Thread(model, data, "suture").lay(line)
  organ.sew("needle")
  head, tail = ({node: np.array([0.0, 0.0, 0.2])} for node in (0, nodes - 1))
  for start, end in ((0.001, 1.0), (1.0, 1.0)):
    for _ in pull(model, data, head | tail, start, end, 300):
      pass
  assert np.abs(organ.xvel).max() < 1e-5
  rest, held, between = organ.pinholes[0].along, 1.0, []
  for k, _ in enumerate(pull(model, data, head, 1.0, 3.5, 1000)):
    held = 1.0 + 2.5 * k / 1000
    first, second = organ.pinholes
    between.append(second.along - first.along)
    if abs(first.along - rest) > edge:
      break
  assert held == pytest.approx(np.exp(mu * np.pi), rel=0.1)
  assert between[-1] == pytest.approx(2 * edge)  # one edge of it is in neither hole
  assert min(between) > 2 * edge - 1e-9
  assert organ.error is None


def test_a_thread_goes_through_both_layers_of_a_wall_and_tears_the_weaker_one():
  """It follows the needle down and up, four holes in all; layers in touch do not pinch it.

  Each bears G by its own thickness. Pulled aside at both ends, the lower one tears.
  """
  model, data, organ = load(wall(nodes=28, free=True))
  thread, lower = palpate.Thread(model, data, "suture"), palpate.Organ(model, data, "lower")
  start, taut = data.ctrl[0], 0.0
  for k in range(700):
    data.ctrl[0] = start + 6.1 * (k + 1) / 700
    mujoco.mj_step(model, data)
    taut = max(taut, thread.tension.max())
  holes = [hole for pair in zip(organ.pinholes, lower.pinholes, strict=True) for hole in pair]
  assert all(hole.thread for hole in holes)
  first, down, out, up = (holes[k].along for k in (0, 1, 3, 2))
  assert first < down < out < up < 0
  assert taut < 0.5
  for each in (organ, lower, thread):
    assert each.error is None
  nodes, pos = 24, (0.017, 0, 0)
  model, data, organ = load(wall(nodes=nodes, pos=pos, foundation=3e7))
  lower = palpate.Organ(model, data, "lower")
  model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # the holes alone
  drive(model, data, organ, [5.0])
  assert organ.pinholes[0].thread and lower.pinholes[0].thread
  data.eq_active[:] = 0
  aside, apart = np.array([0.0, 1.0, 0.0]), np.array([0.1, 0.0, 0.0])
  ends = {0: aside + apart, nodes - 1: aside - apart}  # a hairpin would rest on a node, to and fro
  for _ in pull(model, data, ends, 0.001, 0.3, 300):
    pass
  (hole,) = tears_at(model, data, lower, ends, 1.1, start=0.3)
  bears = 300 * LOWER["thickness"]
  assert np.linalg.norm(hole.force) == pytest.approx(bears, rel=0.03)
  assert organ.pinholes[0].torn == 0
  assert 0.5 * bears < np.linalg.norm(organ.pinholes[0].force) < ENERGY * THICK


@pytest.mark.parametrize(("along", "across", "back"), [(1.6e-3, 2e-3, True), (3e-4, 1e-3, False)])
def test_a_hole_goes_back_from_the_thread_onto_the_needle(along, across, back):
  """Tissue that springs along and across in a step keeps its hole: on the needle if it is there.

  Behind the swage it stays on the thread, which a hole that went to and fro would throw.
  """
  model, data, organ = load(scene(nodes=12, pos=(0.017, 0, 0)))
  drive(model, data, organ, [3.5])
  assert organ.pinholes[0].thread
  ahead = data.site("needle_swage").xmat.reshape(3, 3)[:, 2]
  aside = data.body("suture_2").xpos - data.body("suture_3").xpos
  aside = np.array((0, 1, 0)) if back else aside - (aside @ ahead) * ahead
  way = along * ahead + across * aside / np.linalg.norm(aside)
  for k in range(model.njnt):
    if model.body(model.jnt_bodyid[k]).name.startswith("organ_"):
      data.qpos[model.jnt_qposadr[k]] += model.jnt_axis[k] @ way
  mujoco.mj_step(model, data)
  (hole,) = organ.pinholes
  assert hole.thread != back
  assert abs(hole.along) < 2e-3


def test_a_needle_draws_its_thread_through_both_lips():
  """Over a cut that gapes it goes in on one side and out on the other."""
  spec = scene(nodes=28, spare=20, tension=30.0, young=1e5, needles=f"needle {ENERGY} 10")
  model, data, organ = load(spec)
  organ.cut([(0, y, 0) for y in np.linspace(-0.008, 0.008, 12)])
  mujoco.mj_step(model, data, 100)
  lips = np.flatnonzero(np.abs(organ.xpos0[:, 0]) < 1e-4)
  assert np.ptp(organ.xpos[lips, 0]) > 3e-3
  drive(model, data, organ, [5.9])
  first, second = organ.pinholes
  assert first.thread and second.thread
  assert first.rest[0] > 3e-3 and second.rest[0] < -3e-3
  assert first.along < second.along


def seam(count, bite, pitch, depth):
  """Returns a running stitch across x = 0, from where the needle leaves it to where it begins."""
  turn = np.linspace(0.0, 2 * count - 1, 2000 * count)  # odd turns are above, where it goes on
  y = pitch * (turn // 2 + np.maximum(turn % 2 - 1, 0.0) - (count - 1) / 2)
  across, up = bite * np.cos(np.pi * turn), -depth * np.sin(np.pi * turn)
  points = np.stack([across, y, up], axis=1)
  ahead = np.linspace(1, 0, 1000, endpoint=False)[:, None]
  start, end = points[0] + ahead * (0, 0, 2e-3), points[-1] + ahead * (0, 8e-3, 0.02)
  return np.concatenate([end, points[::-1], start[::-1]])


def wound(line, half, size=0.04, n=13, sewn=True, held=lambda x: np.abs(x).max(axis=1), **config):
  """Returns a sheet, held at its rim, with a cut along x = 0 that a thread on a line joins.

  The thread ends in a bead at its first hole; behind the last one the needle holds it.
  """
  spec, edge = mujoco.MjSpec(), 1.5e-3
  spec.option.timestep, spec.option.gravity = STEP, (0, 0, 0)
  nodes, last = 2, line[0]
  for point in line:  # edges are chords of the line
    if np.linalg.norm(point - last) >= edge:
      nodes, last = nodes + 1, point
  straight = line[0] + edge * np.arange(nodes)[:, None] * (0, 0, 1)
  palpate.add_thread(spec, straight, "suture", strength=0, bead=1e-3)
  spec.worldbody.add_body(name="hand", pos=line[0] + (0, RADIUS, 0))
  palpate.add_needle(spec, length=LENGTH, parent="hand", thread="suture")
  surface, rim = sheet(n, size)
  pin = rim[held(surface[0][rim]) > 0.499 * size]
  given = SHEET | {"damping": 0.01, "pin": pin, "spare": 60, "device": "cpu"} | config
  palpate.add_organ(spec, surface, needles="needle 800 15", **given)
  model, data, organ = load(spec)
  organ.cut([(0, y, 0) for y in np.linspace(-half, half, 20)])
  thread = palpate.Thread(model, data, "suture")
  if sewn:
    thread.lay(line)
    organ.sew("needle")
  return model, data, organ, thread


def gaps(organ, half):
  """Returns how far a cut gapes at its vertices within some of its length [m]."""
  rest = organ.xpos0
  lips = np.flatnonzero((np.abs(rest[:, 0]) < 1e-6) & (np.abs(rest[:, 1]) < half))
  pairs = lips[np.argsort(rest[lips, 1], kind="stable")].reshape(-1, 2)
  return np.abs(np.diff(organ.xpos[pairs, 0], axis=1))[:, 0]


def crossing(thread):
  """Returns the tension across x = 0 of each strand there [N]."""
  x, ways = thread.positions, np.diff(thread.positions, axis=0)
  there = x[1:, 0] * x[:-1, 0] < 0
  return thread.tension[there] * np.abs(ways[there, 0]) / np.linalg.norm(ways[there], axis=1)


def test_a_running_stitch_holds_a_cut_closed():
  """Five stitches bear 0.6 N that pull two halves apart; without them these part.

  The tension of all strands across the cut is the pull.
  """
  force, size = 0.6, 0.04
  for sewn in (False, True):
    line = seam(5, 5e-3, 8e-3, 5e-4)
    model, data, organ, thread = wound(line, size / 2, size, sewn=sewn, held=lambda x: -x[:, 0])
    rim = np.flatnonzero(organ.xpos0[: 13 * 13, 0] > 0.499 * size)
    for k in range(450 if sewn else 100):
      for v in rim:
        data.body(f"organ_{v}").xfrc_applied[0] = force / len(rim) * min(1.0, k / 300)
      mujoco.mj_step(model, data)
    if not sewn:
      assert gaps(organ, 0.015).min() > 0.01
      continue
    assert organ.error is None and thread.error is None
    assert len(organ.pinholes) == 10
    assert gaps(organ, 0.015).max() < 1.2e-3
    assert len(crossing(thread)) == 9
    assert crossing(thread).sum() == pytest.approx(force, rel=0.01)


def test_stitches_hold_an_organ_with_windows_alike():
  """Holes are in the tissue, wherever the window is."""
  seen = []
  for windows in (False, {"tools": ["needle"]}):
    line = seam(4, 5e-3, 6e-3, 5e-4)
    model, data, organ, _ = wound(line, 0.012, tension=40.0, windows=windows)
    mujoco.mj_step(model, data, 80)
    seen.append([hole.at for hole in organ.pinholes])
    assert organ.error is None
  np.testing.assert_allclose(*seen, atol=2e-5)


@pytest.mark.slow
def test_stitches_close_a_cut_that_are_pulled_tight_one_after_the_other():
  """A surgeon's bites, 5 mm from the edge and 6 mm apart, in a wall under 40 N/m.

  Each strand above is pulled with 1 N, and held with half of that until the next one is. A pull at
  the end alone leaves the first stitches loose: friction at each hole takes its share.
  """
  tension, half = 40.0, 0.012
  made = {"size": 0.06, "n": 19, "tension": tension}
  model, data, organ, thread = wound(seam(4, 5e-3, 6e-3, 1.5e-3), half, sewn=False, **made)
  mujoco.mj_step(model, data, 200)
  assert gaps(organ, half).max() > 2e-3
  for first in (0, 3):
    model, data, organ, thread = wound(seam(4, 5e-3, 6e-3, 1.5e-3), half, **made)
    mujoco.mj_step(model, data, 200)
    way, before = np.array([0, 0.9, 0.44]), None
    for stitch in range(first, 4):
      places = [-hole.along for hole in organ.pinholes] + [0.0]
      at = data.body(f"suture_{round(0.5 * sum(places[2 * stitch + 1 : 2 * stitch + 3]) / 1.5e-3)}")
      for k in range(300):
        at.xfrc_applied[:3] = min(1.0, k / 150) * way
        if before is not None:
          before.xfrc_applied[:3] = 0.5 * max(0.0, 1 - max(0, k - 100) / 150) * way
        mujoco.mj_step(model, data)
      at.xfrc_applied[:3], before = 0.5 * way, at
    mujoco.mj_step(model, data, 300)
    assert organ.error is None and thread.error is None
    assert len(organ.pinholes) == 8
    if first:
      assert gaps(organ, half).max() > 7e-4, gaps(organ, half)
      continue
    assert gaps(organ, half).max() < 7e-4
    assert crossing(thread).sum() > 2 * half * tension  # it carries what the cut does not


def test_a_thread_is_sewn_through_a_solid():
  """It goes in where it comes from its end, and out toward the needle."""
  model, data, organ = load(scene(solid=True, height=0.03, nodes=60))
  thread = palpate.Thread(model, data, "suture")
  before = thread.positions
  thread.lay([before[0], (-0.03, 0, 0.005), (0.05, 0, 0.005)])
  edges = [np.linalg.norm(np.diff(x, axis=0), axis=1) for x in (before, thread.positions)]
  np.testing.assert_allclose(*edges, rtol=1e-9)
  organ.sew("needle")
  entry, out = organ.pinholes
  assert entry.rest[0] > 0.02 and out.rest[0] < -0.02
  assert entry.along < out.along < 0
  mujoco.mj_step(model, data, 50)
  assert len(organ.pinholes) == 2
  assert organ.error is None and thread.error is None


def test_what_cannot_be_sewn_is_told():
  for nodes, name, message in (
    (0, "pin", "needle 'pin' is not in its needles, expected one of needle"),
    (0, "needle", "has no thread, expected one joined by `add_needle`"),
    (8, "needle", "crosses the surface 0 times, expected 1"),
  ):
    organ = load(scene(nodes=nodes))[2]
    with pytest.raises(ValueError, match=message):
      organ.sew(name)
  spec = mujoco.MjSpec()
  palpate.add_thread(spec, np.linspace((0, 0, 0), (0.01, 0, 0), 8), pin=[0])
  model = spec.compile()
  thread = palpate.Thread(model, mujoco.MjData(model), "thread")
  with pytest.raises(
    ValueError, match="thread 'thread' has pinned nodes, expected one without"
  ):
    thread.lay([(0, 0, 0), (1, 0, 0)])


def tears_at(model, data, organ, ends, most, start=0.0):
  """Pulls at nodes by rising forces [N]; returns pinholes as they were before the first tore."""
  before = organ.pinholes
  for _ in pull(model, data, ends, start, most, 500):
    if organ.pinholes[0].torn > before[0].torn + 1e-5:
      return before
    before = organ.pinholes
  raise AssertionError("it has not torn")


def test_a_thread_that_turns_in_a_hole_tears_the_sheet_along_its_plane():
  """Half of its pull is off the sheet, where nothing can tear: the hole was lost at once."""
  nodes = 24
  one = {"pos": (0.017, 0, 0), "needles": f"needle {ENERGY}", "foundation": 3e7}
  model, data, organ = load(scene(nodes=nodes, **one))
  model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # the hole alone
  drive(model, data, organ, [5.0])
  data.eq_active[:] = 0
  below, aside = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
  torn, way = [], []
  for _ in pull(model, data, {0: below, nodes - 1: aside}, 0.001, 1.5, 900):
    if not organ.pinholes:
      break
    torn.append(organ.pinholes[0].torn)
    way.append(organ.pinholes[0].rest)
  assert organ.error is None
  assert max(torn) > 2e-3
  gone = way[-1] - way[0]
  assert gone[1] > 0.9 * np.linalg.norm(gone)


@pytest.mark.parametrize("windows", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_thread_follows_through_a_solid_and_tears_it(windows):
  """Of a bite each pinhole bears G by half the way to the other one."""
  nodes, energy = 14, 40.0
  law, room = f"needle {energy} 0 60", {"nodes": 150} if windows else False
  given = {"height": 0.0175, "nodes": nodes, "windows": room}
  model, data, organ = load(scene(solid=True, needles=law, **given))
  drive(model, data, organ, [5.8], speed=8.0)
  first, second = organ.pinholes
  assert first.thread
  assert second.thread
  assert first.along < second.along - 0.01
  data.eq_active[:] = 0
  model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
  up = np.array([0.0, 0.0, 1.0])
  first, second = tears_at(model, data, organ, {0: up, nodes - 1: up}, 0.6)
  bears = energy * np.linalg.norm(second.at - first.at) / 2
  # Friction along the thread is part of the force, some 3 %.
  assert np.linalg.norm(first.force) == pytest.approx(bears, rel=0.05)


@pytest.mark.parametrize("knotted", [True, False])
def test_a_knot_does_not_go_through_a_hole(knotted):
  """Drawn tight and pulled at one end, it stops there, and the hole bears the pull."""
  edge, way = 4.5e-4, np.array([0.0, 0.0, 1.0])
  t = np.linspace(-2.1, 2.1, 161 if knotted else 2)
  knot = np.stack([t**3 - 3 * t, t**4 - 4 * t**2, 0.2 * t**5 - 2 * t], axis=1)  # an overhand knot
  knot -= knot[0]
  along = knot[-1] / np.linalg.norm(knot[-1])
  aside = np.cross(along, [0.0, 1.0, 0.0])
  aside /= np.linalg.norm(aside)
  knot = 1.2e-3 * knot @ np.column_stack([aside, np.cross(along, aside), along])
  line = np.concatenate([[(0, 0, -0.024)], knot, [knot[-1] + 0.012 * way]])
  line += (1e-3, 5e-4, 4e-3)
  count = int(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() / edge) + 1
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = STEP, (0, 0, 0)
  straight = line[0] + edge * np.arange(count)[:, None] * way
  contact = {"friction": 0.3, "contype": 0, "conaffinity": 0}
  palpate.add_thread(spec, straight, "suture", strength=0, iterations=1000, contact=contact)
  hand = spec.worldbody.add_body(name="hand", pos=line[0] + (0, RADIUS, 0))
  palpate.add_needle(spec, length=LENGTH, parent=hand, thread="suture")
  spec.equality("needle_suture").active = False
  surface, rim = sheet()
  given: dict[str, Any] = SHEET | {"foundation": 3e7, "pin": rim, "device": "cpu"}
  palpate.add_organ(spec, surface, needles=f"needle {ENERGY}", **given)
  model, data, organ = load(spec)
  thread = palpate.Thread(model, data, "suture")
  thread.lay(line)
  organ.sew("needle")
  tied = (1,) if knotted else ()
  assert knots.throws(knots.closed(thread.positions)) == tied
  ends = {0: -0.3 * way, count - 1: 0.3 * way}
  for start, stop, steps in ((0.01, 1.0, 400), (1.0, 1.0, 200)):
    for _ in pull(model, data, ends, start, stop, steps):
      pass
  for _ in pull(model, data, {count - 1: 0.3 * way}, 1.0, 0.03, 400):
    if not organ.pinholes:
      break
  if not knotted:
    assert not organ.pinholes
    return
  place = organ.pinholes[0].along
  for _ in pull(model, data, {0: -0.3 * way}, 1.0, 4.0, 400):
    pass
  assert organ.pinholes[0].along == pytest.approx(place, abs=0.1 * edge)
  assert organ.pinholes[0].force[2] == pytest.approx(-1.2 + 0.009, rel=0.02)
  assert knots.throws(knots.closed(thread.positions)) == tied


def test_a_thread_rests_on_the_wall_beside_its_hole():
  """Drawn over the wall, it presses on it, loses some of the pull by friction, and comes to rest.

  Beside the hole it is stiff in some directions and slack in others, and the wall is light: its
  tension was up to 14 times the pull there, another one in each step.
  """
  edge, force = 4.5e-4, 0.1
  line = np.array([(1e-3, 5e-4, -0.02), (1e-3, 5e-4, 5e-4), (9e-3, 5e-4, 8e-4)])
  count = int(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() / edge) + 1
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = STEP, (0, 0, 0)
  spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
  straight = line[0] + edge * np.arange(count)[:, None] * (0, 0, 1)
  contact = {"margin": 6e-4, "friction": 0.3}
  palpate.add_thread(spec, straight, "suture", strength=0, drag=2e-3, contact=contact)
  hand = spec.worldbody.add_body(name="hand", pos=line[0] + (0, RADIUS, 0))
  palpate.add_needle(spec, length=LENGTH, parent=hand, thread="suture")
  spec.equality("needle_suture").active = False
  surface, rim = sheet(15)
  latex = {"mass": 5e-4, "young": 1e6, "thickness": 5e-4, "damping": 3e-3, "pin": rim}
  palpate.add_organ(spec, surface, needles="needle 10000 600", device="cpu", **latex)
  model, data, organ = load(spec)
  thread = palpate.Thread(model, data, "suture")
  thread.lay(line)
  organ.sew("needle")
  ends = {0: np.array([0, 0, -force]), count - 1: force * np.array([1.0, 0, -0.1])}
  for start, stop, steps in ((0.01, 1.0, 300), (1.0, 1.0, 200)):
    for _ in pull(model, data, ends, start, stop, steps):
      pass
  taut, fastest = [], 0.0
  for _ in pull(model, data, ends, 1.0, 1.0, 50):
    taut.append(thread.tension.copy())
    fastest = max(fastest, float(np.abs(data.qvel).max()))
  assert organ.contact_force[:, 2].sum() < -5e-3  # it lies on the wall
  assert np.max(taut) < 1.05 * force
  assert fastest < 2e-3  # [m/s]
  assert 0.7 * force < np.min(taut[-1]) < 0.95 * force
