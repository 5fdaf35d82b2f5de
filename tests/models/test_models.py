"""The organs' files and the loader."""

import pathlib
import re

import mujoco
import numpy as np
import palpate
import pytest
from palpate import models, screen
from palpate.models import build, catalog, organs, shapes
from palpate.tasks.core import scenes

NAMES = models.NAMES


@pytest.fixture(autouse=True)
def _log_nothing(tmp_path, monkeypatch):
  """MuJoCo writes its warnings to a file in the working folder: there must be none."""
  monkeypatch.chdir(tmp_path)
  yield
  assert not (tmp_path / "MUJOCO_LOG.TXT").exists(), (tmp_path / "MUJOCO_LOG.TXT").read_text()


def _attached(name: str, *prefixes: str) -> mujoco.MjSpec:
  spec = mujoco.MjSpec()
  for i, prefix in enumerate(prefixes):
    child = mujoco.MjSpec.from_file(str(models.path(name, scene=False)))
    frame = spec.worldbody.add_frame(pos=[0.5 * i, 0, 0], quat=[0.8, 0, 0.6 * i, 0.6 * (1 - i)])
    spec.attach(child, prefix=prefix, frame=frame)
  return spec


@pytest.mark.parametrize("name", NAMES)
def test_organ_and_scene_files_load(name):
  for path in (models.path(name, scene=False), models.path(name)):
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert not sum(int(w.number) for w in data.warning)


@pytest.mark.parametrize("name", NAMES)
def test_files_are_what_the_source_makes(name):
  files = build.files(name)
  assert len(files) == (4 if catalog.entry(name).backdrop else 3)
  for path, text in files.items():
    assert path.read_bytes() == text.encode(), f"{path.name}: run python -m palpate.models.build"


def test_what_is_behind_an_organ_is_drawn_smooth():
  """MuJoCo draws a triangle flat whose normal is far from its nodes'; the notch had shards."""
  model = mujoco.MjModel.from_xml_path(str(models.path("gallbladder")))
  mesh = model.mesh("liver").id
  start = model.mesh_faceadr[mesh]
  face = model.mesh_face[start : start + model.mesh_facenum[mesh]]
  corner = model.mesh_vert[model.mesh_vertadr[mesh] + face].astype(float)
  normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
  normal /= np.linalg.norm(normal, axis=1, keepdims=True)
  of_nodes = model.mesh_normal[model.mesh_normaladr[mesh] + face]
  assert np.einsum("md,mkd->mk", normal, of_nodes).min() > 0.8


@pytest.mark.parametrize("name", NAMES)
def test_folder_is_complete(name):
  folder = models.path(name).parent
  picture = folder / f"{name}.webp"
  assert picture.stat().st_size < 100_000
  readme = (folder / "README.md").read_text()
  tissue = catalog.entry(name).tissue
  numbers = {
    "young": f"{tissue.young:g} Pa",
    "poisson": f"| {tissue.poisson:g} |",
    "thickness": f"{1e3 * tissue.thickness:g} mm",
    "foundation": f"{tissue.foundation:g} Pa/m",
    "bulk": f"{tissue.bulk:g} Pa",
    "damping": f"| {tissue.damping:g} s |",
    "density": f"| {tissue.density:g} kg/m^3 |",
  }
  for word in (picture.name, "Apache-2.0", *numbers.values()):
    assert word in readme


README = pathlib.Path(models.path("liver")).parents[1] / "README.md"


def test_the_list_of_models_is_whole():
  text = README.read_text()
  for name in (*NAMES, "press", "instruments"):
    assert re.search(rf"^\| \[`{name}`\]", text, re.M), name
  for name, tissue in catalog.TISSUES.items():
    numbers = f"{tissue.young:g} Pa | {1e3 * tissue.thickness:g} mm | {tissue.foundation:g} Pa/m"
    assert f"| `{name}` | {numbers} | {tissue.bulk:g} Pa |" in text
  for path in README.parent.glob("*.py"):
    assert path.name == "__init__.py" or f"`{path.name}`" in text, path.name


@pytest.mark.parametrize("name", catalog.TISSUES)
def test_every_number_has_a_source(name):
  tissue = catalog.TISSUES[name]
  numbers = set(tissue.keys()) | {"density" if tissue.mass is None else "mass"}
  assert set(tissue.sources) == numbers
  assert all(len(source) > 8 for source in tissue.sources.values())


def test_exercises_have_a_tissue_of_their_own_that_says_so():
  """Experts and references of the exercises were recorded with these numbers."""
  keys = ("mass", "young", "thickness", "foundation", "bulk", "damping", "poisson")
  recorded = {
    "liver": (0.4, 5.4e3, 0.003, 4e5, 0, 0.005, 0.45),
    "kidney": (0.15, 1e4, 0.006, 1e5, 0, 0.005, 0.45),
    "stomach": (0.2, 2e4, 0.003, 2e5, 0, 0.005, 0.45),
    "gallbladder": (0.05, 1.5e4, 0.002, 1.5e4, 1e4, 0.005, 0.45),
  }
  for organ, numbers in recorded.items():
    tissue = catalog.TISSUES[f"{organ}_field"]
    assert tuple(getattr(tissue, key) for key in keys) == numbers
    assert "in the field of view" in tissue.title
    assert catalog.TISSUES[organ].title.startswith("Whole")
    spec = scenes.build(scenes.Scene(organ=organ, nodes=250, center=models.targets(organ)[0]))
    model = spec.compile()
    config = palpate.Organ(model, mujoco.MjData(model), scenes.ORGAN).config
    assert config.young == (tissue.young,) and config.foundation == tissue.foundation


@pytest.mark.parametrize("nodes", [250, 1000, pytest.param(4000, marks=pytest.mark.slow)])
def test_resolution(nodes):
  model = models.load("kidney", nodes, instruments=()).compile()
  organ = palpate.Organ(model, mujoco.MjData(model), "kidney/kidney")
  assert abs(organ.nvert - nodes) <= 0.1 * nodes
  assert np.isfinite(organ.volume)
  entry = catalog.entry("kidney")
  volume = entry.tissue.density * organ.volume
  mass = model.body_mass[np.unique(model.flex_vertbodyid)].sum()
  np.testing.assert_allclose(mass, volume, rtol=0.1)  # pinned nodes carry none


@pytest.mark.slow
@pytest.mark.parametrize("name", catalog.NAMES)
def test_finest_resolution(name):
  model = models.load(name, 16000, instruments=()).compile()
  assert abs(model.nflexvert - 16000) <= 1600


@pytest.mark.parametrize(("name", "coupling"), [("liver_inclusion", "window"), ("kidney", "nodal")])
def test_a_solid_organ_is_pressed(name, coupling):
  model = models.load(name, 250, coupling=coupling, interior="solid").compile()
  data = mujoco.MjData(model)
  organ = palpate.Organ(model, data, f"{name}/{name}")
  mujoco.mj_resetDataKeyframe(model, data, model.key("press").id)
  mujoco.mj_step(model, data, nstep=400)
  assert organ.config.elements == "solid" and organ.error is None
  assert 0.1 < np.linalg.norm(organ.force) < 5.0
  assert 0.005 < np.abs(organ.displacement).max() < 0.012


def test_what_cannot_be_solid_says_why():
  with pytest.raises(ValueError, match="expected none: it is hollow"):
    models.load("stomach", 250, interior="solid")


@pytest.mark.parametrize("side", [16, pytest.param(32, marks=pytest.mark.slow)])
def test_grid(side):
  model = models.organ("gallbladder", grid=side).compile()
  assert model.nflexvert == side * side + 2
  assert palpate.Organ(model, mujoco.MjData(model), "gallbladder").volume > 0


def test_seed_is_a_variant_and_repeats():
  first, again, other = (organs.Build(catalog.entry("kidney"), 250, 0, s) for s in (3, 3, 4))
  np.testing.assert_array_equal(first.vertices, again.vertices)
  assert abs(first.volume / other.volume - 1) > 1e-3
  assert models.load("kidney", 250, seed=3).compile().nflexvert == len(first.vertices)


@pytest.mark.parametrize("name", NAMES)
def test_patches_are_pinned_and_sites_on_the_surface(name):
  model = mujoco.MjModel.from_xml_path(str(models.path(name, scene=False)))
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  organ = palpate.Organ(model, data, name)
  entry = catalog.entry(name)
  pins = np.concatenate(list(shapes.patches(entry.shape, organ.xpos0).values()))
  np.testing.assert_array_equal(np.flatnonzero(~organ.free), np.unique(pins))
  spacing = np.sqrt(np.linalg.norm(np.ptp(organ.xpos0, axis=0)) ** 2 / organ.nvert)
  for mark in shapes.landmarks(entry.shape):
    site = data.site(f"{name}_{mark}").xpos
    assert np.linalg.norm(organ.xpos0 - site, axis=1).min() < spacing


def test_inclusion_is_stiff_under_its_landmark():
  model = mujoco.MjModel.from_xml_path(str(models.path("liver_inclusion", scene=False)))
  data = mujoco.MjData(model)
  organ = palpate.Organ(model, data, "liver_inclusion")
  young = np.array(organ.config.young)
  entry = catalog.entry("liver_inclusion")
  assert len(young) == len(organ.elem)
  middle = organ.xpos0[organ.elem].mean(axis=1)
  mujoco.mj_forward(model, data)
  site = data.site(f"liver_inclusion_{entry.inclusion.landmark}").xpos
  distance = np.linalg.norm(middle - site, axis=1)
  assert young[np.argmin(distance)] > 0.7 * entry.inclusion.young
  np.testing.assert_allclose(young[distance > 0.1], entry.tissue.young)


@pytest.mark.parametrize("name", ["liver", "liver_inclusion", "gallbladder"])
def test_attaches_twice(name):
  model = _attached(name, "a/", "b/").compile()
  data = mujoco.MjData(model)
  a, b = (palpate.Organ(model, data, f"{prefix}/{name}") for prefix in "ab")
  assert model.nplugin == 2
  assert a.config == b.config
  force = np.zeros(3)
  body = model.flex_vertbodyid[np.flatnonzero(a.free)[0]]
  data.xfrc_applied[body, 2] = 0.1
  model.opt.gravity = force
  mujoco.mj_step(model, data, 20)
  assert np.abs(a.displacement).max() > 1e-5
  assert np.abs(b.displacement).max() < 1e-8  # rest edges are rounded to float32


def test_mjcf_attach_and_include_twice(tmp_path):
  organ = models.path("kidney", scene=False)
  text = f"""<mujoco><asset><model name="k" file="{organ}"/></asset><worldbody>
    <frame pos="0 0 0.3" euler="30 0 50"><attach model="k" prefix="one/"/></frame>
    <attach model="k" prefix="two/"/></worldbody></mujoco>"""
  model = mujoco.MjModel.from_xml_string(text)
  for prefix in ("one", "two"):
    palpate.Organ(model, mujoco.MjData(model), f"{prefix}/kidney")
  file = tmp_path / "scene.xml"
  file.write_text(f'<mujoco><include file="{organ}"/></mujoco>')
  for asset in (organ.parent / "assets").iterdir():
    (tmp_path / "assets").mkdir(exist_ok=True)
    (tmp_path / "assets" / asset.name).write_bytes(asset.read_bytes())
  assert mujoco.MjModel.from_xml_path(str(file)).nflex == 1


@pytest.mark.parametrize("name", NAMES)
def test_dm_control(name):
  screen.import_dm_control()
  dm_mujoco = pytest.importorskip("dm_control.mujoco", reason="dm_control is not installed")
  physics = dm_mujoco.Physics.from_xml_path(str(models.path(name)))
  physics.reset(keyframe_id=physics.model.name2id("press", "key"))
  physics.step(nstep=100)
  assert np.isfinite(physics.data.qpos).all()
  assert physics.named.data.site_xpos["probe/tip"].shape == (3,)


def test_liver_rests_under_gravity():
  """Weight sags the organ that stands alone; then it is still: < 0.1 mm from 1.5 to 2 s."""
  model = mujoco.MjModel.from_xml_path(str(models.path("liver", scene=False)))
  model.opt.timestep = 0.002
  data = mujoco.MjData(model)
  organ = palpate.Organ(model, data, "liver")
  assert model.opt.gravity[2] < -9
  mujoco.mj_step(model, data, 750)
  before = organ.displacement
  mujoco.mj_step(model, data, 250)
  assert np.abs(organ.displacement - before).max() < 1e-4
  assert 1e-4 < np.abs(before).max() < 5e-3


def test_bad_input():
  with pytest.raises(ValueError, match="'spleen', expected one of liver, liver_inclusion, stom"):
    models.load("spleen")
  with pytest.raises(ValueError, match="'spleen', expected one of"):
    models.path("spleen")
  with pytest.raises(ValueError, match="'liver': nodes is 300, expected one of 250, 1000, 4000"):
    models.load("liver", 300)
  with pytest.raises(ValueError, match="'liver': grid is 20, expected one of 16, 32, 64, 128, 256"):
    models.organ("liver", grid=20)
  with pytest.raises(ValueError, match="'drill', expected one of probe, grasper, scissors, hook"):
    models.load("liver", instruments=("drill",))
  with pytest.raises(ValueError, match="3 names, expected at most two"):
    models.load("liver", instruments=("probe",) * 3)
  with pytest.raises(ValueError, match="expected a tuple such as"):
    models.load("liver", instruments="probe")
  with pytest.raises(ValueError, match="seed is -1, expected"):
    models.load("liver", seed=-1)
  assert all(isinstance(models.path(name), pathlib.Path) for name in NAMES)
