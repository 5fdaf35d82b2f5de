"""Cutting an organ in a scene: state, copies, contacts, pieces, both couplings."""

import copy

import mujoco
import numpy as np
import palpate
import pytest
import scenes
import trimesh
from palpate.tissue.config import Config
from scipy.spatial import cKDTree

FULL = mujoco.mjtState.mjSTATE_INTEGRATION
SPARE = 120
LIP = 8e-4  # how wide the lips of a cut are drawn [m]
BOTH = pytest.mark.parametrize("windows", [False, True], ids=["nodal", "windows"])


def sphere():
  return scenes.sphere(2)


def strip():
  return scenes.triangular(0.12, 0.04, 24, 9, 0.2)


def scene(mesh, windows=False, gravity=(0, 0, 0), h=2e-3, tool=True, **keys):
  """Returns model and data of an organ with room for cuts, a ball on a slide above it."""
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = h, gravity
  if tool:
    body = spec.worldbody.add_body(name="ball", pos=[0, 0, 0.09], gravcomp=1)
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], name="z")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.008, 0, 0], mass=0.1)
    scenes.servo(spec, "z", 400, 10)
  given = {"mass": 0.2, "young": 6e3, "thickness": 0.003, "spare": SPARE, "device": "cpu"} | keys
  palpate.add_organ(spec, mesh, "organ", windows=windows, **given)
  model = spec.compile()
  return model, mujoco.MjData(model)


def handle(model, data):
  return palpate.Organ(model, data, "organ")


def cap(angle=0.4, count=60):
  """Returns a circle around the top of the sphere."""
  t = np.linspace(0, 2 * np.pi, count)
  x, y = np.sin(angle) * np.cos(t), np.sin(angle) * np.sin(t)
  return scenes.RADIUS * np.stack([x, y, np.cos(angle) + 0 * t], axis=1)


def masses(organ):
  """Returns the mass of each vertex that its piece says, spread by area."""
  out = np.zeros(organ.nvert)
  for piece in organ.pieces:
    out[piece.vertices] = piece.mass / len(piece.vertices)
  return out


def run(model, data, steps, z=0.0):
  for _ in range(steps):
    if model.nu:
      data.ctrl[0] = z
    mujoco.mj_step(model, data)


@BOTH
def test_an_organ_at_rest_stays_there_when_it_is_cut(windows, device):
  model, data = scene(sphere(), windows, foundation=1e4, device=device)
  organ = handle(model, data)
  run(model, data, 2)
  before = organ.xpos
  report = organ.cut(cap(1.0))
  assert organ.energy < 1e-25 and report.nodes == organ.nvert - len(before) > 10
  assert report.area == pytest.approx(report.length * 0.003)
  assert report.length == pytest.approx(2 * np.pi * scenes.RADIUS * np.sin(1.0), rel=0.05)
  run(model, data, 10)
  assert organ.error is None and np.abs(organ.displacement).max() < 1e-12
  assert organ.cuts == (report,) and not np.isfinite(organ.volume)


@BOTH
def test_a_piece_that_is_cut_free_falls_and_the_rest_stays(windows, device):
  """It falls outward, for a cap rests in its hole."""
  model, data = scene(sphere(), windows, (0, 0, 9.81), tool=False, foundation=4e5, device=device)
  organ = handle(model, data)
  organ.cut(cap())
  large, small = organ.pieces
  assert large.held and not small.held
  assert large.mass + small.mass == pytest.approx(0.2, rel=1e-12)
  start, steps = organ.xpos[small.vertices].mean(axis=0), 50
  run(model, data, steps)
  t, h = steps * model.opt.timestep, model.opt.timestep
  fallen = organ.xpos[small.vertices].mean(axis=0) - start
  np.testing.assert_allclose(fallen, [0, 0, 9.81 / 2 * t * (t + h)], rtol=1e-3, atol=1e-5)
  assert np.abs(organ.displacement[large.vertices]).max() < 1e-3


def test_a_strip_that_is_cut_across_lets_its_loose_half_go():
  points, elem = strip()
  pin = np.flatnonzero(points[:, 0] < 0.006)
  model, data = scene((points, elem), gravity=(9.81, 0, 0), tool=False, pin=pin, young=2e6)
  organ = handle(model, data)
  organ.cut([[0.07, -0.02, 0], [0.072, 0.02, 0]])
  assert len(organ.pieces) == 2
  loose = np.flatnonzero(organ.xpos0[:, 0] > 0.075)
  tied = np.flatnonzero(organ.xpos0[:, 0] < 0.06)
  run(model, data, 50)
  t, h = 50 * model.opt.timestep, model.opt.timestep
  fallen = organ.displacement[loose][:, 0].mean()
  assert fallen == pytest.approx(9.81 / 2 * t * (t + h), rel=2e-3)
  assert np.abs(organ.displacement[tied]).max() < 0.2 * abs(fallen)


@BOTH
def test_a_slit_in_a_sheet_under_tension_opens_as_a_crack_does(windows, device):
  # A crack of length 2 a in a wide plate of stress s in all directions opens by 4 s a / E in the
  # middle and gives back pi s^2 a^2 / E by thickness (plane stress; Westergaard 1939); s = T / t.
  side, half, young, thickness, tension = 0.24, 0.012, 1e5, 0.002, 0.2
  points, elem = scenes.triangular(2, 2, 56, 64)
  points[:, 0] -= 1
  points[:, :2] *= 0.5 * side * (0.25 + 0.75 * points[:, :2] ** 2)  # a quarter of an edge inside
  pin = np.flatnonzero(np.abs(points).max(axis=1) > 0.499 * side)
  given = {"young": young, "thickness": thickness, "bend": 0, "tension": tension, "pin": pin}
  model, data = scene((points, elem), windows, tool=False, mass=1e-3, device=device, **given)
  organ = handle(model, data)
  run(model, data, 5)
  before = organ.energy
  assert np.abs(organ.displacement).max() < 1e-8
  report = organ.cut(np.linspace([-half, 0, 0], [half, 0, 0], 40))
  run(model, data, 200)
  a, strain = report.length / 2, tension / (thickness * young)
  across = organ.displacement[np.abs(organ.xpos0[:, 0]) < 0.3 * a, 1]
  # Stiffer than a wide plate: 4 % by the mesh (2 with half the edges), 3 by the sides that hold.
  assert 0.92 < np.ptp(across) / (4 * strain * a) < 1
  assert 0.86 < (before - organ.energy) / (np.pi * strain * tension * a**2) < 1


@BOTH
@pytest.mark.parametrize("kind", ["plate", "membrane", "spring"])
def test_mass_and_momentum_are_kept_and_energy_does_not_rise(windows, kind):
  keys = {"plate": {}, "membrane": {"bend": 0}, "spring": {"elements": "spring", "stiffness": 40}}
  points, elem = strip()
  model, data = scene((points, elem), windows, tool=windows, **keys[kind])
  organ = handle(model, data)
  x = organ.xpos
  stretched = x + 0.004 * np.sin(40 * x[:, [1, 0, 0]])
  organ.set_state(stretched, 0.3 * np.sin(50 * x[:, [0, 0, 1]]) + [0.1, 0, 0])
  before = motion(model, organ)
  for path in ([[0.02, -0.005, 0], [0.1, 0.008, 0]], [[0.06, -0.02, 0], [0.06, 0.02, 0]]):
    near = cKDTree(x).query(np.linspace(*path, 40))[1]
    organ.cut(organ.xpos[near[np.append(True, np.diff(near) != 0)]])
  after = motion(model, organ)
  assert organ.nvert > len(points) + 10
  for name in ("mass", "momentum", "spin"):
    scale = np.abs(before["gross"] if name != "mass" else before["mass"])
    np.testing.assert_allclose(after[name], before[name], rtol=0, atol=1e-9 * scale, err_msg=name)
  assert after["energy"] < 1.002 * before["energy"]


def motion(model, organ):
  """Returns what is kept, from the masses that the tissue's own kinetic energy has."""
  mass = organ.mass
  x, v = organ.xpos, organ.xvel
  kinetic = 0.5 * (mass[:, None] * v**2).sum()
  far2 = (organ.displacement[organ.bonds.vertices] ** 2).sum(axis=1)  # made at rest, to the world
  return {
    "mass": mass.sum(),
    "momentum": (mass[:, None] * v).sum(axis=0),
    "spin": (mass[:, None] * np.cross(x, v)).sum(axis=0),
    "gross": np.abs(mass[:, None] * v).sum(),
    "energy": organ.energy + kinetic + 0.5 * 3e5 * (organ.bonds.area * far2).sum(),
  }


@BOTH
def test_state_copy_and_reset_have_the_cuts_to_the_bit(windows):
  model, data = scene(sphere(), windows, (0, 1.0, -2.0), foundation=1e4)
  organ = handle(model, data)
  run(model, data, 30, -0.03)
  organ.cut(cap())
  run(model, data, 10, -0.03)
  whole = mujoco.MjData(model)

  def on(each):  # in turns with data that was never cut
    for _ in range(15):
      run(model, each, 1, -0.02)
      run(model, whole, 1, -0.02)
    return np.append(scenes.state(model, each), handle(model, each).xpos)

  scenes.goes_on(model, data, on)
  assert handle(model, whole).nvert == len(sphere()[0])
  # A healed organ moves as one that was never cut.
  fresh = mujoco.MjData(model)
  mujoco.mj_resetData(model, data)
  assert organ.nvert == len(sphere()[0]) and len(organ.pieces) == 1 and organ.cuts == ()
  for each in (data, fresh):
    run(model, each, 20, -0.03)
  assert np.array_equal(scenes.state(model, data), scenes.state(model, fresh))


def test_models_that_were_copied_or_made_while_cut_have_the_whole_organ(tmp_path):
  model, data = scene(sphere(), foundation=1e4)
  handle(model, data).cut(cap())
  mujoco.mj_saveModel(model, str(tmp_path / "cut.mjb"), None)
  for each in (model, copy.copy(model), mujoco.MjModel.from_binary_path(str(tmp_path / "cut.mjb"))):
    fresh = mujoco.MjData(each)
    run(each, fresh, 3)
    organ = handle(each, fresh)
    assert organ.nvert == len(sphere()[0]) and organ.volume > 0
  assert handle(model, data).nvert > len(sphere()[0])


@BOTH
def test_a_tool_goes_through_the_hole_and_touches_what_is_beside_it(windows):
  model, data = scene(scenes.sphere(3), windows, (0, 60.0, 0), foundation=4e5, spare=200)
  organ, closed = handle(model, data), mujoco.MjData(model)
  organ.cut(cap(0.35))
  run(model, data, 120, 0.0)  # what was cut out falls aside
  forces = []
  for each in (data, closed):
    run(model, each, 150, -0.04)
    forces.append(-handle(model, each).force[2])
  assert abs(forces[0]) < 1e-3 and forces[1] > 0.5
  # At the edge of the hole it meets the tissue that is there.
  model.body_pos[1, 0] = 0.03
  mujoco.mj_forward(model, data)
  run(model, data, 150, 0.01)
  run(model, data, 200, -0.05)
  assert -organ.force[2] > 0.05 and organ.error is None


def test_windows_and_nodal_coupling_agree_on_a_cut_organ():
  forces = []
  for windows in (False, True):
    model, data = scene(scenes.sphere(3), {"nodes": 150} if windows else False, foundation=2e4)
    organ = handle(model, data)
    angle = np.linspace(-0.9, 0.9, 40)
    organ.cut(scenes.RADIUS * np.stack([np.sin(angle), 0.25 + 0 * angle, np.cos(angle)], axis=1))
    pressed = []
    for z in np.linspace(-0.03, -0.045, 150):
      run(model, data, 1, z)
      pressed.append(-organ.force[2])
    forces.append(np.array(pressed))
  # The masses of nodes are not the same: by area with windows, all alike without.
  assert forces[0].max() > 0.08
  np.testing.assert_allclose(forces[1][-50:], forces[0][-50:], atol=0.01 * forces[0].max())


def test_a_scene_is_drawn_with_the_triangles_of_its_data():
  model, data = scene(sphere(), foundation=1e4)
  other = mujoco.MjData(model)
  handle(model, data).cut(cap())
  drawn = mujoco.MjvScene(model, 200)
  seen = []
  for each in (data, other, data):
    mujoco.mj_forward(model, each)
    scenes.draw(model, each, drawn)
    organ = handle(model, each)
    seen.append(model.flex_elem.reshape(-1, 3)[-len(organ.elem) :].copy())  # lips come before
    assert np.array_equal(seen[-1], organ.elem)
  assert not np.array_equal(seen[0], seen[1]) and np.array_equal(seen[0], seen[2])


def test_the_sides_of_an_open_organ_are_drawn_on_both_pieces():
  model, data = scene(strip())
  organ = handle(model, data)
  whole = model.flex_shell.reshape(-1, 2)
  outline = {tuple(edge) for edge in whole.tolist()}
  organ.cut([[0.06, -0.02, 0], [0.062, 0.02, 0]])
  edges = model.flex_shell.reshape(-1, 2)
  sides = [np.isin(edges, piece.vertices) for piece in organ.pieces]
  assert len(sides) == 2 and all((side[:, 0] == side[:, 1]).all() for side in sides)
  mujoco.mj_resetData(model, data)
  mujoco.mj_forward(model, data)
  assert {tuple(edge) for edge in model.flex_shell.reshape(-1, 2).tolist()} == outline


def test_without_spare_vertices_a_cut_ends_early_and_nothing_breaks():
  model, data = scene(sphere(), foundation=1e4, spare=5)
  organ = handle(model, data)
  report = organ.cut(cap(0.8))
  assert report.stopped and report.nodes <= 5 and "no spare vertices are left" in organ.error
  run(model, data, 20, -0.03)
  assert np.isfinite(data.qpos).all() and len(organ.pieces) == 1


def test_an_organ_without_room_refuses_a_cut():
  model, data = scene(sphere(), spare=0)
  with pytest.raises(ValueError, match="organ 'organ': spare is 0, expected room"):
    handle(model, data).cut(cap())


def test_a_state_of_another_model_or_with_other_cuts_is_refused():
  model, data = scene(sphere(), foundation=1e4)
  handle(model, data).cut(cap())
  run(model, data, 2)
  damaged = scenes.state(model, data)
  where = np.flatnonzero(damaged > 2.0**33)
  damaged[where[5]] += 1.0
  fresh = mujoco.MjData(model)
  mujoco.mj_setState(model, fresh, damaged, FULL)
  with pytest.raises(ValueError, match="cuts that are not of this organ"):
    handle(model, fresh).nvert  # noqa: B018
  mujoco.mj_step(model, fresh)
  assert "cuts that are not of this organ" in handle(model, fresh).error


@pytest.mark.parametrize(
  ("keys", "message"),
  [
    ({"spare": -1}, "spare is -1, expected a whole number"),
    ({"spare": "many"}, "spare is 'many'"),
    ({"carrier": "own"}, "carrier is 'own', allowed only where spare is 0"),
    ({"elements": "solid", "capsule_young": 1e5}, "capsule_young is .*, allowed only where spare"),
  ],
)
def test_what_does_not_go_with_cuts_is_refused(keys, message):
  with pytest.raises(ValueError, match=message):
    scene(sphere(), **({"thickness": ""} if "elements" in keys else {}), **keys)


def test_configuration_and_time_step_may_change_on_a_cut_organ():
  model, data = scene(sphere(), foundation=1e4, bulk=1e3)
  organ = handle(model, data)
  organ.cut(cap())
  organ.configure(young_scale=2.0)
  organ.configure(damping=0.01)
  model.opt.timestep = 1e-3
  run(model, data, 20, -0.03)
  assert organ.error is None and np.isfinite(data.qpos).all()
  assert isinstance(organ.config, Config)


def test_auto_gives_room_for_a_few_cuts():
  model, data = scene(sphere(), spare="auto", foundation=1e4)
  organ = handle(model, data)
  for axis in np.eye(3):
    t = np.linspace(0, 6, 80)
    u, v = np.roll(axis, 1), np.roll(axis, 2)
    organ.cut(scenes.RADIUS * (np.outer(np.cos(t), u) + np.outer(np.sin(t), v)))
  assert organ.error is None and len(organ.cuts) == 3
  run(model, data, 5)
  assert organ.error is None


def test_a_piece_can_be_grasped_and_carried_away():
  model, data = scene(sphere(), gravity=(0, 0, -9.81), foundation=4e5)
  organ = handle(model, data)
  run(model, data, 1)
  organ.cut(cap())
  piece = organ.pieces[1]
  organ.attach(piece.vertices, "ball")
  run(model, data, 150, 0.05)
  lifted = organ.displacement[piece.vertices][:, 2].mean()
  assert lifted == pytest.approx(0.05, abs=0.01) and organ.error is None


@BOTH
@pytest.mark.parametrize("tears", [False, True])
def test_tissue_tears_across_where_it_is_stretched_too_far(windows, tears):
  """A strip that is narrow in the middle, held and pulled at its ends."""
  points, elem = scenes.triangular(0.12, 0.03, 40, 12, 0.2)
  points[:, 1] *= 1 - 0.5 * np.exp(-(((points[:, 0] - 0.06) / 0.02) ** 2))
  ends = [np.flatnonzero(s * (points[:, 0] - 0.06) > 0.054) for s in (-1, 1)]
  keys = {"bend": 0, "young": 2e4, "damping": 0.02, "tear": 0.3}
  model, data = scene((points, elem), windows, mass=0.02, spare=80, pin=ends[0], **keys)
  organ = handle(model, data)
  mujoco.mj_forward(model, data)
  organ.attach(ends[1], "ball")
  model.jnt_axis[0] = [1, 0, 0]
  run(model, data, 400, 0.03 if tears else 0.008)
  assert organ.error is None
  assert len(organ.pieces) == 1 + tears and bool(organ.cuts) == tears
  if tears:
    where = np.concatenate([line for cut in organ.cuts for line in cut.path])
    assert np.abs(where[:, 0] - 0.06).max() < 0.03
    assert max(piece.mass for piece in organ.pieces) < 0.02 * 0.8


SLOW = [pytest.param(range(4 * k, 4 * k + 4), marks=pytest.mark.slow) for k in range(1, 60)]


@pytest.mark.parametrize("seeds", [range(4), *SLOW])
def test_random_cuts_gain_no_energy(seeds):
  for seed in seeds:
    r = np.random.RandomState(seed)
    mesh = sphere() if r.rand() < 0.5 else scenes.triangular(0.1, 0.08, 16, 14, 0.25, seed)
    keys = {"young": float(r.choice([3e3, 3e4])), "bend": float(r.choice([0, 1]))}
    keys |= {"foundation": float(r.choice([0, 1e4]))}
    # Springs without bending: a stiff plate on soft springs that folds gains energy, cut or not.
    keys |= {"elements": "spring", "stiffness": 30.0, "bend": 0.0} if r.rand() < 0.3 else {}
    h = float(r.choice([5e-4, 1e-3, 2e-3, 5e-3]))
    windows = bool(r.randint(2))
    model, data = scene(mesh, windows, h=h, tool=windows, **keys, spare=500, bonds="none")
    organ = handle(model, data)
    if seed % 3 == 1:  # held by bonds that do not break
      mujoco.mj_forward(model, data)
      organ.bond("world", 3e5, 1e6, 1e7, vertices=np.arange(0, organ.nvert, 2))
    x, wave = organ.xpos, r.normal(0, 20, (3, 3))
    shape = np.sin(x @ wave + r.rand(3) * 6)
    organ.set_state(x + 0.08 * np.ptp(x) * r.rand() * shape, r.rand() * 0.5 * shape)
    first = last = motion(model, organ)["energy"]
    for step in range(30):
      if step % 5 == 2:
        last = random_cut(organ, r, last)
      run(model, data, 1, 0.1)
      now = motion(model, organ)["energy"]
      # As without cuts: a stiff plate that folds may gain a little within a step.
      assert now <= last + 1e-2 * first, (seed, step, now / last)
      last = now
    assert organ.error is None and np.isfinite(organ.xpos).all()


def random_cut(organ, r, last):
  """Cuts somewhere; returns the energy after it, which is hardly more."""
  x = organ.xpos
  way = r.normal(size=3)
  line = x[r.randint(len(x))] + np.outer(np.linspace(-0.5, 0.5, 30), way * np.ptp(x))
  near = cKDTree(x).query(line)[1]
  near = near[np.append(True, np.diff(near) != 0)]
  try:
    organ.cut(x[near])
  except ValueError as error:
    assert "shorter" in str(error) or "shape" in str(error)
    return last
  return max(last, 0.0) * 1.01


@BOTH
def test_an_organ_of_mjcf_gets_room_by_add_spare(windows):
  points, elem = sphere()
  xml = scenes.world(scenes.organ(points, elem, mass=0.2, foundation=1e4))
  spec = mujoco.MjSpec.from_string(xml)
  palpate.add_spare(spec, "organ", 60)
  if windows:
    palpate.add_windows(spec, "organ", nodes=30)
  model = spec.compile()
  data = mujoco.MjData(model)
  organ = handle(model, data)
  assert organ.nvert == len(points)
  organ.cut(cap())
  mujoco.mj_step(model, data, 5)
  assert organ.error is None and len(organ.pieces) == 2
  assert sum(piece.mass for piece in organ.pieces) == pytest.approx(0.2)
  again = mujoco.MjSpec.from_string(xml)
  with pytest.raises(ValueError, match="spare is 0, expected a number > 0"):
    palpate.add_spare(again, "organ", 0)


def test_a_declared_spare_without_vertices_is_refused():
  points, elem = sphere()
  xml = scenes.world(scenes.organ(points, elem, spare=20))
  with pytest.raises(ValueError, match=r"spare is 20 and vertex .* has triangles"):
    mujoco.MjModel.from_xml_string(xml)


@BOTH
def test_the_lips_are_drawn_and_hidden_between_pictures(windows):
  model, data = scene(strip(), windows, tool=windows)
  organ, drawn = handle(model, data), mujoco.MjvScene(model, 4000)
  flex = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, "organ_inside")
  first, last = np.append(model.flex_elemdataadr, model.nflexelemdata)[flex : flex + 2]
  start, line = model.flex_vertadr[flex], np.array([[0.03, 0.0, 0.0], [0.09, 0.0, 0.0]])
  for cuts in range(3):
    if cuts == 1:
      organ.cut(line)
    if cuts == 2:
      mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    scenes.draw(model, data, drawn)
    elem = model.flex_elem[first:last].reshape(-1, 3)
    elem = elem[elem.any(axis=1)]
    if cuts == 1:  # one band around the cut, from the outer side to the inner one
      band = trimesh.Trimesh(data.flexvert_xpos[start:], elem, process=False)
      assert len(band.split(only_watertight=False)) == 1
      thick = 2 * model.flex_radius[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, "organ")]
      size = np.ptp(band.vertices[elem], axis=(0, 1)) - [organ.cuts[0].length, 0, 0]
      np.testing.assert_allclose(size, [2 * LIP, 2 * LIP, thick], atol=4e-4)
    else:
      assert not len(elem)
    run(model, data, 1)
    assert model.flex_vertnum[flex] == 0
