"""The `palpate` command.

A subcommand is one module with two functions, `add_arguments(parser)` and `main(args) -> int`, and
one line in `COMMANDS`. The module is imported when it is used, so that help comes at once; it calls
`palpate.register()` before it loads a model.

Exit codes: 0 done; 1 it did not work; 2 a wrong option or scene; 130 interrupted; 141 whoever read
the output has closed it.
"""

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from palpate import __version__, screen

from .console import CommandError

# Words of the command -> module of this package, and what the help says.
COMMANDS = {
  ("run", "press"): (
    "press.command",
    "press an organ with a probe, hold, release; measure step and force",
  ),
  ("doctor",): ("doctor", "check the installation: packages, devices, drawing, a short simulation"),
  ("warmup",): ("warmup", "compile all kernels in advance, for the CPU and every CUDA device"),
  ("view",): ("draw.view", "open a scene in MuJoCo's viewer, with instruments to drag"),
  ("render",): ("draw.render", "make a picture or a film of a scene without a display"),
  ("wrap",): ("wrap", "make a model folder of an organ from a mesh or a segmented volume"),
  ("fit",): ("fit.command", "find tissue constants from a measured indentation or grasp"),
  ("exercise",): ("exercise", "run an exercise, record it and write its report"),
  ("serve",): ("serve", "serve a training page for mouse, keyboard, touch, gamepad or device"),
  ("report",): ("report", "write the report of a recording"),
  ("train",): ("learn.train", "train a policy for an exercise"),
  ("evaluate",): ("learn.evaluate", "score a policy over many episodes of an exercise"),
  ("export",): ("learn.export", "make a data set of demonstrations"),
  ("trainee", "add"): ("trainee.add", "add people to a record"),
  ("trainee", "list"): ("trainee.list", "list the people of a record"),
  ("trainee", "show"): ("trainee.show", "show a person's learning curves and standing"),
  ("trainee", "export"): ("trainee.export", "write all of a person's data"),
  ("trainee", "delete"): ("trainee.delete", "delete all of a person's data"),
  ("trainee", "limits"): ("trainee.limits", "make proficiency limits from experts' recordings"),
  ("library",): ("library", "build a plugin library for programs in C and C++"),
  ("bench",): ("bench", "run a measurement of a checkout: accuracy, speed, exercises"),
  ("panel",): ("panel", "make the references of scores from many skilled performers"),
}
_GROUPS = {
  "run": "run a job on a scene",
  "trainee": "manage the record of trainees: learning curves and data",
}


def main(argv: Sequence[str] | None = None) -> int:
  """Runs the command line and returns its exit code."""
  words = list(sys.argv[1:] if argv is None else argv)
  try:
    try:
      args, rest = _parser(words).parse_known_args(words)
      if rest:  # said by the command, whose usage helps
        args.parser.error(f"unrecognized arguments: {' '.join(rest)}")
      return args.main(args)
    finally:
      sys.stdout.flush()
  except CommandError as error:
    print(f"palpate: {error}", file=sys.stderr)
    return error.code
  except KeyboardInterrupt:
    print("palpate: interrupted", file=sys.stderr)
    return 130
  except BrokenPipeError:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is still in it
    return 141


def _parser(words: list[str]) -> argparse.ArgumentParser:
  parser = argparse.ArgumentParser("palpate", description="Soft-tissue simulation for MuJoCo.")
  parser.add_argument("--version", action="version", version=f"palpate {__version__}")
  parser.set_defaults(parser=parser)
  commands = parser.add_subparsers(metavar="COMMAND", required=True)
  groups = {}
  for name, (module, text) in COMMANDS.items():
    place = commands
    if len(name) > 1:
      if name[0] not in groups:
        group = commands.add_parser(name[0], help=_GROUPS[name[0]], description=_GROUPS[name[0]])
        groups[name[0]] = group.add_subparsers(metavar="JOB", required=True)
      place = groups[name[0]]
    command = place.add_parser(name[-1], help=text, description=text[0].upper() + text[1:] + ".")
    if tuple(words[: len(name)]) == name:
      screen.prepare_gl()  # before MuJoCo is imported
      chosen = importlib.import_module(f".{module}", __package__)
      chosen.add_arguments(command)
      command.set_defaults(main=chosen.main, parser=command)
  return parser


if __name__ == "__main__":
  sys.exit(main())
