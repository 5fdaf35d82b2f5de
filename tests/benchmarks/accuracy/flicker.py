"""Contact forces without flicker: a probe pressed at 20 mm/s into the organs that ship.

From 20 ms after the first touch on: the share of steps without a force between organ and probe, and
the RMS change of the force from one step to the next, in percent of the mean force. The targets are
less than 0.5 % and less than 5 %. The probe slides while it presses, since surfaces are not at
right angles to it; docs/physics.md, "What MuJoCo sees", says why that matters.
"""

from __future__ import annotations

import argparse
import math
import pathlib

import mujoco
import numpy as np
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate import models, register

ORGANS = ("stomach", "liver", "kidney", "gallbladder")
NODES = (250, 1000, 4000)
H = (2.5e-4, 5e-4, 1e-3, 2e-3)  # [s]
SPEED = 0.02  # [m/s]
TOUCH = 0.02  # after the first touch, not counted [s]
ALLOWED = {"without": 0.5, "change": 5.0}  # [%]
_DRIVEN = ("pitch", "yaw", "insertion")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case an organ, resolution, coupling and time step."""
  short = args.short
  return [[
    {"case": f"{organ} {nodes} {coupling} {h:g}", "organ": organ, "nodes": nodes,
     "coupling": coupling, "h": h}
    for nodes in (NODES[:1] if short else NODES[::-1])
    for coupling in ("nodal", "window")
    for h in (H[2:3] if short else H)
    for organ in (ORGANS[:1] if short else ORGANS)
  ]]  # fmt: skip


def press(organ: str, nodes: int, coupling: str, h: float) -> np.ndarray:
  """Returns the force on the probe in every step [N], (nstep,), from the first touch on."""
  spec = models.load(organ, nodes=nodes, coupling=coupling)
  spec.option.timestep = h
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key("touch").id)
  driven = [model.actuator(f"probe/{name}").id for name in _DRIVEN]
  start, end = (model.key(key).ctrl[driven].copy() for key in ("touch", "press"))
  steps = round(abs(end[2] - start[2]) / SPEED / h)
  force = np.zeros(steps)
  for k in range(steps):
    data.ctrl[driven] = start + (end - start) * k / steps
    mujoco.mj_step(model, data)
    force[k] = np.linalg.norm(data.sensor("probe/tip_force").data)
  return force[np.flatnonzero(force)[0] :]


def judge(force: np.ndarray, h: float) -> dict:
  """Returns what a press at `h` [s] is judged by, of the force in every step [N]."""
  counted = force[round(TOUCH / h) :]
  change = np.sqrt(np.mean(np.diff(counted) ** 2))
  return {
    "without": 100 * float(np.mean(counted == 0)),
    "change": 100 * float(change / counted.mean()),
    "mean_N": float(counted.mean()),
    "peak_N": float(counted.max()),
  }


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  register()
  what = {key: case[key] for key in ("organ", "nodes", "coupling", "h")}
  return [what | judge(press(**what), case["h"])]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  if not rows:
    return []
  none, most = (max(r[key] for r in rows) for key in ("without", "change"))
  usual = max((r["change"] for r in rows if r["h"] <= 1.001e-3), default=math.nan)
  return [
    f"In {len(rows)} presses at most {none:.2g} % of the steps in contact have no force.",
    f"From step to step the force changes by at most {most:.2g} % of its mean, at up to 1 ms by "
    f"{usual:.2g} %.",
  ]


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page."""
  over = [r for r in rows if any(r[key] >= most for key, most in ALLOWED.items())]
  table = []
  for key in sorted({(r["organ"], r["nodes"], r["coupling"]) for r in rows}):
    mine = {r["h"]: r for r in rows if (r["organ"], r["nodes"], r["coupling"]) == key}
    cells = [f"{mine[h]['without']:.1f} / {mine[h]['change']:.1f}" if h in mine else "-" for h in H]
    table.append([*map(str, key), *cells])
  head = ["organ", "nodes", "coupling", *(f"{1e3 * h:g} ms" for h in H)]
  lines = [str(__doc__).partition("\n\n")[2], "", *plots.table(head, table), ""]
  lines += [f"{len(over)} of {len(rows)} presses are over what is asked for."]
  lines += ["", results.link(path)]
  panels: dict = {}
  for organ, coupling in sorted({(r["organ"], r["coupling"]) for r in rows}):
    mine = [r for r in rows if (r["organ"], r["coupling"]) == (organ, coupling)]
    steps = sorted({r["h"] for r in mine})
    line = [1e3 * h for h in steps], [max(r["change"] for r in mine if r["h"] == h) for h in steps]
    panels.setdefault(coupling, {})[organ] = line
  title = "Change of the force from step to step, the worst of all meshes"
  picture = path.with_suffix(".png")
  plots.curves(picture, title, panels, "time step [ms]", "of the mean [%]")
  return results.Page("Contact forces without flicker", finding(rows), lines, [picture])


BENCH = Bench("flicker", stages, run, report=report)
