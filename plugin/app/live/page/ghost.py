"""How an expert does an exercise, for a page to show: `python -m palpate.app.live.page.ghost`.

In a process of its own, for it takes seconds; the result is JSON: times [s], and place and
orientation of the tip at each of them.
"""

import contextlib
import json
import os
import subprocess
import sys
from typing import Any

import palpate

_EVERY = 2  # control steps between what is shown


def trace(task: str, seed: int, kwargs: dict[str, Any]) -> dict[str, Any]:
  """Returns how the expert does an episode, JSON: `time` (n,), `pose` (n, 7), `outcome`."""
  from palpate.tasks import suite
  from palpate.tasks.core import episode, performer

  env = suite.load(*suite.split(task), task_kwargs={"random": 0, **kwargs})
  made = episode.run(env, performer.make(env, seed=seed), seed, {"task_kwargs": kwargs})
  tips, quats = made.column("tip_pos", 0), made.column("quat", 0)  # of the main hand
  assert tips is not None and quats is not None
  pose = [
    [round(float(x), 5) for x in (*tip, *quat)]
    for tip, quat in zip(tips[::_EVERY], quats[::_EVERY], strict=True)
  ]
  time = [round(float(t), 3) for t in made.time[::_EVERY]]
  return {"time": time, "pose": pose, "outcome": made.outcome}


def ask(task: str, seed: int, kwargs: dict[str, Any]) -> subprocess.Popen[bytes]:
  """Starts a process that writes the trace to its output."""
  words = [sys.executable, "-m", __name__, json.dumps([task, seed, kwargs])]
  return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)


def main() -> None:
  """Writes the trace that the argument asks for."""
  with contextlib.suppress(AttributeError, OSError):
    os.nice(5)  # the hand goes first
  palpate.register()
  print(json.dumps(trace(*json.loads(sys.argv[1]))))


if __name__ == "__main__":
  main()
