"""The scenes: names, rest, contact, keyframes, and the page on authoring."""

import pathlib
import re

import mujoco
import numpy as np
import palpate
import pytest
from palpate import models
from palpate.models import catalog, measure, trocar
from palpate.models.handle import Handle
from scenes import load

NAMES = models.NAMES
CAMERAS = ["laparoscope", "overview", "side"]
KEYFRAMES = ["home", "touch", "press"]
AUTHORING = pathlib.Path(__file__).parents[2] / "docs" / "authoring.md"


@pytest.fixture(autouse=True)
def _log_nothing(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  yield
  assert not (tmp_path / "MUJOCO_LOG.TXT").exists(), (tmp_path / "MUJOCO_LOG.TXT").read_text()


@pytest.fixture(params=NAMES)
def scene(request):
  return request.param, mujoco.MjModel.from_xml_path(str(models.path(request.param)))


def _names(model, kind: str) -> list[str]:
  count = getattr(model, {"camera": "ncam", "key": "nkey", "site": "nsite"}[kind])
  return [getattr(model, kind)(i).name for i in range(count)]


def test_names(scene):
  name, model = scene
  assert _names(model, "camera") == CAMERAS
  assert _names(model, "key") == KEYFRAMES
  marks = [f"{name}/{name}_{mark}" for mark in models.targets(name)]
  assert set(marks) < set(_names(model, "site"))
  assert len(marks) >= 3
  assert {"probe/tip", "grasper/tip"} < set(_names(model, "site"))


def test_loader_and_files_agree(scene):
  name, model = scene
  made = models.load(name).compile()
  for field in ("nq", "nv", "nu", "ncam", "nkey", "nsite", "nflexvert", "nsensor"):
    assert getattr(made, field) == getattr(model, field), field
  np.testing.assert_allclose(made.key_qpos, model.key_qpos, atol=1e-6)
  np.testing.assert_allclose(made.qpos0, model.qpos0, atol=1e-6)
  np.testing.assert_allclose(made.flex_vert0, model.flex_vert0, atol=1e-6)
  np.testing.assert_allclose(made.cam_pos, model.cam_pos, atol=1e-6)


def test_rests(scene):
  """Left alone for 2 s nothing moves from 1.5 s on: the shape is that in situ, without gravity."""
  name, model = scene
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key("touch").id)
  organ = palpate.Organ(model, data, f"{name}/{name}")
  tips = [data.site(f"{tool}/tip") for tool in ("probe", "grasper")]
  before = None
  for i in range(2000):
    mujoco.mj_step(model, data)
    if i == 1500:
      before = organ.xpos, [tip.xpos.copy() for tip in tips]
  assert np.abs(organ.xpos - before[0]).max() < 1e-4
  assert np.abs([tip.xpos for tip in tips] - np.array(before[1])).max() < 1e-4
  assert not data.ncon


@pytest.mark.parametrize("name", NAMES)
def test_presses_without_penetration(name):
  model = models.load(name, instruments=("probe",)).compile()
  got = measure.press(model, name)
  assert got.penetration < 1e-3
  assert 0.08 < got.force < 1.5
  assert abs(got.depth - measure.DEPTH) < 3e-4
  assert got.contacts < 60


def test_hidden_lump_is_felt():
  soft, stiff = (
    measure.press(models.load(name, 250, instruments=("probe",)).compile(), name, depth=0.005)
    for name in ("liver", "liver_inclusion")
  )
  assert stiff.force > 1.3 * soft.force


def test_a_grip_pulls_the_livers_edge_out():
  """The jaws close on the inferior tip and go back 12 mm: the tissue follows by 4 mm or more."""
  model, data, organ = load(models.load("liver", instruments=("grasper",)), "liver/liver")
  mujoco.mj_forward(model, data)
  target = data.site("liver/liver_inferior_tip").xpos.copy()
  normal = measure.surface_normal(organ, target)
  vert = np.argmin(np.linalg.norm(organ.xpos0 - target, axis=1))
  tool = trocar.trocar(model, "grasper/")
  moved, contacts = 0.0, 0
  for t in np.arange(0, 1.5, model.opt.timestep):
    depth = np.interp(t, [0, 0.3, 0.9, 1.5], [-0.02, 0.008, 0.008, -0.004])
    data.actuator("grasper/jaw").ctrl = np.interp(t, [0.3, 0.6], [1.0, -0.05])
    data.ctrl[:3] = trocar.inverse(tool, target - depth * normal, check=False)
    mujoco.mj_step(model, data)
    if t > 0.9:
      moved = max(moved, (organ.xpos[vert] - organ.xpos0[vert]) @ normal)
    contacts = max(contacts, data.ncon)
  assert organ.error is None
  assert moved > 4e-3
  assert contacts < 60


@pytest.mark.parametrize(
  ("instruments", "handle"),
  [((), False), (("hook", "scissors"), False), (("grasper", "grasper"), True), (("probe",), True)],
)
def test_instruments_and_handles(instruments, handle):
  model = models.load("kidney", 250, instruments=instruments, handle=handle).compile()
  data = mujoco.MjData(model)
  assert model.nmocap == (len(instruments) if handle else 0)
  for key in range(model.nkey):
    mujoco.mj_resetDataKeyframe(model, data, key)
    start = data.site_xpos.copy()
    mujoco.mj_step(model, data, 100)
    assert np.isfinite(data.qpos).all()
    if model.key(key).name != "press":
      mujoco.mj_kinematics(model, data)
      assert start.shape == data.site_xpos.shape
  if handle:
    prefix = "right_grasper/" if instruments == ("grasper", "grasper") else "probe/"
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    goal = data.site(f"{prefix}tip").xpos + np.array([0.01, 0.005, 0.0])
    Handle(model, data, prefix).move(goal)
    mujoco.mj_step(model, data, 600)
    np.testing.assert_allclose(data.site(f"{prefix}tip").xpos, goal, atol=2e-4)


def test_targets_are_in_the_laparoscopes_view():
  """The places the instruments point at lie within the picture."""
  for name in NAMES:
    model = mujoco.MjModel.from_xml_path(str(models.path(name)))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = data.camera("laparoscope")
    half = np.tan(np.radians(model.camera("laparoscope").fovy[0] / 2))
    for port in catalog.entry(name).ports:
      site = data.site(f"{name}/{name}_{port.landmark}").xpos
      x, y, z = camera.xmat.reshape(3, 3).T @ (site - camera.xpos)
      assert z < 0
      assert abs(y / z) < half
      assert abs(x / z) < half * 4 / 3


def test_scenes_attach_with_prefixes():
  spec = mujoco.MjSpec()
  child = mujoco.MjSpec.from_file(str(models.path("kidney")))
  spec.option, spec.memory, spec.visual.map.zfar = child.option, child.memory, 30
  spec.attach(child, prefix="left/", frame=spec.worldbody.add_frame(pos=[0.1, 0, 0]))
  model = spec.compile()
  palpate.Organ(model, mujoco.MjData(model), "left/kidney/kidney")
  trocar.trocar(model, "left/probe/")


def test_the_page_on_authoring_runs(tmp_path, monkeypatch):
  """Its MJCF has at most 30 lines; its Python runs as it stands."""
  blocks = re.findall(r"```(xml|python)\n(.*?)```", AUTHORING.read_text(), re.S)
  (_, xml), (_, press), *rest = blocks
  assert xml.count("\n") <= 30
  text = xml.replace("MODELS", str(models.path("liver").parents[1]))
  (tmp_path / "my_scene.xml").write_text(text)
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "my_scene.xml"))
  assert model.nflex == 1
  assert _names(model, "camera")
  assert model.nu == 9
  scope: dict = {}
  exec(press, scope)
  assert np.isfinite(scope["data"].qpos).all()
  assert np.linalg.norm(scope["organ"].force) > 0.01
  for kind, block in rest:
    if kind == "python":
      exec(block, scope)
    else:
      mujoco.MjSpec.from_string(f"<mujoco><worldbody>{block}</worldbody></mujoco>")
  assert scope["model"].nv < 900  # 4000 nodes
  windowed = mujoco.MjModel.from_xml_path("my_windowed_scene.xml")
  assert windowed.nv < model.nv / 3
  data = mujoco.MjData(windowed)
  mujoco.mj_step(windowed, data)
  assert palpate.Organ(windowed, data, "organ/liver").error is None
