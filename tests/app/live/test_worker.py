"""The process of a page, in this one: free practice, the expert, devices, a disk that is full."""

import base64
import errno
import json
import multiprocessing
import pathlib
import socket
import threading
import time
import types

import mujoco
import numpy as np
import palpate
import pytest
from palpate import models
from palpate.app.live import practice
from palpate.app.live.coupling import Link
from palpate.app.live.devices.hand import Hand
from palpate.app.live.page.picture import HEAD, Camera
from palpate.app.live.page.worker import Worker
from palpate.app.live.realtime_clock import Pace
from palpate.tasks.core.instrument import Instrument
from palpate.tasks.recording import Recording

ANSWER = 120.0  # that a busy machine may take [s]


class Page:
  """What a page says and hears, without a browser."""

  def __init__(self, folder, device="mouse"):
    palpate.register()
    self.near, far = multiprocessing.Pipe()
    self.worker = Worker(far, folder, device)
    self.thread = threading.Thread(target=self.worker.serve)
    self.thread.start()
    self.frame = None

  def tell(self, kind, **words):
    self.near.send_bytes(json.dumps({"type": kind, **words}).encode())

  def hear(self, kind, faults=False):
    """Returns the next message of a kind, `frame` for a picture's numbers."""
    due = time.monotonic() + ANSWER
    while time.monotonic() < due:
      if not self.near.poll(0.1):
        continue
      message = self.near.recv_bytes()
      if message[:1] == b"B":
        self.frame = np.frombuffer(message[1:], np.float32)
        if kind == "frame":
          return self.frame
        continue
      words = json.loads(message[1:])
      if words["type"] == "scene":
        self.scene = words
        self.place = [words["head"].index(f"tip_{axis}") for axis in "xyz"]
      if words["type"] == kind:
        return words
      assert faults or words["type"] != "error", words
    raise AssertionError(f"no {kind}")

  def value(self, name):
    return float(self.hear("frame")[self.scene["head"].index(name)])

  def tip(self):
    return self.hear("frame")[self.place].astype(float)

  def close(self):
    self.tell("end")
    for _ in range(int(10 * ANSWER)):
      if not self.thread.is_alive():
        return
      while self.near.poll():
        self.near.recv_bytes()
      self.thread.join(0.1)
    raise AssertionError("it goes on")


@pytest.fixture
def page(tmp_path):
  pages = []

  def start(device="mouse"):
    pages.append(Page(tmp_path / "out", device))
    return pages[-1]

  yield start
  for each in pages:
    each.close()


def exercise(page, **words):
  page.tell("start", task="touch/easy", **words)
  page.hear("scene")
  page.hear("frame")
  stir(page)


def stir(page):
  """Moves a hand, which starts the clock; the instrument stays."""
  page.tell("hand", move=[0.001, 0, 0, 0])


def finish(page):
  page.tell("stop")
  return page.hear("card")


def test_free_practice_changes_while_it_runs(page):
  """Scheme, device, mesh and organ; a scheme that diverges is named and left."""
  one = page()
  menu = one.hear("menu")
  assert {"16 x 16", "256 x 256", "1000 nodes"} <= set(menu["meshes"])
  assert menu["schemes"] == ["implicit", "midpoint", "neumann", "explicit"]
  one.tell("practice", organ="liver", mesh="32 x 32", speed=1.0)
  scene = one.hear("scene")
  assert scene["practice"] and scene["nodes"] == 1026 and scene["time_limit"] is None
  one.tell("scheme", value="neumann")
  while one.hear("status").get("scheme") != "neumann":
    pass
  one.tell("scheme", value="explicit")
  while "explicit: the motion diverged" not in (words := one.hear("status"))["fault"]:
    pass
  assert words["scheme"] == "implicit" and np.isfinite(one.hear("frame")).all()
  before = one.tip()
  one.tell("device", value="hand")
  while np.linalg.norm(one.tip() - before) < 0.003:
    pass
  one.tell("device", value="page")
  one.tell("practice", organ="kidney", mesh="16 x 16", instrument="grasper", scheme="neumann")
  assert one.hear("scene")["nodes"] == 258 and one.scene["jaws"]
  assert one.value("steps") < 5000  # another loop
  one.tell("stop")
  one.hear("idle")
  for words, said in (
    ({"organ": "heart"}, "organ is 'heart', expected one of"),
    ({"mesh": "7 x 7"}, "mesh is '7 x 7'"),
    ({"scheme": "magic"}, "scheme is 'magic'"),
    ({"step": 0.3}, "step is '0.3'"),
    ({"left": "../x"}, "left is '../x'"),
  ):
    one.tell("practice", **words)
    assert said in one.hear("error")["text"]
  one.tell("device", value="udp:0.0.0.0:1")
  assert "device is 'udp:0.0.0.0:1', expected one of" in one.hear("error")["text"]


@pytest.mark.parametrize("message", [b"[" * 200_000, b"\xff", b"{}", b'{"type": "hand", "at": 3}'])
def test_whatever_is_sent_is_answered_and_the_exercise_goes_on(page, message):
  one = page()
  exercise(one)
  one.near.send_bytes(message)
  if message[-1:] != b"}" or message == b"{}":
    assert one.hear("error", faults=True)["text"]
  assert finish(one)


def test_two_hands_on_one_page(page):
  one = page()
  both = {"task": "bimanual/easy", "left": "keyboard"}
  one.tell("start", **both | {"left": ""})
  assert "which takes two hands, left is ''" in one.hear("error")["text"]
  for kind, words in ("practice", {"mesh": "16 x 16", "left": "keyboard"}), ("start", both):
    one.tell(kind, **words)
    the_left_hand_moves_its_instrument_alone(one)
  made = Recording.load(finish(one)["path"])
  assert made.info["performer"] == "device:mouse+mouse" and len(made.instruments) == 2


def the_left_hand_moves_its_instrument_alone(one):
  one.hear("scene")
  stir(one)
  first = one.hear("frame")
  one.tell("hand", which="left", rate=[1, 0, 0, 0])
  size = len(one.scene["head"]) + 3 * one.scene["nodes"]
  own = slice(size, size + 12 * one.scene["bodies"])
  places = lambda frame: frame[own].reshape(-1, 12)[:, :3]  # noqa: E731
  moved = np.zeros(one.scene["bodies"])
  while moved.max() < 0.01:
    moved = np.linalg.norm(places(one.hear("frame")) - places(first), axis=1)
  assert np.linalg.norm(one.tip() - first[one.place]) < 2e-3  # the right one stays, but stirred


def test_the_clock_starts_with_the_first_movement(page):
  one = page()
  one.tell("start", task="touch/easy")
  one.hear("scene")
  assert one.value("state") == 0.0 and one.frame[0] == 0.0
  still = [0.0] * 4  # a page tells all its hands how they are, before they move
  for which in ("right", "scope"):
    one.tell("hand", which=which, move=still, rate=still, buttons=[], jaw=0)
  time.sleep(0.5)
  assert not one.near.poll() or json.loads(one.near.recv_bytes()[1:])["type"] == "status"
  stir(one)
  while one.value("time") < 0.1:
    pass
  assert one.value("state") == 1.0 and one.value("time") < 0.4


def test_the_expert_is_shown_on_request_and_noted(page):
  one = page()
  exercise(one)
  while (before := one.value("time")) < 0.05:
    pass
  one.tell("ghost")
  shown = one.hear("ghost")
  stir(one)
  # Working it out takes seconds, for which the clock waits, until the hand moves.
  assert one.value("time") < before + 1.0
  assert shown["outcome"] == "success" and len(shown["time"]) == len(shown["pose"]) > 20
  np.testing.assert_allclose(shown["pose"][0][:3], one.frame[one.place], atol=4e-3)
  made = Recording.load(finish(one)["path"])
  assert ["the expert was shown"] == [
    hint["text"] for hint in made.info["coach"]["hints"] if hint["kind"] == "hint"
  ]
  exercise(one, assessment=True)
  one.tell("ghost")
  assert "not in an assessment" in one.hear("error")["text"]


def test_a_frame_has_the_largest_force_since_the_last():
  env = palpate.tasks.load("touch", "easy", task_kwargs={"random": 0})
  env.reset()
  camera, pace = Camera.of(env), Pace.instant()
  device = types.SimpleNamespace(stamp=0.0)
  link = types.SimpleNamespace(paused=False, state="ready", force=(0, 0, 0), device=device)
  forces = []
  for felt in (0.9, 0.0):  # a control step is shorter than a frame
    camera.feel(felt)
    camera.feel(0.1)
    forces.append(np.frombuffer(camera.frame(link, pace), np.float32)[HEAD.index("force")])
  np.testing.assert_allclose(forces, [0.9, 0.1], atol=1e-6)


def test_the_plot_has_the_force_of_every_control_step(page, monkeypatch):
  """As warnings have: a force that lasts for one control step falls between two frames."""
  keep, steps = Instrument.keep, []

  def spiked(self, values):
    keep(self, values)
    steps.append(0)
    self.peak_force = 0.1 + 1e-3 * len(steps) if len(steps) % 10 == 0 else 0.0

  monkeypatch.setattr(Instrument, "keep", spiked)
  one = page()
  exercise(one)
  begun, felt = len(steps), []
  while len(steps) < begun + 210:
    felt.append(one.value("force"))
  finish(one)
  spikes = [0.1 + 1e-3 * k for k in range(-(-begun // 10) * 10 + 10, begun + 200, 10)]
  seen = sum(any(abs(force - spike) < 1e-5 for force in felt) for spike in spikes)
  assert seen >= 0.9 * len(spikes)  # frames of a busy machine may be far apart


def test_a_full_disk_loses_nothing(page, tmp_path, monkeypatch):
  """Kept beside where that goes, in memory where it does not, and saved when there is room."""
  one, full = page(), ["out", "palpate-"]
  save = Recording.save

  def limited(self, path):
    if any(name in str(path) for name in full):
      raise OSError(errno.ENOSPC, "No space left on device")
    return save(self, path)

  monkeypatch.setattr(Recording, "save", limited)
  exercise(one, person="Ada")
  card = finish(one)
  assert card["path"] == "" and card["fault"].count("No space left on device") == 2
  one.tell("keep")
  assert one.hear("kept")["path"] == ""
  full.remove("palpate-")
  one.tell("keep")
  assert "palpate-" in one.hear("kept")["path"]
  full.clear()
  one.tell("keep")
  kept = one.hear("kept")
  assert kept["fault"] == "" and pathlib.Path(kept["path"]).parent == tmp_path / "out"
  assert Recording.load(kept["path"]).info["person"] == "Ada"


def test_a_tab_that_closes_with_a_full_disk_saves_when_it_ends(page, tmp_path, monkeypatch):
  one = page()
  save = Recording.save
  full = lambda self, path: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full"))  # noqa: E731
  monkeypatch.setattr(Recording, "save", full)
  exercise(one)
  assert finish(one)["path"] == ""
  monkeypatch.setattr(Recording, "save", save)
  one.close()
  assert len(list((tmp_path / "out").glob("*.npz"))) == 1


def test_a_device_that_another_tab_has_is_named(page):
  with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
    other.bind(("127.0.0.1", 0))
    one = page(f"udp:{other.getsockname()[1]}")
    one.tell("start", task="touch/easy")
    assert "cannot listen on" in one.hear("error")["text"]
    one.hear("idle")
    one.tell("device", value="page")
    exercise(one)
    assert one.value("state") == 1.0  # goes on by mouse


def test_a_cut_is_told_with_its_edges():
  env = palpate.tasks.load("cut", "easy", task_kwargs={"random": 0})
  env.reset()
  camera = Camera.of(env)
  whole = camera.shapes()["organs"][0]["topology"]
  assert not camera.cuts() and unpack(whole["lips"]).size == 0
  organ = env.physics.organ
  organ.cut(np.array([[-0.01, 0.0, 0.0], [0.01, 0.0, 0.0]]))
  (told,) = camera.cuts()
  assert not camera.cuts() and told["outer"] == len(organ.elem)
  np.testing.assert_array_equal(unpack(told["triangles"]).reshape(-1, 3), organ.elem)
  start, end = organ.xpos0[unpack(told["lips"]).reshape(-1, 2).T]
  along = np.linalg.norm(end - start, axis=1)
  assert along.sum() / 2 == pytest.approx(0.02, abs=0.005)  # both edges of the cut, as long as it
  assert np.abs(start[:, 1]).max() < 0.003


def test_a_frame_has_the_places_of_a_thread():
  spec = palpate.models.load("kidney", nodes=250)
  line = np.array([0.1, 0, 0]) + 0.002 * np.arange(6)[:, None] * (0, 1, 0)
  palpate.add_thread(spec, line, "suture", strength=0.5)
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  organ, thread = palpate.Organ(model, data, "kidney/kidney"), palpate.Thread(model, data, "suture")
  camera, device = Camera(model, data, organ, "probe/"), Hand()
  (told,) = camera.shapes()["threads"]
  assert told["nodes"] == 6 and 5e-5 < told["radius"] < 2e-4

  def nodes():
    first = len(HEAD) + 3 * organ.nvert
    frame = np.frombuffer(camera.frame(Link(device), Pace.instant()), np.float32)
    return frame[first : first + 4 * 6].reshape(6, 4)

  np.testing.assert_allclose(nodes(), np.column_stack([line, np.ones(6)]), atol=1e-6)
  for k, pull in ((0, -1.0), (5, 1.0)):
    data.xfrc_applied[model.body(f"suture_{k}").id, 1] = pull  # twice what it bears
  mujoco.mj_step(model, data, 50)
  assert thread.broken.any()
  np.testing.assert_array_equal(nodes()[:-1, 3] == 0, thread.broken)


def unpack(packed):
  """Returns numbers as the page reads them."""
  ((kind, text),) = packed.items()
  kinds = {"f": np.float32, "b": np.uint8, "h": np.uint16, "u": np.uint32}
  return np.frombuffer(base64.b64decode(text), kinds[kind])


def test_every_organ_of_a_scene_is_drawn_and_lit(tmp_path):
  spec, folder = mujoco.MjSpec(), models.path("kidney", scene=False).parent
  for name, at in (("near", 0.0), ("far", 0.2)):
    mesh = str(folder / "assets" / "kidney.obj")
    palpate.add_organ(spec, mesh, name, young=5e3, foundation=1e5, pos=(at, 0, 0))
  spec.compile()
  spec.to_file(str(tmp_path / "two.xml"))
  hands = {"probe": Hand()}
  made = practice.Practice("", {}, hands, pace=Pace.instant(), scene=tmp_path / "two.xml")
  told = made.camera.shapes()
  near, far = told["organs"]
  first, last = len(HEAD), len(HEAD) + 3 * told["nodes"]
  frame = np.frombuffer(made.camera.frame(made.link, made.pace), np.float32)
  np.testing.assert_allclose(frame[first:last].reshape(-1, 3), made.organ.xpos, atol=1e-6)
  other = frame[last : last + 3 * far["count"]].reshape(-1, 3)
  np.testing.assert_allclose(other, palpate.Organ(made.model, made.data, "far").xpos, atol=1e-6)
  assert unpack(far["topology"]["triangles"]).max() < far["count"] == near["count"]
  assert told["lights"][0]["pos"] is not None  # nothing else gives light


def test_cutting_tools_cut_in_free_practice():
  spec, name = practice.furnished("gallbladder", {"nodes": 250}, ("scalpel",))
  model = spec.compile()
  organ = palpate.Organ(model, mujoco.MjData(model), name)
  assert organ.config.spare and organ.cutters[0].geoms == ("scalpel/edge",)
  assert organ.skin is not None  # in the abdomen


def test_a_scene_of_ones_own_is_practised_on(tmp_path):
  path = models.path("kidney", scene=False)
  made = practice.Practice("", {}, {"hook": Hand()}, pace=Pace.instant(), scene=path)
  away = np.linalg.norm(made.organ.xpos - made.data.site("hook/tip").xpos, axis=1).min()
  assert 0.005 < away < 0.05  # of the tip
  made.run(watch=lambda now: setattr(now.pace, "stopped", now.data.time > 0.02))
  assert np.isfinite(made.organ.xpos).all() and made.data.time > 0.02
  empty = tmp_path / "empty.xml"
  empty.write_text("<mujoco><worldbody/></mujoco>")
  with pytest.raises(ValueError, match="it has no organ"):
    practice.own(empty, ())
