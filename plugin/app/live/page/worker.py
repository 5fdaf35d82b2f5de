"""The process of one page: its exercises run here, and nothing of another's.

Messages to here are JSON; from here JSON (`T` before it) or frames of a picture (`B`).
"""

import contextlib
import json
import pathlib
import queue
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

import palpate
import warp as wp
from palpate.tasks.recording import Recording
from palpate.tissue import device as devices

from ...trainee.keeping import Keeping, Kept
from ..coach import Coach, card
from ..coupling import Options
from ..devices import registry
from ..devices.device import Device, DeviceError
from ..devices.relative import Desk
from ..practice import DAMAGE, LIMIT, Practice
from ..realtime_clock import first
from ..session import Session
from . import ghost, menu
from .picture import HOOK, Camera

_STATUS = 0.1  # between words about the exercise [s]
_WORDS = (
  "hand", "start", "practice", "scheme", "device", "ghost", "keep", "pause", "speed", "stop",
  "follow",
)  # fmt: skip


def main(
  conn: Connection, folder: str, device: str, kept: Keeping | None = None, scene: str = ""
) -> None:
  """Serves one page until it says `end`.

  Args:
    conn: to the server
    folder: where recordings are kept
    device: name of the device; one of the page's own is moved by its messages
    kept: the record that recordings go to, None for the folder
    scene: MJCF file for free practice, empty for none
  """
  palpate.register()
  try:
    Worker(conn, pathlib.Path(folder), device, kept, scene).serve()
  except KeyboardInterrupt:
    pass


class Worker:
  """Runs the exercises that a page asks for, one after another."""

  def __init__(
    self,
    conn: Connection,
    folder: pathlib.Path,
    device: str,
    kept: Keeping | None = None,
    scene: str = "",
  ):
    """Takes the arguments of `main`."""
    self._sitting = (kept or Keeping(None)).begin(folder)
    self._conn, self._own, self._scene = conn, device, scene
    self._device = "page" if registry.on_page(device) else device
    self._jobs: queue.SimpleQueue[dict | None] = queue.SimpleQueue()
    self._now: Session | Practice | None = None  # what runs
    self._job: dict[str, Any] = {}
    self._desks: dict[str, Desk] = {}  # hands on the page, by the message's `which`
    self._lock = threading.Lock()  # of the connection
    self._frame: bytes | None = None
    self._fresh = threading.Event()
    self._camera: Camera | None = None
    self._unkept: tuple[Recording, Kept, pathlib.Path | None] | None = None
    self._expert: subprocess.Popen | None = None
    self._trace: dict[str, Any] | None = None  # of the expert; empty where it failed
    self._asked = False  # for it
    self._ended = False
    self._ready = threading.Thread(target=_prepare, daemon=True)

  def serve(self) -> None:
    """Works until the end."""
    for target in (self._receive, self._show):
      threading.Thread(target=target, daemon=True).start()
    self._offer()
    self._ready.start()
    while (job := self._jobs.get()) is not None:
      if not self._jobs.empty():  # something else was asked for since
        continue
      try:
        self._job = job
        self._exercise(job) if job["type"] == "start" else self._practise(job)
      except Exception as error:  # the page names whatever it is, and goes on
        told = isinstance(error, (ValueError, OSError, DeviceError))
        if not told:
          traceback.print_exc()
        self._fault(error if told else f"{type(error).__name__}: {error}")
        self._tell({"type": "idle"})
    if self._unkept is not None and (kept := self._keep(*self._unkept)).path is None:
      print(f"palpate: a recording is lost: {kept.fault}", file=sys.stderr)

  def _keep(self, recording: Recording, before: Kept | None, path: pathlib.Path | None) -> Kept:
    """Keeps a recording, and notes one that is not where it belongs, to try again."""
    kept = self._sitting.keep(recording, before, path)
    self._unkept = (recording, kept, path) if kept.fault else None
    return kept

  # Words.

  def _tell(self, message: dict[str, Any]) -> None:
    with self._lock:
      if not self._ended:
        self._conn.send_bytes(b"T" + json.dumps(message).encode())

  def _offer(self) -> None:
    self._tell(menu.offer(self._own, self._sitting.keeping, bool(self._scene)))

  def _fault(self, error: Exception | str) -> None:
    self._tell({"type": "error", "text": " ".join(str(error).split())})

  def _receive(self) -> None:
    """Takes messages, in a thread of its own."""
    first(1)  # behind the loop's, before other programs: the loop may wait for it
    while not self._ended:
      try:
        message = json.loads(self._conn.recv_bytes())
        self._obey(message)
      except (EOFError, OSError):
        self._end()
      except Exception as error:  # whatever was sent, the exercise goes on and is kept
        self._fault(error)

  def _obey(self, message: Any) -> None:
    kind = message.get("type") if isinstance(message, dict) else None
    if kind == "end":
      self._end()
    elif kind in _WORDS:
      getattr(self, f"_on_{kind}")(message)
    else:
      raise ValueError(f"message is {str(message)[:60]!r}, expected {', '.join(_WORDS)}")

  def _on_hand(self, message: dict[str, Any]) -> None:
    desk = self._desks.get(message.get("which", "right"))
    if desk is None:
      return
    desk.feed(**{k: message[k] for k in ("move", "rate", "buttons", "jaw", "at") if k in message})
    moves = any([*message.get("move", ()), *message.get("rate", ()), message.get("jaw")])
    if message.get("which") == "scope" and moves and self._now is not None:
      self._now.pace.waits = False  # a view is a movement too

  def _on_follow(self, message: dict[str, Any]) -> None:
    scope = self._now.scope if self._now is not None else None
    if scope is None:
      raise ValueError("the laparoscope is held by a hand: nothing follows")
    scope.follows = message.get("on") is True

  def _on_start(self, message: dict[str, Any]) -> None:
    self._put(menu.exercise(message, self._own))

  def _on_practice(self, message: dict[str, Any]) -> None:
    self._put(menu.practice(message, self._own, bool(self._scene)))

  def _put(self, job: dict[str, Any]) -> None:
    self._stop()
    self._forget()
    self._jobs.put(job)

  def _on_scheme(self, message: dict[str, Any]) -> None:
    scheme = menu.choice("scheme", message.get("value"), menu.SCHEMES)
    if not isinstance(self._now, Practice):
      raise ValueError("the scheme may change in free practice alone")
    self._now.change(scheme)

  def _on_device(self, message: dict[str, Any]) -> None:
    name = menu.choice("device", message.get("value"), menu.devices(self._own))
    if self._now is None:
      self._device = name
    elif name != self._device:
      self._now.link.change(self._open(name))
      self._device = name

  def _on_ghost(self, message: dict[str, Any]) -> None:
    session = self._now
    if not isinstance(session, Session) or self._job["assessment"]:
      raise ValueError("the expert is shown in exercises alone, and not in an assessment")
    session.coach.hint("the expert was shown")
    session.pace.waits = self._asked = True
    self._show_expert()

  def _on_keep(self, message: dict[str, Any]) -> None:
    if self._unkept is not None:
      kept = self._keep(*self._unkept)
      self._tell({"type": "kept", "path": str(kept.path or ""), "fault": kept.fault})

  def _on_pause(self, message: dict[str, Any]) -> None:
    if self._now is not None:
      self._now.pace.paused = message.get("on") is True

  def _on_speed(self, message: dict[str, Any]) -> None:
    speed = menu.choice("speed", message.get("value"), menu.SPEEDS)
    if self._now is not None:
      self._now.pace.speed = speed

  def _on_stop(self, message: dict[str, Any]) -> None:
    self._stop()

  def _stop(self) -> None:
    if self._now is not None:
      self._now.pace.stopped = True

  def _end(self) -> None:
    self._ended = True
    self._stop()
    self._forget()
    self._fresh.set()
    self._jobs.put(None)

  # Pictures.

  def _publish(self, frame: Any) -> None:
    """Hands on a frame, made by `frame` in the loop's thread if the last one was sent."""
    if not self._fresh.is_set():
      self._frame = frame()
      self._fresh.set()

  def _show(self) -> None:
    """Sends pictures and words, in a thread of its own."""
    first(1)
    due, said = 0.0, None
    while not self._ended:
      self._fresh.wait()
      frame, now, self._frame = self._frame, self._now, None
      self._fresh.clear()
      try:
        if frame is not None:
          with self._lock:
            self._conn.send_bytes(b"B" + frame)
        if now is not None and time.monotonic() > due:
          due = time.monotonic() + _STATUS
          words = _status(now)
          if words != said:
            said = words
            self._tell(words)
      except OSError:
        self._end()

  def _foresee(self, job: dict[str, Any]) -> None:
    """Has the expert's way worked out, so that it is known when it is asked for."""
    self._trace, self._asked = None, False
    if not job["assessment"]:
      self._expert = ghost.ask(job["task"], job["seed"], _kwargs(job))
      threading.Thread(target=self._learn, args=(job, self._expert), daemon=True).start()

  def _learn(self, job: dict[str, Any], process: subprocess.Popen) -> None:
    """Takes the expert's way when it is known, in a thread of its own."""
    text, _ = process.communicate()
    if not self._ended and job is self._job and self._expert is process:
      self._trace = {} if process.returncode else json.loads(text)
      self._show_expert()

  def _show_expert(self) -> None:
    """Shows the expert's way, once it was asked for and is known."""
    if not self._asked or self._trace is None:
      return
    self._asked = False
    if self._trace:
      self._tell({"type": "ghost", **self._trace})
    else:
      self._fault("the expert could not be shown")

  def _forget(self) -> None:
    """Ends what works out the expert's way."""
    process, self._expert = self._expert, None
    if process is not None:
      process.kill()

  # Exercises.

  def _exercise(self, job: dict[str, Any]) -> None:
    from palpate.tasks import suite

    self._sitting.keeping.check(job["task"])
    self._tell({"type": "loading", "text": job["task"], "note": ""})
    self._ready.join()
    kwargs = _kwargs(job)
    env = suite.load(*suite.split(job["task"]), task_kwargs={"random": 0, **kwargs})
    with self._hands(job["left"], job["scope"]) as (device, other, holder):
      path, info = self._sitting.reserve(job["task"], job["person"])
      session = Session(
        env, device, job["seed"], {"task_kwargs": kwargs, **info}, Options(scale=job["scale"]),
        coach=Coach(job["assessment"]), publish=self._draw, other=other, camera=holder,
        journal=path,
      )  # fmt: skip
    session.pace.waits = True
    self._foresee(job)
    recording = self._run(session, job, lambda: session.run(realtime=True, watch=self._feel))
    self._forget()
    self._tell(_status(session))  # what it ended with, which may have come within one picture
    recording.info["person"] = job["person"]
    kept = self._keep(recording, None, path)
    shown = card(recording, self._sitting.references(job["task"]))
    shown["said"] += kept.said
    self._tell({"type": "card", "path": str(kept.path or ""), "fault": kept.fault, **shown})
    if self._sitting.keeping.trainee:  # another exercise may be open now
      self._offer()

  def _run(self, made: Session | Practice, job: dict[str, Any], run: Any) -> Any:
    """Runs what was made, so that messages reach it."""
    made.pace.speed, self._camera = job["speed"], None
    made.pace.stopped = not self._jobs.empty()  # something else was asked for meanwhile
    self._now = made
    try:
      return run()
    finally:
      self._now, self._desks = None, {}

  def _draw(self, session: Session) -> None:
    """Shows an exercise."""
    env = session.env
    if self._camera is None or self._camera.model is not env.physics.model.ptr:
      self._camera = Camera.of(env)
      task = env.task
      limits = {"force_limit": task.force_limit, "damage": task.damage, "jaws": task.jaws}
      limits |= {"scope": session.scope is not None, "turns": "head" in task.extra}
      limits["wrist"] = any(hand.trocar().wrist for hand in env.physics.hands)
      self._tell(self._camera.shapes(
        time_limit=env.step_limit * env.control_timestep(), report="report" in task.extra,
        assessment=self._job["assessment"], practice=False, step=env.physics.timestep(), **limits,
      ))  # fmt: skip
    camera, link, pace = self._camera, session.link, session.pace
    self._follow(camera)
    hands = zip(env.physics.hands, session.links, strict=True)
    powered = any(each.grip for hand, each in hands if hand.prefix == HOOK)
    self._publish(lambda: camera.frame(link, pace, env.task.progress, powered))

  def _follow(self, camera: Camera) -> None:
    """Tells of triangles that a cut has changed."""
    for message in camera.cuts():
      self._tell(message)

  def _feel(self, env: Any) -> None:
    """Takes the force of a control step, of which there are more than frames."""
    if self._camera is not None:
      self._camera.feel(env.physics.peak_force)

  def _practise(self, job: dict[str, Any]) -> None:
    note = ", which takes a minute or more" if job["size"].get("grid", 0) > 100 else ""
    scene = pathlib.Path(self._scene) if job["organ"] == menu.OWN else None
    text = scene.name if scene else f"{job['organ']}, {job['mesh']}"
    self._tell({"type": "loading", "text": text, "note": note})
    self._ready.join()
    right, left = job["instrument"], job["left"]
    with self._hands(left, job["scope"]) as (device, other, holder):
      hands = {right: device}
      if other is not None:
        hands["grasper" if right != "grasper" else "probe"] = other
      practice = Practice(
        job["organ"], job["size"], hands, 1e-3 * job["step"], job["scheme"],
        Options(scale=job["scale"]), self._picture, on=job["on"] * (job["on"] != "cpu"),
        scene=scene, holder=holder,
      )  # fmt: skip
    self._run(practice, job, lambda: practice.run(realtime=True))
    self._tell({"type": "idle", "late": practice.pace.lateness.summary()})

  def _picture(self, practice: Practice) -> None:
    """Shows free practice."""
    camera = practice.camera
    if self._camera is not camera:
      self._camera = camera
      self._tell(camera.shapes(
        force_limit=LIMIT, damage=DAMAGE, jaws=self._job["instrument"] != "probe", time_limit=None,
        report=False, assessment=False, practice=True, step=1e-3 * self._job["step"],
        scope=practice.scope is not None, turns=False, wrist=False,
      ))  # fmt: skip
    self._follow(camera)
    self._publish(lambda: camera.frame(practice.link, practice.pace, powered=practice.powered))

  @contextlib.contextmanager
  def _hands(self, left: str, scope: str) -> Iterator[tuple[Device, Device | None, Device]]:
    """Opens the devices of both hands, the left one's if it has a name, and the laparoscope's.

    It closes them on failure.
    """
    with contextlib.ExitStack() as stack:
      right, other = self._open(self._device), None
      stack.callback(right.close)
      if left:
        other = self._open("page" if left in menu.OTHER else left, "left")
        stack.callback(other.close)
      holder = self._open(scope, "scope")
      stack.callback(holder.close)
      yield right, other, holder
      stack.pop_all()

  def _open(self, name: str, which: str = "right") -> Device:
    """Opens a device for a hand."""
    if name != "page":
      self._desks.pop(which, None)
      return registry.device(name)
    own = self._own if registry.on_page(self._own) else "mouse"
    self._desks[which] = desk = Desk(own)
    return desk


def _prepare() -> None:
  """Compiles on a new machine what every exercise needs, while somebody chooses the first one."""
  from palpate.tasks import suite

  devices.init()
  compiled = pathlib.Path(wp.config.kernel_cache_dir or "").glob("wp_palpate.cpu.*")
  if next(compiled, None) is None:
    with contextlib.suppress(Exception):  # the exercise that is chosen says so
      suite.load(*menu.FIRST, task_kwargs={"random": 0}).reset()


def _kwargs(job: dict[str, Any]) -> dict[str, Any]:
  """Returns the options of an exercise's environment."""
  nodes = {"nodes": job["nodes"]} if job["nodes"] else {}
  from palpate.tasks import suite

  return {"input": suite.by_hand(job["task"]), "observations": ["joints"], **nodes}


def _status(now: Session | Practice) -> dict[str, Any]:
  """Returns the words about what runs."""
  lost = [link.message for link in now.links if link.state == "lost"]
  lost += [now.scope.message] if now.scope is not None else []
  lost = next(filter(None, lost), "")
  words = {"type": "status", "instruction": "", "warning": "", "kind": "", "fault": lost}
  if isinstance(now, Practice):
    return words | {"fault": lost or "; ".join(now.faults[-1:]), "scheme": now.organ.integrator}
  coach = now.coach
  said = {"instruction": coach.instruction, "warning": coach.warning, "kind": coach.kind}
  return words | said
