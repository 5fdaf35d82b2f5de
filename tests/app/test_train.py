"""`palpate train`, from an empty folder to a policy that `palpate evaluate` runs."""

import csv
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from palpate.app import cli

for name in ("gymnasium", "torch", "rsl_rl", "safetensors"):
  pytest.importorskip(name)

import torch  # noqa: E402
from palpate.tasks.batch import vector  # noqa: E402
from palpate.tasks.core import observation  # noqa: E402
from palpate.tasks.learn import distillation, learning, networks, policy, rsl  # noqa: E402
from palpate.tasks.learn.lessons import Lesson  # noqa: E402
from tensordict import TensorDict  # noqa: E402

SMALL = ["--device", "cpu", "--num-envs", "2", "--processes", "1", "--set", "time_limit=0.4"]

VARIED = 'randomise={"stiffness": [0.5, 2]}'  # which many worlds cannot have


def train(folder, *words, lessons=0):
  words = [*SMALL, "--lessons", str(lessons), *words]
  return cli.main(["train", "touch/easy", "-o", str(folder), *words])


@pytest.fixture(autouse=True)
def short(monkeypatch):
  monkeypatch.setattr(learning, "LEAST", 48)
  monkeypatch.setattr("palpate.app.learn.train.UPDATES", 20)
  monkeypatch.setattr("palpate.app.learn.train.ROUNDS", 2)


def learner(env, **settings):
  space, chosen = env.single_observation_space, learning.Settings(**settings)
  shapes = {name: space[name].shape for name in space.spaces}
  made = networks.Networks(shapes, env.task.components, 8, (8,), chosen.spread, 0, "cpu")
  return learning.Learner(env, chosen, made)


def rows(folder):
  with (folder / "curve.csv").open(newline="") as file:
    return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def test_training_goes_on_where_it_stopped_and_its_policy_is_evaluated(tmp_path, capsys):
  first, second = tmp_path / "a", tmp_path / "b"
  assert train(first, "--iterations", "2") == 0
  names = {path.name for path in first.iterdir()}
  assert {"policy.safetensors", "checkpoint.safetensors", "curve.csv", "LICENSE"} <= names
  assert train(second, "--iterations", "1") == 0
  assert rows(second)[0]["return"] == rows(first)[0]["return"]  # the seed is the same
  assert train(second, "--iterations", "2", "--resume") == 0
  assert [row["iteration"] for row in rows(second)] == [1, 2]
  assert rows(second)[1]["steps"] == 2 * 48
  capsys.readouterr()
  path = str(first / "policy.safetensors")
  words = ["--policy", path, "--episodes", "1", "--set", "time_limit=0.4"]
  assert cli.main(["evaluate", "touch/easy", *words]) == 0
  assert "time limit 1" in capsys.readouterr().out
  assert cli.main(["evaluate", "touch/standard", *words]) == 2
  assert "the policy is of touch/easy, not of touch/standard" in capsys.readouterr().err


def test_an_expert_teaches_before_practice(tmp_path, capsys):
  folder = tmp_path / "a"
  assert train(folder, "--iterations", "0", lessons=2) == 0
  names = {path.name for path in folder.iterdir()}
  assert names == {"lessons.npz", "policy.safetensors", "LICENSE"}
  with np.load(folder / "lessons.npz") as file:
    lengths, before = file["lengths"], file["seen"]
    taught = np.split(file["taught"], np.cumsum(lengths)[:-1])
  assert len(lengths) == 2 * 2 and (lengths == 20).all()
  assert taught[0][0] and not taught[2][0]  # the policy begins, and takes turns with the expert
  assert train(folder, lessons=2) == 2  # nothing is written over
  assert train(folder, "--iterations", "1", "--resume", lessons=2) == 0
  assert [row["iteration"] for row in rows(folder)] == [1]
  with np.load(folder / "lessons.npz") as file:
    assert np.array_equal(file["seen"], before)
  assert policy.load(folder / "policy.safetensors").about.training["lessons"] == 4
  capsys.readouterr()
  words = ["train", "touch/easy", "-o", str(tmp_path / "b"), *SMALL, "--set", VARIED]
  assert cli.main([*words, "--lessons", "1"]) == 0
  assert "taught, not practised: touch/easy: randomise has 'stiffness'" in capsys.readouterr().err


def test_lessons_begin_with_the_policy_of_an_easier_exercise(tmp_path, capsys):
  assert train(tmp_path / "a", "--iterations", "0", lessons=1) == 0
  start = tmp_path / "a" / "policy.safetensors"
  words = [*SMALL, "--lessons", "1", "--iterations", "0", "--from", str(start)]
  assert cli.main(["train", "touch/standard", "-o", str(tmp_path / "b"), *words]) == 0
  with np.load(tmp_path / "b" / "lessons.npz") as file:
    assert not file["taught"][0]  # it begins
  made = tmp_path / "b" / "policy.safetensors"
  assert policy.load(made).about.training["from"] == start.name
  more = [*SMALL, "--resume", "--iterations", "1"]
  assert cli.main(["train", "touch/standard", "-o", str(made.parent), *more]) == 0
  assert policy.load(made).about.training["from"] == start.name
  capsys.readouterr()
  assert cli.main(["train", "grasp/easy", "-o", str(tmp_path / "c"), *words]) == 2
  assert "from: the policy observes joints" in capsys.readouterr().err


PICTURES = ["--observations", "sensors,pixels", "--set", "pixels=[24,32]"]


def test_a_policy_of_pictures_learns_from_one_of_the_state_and_is_evaluated(
  tmp_path, capsys, monkeypatch
):
  monkeypatch.setattr(distillation, "STEPS", 8)
  monkeypatch.setattr(distillation, "UPDATES", 2)
  folder = tmp_path / "a"
  assert train(folder, *PICTURES, "--iterations", "1") == 0
  assert train(folder, *PICTURES, "--iterations", "3", "--resume") == 0
  monkeypatch.setattr("palpate.app.learn.train.JUDGE", 1)
  assert train(folder, *PICTURES, "--iterations", "9", "--resume", "--success", "0") == 0  # judged
  assert [row["iteration"] for row in rows(folder)] == [1, 2, 3]
  about = policy.load(folder / "policy.safetensors").about
  assert tuple(about.pixels) == (24, 32) and about.training["algorithm"] == "distillation"
  assert not {"target", "progress", "nodes_near", "tip_vel"} & set(about.observations)
  capsys.readouterr()
  words = ["evaluate", "touch/easy", "--policy", str(folder / "policy.safetensors")]
  words += ["--episodes", "1", "--set", "time_limit=0.1"]
  assert cli.main(words) == 0  # it draws what the policy sees
  assert "time limit 1" in capsys.readouterr().out
  assert cli.main([*words, "--set", "pixels=[32,32]"]) == 2
  assert "sees 24 x 32 pixels, the exercise draws 32 x 32" in capsys.readouterr().err


def test_what_the_teacher_says_is_learned_from_pictures(monkeypatch):
  monkeypatch.setattr(distillation, "STEPS", 12)
  monkeypatch.setattr(distillation, "UPDATES", 1)
  teacher = policy.shipped("touch/easy")
  options = dict(observations=["sensors", "state", "pixels"], pixels=(24, 24))
  env = vector.Exercises(4, "touch/easy", device="cpu", output="torch", **options)
  space, settings = env.single_observation_space, learning.Settings()
  privileged = [n for n in teacher.about.observations if n not in observation.ROWS] + ["progress"]
  shapes = {n: space[n].shape for n in (*teacher.about.observations, "pixels")}
  made = networks.Networks(
    shapes, env.task.components, settings.memory, settings.hidden, 0.1, 0, "cpu", True, privileged
  )
  found = distillation.Distillation(env, settings, made, teacher, 1)
  found.iterate()
  errors = [found.update() for _ in range(30)]
  assert sum(errors[-5:]) < 0.5 * sum(errors[:5])
  monkeypatch.setattr(distillation, "PATIENCE", -1)  # nobody gets on soon enough
  found.iterate()
  assert found.env.episode_length_buf.max() <= 1
  monkeypatch.setattr(distillation, "STUCK", -1)  # as if nobody had got on for long
  found.iterate()
  assert torch.equal(found.helped, ~found.alone)
  env.close()


def test_networks_take_up_a_policy_and_keep_it_where_observations_vary_otherwise():
  env = vector.Exercises(1, "touch/easy", device="cpu", output="torch", time_limit=0.1)
  shapes = {name: env.single_observation_space[name].shape for name in env.single_observation_space}
  first, second = (
    networks.Networks(shapes, env.task.components, 8, (8,), 0.1, seed, "cpu") for seed in (0, 1)
  )
  count = sum(int(np.prod(shape)) for shape in shapes.values())
  random = np.random.RandomState(0)
  rows = [random.randn(9, count), *(random.rand(9, 4) for _ in range(2))]
  lesson = [row.astype(np.float32) for row in (*rows, np.ones(9), np.ones(9))]
  for made, size in ((first, 1.0), (second, 3.0)):
    seen = Lesson(size * lesson[0], *lesson[1:], "success", False)
    if made is second:
      made.take(first.policy(env.task, {}, {}))
    made.remember([seen])
  env.close()
  one, other = (made.policy(env.task, {}, {}).begin() for made in (first, second))
  for _ in range(3):
    seen = {name: random.randn(*shape) for name, shape in shapes.items()}
    np.testing.assert_allclose(one(seen), other(seen), atol=1e-4)


def test_offsets_are_seen_on_a_finer_scale_which_an_older_policy_begins_without(monkeypatch):
  names, shapes = ("pitch", "jaw"), {"held": (1,), "hook_front": (3,), "target": (3,)}
  task = SimpleNamespace(name="any/easy", components=names, control_timestep=0.02)

  def made(seed):
    return networks.Networks(shapes, names, 8, (8,), 0.1, seed, "cpu")

  random = np.random.RandomState(0)
  seen = {name: random.randn(*shape) for name, shape in shapes.items()}
  with monkeypatch.context() as without:
    without.setattr(networks, "FINELY", ())
    older = made(0).policy(task, {}, {})
  newer = made(1)
  newer.take(older)
  taken = newer.policy(task, {}, {})
  assert older.about.fine == [] and taken.about.fine == [1, 2, 3, 4, 5, 6]
  np.testing.assert_allclose(taken.begin()(seen), older.begin()(seen), atol=1e-6)
  learned, some = made(1), TensorDict({"acting": torch.randn(5, 1, 7) * 1e-3}, batch_size=[5, 1])
  act = learned.policy(task, {}, {}).begin()
  with torch.no_grad():
    latent, _ = learned.actor.rnn.rnn(learned.actor.sense(some))
    said = learned.actor.mlp(latent)[:, 0]
  last = torch.zeros(2)
  for row, says in zip(some["acting"][:, 0].numpy(), said, strict=True):
    last = learned.action(says, last)
    step = {"held": row[:1], "hook_front": row[1:4], "target": row[4:]}
    np.testing.assert_allclose(act(step), last, atol=1e-5)


def test_networks_begin_with_a_policy_that_observes_less():
  names, less = ("pitch", "jaw"), {"held": (1,), "target": (3,)}
  task = SimpleNamespace(name="any/easy", components=names, control_timestep=0.02)
  more = {"held": (1,), "hook_front": (3,), "target": (3,), "through": (1,)}
  older, made = (
    networks.Networks(shapes, names, 8, (8,), 0.1, seed, "cpu")
    for seed, shapes in ((0, less), (1, more))
  )
  taken = older.policy(task, {}, {})
  made.take(taken)
  random = np.random.RandomState(0)
  lesson = [random.randn(9, 8), *(random.rand(9, 2) for _ in range(2)), np.ones(9), np.ones(9)]
  made.remember([Lesson(*(row.astype(np.float32) for row in lesson), "success", False)])
  seen = {name: random.randn(*shape) for name, shape in more.items()}
  np.testing.assert_allclose(
    made.policy(task, {}, {}).begin()(seen), taken.begin()(seen), atol=1e-5
  )
  with pytest.raises(ValueError, match="observes held, hook_front, target, through, expected held"):
    older.take(made.policy(task, {}, {}))


def test_what_was_seen_is_remembered_longer_than_what_is_learned_at_once():
  names, count = ("pitch", "yaw"), 300
  task = SimpleNamespace(name="any/easy", components=names, control_timestep=0.02)
  made = networks.Networks({"told": (1,)}, names, 8, (8,), 0.1, 0, "cpu")
  lessons = []
  for sign in 4 * (-1.0, 1.0):  # what is told at first is to be done all along
    seen, meant = np.zeros((count, 1), np.float32), np.full((count, 2), 0.25 * sign, np.float32)
    seen[:5] = sign
    rows = seen, meant, meant, np.ones(count, bool), meant[:, 0]
    lessons.append(Lesson(*rows, "success", False))
  made.learn(lessons, 300)
  for lesson in lessons:
    act = made.policy(task, {}, {}).begin()
    done = [act({"told": row}).copy() for row in lesson.seen]
    np.testing.assert_allclose(done[100:], lesson.meant[100:], atol=0.1)


def test_what_is_held_from_the_start_is_no_change_to_learn():
  names, first = ("pitch", "jaw"), (0.0, 0.5)
  task = SimpleNamespace(name="any/easy", components=names, control_timestep=0.02)
  made = networks.Networks({"target": (3,)}, names, 8, (8,), 0.1, 0, "cpu", initial_action=first)
  seen, held = np.ones((1, 3), np.float32), np.float32([first])
  made.learn(2 * [Lesson(seen, held, held, np.ones(1, bool), seen[:, 0], "success", False)], 200)
  learned = made.policy(task, {}, {})
  assert learned.about.initial_action == list(first)
  assert learned.begin()({"target": seen[0]})[1] == pytest.approx(0.5, abs=0.05)


def test_jaws_that_are_closed_are_said_past_their_limit():
  names, count, half = ("pitch", "jaw"), 40, 20
  task = SimpleNamespace(name="any/easy", components=names, control_timestep=0.02)
  made = networks.Networks({"target": (3,)}, names, 8, (8,), 0.1, 0, "cpu")
  seen = np.zeros((count, 3), np.float32)
  seen[half:] = 1.0
  done = np.zeros((count, 2), np.float32)
  done[half:, 1] = -1.0  # they close at once, and stay so
  taught = np.arange(count) != half
  made.learn(2 * [Lesson(seen, done, done, taught, seen[:, 0], "success", False)], 200)
  act = made.policy(task, {}, {}).begin()
  changes = []
  for row in seen:
    act.last[:] = 0.0
    changes.append(act({"target": row})[1])
  assert abs(changes[half - 1]) < 0.005
  assert -0.1 < changes[-1] < -0.01


def test_the_learning_rate_falls_in_the_time_there_is():
  random = np.random.RandomState(0)
  seen = random.randn(12, 3).astype(np.float32)
  meant = np.tanh(seen[:, :2] * seen[:, 1:])
  lesson = Lesson(seen, meant, meant, np.ones(12, bool), seen[:, 0], "success", False)
  errors = []
  for end in (lambda k: float(k >= 60), lambda k: k / 60):
    made = networks.Networks({"target": (3,)}, ("pitch", "yaw"), 16, (16,), 0.1, 0, "cpu")
    steps = itertools.count()
    errors.append(made.learn(2 * [lesson], 700, lambda end=end, steps=steps: end(next(steps))))
  assert errors[1] < 0.9 * errors[0]


def test_a_policy_is_judged_by_an_episode_in_each_world():
  env = vector.Exercises(3, "touch/easy", device="cpu", output="torch", time_limit=0.1)
  found = learner(env)
  assert found.judge() == 0.0 and found.judge(lambda: True) == 0.0
  env.close()


def test_what_succeeds_tries_less():
  # touch/standard once succeeded in every world with a spread of 0.36, and without in 10 of 50.
  env = vector.Exercises(2, "touch/easy", device="cpu", output="torch", time_limit=2)
  found = learner(env, spread=0.4, calm=0.1)
  for won, spread in ((0.0, 0.4), (0.5, 0.2), (1.0, 0.1)):
    found.env.won[:] = won
    found.env.whole[:] = False  # what ends now is not counted
    assert found.iterate()["spread"] <= spread + 1e-6
  env.close()


def test_the_curve_counts_the_last_whole_episode_of_each_world():
  env = vector.Exercises(4, "touch/easy", device="cpu", output="torch", time_limit=0.2)
  seen = rsl.RslRl(env, 0)
  seen.stagger(torch.Generator().manual_seed(0))
  began, told = seen.episode_length_buf.clone(), []
  assert len(set(began.tolist())) > 1
  for k in range(1, 11):
    _, _, over, extras = seen.step(torch.zeros(4, 4))
    assert torch.equal(over.bool(), k == 10 - began)  # each ends in its own time
    told += [extras["log"]["/length"]] if extras["log"] else []
  assert not torch.cat(told).numel()  # what began in the middle does not count
  fields = env.parts[0].fields
  seen.won[:] = 1.0
  for _ in range(10):
    _, _, over, extras = seen.step(torch.zeros(4, 4))
    assert not extras["log"] or (extras["log"]["/length"] == 10).all()
  assert not seen.won.any() and not fields.success.numpy().any()  # none touched
  env.close()


def test_what_is_wrong_is_said_before_the_work(tmp_path, capsys):
  (tmp_path / "checkpoint.safetensors").write_bytes(b"?")
  new = str(tmp_path / "new")
  for words, said in (
    (["touch/easy", "-o", str(tmp_path)], "expected --resume or another folder"),
    (["touch/easy", "-o", str(tmp_path / "new"), "--resume"], "to go on with"),
    (["touch/easy", "-o", str(tmp_path), "--resume", "--num-envs", "1"], "checkpoint.safetensors"),
    (["touch/easy", "-o", new, "--lessons", "0", "--set", VARIED], "randomise has"),
    (["touch/easy", "-o", new, "--num-envs", "0"], "num_envs is 0"),
    (["touch/easy", "-o", new, "--observations", "state,pixels"], "expected sensors,pixels"),
    (["sew/easy", "-o", str(tmp_path / "new")], "task is 'sew/easy'"),
  ):
    assert cli.main(["train", *words, "--device", "cpu"]) == 2
    assert said in capsys.readouterr().err
