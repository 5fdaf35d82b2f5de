"""Windows and what people do with them: an error that says what is wrong, or correct motion."""

import re

import mujoco
import numpy as np
import palpate
import pytest
import scenes
from scenes import drive, load, probed, slots


def refused(text: str, *words: str):
  with pytest.raises(ValueError) as error:
    mujoco.MjModel.from_xml_string(text)
  for word in words:
    assert word in str(error.value)


def edited(old: str, new: str, **options) -> str:
  text = probed(**options)
  assert old in text
  return text.replace(old, new)


def second_organ(window: str) -> str:
  """Returns a scene of two organs, the other with its own window or the first one's."""
  text = probed()
  body = re.search(r'<body name="organ">.*?</body>', text, re.S).group(0)
  flex = re.search(r'<flexcomp name="window".*?</flexcomp>', text, re.S).group(0)
  other = body.replace('name="organ"', 'name="other"').replace(
    'value="window"', f'value="{window}"'
  )
  other = other.replace('<body name="other"', '<body name="other" pos=".3 0 0"')
  return text.replace(body, body + other + flex.replace('name="window"', 'name="window2"'))


def test_a_name_that_does_not_exist():
  refused(probed(keys={"window": "nothing"}), "'organ'", "'nothing'", "does not exist", "'window'")


def test_a_name_that_is_no_flexcomp():
  refused(probed(keys={"window": "tool"}), "'organ'", "'tool'", "expected a flexcomp")


def test_the_organ_as_its_own_window():
  refused(probed(keys={"window": "organ"}), "organ 'organ': window 'organ'", "rigid")


def test_a_window_without_free_vertices():
  pinned = '<pin gridrange="0 0 8 5"/><contact '
  text = probed()
  at = text.index('name="window"')
  text = text[:at] + text[at:].replace("<contact ", pinned, 1)
  refused(text, "organ 'organ': window 'window'", "pinned")


def test_a_rigid_window():
  refused(
    edited('<flexcomp name="window"', '<flexcomp name="window" rigid="true"'), "'window'", "rigid"
  )


def test_a_window_with_some_pins():
  text = probed()
  at = text.index('name="window"')
  text = text[:at] + text[at:].replace("<contact ", '<pin id="0"/><contact ', 1)
  refused(text, "organ 'organ': window 'window'", "pins")


def test_a_volumetric_window():
  flat, thick = ('dim="2" type="grid" count="9 6 1"', 'dim="3" type="grid" count="3 3 3"')
  text = edited(flat, thick)
  refused(text, "organ 'organ': window 'window'", "dim")


def test_a_window_of_two_organs():
  refused(second_organ("window"), "'window'", "claimed by organ")
  m, d, organ = load(second_organ("window2"))
  drive(m, d, 20)
  assert organ.error is None and palpate.Organ(m, d, "other").error is None


def test_a_window_on_a_nodal_organ():
  refused(probed(False, keys={"window": "organ", "mass": 0.1}), "rigid flexcomp", "expected one")


def test_windows_may_have_more_slots_than_the_organ_has_nodes():
  m, d, organ = load(probed(count="19 13 1", condim=1))  # of 162 nodes
  force = drive(m, d, 100)[-1, 0]
  assert organ.error is None
  m, d, _ = load(probed(condim=1))
  assert force == pytest.approx(drive(m, d, 100)[-1, 0], rel=1e-3)


def test_several_windows_of_an_organ_are_refused():
  refused(probed(keys={"window": "window second"}), "'window second'", "the name of a flexcomp")


def test_a_body_without_geoms_is_not_followed():
  refused(probed(keys={"follow": "frame"}), "'frame'", "no geoms that collide")


def two_organs(apart, first=scenes.windowed, second=scenes.windowed, **second_contact):
  """Returns two spheres beside each other; the windows of the second are called otherwise."""
  points, elem = scenes.sphere(1)
  keys = {"grid": "second_window"} if second is scenes.windowed else {}
  other = second(points + np.array([apart, 0, 0]), elem, "second", contact=second_contact, **keys)
  return scenes.world(first(points, elem, "first"), other)


@pytest.mark.parametrize("second", [scenes.windowed, scenes.organ])
def test_an_organ_that_windows_would_not_feel_is_refused(second):
  refused(two_organs(0.1, second=second), "'first'", "'second'", "nodal coupling")
  load(two_organs(0.3, second=second), "first")
  load(two_organs(0.1, second=second, contype=0, conaffinity=0), "first")
  load(two_organs(0.1, scenes.organ, scenes.organ), "first")


def test_few_elements_hold_fewer_nodes():
  # Two rows have 52 triangles for 54 vertices: 28 nodes are sure to have no more.
  m, d, organ = load(probed(count="27 2 1", condim=1))
  force = drive(m, d, 100)[-1, 0]
  assert (slots(organ) >= 0).sum() == 28
  assert organ.window_overflow == (0, 0)
  assert organ.window_warning is None
  m, d, organ = load(probed(False, condim=1))
  assert force == pytest.approx(drive(m, d, 100)[-1, 0], rel=0.01)


@pytest.mark.parametrize("target", [(0.0, 0.5), (0.3, -0.2), (-0.1, -0.0567)])
def test_a_teleporting_tool(target):
  """The tool jumps away, far into the organ, or out at the other side, and back."""
  m, d, organ = load(probed())
  d.ctrl[0] = -0.006
  mujoco.mj_step(m, d, 100)
  d.qpos[-2:] = d.ctrl[:] = target[1], target[0]
  mujoco.mj_step(m, d, 150)
  assert organ.error is None and np.isfinite(organ.displacement).all()
  assert d.warning.number[mujoco.mjtWarning.mjWARN_BADQACC] == 0
  assert np.abs(organ.displacement).max() < 0.02
  d.qpos[-2:], d.qvel[-2:] = 0, 0
  d.ctrl[:] = -0.006, 0
  mujoco.mj_step(m, d, 600)
  still = load(probed())
  still[1].ctrl[0] = -0.006
  for _ in range(850):
    mujoco.mj_step(*still[:2])
  assert organ.force[2] == pytest.approx(still[2].force[2], rel=0.02)
  np.testing.assert_allclose(organ.xpos, still[2].xpos, atol=2e-4)


def test_a_jump_into_the_middle_lets_the_tool_out_without_an_explosion():
  m, d, organ = load(probed())
  d.qpos[-2] = d.ctrl[0] = -0.05
  mujoco.mj_step(m, d, 200)
  assert organ.error is None and np.abs(organ.displacement).max() < 0.05
  assert d.warning.number[mujoco.mjtWarning.mjWARN_BADQACC] == 0


def scaled(factor: float) -> str:
  """Returns the scene with all lengths times `factor`: so are displacements, and forces by f^2."""
  text = probed(keys={
    "thickness": 0.002 * factor, "foundation": 1e4 / factor, "mass": 0.1 * factor
  })  # fmt: skip

  def lengths(match):
    values = " ".join(f"{factor * float(x):.9g}" for x in match.group(2).split())
    return f'{match.group(1)}="{values}"'

  text = re.sub(r'(point|radius|spacing|pos|size)="([-\d. e]+)"', lengths, text)
  # A stiffness E t is then times f, so with masses times f the motion in time is the same.
  # The impedance of contacts depends on a length, unless it is constant.
  text = text.replace('solref="', 'solimp=".95 .95 .001" solref="').replace(
    '<geom name="tip"',
    f'<inertial pos="0 0 0" mass="{0.05 * factor}" diaginertia="1e-5 1e-5 1e-5"/>'
    '<geom name="tip" solimp=".95 .95 .001"',
  )
  text = text.replace('mass="0.01"', f'mass="{0.01 * factor}"')
  return text.replace('kp="500" kv="10"', f'kp="{500 * factor}" kv="{10 * factor}"')


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_scaled_by_a_thousand(factor):
  results = []
  for f in (1.0, factor):
    m, d, organ = load(scaled(f))
    for _ in range(250):
      d.ctrl[0] = -0.006 * f * min(1, d.time / 0.1)
      mujoco.mj_step(m, d)
    assert organ.error is None
    results.append((organ.force[2] / f**2, organ.displacement[:, 2].min() / f))
  assert results[0][0] < -0.02
  assert results[1] == pytest.approx(results[0], rel=0.01)
