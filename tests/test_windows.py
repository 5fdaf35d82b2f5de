"""`palpate.add_windows`: any organ gets windows, keeps what it was, and moves as before."""

import mujoco
import numpy as np
import palpate
import pytest
import trimesh
from palpate import models
from palpate import windows as author

STEPS = 450
FRAME = 'pos=".1 .2 .3" euler="0 0 35"'


def scene(frame="", pinned=True, contact='selfcollide="none"', extra=""):
  """Returns MJCF of a ridge of tissue between the jaws of a grasper that also lifts."""
  mesh = trimesh.creation.icosphere(subdivisions=2, radius=1)
  points = mesh.vertices * [0.010, 0.02, 0.03]
  pins = np.flatnonzero(points[:, 2] < -0.02)
  pin = f'<pin id="{" ".join(map(str, pins))}"/>' if pinned else ""
  config = {"young": 2e4, "bulk": 1e4, "foundation": 1e4, "tolerance": 1e-7, "device": "cpu"}
  keys = "".join(f'<config key="{k}" value="{v}"/>' for k, v in config.items())
  jaws = "".join(
    f'<body name="{name}" pos="{0.0165 * side} 0 0">'
    f'<joint name="{name}" type="slide" axis="{-side} 0 0"/><geom name="{name}" type="ellipsoid" '
    f'size="0.004 0.008 0.006" mass="0.01" friction="1" condim="4"/></body>'
    for name, side in (("left", 1), ("right", -1))
  )
  return f"""<mujoco><option timestep="1e-3" cone="elliptic" tolerance="1e-10" gravity="0 0 0"
  integrator="implicitfast"/><size memory="50M"/>
<extension><plugin plugin="palpate.organ"/></extension><worldbody><body name="frame" {frame}>
  <flexcomp name="organ" mass="0.02" type="direct" dim="2" radius="0.0005" rgba=".8 .4 .3 1"
    point="{" ".join(f"{x:.9g}" for x in points.ravel())}"
    element="{" ".join(map(str, mesh.faces.ravel()))}">
    <plugin plugin="palpate.organ">{keys}</plugin><edge damping="1e-9"/>
    <contact condim="4" friction="1" solref="0.004 1" {contact}/>{pin}</flexcomp>
  <body name="grasper" pos="0 0 0.022"><joint name="z" type="slide" axis="0 0 1"/>
    <geom size="0.002" pos="0 0 0.03" mass="0.05" contype="0" conaffinity="0"/>{jaws}</body>
  </body>{extra}</worldbody>
<actuator><position joint="z" kp="1000" kv="20"/><position joint="left" kp="300" kv="5"/>
  <position joint="right" kp="300" kv="5"/></actuator>
<keyframe><key name="shut" qpos="KEY" ctrl="0 .006 .006"/></keyframe></mujoco>"""


def spec(**options) -> mujoco.MjSpec:
  text = scene(**options)
  free = mujoco.MjSpec.from_string(text.partition("<keyframe>")[0] + "</mujoco>")
  key = ["0"] * (3 * (len(free.bodies) - 5)) + [".001", ".002", ".003"]
  return mujoco.MjSpec.from_string(text.replace("KEY", " ".join(key)))


def grasp(m, d, organ, steps=STEPS):
  """Grasps, lifts by 4 mm and lets go; returns the forces on the joints and the positions."""
  dofs = [m.joint(name).dofadr[0] for name in ("z", "left", "right")]
  forces, positions = [], []
  for _ in range(steps):
    shut = 0.0075 * min(1, d.time / 0.1) - 0.008 * np.clip((d.time - 0.33) / 0.05, 0, 1)
    d.ctrl[:] = 0.004 * np.clip((d.time - 0.15) / 0.1, 0, 1), shut, shut
    mujoco.mj_step(m, d)
    forces.append(d.qfrc_constraint[dofs])
    positions.append(organ.xpos)
  return np.array(forces), np.array(positions)


def load(made):
  m = made if isinstance(made, mujoco.MjModel) else made.compile()
  d = mujoco.MjData(m)
  return m, d, palpate.Organ(m, d, "organ")


def nodal(windowed, **options):
  """Returns the nodal scene with the masses and effective inertia of a windowed one."""
  m, _, organ = load(spec(**options))
  mass, inertia = windowed.mass, windowed.inertia
  m.body_mass[organ.bodies[organ.free]] = mass[organ.free]
  m.dof_armature[organ.dofs.ravel()] = np.repeat((inertia - mass)[organ.free], 3)
  mujoco.mj_setConst(m, mujoco.MjData(m))
  return load(m)


@pytest.mark.parametrize(
  ("tools", "nodes", "frame", "resident"),
  [
    (None, None, "", False),
    (["grasper"], 60, FRAME, False),
    (["left", "right"], None, "", False),  # windows of their own, which meet over the ridge
    ([["left", "right"]], 150, "", False),
    (["left", "right"], 90, FRAME, False),  # together more than the organ has nodes
    (["left", "right"], 80, "", True),
  ],
)
def test_grasp_and_release_equal_nodal_coupling(tools, nodes, frame, resident):
  made = spec(frame=frame)
  names = palpate.add_windows(made, "organ", tools, nodes)
  made.plugins[0].config = made.plugins[0].config | {"resident": str(resident).lower()}
  assert len(names) == (2 if tools == ["left", "right"] else 1)
  m, d, organ = load(made)
  windowed = grasp(m, d, organ)
  reference = grasp(*nodal(organ, frame=frame))
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
  m, d, organ = load(made)
  again = load(mujoco.MjModel.from_xml_string(made.to_xml()))
  assert again[0].nv == m.nv
  forces, other = grasp(m, d, organ, 320)[0], grasp(*again, 320)[0]
  # XML has six digits of a position, and a node that slides off a jaw may do so a step later.
  gap = np.abs(other - forces).max(axis=1) / np.abs(forces).max()
  assert np.quantile(gap, 0.98) < 5e-3


def test_what_the_organ_was_is_carried_over():
  made = spec(contact='selfcollide="none" margin=".0003" contype="2" conaffinity="5" priority="1"')
  before = made.compile()
  (name,) = palpate.add_windows(made, "organ")
  m, d, organ = load(made)
  organ_flex, window = (
    mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_FLEX, flex) for flex in ("organ", name)
  )
  np.testing.assert_allclose(organ.mass.sum(), 0.02, rtol=1e-6)
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
  m, d, organ = load(made)
  seen = []
  mujoco.set_mju_user_warning(lambda text: seen.append(text))
  try:
    grasp(m, d, organ, 150)
  finally:
    mujoco.set_mju_user_warning(None)
  assert organ.window_overflow[0] > 0
  assert organ.window_warning and "'organ'" in organ.window_warning
  assert len(seen) == 1 and "no room" in str(seen[0])
  held = organ.slots
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
  assert set(organs[0].bodies).isdisjoint(organs[1].bodies)
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
  text = scene(pinned=False)
  start, stop = text.index("<flexcomp"), text.index("</flexcomp>") + len("</flexcomp>")
  child = mujoco.MjSpec.from_string(
    '<mujoco><extension><plugin plugin="palpate.organ"/></extension>'
    f"<worldbody>{text[start:stop]}</worldbody></mujoco>"
  )
  world = mujoco.MjSpec()
  frame = world.worldbody.add_frame(pos=[0.1, 0, 0], quat=[0.5, 0.5, 0.5, 0.5])  # x to y to z
  world.attach(child, prefix="a/", frame=frame)
  if coupling == "window":
    palpate.add_windows(world, "a/organ")
  elif coupling == "by hand":
    config = dict(child.plugins[0].config) | {"window": "window", "mass": "0.02"}
    keys = "".join(f'<config key="{k}" value="{v}"/>' for k, v in config.items())
    shape = text[text.index("point=") : text.index(">", start)]
    world = mujoco.MjSpec()
    world.attach(
      mujoco.MjSpec.from_string(f"""<mujoco><extension><plugin plugin="palpate.organ">
      <instance name="x">{keys}</instance></plugin></extension><worldbody><body name="organ">
      <plugin plugin="palpate.organ" instance="x"/><flexcomp name="organ" type="direct" dim="2"
      rigid="true" radius="0.0005" {shape}><contact contype="0" conaffinity="0"
      selfcollide="none"/></flexcomp></body><flexcomp name="window" type="grid" count="9 6 1"
      spacing=".01 .01 .01" dim="2" mass=".001" radius="0.0005"><edge damping="1e-9"/>
      <contact selfcollide="none"/></flexcomp></worldbody></mujoco>"""),
      prefix="a/",
      frame=world.worldbody.add_frame(pos=[0.1, 0, 0], quat=[0.5, 0.5, 0.5, 0.5]),
    )
  m = world.compile()
  d = mujoco.MjData(m)
  m.opt.gravity = 0
  organ = palpate.Organ(m, d, "a/organ")
  size = np.ptp(organ.xpos0, axis=0)
  np.testing.assert_allclose(size, [0.06, 0.02, 0.04], rtol=0.02)  # z is now along x
  organ.set_state(organ.xpos0 + np.array([0, 0.001, 0]))
  if coupling == "nodal":
    mujoco.mj_forward(m, d)
    np.testing.assert_allclose(d.flexvert_xpos, organ.xpos, atol=1e-12)
  mujoco.mj_step(m, d)
  assert organ.error is None
  if coupling != "nodal":
    slots = organ.slots
    bodies = organ.bodies[slots >= 0]
    mujoco.mj_kinematics(m, d)
    np.testing.assert_allclose(d.xpos[bodies], organ.xpos[slots[slots >= 0]], atol=1e-9)
  # The foundation takes it back, along y alone.
  speed = organ.xvel.mean(axis=0)
  assert speed[1] < 0 and np.abs(speed[[0, 2]]).max() < 1e-3 * abs(speed[1])


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
    ({"contact": 'selfcollide="auto"'}, "organ", None, ["itself", "nodal"]),
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
