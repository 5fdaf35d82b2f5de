"""`palpate run press`: what it measures, what it writes, and how it ends."""

import csv
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import mujoco
import numpy as np
import palpate
import pytest
import trimesh
from palpate.app import cli, console
from palpate.app.press import command, probe

SHORT = ["--depth", "0.004", "--speed", "0.2", "--hold", "0.1"]
ROWS = {
  "device", "nodes", "elements", "h", "step time, median", "step time, 99th percentile",
  "real-time factor", "contact force, peak", "contact force, static", "indentation",
  "contacts, most", "PCG iterations a step, mean", "PCG iterations a step, most",
  "steps that hit a solve's limit, 200",
}  # fmt: skip
draws = pytest.mark.skipif(
  os.environ.get("MUJOCO_GL", "") not in ("egl", "osmesa"), reason="MUJOCO_GL is not egl or osmesa"
)


def run(out, *words):
  """Runs the job in this process; returns exit code, and the CSV's columns."""
  code = cli.main(["run", "press", *SHORT, "--device", "cpu", "--out", str(out), *words])
  with open(out / "press.csv", newline="", encoding="utf-8") as file:
    rows = list(csv.DictReader(file))
  columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
  return code, {k: v if k == "phase" else v.astype(float) for k, v in columns.items()}


def table(text):
  return {m[1]: m[2] for m in re.finditer(r"^(\S.*?)  +(\S.*)$", text, re.M)}


def test_the_table_says_what_the_csv_holds(tmp_path, capsys):
  code, data = run(tmp_path)
  shown = table(capsys.readouterr().out)
  assert code == 0
  assert set(shown) >= ROWS
  force = np.linalg.norm([data[f"force_{axis}_N"] for axis in "xyz"], axis=0)
  assert (shown["nodes"], shown["elements"], shown["h"]) == ("1000", "1996", "1 ms")
  assert shown["contact force, peak"] == f"{force.max():.4f} N"
  assert shown["indentation"] == f"{1e3 * data['depth_m'].max():.2f} mm"
  assert shown["step time, median"] == f"{1e3 * np.median(data['step_s']):.3f} ms"
  assert float(shown["contacts, most"]) == data["contacts"].max() > 0
  assert float(shown["PCG iterations a step, most"]) == data["iterations"].max() > 0


def test_the_probe_goes_to_the_depth_and_back(tmp_path):
  _, data = run(tmp_path)
  order = [data["phase"][0]]
  order += [b for a, b in zip(data["phase"], data["phase"][1:], strict=False) if a != b]
  assert order == ["approach", "press", "hold", "release"]
  np.testing.assert_allclose(np.diff(data["time_s"]), 1e-3, atol=1e-6)
  held = data["phase"] == "hold"
  assert data["depth_m"][held][-1] == pytest.approx(0.004, abs=5e-5)  # the servo gives 1e-5 m
  assert data["force_z_N"][held][-1] > 0.02  # up, on the probe
  assert data["force_z_N"][-1] == 0
  # The probe's axis meets a node: it goes as deep as the probe, and comes back.
  assert data["node_m"][held][-1] == pytest.approx(0.004, rel=0.25)
  assert data["node_m"][-1] < 5e-4


def test_a_run_repeats(tmp_path):
  first, second = run(tmp_path)[1], run(tmp_path)[1]
  for name in set(first) - {"step_s"}:
    np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def test_speed_step_and_configuration_act(tmp_path, capsys):
  twice = [f"--set={key}" for key in ("young=16000", "foundation=2e5", "bulk=40000")]
  force = []
  for words in ([], twice):
    run(tmp_path, "--h", "0.002", "--speed", "0.1", *words)
    shown = table(capsys.readouterr().out)
    assert shown["h"] == "2 ms"
    force.append(float(shown["contact force, static"].split()[0]))
  assert force[1] == pytest.approx(2 * force[0], rel=0.1)  # the contact stays as soft as it was


def test_the_organ_is_made_anew_with_the_nodes_and_seed_asked_for(tmp_path, capsys):
  code, _ = run(tmp_path, "--nodes", "300", "--seed", "3")
  assert code == 0
  assert table(capsys.readouterr().out)["nodes"] == "300"


def test_the_shipped_organ_is_what_the_code_makes():
  shipped = trimesh.load_mesh(command.folder() / "assets" / "organ.obj", process=False)
  vertices, triangles = command.organ_mesh()
  made = trimesh.Trimesh(vertices, triangles, process=False)
  assert len(shipped.vertices) == len(made.vertices) == 1000
  assert shipped.is_watertight
  assert shipped.volume == pytest.approx(made.volume, rel=1e-3)
  # Rounding elsewhere may move nodes along the surface, which stays where it is.
  np.testing.assert_allclose(shipped.bounds, made.bounds, atol=5e-4)


def test_force_on_the_probe_is_minus_that_on_the_organ():
  model = mujoco.MjModel.from_xml_path(str(command.folder() / "scene.xml"))
  data = mujoco.MjData(model)
  organ = palpate.Organ(model, data, "organ")
  tool = probe.find(model, "probe")
  compared = 0
  for sample in probe.press(model, data, organ, tool, depth=0.002, speed=0.2, hold=0.01):
    force = np.array([sample.force_x_N, sample.force_y_N, sample.force_z_N])
    np.testing.assert_allclose(force, -organ.force, atol=1e-9)
    along = data.qfrc_constraint[model.jnt_dofadr[tool.joint]]
    np.testing.assert_allclose(force @ data.xaxis[tool.joint], along, atol=1e-9)
    compared += sample.contacts > 0
  assert compared > 10


def test_a_probe_that_meets_nothing_ends_with_1(tmp_path, capsys):
  scene = (command.folder() / "press.xml").read_text()
  scene = scene.replace('pos="0.007 -0.0124 0.0565"', 'pos="0.5 0 0.06"')
  shutil.copytree(command.folder() / "assets", tmp_path / "assets")
  (tmp_path / "scene.xml").write_text(scene)
  code, data = run(tmp_path, "--scene", str(tmp_path / "scene.xml"), "--speed", "1")
  assert code == 1
  assert "the probe met no organ within its range" in capsys.readouterr().err
  assert set(data["phase"]) == {"approach"}


def test_a_probe_that_goes_through_ends_with_1_and_tells_no_force(tmp_path, capsys):
  code, data = run(tmp_path, "--depth", "0.04", "--h", "0.002")
  said = capsys.readouterr()
  assert code == 1
  at = float(re.search(r"went through the surface at t = ([\d.]+) s", said.err)[1])
  assert table(said.out)["contact force, static"] == "-"
  assert data["pierced"].sum() == 1 and data["pierced"][-1] == 1
  assert data["time_s"][-1] == pytest.approx(at, abs=1e-3)
  assert 0.015 < data["depth_m"][-1] < 0.04


@pytest.mark.parametrize("geom", ["sphere", "capsule", "cylinder", "box", "ellipsoid"])
def test_the_front_of_a_probe_is_a_radius_behind_its_end(geom):
  end = {"sphere": 0.004, "ellipsoid": 0.006, "cylinder": 0.01, "box": 0.01, "capsule": 0.014}[geom]
  size = "0.004 0.005 0.006" if geom == "ellipsoid" else "0.004 0.01 0.01"
  model = mujoco.MjModel.from_xml_string(
    f"""<mujoco><worldbody><body euler="0 90 0" pos="1 2 3">
    <joint name="probe" type="slide" axis="0 0 1"/><geom type="{geom}" size="{size}" mass="1"/>
    </body></worldbody>
    <actuator><position name="probe" joint="probe" kp="9" ctrlrange="0 1"/></actuator></mujoco>"""
  )
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  front = probe.front(model, data, probe.find(model, "probe"))
  np.testing.assert_allclose(front, [1 + end - 0.004, 2, 3], atol=1e-9)


def test_the_table_counts_the_steps_that_hit_the_limit(tmp_path, capsys):
  run(tmp_path, "--set=iterations=2", "--set=tolerance=1e-6")
  shown = table(capsys.readouterr().out)
  assert int(shown["steps that hit a solve's limit, 2"]) > 100
  assert float(shown["largest residual of those"]) > 1e-6


def test_an_error_of_the_organ_ends_with_1_and_keeps_the_data(tmp_path, capsys, monkeypatch):
  contact_force, calls = probe.contact_force, []

  def spoil(model, data, *rest):
    calls.append(data.time)
    if len(calls) == 30:
      data.qpos[10] = 1e8  # large enough to break the solve, small enough for MuJoCo to go on
    return contact_force(model, data, *rest)

  monkeypatch.setattr(probe, "contact_force", spoil)
  code, data = run(tmp_path)
  error = capsys.readouterr().err
  assert code == 1
  assert "organ 'organ'" in error
  assert "the data up to there is kept" in error
  assert 30 <= len(data["time_s"]) < 60


def test_ctrl_c_keeps_the_data_and_ends_with_130(tmp_path):
  words = ["run", "press", "--hold", "60", "--device", "cpu", "--out", str(tmp_path)]
  process = subprocess.Popen(
    [sys.executable, "-m", "palpate", *words],
    stdout=subprocess.PIPE,
    stderr=subprocess.PIPE,
    text=True,
  )
  file = tmp_path / "press.csv"
  for _ in range(1200):
    if file.exists() and file.stat().st_size > 20000:
      break
    time.sleep(0.05)
  process.send_signal(signal.SIGINT)
  output, error = process.communicate(timeout=60)
  assert process.returncode == 130, error
  assert "interrupted" in error
  assert "Traceback" not in error
  with open(file, newline="", encoding="utf-8") as opened:
    rows = list(csv.DictReader(opened))
  assert len(rows) > 100
  assert None not in rows[-1].values()
  assert f"{len(rows)} steps" in output


def test_a_second_ctrl_c_does_not_wait():
  with pytest.raises(KeyboardInterrupt), console.Interrupt() as interrupt:
    signal.raise_signal(signal.SIGINT)
    assert interrupt.seen
    signal.raise_signal(signal.SIGINT)


def test_the_plot_shows_the_press(tmp_path, capsys):
  image = pytest.importorskip("matplotlib.image")
  run(tmp_path)
  assert f"{tmp_path / 'press.png'}: force and displacement over time" in capsys.readouterr().out
  picture = image.imread(tmp_path / "press.png")
  assert picture.shape[1] > 800
  assert picture[..., :3].std() > 0.02


@draws
@pytest.mark.parametrize("name", ["press.mp4", "press.gif"])
def test_the_film_shows_the_press(name, tmp_path, capsys):
  imageio = pytest.importorskip("imageio.v3")
  pytest.importorskip("imageio_ffmpeg")
  code, _ = run(tmp_path, "--hold", "0", "--video", str(tmp_path / name))
  assert code == 0
  frames = int(re.search(rf"{name}: (\d+) frames", capsys.readouterr().out)[1])
  film = imageio.imread(tmp_path / name)
  assert film.shape[1:] == (480, 640, 3)
  assert 0.8 * frames <= len(film) <= frames  # a GIF joins frames that are the same
  assert film[0].std() > 20
  assert np.abs(film[0].astype(int) - film[frames // 2]).max() > 50  # the probe has moved


@draws
def test_the_picture_is_of_the_deepest_point(tmp_path):
  imageio = pytest.importorskip("imageio.v3")
  code, _ = run(tmp_path, "--picture")
  assert code == 0
  assert imageio.imread(tmp_path / "press_deepest.png").shape == (960, 1280, 3)


def test_a_missing_extra_is_named(tmp_path, capsys, monkeypatch):
  find = importlib.util.find_spec
  monkeypatch.setattr(
    importlib.util, "find_spec", lambda name, *a: None if name == "imageio" else find(name, *a)
  )
  assert cli.main(["run", "press", "--video", "--out", str(tmp_path)]) == 1
  assert "imageio is not installed: pip install 'palpate[video]'" in capsys.readouterr().err


def test_without_matplotlib_the_rest_is_there(tmp_path, capsys, monkeypatch):
  find = importlib.util.find_spec
  monkeypatch.setattr(
    importlib.util, "find_spec", lambda name, *a: None if name == "matplotlib" else find(name, *a)
  )
  code, data = run(tmp_path)
  assert code == 0
  assert len(data["time_s"]) > 100
  assert (
    "no plot: matplotlib is not installed: pip install 'palpate[plot]'" in capsys.readouterr().err
  )
