"""Runs one benchmark: `python tests/benchmarks/run.py NAME --help`."""

from __future__ import annotations

import importlib
import pathlib
import sys
from collections.abc import Sequence

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))  # `benchmarks`, `reference`, `scenes`

from benchmarks.results import BenchError

FOLDER = pathlib.Path(__file__).parent
BENCHES = {
  "attacks": "what random attacks break",
  "batch": "world-steps a second of batches, and what a world takes",
  "cloning": "behaviour cloning: success over the number of demonstrations",
  "cut": "steps in which an organ is cut, beside steps in contact",
  "error": "run time against error, beside MuJoCo's own flex",
  "experts": "how many of its episodes each expert solves; the references",
  "flex": "batches beside mujoco_warp's own flex on the same device",
  "flicker": "steps without force while a probe presses the organs that ship",
  "inertia": "what the effective inertia does to the contact force",
  "learning": "SAC on touch/easy",
  "live": "how punctual a live loop is while a page shows it, and how late its pictures are",
  "locality": "what leaving out solved nodes would save",
  "loop": "the whole loop, mj_step with a probe on a windowed organ",
  "loopholes": "what a search finds in the exercises that does not do the work",
  "paths": "how near cuts of surfaces follow their path, and what they keep",
  "peer": "run time against error, beside MuJoCo's native flex, tolerance by tolerance",
  "policies": "success of the policies that ship",
  "preconditioner": "iterations with block Jacobi and multilevel",
  "press_error": "what is left of the press's force error",
  "rest": "a sleeping organ against none",
  "second_order": "schemes of second order, in float64",
  "skill": "metrics: expert against novices",
  "skipping": "what switching each feature off saves",
  "solver": "the implicit step alone, device by device",
  "speed": "control steps a second of the exercises",
  "stability": "where each scheme breaks, over a thousand runs",
  "thesis": "the tables and figures of the thesis, measured today",
  "truth": "organ forces against closed forms, other finite elements and published measurements",
  "uncut": "steps of organs that are never cut, beside an older state of the code",
}


def main(argv: Sequence[str] | None = None) -> int:
  """Runs the command line and returns its exit code."""
  words = list(sys.argv[1:] if argv is None else argv)
  if not words or words[0] not in BENCHES:
    known = "\n".join(f"  {name:16}{text}" for name, text in BENCHES.items())
    print(f"usage: run.py BENCH [options]; run.py BENCH --help says which\n\n{known}")
    return 0 if words in (["-h"], ["--help"]) else 2
  importlib.import_module("palpate")  # before MuJoCo: it chooses how to draw without a screen
  from benchmarks import runner
  from palpate.app.console import CommandError

  try:
    (path,) = FOLDER.glob(f"*/{words[0]}.py")
    module = importlib.import_module(f"benchmarks.{path.parent.name}.{words[0]}")
    return runner.main(module.BENCH, words[1:])
  except (BenchError, CommandError) as error:
    print(f"run.py: {error}", file=sys.stderr)
    return error.code
  except KeyboardInterrupt:
    print("run.py: interrupted", file=sys.stderr)
    return 130


if __name__ == "__main__":
  sys.exit(main())
