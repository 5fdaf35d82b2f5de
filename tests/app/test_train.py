"""`palpate train`, from an empty folder to a policy that `palpate evaluate` runs."""

import csv

import pytest
from palpate.app import cli

for name in ("gymnasium", "torch", "rsl_rl", "safetensors"):
  pytest.importorskip(name)

import torch  # noqa: E402
from palpate.tasks.batch import learning, rsl, vector  # noqa: E402

SMALL = ["--device", "cpu", "--num-envs", "2", "--set", "time_limit=0.4"]


def train(folder, *words):
  return cli.main(["train", "touch/easy", "-o", str(folder), *SMALL, *words])


@pytest.fixture(autouse=True)
def short(monkeypatch):
  monkeypatch.setattr(learning, "LEAST", 48)


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
  policy = str(first / "policy.safetensors")
  words = ["--policy", policy, "--episodes", "1", "--set", "time_limit=0.4"]
  assert cli.main(["evaluate", "touch/easy", *words]) == 0
  assert "time limit 1" in capsys.readouterr().out
  assert cli.main(["evaluate", "touch/standard", *words]) == 1
  assert "the policy is of touch/easy, not of touch/standard" in capsys.readouterr().err


def test_a_policy_is_judged_by_an_episode_in_each_world():
  env = vector.Exercises(3, "touch/easy", device="cpu", output="torch", time_limit=0.1)
  learner = learning.Learner(env, learning.Settings())
  assert learner.judge() == 0.0 and learner.judge(lambda: True) == 0.0
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
  for words, said in (
    (["touch/easy", "-o", str(tmp_path)], "expected --resume or another folder"),
    (["touch/easy", "-o", str(tmp_path / "new"), "--resume"], "to go on with"),
    (["touch/easy", "-o", str(tmp_path), "--resume", "--num-envs", "1"], "checkpoint.safetensors"),
    (["touch/hard", "-o", str(tmp_path / "new"), "--num-envs", "1"], "expected one shape"),
    (["touch/easy", "-o", str(tmp_path / "new"), "--num-envs", "0"], "num_envs is 0"),
    (["sew/easy", "-o", str(tmp_path / "new")], "task is 'sew/easy'"),
  ):
    assert cli.main(["train", *words, "--device", "cpu"]) == 2
    assert said in capsys.readouterr().err
