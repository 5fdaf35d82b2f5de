"""Changing the configuration while running, and every scheme on every organ that ships."""

import mujoco
import numpy as np
import palpate
import pytest
from palpate import models
from palpate.tissue.step import SCHEMES

STIFF = {"young": 3e6, "foundation": 1e3, "tolerance": 1e-4}
SOFT = {"young": 6e4, "poisson": 0.1, "thickness": 0.003}
HARD = {"young": 3e6, "thickness": 0.004}


def stiff(scenes, **keys):
  """Returns a stiff sphere of 2562 nodes, large enough for coarse meshes, under a driven ball."""
  points, elem = scenes.sphere(4)
  drive = '<actuator><position joint="z" kp="500" kv="10"/></actuator>'
  made = scenes.windowed(points, elem, **(STIFF | keys))
  return scenes.load(scenes.world(made, scenes.ball(scenes.RADIUS + 0.0065), extra=drive))


def iterations(model, data, organ, steps=40):
  """Returns the mean of the iterations of some steps under the tool."""
  found = []
  for _ in range(steps):
    data.ctrl[0] -= 5e-5
    mujoco.mj_step(model, data)
    found.append(organ.iterations)
  assert organ.error is None
  return np.mean(found[5:])


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", models.NAMES)
def test_every_scheme_runs_on_every_organ_that_ships(scenes, name, scheme):
  # Pinned nodes have no mass in MuJoCo: explicit and neumann divided by it.
  model, data, organ = scenes.load(models.load(name, nodes=250, coupling="nodal"), f"{name}/{name}")
  model.opt.timestep = 2e-5
  organ.integrator = scheme
  mujoco.mj_step(model, data, nstep=5)
  assert organ.error is None
  assert np.isfinite(organ.xpos).all()
  assert not organ.free.all() and organ.displacement[~organ.free].max() == 0


@pytest.mark.parametrize("first, then", [(1e3, 1e8), (1e8, 1e3)])
def test_coarse_meshes_follow_a_change_of_the_foundation(scenes, first, then):
  compiled = iterations(*stiff(scenes, foundation=then))
  model, data, organ = stiff(scenes, foundation=first)
  organ.configure(foundation=then)
  # The armature, which stays, moves contacts a little.
  assert iterations(model, data, organ) == pytest.approx(compiled, rel=0.2)


def test_midpoint_has_coarse_meshes(scenes):
  found = {name: iterations(*stiff(scenes, integrator=name)) for name in ("implicit", "midpoint")}
  assert found["midpoint"] < 1.5 * found["implicit"]


def test_windows_that_stand_get_the_inertia_of_a_changed_material(scenes):
  states = []
  for compiled in (HARD, {}):
    model, data, organ = scenes.load(scenes.probed(keys=compiled))
    mujoco.mj_step(model, data)
    if not compiled:
      organ.configure(**HARD)
    states.append(model.dof_armature.copy())
  np.testing.assert_array_equal(*states)


def test_windows_that_stand_get_the_inertia_of_a_changed_time_step(scenes):
  states = []
  for h in (4e-3, 1e-3):
    model, data, _ = scenes.load(scenes.probed(h=h))
    mujoco.mj_step(model, data)
    model.opt.timestep = 4e-3
    mujoco.mj_step(model, data)
    states.append(model.dof_armature.copy())
  np.testing.assert_array_equal(*states)


@pytest.mark.parametrize("window", [False, True], ids=["nodal", "window"])
@pytest.mark.parametrize("keys", [SOFT, HARD], ids=["soft", "hard"])
def test_a_changed_material_is_the_compiled_one(scenes, device, window, keys):
  states = []
  for compiled in (keys, {}):
    made = scenes.probed(window, keys={"device": device} | compiled)
    model, data, organ = scenes.load(made)
    if not compiled:
      organ.configure(**keys)
    for key, value in keys.items():
      assert np.all(np.isclose(getattr(organ.config, key), value))
    scenes.drive(model, data, 120)
    assert organ.error is None
    states.append((organ.xpos, organ.xvel, organ.force, model.dof_armature.copy()))
  for one, other in zip(*states, strict=True):
    np.testing.assert_array_equal(one, other)


def test_a_scale_keeps_the_pattern_of_the_compiled_young(scenes):
  points, elem = scenes.sphere(1)
  young = np.linspace(1e4, 3e4, len(elem))
  organ = scenes.organ(points, elem, young=" ".join(map(str, young)), foundation=1e4)
  _, _, organ = scenes.load(scenes.world(organ))
  for scale in (2.0, 0.5):  # of the compiled one, not of the last
    organ.configure(young_scale=scale)
    np.testing.assert_allclose(organ.config.young, scale * young)
  energy = []
  organ.set_state(1.02 * points)
  for scale in (1.0, 3.0):
    organ.configure(young_scale=scale, foundation=0)
    energy.append(organ.energy)
  assert energy[1] == pytest.approx(3 * energy[0])


def test_the_stiffness_of_springs_changes(scenes):
  points, elem = scenes.sphere(2)
  keys = {"elements": "spring", "foundation": 1e3, "bend": 0}
  deep = []
  for stiffness in (20.0, 60.0, None):
    made = scenes.organ(points, elem, stiffness=stiffness or 20.0, **keys)
    model, data, organ = scenes.load(scenes.world(made))
    if stiffness is None:
      organ.configure(stiffness=60.0)
    data.qfrc_applied[scenes.dofs(organ)[np.argmax(points[:, 2]), 2]] = -0.02
    scenes.run(model, data, 60)
    deep.append(organ.displacement)
  np.testing.assert_array_equal(deep[1], deep[2])
  assert np.abs(deep[0]).max() > 1.1 * np.abs(deep[1]).max()


def test_a_copy_has_the_configuration_after_a_change_of_the_time_step(scenes):
  model, data, organ = scenes.load(scenes.probed())
  organ.configure(young=6e4, damping=0.01)
  model.opt.timestep = 2e-3
  scenes.run(model, data, 80, deepest=0.004)
  copied = mujoco.MjData(model)
  mujoco.mj_copyData(copied, model, data)
  other = palpate.Organ(model, copied, "organ")
  assert other.config == organ.config
  for each in (data, copied):
    mujoco.mj_step(model, each, nstep=5)
  np.testing.assert_array_equal(other.xpos, organ.xpos)
