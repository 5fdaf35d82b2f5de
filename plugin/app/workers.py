"""Jobs in parallel: in processes of this machine, or on a Ray cluster.

A worker has one job at a time, so one that dies takes one job with it. Jobs are done in any order.
"""

import argparse
import contextlib
import dataclasses
import math
import multiprocessing
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import connection
from typing import Any, Protocol

from .console import CommandError, check_counts, need

_POLL = 0.2  # of Ctrl-C, while workers work [s]
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_RETRIES = 3  # of a job whose worker died, on a cluster


@dataclasses.dataclass(frozen=True)
class Ended:
  """A job that has ended.

  Attributes:
    index: of the job
    status: `ok`, `error`, `died` or `timeout`
    value: what the function returned; the exception of an error
  """

  index: int
  status: str
  value: Any = None


def _never() -> bool:
  return False


class Workers(Protocol):
  """What does jobs."""

  def run(
    self,
    function: Callable[[Any], Any],
    jobs: Sequence[Any],
    stop: Callable[[], bool] = _never,
    limit: float = math.inf,
    deadline: float = math.inf,
  ) -> Iterator[Ended]:
    """Yields jobs as they end.

    Args:
      function: of a module, so that a worker can find it
      jobs: its arguments
      stop: once it says so, the jobs that run are finished and no more are begun
      limit: after which a job is given up [s]
      deadline: time.monotonic() after which no job is left running
    """
    ...


@dataclasses.dataclass(frozen=True)
class Processes:
  """Processes of this machine, spawned, not forked, with one thread of linear algebra each.

  Attributes:
    count: at a time
  """

  count: int

  def run(self, function, jobs, stop=_never, limit=math.inf, deadline=math.inf):
    """See `Workers`."""
    context = multiprocessing.get_context("spawn")
    todo = iter(range(len(jobs)))
    left, crew = len(jobs), []

    def may_begin() -> bool:
      return left > 0 and time.monotonic() < deadline and not stop()

    try:
      while True:
        while may_begin() and len(crew) < min(self.count, left + sum(w.busy for w in crew)):
          crew.append(_Process(context, function))
        for worker in crew:
          if not worker.busy and may_begin():
            worker.give(index := next(todo), jobs[index])
            left -= 1
        if not any(worker.busy for worker in crew):
          return
        for worker, ended in _ended(crew, limit):
          if not worker.alive:
            crew.remove(worker)
          yield ended
        if time.monotonic() > deadline:
          return
    finally:
      for worker in crew:
        worker.end()


HERE = Processes(1)


class _Process:
  """A process, and the job it is at."""

  def __init__(self, context: Any, function: Callable[[Any], Any]):
    self.pipe, there = context.Pipe()
    self.process = context.Process(target=_serve, args=(there, function), daemon=True)
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # read when numpy is loaded
    try:
      self.process.start()
    finally:
      for name, value in before.items():
        if value is None:
          del os.environ[name]
        else:
          os.environ[name] = value
    there.close()
    self.index, self.busy, self.alive = 0, False, True
    self.began, self.since = False, math.inf  # until it has started

  def give(self, index: int, job: Any):
    self.index, self.busy = index, True
    self.since = time.monotonic() if self.began else math.inf
    with contextlib.suppress(OSError):  # it has died, which its pipe will say
      self.pipe.send(job)

  def take(self) -> Ended | None:
    """Returns what a job has ended in; None where the process says that it has started."""
    try:
      answer = self.pipe.recv()
      if answer is None:
        self.began, self.since = True, time.monotonic()
        return None
      self.busy = False
      return Ended(self.index, *answer)
    except (EOFError, OSError):
      self.end()
      return Ended(self.index, "died")

  def end(self):
    self.busy = self.alive = False
    self.process.kill()
    self.process.join()
    self.pipe.close()


def _ended(crew: list[_Process], limit: float) -> list[tuple[_Process, Ended]]:
  """Waits a moment and returns the workers whose jobs have ended."""
  busy = {worker.pipe: worker for worker in crew if worker.busy}
  ready: Any = connection.wait(list(busy), timeout=_POLL)
  ended = [(busy[pipe], found) for pipe in ready if (found := busy[pipe].take())]
  for worker in crew:
    if worker.busy and time.monotonic() - worker.since > limit:
      worker.end()
      ended.append((worker, Ended(worker.index, "timeout")))
  return ended


def _serve(pipe: Any, function: Callable[[Any], Any]):
  """Does jobs until the pipe closes; a worker's body."""
  signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is left to the parent
  with contextlib.suppress(EOFError, OSError):  # nobody waits any more
    pipe.send(None)
    while True:
      answer = _attempt(function, pipe.recv())
      try:
        pipe.send(answer)
      except (pickle.PicklingError, TypeError, AttributeError) as error:
        pipe.send(("error", RuntimeError(f"{type(error).__name__}: {error}")))


def _attempt(function: Callable[[Any], Any], job: Any) -> tuple[str, Any]:
  try:
    return "ok", function(job)
  except Exception as error:
    return "error", error


@dataclasses.dataclass(frozen=True)
class Cluster:
  """A Ray cluster, where a job whose worker died is done again, 3 times at most.

  Attributes:
    address: of the cluster; that of RAY_ADDRESS if it is empty, and without one a cluster of this
      machine that lasts as long as the jobs
    count: jobs at a time; as many as the cluster has CPUs by default
  """

  address: str = ""
  count: int | None = None

  def __post_init__(self):
    need("ray", "ray")

  def run(self, function, jobs, stop=_never, limit=math.inf, deadline=math.inf):
    """See `Workers`."""
    import ray

    todo, running = iter(range(len(jobs))), {}
    left = len(jobs)
    with self._joined(ray):
      attempt = ray.remote(max_retries=_RETRIES)(unpacked)
      installed = (sys.prefix, sys.base_prefix)
      path = [p for p in map(os.path.abspath, sys.path) if not p.startswith(installed)]
      count = self.count or max(1, int(ray.cluster_resources().get("CPU", 1)))
      while True:
        while left and len(running) < count and time.monotonic() < deadline and not stop():
          index, left = next(todo), left - 1
          packed = pickle.dumps((function, jobs[index]))
          running[attempt.remote(path, packed)] = index, time.monotonic()
        if not running:
          return
        ready, waiting = ray.wait(list(running), timeout=_POLL)
        for ref in ready:
          index, _ = running.pop(ref)
          yield _result(ray, ref, index)
        now = time.monotonic()
        for ref in waiting:
          if now > deadline or now - running[ref][1] > limit:
            ray.cancel(ref, force=True)
            index = running.pop(ref)[0]
            if now <= deadline:
              yield Ended(index, "timeout")

  @contextlib.contextmanager
  def _joined(self, ray: Any) -> Iterator[None]:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    address = self.address or os.environ.get("RAY_ADDRESS") or "local"
    options = {"num_cpus": self.count, "include_dashboard": False} if address == "local" else {}
    try:
      ray.init(address, log_to_driver=False, logging_level="ERROR", **options)
    except (ConnectionError, ValueError, OSError, RuntimeError) as error:
      raise CommandError(f"ray: no cluster at {address!r}: {error}", code=1) from None
    try:
      yield
    finally:
      ray.shutdown()


def unpacked(path: list[str], packed: bytes) -> tuple[str, Any]:
  """Does a job where modules are found as they were where it was packed."""
  sys.path.extend(folder for folder in path if folder not in sys.path)
  import palpate

  if not hasattr(palpate, "register"):  # Ray's workers look in the current folder first
    where = next(iter(palpate.__path__))
    text = f"ray: workers take the folder {where!r} for the package palpate"
    return "error", CommandError(f"{text}; run the command in another folder", code=1)
  return _attempt(*pickle.loads(packed))


def _result(ray: Any, ref: Any, index: int) -> Ended:
  try:
    return Ended(index, *ray.get(ref))
  except ray.exceptions.RayTaskError as error:  # the cluster's package lacks the function
    return Ended(index, "error", CommandError(f"ray: {error.cause or error}", code=1))
  except ray.exceptions.RayError:
    return Ended(index, "died")


def parallel(
  function: Callable[[Any], Any],
  jobs: Sequence[Any],
  workers: Workers,
  stop: Callable[[], bool] = _never,
) -> Iterator[Any]:
  """Yields what a function makes of each job, in order; None where its worker died.

  Args:
    function: of a module, so that a worker can find it
    jobs: its arguments
    workers: who does them; `HERE` is this process
    stop: see `Workers.run`
  """
  if workers == HERE:
    for job in jobs:
      if stop():
        return
      yield function(job)
    return
  done, index = {}, 0
  for ended in workers.run(function, jobs, stop):
    if ended.status == "error":
      raise ended.value
    done[ended.index] = ended.value
    while index in done:
      yield done.pop(index)
      index += 1


def add_arguments(parser: argparse.ArgumentParser, count: int):
  """Declares the options; `count` is that of processes by default."""
  add = parser.add_argument
  add("--processes", metavar="N", type=int, help=f"at a time ({count}; on a cluster its CPUs)")
  add(
    "--ray", metavar="ADDRESS", nargs="?", const="",
    help="use a Ray cluster; without ADDRESS a cluster of this machine",
  )  # fmt: skip
  parser.set_defaults(default_processes=count)


def chosen(args: argparse.Namespace) -> Workers:
  """Returns the workers that the options ask for."""
  if args.processes is not None:
    check_counts(args, "processes")
  if args.ray is not None:
    return Cluster(args.ray, args.processes)
  return Processes(args.processes or args.default_processes)
