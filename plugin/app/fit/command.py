"""`palpate fit`: constants of tissue from a measured indentation or grasp."""

import argparse
import json
import math
import pathlib
import sys

import numpy as np
from palpate import register

from .. import console
from ..console import CommandError

_LEVEL = 0.95
_SI = "all numbers of the command line are in SI units"


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.epilog = (
    "The table is a CSV whose header names time, depth and force with their units, such as "
    "'time [s], depth [mm], force [N]'; depth counts from the first touch, force is the tissue's "
    f"push on the tool. {_SI[0].upper() + _SI[1:]}. Files go to the output folder as fit.json, "
    "fit.xml and fit.png."
  )
  add = parser.add_argument
  add("data", metavar="DATA.csv", help="time, depth and force")
  add("--test", choices=("indentation", "grasp"), default="indentation",
      help="by one tool, or by two tools that close on each other (%(default)s)")  # fmt: skip
  add("--tip", choices=("sphere", "flat"), default="sphere", help="of the tool (%(default)s)")
  add("--radius", metavar="M", type=float, required=True, help="of the tool")
  add("--sample-size", metavar="M", type=float, nargs=3,
      help="of a block: width, depth, height; held at its bottom (grasp: one end)")  # fmt: skip
  add("--organ", metavar="NAME[:PLACE]", help="an organ of the catalogue instead of a block")
  add("--free", metavar="KEY", nargs="+", default=["young", "damping"],
      help="constants to find, as keys of the configuration (young damping)")  # fmt: skip
  add("--set", metavar="KEY=VALUE", action="append", default=[],
      help="a known constant, or the start value of a free one; may be repeated")  # fmt: skip
  add("--edge", metavar="M", type=float,
      help="longest edge of a triangle under the tool (a third of the contact)")  # fmt: skip
  add("--h", metavar="S", type=float, help="time step (600 for the record)")
  add("-o", "--out", metavar="FOLDER", default="out", help="output folder (%(default)s)")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from . import measured

  _check(args)
  record = measured.read(pathlib.Path(args.data))
  out = console.output_folder("out", args.out)
  register()
  from palpate.tissue.config import Config

  from . import indentation, least_squares

  test = _test(args)
  known = _known(args)
  progress = console.Progress()
  progress.show("filling the tissue; the first run takes some seconds longer", always=True)
  simulation = indentation.Indentation(test, record)
  starts = {"poisson": Config.poisson, "damping": Config.damping}
  starts |= {key: value for key, value in simulation.keys.items() if isinstance(value, float)}
  starts |= known
  if "young" not in known:
    starts["young"] = indentation.first_guess(test, record, starts["poisson"])
  free = [least_squares.constant(name, starts.get(name)) for name in dict.fromkeys(args.free)]
  start = starts | {each.name: each.start for each in free}

  with console.Interrupt() as interrupt:

    def simulate(values):
      return simulation.force(start | values, interrupt)

    def tell(values, error, count):
      found = ", ".join(f"{name} {value:.4g}" for name, value in values.items())
      progress.show(f"simulation {count}: {found}, residual {error:.3g} N", always=True)

    found = least_squares.fit(free, simulate, record.force, _LEVEL, tell)
  progress.clear()
  constants = start | found.values
  _write(out, args, simulation, record, free, found, constants)
  print(console.table(_rows(free, found, record, simulation)))
  for name, value in found.kept.items():
    print(
      f"palpate: the data do not determine {name}: it is kept at {value:g}, for which the other "
      f"constants hold; give --set {name}=VALUE where it is known, and leave it out of --free",
      file=sys.stderr,
    )
  _plot(out / "fit.png", record, found)
  for name, what in (("json", "numbers"), ("xml", "the plugin, to paste into MJCF")):
    print(f"{out / f'fit.{name}'}: {what}")
  if not found.whole:
    print("palpate: interrupted; this is the best so far", file=sys.stderr)
    return 130
  return 0


def _check(args: argparse.Namespace):
  for name in ("radius", "edge", "h"):
    value = getattr(args, name)
    if value is not None and not (math.isfinite(value) and 0 < value < 1):
      raise CommandError(f"{name} is {value:g}, expected a number in (0, 1); {_SI}")
  if (args.sample_size is None) == (args.organ is None):
    raise CommandError("expected either --sample-size or --organ: what was pressed")
  if args.test == "grasp" and args.organ:
    raise CommandError("--test grasp with --organ, expected --sample-size: a block is grasped")
  for value in args.sample_size or ():
    if not (math.isfinite(value) and 0 < value < 1):
      raise CommandError(f"sample-size has {value:g}, expected numbers in (0, 1); {_SI}")
  if args.sample_size and 2 * args.radius > min(args.sample_size[:2]):
    raise CommandError(
      f"radius is {args.radius:g} m, expected at most half of sample-size's width, "
      f"{min(args.sample_size[:2]):g} m"
    )


def _test(args: argparse.Namespace):
  """Returns the test that the options describe."""
  from palpate.models import catalog, scene

  from .indentation import Test

  name, _, place = (args.organ or "").partition(":")
  if args.organ is not None:
    with console.one_line():
      places = scene.targets(name)
    place = place or catalog.entry(name).ports[0].landmark
    if place not in places:
      raise CommandError(f"organ {name!r}: place is {place!r}, expected one of {', '.join(places)}")
  size = tuple(args.sample_size) if args.sample_size else None
  return Test(args.tip, args.radius, size, name, place, args.edge, args.h, args.test == "grasp")


def _known(args: argparse.Namespace) -> dict[str, float]:
  """Returns the constants that --set gives."""
  from .least_squares import allowed

  known = {}
  for text in args.set:
    key, equals, value = text.partition("=")
    rows = allowed()
    if not equals or key not in rows:
      raise CommandError(f"--set {text!r}, expected KEY=VALUE with one of {', '.join(rows)}")
    try:
      known[key] = float(np.ravel(rows[key].read(value, 1))[0])
    except ValueError:
      raise CommandError(f"{key} is {value!r}, expected {rows[key].allowed}") from None
  return known


def _rows(free, found, record, simulation) -> list[tuple[str, str]]:
  """Returns the table that is printed."""
  rows = []
  for each in free:
    if each.name in found.kept:
      rows.append((each.name, f"{each.start:.4g}, kept: the data do not determine it"))
      continue
    value, low, high = (part[each.name] for part in (found.values, found.low, found.high))
    unit = "" if each.unit == "-" else f" {each.unit}"
    span = f"{low:.4g} to {high:.4g}" if math.isfinite(low) else "unknown"
    rows.append((each.name, f"{value:.4g}{unit} ({100 * _LEVEL:.0f} %: {span})"))
  share = 100 * found.residual / np.abs(record.force).max()
  return [
    *rows,
    ("residual", f"{found.residual:.3g} N RMS, {share:.2g} % of the greatest force"),
    ("rows", str(len(record.time))),
    ("nodes", str(simulation.nodes)),
    ("simulations", f"{found.simulations} of h = {1e3 * simulation.step:.3g} ms"),
  ]


def _write(out: pathlib.Path, args, simulation, record, free, found, constants):
  """Writes fit.json and fit.xml."""
  from palpate.models import mjcf

  unit = {each.name: each.unit for each in free}
  numbers = {
    name: {
      "value": value,
      "low": _or_none(found.low[name]),
      "high": _or_none(found.high[name]),
      "unit": unit[name],
    }
    for name, value in found.values.items()
  }
  about = {
    "data": str(args.data),
    "test": args.test,
    "tip": args.tip,
    "radius": args.radius,
    "sample_size": args.sample_size,
    "organ": args.organ,
    "level": _LEVEL,
    "constants": numbers,
    "known": {key: value for key, value in constants.items() if key not in found.values},
    "residual": found.residual,
    "rows": len(record.time),
    "nodes": simulation.nodes,
    "step": simulation.step,
    "simulations": found.simulations,
    "complete": found.whole,
    "undetermined": list(found.kept),
  }
  console.write(out / "fit.json", json.dumps(about, indent=2) + "\n")
  text = mjcf.plugin(simulation.keys | {key: float(f"{v:.5g}") for key, v in constants.items()})
  console.write(out / "fit.xml", text + "\n")


def _or_none(value: float) -> float | None:
  return value if math.isfinite(value) else None


def _plot(path: pathlib.Path, record, found):
  """Draws measurement, fit and residual."""
  try:
    console.need("plot", "matplotlib")
  except CommandError as error:
    print(f"palpate: no plot: {error}", file=sys.stderr)
    return
  from matplotlib.figure import Figure

  figure = Figure(figsize=(9.0, 4.0), dpi=150, layout="constrained")
  axes = figure.subplots(2, 2, height_ratios=(3, 1), sharex="col")
  for column, (x, label) in enumerate(
    ((record.time, "time [s]"), (1e3 * record.depth, "depth [mm]"))
  ):
    above, below = axes[:, column]
    above.plot(x, record.force, ".", ms=3, color="#999999", label="measured")
    above.plot(x, found.force, color="#c1442e", lw=1.4, label="fit")
    below.plot(x, record.force - found.force, ".", ms=2, color="#2f6f9f")
    below.axhline(0, color="#333333", lw=0.6)
    below.set_xlabel(label)
    for ax in (above, below):
      ax.spines[["top", "right"]].set_visible(False)
  axes[0, 0].set_ylabel("force [N]")
  axes[1, 0].set_ylabel("residual [N]")
  axes[0, 0].legend(frameon=False, fontsize=8)
  figure.savefig(path)
  print(f"{path}: fit and residual")
