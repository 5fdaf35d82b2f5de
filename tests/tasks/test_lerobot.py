"""LeRobot: its own commands evaluate policies on the exercises and learn from our data sets."""

import json
import pathlib
import subprocess
import sys

import dm_env
import numpy as np
import pytest

factory = pytest.importorskip("lerobot.envs.factory")

from palpate.app import cli  # noqa: E402
from palpate.tasks import lerobot, suite  # noqa: E402
from palpate.tasks.core import performer  # noqa: E402
from palpate.tasks.learn import demonstrations  # noqa: E402

SEEN = ["sensors", "state", "pixels"]
# An ACT of the smallest size, its first weights drawn and not fetched.
ACT = {
  "type": "act", "device": "cpu", "push_to_hub": "false", "pretrained_backbone_weights": "null",
  "dim_model": "32", "n_heads": "2", "dim_feedforward": "64", "n_encoder_layers": "1",
  "n_vae_encoder_layers": "1", "chunk_size": "10", "n_action_steps": "10",
}  # fmt: skip


def call(command: str, *words: str):
  """Runs a command of lerobot's."""
  path = pathlib.Path(sys.executable).with_name(command)
  done = subprocess.run([path, *words], capture_output=True, text=True, timeout=600)
  assert done.returncode == 0, done.stderr[-2000:]


def evaluate(policy: dict[str, str], task: str, folder: pathlib.Path, count: int, spread: bool):
  call(
    "lerobot-eval", *(f"--policy.{key}={value}" for key, value in policy.items()),
    "--env.discover_packages_path=palpate.tasks.lerobot", "--env.type=palpate",
    f"--env.task={task}", f"--env.observations={json.dumps(SEEN)}", "--env.size=[96, 128]",
    '--env.options={"time_limit": 0.1, "width": 64, "height": 48}', f"--output_dir={folder}",
    f"--eval.n_episodes={count}", f"--eval.batch_size={count}",
    f"--eval.use_async_envs={str(spread).lower()}",
  )  # fmt: skip
  return json.loads((folder / "eval_info.json").read_text())["overall"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
  folder = tmp_path_factory.mktemp("data") / "touch"
  words = ["--format", "lerobot", "--episodes", "2", "--processes", "1", "--size", "96x128"]
  assert cli.main(["export", "touch/easy", "-o", str(folder), *words, "--observations", *SEEN]) == 0
  return folder


def test_an_expert_succeeds():
  env = lerobot.Exercise(task="touch/easy", observations=SEEN, pixels=(32, 48))
  seen, info = env.reset(seed=3)
  act, over = performer.make(env.unwrapped.environment, "expert"), False
  timestep = dm_env.restart(seen)
  while not over:
    assert not info["is_success"] and env.observation_space.contains(seen)
    seen, _, over, _, info = env.step(act(timestep))
    timestep = dm_env.transition(0.0, seen)
  assert info["is_success"]


def test_the_hub_takes_env_py(monkeypatch, tmp_path):
  path = pathlib.Path(lerobot.__file__).with_name("env.py")
  monkeypatch.setattr("lerobot.envs.utils.hf_hub_download", lambda **kwargs: str(path))
  envs = factory.make_env("somebody/palpate", n_envs=2, trust_remote_code=True)
  vector = envs["palpate"][0]
  seen, _ = vector.reset(seed=[0, 1])
  assert vector.call("task_description") == ("touch one point within 5 mm",) * 2
  assert seen["agent_pos"].shape[0] == 2 and (seen["agent_pos"][0] != seen["agent_pos"][1]).any()
  assert vector.call("_max_episode_steps")[0] == 500
  vector.close()


def test_lerobot_itself_reads_a_data_set(data):
  from lerobot.datasets.lerobot_dataset import LeRobotDataset

  dataset = LeRobotDataset("palpate/touch", root=data, video_backend="pyav")
  env = suite.load("touch", "easy", task_kwargs={"random": 0, "observations": SEEN})
  episodes = [demonstrations.perform(env, performer.make(env, seed=k), k) for k in range(2)]
  assert dataset.num_episodes == 2 and dataset.num_frames == sum(map(len, episodes))
  last, row = dataset[len(dataset) - 1], len(episodes[1]) - 1
  observed = {name: value[row] for name, value in episodes[1].observations.items()}
  assert last["observation.images.laparoscope"].shape == (3, 96, 128) and last["next.success"]
  assert last["task"] == "touch one point within 5 mm"
  np.testing.assert_array_equal(last["action"], np.float32(episodes[1].actions[-1]))
  for key, kind in demonstrations.VECTORS.items():
    np.testing.assert_array_equal(last.get(key, []), demonstrations.vector(observed, kind))
  kept = json.loads((data / "meta/palpate.json").read_text())
  assert [(row["seed"], row["outcome"]) for row in kept] == [(0, "success"), (1, "success")]


@pytest.mark.slow
def test_its_act_learns_from_a_data_set_and_is_evaluated(data, tmp_path):
  call(
    "lerobot-train", *(f"--policy.{key}={value}" for key, value in ACT.items()),
    "--dataset.repo_id=palpate/touch", f"--dataset.root={data}", "--dataset.video_backend=pyav",
    "--steps=3", "--save_freq=3", "--batch_size=4", "--num_workers=0", "--wandb.enable=false",
    f"--output_dir={tmp_path / 'train'}",
  )  # fmt: skip
  made = {"path": str(tmp_path / "train/checkpoints/last/pretrained_model"), "device": "cpu"}
  info = evaluate(made, "touch/easy", tmp_path / "eval", 2, False)
  assert info["n_episodes"] == 2 and np.isfinite(info["avg_sum_reward"])


@pytest.mark.slow
@pytest.mark.parametrize(
  "task, count, spread", [("probe/easy", 1, False), ("grasp/easy", 2, False), ("cut/easy", 2, True)]
)
def test_a_small_policy_is_evaluated(task, count, spread, tmp_path):
  info = evaluate(ACT, task, tmp_path, count, spread)
  assert info["n_episodes"] == count and np.isfinite(info["avg_sum_reward"])
