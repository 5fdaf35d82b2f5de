"""Organs that have grown on to bodies and to each other, and come apart."""

import copy

import mujoco
import numpy as np
import palpate
import pytest
from scipy.spatial import cKDTree

SOFT = {"young": 3e4, "tolerance": 1e-7}
LAW = (1e6, 100.0, 0.05)  # stiffness [N/m^3], strength [Pa], energy [J/m^2]
TEXT = "1e6 100 0.05"
HAND = '<body name="hand" pos="0 0 0.08" mocap="true"/>'
LOOSE = """<body name="hand" pos="0 0 0.08"><freejoint name="free"/>
  <geom size="0.01" mass="0.5" contype="0" conaffinity="0"/></body>"""
BED = """<body name="bed" pos="0 0 -0.0605"><geom name="bed" type="box" size="0.1 0.1 0.01"
  contype="0" conaffinity="0"/></body>"""


@pytest.fixture(params=["nodal", "window"])
def make(request, scenes):
  """Returns a function that returns model, data and organ of tissue beside bodies."""
  return lambda bodies=HAND, *shape, **keys: scenes.beside(
    request.param, bodies, *shape, **SOFT | keys
  )


def _lift(model, data, organ, grip, speed, height):
  """Lifts what the mocap body holds; returns the work and the forces along z."""
  forces = []
  while data.mocap_pos[0, 2] < height:
    data.mocap_pos[0, 2] += speed * model.opt.timestep
    mujoco.mj_step(model, data)
    forces.append(grip.force[2])
  return speed * model.opt.timestep * np.sum(forces), np.array(forces)


# Closed forms.


def test_pulling_an_area_free_takes_its_fracture_energy(make, scenes):
  points, elem = scenes.triangular(0.02, 0.0173, 4, 4)
  model, data, organ = make(
    '<body name="hand" mocap="true"/>', points, elem, bonds="none", damping=0.0, mass=0.002
  )
  mujoco.mj_forward(model, data)
  every = np.arange(organ.nvert)
  organ.bond("world", 1e7, 2e3, 2.0, vertices=every)
  grip = organ.attach(every, "hand", stiffness=1e4)
  work, forces = _lift(model, data, organ, grip, 0.004, 0.003)
  area = organ.bonds.area.sum()
  assert area == pytest.approx(0.02 * 0.0173, rel=1e-9)
  assert forces.max() == pytest.approx(2e3 * area, rel=0.03)
  assert work == pytest.approx(2.0 * area, rel=0.02)
  assert organ.bonds.energy == pytest.approx(2.0 * area, rel=0.01)
  assert organ.bonds.share_freed == 1.0 and abs(forces[-1]) < 1e-3 and organ.error is None


def test_peeling_a_strip_takes_the_force_of_its_fracture_energy(scenes):
  # Kendall 1975, doi:10.1088/0022-3727/8/13/005: G = (P/b)^2 / (2 d E) + (P/b) (1 - cos 90).
  width, energy, speed = 0.00866, 10.0, 0.02
  points, elem = scenes.triangular(0.06, width, 24, 4)
  hand = """<body name="hand"><joint name="x" type="slide" axis="1 0 0" damping="0.02"/>
    <joint name="z" type="slide" axis="0 0 1"/>
    <geom size="0.002" mass="0.05" contype="0" conaffinity="0"/></body>"""
  keys = {"young": 1e6, "thickness": 1e-3, "bend": 0.0, "damping": 2e-4, "mass": 0.002}
  organ = scenes.organ(points, elem, bonds="none", **keys)
  model, data, organ = scenes.load(scenes.world(organ + hand))
  mujoco.mj_forward(model, data)
  organ.bond("world", 5e7, 5e3, energy, vertices=np.flatnonzero(points[:, 0] > 0.006))
  grip = organ.attach(np.flatnonzero(points[:, 0] < 1e-6), "hand")
  z, pulls = model.joint("z").dofadr[0], []
  while organ.bonds.share_freed < 0.8:
    data.qvel[z] = speed
    mujoco.mj_step(model, data)
    if organ.bonds.share_freed > 0.3:
      pulls.append(grip.force[2] / width)
  pull = np.mean(pulls)
  found = pull + pull**2 / (2 * keys["thickness"] * keys["young"])
  assert found == pytest.approx(energy, rel=0.08)
  freed = organ.bonds.area[organ.bonds.free].sum()
  assert organ.bonds.energy == pytest.approx(energy * freed, rel=0.1)
  assert organ.error is None


# Reactions.


def test_an_organ_and_a_free_body_bonded_together_keep_their_momentum(make, scenes, device):
  model, data, organ = make(LOOSE, bonds=f"hand {TEXT} near 0.025", device=device)
  mujoco.mj_forward(model, data)
  dof, adr = model.joint("free").dofadr[0], model.joint("free").qposadr[0]
  data.qvel[dof : dof + 3] = 0.1, 0, 0.2
  mujoco.mj_step(model, data, 200)
  assert 0.1 < organ.bonds.damage.mean()
  momentum = (scenes.masses(organ)[:, None] * organ.xvel).sum(0)
  momentum += 0.5 * data.qvel[dof : dof + 3]
  np.testing.assert_allclose(momentum, [0.05, 0, 0.1], atol=2e-5)
  assert np.isfinite(data.qpos[adr]) and organ.error is None


def _two(scenes, gravity=(0, 0, -9.81), first="upper", **keys):
  """Returns a block that is held, with bonds to a block a millimetre under it, and that block."""
  points, elem = scenes.box((0.06, 0.06, 0.03), 0.012)
  points[:, 2] -= points[:, 2].min()
  held = " ".join(map(str, np.flatnonzero(points[:, 2] > 0.029)))
  each = {"elements": "solid", "young": 2e4, "damping": 0.01, "tolerance": 1e-5}
  each |= {"contact": {"contype": 1, "conaffinity": 2}}
  upper = scenes.windowed(points, elem, "upper", "one", "3 3 1", pin=held, **each | keys)
  lower = scenes.windowed(points - [0, 0, 0.031], elem, "lower", "two", "3 3 1", **each)
  both = upper + lower if first == "upper" else lower + upper
  made = scenes.world(both + scenes.ball(1.0, joint=False) + HAND, gravity=gravity)
  model, data, organ = scenes.load(made, "upper")
  mujoco.mj_forward(model, data)
  return model, data, organ, palpate.Organ(model, data, "lower")


def test_an_organ_hangs_by_its_bonds_on_another(scenes):
  model, data, upper, lower = _two(scenes, bonds="lower 1e6 5e3 50 near 0.002")
  assert len(upper.bonds) == 36 and not len(lower.bonds)
  mujoco.mj_step(model, data, 600)
  np.testing.assert_allclose(upper.bonds.force.sum(axis=0), [0, 0, -0.981], atol=0.01)
  assert np.abs(lower.xvel).max() < 5e-3 and not upper.bonds.damage.any()
  assert upper.error is None and lower.error is None


def test_forces_between_organs_are_the_same_whichever_comes_first(scenes):
  found = []
  for first in ("upper", "lower"):
    model, data, upper, _ = _two(scenes, first=first, bonds="lower 1e6 5e3 50 near 0.002")
    mujoco.mj_step(model, data, 20)
    found.append(upper.bonds.force)
  np.testing.assert_allclose(found[1], found[0], atol=1e-3 * np.abs(found[0]).max())


def test_a_pull_frees_an_organ_from_another(scenes):
  energy = 1.0
  model, data, upper, lower = _two(scenes, (0, 0, 0), bonds=f"lower 1e6 1e3 {energy} near 0.002")
  grip = lower.attach(np.flatnonzero(lower.xpos0[:, 2] < -0.0305), "hand")
  shares = []
  for _ in range(750):
    data.mocap_pos[0, 2] -= 2e-5
    mujoco.mj_step(model, data)
    shares.append(upper.bonds.share_freed)
  assert shares[-1] == 1.0 and np.all(np.diff(shares) >= 0)
  assert upper.bonds.energy == pytest.approx(energy * upper.bonds.area.sum(), rel=0.05)
  assert np.abs(grip.force).max() < 0.05 and upper.error is None and lower.error is None


def _pair(scenes, kinds):
  """Returns the bonds' force on an organ, and that of a hand on the one it is bonded to."""
  points, elem = scenes.box((0.04, 0.04, 0.02), 0.01)
  points[:, 2] -= points[:, 2].min()
  organs = []
  for kind, name, down in zip(kinds, ("upper", "lower"), (0.0, 0.021), strict=True):
    keys = SOFT | {"damping": 0.01, "bulk": 1e4, "contact": {"contype": 1, "conaffinity": 2}}
    if name == "upper":
      keys |= {"bonds": "lower 1e6 1e3 1 near 0.002", "foundation": 1e5}
    body = points - [0, 0, down], elem, name
    windows = {"grid": f"{name}_window", "count": "3 3 1"}
    organs.append(
      scenes.windowed(*body, **windows, **keys) if kind else scenes.organ(*body, **keys)
    )
  model, data, upper = scenes.load(
    scenes.world(*organs, scenes.ball(1.0, joint=False), HAND), "upper"
  )
  mujoco.mj_forward(model, data)
  lower = palpate.Organ(model, data, "lower")
  grip = lower.attach(np.flatnonzero(lower.xpos0[:, 2] < -0.0205), "hand")
  for k in range(250):
    data.mocap_pos[0, 2] -= 1e-5 if k < 100 else 0.0
    mujoco.mj_step(model, data)
  return upper.bonds.force.sum(axis=0), grip.force


def test_what_pulls_at_one_organ_pulls_back_at_the_other_in_each_coupling(scenes):
  found = []
  for kinds in ((False, False), (False, True), (True, False)):
    force, grip = _pair(scenes, kinds)
    np.testing.assert_allclose(force, grip, atol=0.02 * np.abs(force).max())
    found.append(force)
  assert found[0][2] < -0.1
  np.testing.assert_allclose(found[1:], [found[0]] * 2, atol=0.005 * np.abs(found[0]).max())


# Pressing.


def test_pressing_frees_nothing(make):
  model, data, organ = make(BED + HAND, bonds=f"bed {TEXT} near 0.004", foundation=5e2)
  mujoco.mj_forward(model, data)
  press = organ.attach(organ.bonds.vertices, "hand")
  for _ in range(200):
    data.mocap_pos[0, 2] -= 5e-6
    mujoco.mj_step(model, data)
  pressed = organ.bonds.force[:, 2] / organ.bonds.area
  assert pressed.min() > 2 * 100.0 and press.force[2] < -0.5
  assert not organ.bonds.damage.any()
  for _ in range(200):
    data.mocap_pos[0, 2] += 2e-5
    mujoco.mj_step(model, data)
  assert organ.bonds.share_freed == 1.0


# No gain.


def _runaway(scenes, seed, steps):
  """Returns the most energy that a sheet and its bonds have, as a share of the blow that it got."""
  random = np.random.RandomState(seed)
  points, elem = scenes.triangular(0.02, 0.0173, 5, 5, jitter=0.1, seed=seed)
  h = 10 ** random.uniform(-3.5, -2.3)
  stiffness = 10 ** random.uniform(5, 9)
  strength = 10 ** random.uniform(2, 5)
  energy = strength**2 / (2 * stiffness) * 10 ** random.uniform(0.01, 3)
  keys = {"young": 10 ** random.uniform(3.5, 6), "damping": 0.0, "mass": 0.01}
  keys |= {"bonds": "none", "foundation": 0.0}
  organ = scenes.organ(points, elem, **keys)
  model, data, organ = scenes.load(scenes.world(organ, h=h))
  mujoco.mj_forward(model, data)
  organ.bond("world", stiffness, strength, energy, vertices=np.arange(organ.nvert))
  far = 10 ** random.uniform(-1, 1) * 2 * energy / strength
  wave = np.sin(random.uniform(0, 6, 3) + points @ random.uniform(-100, 100, (3, 3)))
  wave[:, 2] += 1.0
  organ.set_state(xvel=min(far / h / 20, 0.5) * wave)
  mass = model.body_mass[scenes.bodies(organ)][:, None]
  most, first = 0.0, None
  for _ in range(steps):
    kinetic, elastic = 0.5 * (mass * organ.xvel**2).sum(), organ.energy
    mujoco.mj_step(model, data)
    total = kinetic + elastic + organ.bonds.stored
    first = total if first is None else first
    most = max(most, total / first)
  assert organ.error is None and np.isfinite(most)
  return most


@pytest.mark.parametrize("seed", range(6))
def test_bonds_that_break_add_no_energy(scenes, seed):
  assert _runaway(scenes, seed, 60) < 1.02


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6, 206))
def test_bonds_of_many_kinds_add_no_energy(scenes, seed):
  assert _runaway(scenes, seed, 300) < 1.02


# State.


def _torn(make, **keys):
  model, data, organ = make(BED + HAND, bonds=f"bed {TEXT} near 0.004", foundation=5e2, **keys)
  mujoco.mj_forward(model, data)
  grip = organ.attach(np.flatnonzero(organ.xpos0[:, 2] > 0.04), "hand")
  return model, data, organ, grip


def _pull(model, data, steps, speed=0.02):
  for _ in range(steps):
    data.mocap_pos[0, 2] += speed * model.opt.timestep
    mujoco.mj_step(model, data)


def test_states_and_copies_go_on_to_the_bit_and_a_reset_heals(scenes, make):
  model, data, organ, _ = _torn(make)
  _pull(model, data, 250)
  state = scenes.state(model, data)
  torn = organ.bonds.damage
  assert 0 < (torn > 0).sum() and 0 < organ.bonds.energy
  other = copy.copy(data)
  ends = []
  for each in (data, other):
    _pull(model, each, 100)
    found = palpate.Organ(model, each, "organ").bonds
    ends.append([found.damage, found.released, found.force])
  mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
  np.testing.assert_array_equal(organ.bonds.damage, torn)
  _pull(model, data, 100)
  ends.append([organ.bonds.damage, organ.bonds.released, organ.bonds.force])
  for end in ends[1:]:
    for a, b in zip(ends[0], end, strict=True):
      np.testing.assert_array_equal(a, b)
  assert (ends[0][0] > torn).any()
  mujoco.mj_resetData(model, data)
  assert not organ.bonds.damage.any() and not organ.bonds.energy and len(organ.bonds)


def test_bonds_of_python_are_copied_and_end_with_a_reset(make):
  model, data, organ = make(bonds="none")
  mujoco.mj_forward(model, data)
  organ.bond("world", *LAW, vertices=[3, 17])
  organ.bond("hand", *LAW, vertices=[40])
  data.mocap_pos[0] += [0, 0, 0.0005]
  mujoco.mj_step(model, data, 20)
  other = copy.copy(data)
  twin = palpate.Organ(model, other, "organ")
  for each in (data, other):
    mujoco.mj_step(model, each, 20)
  np.testing.assert_array_equal(twin.xpos, organ.xpos)
  assert len(twin.bonds) == 3 and np.abs(twin.bonds.force[2]).max() > 0
  organ.bond("hand", *LAW, vertices=[41])
  for _ in range(2):
    mujoco.mj_copyData(other, model, data)
    assert len(twin.bonds) == 4
  mujoco.mj_resetData(model, data)
  data.mocap_pos[0] += [0, 0, 0.005]
  mujoco.mj_step(model, data)
  assert not len(organ.bonds) and not organ.displacement.any()


def test_what_is_held_before_anything_was_computed_is_held_where_it_is(make):
  model, data, organ = make(bonds="none")
  organ.bond("hand", *LAW, vertices=[3, 17])
  grip = organ.attach([40], "hand")
  data.mocap_pos[0] += [0, 0, 1e-3]
  organ.bond("hand", *LAW, vertices=[5])  # it is where it will be found
  data.mocap_pos[0] -= [0, 0, 1e-3]
  mujoco.mj_step(model, data)
  stretch = np.round(organ.bonds.stretch, 9)
  np.testing.assert_array_equal(stretch, [[0, 0, 0], [0, 0, 0], [0, 0, 1e-3]])
  assert np.abs(grip.force).max() < 1e-3


def test_a_motion_that_is_set_leaves_what_is_torn_and_a_reset_of_the_organ_heals(make):
  model, data, organ, _ = _torn(make)
  _pull(model, data, 350)
  torn = organ.bonds.damage
  assert torn.any()
  organ.set_state(organ.xpos0, np.zeros((organ.nvert, 3)))
  np.testing.assert_array_equal(organ.bonds.damage, torn)
  organ.reset()
  assert not organ.bonds.damage.any()


def test_both_couplings_tear_alike(scenes):
  points, elem = scenes.sphere(2)
  found = []
  for window in (False, True):
    keys = SOFT | {"bonds": f"bed {TEXT} near 0.004", "foundation": 5e2}
    made = (scenes.windowed if window else scenes.organ)(points, elem, **keys)
    made = scenes.world(made + scenes.ball(1.0, joint=False) + BED + HAND)
    model, data, organ = scenes.load(made)
    if not window:
      scenes.lump(organ)
    mujoco.mj_forward(model, data)
    grip = organ.attach(np.flatnonzero(points[:, 2] > 0.04), "hand")
    forces = []
    for _ in range(900):
      data.mocap_pos[0, 2] += 3e-5
      mujoco.mj_step(model, data)
      forces.append(grip.force[2])
    found.append((np.array(forces), organ.bonds.damage))
  (forces, damage), (other, torn) = found
  assert 0.1 < damage.mean()
  np.testing.assert_allclose(other, forces, atol=0.01 * np.abs(forces).max())
  np.testing.assert_allclose(torn, damage, atol=0.02)


def test_without_bonds_there_is_no_room_for_them(make):
  without, with_ = make(), make(bonds="none")
  assert with_[0].npluginstate > without[0].npluginstate
  assert not len(without[2].bonds) and without[2].bonds.share_freed == 0.0


def test_a_current_weakens_what_is_near_it(make):
  model, data, organ = make(BED, bonds=f"bed {TEXT} near 0.004")
  mujoco.mj_forward(model, data)
  near = np.linalg.norm(organ.bonds.positions - [0, 0, -0.05], axis=1) < 0.005
  for _ in range(2):
    organ.bonds.weaken(0.3 * near)
    mujoco.mj_step(model, data)
  for _ in range(2):  # and between the two halves of a step
    mujoco.mj_step1(model, data)
    organ.bonds.weaken(0.3 * near)
    mujoco.mj_step2(model, data)
  np.testing.assert_array_equal(organ.bonds.damage, 1.0 * near)
  assert near.any() and not near.all() and organ.bonds.energy == pytest.approx(0, abs=1e-9)


def test_the_distance_of_a_strand_is_that_of_its_nearest_point(make):
  model, data, organ = make(bonds="none")
  mujoco.mj_forward(model, data)
  organ.bond("hand", 1e4, 1e5, 1e6, vertices=np.arange(40))
  data.mocap_pos[0] += [0.004, 0.003, 0.01]
  mujoco.mj_step(model, data, 3)
  bonds, share = organ.bonds, np.linspace(0, 1, 400)
  assert np.linalg.norm(bonds.stretch, axis=1).min() > 0.005
  for start, end in [([0, 0, 0.05], [0.01, 0.02, 0.06]), ([0.03, 0, 0], [0.03, 0, 0.0])]:
    wire = start + share[:, None] * np.subtract(end, start)
    strands = bonds.positions[:, None] - share[:, None] * bonds.stretch[:, None]
    found = [cKDTree(wire).query(strand)[0].min() for strand in strands]
    np.testing.assert_allclose(bonds.distance(start, end), found, atol=1e-4)


# What is refused.


@pytest.mark.parametrize(
  ("arguments", "message"),
  [
    (("nobody", *LAW, 0.01), "no body 'nobody'"),
    (("bed", 1e7, -2e3, 2.0, 0.01), "a bond has strength -2000, expected a number > 0"),
    (("bed", 1e7, 2e3, 0.1, 0.01), "energy 0.1 J/m.2, expected more than strength.2 / "),
    (("bed", *LAW, 1e-5), "no free vertex within 1e-05 m of 'bed'"),
    (("bed", *LAW, -1.0), "near is -1"),
    (("bed", *LAW), "either near or vertices"),
    (("bed", *LAW, None, [900]), "vertices have 900"),
    (("world", *LAW, None, [3]), "vertex 3 is bonded already"),
  ],
)
def test_what_cannot_be_bonded_is_named(make, arguments, message):
  model, data, organ = make(BED, bonds="none")
  mujoco.mj_forward(model, data)
  organ.bond("world", *LAW, vertices=[3])
  with pytest.raises(ValueError, match=message):
    organ.bond(*arguments)


def test_what_cannot_weaken_is_named(make):
  bonds = make(BED, bonds=f"bed {TEXT} near 0.004")[2].bonds
  for amount, message in ((-1.0, "amount is -1"), (np.nan, "nan"), ([1, 2], "has shape ")):
    with pytest.raises(ValueError, match=message):
      bonds.weaken(amount)
  assert not bonds.damage.any()


def test_an_organ_without_the_key_has_no_room(make):
  organ = make()[2]
  with pytest.raises(ValueError, match="key bonds is not set"):
    organ.bond("world", *LAW, vertices=[3])


@pytest.mark.parametrize(
  ("keys", "message"),
  [
    ({"bonds": "bed 1e7 2e3 2"}, "bonds is 'bed 1e7 2e3 2', expected 'none', or a body or organ"),
    ({"bonds": "bed 1e7 2e3 -2 near 0.004"}, "bonds has energy -2"),
    ({"bonds": "bed 1e7 2e3 2 near 0"}, "expected 'none', or a body or organ"),
    ({"bonds": "nobody 1e7 2e3 2 near 0.004"}, "bonds names 'nobody', which is no body"),
    ({"bonds": "bed 1e7 2e3 2 near 0.0001"}, "no free vertex within 0.0001 m of 'bed'"),
    ({"bonds": "bed 1e7 2e3 2 at 3 900"}, "vertices have 900"),
    ({"bonds": "none", "integrator": "neumann"}, "allowed only without bonds"),
  ],
)
def test_a_declaration_that_cannot_be_is_named(make, keys, message):
  with pytest.raises(ValueError, match=message):
    make(BED, **keys)


def test_springs_too_stiff_for_a_light_body_are_refused(make):
  with pytest.raises(ValueError, match=r"expected at most .* N/m for a body this light"):
    make(LOOSE, bonds="hand 1e9 2e3 2 near 0.025")
