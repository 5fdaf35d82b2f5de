"""The page's process keeps what is done in a record."""

import json
import multiprocessing
import pathlib
import threading

import pytest
from palpate.app.live.page import worker
from palpate.app.live.page.menu import offer
from palpate.app.trainee import keeping
from palpate.app.trainee.record import Record
from palpate.tasks.people import limits
from palpate.tasks.recording import Recording

ANSWER = 120.0  # that a busy machine may take [s]


@pytest.fixture
def folder(tmp_path):
  record = Record(tmp_path / "record", limits.lookup())
  record.add("Ada")
  return tmp_path / "record"


@pytest.fixture
def page(tmp_path):
  """Starts a page's process, here in a thread."""
  running = []

  def start(kept):
    near, far = multiprocessing.Pipe()
    thread = threading.Thread(target=worker.main, args=(far, str(tmp_path / "live"), "mouse", kept))
    thread.start()
    running.append((near, thread))
    return near

  yield start
  for near, thread in running:
    near.send_bytes(b'{"type": "end"}')
    thread.join(ANSWER)
    assert not thread.is_alive()


def hear(page, *kinds):
  """Returns the next message of one of the kinds; `frame` is a picture."""
  while page.poll(ANSWER):
    data = page.recv_bytes()
    words = json.loads(data[1:]) if data[:1] == b"T" else {"type": "frame"}
    if words["type"] in kinds:
      return words
  raise AssertionError(f"no {kinds}")


def do(page, **job):
  """Returns the card of an exercise that is begun and stopped, or the error that forbids it."""
  page.send_bytes(json.dumps({"type": "start", "seed": 3, **job}).encode())
  words = hear(page, "frame", "error")
  if words["type"] == "frame":
    page.send_bytes(b'{"type": "stop"}')
    words = hear(page, "card", "error")
  return words


def test_an_exercise_on_the_page_is_kept_and_what_is_locked_refused(page, folder, tmp_path):
  one = page(keeping.Keeping(folder, "Ada"))
  said = do(one, task="touch/hard")
  assert said["type"] == "error" and "not open to 'Ada' yet: touch/standard" in said["text"]
  first = do(one, task="touch/easy", person="Bo")  # who does it is said by the command
  do(one, task="touch/easy", assessment=True)
  assert first["said"][-1].startswith("Attempt 1 at touch/easy") and not first["fault"]
  assert Recording.load(first["path"]).outcome == "stopped"
  assert folder in pathlib.Path(first["path"]).parents and not (tmp_path / "live").exists()
  record = Record(folder)
  assert [p.name for p in record.trainees()] == ["Ada"]
  done = record.episodes(record.find("Ada"))
  assert [e.assessment for e in done] == [False, True] and done[0].hints > 0 == done[1].hints
  assert len({e.session for e in done}) == 1 and done[0].performer == "device:mouse"


def test_a_page_offers_what_is_open_to_its_trainee(folder):
  menu = offer("mouse", keeping.Keeping(folder, "Ada"))
  assert menu["trainee"] == "Ada" and menu["locked"]["touch/hard"] == "touch/standard"
  assert "touch/easy" not in menu["locked"] and set(menu["locked"]) < set(menu["tasks"])
  for kept in (None, keeping.Keeping(folder), keeping.Keeping(folder, "Ada", any_task=True)):
    assert not offer("mouse", kept)["locked"]


def test_references_need_no_record(page, tmp_path):
  reference = limits.lookup()("touch/easy")
  strict = {"metrics": {"errors": reference["metrics"]["errors"] | {"limit": -1.0}}}
  (tmp_path / "own.json").write_text(limits.to_json({"touch/easy": reference | strict}))
  card = do(page(keeping.Keeping(None, references=str(tmp_path / "own.json"))), task="touch/easy")
  assert pathlib.Path(card["path"]).parent == tmp_path / "live"
  assert [row["label"] for row in card["rows"] if row["over"]] == ["Errors"]


def test_a_name_on_a_page_is_kept_apart_and_nothing_is_told(page, folder, tmp_path):
  one = page(keeping.Keeping(folder))
  cards = [do(one, task="touch/easy", person=name) for name in ("Ada", "Bo", "")]
  assert not any("Attempt" in line for card in cards for line in card["said"])
  assert [folder in pathlib.Path(card["path"]).parents for card in cards] == [True, True, False]
  assert pathlib.Path(cards[2]["path"]).parent == tmp_path / "live"  # nobody's
  record = Record(folder)
  counts = {p.name: len(record.episodes(p)) for p in record.trainees()}
  assert counts == {"Ada": 1, "Bo": 1}
