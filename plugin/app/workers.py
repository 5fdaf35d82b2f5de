"""Jobs in parallel processes, and what a job that runs an episode needs."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from .console import Interrupt

Job = TypeVar("Job")
Out = TypeVar("Out")
_POLL = 0.2  # of Ctrl-C, while processes work [s]


def parallel(
  function: Callable[[Job], Out], jobs: Sequence[Job], processes: int, interrupt: Interrupt
) -> Iterator[Out | None]:
  """Yields what a function makes of each job, in order; None where a process died.

  Args:
    function: of a module, so that a process can find it; the processes are spawned, not forked
    jobs: its arguments
    processes: at a time; 1 is this one
    interrupt: once seen, the jobs that run are finished and no more are begun
  """
  if processes == 1:
    for job in jobs:
      if interrupt.seen:
        return
      yield function(job)
    return
  pool = concurrent.futures.ProcessPoolExecutor(
    min(processes, len(jobs)), multiprocessing.get_context("spawn"), initializer=_ignore_interrupts
  )
  with pool:
    for future in [pool.submit(function, job) for job in jobs]:
      while not concurrent.futures.wait([future], _POLL).done:
        if interrupt.seen:
          pool.shutdown(wait=False, cancel_futures=True)
      if future.cancelled():
        return
      try:
        yield future.result()
      except concurrent.futures.process.BrokenProcessPool:
        yield None


def _ignore_interrupts():
  """Leaves Ctrl-C to the parent."""
  signal.signal(signal.SIGINT, signal.SIG_IGN)
