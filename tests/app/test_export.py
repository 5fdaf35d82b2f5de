"""`palpate export`: data sets that their own libraries read, whole or not at all, and resumed."""

import errno
import importlib.util
import json
import os
import pathlib
import re
import runpy
import signal

import numpy as np
import pytest
from palpate.app import cli, console, live, options
from palpate.app.datasets import lerobot as written
from palpate.app.learn import export as command
from palpate.tasks import suite
from palpate.tasks.core import performer
from palpate.tasks.learn import demonstrations, policy
from palpate.tasks.recording import Recording

for name in ("h5py", "minari"):
  pytest.importorskip(name)

import h5py  # noqa: E402
import minari  # noqa: E402

SHORT = ["--episodes", "2", "--processes", "1"]
SEEN = ["--observations", "sensors", "state", "pixels", "--size", "32x48"]
ROBOT = ["touch/easy", "--format", "lerobot"]
IDLE = "import numpy as np\ndef act(observation): return np.zeros(4)\n"


def export(*words) -> int:
  return cli.main(["export", *map(str, words)])


pytestmark = pytest.mark.usefixtures("here")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
  """A folder with a data set of two episodes in each format."""
  folder = tmp_path_factory.mktemp("data")
  for form in ("robomimic", "minari"):
    assert export("touch/easy", "-o", folder / form, "--format", form, *SHORT, *SEEN) == 0
  return folder


@pytest.fixture(scope="module")
def episodes():
  """What is in them."""
  observed = ["sensors", "state", "pixels"]
  kwargs = {"random": 0, "observations": observed, "pixels": (32, 48)}
  env = suite.load("touch", "easy", task_kwargs=kwargs)
  return [demonstrations.perform(env, performer.make(env, seed=k), k) for k in range(2)]


def column(table, name) -> np.ndarray:
  return np.array(table.column(name).to_pylist())


# LeRobot.


def test_lerobot_is_given_types_names_and_frames(episodes):
  names = written.features(episodes[0])
  assert names["observation.images.laparoscope"]["dtype"] == "video"
  assert names["action"] == {
    "dtype": "float32", "shape": (4,), "names": ["pitch", "yaw", "roll", "insertion"],
  }  # fmt: skip
  place = names["observation.environment_state"]["names"].index("target.0")
  for episode in episodes:
    frames = list(written.frames(episode))
    assert [bool(frame["next.done"][0]) for frame in frames] == [False] * (len(frames) - 1) + [True]
    assert frames[-1]["next.success"] and not frames[0]["next.success"]
    for k, frame in enumerate(frames):
      assert set(frame) == set(names)
      for key, about in names.items():
        assert frame[key].shape == tuple(about["shape"]), key
      target = np.float32(episode.observations["target"][k, 0])
      assert frame["observation.environment_state"][place] == target
      np.testing.assert_array_equal(frame["action"], np.float32(episode.actions[k]))
      np.testing.assert_array_equal(frame["next.force"], np.float32(episode.forces["force"][k + 1]))


def test_lerobot_is_named_where_it_is_missing(capsys, monkeypatch, tmp_path):
  found = importlib.util.find_spec
  monkeypatch.setattr(
    importlib.util, "find_spec", lambda name: None if name == "lerobot" else found(name)
  )
  assert export("touch/easy", "-o", "out", "--format", "lerobot") == 1
  assert "installed: pip install 'palpate[lerobot]'" in capsys.readouterr().err


# robomimic.


def test_robomimic_has_its_groups(data, episodes):
  with h5py.File(data / "robomimic/demos.hdf5") as file:
    assert file["data"].attrs["total"] == sum(map(len, episodes))
    made = json.loads(file["data"].attrs["env_args"])
    assert (made["env_name"], made["type"]) == ("palpate/TouchEasy-v0", 2)
    demo, episode = file["data/demo_1"], episodes[1]
    assert demo.attrs["num_samples"] == len(episode) and demo.attrs["seed"] == 1
    np.testing.assert_array_equal(demo["actions"], episode.actions)
    np.testing.assert_array_equal(demo["next_obs/tip_pos"], episode.observations["tip_pos"][1:])
    np.testing.assert_array_equal(demo["forces/force"], episode.forces["force"][1:])
    assert demo["obs/pixels"].shape == (len(episode), 32, 48, 3) and demo["obs/pixels"][0].any()
    pixels = episode.observations["pixels"]
    np.testing.assert_array_equal(demo["obs/pixels"], pixels[:-1])
    np.testing.assert_array_equal(demo["next_obs/pixels"], pixels[1:])
    assert demo["dones"][:].tolist() == [0] * (len(episode) - 1) + [1]


def test_robomimic_itself_reads_it(data, episodes):
  dataset = pytest.importorskip("robomimic.utils.dataset")
  from robomimic.utils import obs_utils

  obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": ["target"], "rgb": ["pixels"]}})
  read = dataset.SequenceDataset(
    str(data / "robomimic/demos.hdf5"), ("target", "pixels"), dataset_keys=("actions",)
  )
  assert len(read) == sum(map(len, episodes)) and read[0]["obs"]["pixels"].shape[1:] == (32, 48, 3)


def test_truth_and_pictures_without_opengl():
  seen = ["sensors", "truth", "pixels", "pixels_left", "depth", "flow"]
  words = ["--episodes", 1, "--processes", 1, "--renderer", "cpu", "--size", "24x32"]
  assert export("touch/easy", "-o", "out", *words, "--observations", *seen) == 0
  with h5py.File("out/demos.hdf5") as file:
    demo = file["data/demo_0"]
    steps = demo.attrs["num_samples"]
    assert json.loads(demo.attrs["task_kwargs"])["renderer"] == "cpu"
    assert demo["obs/flow"].shape == (steps, 24, 32, 2) and not demo["obs/flow"][0].round(2).any()
    assert np.abs(demo["obs/flow"][:]).max() > 0.2
    assert demo["obs/keypoints"].shape == (steps, 4, 3)
    assert demo["obs/camera_pose"].shape == (steps, 4, 4)
    assert (demo["obs/pixels"][5] != demo["obs/pixels_left"][5]).any()
  assert "--renderer cpu" in pathlib.Path("out/README.md").read_text()


# Minari.


def test_minari_itself_reads_it(data, episodes):
  dataset = minari.MinariDataset(data / "minari/data")
  assert dataset.total_episodes == 2 and dataset.id == "palpate/touch-easy/expert-v0"
  read, episode = dataset[1], episodes[1]
  np.testing.assert_array_equal(read.actions, episode.actions)
  np.testing.assert_array_equal(read.observations["surface"], episode.observations["surface"])
  assert read.observations["pixels"].shape == (len(episode) + 1, 32, 48, 3)
  assert read.terminations.tolist() == [False] * (len(episode) - 1) + [True]
  np.testing.assert_array_equal(read.infos["force"], episode.forces["force"])
  env = dataset.recover_environment()
  assert env.observation_space == dataset.observation_space


# What is in it.


def test_the_card_says_licence_seeds_and_command(data):
  for form in ("robomimic", "minari"):
    text = (data / form / "README.md").read_text()
    assert text.startswith("---\nlicense: apache-2.0\n") and "Licence of the data: Apache" in text
    assert "Seeds 0 to 1" in text and f"palpate export touch/easy --format {form}" in text
    assert not (data / f"{form}.part").exists()


def test_recordings_are_run_anew_and_one_that_differs_is_left_out(tmp_path, capsys, episodes):
  words = ["evaluate", "touch/easy", "--episodes", "2", "--recordings", "kept"]
  assert cli.main([*words, "--set", "time_limit=1.6"]) == 0
  changed = Recording.load("kept/1.npz")
  actions = changed.arrays["action"].copy()
  actions[5] *= 0.5
  changed.arrays["action"] = actions
  changed.save("kept/1.npz")
  words = ["--recordings", "kept", "-o", "out", "--format", "robomimic", "--processes", "1"]
  assert export(*words, "--failures", "--observations", "target") == 0
  said = capsys.readouterr().out
  assert re.search(r"left out: \S+1.npz \(the replay differs in ", said)
  assert "licence unknown" in said
  with h5py.File("out/demos.hdf5") as file:
    (demo,) = file["data"].values()
    count = len(demo["obs/target"])
    np.testing.assert_array_equal(demo["obs/target"], episodes[0].observations["target"][:count])
  assert export("touch/easy", *words) == 2
  assert "of their own, expected none" in capsys.readouterr().err


def test_what_a_hand_did_live_becomes_a_data_set(tmp_path, capsys):
  kwargs = {"input": "handle", "observations": ["joints"], "time_limit": 0.2}
  env = suite.load("touch", "easy", task_kwargs={"random": 0, **kwargs})
  pace = live.Pace.instant(env.physics.timestep())
  hand = live.Hand(lambda t: (0.01 * t, 0.0, 0.0))
  old = live.Session(env, hand, 3, {"task_kwargs": kwargs}, pace=pace).run()
  old.save("live.npz")
  words = ["--recordings", "live.npz", "-o", "out", "--format", "robomimic", "--processes", "1"]
  assert export(*words, "--failures") == 0
  assert "not in it: a hand's path between two control steps" in capsys.readouterr().out
  with h5py.File("out/demos.hdf5") as file:
    demo = file["data/demo_0"]
    np.testing.assert_array_equal(demo["actions"], old.arrays["action"][1:, -1])
    np.testing.assert_array_equal(demo["obs/tip_pos"][1:], old.columns["tip_pos"][1:-1, 0])
    assert demo["obs/surface"].shape[1:] == (32, 3)


def test_episodes_without_success_are_left_out_or_marked(tmp_path, capsys):
  (tmp_path / "idle.py").write_text(IDLE)
  words = ["touch/easy", "-o", "out", "--performer", "idle:act", "--set", "time_limit=0.1"]
  words += ["--format", "robomimic", *SHORT]
  assert export(*words) == 1
  assert "no episode succeeded, the first: seed 0 (time limit)" in capsys.readouterr().err
  assert export(*words, "--failures", "--resume") == 0
  assert "without success: seed 0 (time limit), seed 1 (time limit)" in capsys.readouterr().out
  with h5py.File("out/demos.hdf5") as file:
    assert file["mask/failure"][:].tolist() == [b"demo_0", b"demo_1"]
    assert not file["data/demo_0/dones"][:].any()


def test_noise_shakes_what_is_done_and_keeps_what_was_meant():
  env = suite.load("touch", "easy", task_kwargs={"random": 0, "observations": ["drive"]})
  calm, shaken = (
    demonstrations.perform(env, lambda _: np.full(4, 0.1), 0, {}, noise) for noise in (0.0, 0.3)
  )
  assert (shaken.actions == 0.1).all() and shaken.info["noise"] == 0.3
  assert np.abs(shaken.observations["drive"][1:5] - calm.observations["drive"][1:5]).max() > 1e-4


def test_the_page_clones_an_expert(tmp_path):
  for name in ("sklearn", "safetensors"):
    pytest.importorskip(name)
  page = (pathlib.Path(__file__).parents[2] / "docs/datasets.md").read_text(encoding="utf-8")
  text = next(t for t in re.findall(r"```python\n(.*?)```", page, re.S) if "MLPRegressor" in t)
  commands = re.findall(r"^palpate (export touch/standard .*) --episodes \d+(.*)$", page, re.M)
  assert len(commands) == 2
  for words in commands:
    assert cli.main([*" ".join(words).split(), "--episodes", "1", "--processes", "1"]) == 0
  (tmp_path / "clone.py").write_text(text.replace("max_iter=epochs", "max_iter=1"))
  runpy.run_path("clone.py")
  made = policy.load("clone.safetensors")
  env = options.environment("touch/standard", json.dumps({"observations": ["sensors", "state"]}))
  made.check(env)
  assert made.begin()(env.reset().observation).shape == (4,)


# What goes wrong.


def test_ctrl_c_keeps_whole_episodes_and_resume_makes_the_others(tmp_path, monkeypatch, capsys):
  show, made = console.Progress.show, []

  def interrupt(self, text, always=False):
    if text == "1 of 3 episodes":
      signal.raise_signal(signal.SIGINT)
    show(self, text, always)

  monkeypatch.setattr(console.Progress, "show", interrupt)
  words = ["touch/easy", "-o", "out", "--format", "robomimic", "--processes", "1"]
  assert export(*words, "--episodes", "3") == 130
  assert "interrupted after 1 of 3 episodes; go on with --resume" in capsys.readouterr().err
  assert [path.name for path in (tmp_path / "out.part").glob("*.npz")] == ["00000000.npz"]
  assert not (tmp_path / "out").exists()
  assert export(*words, "--episodes", "2") == 2
  assert "expected --resume or another folder" in capsys.readouterr().err
  assert export(*words, "--episodes", "2", "--resume", "--performer", "skilled") == 2
  assert "has performer expert, not skilled" in capsys.readouterr().err
  perform = demonstrations.perform
  monkeypatch.setattr(
    demonstrations, "perform", lambda *args: made.append(args[2]) or perform(*args)
  )
  assert export(*words, "--episodes", "2", "--resume") == 0
  assert made == [1] and (tmp_path / "out/demos.hdf5").exists()
  assert export(*words) == 2
  assert "out is 'out', which exists, expected a new folder" in capsys.readouterr().err


def test_a_full_disk_is_named_and_nothing_is_lost(tmp_path, monkeypatch, capsys):
  fsync, calls = os.fsync, []

  def full(number):
    calls.append(number)
    if len(calls) == 3:  # the job, the first episode, the second
      raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    fsync(number)

  monkeypatch.setattr(os, "fsync", full)
  words = ["touch/easy", "-o", "out", "--format", "robomimic", *SHORT]
  assert export(*words) == 1
  said = capsys.readouterr().err
  assert "No space left on device; 1 of 2 episodes are done, go on with --resume" in said
  assert [path.name for path in (tmp_path / "out.part").glob("*.npz")] == ["00000000.npz"]
  assert export(*words, "--resume") == 0


@pytest.mark.parametrize(
  "words, said",
  [
    ([], "neither TASK nor --recordings is given"),
    (["touch/eazy"], "task is 'touch/eazy'"),
    (["touch/easy", "--episodes", "0"], "episodes is 0"),
    (["touch/easy", "--noise", "2"], "noise is 2.0, expected a number in [0, 1]"),
    (["touch/easy", "--size", "84"], "size is '84', expected height and width such as 96x128"),
    ([*ROBOT, "--observations", "pixels", "--size", "33x48"], "expected even numbers"),
    ([*ROBOT, "--observations", "sensors", "depth"], "of pictures lerobot has pixels, pixels_left"),
    (["touch/easy", "--observations", "sensor"], "observations has 'sensor', expected some of"),
    (["--recordings", "nowhere"], "nowhere"),
  ],
)
def test_what_is_wrong_is_said_before_the_work(words, said, capsys, monkeypatch, tmp_path):
  monkeypatch.setattr(command, "keep", lambda job: pytest.fail("it worked first"))
  monkeypatch.setattr(command.console, "need", lambda *names: None)
  assert export(*words, "-o", "out") == 2
  message = capsys.readouterr().err
  assert said in message and message.count("\n") == 1
  assert not list(tmp_path.iterdir())
