"""Window coupling: the same motion as nodal coupling, and what may go wrong."""

import os
import subprocess
import sys

import mujoco
import numpy as np
import palpate
import pytest
from palpate.engine import coupling, layout
from scenes import RADIUS, draw, drive, goes_on, load, lump, organ, probed, sphere, windowed, world


# With friction the tip sticks on the facets and jumps off them from 0.18 s on, in a 20 us reference
# too, and the moment is chance; until then the motions can be compared.
@pytest.mark.parametrize(("condim", "steps"), [(1, 350), (3, 170), (4, 170), (6, 170)])
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_window_moves_as_nodal_dofs_do(condim, steps, cone):
  m, d, organ = load(probed(False, condim=condim, cone=cone))
  lump(organ)
  reference = drive(m, d, steps)
  mw, dw, windowed = load(probed(condim=condim, cone=cone))
  force = drive(mw, dw, steps)
  assert mw.nv < 0.4 * m.nv
  peak = np.abs(reference).max()
  assert peak > 0.02
  rms = np.sqrt(np.mean((force - reference) ** 2, axis=0)).max()
  assert rms < 5e-3 * peak
  np.testing.assert_allclose(windowed.xpos, organ.xpos, atol=2e-5)


def test_static_force_does_not_depend_on_the_step():
  forces = []
  for h in (5e-4, 1e-3, 2e-3):
    m = mujoco.MjModel.from_xml_string(probed(h=h))
    d = mujoco.MjData(m)
    d.ctrl[0] = -0.006
    mujoco.mj_step(m, d, round(0.8 / h))
    forces.append(d.qfrc_constraint[-2])
  np.testing.assert_allclose(forces, forces[0], rtol=1e-3)


def test_a_state_and_a_copy_go_on_to_the_bit():
  m, d, _ = load(probed())
  drive(m, d, 150)
  goes_on(m, d, lambda each: drive(m, each, 100))


def test_reset_starts_over():
  m = mujoco.MjModel.from_xml_string(probed())
  d = mujoco.MjData(m)
  first = drive(m, d, 200)
  mujoco.mj_resetData(m, d)
  np.testing.assert_array_equal(drive(m, d, 200), first)


def test_two_data_of_one_model_take_turns():
  m = mujoco.MjModel.from_xml_string(probed())
  d = mujoco.MjData(m)
  alone = drive(m, d, 160)
  first, second = mujoco.MjData(m), mujoco.MjData(m)
  drive(m, second, 100)
  forces = []
  for _ in range(8):
    forces.append(drive(m, first, 20))
    drive(m, second, 7)
  np.testing.assert_allclose(np.concatenate(forces), alone, atol=1e-9)


def test_memory_need_not_be_clear_before():
  code = """if True:
    import importlib.util, pathlib, sys
    sys.path.insert(0, str(pathlib.Path(sys.argv[1]).parents[2]))
    spec = importlib.util.spec_from_file_location("test_window", sys.argv[1])
    tests = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tests)
    tests.test_a_state_and_a_copy_go_on_to_the_bit()
    tests.test_two_data_of_one_model_take_turns()"""
  # glibc fills what it hands out with this byte's complement: slots of about 2e5.
  env = {**os.environ, "MALLOC_PERTURB_": str(0xFF ^ 0x41)}
  subprocess.run([sys.executable, "-c", code, __file__], env=env, check=True)


@pytest.mark.parametrize("window", [True, False])
def test_two_steps_back_tell_where_the_solve_starts(window):
  """Without the dv before the last, the solve takes more iterations to the same motion."""
  forces, counts = [], []
  for forget in (False, True):
    m, d, organ = load(probed(window=window, keys={"tolerance": 1e-5}))
    if window:
      where = layout.spans(layout.Motion, {"nvert": organ.nvert})
    else:
      sizes = layout.NO_CUTS | coupling.nodal_sizes(3 * organ.nvert, 0)
      sizes |= {"nrelax": 0, "nbond": 0}
      where = layout.spans(layout.NodalState, sizes)
    before = where["before"]
    forces.append([])
    counts.append([])
    for _ in range(150):
      forces[-1].append(drive(m, d, 1)[0])
      counts[-1].append(organ.iterations)
      assert len(counts[-1]) < 50 or np.any(d.plugin_state[before])  # the probe has touched by then
      if forget:
        d.plugin_state[before] = 0
  assert np.mean(counts[0]) < 0.9 * np.mean(counts[1])
  np.testing.assert_allclose(forces[0], forces[1], atol=1e-3 * np.abs(forces[1]).max())


def test_rotated_frame_gives_the_same_force():
  plain = mujoco.MjModel.from_xml_string(probed())
  turned = mujoco.MjModel.from_xml_string(probed(frame='pos=".1 .2 .3" euler="40 20 70"'))
  forces = [drive(m, mujoco.MjData(m), 150) for m in (plain, turned)]
  # Rounding differs under the rotation, and friction amplifies it.
  np.testing.assert_allclose(forces[1][:110], forces[0][:110], atol=1e-6 * np.abs(forces[0]).max())


def test_far_tool_leaves_the_organ_at_rest_and_finds_it_after_a_jump():
  m, d, organ = load(probed())
  d.qpos[-2] = d.ctrl[0] = 0.5
  mujoco.mj_step(m, d, 20)
  assert np.abs(organ.displacement).max() < 1e-9
  d.qpos[-2], d.ctrl[0] = 0.0, -0.005
  mujoco.mj_step(m, d, 300)
  assert d.qfrc_constraint[-2] > 0.01
  assert organ.force[2] == pytest.approx(-d.qfrc_constraint[-2], rel=1e-6)


def test_deformed_surface_reaches_the_renderer():
  m = mujoco.MjModel.from_xml_string(probed())
  d = mujoco.MjData(m)
  drive(m, d, 110)
  organ = palpate.Organ(m, d, "organ")
  scn = mujoco.MjvScene(m, 1000)
  draw(m, d, scn)
  flex = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_FLEX, "organ")
  start = m.flex_vertadr[flex]
  drawn = d.flexvert_xpos[start : start + organ.nvert]
  np.testing.assert_allclose(drawn, organ.xpos, atol=1e-12)
  assert np.abs(drawn - organ.xpos0).max() > 1e-3


def test_set_state_and_reset():
  _, _, organ = load(probed())
  moved = organ.xpos0 + np.array([0, 0, 0.001])
  organ.set_state(moved, np.ones_like(moved))
  np.testing.assert_allclose(organ.xpos, moved, atol=1e-12)
  np.testing.assert_allclose(organ.xvel, 1.0)
  organ.reset()
  np.testing.assert_allclose(organ.xpos, organ.xpos0, atol=1e-12)


@pytest.mark.parametrize(
  ("keys", "words"),
  [
    ({"mass": None}, ["mass"]),
    ({"mass": "-1"}, ["mass", "-1"]),
    ({"pin": "0 9999"}, ["pin", "9999"]),
    ({"pin": "a"}, ["pin", "'a'"]),
    ({"follow": "nobody"}, ["nobody"]),
  ],
)
def test_bad_windows_are_named(keys, words):
  with pytest.raises(ValueError) as error:
    mujoco.MjModel.from_xml_string(probed(keys=keys))
  for word in words:
    assert word in str(error.value)


@pytest.mark.parametrize("count", ["9 6 1", "18 12 1"])  # little room, and much to spare
def test_window_touches_what_nodal_dofs_touch(count):
  found = []
  for text in (probed(False, condim=1), probed(condim=1, count=count)):
    m = mujoco.MjModel.from_xml_string(text)
    d = mujoco.MjData(m)
    d.qpos[-2:] = 0.002, -0.012
    d.ctrl[1] = -0.012
    contacts = 0
    for _ in range(300):
      d.ctrl[0] = -min(0.008, 0.1 * d.time)
      mujoco.mj_step(m, d)
      contacts = max(contacts, d.ncon)
    found.append((contacts, d.qfrc_constraint[-2]))
  assert found[1][0] == found[0][0]
  assert found[1][1] == pytest.approx(found[0][1], rel=0.01)  # masses are spread otherwise


TILTED = {
  "capsule": 'type="capsule" size=".004 .02" euler="0 60 0"',
  "cylinder": 'type="cylinder" size=".004 .02" euler="0 60 0"',
  "ellipsoid": 'type="ellipsoid" size=".004 .006 .02" euler="0 60 0"',
  "box": 'type="box" size=".004 .006 .02" euler="0 60 0"',
}


@pytest.mark.parametrize("shape", TILTED)
def test_a_tilted_tool_meets_the_nodes_under_it(shape):
  points, elem = sphere(3)
  geom = f'<geom {TILTED[shape]} mass=".05" condim="1"/>'
  joint = '<joint name="z" type="slide" axis="0 0 1"/>'
  tool = f'<body name="tool" pos="0 0 {RADIUS + 0.03}">{joint}{geom}</body>'
  motor = '<actuator><position joint="z" kp="500" kv="10"/></actuator>'
  keys = {"young": 3e4, "foundation": 1e5, "tolerance": 1e-6}
  nodal, window = organ(points, elem, **keys), windowed(points, elem, count="7 5 1", **keys)
  found = []
  for made in (nodal, window):
    m, d, handle = load(world(made, tool, extra=motor))
    if made is nodal:
      lump(handle)
    for _ in range(220):
      d.ctrl[0] = -0.025 * min(1, d.time / 0.15)
      mujoco.mj_step(m, d)
    assert handle.window_overflow == (0, 0)
    found.append((d.qfrc_constraint[-1], handle.displacement))
  assert found[0][0] > 0.05
  assert found[1][0] == pytest.approx(found[0][0], rel=1e-3)
  np.testing.assert_allclose(found[1][1], found[0][1], atol=1e-5)


@pytest.mark.parametrize(
  "place", ['pos="0 0 {z}"', 'pos=".5 .3 {z}"', 'euler="0 10 0" pos="0 0 {z}"']
)
def test_a_windowed_organ_rests_on_a_plane_as_a_nodal_one_does(place):
  points, elem = sphere(2)
  keys = {"young": 3e4, "bulk": 1e5, "damping": 0.01, "tolerance": 1e-6}
  soft = {"solref": "0.01 1"}
  floor = f'<geom type="plane" size="1 1 1" condim="1" {place.format(z=-RADIUS - 0.002)}/>'
  nodal = organ(points, elem, contact=soft, **keys)
  window = windowed(points, elem, count="12 12 1", contact=soft, follow="world", **keys)
  found = []
  for made in (nodal, window):
    m, d, handle = load(world(made, floor, gravity=(0, 0, -9.81)))
    if made is nodal:
      lump(handle)
    mujoco.mj_step(m, d, nstep=300)
    found.append(handle.xpos)
  np.testing.assert_allclose(found[1], found[0], atol=1e-5)


@pytest.mark.parametrize(("young", "offset"), [(3e4, 0.0), (3e6, 0.0), (3e6, 0.0395)])
@pytest.mark.parametrize("resident", [None, "true"])
def test_pinned_vertices_stay_and_carry_a_tool(young, offset, resident):
  points, elem = sphere(3)
  pin = np.flatnonzero(points[:, 2] > 0.03)
  ball = f"""<body pos="{offset} 0 {RADIUS + 0.007}"><joint name="z" type="slide" axis="0 0 1"/>
    <geom size=".006" mass=".03" condim="1" solref=".004 1"/></body>"""
  keys = {"young": young, "foundation": 1e3, "tolerance": 1e-6}
  heights = []
  for made in (
    organ(points, elem, pin=pin, **keys),
    windowed(points, elem, count="12 9 1", pin=" ".join(map(str, pin)), resident=resident, **keys),
  ):
    m, d, handle = load(world(made, ball, gravity=(0, 0, -9.81)))
    for _ in range(10):
      mujoco.mj_step(m, d, nstep=30)
      np.testing.assert_array_equal(handle.displacement[pin], 0.0)
      np.testing.assert_array_equal(handle.xvel[pin], 0.0)
    heights.append(d.qpos[-1])
    assert d.qfrc_constraint[-1] == pytest.approx(0.03 * 9.81, rel=1e-3)  # it is at rest
  assert heights[1] == pytest.approx(heights[0], abs=1e-6)


def test_the_warning_of_a_small_window_tells_the_worst_moment():
  m, d, handle = load(probed(condim=1, count="3 2 1"))
  d.qpos[-2] = 0.02
  counts = []
  for _ in range(200):
    d.ctrl[0] = 0.02 - 0.2 * d.time
    mujoco.mj_step(m, d)
    counts.append(handle.window_overflow[0])
  first = next(count for count in counts if count)
  assert max(counts) > first
  assert f"no room for {max(counts)} nodes" in handle.window_warning
  assert d.warning.number.sum() == 0
