"""What is left of the press's force error: each cause switched by itself, against the reference.

  python press_error.py    prints RMS errors in % of the peak, of the whole and of its three parts

The press of tests/engine/test_coupling.py and its explicit reference. `touch` is the first 35 ms,
in which the ball bounces on one node, `ramp` until it stops at 100 ms, `hold` the rest; their
squares add up.
"""

import pathlib
import runpy

import mujoco
import numpy as np
import palpate
from benchmarks import plots
from palpate.tissue import solver

REFERENCE = pathlib.Path(__file__).parents[1] / "reference" / "press_explicit_20us"
PARTS = {"touch": (0, 0.035), "ramp": (0.035, 0.1), "hold": (0.1, 1)}  # [s]
CASES = {
  "as it is": {},
  "3 Newton iterations": {"newton": 3},
  "tolerance 1e-6": {"tolerance": 1e-6},
  "without looking ahead": {"ahead": 1e-9},
  "without looking ahead, 2 Newton iterations": {"ahead": 1e-9, "newton": 2},
  "contact force extrapolated": {"extrapolate": 1.0},
  "masses instead of effective inertia": {"armature": 0.0},
  "twice the effective inertia": {"armature": 2.0},
  "midpoint": {"integrator": "midpoint"},
}


def press(script: dict, h: float, ahead=0.1, extrapolate=0.0, armature=1.0, **keys) -> np.ndarray:
  """Returns time and contact force, a row each step; see CASES for what may be switched."""
  texts = {"elements": "spring", "stiffness": script["STIFFNESS"], "bend": 0, "device": "cpu"}
  texts |= {"foundation": script["FOUNDATION"], "damping": script["DAMPING"]} | keys
  config = "".join(f'<config key="{key}" value="{value}"/>' for key, value in texts.items())
  plugin = '<plugin plugin="palpate.organ">'
  extension = '<extension><plugin plugin="palpate.organ"/></extension>'
  xml = script["mjcf"](h, extension, f"{plugin}{config}</plugin>")
  before, solver.AHEAD = solver.AHEAD, ahead
  try:
    model = mujoco.MjModel.from_xml_string(xml)
    nodes = slice(0, model.nv - 1)
    mass = model.body_mass[model.dof_bodyid[nodes]]
    inertia = mass + model.dof_armature[nodes]
    if armature != 1:
      model.dof_armature[nodes] = np.maximum(armature * inertia - mass, 0)
      model.dof_M0[nodes] = mass + model.dof_armature[nodes]
    data = mujoco.MjData(model)
  finally:
    solver.AHEAD = before
  lagged = data.plugin_state[: model.nv - 1]
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


def main():
  """Prints the table."""
  palpate.register()
  script = runpy.run_path(str(REFERENCE.with_suffix(".py")))
  time, expected = np.loadtxt(REFERENCE.with_suffix(".csv"), delimiter=",", skiprows=1).T
  table = []
  for h in (5e-4, 1e-3, 2e-3):
    for name, switches in CASES.items():
      found = press(script, h, **switches)
      row = [f"{1e3 * h:g}", name]
      for shift in (0.0, h):  # the force is taken for that of the step's end, or its start
        gap = np.interp(time, found[:, 0] - shift, found[:, 1]) - expected
        row.append(100 * float(np.sqrt(np.mean(gap**2))) / expected.max())
        if not shift:
          parts = [gap[(time >= a) & (time < b)] for a, b in PARTS.values()]
      row += [100 * float(np.sqrt((p @ p) / time.size)) / expected.max() for p in parts]
      table.append(row)
  head = ["h [ms]", "", "RMS, as of the step's end", "of its start", *PARTS]
  print("\n".join(plots.table(head, table)))


if __name__ == "__main__":
  main()
