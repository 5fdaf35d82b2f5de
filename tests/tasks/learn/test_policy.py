"""Files of trained policies."""

import dataclasses
import json
import os
import struct

import numpy as np
import pytest

pytest.importorskip("safetensors")

from palpate.tasks import registry, suite
from palpate.tasks.core import performer
from palpate.tasks.learn import demonstrations, policy
from safetensors.numpy import save_file

NAMES = ("target", "held")


def made(task="touch/easy", **changes):
  about = policy.About(task, ("pitch", "yaw", "roll", "insertion"), NAMES, 0.02)
  random = np.random.RandomState(0)
  layers = [(random.randn(n, k), random.randn(n)) for n, k in ((5, 4), (4, 5))]
  fields = {"about": about, "mean": random.randn(4), "scale": random.rand(4), "layers": layers}
  return policy.Policy(**(fields | changes))


SEEN = {"held": np.array([0.5]), "target": np.array([0.01, 0.02, 0.03]), "other": np.zeros(3)}


def test_a_policy_is_what_was_saved(tmp_path):
  made_, path = made(), tmp_path / "policy.safetensors"
  policy.save(path, made_)
  loaded = policy.load(path)
  x = (np.array([0.01, 0.02, 0.03, 0.5]) - made_.mean) * made_.scale
  (a, b), (c, d) = made_.layers
  expected = np.clip(c @ np.tanh(a @ x + b) + d, -1, 1)
  np.testing.assert_allclose(loaded.begin()(SEEN), expected, atol=5e-3)  # half precision
  assert loaded.about.task == "touch/easy" and loaded.about.licence == "Apache-2.0"
  env = suite.load("touch", "easy", task_kwargs={"random": 0})
  act = performer.make(env, str(path))
  assert env.step(act(env.reset())).reward is not None


def test_a_policy_remembers_its_episode_alone(tmp_path):
  torch = pytest.importorskip("torch")
  path, unit = tmp_path / "policy.safetensors", torch.nn.GRU(4, 5)
  names = ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
  memory = tuple(getattr(unit, name).detach().numpy() for name in names)
  layers = [(np.eye(4, 5), np.zeros(4))]
  policy.save(path, made(layers=layers, memory=memory))
  loaded = policy.load(path)
  x = (np.array([0.01, 0.02, 0.03, 0.5]) - loaded.mean) * loaded.scale
  told = unit(torch.tensor(x, dtype=torch.float32).expand(3, 4))[0].detach().numpy()[:, :4]
  for _ in range(2):
    act = loaded.begin()
    np.testing.assert_allclose([act(SEEN) for _ in range(3)], told, atol=2e-3)
  side_by_side = loaded.begin(2)({name: np.stack([seen, seen]) for name, seen in SEEN.items()})
  np.testing.assert_allclose(side_by_side, told[[0, 0]], atol=2e-3)


def test_a_policy_says_small_actions_and_changes():
  about = dataclasses.replace(made().about, power=2.0, changes=("insertion",))
  act = made(about=about, layers=[(np.zeros((4, 4)), np.array([0.1, -0.5, 0.0, 0.5]))]).begin()
  np.testing.assert_allclose(act(SEEN), [0.01, -0.25, 0, 0.25])
  np.testing.assert_allclose(act(SEEN), [0.01, -0.25, 0, 0.5])
  act.last = np.full(4, 0.9)  # somebody else's
  np.testing.assert_allclose(act(SEEN), [0.01, -0.25, 0, 1.0])


def test_a_policy_begins_with_what_the_exercise_holds(tmp_path):
  env = suite.load("needle", "transfer_easy", task_kwargs={"surroundings": "unseen"})
  first, names = env.task.initial_action, tuple(env.task.components)
  assert first[names.index("jaw")] == -1.0 and first[names.index("left_psm_jaw")] > 0
  about = policy.About(
    "needle/transfer_easy",
    names,
    NAMES,
    0.02,
    changes=("jaw", "left_psm_jaw"),
    initial_action=first,
  )
  quiet = made(about=about, layers=[(np.zeros((len(names), 4)), np.zeros(len(names)))])
  path = tmp_path / "policy.safetensors"
  policy.save(path, quiet)
  act = policy.load(path).begin()
  np.testing.assert_array_equal([act(SEEN), act(SEEN)], [first, first])
  both = policy.load(path).begin(2)({name: np.stack([seen, seen]) for name, seen in SEEN.items()})
  np.testing.assert_array_equal(both, [first, first])
  env.task.random.seed(0)
  env.reset()
  for _ in range(30):  # longer than a needle may be loose
    env.step(np.array(first))
  assert env.task.right_holds and not env.task.left_holds and env.task.outcome is None


def test_a_policy_of_something_else_is_refused_by_name(tmp_path):
  path = tmp_path / "policy.safetensors"
  env = suite.load("touch", "easy", task_kwargs={"random": 0})
  about = made().about
  for changes, said in (
    ({"task": "probe/easy"}, "the policy is of probe/easy, not of touch/easy"),
    ({"control_timestep": 0.1}, "acts each 0.1 s, not each 0.02 s"),
    ({"observations": ("target", "felt")}, "observes felt, which observations lack"),
    ({"observations": ("target", "normal")}, "takes 4 numbers, the exercise has 6"),
  ):
    policy.save(path, made(about=dataclasses.replace(about, **changes)))
    with pytest.raises(ValueError, match=said):
      performer.make(env, str(path))


def test_a_file_that_is_none_is_refused(tmp_path):
  path = tmp_path / "policy.safetensors"
  with pytest.raises(ValueError, match=r"policy.safetensors"):
    policy.load(path)
  path.write_bytes(b"weights")
  with pytest.raises(ValueError, match=r"policy '.*policy.safetensors'"):
    policy.load(path)
  save_file({"mean": np.zeros(3, np.float32)}, path)
  with pytest.raises(ValueError, match="is not one of Palpate's"):
    policy.load(path)
  (a, b), last = made().layers
  for layers, said in (
    ([(a[:, :3], b), last], r"weight0 has shape \(5, 3\), expected \(5, 4\)"),
    ([(a, b)], "it ends in 5 numbers, expected 4"),
    ([(a * np.nan, b), last], "not finite"),
  ):
    policy.save(path, made(layers=layers))
    with pytest.raises(ValueError, match=said):
      policy.load(path)
  memory = np.zeros((15, 3)), np.zeros((15, 5)), np.zeros(15), np.zeros(15)
  policy.save(path, made(memory=memory))
  with pytest.raises(ValueError, match=r"input has shape \(15, 3\), expected \(15, 4\)"):
    policy.load(path)


@pytest.mark.parametrize(
  ("changes", "said"),
  [
    ({"power": float("nan")}, "power is nan, expected a finite number > 0"),
    ({"initial_action": (0, 0, 0, 2)}, r"initial_action is \[0, 0, 0, 2\], expected 4 numbers in"),
    ({"initial_action": (0.5,)}, r"initial_action is \[0.5\], expected 4 numbers in \[-1, 1\] or"),
    ({"power": -3.0}, "power is -3.0, expected a finite number > 0"),
    ({"control_timestep": "x"}, "control_timestep is 'x', expected a finite number"),
    ({"components": 5}, "components is 5, expected a list of names"),
    ({"observations": [1, 2]}, r"observations is \[1, 2\], expected a list of names"),
    ({"task": ["x"]}, r"task is \['x'\], expected a text"),
    ({"task_kwargs": "abc"}, "task_kwargs is 'abc', expected options by name"),
  ],
)
def test_a_header_of_wrong_types_is_refused(tmp_path, changes, said):
  path = tmp_path / "policy.safetensors"
  policy.save(path, made(about=dataclasses.replace(made().about, **changes)))
  with pytest.raises(ValueError, match=f"policy.safetensors': {said}"):
    policy.load(path)


@pytest.mark.parametrize("name", ["mean", "scale"])
def test_an_input_that_is_not_normalised_by_finite_numbers_is_refused(tmp_path, name):
  policy.save(tmp_path / "policy.safetensors", made(**{name: np.full(4, np.inf)}))
  with pytest.raises(ValueError, match="not finite"):
    policy.load(tmp_path / "policy.safetensors")


def test_headers_and_arrays_that_cannot_be_read_are_refused(tmp_path):
  path = tmp_path / "policy.safetensors"
  for header in ("[" * 100_000, '{"a":' * 50_000):
    save_file({"mean": np.zeros(3, np.float32)}, path, {"palpate": header})
    with pytest.raises(ValueError, match="its header is nested too deep"):
      policy.load(path)
  for header in ("null", "{}"):
    save_file({"mean": np.zeros(3, np.float32)}, path, {"palpate": header})
    with pytest.raises(ValueError, match="it is of another version"):
      policy.load(path)
  for kind, count in (("BF16", 2), ("F8_E4M3", 4), ("I32", 1)):
    array = {"dtype": kind, "shape": [count], "data_offsets": [0, 4]}
    header = json.dumps({"mean": array, "__metadata__": {"palpate": "{}"}}).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header + bytes(4))
    with pytest.raises(ValueError, match=f"mean is of type {kind}, expected one of F16, F32"):
      policy.load(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_policy_that_is_no_regular_file_is_refused(tmp_path):
  os.mkfifo(tmp_path / "pipe.safetensors")
  for path in (tmp_path / "pipe.safetensors", tmp_path, "/dev/zero"):
    with pytest.raises(ValueError, match="is no regular file"):
      policy.load(path)


def seeing(pixels=(12, 16), head=None):
  """Returns a policy of one feature, which is where a picture is bright, and says where."""
  about = dataclasses.replace(made().about, pixels=pixels, observations=("held",))
  weight = np.zeros((1, 3, 1, 1))
  weight[0, :, 0, 0] = 40.0
  encoder = [(weight, np.zeros(1)), (np.eye(3) if head is None else head, np.zeros(3))]
  layers = [(np.eye(4, 4, 1), np.zeros(4))]  # the first input is what `held` is
  return made(about=about, mean=np.zeros(1), scale=np.ones(1), layers=layers, encoder=encoder)


def test_a_policy_says_where_in_a_picture_something_is(tmp_path):
  path = tmp_path / "policy.safetensors"
  policy.save(path, seeing())
  act = policy.load(path).begin()
  for row, column in ((0, 0), (4, 10), (10, 14)):
    pixels = np.zeros((12, 16, 3), np.uint8)
    pixels[row, column] = 255
    said = act({"held": np.zeros(1), "pixels": pixels})
    # Every second pixel is looked at: 6 rows and 8 columns, from -1 to 1.
    np.testing.assert_allclose(said[:2], np.tanh([column / 7 - 1, row / 5 - 1]), atol=1e-3)
  both = policy.load(path).begin(2)({"held": np.zeros((2, 1)), "pixels": np.stack([pixels] * 2)})
  np.testing.assert_allclose(both, [said, said])


def test_an_encoder_is_that_of_torch():
  torch = pytest.importorskip("torch")
  pytest.importorskip("rsl_rl")
  from palpate.tasks.learn.sight import Encoder

  torch.manual_seed(0)
  encoder, random = Encoder((20, 28)), np.random.RandomState(0)
  pixels = random.randint(0, 256, (3, 20, 28, 3)).astype(np.uint8)
  expected = encoder(torch.from_numpy(pixels).flatten(1)).detach().numpy()
  layers = [(each.weight.detach().numpy(), each.bias.detach().numpy()) for each in encoder.layers]
  np.testing.assert_allclose(policy.encode(pixels, layers), expected, atol=1e-5)
  assert expected.std(axis=0).max() > 0.01


def test_a_policy_of_pictures_is_refused_where_they_are_otherwise(tmp_path):
  path = tmp_path / "policy.safetensors"
  for found, said in (
    (seeing(head=np.eye(3, 4)), r"encoder_weight1 has shape \(3, 4\), expected \(3, 3\)"),
    (seeing(pixels=(0, 8)), r"pixels is \[0, 8\], expected height and width"),
    (seeing(pixels=()), r"pixels is \[\], but 2 layers see them"),
    (dataclasses.replace(seeing(), encoder=()), r"pixels is \[12, 16\], but 0 layers"),
  ):
    policy.save(path, found)
    with pytest.raises(ValueError, match=said):
      policy.load(path)
  for options, said in (
    ({}, "the policy observes pixels, which observations lack"),
    ({"pixels": (16, 16)}, "the policy sees 12 x 16 pixels, the exercise draws 16 x 16"),
  ):
    options = {"observations": ["sensors", "held", *(["pixels"] if options else [])], **options}
    env = suite.load("touch", "easy", task_kwargs={"random": 0, **options})
    with pytest.raises(ValueError, match=said):
      seeing().check(env)


SHIPPED = sorted(policy.FOLDER.glob(f"*{policy.SUFFIX}"))
PLAYED = ("grasp_easy", "touch_easy")  # always: others take minutes


def test_policies_that_come_along_are_small_and_of_their_exercise():
  assert (policy.FOLDER / "LICENSE").exists()
  for path in SHIPPED:
    about = policy.load(path).about
    domain, task = about.task.split("/")
    assert path.stem == f"{domain}_{task}" + about.sees * "_pixels"
    assert task in registry.TASKS[domain]
    assert path.stat().st_size < (1_000_000 if about.sees else 150_000)
    if about.sees:  # what a robot has, and the picture
      assert {demonstrations.group(name) for name in about.observations} == {"sensors"}
    else:
      assert about.training["lessons"] or about.training["from"]  # of another level


@pytest.mark.parametrize(
  "path",
  [
    pytest.param(path, id=path.stem, marks=() if path.stem in PLAYED else pytest.mark.slow)
    for path in SHIPPED
  ],
)
def test_policies_that_come_along_solve_their_exercise(path):
  about = policy.load(path).about
  seen = {"observations": ("sensors", "pixels"), "pixels": tuple(about.pixels)}
  options = seen if about.sees else {"surroundings": "none"}
  env = suite.load(*about.task.split("/"), task_kwargs={"random": 7, **options})
  outcomes, act = [], performer.make(env, "trained")
  while "success" not in outcomes and len(outcomes) < 3:
    timestep = env.reset()
    while not timestep.last():
      timestep = env.step(act(timestep))
    outcomes.append(env.task.outcome)
  assert "success" in outcomes


def test_an_exercise_without_a_policy_says_which_have_one():
  with pytest.raises(ValueError, match=r"no trained policy comes with sew/easy, .* touch/easy"):
    policy.shipped("sew/easy")
  with pytest.raises(ValueError, match=r"policy of pictures comes with sew/easy, .* retract/easy"):
    policy.shipped("sew/easy", pictures=True)
