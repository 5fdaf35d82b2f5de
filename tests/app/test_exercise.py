"""`palpate exercise`: its files, replays, and how it ends."""

import base64
import re
import signal

import imageio.v3 as iio
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
