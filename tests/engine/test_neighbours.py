"""Organs bonded to or resting on each other, where one's step launches the other's springs."""

import copy

import mujoco
import numpy as np
import palpate
import pytest
from palpate.models.meshing import grid

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
BONDS = "1e6 200 0.2 near 0.004"


def bonded(below="none"):
  """Two balls, the upper one bonded to the lower one, and as `below` says the other way too."""
  spec = mujoco.MjSpec.from_string('<mujoco><option gravity="0 0 0"/></mujoco>')
  vertices, triangles = grid.octasphere(5)
  keys = {"young": 2e4, "foundation": 1e5, "tolerance": 1e-7}
  palpate.add_organ(spec, (0.03 * vertices, triangles), "lower", bonds=below, **keys)
  place = dict(pos=(0, 0, 0.051), bonds=f"lower {BONDS}")
  palpate.add_organ(spec, (0.02 * vertices, triangles), "upper", **place, **keys)
  return spec.compile()


def resting():
  """A ball of tissue on another one."""
  spec = mujoco.MjSpec.from_string("""<mujoco><worldbody>
    <body name="finger" mocap="true" pos="0 0 0.3"><geom size="0.005"/></body>
    </worldbody></mujoco>""")
  vertices, triangles = grid.octasphere(3)
  keys = {"young": 8e3, "foundation": 1e5, "windows": {"tools": ["finger"]}}
  palpate.add_organ(spec, (0.03 * vertices, triangles), "lower", **keys)
  place = dict(pos=(0, 0, 0.0515), support="lower")
  palpate.add_organ(spec, (0.02 * vertices, triangles), "upper", **place, **keys)
  return spec.compile()


def organs(model, data):
  return [palpate.Organ(model, data, name) for name in ("lower", "upper")]


def thrown(model, speed):
  """Returns data whose upper organ moves."""
  data = mujoco.MjData(model)
  upper = organs(model, data)[1]
  upper.set_state(xvel=np.full((upper.nvert, 3), (0.3 * speed, 0.0, speed)))
  return data


@pytest.mark.parametrize("make, speed", [(bonded, 0.1), (resting, -0.1)])
def test_a_step_with_a_copy_of_the_model_reads_nothing_of_the_first(make, speed):
  model = make()
  data = thrown(model, speed)
  twin = copy.copy(data)
  mujoco.mj_step(model, twin, 20)
  expected = [organ.displacement for organ in organs(model, twin)]
  other = copy.copy(model)
  model.opt.timestep = 10.0  # nor what it may hold once it is freed
  model.qpos0[:] = 7.0
  mujoco.mj_step(other, data, 20)
  for organ, theirs in zip(organs(other, data), expected, strict=True):
    assert organ.error is None
    np.testing.assert_array_equal(organ.displacement, theirs)
    assert np.abs(organ.displacement).max() > 1e-5


def test_organs_bonded_to_each_other_from_both_sides_break_and_are_copied(scenes):
  model = bonded(below=f"upper {BONDS}")
  data = thrown(model, 1.0)
  lower, upper = organs(model, data)
  mujoco.mj_forward(model, data)
  assert lower.bonds.count and upper.bonds.count > lower.bonds.count
  for _ in range(100):
    mujoco.mj_step(model, data)
    if upper.bonds.damage.any():
      break
  assert upper.bonds.share_freed < 1
  twins = [copy.copy(data), mujoco.MjData(model)]
  mujoco.mj_setState(model, twins[1], scenes.state(model, data), STATE)
  for each in (data, *twins):
    mujoco.mj_step(model, each, 20)
  assert upper.bonds.share_freed > 0 and upper.error is None and lower.error is None
  for twin in twins:
    for organ, expected in zip(organs(model, twin), (lower, upper), strict=True):
      np.testing.assert_array_equal(organ.displacement, expected.displacement)
      np.testing.assert_array_equal(organ.bonds.damage, expected.bonds.damage)
