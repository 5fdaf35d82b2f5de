"""Settings of MuJoCo's native flex: which is the fastest, which the most accurate.

The scene is that of `peer` with 642 vertices on the surface and a step of 1 ms: a ball is driven
6 mm into the tissue. All settings of a tissue take blocks of steps in turn. Times are medians, in
processor time of one thread, over that of `discrete, CG`. Errors are RMS of the contact force over
its peak, against `discrete, CG` at a quarter of the step and a tolerance of 1e-9. `trilinear` and
`quadratic` move the solid by 8 and 27 points, of which the lowest layer is pinned. `fails` means
that MuJoCo refuses the setting or the state is lost.
"""

from __future__ import annotations

import argparse
import pathlib
import re
import time

import mujoco
import numpy as np
import scenes
from benchmarks import plots, results, scene
from benchmarks.accuracy import peer
from benchmarks.runner import Bench, Case, Row
from palpate.tissue.geometry import mesh as topology

H = 1e-3  # [s]
BLOCK = 5
PEER = "discrete, CG"
# Integrator, solver, attributes of the option, dofs of the flex.
SETTINGS = {
  PEER: ("discrete", "CG", "", ""),
  "discrete, CG, elliptic": ("discrete", "CG", 'cone="elliptic"', ""),
  "discrete, CG, sparse": ("discrete", "CG", 'jacobian="sparse"', ""),
  "discrete, Newton, dense": ("discrete", "Newton", 'jacobian="dense"', ""),
  "discrete, Newton, sparse": ("discrete", "Newton", 'jacobian="sparse"', ""),
  "implicitfast, CG": ("implicitfast", "CG", "", ""),
  "Euler, CG": ("Euler", "CG", "", ""),
  "discrete, CG, trilinear": ("discrete", "CG", "", "trilinear"),
  "discrete, CG, quadratic": ("discrete", "CG", "", "quadratic"),
}
# Points of the lowest layer, whose number along z counts first.
PINNED = {"trilinear": range(0, 8, 2), "quadratic": range(0, 27, 3)}


class Press:
  """The press with one setting."""

  def __init__(self, kind: str, setting: str, h: float = H, tolerance: float = 1e-6):
    integrator, solver, option, dofs = SETTINGS[setting]
    xml = peer.mjcf(3, "peer", kind, 1e-4, h)
    xml = xml.replace('integrator="discrete"', f'integrator="{integrator}" {option}')
    xml = xml.replace('solver="CG"', f'solver="{solver}"')
    if dofs:
      xml = xml.replace("<flexcomp ", f'<flexcomp dof="{dofs}" ')
      xml = re.sub(r'<pin id="[^"]*"', f'<pin id="{" ".join(map(str, PINNED[dofs]))}"', xml)
    self.model = mujoco.MjModel.from_xml_string(xml)
    if not dofs:
      skin = topology.build("organ", *scenes.sphere(3))
      scene.finish(self.model, skin, peer.KINDS[kind])
    self.model.opt.tolerance, self.model.opt.iterations = tolerance, 100
    self.data, self.left = mujoco.MjData(self.model), round(0.12 / h)
    self.times, self.forces = [], []
    self.dof = self.model.joint("z").dofadr[0]

  def go(self, count: int):
    """Takes up to so many of the steps that are left."""
    for _ in range(min(count, self.left)):
      self.data.ctrl[0] = -min(0.05 * self.data.time, 0.006)
      start = time.thread_time()
      mujoco.mj_step(self.model, self.data)
      self.times.append(time.thread_time() - start)
      self.forces.append(self.data.qfrc_constraint[self.dof])
      self.left -= 1


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a tissue."""
  kinds = ("solid",) if args.short else ("skin", "bending", "solid")
  return [[{"case": kind, "kind": kind} for kind in kinds]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns a row a setting."""
  kind, presses, refused = case["kind"], {}, {}
  for setting, (*_, dofs) in SETTINGS.items():
    if dofs and kind != "solid":
      continue
    try:
      presses[setting] = Press(kind, setting)
    except ValueError as error:
      refused[setting] = " ".join(str(error).split())[:60]
  while any(press.left for press in presses.values()):
    for press in presses.values():
      press.go(BLOCK)
  fine = Press(kind, PEER, H / 4, 1e-9)
  fine.go(fine.left)
  expected = np.array(fine.forces)[3::4]
  rows: list[Row] = [
    {"kind": kind, "setting": setting, "nv": 0, "times": 0.0, "error": 0.0, "peak": 0.0, "why": why}
    for setting, why in refused.items()
  ]
  for setting, press in presses.items():
    lost = press.data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number
    gap = np.array(press.forces) - expected
    rows.append({
      "kind": kind, "setting": setting, "nv": press.model.nv,
      "times": float(np.median(press.times) / np.median(presses[PEER].times)),
      "error": 100 * float(np.sqrt(np.mean(gap**2)) / expected.max()),
      "peak": float(np.max(press.forces) / expected.max()), "why": "unstable" if lost else "",
    })  # fmt: skip
  return rows


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  held = [r for r in rows if not r["why"]]
  good = [r for r in held if r["error"] < 5]
  if not good:
    return []
  fast = min(good, key=lambda r: r["times"])
  newton = [r["times"] for r in good if "Newton" in r["setting"]]
  few = [r for r in held if r["setting"].endswith(("trilinear", "quadratic"))]
  lines = [
    f"No setting within 5 % takes less than {fast['times']:.2f} of the time of `{PEER}`, the peer "
    f"on the other pages; Newton takes {min(newton):.1f} to {max(newton):.0f} times as long for "
    "the same error."
  ]
  lines += [
    f"`{r['setting']}` takes {r['times']:.2f} of the time and pushes {r['peak']:.1f} times as hard."
    for r in few
  ]
  return lines


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page."""
  table = [
    [r["kind"], r["setting"], *([f"fails: {r['why']}", "", "", ""] if r["why"] else [
      str(r["nv"]), f"{r['times']:.2f}", f"{r['error']:.2g}", f"{r['peak']:.2f}"])]
    for r in rows
  ]  # fmt: skip
  head = ["tissue", "setting", "dofs", f"time / {PEER}", "error [%]", "peak / fine"]
  lines = [str(__doc__).partition("\n\n")[2], "", *plots.table(head, table)]
  held = [r for r in rows if not r["why"]]
  names = [f"{r['kind']}: {r['setting']}" for r in held]
  title = "Settings of MuJoCo's native flex"
  picture = plots.bars(
    path.with_suffix(".png"), title, names, {"time": [r["times"] for r in held]}, f"[of {PEER}]"
  )
  return results.Page(title, finding(rows), lines, [picture])


COLUMNS = ("kind", "setting", "nv", "times", "error", "peak", "why")
BENCH = Bench("native", stages, run, COLUMNS, report)
