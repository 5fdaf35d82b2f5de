"""Recorded graphs of launches, and the lock under which all that is not a step is done.

Warp keeps what is being recorded on the CPU in one place for all threads: a kernel that another
thread launches meanwhile would become part of the recording, or end the process. Here each thread
has a place of its own, as in Warp's native half.
"""

import functools
import itertools
import os
import threading
from collections.abc import Callable
from typing import Any

import warp as wp
from palpate.tissue.device import warp_context

# Held where models are compiled, data made, kernels loaded, graphs recorded; never in a step.
lock = threading.RLock()


def _hold_lock_while_forking():
  """Lets a child begin with a lock that nobody holds and nothing half done."""
  if hasattr(os, "register_at_fork"):
    os.register_at_fork(
      before=lock.acquire, after_in_parent=lock.release, after_in_child=lock.release
    )


_hold_lock_while_forking()
_here = threading.local()
_KEPT = ("_apic_capture", "_apic_graph")  # Warp's attributes of what is being recorded


def _of_this_thread(name: str) -> property:
  return property(
    lambda _: getattr(_here, name, None), lambda _, value: setattr(_here, name, value)
  )


def _record_by_thread():
  """Gives each thread its own recording; once a process, and not while one is under way."""
  runtime = warp_context.runtime
  if any(getattr(runtime, name) is not None for name in _KEPT):
    return
  for name in _KEPT:
    if not isinstance(getattr(type(runtime), name, None), property):
      setattr(type(runtime), name, _of_this_thread(name))


def record(device: wp.Device, work: Callable[[], None]) -> Any:
  """Returns the graph of what `work` launches on a device; none of it is run."""
  with lock:
    _record_by_thread()
    with wp.ScopedDevice(device), wp.ScopedCapture(device=device) as capture:
      work()
    return capture.graph


def record_all(*parts) -> list:
  """Records (device, work) pairs, those in a row on one device as one graph."""
  graphs = []
  for device, group in itertools.groupby(parts, key=lambda part: part[0]):
    work = [part[1] for part in group]
    graphs.append((device, record(device, functools.partial(_each, work))))
  return graphs


def _each(work: list[Callable[[], None]]):
  for one in work:
    one()


def launch_all(graphs: list):
  """Launches recorded graphs in order and waits for those on a GPU."""
  for device, graph in graphs:
    wp.capture_launch(graph)
    if device.is_cuda:
      wp.synchronize_device(device)
