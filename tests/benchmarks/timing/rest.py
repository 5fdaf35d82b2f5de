"""Times mj_step of a scene with a sleeping windowed organ against the scene without the organ.

    palpate bench rest

The liver with a probe in its home pose, or withdrawn; CPU time of blocks of steps, all variants in
turn. `mujoco_us` is the same model with the plugin left out: what MuJoCo spends on the
window's dofs. `napping_us` has MuJoCo's own sleep switched on, `awake_us` is the organ kept from
sleeping.
"""

import argparse
import pathlib
import time

import mujoco
import numpy as np
import palpate
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate import models
from palpate.engine.model import mjstruct
from palpate.models import markup
from palpate.models import organs as anatomy

ROUNDS, STEPS = 200, 20
TOOLS = ("probe",)


def block(model, data, steps: int) -> float:
  """Returns the CPU time of a step in us, which neighbours on the machine change least."""
  start = time.process_time()
  mujoco.mj_step(model, data, nstep=steps)
  return 1e6 * (time.process_time() - start) / steps


def measure(nodes: int, insertion: float) -> dict:
  """Returns medians of a step's time and their ratios to the scene without the organ."""
  windowed = models.load("liver", nodes=nodes, coupling="window", instruments=TOOLS).compile()
  build = anatomy.build("liver", nodes)
  bare = mujoco.MjModel.from_xml_string(markup.scene(build, "liver", TOOLS, root=None))
  variants, organs = {}, {}
  napping = windowed.__copy__()
  napping.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
  scenes = {"bare": bare, "asleep": windowed, "napping": napping, "awake": windowed.__copy__()}
  for name, m in scenes.items():
    d = mujoco.MjData(m)
    d.ctrl[2] = insertion
    if name != "bare":
      organs[name] = palpate.Organ(m, d, "liver/liver")
    variants[name] = m, d
    mujoco.mj_step(m, d, nstep=3000)
  if not organs["asleep"].asleep:
    raise RuntimeError("the organ does not fall asleep")
  m, d = variants["asleep"]
  raw = mjstruct.Model.from_address(m._address)
  times = {name: [] for name in (*variants, "mujoco")}
  for _ in range(ROUNDS):
    for name in ("bare", "asleep", "napping"):
      times[name].append(block(*variants[name], STEPS))
    organs["awake"].configure(tolerance=1e-3)  # a change of a key ends its sleep
    times["awake"].append(block(*variants["awake"], STEPS))
    raw.nplugin = 0
    times["mujoco"].append(block(m, d, STEPS))
    raw.nplugin = 1
  median = {name: float(np.median(each)) for name, each in times.items()}
  return {
    "nodes": nodes,
    "insertion_m": insertion,
    "nv": m.nv,
    "contacts": d.ncon,
    **{f"{name}_us": value for name, value in median.items()},
    **{f"{name}_ratio": value / median["bare"] for name, value in median.items()},
  }


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a size and place of the probe."""
  nodes = args.nodes[:1] if args.short else args.nodes
  return [
    [
      {"case": f"{n}-{insertion:g}", "nodes": n, "insertion": insertion}
      for n in nodes
      for insertion in (0.0, -0.08)
    ]
  ]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  return [measure(case["nodes"], case["insertion"])]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.add_argument("--nodes", type=int, nargs="+", default=[1000, 4000])


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  return [
    f"{r['nodes']} nodes: a step takes {r['asleep_us']:.0f} us asleep, {r['awake_us']:.0f} us "
    f"awake and {r['bare_us']:.0f} us without the organ; {r['mujoco_us']:.0f} us of the first are "
    "MuJoCo's."
    for r in rows
    if not r["insertion_m"]
  ][:3]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  table = []
  for row in rows:
    place = f"withdrawn {-100 * row['insertion_m']:g} cm" if row["insertion_m"] else "home pose"
    cells = [f"{row['bare_us']:.1f}"]
    for name in ("awake", "asleep", "mujoco", "napping"):
      cells.append(f"{row[f'{name}_us']:.0f} ({row[f'{name}_ratio']:.3g})")
    table.append([f"{row['nodes']} ({row['nv']})", place, *cells])
  head = ["nodes (dofs)", "probe", "without the organ", "kept awake", "asleep", "of it MuJoCo"]
  lines = [
    "The liver with a probe, window coupling. Medians of CPU time of a step in us, and in brackets "
    'times the scene without the organ. "of it MuJoCo": the same model with the plugin left out. '
    "\"with the flag\": `<flag sleep='enable'/>`, MuJoCo's own sleep. "
    + results.link(out / "rest_cpu.csv"),
    "",
    *plots.table([*head, "asleep, with the flag"], table),
  ]
  names = [f"{r['nodes']} nodes, {'withdrawn' if r['insertion_m'] else 'home pose'}" for r in rows]
  title = "What a sleeping organ costs"
  picture = plots.bars(out / "rest.png", title, names, {
    label: [r[f"{key}_us"] for r in rows]
    for label, key in (("kept awake", "awake"), ("asleep", "asleep"), ("without it", "bare"))
  }, "CPU time of a step [us]")  # fmt: skip
  return [picture, results.page(out / "rest.md", title, about, lines, finding(rows), picture)]


BENCH = Bench("rest", stages, run, report=report, arguments=arguments, file="rest_cpu")
