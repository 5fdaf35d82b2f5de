"""What the effective inertia does to the contact force: it scaled, against the explicit reference.

    python tests/benchmarks/inertia.py

The press of `tests/plugin/data/press_explicit_20us.py` (642 nodes), RMS error in % of its peak,
with the joint armature times the factor of each column; `-` where it does not stay bounded. If an
inertia computed anew in every step for the nodes in contact gained much, some factor would.
"""

import pathlib
import runpy

import mujoco
import numpy as np
import palpate

PRESS = pathlib.Path(__file__).parents[1] / "reference" / "press_explicit_20us.py"
FACTORS = (1e-3, 0.25, 0.5, 1.0, 2.0, 4.0)


def error(script: dict, expected: np.ndarray, h: float, factor: float) -> float:
  """Returns the RMS error of the force, a share of its peak."""
  names = {"stiffness": "STIFFNESS", "foundation": "FOUNDATION", "damping": "DAMPING"}
  keys = {"elements": "spring", "bend": 0, "device": "cpu"}
  keys |= {key: script[name] for key, name in names.items()}
  config = "".join(f'<config key="{key}" value="{value}"/>' for key, value in keys.items())
  xml = script["mjcf"](
    h,
    '<extension><plugin plugin="palpate.organ"/></extension>',
    f'<plugin plugin="palpate.organ">{config}</plugin>',
  )
  model = mujoco.MjModel.from_xml_string(xml)
  name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, 0)
  organ = palpate.Organ(model, mujoco.MjData(model), name)
  dofs = organ._dofs
  model.dof_M0[dofs] += (factor - 1) * model.dof_armature[dofs]
  model.dof_armature[dofs] *= factor
  found = script["press"](model)
  force = np.interp(expected[:, 0], found[:, 0], found[:, 1])
  return float(np.sqrt(np.mean((force - expected[:, 1]) ** 2)) / expected[:, 1].max())


def main():
  """Prints the table."""
  script = runpy.run_path(str(PRESS))
  expected = np.loadtxt(PRESS.with_suffix(".csv"), delimiter=",", skiprows=1)
  print("h [ms] " + "".join(f"{factor:>8g}" for factor in FACTORS))
  for h in (0.5e-3, 1e-3, 2e-3, 4e-3):
    row = [100 * error(script, expected, h, factor) for factor in FACTORS]
    print(f"{1e3 * h:6g} " + "".join(f"{e:8.2f}" if e < 100 else "       -" for e in row))


if __name__ == "__main__":
  main()
