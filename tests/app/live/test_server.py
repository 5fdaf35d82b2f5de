"""The page's server: who may come in, what is refused, and an exercise over its socket."""

import contextlib
import http.client
import json
import multiprocessing
import pathlib
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from socket import gethostname

import numpy as np
import pytest
from palpate.app import cli
from palpate.app.trainee.keeping import Keeping
from palpate.app.trainee.record import Record
from palpate.tasks.core import episode
from palpate.tasks.people import limits, report
from palpate.tasks.recording import Recording

pytest.importorskip("websockets")
from palpate.app.live.page.server import Server
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

ANSWER = 120.0  # that a busy machine may take [s]


@pytest.fixture
def serve(tmp_path):
  running = []

  def start(**kwargs):
    server = Server(tmp_path / "out", **kwargs)
    thread = threading.Thread(target=server.run)
    thread.start()
    running.append((server, thread))
    return server

  yield start
  for server, thread in running:
    server.close()
    thread.join(30)
    assert not thread.is_alive()


def get(server, path="/", host=None):
  """Returns status and text of a page."""
  request = urllib.request.Request(f"http://127.0.0.1:{server.port}{path}")
  if host:
    request.add_header("Host", host)
  try:
    with urllib.request.urlopen(request, timeout=10) as found:
      return found.status, found.read().decode()
  except urllib.error.HTTPError as error:
    return error.code, error.read().decode()


def socket(server, query="", origin=None):
  url = f"ws://127.0.0.1:{server.port}/socket{query}"
  origin = origin or f"http://127.0.0.1:{server.port}"
  return connect(url, origin=origin, open_timeout=30, max_size=None)


def hear(page, kind):
  """Returns the next message of a kind, and the frames before it."""
  frames = []
  while True:
    message = page.recv(timeout=ANSWER)
    if isinstance(message, bytes):
      frames.append(np.frombuffer(message, np.float32))
      if kind == "frame":
        return frames[-1], frames
      continue
    words = json.loads(message)
    if words["type"] == kind:
      return words, frames
    assert words["type"] != "error", words


def tell(page, **message):
  page.send(json.dumps(message))


def test_the_page_and_its_files_are_there_and_nothing_else(serve):
  server = serve()
  status, text = get(server)
  assert status == 200 and "Palpate" in text and server.url == f"http://127.0.0.1:{server.port}/"
  for path in ("/page.js", "/scene/view.js", "/hand.js", "/page.css"):
    assert get(server, path)[0] == 200
  for path in ("/server.py", "/../server.py", "/%2e%2e/server.py", "/socketx"):
    assert get(server, path)[0] == 404


def test_strangers_are_refused(serve):
  server = serve()
  assert get(server, host="evil.example")[0] == 403  # a name that was made to lead here
  assert get(server, host=f"localhost:{server.port}")[0] == 200
  for origin in ("http://evil.example", f"http://127.0.0.1:{server.port + 1}", "null"):
    with pytest.raises(InvalidStatus) as refused:
      socket(server, origin=origin)
    assert refused.value.response.status_code == 403


def test_a_request_of_two_hosts_is_a_bad_one_and_a_page_connects_to_its_own_alone(serve):
  server = serve()
  with contextlib.closing(http.client.HTTPConnection("127.0.0.1", server.port)) as line:
    line.putrequest("GET", "/", skip_host=True)
    for _ in range(2):
      line.putheader("Host", f"localhost:{server.port}")
    line.endheaders()
    assert line.getresponse().status == 400
  url = f"http://localhost:{server.port}/"
  with urllib.request.urlopen(url, timeout=10) as found:
    policy = found.headers["Content-Security-Policy"]
  own = f"localhost:{server.port}"
  assert f"connect-src 'self' ws://{own} wss://{own};" in policy


def test_a_page_that_is_loaded_again_waits_for_its_place(serve):
  server = serve(most=1)
  for _ in range(2):
    with socket(server) as page:
      hear(page, "menu")


def test_what_others_can_reach_wants_a_token(serve):
  server = serve(host="0.0.0.0")
  assert len(server.token) > 20 and server.url.endswith(f"?token={server.token}")
  assert server.url.startswith(f"http://{gethostname()}:")  # not localhost, which others are too
  assert get(server)[0] == 403 and get(server, "/?token=wrong")[0] == 403
  assert get(server, f"/?token={server.token}")[0] == 200
  for query in ("", "?token=wrong"):
    with pytest.raises(InvalidStatus):
      socket(server, query)


def test_a_session_over_the_socket(serve, tmp_path):
  """Bad words are named and change nothing; the exercise is moved, paused, stopped, kept."""
  server = serve(most=1)
  with socket(server) as page:
    menu, _ = hear(page, "menu")
    assert menu["tasks"]["touch/easy"] and 1000 in menu["nodes"]
    assert next(iter(menu["tasks"])) == "touch/easy"  # what a beginner begins with
    with socket(server) as other:
      assert "All places are taken" in json.loads(other.recv(timeout=ANSWER))["text"]
    for words, said in (
      ("{", "Expecting"),
      ("[1]", "message is '[1]'"),
      ('{"type": "shell"}', "expected hand, start"),
      ('{"type": "start", "task": "touch/none"}', "task is 'touch/none', expected one of"),
      ('{"type": "start", "task": "touch/easy", "nodes": 7}', "nodes is '7', expected one of"),
      ('{"type": "start", "task": "touch/easy", "seed": -1}', "seed is -1"),
      ('{"type": "start", "task": "touch/easy", "scale": 1e9}', "scale is 1000000000.0"),
      ('{"type": "start", "task": "touch/easy", "person": "\\u0000"}', "person is"),
    ):
      page.send(words)
      assert said in json.loads(page.recv(timeout=ANSWER))["text"]
    tell(page, type="start", task="touch/easy", seed=3, nodes=250, person="Ada")
    scene, _ = hear(page, "scene")
    assert scene["force_limit"] == 0.5 and len(scene["parts"]) > 3
    size = len(scene["head"]) + 3 * scene["nodes"] + 12 * scene["bodies"] + 19 * len(scene["sites"])
    head = {name: i for i, name in enumerate(scene["head"])}
    first, _ = hear(page, "frame")
    assert first.shape == (size,)
    nodes = first[len(head) : len(head) + 3 * scene["nodes"]].reshape(-1, 3)
    assert np.ptp(nodes, axis=0).max() == pytest.approx(0.2, abs=0.05)  # a liver
    tell(page, type="hand", move=[0.01, 0, 0, 0], rate=[0, 0, 0, 0], buttons=[])
    right = np.array(scene["camera"]["mat"]).reshape(3, 3)[:, 0]
    place = [head[f"tip_{axis}"] for axis in "xyz"]
    for _ in range(300):
      now, _ = hear(page, "frame")
      if np.dot(now[place] - first[place], right) > 0.008:
        break
    assert np.dot(now[place] - first[place], right) == pytest.approx(0.01, abs=0.0025)
    tell(page, type="pause", on=True)
    time.sleep(0.5)
    tell(page, type="stop")
    card, _ = hear(page, "card")
    assert card["outcome"] == "stopped" and card["ending"].startswith("Stopped before the end")
  made = Recording.load(card["path"])
  assert pathlib.Path(card["path"]).parent == tmp_path / "out"
  assert made.info["person"] == "Ada" and made.info["seed"] == 3
  assert episode.differences(made, episode.replay(made)) == []


def test_a_killed_exercise_is_in_the_record_up_to_the_last_second(serve, tmp_path, capsys):
  folder = tmp_path / "record"
  record = Record(folder, limits.lookup())
  ada = record.add("Ada")
  with socket(serve(kept=Keeping(folder, "Ada"))) as page:
    hear(page, "menu")
    tell(page, type="start", task="touch/easy", seed=3, assessment=True)
    scene, _ = hear(page, "scene")
    tell(page, type="hand", move=[0.001, 0, 0, 0])  # which starts the clock
    until = scene["head"].index("time")
    while (now := hear(page, "frame")[0][until]) < 2.5:
      pass
    (process,) = multiprocessing.active_children()
    process.kill()
    process.join()
  record = Record(folder)
  (done,) = record.episodes(ada)
  made = Recording.load(record.path(done))
  assert not record.said
  assert done.outcome == "interrupted" and done.seed == 3 and done.assessment
  assert now - 1.3 < made.time[-1] < now + 0.5 and not done.proficient
  assert "vertices" in made.constants and np.isfinite(made.columns["tip_pos"]).all()
  assert episode.differences(made, episode.replay(made)) == ["constant state_last"]
  assert report.ending(made).startswith("Interrupted: the program was killed")
  assert cli.main(["trainee", "show", "Ada", "--record", str(folder)]) == 0
  said = capsys.readouterr().out
  assert "; 1 interrupted, not counted" in said and "attempts" not in said


def test_a_closed_tab_keeps_its_recording(serve, tmp_path):
  server = serve()
  with socket(server) as page:
    hear(page, "menu")
    tell(page, type="start", task="touch/easy", assessment=True)
    hear(page, "frame")
    tell(page, type="hand", move=[0.001, 0, 0, 0])
  for _ in range(600):
    (path,) = (tmp_path / "out").glob("*.npz")
    if path.read_bytes()[:2] == b"PK":  # no longer its parts
      break
    time.sleep(0.1)
  made = Recording.load(path)
  assert made.outcome == "stopped" and made.info["coach"] == {"assessment": True, "hints": []}


@pytest.mark.parametrize(
  ("words", "said"),
  [
    (["serve", "--port", "70000"], "port is 70000"),
    (["serve", "--device", "glove"], "device is 'glove'"),
    (["serve", "--pages", "0"], "pages is 0"),
    (["exercise", "touch/easy", "--device", "glove"], "device is 'glove'"),
    (["exercise", "touch/none", "--device", "mouse"], "task is 'touch/none'"),
    (["exercise", "--replay", "x", "--device", "mouse"], "device is given without a TASK"),
  ],
)
def test_wrong_options_are_one_line(words, said, capsys):
  assert cli.main(words) == 2
  error = capsys.readouterr().err
  assert said in error and error.count("\n") == 1


def test_the_command_serves_until_it_is_interrupted(tmp_path):
  # As installed: `import palpate` registers nothing in a program of that name, nor in its workers.
  script = tmp_path / "palpate"
  script.write_text(
    "import sys\nfrom palpate.app.cli import main\nif __name__ == '__main__':\n  sys.exit(main())\n"
  )
  words = [sys.executable, script, "serve", "--port", "0", "-o", tmp_path / "out"]
  pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
  with subprocess.Popen(words, **pipes) as process:
    assert process.stdout
    line = process.stdout.readline()
    said = "" if line else process.communicate()[1]
    assert line.startswith("page "), said
    url = line.split()[1]
    with urllib.request.urlopen(url, timeout=ANSWER) as answer:
      assert "<canvas" in answer.read().decode()
    way = url.replace("http", "ws", 1) + "socket"
    with connect(way, origin=url.rstrip("/"), open_timeout=30, max_size=None) as page:
      assert "touch/easy" in hear(page, "menu")[0]["tasks"]
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=ANSWER)
  assert (process.returncode, said) in ((0, ""), (130, ""))


def test_an_exercise_by_a_device_from_the_command_line(tmp_path, capsys, monkeypatch):
  monkeypatch.chdir(tmp_path)
  words = ["exercise", "touch/easy", "--device", "hand", "--no-report", "--set", "time_limit=1"]
  assert cli.main([*words, "-o", "a"]) == 0
  assert "on time, 99 % within" in capsys.readouterr().out
  assert cli.main(["exercise", "--replay", "a/recording.npz", "--no-report", "-o", "b"]) == 0
  assert "the same to the bit" in capsys.readouterr().out
