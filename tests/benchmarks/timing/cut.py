"""Times steps in which an organ is cut, beside steps in which it is touched.

    palpate bench cut

A sheet of 15 by 10 cm (E = 200 kPa, t = 2 mm, h = 2 ms, windows), a membrane or with bending,
pinned at its long sides, is cut by a blade at 80 mm/s, by scissors that close, by a hook's current
at 14 mm/s, or by `Organ.cut`, two edges at a time; the same sheet is pressed by a ball that holds
still, with room for cuts and without, and by one that moves on as fast as the tool (as the blade
for tools without a speed). All are stepped in turn. CPU time of the process; `open` are the steps
in which the mesh came apart (with `Organ.cut` the call, and the step after it), `between` the
others. A solid, a block of 30 mm of the same tissue, is cut and pressed in the same way, 6 mm deep;
`nodes` are those on its surface.
"""

import argparse
import itertools
import pathlib
import time

import mujoco
import numpy as np
import palpate
import scenes
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate.models import trocar

H, LENGTH, WIDTH = 2e-3, 0.15, 0.10
ENERGY, BURN, THICKNESS = 40.0, 1.1e6, 2e-3  # [J/m^2], of a current, of the wall [m]
SLIDE, CAPSULE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtGeom.mjGEOM_CAPSULE
FREE = {"contype": 0, "conaffinity": 0}
TOOLS = ("blade", "scissors", "hook", "Organ.cut")
TISSUES = ("membrane", "plate", "solid")
DEEP, BLOCK = 6e-3, 0.03  # how deep solids are cut, and how thick they are [m]
SPEED = {"blade": 0.08, "hook": 0.014}  # [m/s]
STEPS = 900  # at most
AROUND = 0.02  # from the ends of the sheet to where the ball that moves turns back [m]
PIECE = 2.3  # edges that `Organ.cut` cuts at a time


def _blade(spec, radius: float, half: float):
  body = spec.worldbody.add_body(name="tool", pos=[0, 0, 0])
  body.add_joint(type=SLIDE, axis=[1, 0, 0], name="x", damping=4)
  scenes.servo(spec, "x", 2000)
  body.add_geom(pos=[0, 0, 0.03], size=[0.004, 0, 0], mass=0.1, **FREE)
  body.add_geom(name="edge", type=CAPSULE, size=[radius, half, 0], mass=1e-3, **FREE)


def _organ(nodes: int, tissue: str):
  """Returns points, triangles and the pinned ones, and what else an organ is given."""
  if tissue == "solid":
    area = 2 * (LENGTH * WIDTH + (LENGTH + WIDTH) * BLOCK)
    points, elem = scenes.box((LENGTH, WIDTH, BLOCK), np.sqrt(area / nodes))
    points += [LENGTH / 2, 0, -BLOCK / 2]
    pin = np.flatnonzero(points[:, 2] < 1e-9 - BLOCK)
    return points, elem, pin, {"elements": "solid", "mass": 0.45, "young": 2e5}
  nx = round(np.sqrt(nodes * LENGTH / WIDTH * 0.87))
  points, elem = scenes.triangular(LENGTH, WIDTH, nx, round(nx * WIDTH / LENGTH / 0.866), 0.2)
  pin = np.flatnonzero(np.abs(np.abs(points[:, 1]) - WIDTH / 2) < 1e-9)
  more = {"mass": 0.05, "young": 2e5, "thickness": THICKNESS, "bend": float(tissue == "plate")}
  return points, elem, pin, more


def scene(nodes: int, tool: str, tissue: str):
  """Returns model, data and organ of a sheet or block, and what cuts it or a ball on it."""
  points, elem, pin, more = _organ(nodes, tissue)
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = H, (0, 0, 0)
  keys = {"spare": "auto"}
  if tool == "blade":
    _blade(spec, 5e-4, 6e-3)
    keys["cutters"] = f"edge {ENERGY}"
  elif tool == "hook":
    _blade(spec, 1e-3, 1e-3)
    spec.add_actuator(name="power", target="x", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    spec.actuator("power").gainprm = 10 * [0]
    keys["cutters"] = f"edge {BURN} by power"
  elif tool == "scissors":
    turn = (np.sqrt(0.5), 0, -np.sqrt(0.5), 0)
    trocar.attach(spec, "scissors", "s/", pos=(LENGTH / 2 - 0.12, 0, 0), quat=turn)
    for geom in spec.geoms:
      geom.contype = geom.conaffinity = 0
    keys["cutters"] = f"s/edge_left s/edge_right {ENERGY}"
  elif tool != "Organ.cut":
    body = spec.worldbody.add_body(name="ball", pos=[LENGTH / 2, 0, 0.012])
    for axis in ("z", "x"):
      body.add_joint(type=SLIDE, axis=np.eye(3)["xyz".index(axis)], name=axis, damping=4)
      scenes.servo(spec, axis, 2000)
    body.add_geom(size=[0.008, 0, 0], mass=0.1)
    keys = {} if tool == "plain" else keys
  if keys and tissue == "solid":
    keys["spare"] = 900
  more |= {"windows": True, "pin": pin, "device": "cpu", **keys}
  palpate.add_organ(spec, (points, elem), "organ", **more)
  return scenes.load(spec)


def _spent(work) -> float:
  start = time.process_time()
  work()
  return 1e3 * (time.process_time() - start)


def _cuts(model, data, organ, tool: str, tissue: str):
  """Yields functions, each of which takes a step with the tool."""

  def step():
    mujoco.mj_step(model, data)

  if tool in SPEED:
    for k in range(min(STEPS, round((LENGTH - 0.01) / SPEED[tool] / H))):
      data.ctrl[0] = SPEED[tool] * H * k
      if tool == "hook":
        data.ctrl[1] = 2 * SPEED[tool] * BURN * THICKNESS
      yield step
  elif tool == "scissors":
    jaw = data.actuator("s/jaw")
    for _ in range(2):
      mujoco.mj_resetData(model, data)
      data.joint("s/jaw_left").qpos[0] = data.joint("s/jaw_right").qpos[0] = 0.4
      for opening in [*np.full(50, 0.8), *np.linspace(0.8, -0.1, 400)]:
        jaw.ctrl[0] = opening
        yield step
  else:
    depth = DEEP if tissue == "solid" else None

    def cut(line):
      organ.cut(line, depth=depth)
      step()

    edge = organ.xpos0[organ.elem]
    piece = PIECE * np.linalg.norm(edge[:, 1] - edge[:, 0], axis=1).mean()
    for y in np.linspace(-0.03, 0.03, 3):
      for x in np.arange(0.02, LENGTH - 0.02, piece):
        yield lambda line=[[x, y, 0], [x + piece, y, 0]]: cut(line)
        yield step


def _place(step: int, speed: float) -> float:
  """Returns where a ball is that goes to and fro about the middle [m]."""
  half = LENGTH / 2 - AROUND
  return half - abs((speed * H * step + half) % (4 * half) - 2 * half)


def measure(nodes: int, tool: str, tissue: str) -> dict:
  """Returns medians of steps of the four sheets or blocks, in ms."""
  cutting, touched, moved, plain = (
    scene(nodes, name, tissue) for name in (tool, "ball", "ball", "plain")
  )
  for model, data, _ in (touched, moved, plain):
    for k in range(150):
      data.ctrl[0] = -0.012 * min(1.0, k / 100)
      mujoco.mj_step(model, data)
  spent, opened = {"cut": [], "touched": [], "moved": [], "plain": []}, []
  others = {"touched": touched, "moved": moved, "plain": plain}
  model, data, organ = cutting
  for k, work in enumerate(_cuts(model, data, organ, tool, tissue)):
    before = len(organ.cuts)
    spent["cut"].append(_spent(work))
    opened.append(len(organ.cuts) > before)
    for name, (m, d, _) in others.items() if k % 4 == 0 else ():
      if name == "moved":
        d.ctrl[1] = _place(len(spent[name]), SPEED.get(tool, SPEED["blade"]))
      spent[name].append(_spent(lambda m=m, d=d: mujoco.mj_step(m, d)))
  assert organ.error is None and touched[2].error is None, organ.error
  opened, taken = np.array(opened), np.array(spent["cut"])
  contact, moving = (float(np.median(spent[name])) for name in ("touched", "moved"))
  cuts, at = taken[opened], np.flatnonzero(opened[:-1])
  return {
    "nodes": touched[2].nvert,
    "tool": tool,
    "tissue": tissue,
    "cuts": int(opened.sum()),
    "contacts": touched[1].ncon,
    "plain_ms": float(np.median(spent["plain"])),
    "contact_ms": contact,
    "moving_ms": moving,
    "between_ms": float(np.median(taken[~opened])),
    "open_ms": float(np.median(cuts)),
    "open_most_ms": float(np.quantile(cuts, 0.95)),
    "mean_ms": float(taken.mean()),
    "cut_ms": float(np.median(taken[at] - 0.5 * (taken[at - 1] + taken[at + 1]))),
    "ratio": float(np.median(cuts)) / contact,
    "moving_ratio": float(np.median(cuts)) / moving,
    "room_ratio": float(np.median(np.array(spent["touched"]) / np.array(spent["plain"]))),
  }


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a size and tool."""
  nodes = args.nodes[:1] if args.short else args.nodes
  return [
    [
      {"case": f"{n}-{tool}-{tissue}", "nodes": n, "tool": tool, "tissue": tissue}
      for n, tissue, tool in itertools.product(nodes, args.tissues, TOOLS)
      if tissue != "solid" or tool in ("blade", "Organ.cut")  # others reach less than such meshes
    ]
  ]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  return [measure(case["nodes"], case["tool"], case["tissue"])]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.add_argument("--nodes", type=int, nargs="+", default=[1000, 4000])
  parser.add_argument("--tissues", nargs="+", choices=TISSUES, default=TISSUES)


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for name, tissues in (("sheets", ("membrane", "plate")), ("solids", ("solid",))):
    mine = [r for r in rows if r["tissue"] in tissues]
    if mine:
      some = [r["cut_ms"] for r in mine]
      most = max(mine, key=lambda r: r["ratio"])
      lines.append(
        f"A cut of two edges adds {min(some):.2g} to {max(some):.2g} ms to a step of {name}; a "
        f"step with it takes at most {most['ratio']:.2g} times one in contact ({most['nodes']} "
        f"nodes, {most['tool']}, {most['tissue']})."
      )
  return lines


def draw(rows: list[Row], out: pathlib.Path) -> pathlib.Path:
  """Draws a step in contact, one that cuts, and the cut alone."""
  names = [f"{r['nodes']} nodes, {r['tissue']}, {r['tool']}" for r in rows]
  keys = {"step in contact": "contact_ms", "step that cuts": "open_ms", "cut alone": "cut_ms"}
  groups = {label: [r[key] for r in rows] for label, key in keys.items()}
  return plots.bars(out / "cut.png", "What cutting costs a step", names, groups, "CPU time [ms]")


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page."""
  names = ("contact", "moving", "between", "mean", "cut", "open", "open_most")
  table = [
    [
      str(row["nodes"]),
      row["tool"],
      row["tissue"],
      str(row["cuts"]),
      *(f"{row[f'{name}_ms']:.2f}" for name in names),
      f"{row['ratio']:.2f}",
      f"{row['moving_ratio']:.2f}",
      f"{row['room_ratio']:.3f}",
    ]
    for row in rows
  ]
  head = ["nodes", "tool", "tissue", "cuts", "in contact", "moving", "tool in it", "mean",
          "cut alone", "step that cuts", "95 % of these", "to one in contact", "to one moving",
          "room to none"]  # fmt: skip
  lines = [
    "Milliseconds of CPU time, medians but for one mean. A sheet pressed by a ball that holds "
    "still (in contact) or moves on, with a tool in it that cuts nothing just then, the mean of "
    "all steps while it cuts, what a cut of two edges adds, a step with such a cut, 95 % of these, "
    "and that to a step in contact, and to one in which the ball moves; last: in contact, with "
    "room for cuts to without. " + results.link(path),
    "",
    *plots.table(head, table),
  ]
  return results.Page("What cutting costs a step", finding(rows), lines, [draw(rows, path.parent)])


BENCH = Bench("cut", stages, run, report=report, arguments=arguments)
