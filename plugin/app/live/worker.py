"""The process of one page: its exercises run here, and nothing of another's.

Messages to here are JSON; from here JSON (`T` before it) or frames of a picture (`B`).
"""

from __future__ import annotations

import json
import pathlib
import queue
import tempfile
import threading
import time
from multiprocessing.connection import Connection
from typing import Any

import palpate

from ..trainee.keeping import Keeping, references
from . import devices, picture
from .coach import Coach, card
from .coupling import Options
from .desk import Desk
from .device import Device, DeviceError
from .session import Session

NODES = (250, 500, 1000, 2000, 4000)
SPEEDS = (0.1, 0.25, 0.5, 1.0)
_STATUS = 0.1  # between words about the exercise [s]


def main(conn: Connection, folder: str, device: str, kept: Keeping | None = None) -> None:
  """Serves one page until it says `end`.

  Args:
    conn: to the server
    folder: where recordings are kept
    device: name of the device; one of the page's own is moved by its messages
    kept: the record that recordings go to, None for the folder
  """
  palpate.register()
  try:
    Worker(conn, pathlib.Path(folder), device, kept).serve()
  except KeyboardInterrupt:
    pass


class Worker:
  """Runs the exercises that a page asks for, one after another."""

  def __init__(
    self, conn: Connection, folder: pathlib.Path, device: str, kept: Keeping | None = None
  ):
    """Takes the arguments of `main`."""
    self._kept = kept
    self._use: Any = kept.session() if kept else None
    self._conn, self._folder, self._device = conn, folder, device
    self._jobs: queue.SimpleQueue[dict | None] = queue.SimpleQueue()
    self._session: Session | None = None
    self._desk: Desk | None = None
    self._lock = threading.Lock()  # of the connection
    self._frame: bytes | None = None
    self._fresh = threading.Event()
    self._camera: picture.Camera | None = None
    self._ended = False

  def serve(self) -> None:
    """Works until the end."""
    for target in (self._receive, self._show):
      threading.Thread(target=target, daemon=True).start()
    self._tell(menu(self._device))
    while (job := self._jobs.get()) is not None:
      try:
        self._exercise(job)
      except (ValueError, TypeError, OSError, DeviceError) as error:
        self._fault(error)

  # Words.

  def _tell(self, message: dict[str, Any]) -> None:
    with self._lock:
      if not self._ended:
        self._conn.send_bytes(b"T" + json.dumps(message).encode())

  def _fault(self, error: Exception) -> None:
    self._tell({"type": "error", "text": " ".join(str(error).split())})

  def _receive(self) -> None:
    """Takes messages, in a thread of its own."""
    while not self._ended:
      try:
        message = json.loads(self._conn.recv_bytes())
        self._obey(message)
      except (EOFError, OSError):
        self._end()
      except (ValueError, TypeError, KeyError) as error:
        self._fault(error)

  def _obey(self, message: Any) -> None:
    kind = message.get("type") if isinstance(message, dict) else None
    session = self._session
    if kind == "hand":
      if self._desk is not None:
        given = {k: message[k] for k in ("move", "rate", "buttons", "jaw") if k in message}
        self._desk.feed(**given)
    elif kind == "start":
      job = check(message)
      if session is not None:
        session.pace.stopped = True
      self._jobs.put(job)
    elif kind == "pause" and session is not None:
      session.pace.paused = message.get("on") is True
    elif kind == "speed" and session is not None:
      session.pace.speed = _choice("speed", message.get("value"), SPEEDS)
    elif kind == "stop" and session is not None:
      session.pace.stopped = True
    elif kind == "end":
      self._end()
    elif kind not in ("pause", "speed", "stop"):
      text = str(message)[:60]
      raise ValueError(f"message is {text!r}, expected hand, start, pause, speed, stop")

  def _end(self) -> None:
    self._ended = True
    if self._session is not None:
      self._session.pace.stopped = True
    self._fresh.set()
    self._jobs.put(None)

  # Pictures.

  def _publish(self, session: Session) -> None:
    """Copies what the page draws, in the loop's thread."""
    if self._camera is None or self._camera.model is not session.env.physics.model.ptr:
      self._camera = picture.Camera(session.env)
      self._tell(picture.shapes(session.env))
    if not self._fresh.is_set():  # what was not sent yet is not made anew
      self._frame = self._camera.frame(session)
      self._fresh.set()

  def _show(self) -> None:
    """Sends pictures and words, in a thread of its own."""
    due, said = 0.0, None
    while not self._ended:
      self._fresh.wait()
      frame, session, self._frame = self._frame, self._session, None
      self._fresh.clear()
      try:
        if frame is not None:
          with self._lock:
            self._conn.send_bytes(b"B" + frame)
        if session is not None and time.monotonic() > due:
          due = time.monotonic() + _STATUS
          coach, link = session.coach, session.link
          words = {
            "type": "status",
            "instruction": coach.instruction,
            "warning": coach.warning,
            "fault": link.message if link.state == "lost" else "",
          }
          if words != said:
            said = words
            self._tell(words)
      except OSError:
        self._end()

  # Exercises.

  def _exercise(self, job: dict[str, Any]) -> None:
    from palpate.tasks import suite

    if self._kept:
      self._kept.check(job["task"])
    kwargs = {"input": "handle", "observations": ["joints"]}
    kwargs |= {"nodes": job["nodes"]} if job["nodes"] else {}
    self._tell({"type": "loading", "task": job["task"]})
    env = suite.load(*suite.split(job["task"]), task_kwargs={"random": 0, **kwargs})
    device = self._open()
    info = {"task_kwargs": kwargs, "person": job["person"], "seed": job["seed"]}
    self._camera = None
    session = Session(
      env, device, job["seed"], info, Options(scale=job["scale"]),
      coach=Coach(job["assessment"]), publish=self._publish,
    )  # fmt: skip
    session.pace.speed = job["speed"]
    self._session = session
    try:
      recording = session.run()
    finally:
      self._session = self._desk = None
    known = references(self._kept.references if self._kept else None)
    shown = card(recording, known(job["task"]))
    if self._kept and (self._kept.trainee or job["person"]):
      made = self._kept.keep(recording, self._use, job["person"])
      path, fault = made.path, made.fault
      shown["advice"] += made.said
    else:
      path, fault = self._keep(recording, job["task"])
    self._tell({"type": "card", "path": str(path), "fault": fault, **shown})

  def _open(self) -> Device:
    device = devices.device(self._device)
    if isinstance(device, Desk) and devices.on_page(self._device):
      self._desk = device
    return device

  def _keep(self, recording: Any, task: str) -> tuple[pathlib.Path, str]:
    """Saves a recording; where that fails, among the temporary files, and says so."""
    name = f"{time.strftime('%Y%m%d-%H%M%S')}_{task.replace('/', '_')}"
    try:
      self._folder.mkdir(parents=True, exist_ok=True)
      return recording.save(_free(self._folder, name)), ""
    except OSError as error:
      folder = pathlib.Path(tempfile.mkdtemp(prefix="palpate-"))
      return recording.save(_free(folder, name)), f"not kept in {self._folder}: {error}"


def _free(folder: pathlib.Path, name: str) -> pathlib.Path:
  """Returns a path that is not taken."""
  path, k = folder / f"{name}.npz", 1
  while path.exists():
    path, k = folder / f"{name}-{k}.npz", k + 1
  return path


def menu(device: str) -> dict[str, Any]:
  """Returns what a page offers."""
  from palpate.tasks import suite

  tasks = {f"{d}/{t}": suite.summary(d, t) for d, t in suite.ALL_TASKS}
  return {"type": "menu", "tasks": tasks, "nodes": NODES, "speeds": SPEEDS, "device": device}


def check(message: dict[str, Any]) -> dict[str, Any]:
  """Returns the exercise that a message asks for; ValueError names what is wrong with it."""
  from palpate.tasks import suite

  task = message.get("task")
  if not isinstance(task, str):
    raise ValueError(f"task is {task!r}, expected a name")
  person = message.get("person", "")
  if not isinstance(person, str) or len(person) > 40 or not person.isprintable():
    raise ValueError(f"person is {str(person)[:50]!r}, expected a name of at most 40 letters")
  seed = message.get("seed", 0)
  if type(seed) is not int or not 0 <= seed < 2**31:
    raise ValueError(f"seed is {seed!r}, expected a whole number in [0, 2^31)")
  scale = message.get("scale", 1.0)
  if type(scale) not in (int, float) or not 0.1 <= scale <= 5:
    raise ValueError(f"scale is {scale!r}, expected a number in [0.1, 5]")
  return {
    "task": "/".join(suite.split(task)),
    "person": person.strip(),
    "seed": seed,
    "scale": float(scale),
    "nodes": _choice("nodes", message.get("nodes"), (None, *NODES)),
    "speed": _choice("speed", message.get("speed", 1.0), SPEEDS),
    "assessment": message.get("assessment") is True,
  }


def _choice(name: str, value: Any, choices: tuple) -> Any:
  if isinstance(value, bool) or value not in choices:
    raise ValueError(f"{name} is {str(value)[:40]!r}, expected one of {choices}")
  return value
