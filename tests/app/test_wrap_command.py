"""`palpate wrap`: from a file of a user's to a model folder that runs."""

import mujoco
import numpy as np
import palpate
import pytest
import trimesh
from palpate.app import cli


def _mesh(path, scale=1.0):
  mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05 * scale)
  mesh.vertices *= [1, 0.8, 0.6]
  mesh.export(path)
  return path


@pytest.fixture
def draws(monkeypatch):
  from palpate.app import wrap

  # Drawing has tests of its own; the folder must not depend on a GL library here.
  monkeypatch.setattr(wrap, "_picture", lambda paths, name: paths[0])


def test_the_folder_is_an_organ_that_rests(tmp_path, capsys, draws):
  mesh = _mesh(tmp_path / "spleen.stl", scale=1000)
  out = tmp_path / "spleen"
  code = cli.main(["wrap", str(mesh), "-o", str(out), "--nodes", "250", "--scale", "0.001"])
  assert code == 0
  assert "foldovers: 0" in capsys.readouterr().out
  model = mujoco.MjModel.from_xml_path(str(out / "scene.xml"))
  data = mujoco.MjData(model)
  organ = palpate.Organ(model, data, "spleen/spleen")
  assert organ.nvert == 250
  ellipsoid = 4 / 3 * np.pi * 0.05**3 * 0.8 * 0.6
  assert organ.volume == pytest.approx(ellipsoid, rel=0.05)
  mujoco.mj_step(model, data, nstep=50)
  assert np.abs(organ.displacement).max() < 1e-6
  assert organ.error is None
  assert (out / "README.md").read_text().startswith("# spleen")


@pytest.mark.parametrize(
  ("options", "words"),
  [
    (["--scale", "1"], ["scale=0.001"]),
    (["--name", "a/b"], ["'a/b'", "letters"]),
    (["--young", "-5"], ["young", "-5"]),
    (["--nodes", "3"], ["nodes", "3"]),
  ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path, capsys, draws, options, words):
  mesh = _mesh(tmp_path / "organ.ply", scale=1000 if "--scale" in options else 1)
  assert cli.main(["wrap", str(mesh), "-o", str(tmp_path / "out"), "--nodes", "250", *options]) == 2
  said = capsys.readouterr().err
  assert said.count("\n") == 1
  for word in words:
    assert word in said


def test_a_missing_file_is_named(tmp_path, capsys):
  assert cli.main(["wrap", str(tmp_path / "none.obj"), "-o", str(tmp_path)]) == 2
  assert "none.obj" in capsys.readouterr().err
