"""All benchmarks; `palpate bench NAME --help` runs one."""

from __future__ import annotations

import importlib
import pathlib
from collections.abc import Sequence

from benchmarks import runner
from palpate.app.console import CommandError

FOLDER = pathlib.Path(__file__).parent
BENCHES = {
  "batch": "world-steps a second of batches, and what a world takes",
  "cut": "steps in which an organ is cut, beside steps in contact",
  "error": "run time against error, beside MuJoCo's own flex",
  "experts": "how many of its episodes each expert solves; the references",
  "flex": "batches beside mujoco_warp's own flex on the same device",
  "flicker": "steps without force while a probe presses the organs that ship",
  "knots": "threads in knots: does anything go through, what holds, what edges cost",
  "learning": "what an agent learns of the exercises from random weights",
  "live": "how punctual a live loop is while a page shows it, and how late its pictures are",
  "loop": "the whole loop, mj_step with a probe on a windowed organ",
  "loopholes": "what a search finds in the exercises that does not do the work",
  "native": "settings of MuJoCo's native flex beside each other",
  "paths": "how near cuts of surfaces follow their path, and what they keep",
  "peer": "run time against error, beside MuJoCo's native flex, tolerance by tolerance",
  "pictures": "pictures a second in many worlds, beside mujoco_warp's renderer",
  "policies": "success of the policies that ship",
  "skill": "metrics: expert against novices",
  "skipping": "what switching each feature off saves",
  "solver": "the implicit step alone, device by device",
  "speed": "control steps a second of the exercises",
  "stability": "where each scheme breaks, over a thousand runs",
  "thesis": "the tables and figures of the thesis, measured today",
  "truth": "organ forces against closed forms, other finite elements and published measurements",
}


def main(name: str, words: Sequence[str]) -> int:
  """Runs the bench of that name with its options and returns the exit code."""
  (path,) = FOLDER.glob(f"*/{name}.py")
  try:
    module = importlib.import_module(f"benchmarks.{path.parent.name}.{name}")
  except ModuleNotFoundError as error:
    text = f"{name}: {error.name} is not installed: pip install '.[bench]'"
    raise CommandError(text, code=1) from None
  return runner.main(module.BENCH, list(words))
