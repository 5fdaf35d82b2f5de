"""Recording, replay to the bit, evaluation, and the commands on top."""

import contextlib
import json
import sys
import types

import mujoco
import numpy as np
import pytest
from palpate import tasks
from palpate.app import cli, evaluate
from palpate.tasks import episode, experts
from palpate.tasks.recording import Recording


def record(name="touch/easy", seed=0, style="expert", **kwargs):
  env = tasks.load(*name.split("/"), task_kwargs={"random": 5})
  return episode.run(env, experts.make(env, style, seed), seed, {"task_kwargs": {}}, **kwargs)


@pytest.mark.parametrize("name", ["touch/easy", "grasp/easy", "trace/easy"])
def test_replay_gives_everything_again_to_the_bit(name, tmp_path):
  first = record(name, states=name == "touch/easy")
  again, _ = episode.replay(Recording.load(first.save(tmp_path / "a.npz")))
  assert episode.differences(first, again) == []
  assert again.info["outcome"] == first.info["outcome"] == "success"
  assert again.metrics() == first.metrics()


def test_a_changed_action_is_noticed():
  first = record()
  actions = first.arrays["action"].copy()
  actions[4, 0] += 1e-3
  first.arrays["action"] = actions
  again, _ = episode.replay(first)
  assert "constant state_last" in episode.differences(first, again)


def test_what_was_recorded_before_an_error_is_kept(tmp_path):
  env = tasks.load("touch", "easy")
  good = iter([np.zeros(4)] * 3)
  with pytest.raises(
    episode.EpisodeError, match=r"touch/easy: step 3: ValueError: .*roll is nan"
  ) as e:
    episode.run(env, lambda _: next(good, np.array([0, 0, np.nan, 0])), 0)
  assert len(e.value.recording.time) == 1 + 3
  assert Recording.load(e.value.recording.save(tmp_path / "a.npz")).info["outcome"] == "error"

  def broken(_):
    raise RuntimeError("no idea")

  with pytest.raises(episode.EpisodeError, match="step 0: RuntimeError: no idea"):
    episode.run(env, broken, 0)


def test_metrics_of_an_expert_are_known():
  metrics = record("trace/easy").metrics()
  for name in (
    "path_length",
    "peak_force",
    "trace_rms",
    "trace_frechet",
    "peak_pressure",
    "errors",
  ):
    assert np.isfinite(getattr(metrics, name)), (name, metrics.reasons())
  assert metrics.trace_rms < 0.005
  assert np.isfinite(record("grasp/easy").metrics().grasp_slips)


def test_policies_are_found_by_name(tmp_path, monkeypatch):
  (tmp_path / "mine.py").write_text(
    "import numpy as np\nclass P:\n  def __init__(self, env, seed): self.env = env\n"
    "  def __call__(self, timestep): return np.zeros(4)\n"
    "def still(observation): return np.zeros(4)\nnumber = 3\n"
  )
  monkeypatch.chdir(tmp_path)
  monkeypatch.setattr(sys, "path", sys.path.copy())
  env = tasks.load("touch", "easy")
  timestep = env.reset()
  for spec in ("mine:P", "mine:still"):
    assert episode.performer(spec, env, 0)(timestep).shape == (4,)
  for spec, text in (
    ("mine", "expected module:object"),
    ("mine:nothing", "mine has no 'nothing'"),
    ("mine:number", "is a int, expected something to call"),
    ("nowhere:x", "ModuleNotFoundError"),
  ):
    with pytest.raises(ValueError, match=text):
      episode.find(spec)


def test_evaluate_prints_success_and_spread(capsys, tmp_path):
  out = tmp_path / "reference.json"
  assert cli.main(["evaluate", "touch/easy", "--episodes", "2", "--reference", str(out)]) == 0
  text = capsys.readouterr().out
  assert "success  2/2" in text and "Path length [mm]" in text
  data = json.loads(out.read_text())
  assert data["task"] == "touch/easy" and data["n"] == 2 and data["seed"] == 0
  kept = tmp_path / "kept"
  words = ["evaluate", "touch/easy", "--policy", "math:nan", "--episodes", "1"]
  assert cli.main([*words, "--recordings", str(kept)]) == 2
  assert "math:nan' is a float, expected something to call" in capsys.readouterr().err
  words = ["evaluate", "touch/easy", "--policy", "math:sqrt", "--episodes", "1"]
  assert cli.main([*words, "--recordings", str(kept)]) == 1
  assert "1 episodes failed, the first: TypeError" in capsys.readouterr().err
  assert Recording.load(kept / "0.npz").info["outcome"] == "error"
  assert cli.main(["evaluate", "touch/eazy"]) == 2
  assert "expected one of touch/easy" in capsys.readouterr().err
  assert cli.main(["evaluate", "touch/easy", "--policy", "nobody"]) == 2


def test_processes_give_the_same_as_one():
  one = list(evaluate.evaluate("touch/easy", "expert", range(2)))
  two = list(evaluate.evaluate("touch/easy", "expert", range(2), processes=2))
  assert one == two


def test_exercise_writes_recording_metrics_and_report(tmp_path, capsys):
  folder = str(tmp_path / "out")
  assert cli.main(["exercise", "touch/easy", "-o", folder]) == 0
  assert "success after" in capsys.readouterr().out
  assert (tmp_path / "out" / "report.html").stat().st_size > 1000
  again = ["exercise", "--replay", f"{folder}/recording.npz", "-o", str(tmp_path / "b")]
  assert cli.main([*again, "--no-report"]) == 0
  assert "the same to the bit" in capsys.readouterr().out
  assert cli.main(["report", f"{folder}/recording.npz", "-o", str(tmp_path / "c")]) == 0
  (tmp_path / "foreign.npz").write_bytes(b"PK nonsense")
  assert cli.main(["exercise", "--replay", str(tmp_path / "foreign.npz")]) == 2
  assert "not a readable palpate-recording" in capsys.readouterr().err
  assert cli.main(["exercise", "touch/easy", "--performer", "nobody"]) == 2
  assert "keyboard or module:object" in capsys.readouterr().err
  assert cli.main(["exercise", "touch/easy", "--performer", "math:none"]) == 2
  assert "math has no 'none'" in capsys.readouterr().err
  assert cli.main(["exercise", "touch/easy", "--performer", "math:sqrt", "-o", folder]) == 1
  said = capsys.readouterr()
  assert "error after 0.00 s" in said.out and "step 0: TypeError" in said.err
  assert cli.main(["exercise", "nothing"]) == 2


def test_film(tmp_path):
  pytest.importorskip("imageio")
  out = tmp_path / "a.gif"
  words = ["exercise", "touch/easy", "-o", str(tmp_path), "--no-report", "--film", str(out)]
  assert cli.main(words) == 0
  assert out.read_bytes()[:3] == b"GIF"


def test_references_are_those_of_the_tasks():
  for pair in tasks.ALL_TASKS:
    name = "/".join(pair)
    reference = episode.reference(name)
    assert reference is not None, name
    assert reference["task"] == name and reference["n"] >= 5
    assert {"seed", "palpate", "mujoco"} < set(reference)


class Window:
  """Stands in for MuJoCo's passive viewer: presses a key at every second picture."""

  def __init__(self, model, data, key_callback, **panels):
    self.key, self.pictures = key_callback, 0
    self.cam = types.SimpleNamespace(type=None, fixedcamid=-1)
    self.opt = types.SimpleNamespace(flags=np.zeros(4, np.uint8))
    self.user_scn = types.SimpleNamespace(flags=np.ones(4, np.uint8))
    self.model, self.panels = model, panels

  def __enter__(self):
    return self

  def __exit__(self, *_):
    pass

  lock = contextlib.nullcontext

  def sync(self):
    assert not self.opt.flags.any() and self.user_scn.flags.all()
    self.pictures += 1
    if self.pictures % 2:
      self.key(ord("S"))
      self.user_scn.flags[1], self.opt.flags[2] = False, True  # the viewer's own switches

  def is_running(self):
    return self.pictures < 25


def test_keyboard_moves_the_tool_in_front_of_the_laparoscope(tmp_path, monkeypatch):
  windows = []

  def launch(*words, **keys):
    windows.append(Window(*words, **keys))
    return windows[-1]

  monkeypatch.setattr("mujoco.viewer.launch_passive", launch)
  monkeypatch.setenv("DISPLAY", ":0")
  words = ["exercise", "touch/easy", "--performer", "keyboard", "--no-report"]
  assert cli.main([*words, "--out", str(tmp_path)]) == 0
  (window,) = windows
  assert window.cam.type == mujoco.mjtCamera.mjCAMERA_FIXED
  assert window.cam.fixedcamid == window.model.camera("laparoscope").id
  assert not any(window.panels.values())
  recording = Recording.load(tmp_path / "recording.npz")
  assert recording.info["performer"] == "keyboard" and len(recording.time) > 20
  moved = recording.arrays["action"]
  assert moved[2:, :].max() == 1.0  # inserted, by the key that was held


def test_keyboard_says_that_there_is_no_display(tmp_path, monkeypatch, capsys):
  if not sys.platform.startswith("linux"):
    pytest.skip("displays are asked for on Linux")
  monkeypatch.delenv("DISPLAY", raising=False)
  monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
  assert cli.main(["exercise", "touch/easy", "--performer", "keyboard", "--out", str(tmp_path)])
  assert "no display to open a window on; use another performer" in capsys.readouterr().err
