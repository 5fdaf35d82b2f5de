"""Cases of a bench, given to the workers of the commands."""

from __future__ import annotations

import functools
import os
import pathlib
import tempfile
import traceback
from collections.abc import Callable, Iterator

from palpate.app.workers import Workers


def work(
  run: Callable, out: pathlib.Path, cases: list[dict], crew: Workers, deadline: float, limit: float
) -> Iterator[tuple[dict, str, list[dict]]]:
  """Yields (case, status, rows) as cases end; status is `ok`, `error: ...`, `crash` or `timeout`.

  Args:
    run: returns the rows of a case; a function of a module
    out: output folder, the second argument of `run`
    cases: the cases
    crew: who runs them, one case at a time each
    deadline: time.monotonic() after which no case is left running
    limit: seconds after which a case is ended
  """
  jobs = [(run, str(out), case) for case in cases]
  for ended in crew.run(attempt, jobs, limit=limit, deadline=deadline):
    status, rows = ended.value if ended.status == "ok" else (ended.status, [])
    yield cases[ended.index], {"died": "crash"}.get(status, status), rows


def attempt(job: tuple[Callable, str, dict]) -> tuple[str, list[dict]]:
  """Returns status and rows of a case: the function, the output folder, the case."""
  run, out, case = job
  register_quietly()
  # MuJoCo writes its log where it stands.
  os.chdir(tempfile.gettempdir())
  try:
    return "ok", run(case, pathlib.Path(out))
  except Exception as error:
    traceback.print_exc()
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return f"error: {text[:200]}", []


@functools.cache
def register_quietly():
  """Registers the plugin and keeps MuJoCo's warnings off the screen."""
  from palpate import register

  register()
  import mujoco

  mujoco.set_mju_user_warning(lambda _: None)
