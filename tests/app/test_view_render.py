"""`palpate view` and `palpate render`."""

import pathlib
import shutil
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("imageio")
import imageio.v3 as imageio
import mujoco
from palpate import models
from palpate.app import cli

SIZE = ("--size", "160x120")


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  monkeypatch.delenv("DISPLAY", raising=False)
  monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


pytestmark = pytest.mark.usefixtures("can_render")


def _render(*words: str) -> np.ndarray:
  assert cli.main(["render", *words, "-o", "out.png", *SIZE]) == 0
  image = imageio.imread("out.png")
  assert image.shape == (120, 160, 3)
  return image.astype(int)


def test_picture_shows_a_press():
  words = ("kidney", "--nodes", "250", "--keyframe")
  still, pressed = _render(*words, "touch"), _render(*words, "press", "--seconds", "0.3")
  red = still[..., 0] > 2 * still[..., 2] + 30  # the organ, lit
  assert 0.05 < red.mean() < 0.7
  moved = np.abs(still - pressed).max(axis=2) > 12
  assert (moved & red).mean() > 0.002
  assert np.ptp(still) > 100


@pytest.mark.parametrize("option", ["--edges", "--wireframe", "--forces", "--sites"])
def test_options_draw_something(option):
  words = ["kidney", "--nodes", "250"]
  words += ["--keyframe", "press", "--seconds", "0.2"] if option == "--forces" else []
  assert (np.abs(_render(*words) - _render(*words, option)).max(axis=2) > 20).mean() > 2e-4


def test_a_command_without_a_screen_chooses_how_to_draw(monkeypatch):
  monkeypatch.delenv("MUJOCO_GL", raising=False)
  command = shutil.which("palpate", path=str(pathlib.Path(sys.executable).parent))
  if command is None:
    pytest.skip("the palpate command is not installed")
  words = ["render", "press", "-o", "drawn.png", *SIZE]
  subprocess.run([command, *words], check=True, timeout=300)
  assert np.ptp(imageio.imread("drawn.png")) > 100


def test_cameras_differ():
  words = ["kidney", "--nodes", "250", "--camera"]
  laparoscope, side, free = (_render(*words, name) for name in ("laparoscope", "side", "free"))
  assert np.abs(laparoscope - side).mean() > 1
  assert np.abs(free - side).mean() > 1


@pytest.mark.parametrize("name", models.NAMES)
def test_every_camera_shows_the_organ_in_light(name):
  model = mujoco.MjModel.from_xml_path(str(models.path(name)))
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, 0)
  mujoco.mj_forward(model, data)
  with mujoco.Renderer(model, 120, 160) as renderer:
    for camera in (-1, *range(model.ncam)):
      renderer.update_scene(data, camera)
      image = renderer.render().astype(float)
      renderer.enable_segmentation_rendering()
      renderer.update_scene(data, camera)
      organ = renderer.render()[..., 1] == mujoco.mjtObj.mjOBJ_FLEX
      renderer.disable_segmentation_rendering()
      assert organ.mean() > 0.03 and image[organ].mean() > 40, camera


def test_every_way_to_name_a_scene(tmp_path):
  folder = models.path("gallbladder").parent
  shown = [_render(str(models.path("gallbladder"))), _render(str(folder)), _render("press")]
  np.testing.assert_array_equal(shown[0], shown[1])
  assert np.ptp(shown[2]) > 100 and np.abs(shown[2] - shown[0]).mean() > 5


def test_help_lists_the_scenes(capsys):
  for command in ("view", "render"):
    with pytest.raises(SystemExit):
      cli.main([command, "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert f"{', '.join(models.NAMES)}, abdomen or press; an exercise such as" in said
    assert "250 or 1000" in said and "probe,grasper" in said


def test_path_of_a_scene():
  assert np.ptp(_render(str(models.path("gallbladder")))) > 100


def test_the_expert_is_at_work_in_pictures_and_films_of_an_exercise():
  later = _render("touch/easy", "--seconds", "1.0")
  words = ["touch/easy", "--seconds", "1.0", "--fps", "2", "-o", "film.gif"]
  assert cli.main(["render", *words, *SIZE]) == 0
  start, half = (frame[..., :3].astype(int) for frame in imageio.imiter("film.gif"))
  for moved in (half, later):
    assert (np.abs(start - moved).max(axis=2) > 40).mean() > 0.01  # the shaft


@pytest.mark.parametrize("suffix", ["webp", "jpg"])
def test_small_pictures(suffix):
  assert cli.main(["render", "kidney", "--nodes", "250", "-o", f"small.{suffix}", *SIZE]) == 0
  like = _render("kidney", "--nodes", "250")
  assert np.abs(imageio.imread(f"small.{suffix}").astype(int) - like).mean() < 8


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_film(suffix, capsys):
  if suffix == "mp4":
    pytest.importorskip("imageio_ffmpeg")
  words = ["kidney", "--nodes", "250", "--keyframe", "press", "--seconds", "0.1", "--fps", "50"]
  words += ["-o", f"film.{suffix}"]
  assert cli.main(["render", *words, *SIZE]) == 0
  assert "5 frames of 160 x 120" in capsys.readouterr().out
  assert len(list(imageio.imiter(f"film.{suffix}"))) == 5


@pytest.mark.parametrize(
  ("words", "message"),
  [
    (["spleen"], "scene is 'spleen', expected one of liver, liver_inclusion,"),
    (["liver", "--nodes", "7"], "nodes is 7, expected one of 250, 1000"),
    (["liver", "--instruments", "saw"], "'saw', expected one of probe"),
    (["liver", "--size", "big"], "size is 'big', expected WxH"),
    (["kidney", "--nodes", "250", "--camera", "x"], "expected one of laparoscope, overview, side"),
    (["kidney", "--nodes", "250", "--keyframe", "x"], "the scene has home, touch, press"),
    (["liver", "--seconds", "-1"], "seconds is -1"),
    (["liver", "--fps", "0"], "fps is 0"),
  ],
)
def test_bad_input(words, message, capsys):
  assert cli.main(["render", *words, "-o", "out.png"]) == 2
  error = capsys.readouterr().err
  assert message in error
  assert error.count("\n") == 1


def test_bad_files(tmp_path, capsys):
  assert cli.main(["render", "liver", "-o", "out.bmp"]) == 2
  assert "expected a name that ends in .png" in capsys.readouterr().err
  (tmp_path / "broken.xml").write_text("<mujoco><worldbody>")
  assert cli.main(["render", "broken.xml", "-o", "out.png"]) == 2
  assert "scene broken.xml: XML parse error" in capsys.readouterr().err
  assert cli.main(["render", "press", "-o", "broken.xml/out.png"]) == 1
  assert "out: cannot write 'broken.xml'" in capsys.readouterr().err
  assert cli.main(["render", "broken.xml", "-o", "out.png", "--nodes", "250"]) == 2
  assert "goes with a named organ" in capsys.readouterr().err


def test_view_needs_a_display(capsys):
  assert cli.main(["view", "liver"]) == 1
  assert "no display" in capsys.readouterr().err
  with pytest.raises(SystemExit):
    cli.main(["view"])


def test_view_gives_the_viewer_handles(monkeypatch):
  viewer = pytest.importorskip("mujoco.viewer")
  seen = []
  monkeypatch.setenv("DISPLAY", ":0")
  monkeypatch.setattr(viewer, "launch", lambda loader: seen.extend([loader(), loader()]))
  assert cli.main(["view", "kidney", "--nodes", "250", "--keyframe", "touch"]) == 0
  model, data, name = seen[0]
  assert model.camera(model.vis.global_.cameraid).name == "laparoscope"
  assert model.nmocap == 2 and name == "kidney"
  assert seen[1][0] is not model  # the viewer's button to load anew
  np.testing.assert_allclose(data.site("probe/tip").xpos, data.mocap_pos[0], atol=1e-6)
