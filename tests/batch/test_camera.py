"""Cameras of batches against MuJoCo's renderer, of the same states."""

import mujoco as mj
import numpy as np
import palpate
import palpate.batch
import pytest
import trimesh
import warp as wp
from devices import needs_cuda
from palpate.camera import Camera
from palpate.camera.host import Single
from palpate.tasks import suite
from scenes.resting import block

OUTPUTS = ("pixels", "depth", "segmentation", "points")
SIZE = 96
PATH = np.array([[-0.015, -0.01, 0.0], [0.0, 0.005, 0.0], [0.015, -0.006, 0.0]])
# Everything a scene is made of: shapes with and without textures, lamps of both kinds, a mesh, a
# body that moves, a site one can see through, and a sky. They meet nothing: kernels of contacts
# between such shapes take a minute to compile.
SHAPES = """<mujoco>
  <visual>
    <map znear="0.01" zfar="5"/>
    <headlight ambient="0.3 0.3 0.3" diffuse="0.3 0.3 0.3" specular="0.2 0.2 0.2"/>
  </visual>
  <statistic extent="1" center="0 0 0"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.3 0.5 0.7" rgb2="0 0 0.1" width="32"
      height="32"/>
    <texture name="floor" type="2d" builtin="checker" rgb1="0.2 0.3 0.4" rgb2="0.9 0.8 0.7"
      width="64" height="64"/>
    <texture name="cube" type="cube" builtin="flat" mark="cross" rgb1="0.8 0.4 0.2"
      rgb2="0.2 0.4 0.8" markrgb="1 1 1" width="64" height="64"/>
    <material name="floor" texture="floor" texrepeat="3 3" specular="0"/>
    <material name="cube" texture="cube"/>
    <mesh name="pyramid" vertex="0 0 0  0.2 0 0  0 0.2 0  0 0 0.3"/>
  </asset>
  <worldbody>
    <light pos="0.3 -0.4 1" dir="-0.2 0.3 -1" castshadow="false" type="directional"
      diffuse="0.5 0.5 0.4"/>
    <light pos="0.2 0.1 0.8" dir="0 0 -1" castshadow="false" cutoff="40" exponent="3"
      attenuation="0.6 0.1 0.3"/>
    <camera name="eye" pos="0.3 -0.9 0.5" xyaxes="1 0.25 0 0 0.5 1" fovy="55"/>
    <geom type="plane" size="0.8 0.8 0.1" material="floor"/>
    <geom type="box" size="0.1 0.08 0.12" pos="-0.3 0.1 0.12" euler="0 0 30" material="cube"/>
    <geom type="mesh" mesh="pyramid" pos="0 0.3 0" rgba="0.3 0.7 0.3 1"/>
    <geom type="ellipsoid" size="0.1 0.05 0.15" pos="0.35 0.2 0.15" rgba="0.7 0.2 0.5 1"/>
    <site type="sphere" size="0.07" pos="0.05 -0.2 0.1" rgba="1 1 0 0.5"/>
    <body name="swing" pos="0 -0.05 0.4">
      <joint name="swing" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 -0.15" size="0.04" rgba="0.9 0.9 0.2 1"/>
      <geom type="cylinder" size="0.05 0.06" pos="0.1 0.1 0" rgba="0.2 0.6 0.9 1"/>
    </body>
  </worldbody>
</mujoco>"""


def rendered(batch, world, camera, size=SIZE):
  """Returns what MuJoCo's renderer makes of a world: pixels, depth and segmentation."""
  data = mj.MjData(batch.model)
  batch.get_state(world, data)
  mj.mj_forward(batch.model, data)
  with mj.Renderer(batch.model, size, size) as renderer:
    flags, flag = renderer.scene.flags, mj.mjtRndFlag
    renderer.update_scene(data, camera)
    out = {"pixels": renderer.render().copy()}
    flags[flag.mjRND_SKYBOX], flags[flag.mjRND_SEGMENT] = 0, 1
    renderer.enable_depth_rendering()
    out["depth"] = renderer.render().copy()
    renderer.disable_depth_rendering()
    flags[flag.mjRND_SKYBOX], flags[flag.mjRND_SEGMENT] = 1, 0
    renderer.enable_segmentation_rendering()
    return out | {"segmentation": renderer.render().copy()}


def compare(batch, world, camera, seen, seg=0.99, depth=0.99, colour=8.0):
  """Compares a picture with MuJoCo's: its edges are smooth, those of a ray a pixel are not."""
  expected = rendered(batch, world, camera)
  found = {name: array.numpy()[world] for name, array in seen.items()}
  assert (found["segmentation"] == expected["segmentation"]).all(axis=-1).mean() >= seg
  assert (np.abs(found["depth"] - expected["depth"]) < 1e-3).mean() >= depth
  off = np.abs(found["pixels"].astype(float) - expected["pixels"])
  assert off.mean() <= colour
  return found


def exercise(name, nworld, device):
  task = suite.load(*name.split("/"), task_kwargs={"random": 0}).task
  return palpate.batch.make(task.spec(task.variants[0]), nworld, device)


def shapes():
  """Returns `SHAPES` with a block of tissue in it."""
  spec, made = mj.MjSpec.from_string(SHAPES), block()
  palpate.add_organ(
    spec,
    (np.array(made.vertices), np.array(made.faces)),
    pos=[0.1, -0.2, 0.3],
    mass=0.06,
    young=1e4,
    rgba=(0.8, 0.3, 0.3, 1),
  )
  return spec


def test_exercise_looks_as_mujoco_draws_it():
  batch = exercise("grasp/easy", 2, "warp-cpu")
  camera = batch.camera("laparoscope", SIZE, SIZE, OUTPUTS)
  batch.step(3)
  found = compare(batch, 1, "laparoscope", camera.draw(), depth=0.98)
  z, points = found["depth"], found["points"]
  np.testing.assert_allclose(points[..., 2], z, atol=1e-6)
  at = np.tan(np.radians(25)) * (2 * np.arange(SIZE) + 1 - SIZE) / SIZE
  np.testing.assert_allclose(points[..., 0], z * at, atol=1e-5)
  np.testing.assert_allclose(points[..., 1], z * at[:, None], atol=1e-5)


@needs_cuda
@pytest.mark.parametrize("name", ["grasp/easy", "cut/easy"])
def test_cuda_draws_what_the_cpu_draws(name):
  found = []
  for device in ("warp-cpu", "cuda:0"):
    batch = exercise(name, 2, device)
    camera = batch.camera("laparoscope", SIZE, SIZE, OUTPUTS)
    pictures = [{key: array.numpy().copy() for key, array in camera.draw().items()}]
    if name == "cut/easy":
      batch.organ("organ").cut(np.stack([PATH, PATH]), mask=np.array([False, True]))
      pictures.append({key: array.numpy().copy() for key, array in camera.draw().items()})
    found.append(pictures)
  for cpu, gpu in zip(*found, strict=True):
    assert (cpu["segmentation"] == gpu["segmentation"]).mean() > 0.9999
    for key in ("depth", "points"):
      assert (np.abs(cpu[key] - gpu[key]) < 1e-5).mean() > 0.9999
    assert np.abs(cpu["pixels"].astype(float) - gpu["pixels"]).mean() < 0.01


@pytest.mark.parametrize("room", [3, 3000])
def test_large_triangles_are_drawn_by_many_threads_as_by_one(room):
  """As on a GPU; what has no room there is drawn by one."""
  camera = exercise("grasp/easy", 2, "warp-cpu").camera("laparoscope", SIZE, SIZE, OUTPUTS)
  expected = {name: array.numpy().copy() for name, array in camera.draw().items()}
  camera.view.little, some = 20, len(camera.view.solid)
  camera.view.large = wp.zeros((some, room), dtype=wp.vec3i, device=camera.view.large.device)
  found = camera.draw()
  assert (camera.view.nlarge.numpy() > 100).all()
  for name in OUTPUTS:
    np.testing.assert_array_equal(found[name].numpy(), expected[name])


def test_cuts_open_and_heal():
  batch = exercise("cut/easy", 2, "warp-cpu")
  camera = batch.camera("laparoscope", SIZE, SIZE, (*OUTPUTS, "flow"))
  whole = {name: array.numpy().copy() for name, array in camera.draw().items()}
  batch.organ("organ").cut(np.stack([PATH, PATH]), mask=np.array([False, True]))
  batch.step(50)
  seen = camera.draw()
  assert np.abs(seen["flow"].numpy()).max() < 10.0  # cuts have made vertices since
  compare(batch, 0, "laparoscope", seen)
  cut = compare(batch, 1, "laparoscope", seen)
  lip, expected = [batch.model.nflex - 1, mj.mjtObj.mjOBJ_FLEX], rendered(batch, 1, "laparoscope")
  mine, theirs = ((each["segmentation"] == lip).all(axis=-1) for each in (cut, expected))
  assert (mine & theirs).sum() > 0.7 * (mine | theirs).sum()  # a pixel wide
  lips = (cut["segmentation"] != whole["segmentation"][1]).any(axis=-1)
  assert 20 < lips.sum() < 200
  before, after = (each[lips].mean() for each in (whole["pixels"][1], cut["pixels"]))
  assert after < 0.7 * before  # lips are dark; between them the bed shows
  batch.reset()
  again = camera.draw()
  for name in OUTPUTS:
    np.testing.assert_array_equal(again[name].numpy()[1], whole[name][1])


def test_an_open_hollow_organ_shows_its_inside():
  spec = mj.MjSpec()
  spec.visual.headlight.ambient = [0.4] * 3
  spec.worldbody.add_camera(name="eye", pos=[0, 0, 0.3], fovy=30)
  ball = trimesh.creation.icosphere(3, 0.05)
  surface = np.array(ball.vertices), np.array(ball.faces)
  palpate.add_organ(spec, surface, "organ", mass=0.1, spare=150, rgba=(0.3, 0.7, 0.3, 1))
  model = spec.compile()
  data = mj.MjData(model)
  mj.mj_forward(model, data)
  organ, turn = palpate.Organ(model, data, "organ"), np.linspace(0, 2 * np.pi, 60)
  organ.cut(np.stack([0.03 * np.cos(turn), 0.03 * np.sin(turn), 0.04 + 0 * turn], axis=1))
  place, lid = organ.xpos.copy(), organ.pieces[1].vertices
  place[lid, 0] += 0.04
  organ.set_state(place)
  mj.mj_forward(model, data)
  batch = palpate.batch.make(model, 1, "cpu")
  batch.set_state(0, data)
  seen = compare(batch, 0, "eye", batch.camera("eye", SIZE, SIZE, OUTPUTS).draw(), seg=0.98)
  assert (seen["depth"][SIZE // 2, SIZE // 3 : SIZE // 2] > 0.3).all()  # the far wall's inner side
  assert (seen["pixels"][SIZE // 2, SIZE // 3 : SIZE // 2, 1] > 50).all()


def test_shapes_textures_lamps_and_what_one_sees_through():
  batch = palpate.batch.make(shapes(), 2, "warp-cpu")
  camera = batch.camera("eye", SIZE, SIZE, OUTPUTS)
  batch.pose(["swing"], [[0.0], [0.7]])
  seen = camera.draw()
  for world in range(2):
    compare(batch, world, "eye", seen)
  apart = np.abs(seen["depth"].numpy()[0] - seen["depth"].numpy()[1]) > 0.01
  assert 50 < apart.sum() < SIZE * SIZE / 4  # each world has a swing of its own


def test_some_worlds_can_be_drawn():
  batch = exercise("touch/easy", 3, "warp-cpu")
  every = batch.camera("laparoscope", 16, 20)
  one = batch.camera("laparoscope", 16, 20, worlds=[2])
  np.testing.assert_array_equal(every.draw()["pixels"].numpy()[2], one.draw()["pixels"].numpy()[0])
  every.choose(None)
  assert one.pictures["pixels"].shape == (1, 16, 20, 3)


def test_two_lenses_see_a_distance():
  batch = palpate.batch.make(shapes(), 1, "warp-cpu")
  base, size = 0.04, 200
  camera = Camera(
    batch, "eye", size, size, ("depth", "segmentation"), [0, 0], shift=[-base / 2, base / 2]
  )
  seen = {name: array.numpy() for name, array in camera.draw().items()}
  ball = (seen["segmentation"] == [0, int(mj.mjtObj.mjOBJ_SITE)]).all(axis=-1)
  assert ball.sum(axis=(1, 2)).min() > 300
  column = [np.nonzero(each)[1].mean() for each in ball]
  middle = np.linalg.norm([0.3 - 0.05, -0.9 + 0.2, 0.5 - 0.1])  # of the ball, near the axis
  focal = 0.5 * size / np.tan(np.radians(55) / 2)
  assert column[0] - column[1] == pytest.approx(focal * base / middle, rel=0.05)


def pixels_of(place):
  """Returns where places in the camera's frame, z forward, are on a picture of `SHAPES`."""
  focal = 0.5 * SIZE / np.tan(np.radians(55) / 2)
  return focal * place[..., :2] / place[..., 2:] + (SIZE - 1) / 2


def test_flow_of_a_body_is_that_of_its_turn():
  batch = palpate.batch.make(shapes(), 2, "warp-cpu")
  camera = batch.camera("eye", SIZE, SIZE, ("points", "flow", "segmentation"))
  batch.pose(["swing"], [[0.0], [0.1]])
  camera.draw()
  batch.pose(["swing"], [[0.0], [0.2]])
  seen = {name: array.numpy() for name, array in camera.draw().items()}
  np.testing.assert_allclose(seen["flow"][0], 0, atol=1e-4)
  model, data = batch.model, mj.MjData(batch.model)
  mj.mj_forward(model, data)
  place, mat = data.cam_xpos[0], data.cam_xmat[0].reshape(3, 3) @ np.diag([1, -1, -1])
  geoms = np.flatnonzero(model.geom_bodyid == model.body("swing").id)
  kind = seen["segmentation"][1]
  moved = np.isin(kind[..., 0], geoms) & (kind[..., 1] == mj.mjtObj.mjOBJ_GEOM)
  assert moved.sum() > 200
  np.testing.assert_allclose(seen["flow"][1][~moved], 0, atol=1e-4)
  points = seen["points"][1][moved].astype(float)
  hinge, c, s = data.body("swing").xpos, np.cos(-0.1), np.sin(-0.1)
  back = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
  before = (hinge + (place + points @ mat.T - hinge) @ back.T - place) @ mat
  expected = pixels_of(points) - pixels_of(before)
  assert np.abs(expected).max() > 1
  np.testing.assert_allclose(seen["flow"][1][moved], expected, atol=2e-3)


def test_flow_of_tissue_is_that_of_its_stretch():
  model = shapes().compile()
  data = mj.MjData(model)
  mj.mj_forward(model, data)
  organ = palpate.Organ(model, data, "organ")
  camera = Camera(Single(model, data, "cpu"), "eye", SIZE, SIZE, ("points", "flow", "segmentation"))
  camera.draw()
  stretch, shift = np.diag([1.2, 0.9, 1.3]), np.array([0.02, 0.0, 0.03])
  middle = organ.xpos0.mean(axis=0)
  organ.set_state(xpos=middle + shift + (organ.xpos0 - middle) @ stretch)
  mj.mj_forward(model, data)
  seen = {name: array.numpy()[0] for name, array in camera.draw().items()}
  own = seen["segmentation"][..., 1] == mj.mjtObj.mjOBJ_FLEX
  assert own.sum() > 40
  place, mat = data.cam_xpos[0], data.cam_xmat[0].reshape(3, 3) @ np.diag([1, -1, -1])
  points = seen["points"][own].astype(float)
  world = place + points @ mat.T
  before = (middle + (world - shift - middle) / np.diag(stretch) - place) @ mat
  expected = pixels_of(points) - pixels_of(before)
  assert np.abs(expected).max() > 2
  np.testing.assert_allclose(seen["flow"][own], expected, atol=0.1)  # the flex's radius is not cut


@pytest.mark.parametrize(
  "args, message",
  [
    (("lens", 8, 8), "no camera 'lens' in the model, it has 'eye'"),
    (("eye", 0, 8), r"height is 0, expected a whole number in \[1, 1024\]"),
    (("eye", 8, 1025), "width is 1025"),
    (("eye", 8, 8, ("normals",)), r"outputs is \('normals',\), expected some of pixels, depth"),
    (("eye", 8, 8, ()), "outputs is"),
    (("eye", 8, 8, ("depth",), [2]), r"world is 2, expected one in \[0, 2\)"),
    (("eye", 8, 8, ("depth",), []), r"worlds is \[\], expected one or more"),
  ],
)
def test_what_a_camera_cannot_be_is_named(args, message):
  batch = palpate.batch.make(shapes(), 2, "cpu")
  with pytest.raises(ValueError, match=message):
    batch.camera(*args)


def test_a_crowd_is_told_how_many_pictures_fit(monkeypatch):
  batch = palpate.batch.make(shapes(), 2, "cpu")
  monkeypatch.setattr("palpate.camera.camera.room_of", lambda device: 4e6)
  with pytest.raises(ValueError, match=r"worlds to draw are 2, .* expected at most 1"):
    batch.camera("eye", 1000, 1000)
