"""Domain randomisation: drawn from ranges, reproducible, undone with the next episode."""

import copy
import json
import pathlib

import numpy as np
import pytest
from palpate import tasks
from palpate.camera import lens
from palpate.tasks.core import episode, observation, randomisation

PAGE = pathlib.Path(__file__).parents[3] / "docs" / "environments.md"
RANGES = {
  "texture": (0, 16),
  "colour": (-0.2, 0.2),
  "stiffness": [0.5, 2],
  "friction": (0.5, 1.5),
  "camera_pos": (-0.01, 0.01),
  "camera_turn": (-5, 5),
  "light": (0.5, 1.5),
  "light_pos": (-0.02, 0.02),
  "camera_fovy": (-5, 5),
  "lens_k1": (-0.2, 0.0),
  "lens_k2": (0.0, 0.1),
  "blur": (-0.02, 0.02),
  "veil": (0.1, 0.3),
  "blood": (0, 8),
  "exposure": (0.8, 1.2),
  "noise": (0.01, 0.05),
}


def load(ranges, **options):
  return tasks.load("touch", "easy", task_kwargs={"random": 0, "randomise": ranges, **options})


def test_a_seed_repeats_what_is_drawn_and_every_episode_draws_anew():
  first, second = (load(ranges) for ranges in (RANGES, dict(reversed(RANGES.items()))))
  drawn = []
  for _ in range(2):
    a, b = first.reset(), second.reset()  # the order of the ranges does not matter
    assert first.task.drawn == second.task.drawn
    assert set(first.task.drawn) == set(RANGES) == set(randomisation.QUANTITIES)
    for name in a.observation:
      np.testing.assert_array_equal(a.observation[name], b.observation[name])
    drawn.append(first.task.drawn)
  for name, (low, high) in RANGES.items():
    values = np.array([each[name] for each in drawn])
    count = randomisation.QUANTITIES[name].count
    assert values.shape[1:] == ((count,) if count > 1 else ())
    assert (values >= low).all() and (values <= high).all() and (values[0] != values[1]).all()


def test_without_ranges_nothing_is_drawn():
  plain, same = load(None), load({})
  np.testing.assert_array_equal(
    plain.reset().observation["tip_pos"], same.reset().observation["tip_pos"]
  )
  assert plain.task.drawn == {}


def test_an_episode_begins_from_the_model_as_compiled():
  # Factors must not pile up.
  env = load({name: (2.0, 2.0) for name in ("stiffness", "friction", "light")})
  found = []
  for _ in range(2):
    env.reset()
    model = env.physics.model.ptr
    found.append(
      [model.flex_friction.copy(), model.light_diffuse.copy(), env.physics.organ.config.young]
    )
  for a, b in zip(*found, strict=True):
    np.testing.assert_array_equal(a, b)
  nominal = load(None)
  nominal.reset()
  np.testing.assert_allclose(found[0][2], 2 * np.array(nominal.physics.organ.config.young))
  np.testing.assert_allclose(found[0][0][:, 0], 2 * nominal.physics.model.ptr.flex_friction[:, 0])


def pressed(factor):
  """Returns how far the organ sags [m], how fast it moves then, and the force of the same push."""
  env = load({"stiffness": (factor, factor)}, damage=100.0)
  env.reset()
  organ = env.physics.organ
  sag, speed = np.abs(organ.displacement).max(), np.abs(organ.xvel).max()
  for _ in range(45):
    env.step(np.array([0.0, 0.0, 0.0, 0.5]))
  return sag, speed, env.physics.peak_force


def test_twice_the_stiffness_is_twice_the_force():
  (sag, speed, soft), (less, _, stiff) = pressed(1.0), pressed(2.0)
  assert less == pytest.approx(sag / 2, rel=0.05) and speed < 1e-5  # at rest
  assert 1.6 < stiff / soft < 2.1  # the instrument gives way too


def seen(ranges, **options):
  names = ("pixels", "segmentation")
  return load(ranges, observations=names, pixels=(48, 64), **options).reset().observation


def test_pictures_change():
  plain, (height, width) = seen(None), (48, 64)
  organ = plain["segmentation"] == observation.LABELS["organ"]

  def colour(found):
    return found["pixels"][organ].mean(axis=0)

  assert (colour(seen({"light": (0.5, 0.5)})) < 0.8 * colour(plain)).all()
  assert (colour(seen({"colour": (0.3, 0.3)})) > colour(plain) + 10).all()
  assert (colour(seen({"exposure": (0.5, 0.5)})) < 0.52 * colour(plain)).all()
  smoke = (0.5, 0.5), 255 * lens.SMOKE
  half = 0.5 * (colour(plain) + smoke[1])
  np.testing.assert_allclose(colour(seen({"veil": smoke[0]})), half, atol=1)
  noise = seen({"noise": (0.1, 0.1)})["pixels"].astype(float) - plain["pixels"]
  assert 0.07 < noise[organ].std() / 255 < 0.11
  wide = seen({"camera_fovy": (20, 20)})["segmentation"] == observation.LABELS["organ"]
  assert wide.mean() < 0.8 * organ.mean()
  other = seen({"texture": (15, 15)})["pixels"].astype(float) - plain["pixels"]
  assert 2 < np.abs(other[organ]).mean() < 30  # below 1 with the first texture: the marker moves
  turned = seen({"camera_turn": (5, 5)})["segmentation"] == observation.LABELS["organ"]
  moved = seen({"camera_pos": (0.02, 0.02)})["segmentation"] == observation.LABELS["organ"]
  assert turned.shape == (height, width)
  for found in (turned, moved):
    assert (found != organ).mean() > 0.05 and found.mean() > 0.05


def looked_at(sent, **drawn):
  return randomisation.see(sent, drawn, fovy=1.0, far=9.0, seed=3)


def test_a_lens_distorts_as_brown_and_conrady_have_it():
  height, width, k1, k2 = 240, 320, -0.3, 0.08
  pixel = 2 * np.tan(0.5) / height
  x, y = np.meshgrid(
    pixel * (np.arange(width) + 0.5 - width / 2), pixel * (np.arange(height) + 0.5 - height / 2)
  )
  sent = np.stack([x, y, np.ones_like(x)], axis=2).astype(np.float32)
  ramp = (128 + 150 * np.stack([x, y, 0 * x], axis=2)).astype(np.uint8)
  seen = looked_at({"points": sent, "pixels": ramp}, lens_k1=k1, lens_k2=k2)
  shown = seen["points"][..., 2] > 0
  assert 0.7 < shown.mean() < 0.95 and not shown[0, 0] and not seen["pixels"][~shown].any()
  at = seen["points"][shown][:, :2]
  r2 = (at**2).sum(axis=1, keepdims=True)
  expected = at * (1 + k1 * r2 + k2 * r2**2)
  where = np.stack([x[shown], y[shown]], axis=1)
  assert np.abs(expected - where).max() < 0.75 * pixel  # the nearest pixel's
  np.testing.assert_allclose(seen["pixels"][shown][:, 0], 128 + 150 * at[:, 0], atol=2)


def test_blur_smears_and_blood_covers():
  sent = np.zeros((40, 60, 3), np.uint8)
  sent[20, 30] = 250
  smeared = looked_at({"pixels": sent}, blur=(0.2, 0.0))["pixels"][..., 0].astype(float)
  assert smeared.sum() == pytest.approx(250, rel=0.05)
  assert np.flatnonzero(smeared.sum(axis=0)).tolist() == [*range(26, 35)]  # 8 pixels
  assert np.flatnonzero(smeared.sum(axis=1)).tolist() == [20]
  grey = np.full((40, 60, 3), 100, np.uint8)
  empty = np.zeros((40, 60, 2), np.uint8)
  seen = looked_at({"pixels": grey, "soiling": empty}, veil=0.4, blood=4.5, exposure=1.2)
  smoke, blood = np.moveaxis(seen["soiling"] / 255, 2, 0)
  np.testing.assert_allclose(smoke, 0.4, atol=1 / 255)
  assert 0.02 < (blood > 0.5).mean() < 0.4 and (blood == 0).mean() > 0.3
  without = 1.2 * (0.6 * 100 + 0.4 * 255 * lens.SMOKE)
  np.testing.assert_allclose(seen["pixels"][blood == 0], without, atol=1)
  assert (seen["pixels"][blood > 0.9][:, 1] < 0.15 * without).all()
  more = looked_at({"soiling": empty}, blood=8.5)["soiling"]
  assert (more[..., 1] > 128).sum() != (seen["soiling"][..., 1] > 128).sum()
  same = looked_at({"pixels": sent}, noise=0.0)
  np.testing.assert_array_equal(same["pixels"], sent)


def test_copies_and_recordings_have_what_was_drawn(tmp_path):
  env = load(RANGES, time_limit=0.2)
  options = {"time_limit": 0.2, "randomise": RANGES}
  recording = episode.run(env, lambda _: np.zeros(4), 3, {"task_kwargs": options})
  assert recording.info["randomised"] == env.task.drawn
  json.dumps(recording.info)
  assert episode.differences(recording, episode.replay(recording)) == []
  twin = copy.deepcopy(env)
  assert twin.task.drawn == env.task.drawn
  for _ in range(2):
    a, b = env.reset(), twin.reset()
    assert twin.task.drawn == env.task.drawn
    np.testing.assert_array_equal(a.observation["nodes_near"], b.observation["nodes_near"])


@pytest.mark.parametrize(
  "ranges, said",
  [
    ({"stiff": (1, 2)}, "randomise has 'stiff', expected some of stiffness, friction, camera_pos"),
    ({"stiffness": (2, 1)}, r"stiffness is \(2, 1\), expected low and high, low <= high, both in"),
    ({"stiffness": (0, 1)}, r"both in \[0.1, 10\]"),
    ({"light": (1, float("nan"))}, r"light is \(1, nan\), expected low and high"),
    ({"friction": 0.5}, "friction is 0.5, expected low and high"),
    ({"camera_pos": "ab"}, "camera_pos is 'ab', expected low and high"),
    (["light"], r"randomise is \['light'\], expected ranges by name"),
  ],
)
def test_wrong_ranges_are_said(ranges, said):
  with pytest.raises(ValueError, match=said):
    load(ranges)


def test_the_page_has_every_quantity():
  assert randomisation.table() in PAGE.read_text()  # paste it anew
