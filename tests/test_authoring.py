"""`palpate.add_organ`: an organ in an MjSpec is the same as a flexcomp in MJCF."""

import mujoco
import numpy as np
import palpate
import pytest
import trimesh
from palpate.models import mjcf
from scenes import load

TISSUE = {"young": 8e3, "foundation": 1e5, "bulk": 2e4, "damping": 0.05, "device": "cpu"}
BALL = trimesh.creation.icosphere(3, 0.04)
MESH = np.array(BALL.vertices), np.array(BALL.faces)
TOOL = 0.02  # [kg]


def world(height=0.0485):
  """Returns a spec with a ball of 8 mm radius on a slide, just above an organ of 4 cm radius."""
  return mujoco.MjSpec.from_string(f"""<mujoco><option timestep="1e-3"/>
    <worldbody><body name="shelf" pos="0 0 .1" euler="0 0 30"/>
      <body name="tool" pos="0 0 {height}"><joint type="slide" axis="0 0 1"/>
        <geom size=".008" mass="{TOOL}"/></body></worldbody></mujoco>""")


@pytest.mark.parametrize("coupling", ["nodal", "window"])
@pytest.mark.parametrize("source", ["stl", "trimesh", "arrays"])
def test_a_ball_rests_with_its_weight(coupling, source, tmp_path):
  """Organ and tool are still after a second; the contacts carry the tool's weight."""
  mesh = {"stl": tmp_path / "organ.stl", "trimesh": BALL, "arrays": MESH}[source]
  if source == "stl":
    BALL.copy().apply_scale(1000).export(mesh)
  spec = world()
  bottom = np.flatnonzero(BALL.vertices[:, 2] < -0.03) if source != "stl" else ()
  windows = coupling == "window"
  flex = palpate.add_organ(
    spec, mesh, scale="mm" if source == "stl" else 1, pin=bottom, windows=windows, **TISSUE
  )
  assert flex.name == "organ"
  model, data, organ = load(spec)
  assert organ.nvert == len(MESH[0])
  assert model.nv < 3 * organ.nvert or coupling == "nodal"
  mujoco.mj_step(model, data, nstep=1000)
  weight = TOOL * 9.81
  np.testing.assert_allclose(np.abs(organ.force), [0, 0, weight], atol=1e-3 * weight)
  assert organ.volume == pytest.approx(BALL.volume, rel=0.02)


def test_it_is_the_flexcomp():
  pin = [0, 5, 7]
  spec = world()
  palpate.add_organ(spec, MESH, mass=0.1, pin=pin, rgba=(1, 0, 0, 1), parent="shelf", **TISSUE)
  text = mjcf.flexcomp(
    "organ", MESH, config=TISSUE, contact=mjcf.CONTACT, pin=pin, digits=17, mass=0.1, radius=0.001,
    rgba=(1, 0, 0, 1),
  )  # fmt: skip
  shelf = f'<body name="shelf" pos="0 0 .1" euler="0 0 30"><body name="o">{text}</body></body>'
  tool = world().to_xml().partition('<body name="tool"')[2].partition("</worldbody>")[0]
  other = mujoco.MjModel.from_xml_string(
    f'<mujoco><option timestep="1e-3"/>{mjcf.extension()}<worldbody>{shelf}'
    f'<body name="tool"{tool}</worldbody></mujoco>'
  )
  model, _, organ = load(spec)
  again = palpate.Organ(other, mujoco.MjData(other), "organ")
  assert organ.config == again.config
  contact = ("solref", "solimp", "solmix", "friction", "condim", "selfcollide", "margin")
  for key in ("elem", "rgba", "radius", "edgedamping", *contact):
    np.testing.assert_array_equal(getattr(model, f"flex_{key}"), getattr(other, f"flex_{key}"), key)
  nodes = [
    [m.body(f"organ_{k}").id for k in range(organ.nvert) if k not in pin] for m in (model, other)
  ]
  for key in ("body_mass", "body_inertia", "body_pos"):
    np.testing.assert_allclose(
      getattr(model, key)[nodes[0]], getattr(other, key)[nodes[1]], rtol=1e-12, err_msg=key
    )
  np.testing.assert_allclose(organ.xpos0, again.xpos0, atol=1e-12)
  np.testing.assert_array_equal(organ.free, again.free)


def test_what_is_left_out_has_a_default_and_the_rest_is_taken():
  spec = world()
  spec.add_material(name="wet", rgba=[0.5, 0.1, 0.1, 1])
  inward = MESH[0], MESH[1][:, ::-1]
  flex = palpate.add_organ(
    spec, inward, "spleen", pos=(0.1, 0, 0), quat=(0.5, 0.5, 0.5, 0.5),
    contact={"friction": (0.7, 0.01), "margin": 1e-4}, radius=0.002, **TISSUE,
  )  # fmt: skip
  flex.material = "wet"
  model, _, organ = load(spec, "spleen")
  free = model.body_mass[model.flex_vertbodyid].sum()
  assert free == pytest.approx(1060 * BALL.volume)
  np.testing.assert_allclose(organ.xpos0.mean(axis=0), [0.1, 0, 0], atol=1e-9)
  np.testing.assert_allclose(model.flex_friction[0], [0.7, 0.01, 0.0001])
  assert organ.volume > 0  # wound outward now
  assert organ.config.poisson == 0.45


def test_two_organs_and_one_with_windows_stand_side_by_side_and_are_saved():
  spec = world()
  for k, windows in enumerate((False, {"nodes": 20})):
    palpate.add_organ(
      spec, MESH, f"organ{k}", pos=(0.2 * k, 0, 0), windows=windows, young=1e3 * (k + 1)
    )
  text = spec.to_xml() if spec.compile() else ""
  model = mujoco.MjModel.from_xml_string(text)
  organs = [palpate.Organ(model, mujoco.MjData(model), f"organ{k}") for k in range(2)]
  assert [organ.config.young for organ in organs] == [(1e3,), (2e3,)]
  assert organs[1].config.window
  assert model.nv < 3 * organs[0].nvert + 3 * 22 + 2


OPEN = MESH[0], MESH[1][1:]
TORN = MESH[0], np.where(np.arange(len(MESH[1]))[:, None] == 3, MESH[1][:, ::-1], MESH[1])


@pytest.mark.parametrize(
  ("mesh", "options", "words"),
  [
    (MESH, {"yung": 3}, ["'organ'", "'yung'", "young"]),
    (MESH, {"young": -3}, ["young is '-3'", "> 0"]),
    (MESH, {"young": [1, 2]}, ["2 values", "1280"]),
    (MESH, {"poisson": 0.6}, ["poisson is '0.6'", "[0, 0.5)"]),
    (MESH, {"device": "abacus"}, ["'abacus'", "cpu"]),
    (MESH, {"resident": True}, ["resident", "only with window"]),
    (MESH, {"window": "w"}, ["windows=True"]),
    (MESH, {"windows": {"node": 9}}, ["windows has 'node'", "tools and nodes"]),
    (MESH, {"windows": {"tools": ["hand"]}}, ["'hand'", "does not exist"]),
    (MESH, {"mass": 0}, ["mass is 0", "> 0"]),
    (MESH, {"pin": [3, 700]}, ["pin has 700", "[0, 642)"]),
    (MESH, {"pin": range(642)}, ["all vertices are pinned"]),
    (MESH, {"radius": -1}, ["radius is -1"]),
    (MESH, {"rgba": (1, 0, 0)}, ["rgba", "four numbers"]),
    (MESH, {"contact": {"slip": 1}}, ["'slip'", "friction"]),
    (MESH, {"contact": {"selfcollide": "yes"}}, ["'yes'", "none, narrow"]),
    (MESH, {"parent": "table"}, ["no body 'table'", "'shelf'"]),
    (MESH, {"parent": "tool"}, ["'tool' above it moves"]),
    (MESH, {"name": "tool"}, ["a body 'tool' already"]),
    (MESH, {"name": ""}, ["name is ''"]),
    (MESH, {"scale": "foot"}, ["'foot'", "inch"]),
    (OPEN, {}, ["mass is missing"]),
    (OPEN, {"mass": 1, "bulk": 1}, ["bulk", "closed surface"]),
    (TORN, {}, ["wound", "palpate wrap"]),
    ((MESH[0], MESH[1] + 9), {}, ["outside 0..641"]),
    (trimesh.creation.icosphere(1, 50.0), {}, ["173 m", "scale='mm'"]),
    ("nowhere.obj", {}, ["nowhere.obj"]),
  ],
)
def test_what_is_wrong_is_named_and_changes_nothing(mesh, options, words):
  spec = world()
  before = spec.compile()
  with pytest.raises((ValueError, FileNotFoundError)) as error:
    palpate.add_organ(spec, mesh, **options)
  for word in words:
    assert word in str(error.value)
  after = spec.compile()
  for key in ("nbody", "nflex", "nplugin", "nv"):
    assert getattr(after, key) == getattr(before, key)
