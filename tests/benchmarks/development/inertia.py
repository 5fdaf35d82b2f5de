"""What the effective inertia does to the contact force: it scaled, against the explicit reference.

The press of `tests/reference/press_explicit_20us.py` (642 nodes), RMS error in % of its peak,
with the joint armature times the factor of each column; `-` where it does not stay bounded. If an
inertia computed anew in every step for the nodes in contact gained much, some factor would.
"""

import argparse
import pathlib
import runpy

import numpy as np
import scenes
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row

PRESS = pathlib.Path(__file__).parents[2] / "reference" / "press_explicit_20us.py"
H = (0.5e-3, 1e-3, 2e-3, 4e-3)  # [s]
FACTORS = (1e-3, 0.25, 0.5, 1.0, 2.0, 4.0)


def error(script: dict, expected: np.ndarray, h: float, factor: float) -> float:
  """Returns the RMS error of the force, a share of its peak."""
  names = {"stiffness": "STIFFNESS", "foundation": "FOUNDATION", "damping": "DAMPING"}
  keys = {"elements": "spring", "bend": 0}
  keys |= {key: script[name] for key, name in names.items()}
  extension = '<extension><plugin plugin="palpate.organ"/></extension>'
  model, _, organ = scenes.load(script["mjcf"](h, extension, scenes.plugin(**keys)))
  dofs = scenes.dofs(organ)
  model.dof_M0[dofs] += (factor - 1) * model.dof_armature[dofs]
  model.dof_armature[dofs] *= factor
  found = script["press"](model)
  force = np.interp(expected[:, 0], found[:, 0], found[:, 1])
  return float(np.sqrt(np.mean((force - expected[:, 1]) ** 2)) / expected[:, 1].max())


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a time step and factor."""
  steps = H[1:2] if args.short else H
  return [[{"case": f"{h:g}-{k:g}", "h": h, "factor": k} for h in steps for k in FACTORS]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  script = runpy.run_path(str(PRESS))
  expected = np.loadtxt(PRESS.with_suffix(".csv"), delimiter=",", skiprows=1)
  off = 100 * error(script, expected, case["h"], case["factor"])
  return [{"h": case["h"], "factor": case["factor"], "rms_percent": off}]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for h in sorted({row["h"] for row in rows if row["h"] <= 2.001e-3}):
    errors = {row["factor"]: row["rms_percent"] for row in rows if row["h"] == h}
    best = min(errors, key=lambda factor: errors[factor])
    lines.append(f"At {1e3 * h:g} ms the best factor, {best:g}, has an error of {errors[best]:.2g} "
                 f"% of the peak; the inertia as it is has {errors[1]:.2g} %.")  # fmt: skip
  return lines[:3]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  table = []
  for h in dict.fromkeys(row["h"] for row in rows):
    found = [row["rms_percent"] for row in rows if row["h"] == h]
    table.append([f"{1e3 * h:g}", *(f"{off:.2f}" if off < 100 else "-" for off in found)])
  lines = [str(__doc__).partition("\n\n")[2], ""]
  lines += plots.table(["h [ms]", *(f"x {factor:g}" for factor in FACTORS)], table)
  steps = dict.fromkeys(row["h"] for row in rows)
  panels = {"": {f"{1e3 * h:g} ms": (
    [row["factor"] for row in rows if row["h"] == h],
    [row["rms_percent"] for row in rows if row["h"] == h],
  ) for h in steps}}  # fmt: skip
  title = "Scaled effective inertia"
  picture = plots.curves(out / "inertia.png", title, panels, "factor", "RMS error [% of peak]")
  return [picture, results.page(out / "inertia.md", title, about, lines, finding(rows), picture)]


BENCH = Bench("inertia", stages, run, report=report,
              folder="development")  # fmt: skip
