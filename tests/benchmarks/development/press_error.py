"""What is left of the press's force error: each cause switched by itself, against the reference.

RMS errors in % of the peak, of the whole and of its three parts, in the press of
tests/engine/test_coupling.py against its explicit reference. The force is taken for that of the
step's end, or its start. `touch` is the first 35 ms, in which the ball lies on one node, `ramp`
until it stops at 100 ms, `hold` the rest; their squares add up.
"""

import argparse
import dataclasses
import pathlib
import runpy

import mujoco
import numpy as np
import palpate
import scenes
import warp as wp
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate.engine import coupling, layout
from palpate.tissue import step as stepping
from palpate.tissue.body import Body
from palpate.tissue.types import Stage

REFERENCE = pathlib.Path(__file__).parents[2] / "reference" / "press_explicit_20us"
PARTS = {"touch": (0, 0.035), "ramp": (0.035, 0.1), "hold": (0.1, 1)}  # [s]
H = (5e-4, 1e-3, 2e-3)  # [s]
CASES = {
  "as it is": {},
  "3 Newton iterations": {"newton": 3},
  "tolerance 1e-6": {"tolerance": 1e-6},
  "without looking ahead": {"ahead": False},
  "contact force extrapolated": {"extrapolate": 1.0},
  "masses instead of effective inertia": {"armature": 0.0},
  "twice the effective inertia": {"armature": 2.0},
  "midpoint": {"integrator": "midpoint"},
}


def at_present(body: Body):
  """Takes an implicit step with the forces of where the body is."""
  wp.copy(body.system.disp_trial, body.state.disp)
  wp.copy(body.system.vel_trial, body.state.vel)
  stepping.assemble(body, Stage.FIRST)  # the share ahead in `state.step` is 0, as nobody wrote it
  stepping.solve(body, Stage.FIRST)
  wp.copy(body.state.dvel, body.system.sol)


def press(script: dict, h: float, ahead=True, extrapolate=0.0, armature=1.0, **keys) -> np.ndarray:
  """Returns time and contact force, a row each step; see CASES for what may be switched."""
  texts = {"elements": "spring", "stiffness": script["STIFFNESS"], "bend": 0}
  texts |= {"foundation": script["FOUNDATION"], "damping": script["DAMPING"]} | keys
  extension = '<extension><plugin plugin="palpate.organ"/></extension>'
  xml = script["mjcf"](h, extension, scenes.plugin(**texts))
  known = stepping.SCHEMES["implicit"]
  if not ahead:
    stepping.SCHEMES["implicit"] = dataclasses.replace(known, step=at_present)
  try:
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)  # gives the nodes the right inertia, if they have not
    nodes = slice(0, model.nv - 1)
    mass = model.body_mass[model.dof_bodyid[nodes]]
    inertia = mass + model.dof_armature[nodes]
    if armature != 1:
      model.dof_armature[nodes] = np.maximum(armature * inertia - mass, 0)
      model.dof_M0[nodes] = mass + model.dof_armature[nodes]
  finally:
    stepping.SCHEMES["implicit"] = known
  sizes = layout.NO_CUTS | coupling.nodal_sizes(model.nv - 1, 0) | {"nrelax": 0, "nbond": 0}
  lagged = data.plugin_state[layout.spans(layout.NodalState, sizes)["force"]]
  old = np.zeros_like(lagged)
  rows = []
  for _ in range(round(script["DURATION"] / h)):
    data.ctrl[0] = -script["DEPTH"] * min(1, data.time / script["HOLD"])
    mujoco.mj_step(model, data)
    rows.append((data.time, data.qfrc_constraint[model.nv - 1]))
    force = lagged.copy()
    lagged += extrapolate * (force - old) * (force != 0)
    old = force
  return np.array(rows)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a time step and cause."""
  steps = H[1:2] if args.short else H
  return [[{"case": f"{h:g}, {name}", "h": h, "switched": name} for h in steps for name in CASES]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  palpate.register()
  script = runpy.run_path(str(REFERENCE.with_suffix(".py")))
  time, expected = np.loadtxt(REFERENCE.with_suffix(".csv"), delimiter=",", skiprows=1).T
  found = press(script, case["h"], **CASES[case["switched"]])

  def gap(shift: float) -> np.ndarray:
    return np.interp(time, found[:, 0] - shift, found[:, 1]) - expected

  def percent(part: np.ndarray) -> float:
    return 100 * float(np.sqrt((part @ part) / time.size)) / expected.max()

  row = {"h": case["h"], "switched": case["switched"]}
  row |= {"rms_end": percent(gap(0.0)), "rms_start": percent(gap(case["h"]))}
  parts = {part: gap(0.0)[(time >= a) & (time < b)] for part, (a, b) in PARTS.items()}
  return [row | {name: percent(part) for name, part in parts.items()}]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with: of steps of 1 ms."""
  mine = {r["switched"]: r for r in rows if abs(r["h"] - 1e-3) < 1e-9}
  now = mine.get("as it is")
  if not now:
    return []
  best = min(mine.values(), key=lambda r: min(r["rms_end"], r["rms_start"]))
  squares = {part: now[part] ** 2 for part in PARTS}
  part = max(squares, key=lambda name: squares[name])
  return [
    f"At 1 ms the force's error is {now['rms_end']:.2g} % of the peak.",
    f"{100 * squares[part] / sum(squares.values()):.0f} % of its square arise in `{part}`.",
    f"The least error of any variant at 1 ms is {min(best['rms_end'], best['rms_start']):.2g} % "
    f"({best['switched']}).",
  ]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  keys = ("rms_end", "rms_start", *PARTS)
  table = [[f"{1e3 * r['h']:g}", r["switched"], *(float(r[k]) for k in keys)] for r in rows]
  head = ["h [ms]", "", "RMS, as of the step's end", "of its start", *PARTS]
  lines = [str(__doc__).partition("\n\n")[2], "", *plots.table(head, table)]
  names = [f"{1e3 * r['h']:g} ms, {r['switched']}" for r in rows]
  picture = plots.bars(out / "press_error.png", "RMS error of the press's force", names, {
    "as of the step's end": [r["rms_end"] for r in rows],
    "as of its start": [r["rms_start"] for r in rows],
  }, "[% of peak]")  # fmt: skip
  title = "What is left of the press's error"
  page = out / "press_error.md"
  return [picture, results.page(page, title, about, lines, finding(rows), picture)]


BENCH = Bench("press_error", stages, run, report=report,
              folder="development")  # fmt: skip
