"""`palpate.add_windows`: any organ gets windows, keeps what it was, and moves as before."""

import re

import mujoco
import numpy as np
import palpate
import pytest
import scenes
from palpate import models
from palpate import windows as author

FRAME = 'pos=".1 .2 .3" euler="0 0 35"'


def spec(**options) -> mujoco.MjSpec:
  """Returns the spec of a ridge between jaws, with a keyframe."""
  made = mujoco.MjSpec.from_string(scenes.ridge(**options))
  free = [0.0] * (3 * (len(made.bodies) - 5))
  made.add_key(name="shut", qpos=[*free, 0.001, 0.002, 0.003], ctrl=[0, 0.006, 0.006])
  return made


def bag(selfcollide: str) -> mujoco.MjSpec:
  """Returns the spec of a limp bag between two balls that press its walls together."""
  points, elem = scenes.sphere(2, 1.0)
  contact = {"condim": 3, "selfcollide": selfcollide}
  keys = {"young": 8e3, "thickness": 1e-3, "foundation": 1e3}
  tissue = scenes.organ(points * [0.02, 0.02, 0.008], elem, mass=0.02, contact=contact, **keys)
  balls = (
    f'<body pos="0 0 {0.0155 * side}"><joint name="{name}" type="slide" axis="0 0 {-side}" '
    'damping="1"/><geom size="0.006" mass="0.05"/></body>'
    for name, side in (("above", 1), ("below", -1))
  )
  drive = "".join(f'<position joint="{name}" kp="500"/>' for name in ("above", "below"))
  document = scenes.world(tissue, *balls, extra=f"<actuator>{drive}</actuator>")
  return mujoco.MjSpec.from_string(document)


def nodal(windowed, **options):
  """Returns the nodal scene with the masses and effective inertia of a windowed one."""
  return nodal_of(windowed, spec(**options))


def nodal_of(windowed, made: mujoco.MjSpec):
  """Returns another nodal scene so."""
  space = scenes.workspace(windowed)
  mass, inertia = space.organ.mass, space.views["inertia"].numpy()
  m, _, organ = scenes.load(made)
  m.body_mass[scenes.bodies(organ)[organ.free]] = mass[organ.free]
  m.dof_armature[scenes.dofs(organ)] = (inertia - mass)[organ.free][:, None]
  mujoco.mj_setConst(m, mujoco.MjData(m))
  return scenes.load(m)


@pytest.mark.parametrize(
  ("tools", "nodes", "frame", "resident"),
  [
    (None, None, "", False),
    (["grasper"], 60, FRAME, False),
    (["left", "right"], None, FRAME, False),
    ([["left", "right"]], 150, "", False),
    (["left", "right"], 80, "", True),
  ],
)
def test_grasp_and_release_equal_nodal_coupling(tools, nodes, frame, resident):
  made = spec(frame=frame)
  assert palpate.add_windows(made, "organ", tools, nodes) == ("organ_window",)
  made.plugins[0].config = made.plugins[0].config | {"resident": str(resident).lower()}
  m, d, organ = scenes.load(made)
  windowed = scenes.grasp(m, d, organ)
  reference = scenes.grasp(*nodal(organ, frame=frame))
  peak = np.abs(reference[0]).max()
  moved = np.abs(reference[1] - organ.xpos0).max()
  assert peak > 0.02 and moved > 1e-3
  assert reference[0][-1] == pytest.approx(0.0, abs=1e-3 * peak)  # released
  assert np.abs(windowed[0] - reference[0]).max() < 5e-3 * peak
  assert np.abs(windowed[1] - reference[1]).max() < 5e-3 * moved
  assert organ.window_warning is None and organ.error is None


def test_saved_as_xml_it_loads_as_plain_mjcf_and_moves_the_same():
  made = spec()
  palpate.add_windows(made, "organ", ["left", "right"])
  m, d, organ = scenes.load(made)
  again = scenes.load(mujoco.MjModel.from_xml_string(made.to_xml()))
  assert again[0].nv == m.nv
  forces, other = scenes.grasp(m, d, organ, 320)[0], scenes.grasp(*again, 320)[0]
  # XML has six digits of a position, and a node that slides off a jaw may do so a step later.
  gap = np.abs(other - forces).max(axis=1) / np.abs(forces).max()
  assert np.quantile(gap, 0.98) < 5e-3


def test_what_the_organ_was_is_carried_over():
  made = spec(contact={"margin": 0.0003, "contype": 2, "conaffinity": 5, "priority": 1})
  before = made.compile()
  (name,) = palpate.add_windows(made, "organ")
  m, d, organ = scenes.load(made)
  organ_flex, window = (
    mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_FLEX, flex) for flex in ("organ", name)
  )
  np.testing.assert_allclose(scenes.workspace(organ).organ.mass.sum(), 0.02, rtol=1e-6)
  np.testing.assert_array_equal(m.flex_rgba[organ_flex], before.flex_rgba[0])
  for key in ("contype", "conaffinity", "condim", "friction", "solref", "margin", "priority"):
    values = getattr(m, f"flex_{key}")[window]
    np.testing.assert_array_equal(values, getattr(before, f"flex_{key}")[0])
  assert m.flex_contype[organ_flex] == m.flex_conaffinity[organ_flex] == 0
  nodal_organ = palpate.Organ(before, mujoco.MjData(before), "organ")
  np.testing.assert_array_equal(organ.free, nodal_organ.free)
  np.testing.assert_allclose(organ.xpos0, nodal_organ.xpos0, atol=1e-9)
  assert organ.config.young == (2e4,) and organ.config.bulk == 1e4
  mujoco.mj_resetDataKeyframe(m, d, 0)
  assert [d.joint(name).qpos[0] for name in ("z", "left", "right")] == [0.001, 0.002, 0.003]
  mujoco.mj_step(m, d)
  assert np.abs(organ.displacement).max() < 1e-3


def test_more_nodes_than_the_window_holds_warn_once():
  made = spec()
  palpate.add_windows(made, "organ", nodes=12)
  m, d, organ = scenes.load(made)
  seen = []
  mujoco.set_mju_user_warning(lambda text: seen.append(text))
  try:
    scenes.grasp(m, d, organ, 150)
  finally:
    mujoco.set_mju_user_warning(None)
  assert organ.window_overflow[0] > 0
  assert organ.window_warning and "'organ'" in organ.window_warning
  assert len(seen) == 1 and "no room" in str(seen[0])
  held = scenes.slots(organ)
  assert (held >= 0).sum() == 12
  inside = np.full(organ.nvert, np.inf)  # 1 on a jaw, 0 in its middle
  for name in ("left", "right"):
    away = (organ.xpos - d.geom(name).xpos) / m.geom(name).size
    inside = np.minimum(inside, np.linalg.norm(away, axis=1))
  nearest = np.argsort(inside)
  assert set(nearest[:4]) <= set(held) and len(set(nearest[:12]) & set(held)) >= 9


def test_attached_with_a_prefix_names_still_fit():
  world = mujoco.MjSpec()
  world.option.gravity = [0, 0, 0]
  for k, prefix in enumerate(("a/", "b/")):
    child = models.organ("kidney", nodes=250, coupling="window")
    world.attach(child, prefix=prefix, frame=world.worldbody.add_frame(pos=[0.5 * k, 0, 0]))
  m = world.compile()
  d = mujoco.MjData(m)
  organs = [palpate.Organ(m, d, f"{prefix}kidney") for prefix in ("a/", "b/")]
  flexes = [scenes.workspace(organ).organ.windows.flex for organ in organs]
  assert flexes[0] != flexes[1]
  mujoco.mj_step(m, d)
  assert m.nv < 250 and all(organ.error is None for organ in organs)


def test_catalogue_with_windows_presses_as_without():
  forces = []
  for coupling in ("nodal", "window"):
    m = models.load("kidney", nodes=1000, instruments=("probe",), coupling=coupling).compile()
    d = mujoco.MjData(m)
    mujoco.mj_resetDataKeyframe(m, d, 1)
    organ = palpate.Organ(m, d, "kidney/kidney")
    for _ in range(300):
      d.ctrl[2] = min(0.015 + 0.05 * d.time, 0.025)
      mujoco.mj_step(m, d)
    forces.append(np.linalg.norm(organ.force))
  assert m.nv < 600 and organ.window_warning is None
  assert forces[0] > 0.1
  assert forces[1] == pytest.approx(forces[0], rel=0.01)  # other masses, so another way in
  with pytest.raises(ValueError, match="expected nodal or window"):
    models.load("kidney", nodes=250, coupling="none")


@pytest.mark.parametrize("coupling", ["nodal", "window", "by hand"])
def test_organ_of_a_world_that_is_attached_in_a_turned_frame(coupling):
  points, elem = scenes.sphere(2, 1.0)
  build = scenes.windowed if coupling == "by hand" else scenes.organ
  tissue = build(points * [0.010, 0.02, 0.03], elem, foundation=1e4, mass=0.02)
  text = scenes.world(tissue)
  if coupling == "by hand":  # MuJoCo attaches a body with a plugin where its instance has a name
    keys = re.search(r"<plugin[^>]*[^/]>(.*?)</plugin>", text, re.S)[1]
    text = text.replace(f">{keys}</plugin>", ' instance="x"/>')
    instance = f'<instance name="x">{keys}</instance></plugin></extension>'
    text = re.sub(r"/>\s*</extension>", f">{instance}", text)
  child = mujoco.MjSpec.from_string(text)
  world = mujoco.MjSpec.from_string(scenes.world())
  frame = world.worldbody.add_frame(pos=[0.1, 0, 0], quat=[0.5, 0.5, 0.5, 0.5])  # x to y to z
  world.attach(child, prefix="a/", frame=frame)
  if coupling == "window":
    palpate.add_windows(world, "a/organ")
  m, d, organ = scenes.load(world, "a/organ")
  size = np.ptp(organ.xpos0, axis=0)
  np.testing.assert_allclose(size, [0.06, 0.02, 0.04], rtol=0.02)  # z is now along x
  organ.set_state(organ.xpos0 + np.array([0, 0.001, 0]))
  if coupling == "nodal":
    mujoco.mj_forward(m, d)
    np.testing.assert_allclose(d.flexvert_xpos, organ.xpos, atol=1e-12)
  mujoco.mj_step(m, d)
  assert organ.error is None
  if coupling != "nodal":
    node, body = scenes.slots(organ), scenes.slot_bodies(organ)
    mujoco.mj_kinematics(m, d)
    np.testing.assert_allclose(d.xpos[body[node >= 0]], organ.xpos[node[node >= 0]], atol=1e-9)
  # The foundation takes it back, along y alone.
  speed = organ.xvel.mean(axis=0)
  assert speed[1] < 0 and np.abs(speed[[0, 2]]).max() < 1e-3 * abs(speed[1])


def press_flat(m, d, organ):
  """Presses a `bag` flat; returns the balls' forces in each step [N], (400, 2)."""
  forces = []
  for _ in range(400):
    d.ctrl[:] = 0.0095 * min(1.0, d.time / 0.2)
    mujoco.mj_step(m, d)
    forces.append(d.actuator_force.copy())
  assert organ.error is None and organ.window_warning is None
  return np.array(forces)


def test_walls_that_meet_bear_each_other():
  made = bag("auto")
  palpate.add_windows(made, "organ")
  m, d, organ = scenes.load(made)
  force = press_flat(m, d, organ)
  assert (d.contact.flex >= 0).all(axis=1).any()  # the organ touches itself
  reference = press_flat(*nodal_of(organ, bag("auto")))
  through = press_flat(*scenes.load(bag("none")))
  assert force[-1, 0] > 2 * through[-1, 0]
  assert np.abs(force - reference).max() < 5e-3 * force.max()


def test_organs_of_a_spec():
  made = spec()
  assert author.organs(made) == {"organ": False}
  palpate.add_windows(made, "organ")
  assert author.organs(made) == {"organ": True}


@pytest.mark.parametrize(
  ("options", "organ", "tools", "words"),
  [
    ({}, "liver", None, ["'liver'", "'organ'"]),
    ({}, "organ", ["hand"], ["'hand'", "does not exist"]),
    ({}, "organ", "left", ["'left'", "list"]),
    ({}, "organ", [], ["list"]),
    ({}, "organ", ["organ_1"], ["'organ_1'", "collides"]),
  ],
)
def test_bad_requests_are_named(options, organ, tools, words):
  made = spec(**options)
  with pytest.raises(ValueError) as error:
    palpate.add_windows(made, organ, tools)
  for word in words:
    assert word in str(error.value)


def test_a_refusal_changes_nothing():
  made = spec()
  before = made.to_xml()
  for tools, nodes in ((["organ_1"], None), (None, 2)):
    with pytest.raises(ValueError):
      palpate.add_windows(made, "organ", tools, nodes)
  assert made.to_xml() == before


def test_a_second_time_is_refused():
  made = spec()
  palpate.add_windows(made, "organ")
  with pytest.raises(ValueError, match="already"):
    palpate.add_windows(made, "organ")


def test_a_table_that_nobody_follows_is_pointed_out():
  table = '<geom name="table" type="plane" size="1 1 .1" pos="0 0 -.1"/>'
  with pytest.warns(UserWarning, match="'table'"):
    palpate.add_windows(spec(extra=table), "organ")


def test_what_no_window_follows_is_listed_once_and_in_words():
  arm = "".join(f'<geom type="capsule" size=".01 .05" pos="0 0 {k}"/>' for k in (1, 2))
  extra = f'<body name="arm" pos="0 0 3">{arm}<geom name="tip" size=".01"/></body>'
  with pytest.warns(UserWarning) as said:
    made = mujoco.MjSpec.from_string(scenes.ridge(extra=extra))
    palpate.add_windows(made, "organ", ["grasper"])
  (text,) = [str(each.message) for each in said if "no window follows" in str(each.message)]
  assert text.count("a capsule of body 'arm'") == 2 and "geom 'tip' of body 'arm'" in text


def test_the_motion_of_a_keyframe_that_windows_leave_out_is_pointed_out():
  made = spec()
  m = made.compile()
  bent = m.qpos0.copy()
  bent[: -len(("z", "left", "right"))] = 1e-3
  made.keys[0].qpos = bent
  with pytest.warns(UserWarning, match=r"keyframes \['shut'\].*plugin_state.*set_state"):
    palpate.add_windows(made, "organ")


def test_a_tool_may_have_many_geoms():
  geoms = '<geom size=".001" mass="1e-4"/>' * 40
  extra = f'<body name="brush" pos="0 0 .2"><freejoint/>{geoms}</body>'
  made = mujoco.MjSpec.from_string(scenes.ridge(extra=extra))
  palpate.add_windows(made, "organ")
  m, d, organ = scenes.load(made)
  forces, _ = scenes.grasp(m, d, organ)
  assert organ.error is None and np.abs(forces).max() > 0.02
