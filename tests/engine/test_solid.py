"""Solids under MuJoCo's tools: what a user sees of an organ that has an inside."""

import mujoco
import numpy as np
import pytest

WEIGHT = 0.05 * 9.81
KEYS = {"elements": "solid", "young": 2e4, "poisson": 0.45, "damping": 0.01, "tolerance": 1e-6}


both = pytest.mark.parametrize("window", [True, False], ids=["window", "nodal"])


def _resting(scenes, window=True, extra="", **keys):
  """Returns a block, held below, with a ball above that falls onto it."""
  points, elem = scenes.box((0.06, 0.06, 0.03), 0.006)
  pin, keys = np.flatnonzero(points[:, 2] < -0.0149), KEYS | keys
  if window:
    keys |= {"mass": 0.1, "pin": " ".join(map(str, pin)), "count": "12 12 1"}
    block = scenes.windowed(points, elem, **keys)
  else:
    block = scenes.organ(points, elem, mass=0.1, pin=pin, **keys)
  ball = scenes.ball(0.0265, radius=0.01)
  return scenes.world(block + ball, gravity=(0, 0, -9.81), extra=extra)


@both
def test_a_resting_ball_is_carried_exactly(scenes, device, window):
  # The window hangs in the air, so that gravity acts on the organ and the ball.
  model, data, organ = scenes.load(_resting(scenes, window, device=device))
  scenes.run(model, data, 1500)
  assert organ.force[2] == pytest.approx(-WEIGHT, rel=2e-3)
  assert np.abs(organ.xvel).max() < 1e-3 and organ.error is None
  assert 5e-4 < np.abs(organ.displacement).max() < 5e-3


DRIVE = '<actuator><position joint="z" kp="500" kv="10"/></actuator>'


SKIN = {"capsule_young": 1e5, "thickness": 3e-4}


@pytest.mark.parametrize(
  "stiff", [SKIN, {"young": 3e5, "damping": 0.002}], ids=["soft, with a skin", "stiff"]
)
def test_force_is_the_same_with_and_without_windows(scenes, stiff):
  forces, places = [], []
  for window in (True, False):
    model, data, organ = scenes.load(_resting(scenes, window, DRIVE, **stiff))
    force = []
    for _ in range(150):
      data.ctrl[0] = -min(0.05 * data.time, 0.004)
      mujoco.mj_step(model, data)
      force.append(organ.force[2])
    assert organ.error is None
    forces.append(force)
    places.append(organ.xpos)
  peak = np.abs(forces[0]).max()
  assert peak > 0.1
  np.testing.assert_allclose(*forces, atol=0.005 * peak)
  np.testing.assert_allclose(*places, atol=1e-6)


def test_force_of_an_indentation_is_that_of_hertz_on_a_layer(scenes):
  radius, depth, height, young, nu = 0.02, 0.003, 0.04, 5000.0, 0.45
  points, elem = scenes.box((0.08, 0.08, height), 0.005)
  pin = " ".join(map(str, np.flatnonzero(points[:, 2] < -height / 2 + 1e-4)))
  keys = KEYS | {"young": young, "poisson": nu, "mass": 0.25, "pin": pin, "tolerance": 1e-4}
  block = scenes.windowed(points, elem, count="20 20 1", radius=0.0003, **keys)
  top = height / 2 + 0.0003
  ball = scenes.ball(top + radius + 0.0005, radius=radius)
  drive = '<actuator><position joint="z" kp="5000" kv="20"/></actuator>'
  model, data, organ = scenes.load(scenes.world(block + ball, h=2e-3, extra=drive))
  scenes.run(model, data, 500, deepest=depth + 0.0005)
  # What the contact gives way is not indentation.
  given = -min(contact.dist for contact in data.contact[: data.ncon])
  deep = -data.qpos[model.joint("z").qposadr[0]] - 0.0005 - given
  hertz = 4 / 3 * young / (1 - nu**2) * np.sqrt(radius) * deep**1.5
  # A layer that is bonded below is stiffer than a half space (Dimitriadis et al. 2002, eq. 12,
  # doi:10.1016/S0006-3495(02)75620-8).
  chi = np.sqrt(radius * deep) / height
  layer = 1 + 1.133 * chi + 1.283 * chi**2 + 0.769 * chi**3
  assert np.linalg.norm(organ.force) == pytest.approx(hertz * layer, rel=0.1)
  # What the mean over nodes leaves soft does not ring under the tool.
  forces = []
  for _ in range(30):
    mujoco.mj_step(model, data)
    forces.append(organ.force[2])
  assert np.std(forces) < 1e-3 * abs(np.mean(forces))


@both
def test_a_solid_that_nothing_holds_falls_freely(scenes, window):
  points, elem = scenes.sphere(2)
  organ = (scenes.windowed if window else scenes.organ)(points, elem, **KEYS | {"mass": 0.5})
  far = scenes.ball(1.0)
  model, data, organ = scenes.load(scenes.world(organ + far, gravity=(0, 0, -9.81), h=1e-3))
  scenes.run(model, data, 100)
  np.testing.assert_allclose(organ.xvel - [0, 0, -0.981], 0.0, atol=1e-3)
  assert organ.energy < 1e-9


def test_a_step_adds_less_to_the_damping_of_a_solid_than_it_would_by_itself(scenes):
  points, elem = scenes.sphere(1)
  keys = {"elements": "solid", "young": 1e6, "foundation": 4e4, "damping": 0.004, "mass": 0.1}
  swings = []
  for h in (1e-4, 1e-3):
    xml = scenes.world(scenes.windowed(points, elem, **keys) + scenes.ball(1.0), h=h)
    model, data, organ = scenes.load(xml)
    organ.set_state(xvel=np.tile([0.1, 0, 0], (organ.nvert, 1)))
    place = []
    for _ in range(round(0.1 / h)):
      mujoco.mj_step(model, data)
      place.append(organ.displacement[:, 0].mean())
    swings.append(-np.min(place) / np.max(place))  # half a swing apart
  exact, found = -np.log(swings)
  assert 1.0 < found / exact < 1.15  # Euler's step: 1.22


@both
def test_a_saved_state_goes_on_to_the_bit(scenes, window):
  model, data, organ = scenes.load(_resting(scenes, window))
  scenes.run(model, data, 60)
  scenes.goes_on(model, data, lambda each: scenes.run(model, each, 40, record=True))
  expected = organ.xpos
  mujoco.mj_resetData(model, data)
  scenes.run(model, data, 100)
  np.testing.assert_array_equal(organ.xpos, expected)


@both
def test_what_a_user_sees_is_the_surface(scenes, window):
  organ = scenes.load(_resting(scenes, window))[2]
  assert organ.nvert == len(organ.xpos) == len(organ.free) == len(organ.contact_force)
  moved = organ.xpos0 + np.array([0.0, 0.0, 0.001])
  organ.set_state(moved)
  held = ~organ.free
  np.testing.assert_allclose(organ.xpos[~held], moved[~held], atol=1e-12)
  np.testing.assert_allclose(organ.xpos[held], organ.xpos0[held], atol=1e-12)
  corner = np.concatenate([organ.xpos, organ.inside])[organ.tetrahedra]
  volume = np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6
  assert volume.min() > 0 and volume.sum() == pytest.approx(organ.volume)
  organ.reset()
  assert np.abs(organ.displacement).max() == 0 and organ.energy == 0


@pytest.mark.parametrize(
  ("keys", "message"),
  [
    ({"thickness": 0.003}, "thickness is 0.003, allowed only on a solid with capsule_young"),
    ({"bend": 2}, "bend is 2, allowed only on a solid with capsule_young"),
    ({"capsule_young": 1e5}, "capsule_young is set and thickness is missing"),
    ({"bulk": 1e4}, "bulk is 10000, allowed only"),
    ({"pressure": 100}, "pressure is 100, allowed only"),
    ({"integrator": "neumann"}, "integrator is 'neumann', allowed only"),
    ({"poisson": 0.5}, r"poisson is '0.5', expected a number in \[0, 0.5\)"),
  ],
)
def test_what_a_solid_has_not_is_refused(scenes, keys, message):
  with pytest.raises(ValueError, match=message):
    scenes.load(_resting(scenes, **keys))


def test_a_skin_may_change_but_not_begin_while_running(scenes):
  forces = []
  for skin in (SKIN, SKIN | {"capsule_young": 5e5}):
    organ = scenes.load(_resting(scenes, **SKIN))[2]
    organ.configure(**skin)
    scenes.run(organ.model, organ.data, 200)
    forces.append(-organ.xpos[organ.contact_force[:, 2] < 0, 2].mean())
  assert forces[1] < forces[0]  # the ball sinks in less far
  organ = scenes.load(_resting(scenes))[2]
  with pytest.raises(ValueError, match=r"capsule_young is .*: it cannot begin or end"):
    organ.configure(**SKIN)


def test_a_file_of_tetrahedra_is_for_solids(scenes):
  with pytest.raises(ValueError, match="tetrahedra is 'a': No such file"):
    scenes.load(_resting(scenes, tetrahedra="a"))
  points, elem = scenes.sphere(1)
  with pytest.raises(ValueError, match="tetrahedra is 'a', allowed only with elements='solid'"):
    scenes.load(scenes.world(scenes.organ(points, elem, tetrahedra="a")))
  with pytest.raises(ValueError, match=r"capsule_young is .*, allowed only with elements='solid'"):
    scenes.load(scenes.world(scenes.organ(points, elem, **SKIN)))


def test_a_solid_that_is_open_is_refused(scenes):
  points, elem = scenes.strip(0.1, 0.05, 4, 3)
  with pytest.raises(ValueError, match="expected a closed surface"):
    scenes.load(scenes.world(scenes.windowed(points, elem, **KEYS) + scenes.ball(0.1)))
