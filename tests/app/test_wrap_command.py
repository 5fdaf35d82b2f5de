"""`palpate wrap`: from a file of a user's to a model folder that runs."""

import re

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
def wrap(tmp_path, capsys, monkeypatch):
  """Returns a function that runs the command in a folder: exit code, output, error."""
  from palpate.app import wrap

  # Drawing has tests of its own; the folder must not depend on a GL library here.
  monkeypatch.setattr(wrap, "picture", lambda paths, name: paths[0])
  monkeypatch.chdir(tmp_path)

  def run(*words):
    code = cli.main(["wrap", *map(str, words)])
    said = capsys.readouterr()
    return code, said.out, said.err

  return run


def _listed(folder):
  return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_folder_is_an_organ_that_rests(tmp_path, wrap):
  mesh = _mesh(tmp_path / "spleen.stl", scale=1000)
  out = tmp_path / "spleen"
  code, said, _ = wrap(mesh, "-o", out, "--nodes", 250, "--scale", "mm")
  assert code == 0
  for words in (
    r"foldovers +0",
    r"size +99.* mm",
    r"volume +\d+.* ml",
    r"edges +.* mm",
    r"% of its",
  ):
    assert re.search(words, said), words
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
    (["--scale", "1"], ["try --scale mm (0.14 m)"]),
    (["--scale", "foot"], ["scale is 'foot'", "inch"]),
    (["--name", "a/b"], ["'a/b'", "letters"]),
    (["--name", "scene"], ["'scene'", "expected another"]),
    (["--young", "-5"], ["young", "-5"]),
    (["--nodes", "3"], ["nodes", "3"]),
    (["--label", "3"], ["--label goes with a volume"]),
    (["--method", "direct", "--nodes", "250"], ["keeps all 642"]),
  ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path, wrap, options, words):
  mesh = _mesh(tmp_path / "organ.ply", scale=1000 if "--scale" in options else 1)
  code, _, said = wrap(mesh, "-o", "out", *options)
  assert code == 2
  assert said.count("\n") == 1
  for word in words:
    assert word in said
  assert not (tmp_path / "out").exists()


def test_constants_that_do_not_compile_are_said_in_one_line(tmp_path, capsys):
  mesh = _mesh(tmp_path / "ball.obj")
  code = cli.main(["wrap", str(mesh), "-o", str(tmp_path / "out"), "--young", "1e30"])
  said = capsys.readouterr().err
  assert code == 1 and "does not compile: organ " in said
  assert said.count("\n") == 1


def test_a_missing_file_is_named(tmp_path, wrap):
  code, _, said = wrap(tmp_path / "none.obj", "-o", tmp_path)
  assert code == 2 and "none.obj" in said


def test_a_mesh_called_scene_is_an_organ_solid_or_not(tmp_path, wrap):
  """The usual name of a glTF file is the name of the scene's file as well."""
  for out, name, kind in (("spleen", "spleen", ["--solid"]), ("scene", "organ", [])):
    mesh = _mesh(tmp_path / "scene.glb")
    assert wrap(mesh, "-o", out, "--nodes", 64, "--accept-losses", *kind)[0] == 0
    model = mujoco.MjModel.from_xml_path(str(tmp_path / out / "scene.xml"))
    organ = palpate.Organ(model, mujoco.MjData(model), f"{name}/{name}")
    assert organ.nvert == 64 and (organ.config.elements == "solid") == bool(kind)
    assert (organ.config.foundation == 0) == bool(kind)


def _two(path):
  one, other = (trimesh.creation.icosphere(3, radius) for radius in (0.05, 0.03))
  other.apply_translation([0.1, 0, 0])
  trimesh.util.concatenate([one, other]).export(path)
  return path


def test_losses_end_it_unless_they_are_accepted_or_made_organs(tmp_path, wrap):
  mesh = _two(tmp_path / "two.stl")
  code, _, said = wrap(mesh, "-o", "out", "--nodes", 128)
  assert code == 1
  assert "a separate piece is left out: 112 ml" in said  # 642 nodes of a ball of 113 ml
  assert "--accept-losses" in said and "--pieces" in said
  assert not (tmp_path / "out").exists()
  assert wrap(mesh, "-o", "out", "--nodes", 128, "--accept-losses")[0] == 0
  assert "a separate piece is left out: 112 ml" in (tmp_path / "out" / "README.md").read_text()
  assert wrap(mesh, "-o", "both", "--nodes", 128, "--pieces")[0] == 0
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "both" / "scene.xml"))
  data = mujoco.MjData(model)
  organs = [palpate.Organ(model, data, f"two_{k}/two_{k}") for k in (1, 2)]
  assert organs[0].volume > organs[1].volume
  mujoco.mj_step(model, data)
  np.testing.assert_allclose(organs[1].xpos.mean(axis=0), [0.1, 0, 0], atol=1e-3)


def _scan(path):
  import nrrd

  labels = np.zeros((30, 20, 20), np.int16)
  labels[3:15, 4:16, 4:16], labels[18:27, 5:14, 5:14] = 1, 2
  header = {"space": "right-anterior-superior", "space directions": 4 * np.eye(3)}
  header |= {"Segment0_Name": "Left kidney", "Segment0_LabelValue": "1"}
  nrrd.write(str(path), labels, header)
  return path


def test_labels_are_organs_of_their_own(tmp_path, wrap):
  pytest.importorskip("nrrd")
  scan = _scan(tmp_path / "scan.seg.nrrd")
  code, _, said = wrap(scan, "-o", "out", "--scale", "mm")
  assert code == 2 and "--scale goes with a mesh" in said
  code, _, said = wrap(scan, "-o", "out")
  assert code == 2 and "1 (Left kidney), 2" in said
  assert wrap(scan, "-o", "out", "--nodes", 100, "--label", "all")[0] == 0
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "scene.xml"))
  for name in ("scan_Left_kidney", "scan_2"):
    assert palpate.Organ(model, mujoco.MjData(model), f"{name}/{name}").nvert == 100


def test_a_scan_is_wrapped_by_a_threshold(tmp_path, wrap):
  import nrrd

  x = np.indices((30, 28, 26)) - 13.0
  values = 120.0 - 10 * np.sqrt((x**2).sum(axis=0))  # 0 at 12 voxels of 4 mm
  scan = tmp_path / "mr.nrrd"
  nrrd.write(str(scan), values, {"space": "LPS", "space directions": 4 * np.eye(3)})
  code, _, said = wrap(scan, "-o", "out")
  assert code == 2 and "a scan needs --threshold" in said
  code, said, _ = wrap(scan, "-o", "out", "--nodes", 100, "--threshold", 0)
  assert code == 0 and "30 x 28 x 26 voxels of 4 x 4 x 4 mm; taken: 4" in said
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "scene.xml"))
  organ = palpate.Organ(model, mujoco.MjData(model), "mr/mr")
  assert organ.volume == pytest.approx(4 / 3 * np.pi * 0.048**3, rel=0.09)  # 100 nodes cut off 7 %
  assert wrap(scan, "-o", "inner", "--nodes", 100, "--threshold", -50, "--upper", 60)[0] == 1
  for words, wrong in (
    (["--upper", 3], "--upper goes with --threshold"),
    (["--threshold", 3, "--label", 1], "expected one"),
    (["--threshold", 9, "--upper", 3], "upper is 3, expected a number > 9"),
    (["--threshold", 500], "no voxel has 500 and more, its values are -129"),
  ):
    code, _, said = wrap(scan, "-o", "none", *words)
    assert code == 2 and wrong in said and said.count("\n") == 1
  code, _, said = wrap(_mesh(tmp_path / "organ.ply"), "-o", "none", "--threshold", 3)
  assert code == 2 and "--threshold goes with a volume" in said
  (tmp_path / "series").mkdir()
  code, _, said = wrap("series", "-o", "none")
  assert code == 2 and "a DICOM series needs --threshold" in said
  code, _, said = wrap("series", "-o", "none", "--threshold", 3)
  assert code == 2 and "holds 0 DICOM slices" in said
  code, _, said = wrap("series", "-o", "series", "--force", "--threshold", 3)
  assert code == 2 and "--force writes into" in said


def test_what_is_in_a_folder_is_not_lost(tmp_path, wrap):
  mesh, out, elsewhere = _mesh(tmp_path / "organ.obj"), tmp_path / "out", tmp_path / "elsewhere"
  (out / "assets").mkdir(parents=True)
  elsewhere.write_text("mine")
  (out / "organ.xml").write_text("edited by hand")
  (out / "scene.xml").symlink_to(elsewhere)
  before = _listed(out)
  code, _, said = wrap(mesh, "-o", out, "--nodes", 64)
  assert code == 2 and "not empty" in said and "--force" in said
  assert _listed(out) == before
  assert wrap(mesh, "-o", out, "--nodes", 64, "--force")[0] == 0
  assert elsewhere.read_text() == "mine"
  assert mujoco.MjModel.from_xml_path(str(out / "scene.xml")).nflex == 1


def test_assets_that_are_a_link_are_refused(tmp_path, wrap):
  mesh, out, elsewhere = _mesh(tmp_path / "organ.obj"), tmp_path / "out", tmp_path / "elsewhere"
  out.mkdir()
  elsewhere.mkdir()
  (out / "assets").symlink_to(elsewhere)
  code, _, said = wrap(mesh, "-o", out, "--nodes", 64, "--force")
  assert code == 2 and "is a link" in said
  assert not list(elsewhere.iterdir())


def test_the_mesh_itself_is_not_written_over(tmp_path, wrap):
  (tmp_path / "organ" / "assets").mkdir(parents=True)
  mesh = _mesh(tmp_path / "organ" / "assets" / "organ.obj")
  before = mesh.read_bytes()
  code, _, said = wrap(mesh, "-o", "organ", "--nodes", 64, "--force")
  assert code == 2 and "organ.obj" in said
  assert mesh.read_bytes() == before


@pytest.mark.parametrize("out", ["organ.obj", "organ.obj/in"])
def test_a_file_is_no_folder(tmp_path, wrap, out):
  mesh = _mesh(tmp_path / "organ.obj")
  code, _, said = wrap(mesh, "-o", out)
  assert code == 2 and "organ.obj" in said
  assert said.count("\n") == 1


def test_names_and_folders_are_refused_before_the_work(tmp_path, wrap, monkeypatch):
  from palpate.models.meshing import wrap as wrapping

  def work(*_, **__):
    raise AssertionError("it was begun")

  monkeypatch.setattr(wrapping, "wrap", work)
  mesh = _mesh(tmp_path / "organ.obj")
  for words in (["-o", "out", "--name", "a b"], ["-o", mesh], ["-o", tmp_path]):
    assert wrap(mesh, *words)[0] == 2
