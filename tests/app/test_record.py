"""A person's record: kept, read, exported, deleted; and what happens when things go wrong."""

import csv
import dataclasses
import json
import os
import pathlib
import re
import resource
import shutil
import stat
import subprocess
import sys
import tempfile
import zipfile

import numpy as np
import pytest
from palpate.app import cli
from palpate.app.trainee import keeping
from palpate.app.trainee.record import Record, Session, check_name
from palpate.tasks.people import limits
from palpate.tasks.recorder import Recorder, Settings
from palpate.tasks.recording import Recording

NAMES = ["O'Brien \"x\"'); drop table trainee;--", "../x", "/etc/passwd", "Zoë 李 🙂", "-", "%s"]
KNOWN = limits.lookup()
# In a process of its own: keeps recordings until it is killed, and says how many were committed.
WRITER = """
import sys, pathlib
sys.path[:0] = {path!r}
from test_record import KNOWN, Record, Session, made
record = Record(pathlib.Path({folder!r}), KNOWN)
person, session = record.add({name!r}), Session()
for k in range({count}):
  record.keep(person, made(k), session, KNOWN)
  print(k, flush=True)
"""


def made(seed=0, task="touch/easy", outcome="success", samples=20, **info):
  """A recording of a made-up exercise."""
  rng = np.random.RandomState(seed)
  recorder = Recorder(settings=Settings(force_limit=0.5, tip_cutoff=None), watch=["drop"])
  recorder.info = {"task": task, "seed": seed, "outcome": outcome, "performer": "device:mouse"}
  recorder.info |= {"palpate": "1", "mujoco": "3", **info}
  pos = np.cumsum(rng.randn(samples, 3) * 1e-3, 0)
  for k in range(samples):
    recorder.append(0.02 * k, pos[k], force=abs(rng.randn(3)) * 0.1)
  return recorder.recording()


@pytest.fixture
def folder(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
  return tmp_path / "out" / "record"


def fill(folder, name, count=3, **info):
  """Keeps some recordings of a person, of one session."""
  record = Record(folder, KNOWN)
  person, session = record.add(name), Session()
  return [record.keep(person, made(k, **info), session, KNOWN) for k in range(count)]


def episodes(folder, name):
  record = Record(folder)
  return record.episodes(record.find(name))


def everything(folder):
  """Returns the bytes of every file of a folder, and the paths."""
  paths = [path for path in folder.rglob("*") if path.is_file()]
  return b"".join(str(p).encode() + p.read_bytes() for p in paths)


def say(capsys, *words, code=0):
  """Runs a command and returns what it said."""
  assert cli.main(list(words)) == code
  said = capsys.readouterr()
  return said.out + said.err


def test_a_trainee_through_the_commands(folder, capsys, tmp_path):
  """Thirty episodes: a novice, then somebody skilled; what is locked, next, drawn, exported."""
  say(capsys, "trainee", "add", "Ada")
  words = ["exercise", "touch/easy", "--trainee", "Ada", "--seed"]
  assert "not open to 'Ada' yet: touch/easy comes first" in say(
    capsys, "exercise", "touch/standard", "--trainee", "Ada", "--performer", "expert", code=2
  )
  fill(folder, "Ada", 12, outcome="time limit")
  for k in range(12, 30):
    said = say(capsys, *words, str(k), "--performer", "expert")
  assert "Attempt 30 at touch/easy" in said and "next is navigate/easy" in said
  assert not (tmp_path / "out" / "touch_easy").exists()  # in the record alone
  done = episodes(folder, "Ada")
  assert [e.seed for e in done] == list(range(30)) and len({e.session for e in done}) == 1 + 18
  assert [e.outcome for e in done] == ["time limit"] * 12 + ["success"] * 18
  assert all(e.assessment and e.score == -20 for e in done[:12])
  again = Recording.load(folder / done[20].path)
  assert again.metrics() == done[20].metrics and again.info["performer"] == "expert"
  assert set(done[0].versions) == {"palpate", "mujoco"}
  said = say(capsys, "trainee", "show", "Ada", "-o", "ada.html", "--metric", "time")
  found = r"touch/easy +30 +18 +1[5-8]  rule met after (2[4-9]|30); CUSUM: competent"
  assert re.search(found, said)
  page = (tmp_path / "ada.html").read_text()
  assert "Ada" in page and "data:image/png;base64" in page and "Biau et al." in page
  say(capsys, "trainee", "show", "Ada", "-o", "ada.png", "--task", "touch/easy")
  assert (tmp_path / "ada.png").read_bytes()[:4] == b"\x89PNG"
  assert "next navigate/easy" in say(capsys, "trainee", "list")
  said = say(capsys, "trainee", "limits", "--trainee", "Ada", "--rule", "sd:0", "-o", "own.json")
  assert "touch/easy: limits of 18 successes" in said
  own = ["--references", "own.json"]
  said = say(capsys, "trainee", "show", "Ada", *own)
  assert re.search(r"touch/easy +30 +18 +0  12 more", said)  # nobody is better than all means
  assert "proficient  0/1" in say(capsys, "evaluate", "touch/easy", "--episodes", "1", *own)


@pytest.mark.parametrize("name", NAMES)
def test_any_name_is_a_name_and_no_path(folder, name, capsys):
  fill(folder, name, 1)
  assert len(episodes(folder, name)) == 1
  fill(folder, "somebody else", 1)
  inside = [path.relative_to(folder).as_posix() for path in folder.rglob("*")]
  allowed = r"recordings(/[0-9a-f]{32}(/(trainee\.json|\d{17}_touch_easy\.npz))?)?"
  assert all(re.fullmatch(allowed, path) for path in inside), inside
  assert cli.main(["trainee", "delete", "--yes", "--", name]) == 0
  record = Record(folder)
  assert [p.name for p in record.trainees()] == ["somebody else"]


@pytest.mark.parametrize("name", ["", "  ", "a\nb", "a\0b", "x" * 81, None, 3])
def test_what_is_no_name_is_refused(name):
  with pytest.raises(ValueError, match=r"trainee is .*, expected a name of 1 to 80"):
    check_name(name)


def test_equal_names_of_unicode_are_one_person(folder):
  fill(folder, "Zoe\u0308", 1)
  assert len(episodes(folder, "Zo\u00eb")) == 1


def test_nobody_else_may_read_a_record(folder):
  fill(folder, "Ada", 1)
  (folder / "recordings").chmod(0o777)  # by somebody who meant well
  old = os.umask(0)
  try:
    fill(folder, "Bo", 1)
  finally:
    os.umask(old)
  for path in [folder, *folder.rglob("*")]:
    mode = stat.S_IMODE(path.stat().st_mode)
    assert mode == (0o700 if path.is_dir() else 0o600), path


def test_deletion_leaves_nothing(folder, capsys):
  name = "Grace-Hopper-Ω"
  fill(folder, name, 6)
  kept = fill(folder, "Ada", 2)
  record = Record(folder)
  ident = record.find(name).id
  said = say(capsys, "trainee", "delete", name, code=2)
  assert "6 episodes" in said and "nothing is deleted without --yes" in said
  said = say(capsys, "trainee", "delete", name, "--yes")
  assert "6 episodes in 1 sessions, 7 files" in said
  left = everything(folder)
  assert name.encode() not in left and b"Hopper" not in left and ident.encode() not in left
  assert [e.path for e in episodes(folder, "Ada")] == [e.path for e in kept]
  assert all((folder / e.path).is_file() for e in kept)
  assert "no trainee" in say(capsys, "trainee", "delete", name, "--yes", code=1)


def test_deletion_says_where_something_is_left(folder, capsys):
  fill(folder, "Ada", 1)
  record = Record(folder)
  (folder / "notes.txt").write_text(record.find("Ada").id)
  said = say(capsys, "trainee", "delete", "Ada", "--yes", code=1)
  assert "notes.txt: still has data of 'Ada'" in said


def test_an_export_is_read_back(folder, capsys, tmp_path):
  fill(folder, "Ada", 3)
  fill(folder, "Bo", 2)
  say(capsys, "trainee", "export", "Ada", "-o", "a.zip")
  say(capsys, "trainee", "export", "Ada", "-o", "b", "--anonymous")
  with zipfile.ZipFile("a.zip") as archive:
    assert archive.testzip() is None
    archive.extractall("a")
  kept = episodes(folder, "Ada")
  for out, name in (("a", "Ada"), ("b", "")):
    data = json.loads((tmp_path / out / "trainee.json").read_text())
    assert (data["format"], data["name"], len(data["episodes"])) == ("palpate-trainee", name, 3)
    with open(tmp_path / out / "episodes.csv", newline="") as file:
      table = list(csv.DictReader(file))
    for row, line, episode in zip(data["episodes"], table, kept, strict=True):
      assert row["metrics"]["path_length"] == episode.metrics.path_length
      assert float(line["path_length"]) == pytest.approx(episode.metrics.path_length, rel=1e-6)
      assert row["seed"] == int(line["seed"]) == episode.seed
      again = Recording.load(tmp_path / out / row["recording"])
      assert again.metrics() == episode.metrics
  assert b"Ada" not in everything(tmp_path / "b")
  assert "is there already" in say(capsys, "trainee", "export", "Ada", "-o", "b", code=2)


def test_a_kill_in_the_middle_of_a_write_loses_nothing_that_was_committed(folder):
  script = WRITER.format(path=[str(pathlib.Path(__file__).parent)], folder=str(folder), name="Ada",
                         count=10_000)  # fmt: skip
  process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
  for line in process.stdout:
    if int(line) == 12:
      process.kill()
      break
  said = [int(line) for line in process.stdout.read().split()]
  process.wait()
  last = max(said, default=12)
  record = Record(folder, KNOWN)
  done = record.episodes(record.find("Ada"))
  assert [e.seed for e in done[: last + 1]] == list(range(last + 1))
  assert len(done) <= last + 2
  for episode in done:
    assert Recording.load(folder / episode.path).metrics() == episode.metrics
  assert not list(folder.rglob("*.part"))


def test_two_writers_keep_all(folder):
  processes = []
  for name in ("Ada", "Bo"):
    words = {"path": [str(pathlib.Path(__file__).parent)], "folder": str(folder), "name": name}
    script = WRITER.format(**words, count=8)
    processes.append(subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE))
  for process in processes:
    assert process.communicate()[0].split()[-1] == b"7" and process.returncode == 0
  for name in ("Ada", "Bo"):
    assert [e.seed for e in episodes(folder, name)] == list(range(8))


def test_a_record_is_its_recordings_and_reads_no_samples_to_list_them(folder, capsys, monkeypatch):
  before = fill(folder, "Ada", 2)
  monkeypatch.setattr(Recording, "load", None)
  assert episodes(folder, "Ada") == before
  said = say(capsys, "trainee", "list")
  assert "2 episodes" in said
  assert "no record in 'nowhere'" in say(capsys, "trainee", "list", "--record", "nowhere", code=1)


def test_limits_of_later_do_not_change_what_was_kept(folder):
  fill(folder, "Ada", 1)
  record = Record(folder, lambda task: None)
  (kept,) = record.episodes(record.find("Ada"))
  made(1).save((folder / kept.path).with_name("z.npz"))  # by nobody's limits yet
  _, other = record.episodes(record.find("Ada"))
  assert kept.score is not None and other.score is None


def test_a_full_disk_is_named_and_loses_nothing(folder):
  """A limit on the size of files: a large recording does not fit."""
  before = fill(folder, "Ada", 3)
  keep = keeping.Keeping(folder, "Ada").begin().keep
  large, limit = made(9, samples=3000), resource.getrlimit(resource.RLIMIT_FSIZE)
  try:
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, limit[1]))
    kept = keep(large)
    assert re.search("not kept in .*File too large; nor among the temporary files", kept.fault)
    assert kept.path is None
    assert episodes(folder, "Ada") == before
  finally:
    resource.setrlimit(resource.RLIMIT_FSIZE, limit)
  assert not keep(large).fault and len(episodes(folder, "Ada")) == 4
  assert not list(folder.rglob("*.part"))


def test_a_recording_that_cannot_be_kept_goes_elsewhere(folder):
  fill(folder, "Ada", 1)
  keep = keeping.Keeping(folder, "Ada").begin().keep
  shutil.rmtree(folder / "recordings")
  (folder / "recordings").write_text("nothing can be made there")
  kept = keep(made(1))
  assert kept.fault.startswith(f"not kept in {folder}: ")
  assert Recording.load(kept.path).info["seed"] == 1 and folder not in kept.path.parents


def test_a_link_does_not_lead_out(folder, tmp_path, capsys):
  (kept,) = fill(folder, "Ada", 1)
  (tmp_path / "secret.npz").write_text("mine")
  (folder / kept.path).with_name("z.npz").symlink_to(tmp_path / "secret.npz")
  assert "1 episodes" in say(capsys, "trainee", "export", "Ada", "-o", "a")
  assert "mine" not in str(everything(tmp_path / "a"))
  assert cli.main(["trainee", "delete", "Ada", "--yes"]) == 0
  assert (tmp_path / "secret.npz").read_text() == "mine"


def test_a_foreign_recording_is_named_and_harms_nothing(folder):
  (first, *_) = fill(folder, "Ada", 2)
  place = (folder / first.path).parent
  (place / "broken.npz").write_bytes(b"PK broken")
  odd = {"coach": {"hints": 5}, "record": {"session": first.session, "ended": 3}, "task": None}
  made(7, **odd).save(place / "odd.npz")
  (folder / "recordings" / "notes").mkdir()
  record = Record(folder, KNOWN)
  bo = record.add("Bo")
  made(8, record={"session": first.session}).save(folder / "recordings" / bo.id / "theirs.npz")
  record = Record(folder, KNOWN)
  assert [e.seed for e in record.episodes(record.find("Ada"))] == [0, 1, 7]
  assert [text for text in record.said if "broken.npz: not counted" in text]
  (other,) = record.episodes(record.find("Bo"))
  assert other.seed == 8


def test_a_page_shows_what_was_typed_as_text(folder, capsys, tmp_path):
  pytest.importorskip("matplotlib")
  name = "<script>alert('x')</script> & $\\frac{1"
  fill(folder, name, 2, task="touch/<b>easy</b>")
  record = Record(folder, KNOWN)
  record.add("nothing yet")
  say(capsys, "trainee", "show", name, "-o", "a.html")
  page = (tmp_path / "a.html").read_text()
  assert "<script" not in page and "<b>easy" not in page and "&lt;script&gt;" in page
  assert "exercises done: 0, next is touch/easy" in say(
    capsys, "trainee", "show", "nothing yet", "-o", "b.html"
  )


def test_a_name_on_a_page_adds_and_tells_nothing(folder):
  fill(folder, "Ada", 3)
  keep = keeping.Keeping(folder)
  for name in ("Ada", "New"):
    kept = keep.begin().keep(made(1, person=name))
    assert (kept.said, kept.fault) == ((), "")
    assert "person" not in Recording.load(kept.path).info
  assert len(episodes(folder, "Ada")) == 4 and len(episodes(folder, "New")) == 1
  keep.check("touch/hard")  # whom it would tell about is not known


def test_what_the_coach_said_and_errors(folder):
  coach = {"assessment": False, "hints": [{"kind": "instruction"}] * 3}
  (first,) = fill(folder, "Ada", 1, coach=coach)
  assert (first.assessment, first.hints) == (False, 3)
  record = Record(folder, KNOWN)
  person = record.find("Ada")
  record.keep(person, made(1, outcome="error"), Session(), KNOWN)
  broken = dataclasses.replace(made(2), info={"task": 3, "seed": "x", "coach": "y"})
  last = record.keep(person, broken, Session(), KNOWN)
  assert (last.task, last.seed, last.outcome) == ("3", None, "not recorded")
  kept = keeping.Keeping(folder, "Ada").begin().keep(made(5))
  assert kept.said[0].startswith("Attempt 2 at touch/easy")  # an error is no attempt
  kept = keeping.Keeping(folder, "Ada").begin().keep(made(5, task="press/own"))
  assert "Attempt 1 at press/own, which has no limits" in kept.said[0]


@pytest.mark.parametrize(
  ("words", "said"),
  [
    ("exercise touch/easy --trainee Ada", "trainee is 'Ada' without --device NAME: the expert's"),
    ("exercise touch/easy --trainee Ada --device hand --set damage=9", "set is 'damage=9' with"),
    ("exercise touch/easy --trainee Ada --device mouse --set nodes=9", "set is 'nodes=9' with"),
    ("exercise touch/easy --device mouse --set nodes=9", "set is given with --device mouse"),
    ("exercise touch/easy --device hand --performer expert", "expected one of them"),
    ("exercise touch/easy --trainee Bo --device hand", "no trainee 'Bo' in 'out/record', it has"),
    ("exercise touch/easy --record out/record", "record is given without --trainee"),
    ("exercise touch/easy --any-task", "any-task is given without --trainee"),
    ("exercise --replay x.npz --trainee Ada", "trainee is given with --replay"),
    ("exercise touch/easy --references none.json", "references: none.json: No such file"),
    ("evaluate touch/easy --references .", "references: .: not palpate-references: not a file"),
    ("serve --trainee Bo", "no trainee 'Bo'"),
    ("trainee show Ada --metric speed", "no such metric 'speed'"),
    ("trainee show Ada --task touch/hard", "task is 'touch/hard', 'Ada' has done touch/easy"),
    ("trainee show Ada -o a.pdf", "out is 'a.pdf', expected a name that ends in .html or .png"),
    ("trainee limits -o a.json", "no FILE and no --trainee"),
    ("trainee limits -o a.json --trainee Ada --rule best", "rule is 'best', expected panel"),
    ("trainee limits -o a.json --trainee Ada", "no limits were made"),
    ("trainee add x\ty", "trainee is 'x\\ty', expected a name"),
  ],
)
def test_what_is_wrong_is_one_line(folder, words, said, capsys):
  fill(folder, "Ada", 2)
  assert cli.main(words.split(" ")) in (1, 2)
  error = capsys.readouterr().err
  assert said in error and error.splitlines()[-1].startswith("palpate: ")
