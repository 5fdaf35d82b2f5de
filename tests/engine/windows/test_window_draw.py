"""Windowed organs in pictures and films: the deformed surface, in every way MuJoCo draws."""

import os
import pathlib
import subprocess
import sys

import mujoco
import numpy as np
import palpate
import pytest
from palpate.app import cli
from palpate.app.press import figures
from scenes import drive, load, probed

CAMERA = '<camera name="side" pos="0 -.2 .12" xyaxes="1 0 0 0 .5 .9"/>'
LIT = "<worldbody><light pos='.1 -.2 .3' dir='-.3 .5 -.8'/>" + CAMERA


def lit(text: str) -> str:
  """Returns a scene with a light and a camera, its window not drawn."""
  text = text.replace("<worldbody>", LIT)
  return text.replace('<flexcomp name="window"', '<flexcomp name="window" group="4"')


def picture(m, d) -> np.ndarray:
  renderer = mujoco.Renderer(m, 120, 160)
  try:
    renderer.update_scene(d, "side")
    return renderer.render().astype(int)
  finally:
    renderer.close()


def draw():
  """Prints how a windowed organ's picture differs from a nodal one's, and from that at rest."""
  m = mujoco.MjModel.from_xml_string(lit(probed()))
  d = mujoco.MjData(m)
  mujoco.mj_forward(m, d)
  still = picture(m, d)
  drive(m, d, 110)
  pressed = picture(m, d)
  n = mujoco.MjModel.from_xml_string(lit(probed(False)))
  other = mujoco.MjData(n)
  palpate.Organ(n, other, "organ").set_state(palpate.Organ(m, d, "organ").xpos)
  other.qpos[-2:] = d.qpos[-2:]
  mujoco.mj_forward(n, other)
  mujoco.mj_forward(m, d)
  same = picture(n, other)
  print(np.abs(pressed - same).mean(), np.abs(pressed - still).mean())


@pytest.mark.parametrize("backend", ["egl", "osmesa"])
def test_a_windowed_organ_looks_like_a_nodal_one(backend):
  code = f"""if True:
    import importlib.util, sys
    try:
      import mujoco
      mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except Exception as error:
      print(error)
      sys.exit(77)
    sys.path.insert(0, {str(pathlib.Path(__file__).parents[2])!r})
    spec = importlib.util.spec_from_file_location("drawing", {__file__!r})
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.draw()"""
  run = subprocess.run(
    [sys.executable, "-c", code],
    env={**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend},
    capture_output=True,
    text=True,
  )
  if run.returncode == 77:
    pytest.skip(f"no {backend} here: {run.stdout.strip()[:80]}")
  assert run.returncode == 0, run.stderr
  wrong, moved = map(float, run.stdout.split())
  assert moved > 0.5
  assert wrong < 0.05 * moved


def test_a_snapshot_brings_the_shape_back():
  m, d, organ = load(probed())
  drive(m, d, 110)
  kept, shape = figures.snapshot(m, d), organ.xpos
  assert np.abs(shape - organ.xpos0).max() > 1e-3
  drive(m, d, 250)
  assert np.abs(organ.xpos - shape).max() > 1e-3

  class Renderer:  # takes the place of one that draws
    def update_scene(self, data, camera):
      scn = mujoco.MjvScene(m, 1000)
      mask = mujoco.mjtCatBit.mjCAT_ALL
      mujoco.mjv_updateScene(m, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), mask, scn)

    def render(self):
      flex = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_FLEX, "organ")
      first = m.flex_vertadr[flex]
      return d.flexvert_xpos[first : first + organ.nvert].copy()

  np.testing.assert_allclose(figures.frame(m, d, kept, Renderer()), shape, atol=1e-7)


@pytest.mark.usefixtures("can_render")
def test_picture_of_a_press_with_a_window(tmp_path):
  imageio = pytest.importorskip("imageio.v3")
  images = []
  for coupling in ("nodal", "window"):
    words = ["run", "press", "--coupling", coupling, "--hold", "0.01", "--depth", ".008"]
    words += ["--speed", ".1", "--out", str(tmp_path / coupling), "--h", "0.002", "--picture"]
    assert cli.main(words) == 0
    images.append(imageio.imread(tmp_path / coupling / "press_deepest.png").astype(int))
  assert np.abs(images[0] - images[1]).mean() < 0.3


@pytest.mark.usefixtures("can_render")
def test_render_shows_edges_of_the_organ_alone(tmp_path):
  imageio = pytest.importorskip("imageio.v3")
  images = []
  for coupling in ("nodal", "window"):
    words = ["kidney", "--nodes", "250", "--keyframe", "press", "--seconds", "0.1", "--edges"]
    out = str(tmp_path / f"{coupling}.png")
    words += ["--coupling", coupling, "-o", out, "--size", "160x120"]
    assert cli.main(["render", *words]) == 0
    images.append(imageio.imread(out).astype(int))
  assert np.abs(images[0] - images[1]).mean() < 1.0
