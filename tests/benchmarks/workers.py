"""Cases of a bench in processes of their own, each ended when it takes too long."""

from __future__ import annotations

import multiprocessing
import os
import pathlib
import time
from collections.abc import Callable, Iterator
from multiprocessing import connection

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def work(
  run: Callable, out: pathlib.Path, cases: list[dict], jobs: int, deadline: float, limit: float
) -> Iterator[tuple[dict, str, list[dict]]]:
  """Yields (case, status, rows) as cases end; status is `ok`, `error: ...`, `crash` or `timeout`.

  Args:
    run: returns the rows of a case; a function of a module
    out: output folder, the second argument of `run`
    cases: the cases
    jobs: processes, one case at a time each
    deadline: time.monotonic() after which no case is left running
    limit: seconds after which a case is ended
  """
  context = multiprocessing.get_context("spawn")
  todo = list(reversed(cases))
  workers: list[_Worker] = []
  try:
    while (todo and time.monotonic() < deadline) or any(w.case for w in workers):
      while todo and len(workers) < jobs and time.monotonic() < deadline:
        workers.append(_Worker(context, run, out))
      for worker in workers:
        if todo and not worker.case and time.monotonic() < deadline:
          worker.give(todo.pop())
      busy = {worker.pipe: worker for worker in workers if worker.case}
      if not busy:
        break
      for pipe in connection.wait(list(busy), timeout=1.0):
        worker = busy[pipe]  # type: ignore[index]
        case = worker.case or {}
        try:
          status, rows = worker.pipe.recv()
        except (EOFError, OSError):
          status, rows = "crash", []
          worker.end()
          workers.remove(worker)
        worker.case = {}
        yield case, status, rows
      now = time.monotonic()
      for worker in list(workers):
        if worker.case and (now - worker.since > limit or now > deadline):
          case = worker.case
          worker.end()
          workers.remove(worker)
          if now <= deadline:
            yield case, "timeout", []
  finally:
    for worker in workers:
      worker.end()


class _Worker:
  """A process and the case it is at."""

  def __init__(self, context, run: Callable, out: pathlib.Path):
    self.pipe, there = context.Pipe()
    self.process = context.Process(target=_serve, args=(there, run, str(out)), daemon=True)
    threads = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # read when numpy is loaded
    try:
      self.process.start()
    finally:
      for name, value in threads.items():
        if value is None:
          del os.environ[name]
        else:
          os.environ[name] = value
    there.close()
    self.case: dict = {}
    self.since = 0.0

  def give(self, case: dict):
    self.case, self.since = case, time.monotonic()
    self.pipe.send(case)

  def end(self):
    self.process.kill()
    self.process.join()
    self.pipe.close()


def _serve(pipe, run: Callable, out: str):
  """Runs cases until the pipe closes; a worker's body."""
  import signal
  import tempfile
  import traceback

  signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
  os.chdir(tempfile.gettempdir())  # MuJoCo writes its log where it stands
  register_quietly()
  while True:
    try:
      case = pipe.recv()
    except EOFError:
      return
    try:
      answer = "ok", run(case, pathlib.Path(out))
    except Exception as error:
      traceback.print_exc()
      text = " ".join(f"{type(error).__name__}: {error}".split())
      answer = f"error: {text[:200]}", []
    try:
      pipe.send(answer)
    except OSError:  # nobody waits any more
      return


def register_quietly():
  """Registers the plugin and keeps MuJoCo's warnings off the screen."""
  from palpate import register

  register()
  import mujoco

  mujoco.set_mju_user_warning(lambda _: None)
