"""`palpate exercise`: its files, replays, the keyboard, and how it ends."""

import base64
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import types

import imageio.v3 as iio
import mujoco
import numpy as np
import pytest
from palpate.app import cli, console
from palpate.tasks.core.physics import Physics
from palpate.tasks.recording import Recording

EASY = ("exercise", "touch/easy", "--no-report")

pytestmark = pytest.mark.usefixtures("here")


@pytest.fixture
def interrupted(monkeypatch):
  """Ctrl-C after ten steps."""
  shown = []

  def interrupt(self, text, always=False):
    shown.append(text)
    if len(shown) == 10:
      signal.raise_signal(signal.SIGINT)

  monkeypatch.setattr(console.Progress, "show", interrupt)


def test_exercise_writes_recording_metrics_and_report(tmp_path, capsys):
  folder = str(tmp_path / "out")
  assert cli.main(["exercise", "touch/easy", "-o", folder]) == 0
  assert "success after" in capsys.readouterr().out
  page = (tmp_path / "out" / "report.html").read_text()
  assert page.index("data:image/jpeg") < page.index("<h2>")  # pictures of the operation
  again = ["exercise", "--replay", f"{folder}/recording.npz", "-o", str(tmp_path / "b")]
  assert cli.main([*again, "--no-report"]) == 0
  assert "the same to the bit" in capsys.readouterr().out
  capsys.readouterr()
  assert cli.main(["report", f"{folder}/recording.npz", "-o", str(tmp_path / "c")]) == 0
  said = capsys.readouterr().out
  assert "Outcome" in said and "report.html" in said and (tmp_path / "c" / "report.html").exists()
  pair = [f"{folder}/recording.npz", str(tmp_path / "b" / "recording.npz")]
  assert cli.main(["report", *pair, "-o", str(tmp_path / "d")]) == 0
  said = capsys.readouterr().out
  assert "out/recording" in said and "b/recording" in said and "Peak force [N]" in said
  assert "b/recording" in (tmp_path / "d" / "comparison.html").read_text()
  (tmp_path / "foreign.npz").write_bytes(b"PK nonsense")
  assert cli.main(["exercise", "--replay", str(tmp_path / "foreign.npz")]) == 2
  assert "not a readable palpate-recording" in capsys.readouterr().err
  for words in (["exercise", "--replay"], ["report"]):
    assert cli.main([*words, "nope.npz"]) == 2
    said = capsys.readouterr().err
    assert "nope.npz: No such file or directory, expected a palpate-recording (.npz)" in said
  assert cli.main(["exercise", "touch/easy", "--performer", "nobody"]) == 2
  assert "or module:object" in capsys.readouterr().err
  assert cli.main(["exercise", "touch/easy", "--performer", "math:none"]) == 2
  assert "math has no 'none'" in capsys.readouterr().err
  assert cli.main(["exercise", "touch/easy", "--performer", "math:sqrt", "-o", folder]) == 1
  said = capsys.readouterr()
  assert "error after 0.00 s" in said.out and "step 0: TypeError" in said.err
  assert cli.main(["exercise", "nothing"]) == 2


def test_films(tmp_path, capsys):
  """One of an episode as it goes, and one in its report on request."""
  pytest.importorskip("imageio_ffmpeg")
  words = ["exercise", "touch/easy", "--set", "time_limit=0.4", "--no-report", "--out", "a"]
  assert cli.main([*words, "--film", "a.gif", "--size", "160x120"]) == 0
  assert (tmp_path / "a.gif").read_bytes()[:10] == b"GIF89a" + bytes([160, 0, 120, 0])
  assert cli.main(["report", "a/recording.npz", "--film"]) == 0
  page = (tmp_path / "a" / "report.html").read_text()
  data = re.search(r"<video [^>]*src='data:video/mp4;base64,([^']*)'", page)[1]
  assert base64.b64decode(data)[4:8] == b"ftyp"


def test_a_report_begins_with_pictures_with_and_without_opengl(tmp_path, capsys, monkeypatch):
  words = ["exercise", "touch/easy", "--set", "time_limit=0.1", "--no-report", "--out", "a"]
  assert cli.main(words) == 0
  path, drawn = tmp_path / "a" / "recording.npz", []

  def pictures(*more):
    assert cli.main(["report", str(path), *more]) == 0
    page = (tmp_path / "a" / "report.html").read_text()
    found = re.findall(r"data:image/jpeg;base64,([^']*)'", page.partition("<h2>")[0])
    return [iio.imread(base64.b64decode(each)).astype(int) for each in found]

  drawn.append(pictures())
  monkeypatch.setattr(Physics, "render", None)
  drawn.append(pictures())
  assert len(drawn[0]) == len(drawn[1]) == 5
  for one, other in zip(*drawn, strict=True):
    assert one.std() > 20 and 0 < np.abs(one - other).mean() < 8
  assert not pictures("--no-pictures")
  made = Recording.load(path)
  made.arrays["action"][2:] = 0.5
  made.save(path)
  capsys.readouterr()
  assert not pictures()
  assert "no pictures: the replay differs in column" in capsys.readouterr().err


def test_a_replay_leaves_the_recording_alone(tmp_path, capsys):
  assert cli.main(EASY) == 0
  path = tmp_path / "out" / "touch_easy" / "recording.npz"
  before = path.read_bytes()
  assert cli.main(["exercise", "--replay", str(path), "--no-report"]) == 0
  assert "out/touch_easy_replay/recording.npz" in capsys.readouterr().out
  assert cli.main(["exercise", "--replay", str(path), "--out", "out/touch_easy"]) == 2
  said = capsys.readouterr().err
  assert "out is 'out/touch_easy', the folder of the recording that is replayed" in said
  assert path.read_bytes() == before


def test_ctrl_c_keeps_what_was_recorded(tmp_path, capsys, interrupted):
  assert cli.main([*EASY, "--out", "a"]) == 130
  said = capsys.readouterr()
  assert "stopped after 0.20 s" in said.out
  assert said.err == "palpate: interrupted; the recording up to there is kept\n"
  assert len(Recording.load(tmp_path / "a" / "recording.npz").time) == 11


def test_a_replay_that_is_interrupted_says_so_alone(tmp_path, capsys, request):
  assert cli.main([*EASY, "--out", "a"]) == 0
  request.getfixturevalue("interrupted")
  assert cli.main(["exercise", "--replay", "a/recording.npz", "--no-report"]) == 130
  assert "differs" not in capsys.readouterr().err


def test_a_stopped_recording_replays_with_its_outcome(tmp_path, capsys, monkeypatch):
  with monkeypatch.context() as patch:
    patch.setattr(console.Progress, "show", lambda *_: signal.raise_signal(signal.SIGINT))
    assert cli.main([*EASY, "--out", "a"]) == 130
  assert cli.main(["exercise", "--replay", "a/recording.npz", "--no-report"]) == 0
  assert "stopped after 0.02 s" in capsys.readouterr().out.splitlines()[-3]


@pytest.mark.parametrize(
  ("words", "said"),
  [
    (["--out", "file"], "out: cannot write 'file': "),
    (["--film", "file/a.mp4"], "film: cannot write 'file': "),
    (["--film", "a.avi"], "film is 'a.avi', expected a name that ends in .mp4 or .gif"),
    (["--film", "a.gif", "--size", "9x9"], "size is '9x9', expected WxH such as 1280x960"),
  ],
)
def test_outputs_that_cannot_be_written_are_said_before_the_work(
  words, said, tmp_path, capsys, monkeypatch
):
  pytest.importorskip("imageio_ffmpeg")
  monkeypatch.setattr(console.Progress, "show", lambda *_: pytest.fail("it worked first"))
  (tmp_path / "file").touch()
  assert cli.main([*EASY, *words]) in (1, 2)
  error = capsys.readouterr().err
  assert said in error and error.count("\n") == 1


def test_a_policy_that_cannot_be_made_is_one_line(tmp_path, capsys):
  text = "class P:\n  def __init__(self, env, seed): raise OSError('no weights')\n"
  (tmp_path / "lost.py").write_text(text)
  assert cli.main([*EASY, "--performer", "lost:P"]) == 2
  assert capsys.readouterr().err == "palpate: policy 'lost:P': OSError: no weights\n"


class Window:
  """Stands in for MuJoCo's passive viewer: presses a key at every second picture."""

  def __init__(self, model, data, key_callback, **panels):
    self.key, self.pictures = key_callback, 0
    self.cam = types.SimpleNamespace(type=None, fixedcamid=-1)
    self.opt = types.SimpleNamespace(flags=np.zeros(4, np.uint8))
    self.user_scn = types.SimpleNamespace(flags=np.ones(4, np.uint8))
    self.model, self.panels, self.closed = model, panels, False

  lock = contextlib.nullcontext

  def sync(self):
    assert not self.opt.flags.any() and self.user_scn.flags.all()
    self.pictures += 1
    if self.pictures % 2:
      self.key(ord("S"))
      self.user_scn.flags[1], self.opt.flags[2] = False, True  # the viewer's own switches

  def is_running(self):
    return self.pictures < 25

  def close(self):
    self.closed = True


@pytest.fixture
def windows(monkeypatch):
  """Every window that is opened."""
  opened = []

  def launch(*words, **keys):
    opened.append(Window(*words, **keys))
    return opened[-1]

  monkeypatch.setattr("mujoco.viewer.launch_passive", launch)
  monkeypatch.setenv("DISPLAY", ":0")
  return opened


def test_keyboard_moves_the_tool_in_front_of_the_laparoscope(tmp_path, windows):
  words = ["exercise", "touch/easy", "--performer", "keyboard", "--no-report"]
  assert cli.main([*words, "--out", str(tmp_path)]) == 0
  (window,) = windows
  assert window.cam.type == mujoco.mjtCamera.mjCAMERA_FIXED
  assert window.cam.fixedcamid == window.model.camera("laparoscope").id
  assert not any(window.panels.values()) and window.closed
  recording = Recording.load(tmp_path / "recording.npz")
  assert recording.info["performer"] == "keyboard" and len(recording.time) > 20
  moved = recording.arrays["action"]
  assert moved[2:, :].max() == 1.0  # inserted, by the key that was held


def test_escape_ends_the_episode(tmp_path, windows, monkeypatch):
  sync = Window.sync

  def escape(self):
    sync(self)
    if self.pictures == 6:
      self.key(256)

  monkeypatch.setattr(Window, "sync", escape)
  assert cli.main([*EASY, "--performer", "keyboard", "--out", "a"]) == 0
  recording = Recording.load(tmp_path / "a" / "recording.npz")
  assert recording.info["outcome"] == "stopped" and len(recording.time) == 1 + 6
  assert windows[0].closed


def test_closing_waits_for_the_window_to_go(windows, monkeypatch):
  gone = []

  class Slow(Window):
    def __init__(self, *words, **keys):
      super().__init__(*words, **keys)
      self.leave = threading.Event()
      threading.Thread(target=self.draw, daemon=True).start()

    def draw(self):
      self.leave.wait()
      time.sleep(0.3)  # MuJoCo's window finishes a picture
      gone.append(True)

    def close(self):
      self.leave.set()

  monkeypatch.setattr("mujoco.viewer.launch_passive", Slow)
  assert cli.main([*EASY, "--performer", "keyboard", "--out", "a"]) == 0
  assert gone


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("Xvfb"), reason="needs Xvfb")
def test_ctrl_c_in_the_window_ends_in_order(tmp_path):
  server = subprocess.Popen(
    ["Xvfb", "-displayfd", "1", "-screen", "0", "800x600x24"],
    stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
  )  # fmt: skip
  environment = os.environ | {"DISPLAY": f":{server.stdout.readline().strip()}"}
  environment.pop("MUJOCO_GL", None)
  command = [sys.executable, "-m", "palpate", *EASY, "--performer", "keyboard", "--out", "a"]
  try:
    for _ in range(5):
      process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
      time.sleep(8)
      process.send_signal(signal.SIGINT)
      _, error = process.communicate(timeout=60)
      assert process.returncode == 130, error
  finally:
    server.terminate()


def test_keyboard_says_that_there_is_no_display(tmp_path, monkeypatch, capsys):
  if not sys.platform.startswith("linux"):
    pytest.skip("displays are asked for on Linux")
  monkeypatch.delenv("DISPLAY", raising=False)
  monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
  assert cli.main(["exercise", "touch/easy", "--performer", "keyboard", "--out", str(tmp_path)])
  assert "no display to open a window on; use another performer" in capsys.readouterr().err
