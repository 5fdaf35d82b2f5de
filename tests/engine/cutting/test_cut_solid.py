"""Cutting solids in a scene: state, pieces, walls that tools touch, both couplings."""

import mujoco
import numpy as np
import palpate
import pytest
import scenes
from palpate.engine.cutting import cuts
from scipy.spatial import cKDTree

FULL = mujoco.mjtState.mjSTATE_INTEGRATION
BOTH = pytest.mark.parametrize("windows", [False, True], ids=["nodal", "windows"])
KEYS = {"elements": "solid", "mass": 0.3, "young": 1e4, "spare": 260}


def block():
  return scenes.box((0.06, 0.05, 0.03), 0.009)


def scene(mesh=None, windows=True, gravity=(0, 0, 0), h=2e-3, **keys):
  """Returns model, data and an organ with room for cuts, below a ball on a slide."""
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = h, gravity
  body = spec.worldbody.add_body(name="ball", pos=[0, 0, 0.05], gravcomp=1)
  body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], name="z")
  body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.006, 0, 0], mass=0.1)
  scenes.servo(spec, "z", 400, 10)
  palpate.add_organ(spec, mesh or block(), "organ", windows=windows, **KEYS | keys)
  return scenes.load(spec)


def across(x=0.0, ends=0.025):
  """Returns a path over the top of the block."""
  return [[x, y, 0.015] for y in np.linspace(-ends, ends, 9)]


def run(model, data, steps, z=0.0):
  data.ctrl[0] = z
  mujoco.mj_step(model, data, steps)


@BOTH
def test_a_block_that_is_cut_through_falls_in_two(windows, device):
  points = block()[0]
  pin = np.flatnonzero(points[:, 0] < -0.0299)
  model, data, organ = scene(
    windows=windows, gravity=(9.81, 0, 0), pin=pin, device=device, young=2e5
  )
  report = organ.cut(across())
  assert report.area == pytest.approx(0.05 * 0.03, rel=0.1) and report.nodes > 10
  assert report.depth == pytest.approx(0.03, abs=1e-3) and organ.energy < 1e-20
  one, two = organ.pieces
  assert one.mass + two.mass == pytest.approx(0.3, rel=1e-12)
  assert one.volume + two.volume == pytest.approx(9e-5, rel=1e-12) == organ.volume
  assert two.mass > 0.45 * 0.3
  loose = max((one, two), key=lambda piece: organ.xpos0[piece.vertices, 0].mean())
  held = one if loose is two else two
  run(model, data, 50)
  t, h = 50 * model.opt.timestep, model.opt.timestep
  fallen = organ.displacement[loose.vertices].mean(axis=0)
  np.testing.assert_allclose(fallen, [9.81 / 2 * t * (t + h), 0, 0], rtol=2e-3, atol=1e-5)
  assert np.abs(organ.displacement[held.vertices]).max() < 5e-3 and organ.error is None
  assert organ.cuts == (report,)


@BOTH
def test_state_copy_and_reset_have_the_cuts_to_the_bit(windows):
  model, data, organ = scene(windows=windows, gravity=(0, 1.0, -2.0), foundation=1e5)
  run(model, data, 10, -0.03)
  organ.cut(across(0.004), depth=0.02)
  run(model, data, 5, -0.03)
  organ.cut(across(-0.01))
  saved = scenes.state(model, data)

  def on(each):
    run(model, each, 10, -0.03)
    return np.append(scenes.state(model, each), palpate.Organ(model, each, "organ").xpos)

  scenes.goes_on(model, data, on)
  fresh = mujoco.MjData(model)
  mujoco.mj_resetData(model, data)
  assert organ.nvert == len(block()[0]) and len(organ.pieces) == 1 and organ.cuts == ()
  for each in (data, fresh):
    run(model, each, 10, -0.03)
  assert np.array_equal(scenes.state(model, data), scenes.state(model, fresh))
  damaged = saved.copy()
  damaged[np.flatnonzero(damaged > 2.0**33)[3]] += 1.0
  mujoco.mj_setState(model, data, damaged, FULL)
  with pytest.raises(ValueError, match="cuts that are not of this organ"):
    organ.nvert  # noqa: B018


@BOTH
def test_a_cut_solid_may_be_placed_and_put_to_rest(windows):
  model, data, organ = scene(windows=windows)
  for x in (-0.018, -0.009, 0.0, 0.009, 0.018):  # so many that the last vertex inside is on a wall
    organ.cut(across(x), depth=0.02)
  shift, speed = np.full((organ.nvert, 3), 1e-3), np.full((organ.nvert, 3), 0.01)
  organ.set_state(organ.xpos0 + shift, speed)
  np.testing.assert_allclose(organ.displacement, shift, atol=1e-12)
  run(model, data, 10)
  np.testing.assert_allclose(organ.displacement, 1e-3 + 10 * 0.01 * 2e-3, rtol=1e-4)  # rigid
  organ.reset()
  run(model, data, 10)
  assert np.abs(organ.displacement).max() < 1e-9 and organ.error is None and organ.cuts


def moving(organ):
  """Returns mass, momentum, angular momentum, and energy, of all nodes."""
  space = scenes.workspace(organ)
  cuts.follow(space)
  u, v = space.motion()
  mass, x = space.organ.mass[:, None], space.organ.mesh.rest + u
  kept = np.concatenate([[mass.sum()], (mass * v).sum(0), (mass * np.cross(x, v)).sum(0)])
  return kept, organ.energy + 0.5 * (mass * v**2).sum()


@BOTH
def test_mass_and_momentum_are_kept_and_energy_does_not_rise(windows):
  organ = scene(windows=windows)[2]
  x = organ.xpos
  organ.set_state(x + 0.003 * np.sin(60 * x[:, [1, 2, 0]]), 0.3 * np.sin(50 * x[:, [0, 0, 1]]))
  before, energy = moving(organ)
  organ.cut(organ.xpos[cKDTree(x).query(across(0.005))[1]], depth=0.02)
  after, less = moving(organ)
  np.testing.assert_allclose(after, before, rtol=0, atol=1e-9)
  assert less < (1 + 1e-6) * energy


def test_a_ball_is_borne_by_the_wall_of_a_cut():
  points, radius = block()[0], 0.009
  pin = np.flatnonzero(points[:, 0] < -0.0299)
  model, data, organ = scene(pin=pin, young=2e4, radius=0.0005)
  model.body_pos[1] = [0.02, 0, 0]
  model.jnt_axis[0] = [1, 0, 0]
  model.geom_size[0, 0] = radius
  organ.cut(across())
  away = max(organ.pieces, key=lambda piece: organ.xpos0[piece.vertices, 0].mean())
  x = organ.xpos
  x[away.vertices] += [0.0, 0.3, 0.0]
  organ.set_state(x)
  wall = np.arange(organ.nvert) >= len(points)
  total, walls = [], []
  for k in range(200):
    run(model, data, 1, -0.02 + radius - 0.003)  # 3 mm into where the wall was
    if k >= 100:  # the ball bounces on it
      total.append(organ.force[0])
      walls.append(organ.contact_force[wall, 0].sum())
  assert organ.error is None and -2 < np.mean(total) < -0.05
  assert np.mean(walls) < 0.7 * np.mean(total)
  assert organ.displacement[wall][:, 0].min() == pytest.approx(-0.0035, abs=1.5e-3)


@BOTH
def test_what_holds_a_solid_goes_on_to_hold_both_sides(windows):
  model, data, organ = scene(windows=windows, gravity=(0, 0, -9.81), bonds="none", young=5e4)
  mujoco.mj_forward(model, data)
  below = np.flatnonzero(organ.xpos0[:, 2] < -0.0149)
  organ.bond("world", 3e6, 1e6, 1e7, vertices=below)
  grip = organ.attach(np.flatnonzero(organ.xpos0[:, 2] > 0.0149), "world", 2e3)
  run(model, data, 20)
  force = grip.force[2]
  organ.cut(across())
  run(model, data, 100)
  assert len(organ.pieces) == 2 and organ.error is None
  for piece in organ.pieces:
    assert np.abs(organ.displacement[piece.vertices]).max() < 2e-3
  assert grip.force[2] == pytest.approx(force, rel=0.2)


@BOTH
def test_the_walls_are_drawn_and_hidden_between_pictures(windows):
  model, data, organ = scene(windows=windows)
  drawn = mujoco.MjvScene(model, 4000)
  flex = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, "organ_inside")
  first, last = np.append(model.flex_elemdataadr, model.nflexelemdata)[flex : flex + 2]
  for act in range(3):
    if act == 1:
      organ.cut(across(), depth=0.02)
    if act == 2:
      mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    scenes.draw(model, data, drawn)
    elem = model.flex_elem[first:last].reshape(-1, 3)
    wall = organ.elem[len(block()[1]) :]
    assert np.array_equal(elem[: len(wall)], wall) and bool(len(wall)) == (act == 1)
    lips = elem[len(wall) :][elem[len(wall) :].any(axis=1)]
    assert bool(len(lips)) == (act == 1)
    if act == 1:
      at = data.flexvert_xpos[model.flex_vertadr[flex] :]
      np.testing.assert_allclose(at[wall], organ.xpos[wall], atol=1e-9)
      skin = organ.elem[: len(block()[1])]
      mouth = np.intersect1d(wall, skin)  # lips go around it
      far = np.linalg.norm(at[np.unique(lips)][:, None] - organ.xpos[mouth], axis=2)
      assert far.min(axis=1).max() < 2e-3 and far.min(axis=0).max() < 2e-3
    run(model, data, 1)
    assert model.flex_vertnum[flex] == 0


def test_a_tool_carries_a_piece_away():
  model, data, organ = scene(gravity=(0, 0, -9.81), foundation=4e5)
  run(model, data, 1)
  organ.cut(across(0.012))
  piece = organ.pieces[1]
  assert not piece.held and organ.pieces[0].held
  organ.attach(piece.vertices, "ball")
  run(model, data, 150, 0.03)
  assert organ.displacement[piece.vertices][:, 2].mean() == pytest.approx(0.03, abs=0.01)
  assert organ.error is None


def test_material_and_time_step_may_change_on_a_cut_solid():
  model, data, organ = scene(foundation=1e4)
  organ.cut(across(), depth=0.02)
  organ.configure(young_scale=2.0, poisson=0.4)
  model.opt.timestep = 1e-3
  organ.cut(across(0.012), depth=0.02)
  run(model, data, 20, -0.03)
  assert organ.error is None and np.isfinite(organ.xpos).all()


@pytest.mark.parametrize(
  ("keys", "message"),
  [
    ({"depth": 0.0}, "depth is 0, expected a number > 0"),
    ({"depth": -0.01}, "depth is -0.01, expected a number > 0"),
    ({"depth": 0.01, "direction": [0, 1]}, r"direction is .*, expected three numbers"),
    ({"points": []}, r"points of a cut have shape \(0,\), expected \(n, 3\), n >= 2"),
    ({"points": [[0, 0], [0, 1]]}, r"points of a cut have shape \(2, 2\)"),
    ({"points": "round"}, "points of a cut are 'round', expected numbers"),
    ({"points": [[0, 0, 0.08], [0.01, 0, 0.08]]}, "point 0 of the path is .* m from the surface"),
    ({"points": [[-0.03, y, 0.0] for y in (-0.02, 0, 0.02)]}, "vertex .*, which is pinned"),
  ],
)
def test_what_cannot_be_cut_says_so(keys, message):
  points = block()[0]
  organ = scene(pin=np.flatnonzero(points[:, 0] < -0.0299))[2]
  with pytest.raises(ValueError, match=message):
    organ.cut(**{"points": across()} | keys)


def test_a_solid_does_not_tear():
  with pytest.raises(ValueError, match=r"tear is .*, allowed only with spare and not for a solid"):
    scene(tear=0.4)


def test_a_surface_has_no_depth_and_without_room_a_cut_ends_early():
  organ = scene(elements="membrane", foundation=1e4)[2]
  with pytest.raises(ValueError, match="allowed only with elements='solid'"):
    organ.cut(across(), depth=0.01)
  model, data, organ = scene(spare=9)
  report = organ.cut(across())
  assert report.stopped and "no spare vertices are left" in organ.error
  assert 0 < report.nodes <= 9 and len(organ.pieces) == 1
  run(model, data, 5, -0.03)
  assert np.isfinite(organ.xpos).all()
