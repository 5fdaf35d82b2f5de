"""Times the implicit step alone, device by device.

    palpate bench solver --device cuda:0 --nodes 678 16386 65538 262146

Each size is an octahedral sphere of radius 5 cm pressed over a 6 mm patch (E = 30 kPa, t = 2 mm,
0.1 kg, h = 1 ms) and solved from a cold start with each preconditioner; the median of graph replays
is reported. `condition` is what the choice between them goes by, `auto` what it is.
"""

import argparse
import itertools
import pathlib
import time

import numpy as np
import scenes
import warp as wp
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate.models.meshing import grid
from palpate.tissue import body as bodies
from palpate.tissue import coarse, config
from palpate.tissue import shape as making
from palpate.tissue import step as stepping
from palpate.tissue.body import Body
from palpate.tissue.geometry import mesh
from palpate.tissue.types import NUMBERS, Stage

H = 1e-3
MASS = 0.1
RADIUS = 0.05
PRECONDITIONERS = {"jacobi": np.inf, "multilevel": 0.0}  # condition number to use cycles from


def sphere(nodes: int) -> mesh.Mesh:
  """Returns an octahedral sphere of about `nodes` nodes."""
  made = grid.octasphere(max(2, round(np.sqrt((nodes - 2) / 4))))
  return mesh.build("sphere", np.asarray(made[0]) * RADIUS, np.asarray(made[1]))


def make(shape: mesh.Mesh, device: str, scale: float = np.inf, **keys) -> Body:
  """Returns the body of an organ of that shape, with coarse meshes."""
  cfg = config.Config(**({"young": (3e4,), "poisson": 0.3, "device": device} | keys))
  pinned = shape.rest[:, 2] < shape.rest[:, 2].min() + 0.05 * np.ptp(shape.rest[:, 2])
  body = making.make(shape, cfg, pinned, device, scale)
  scenes.put(body, body.state.mass, MASS / shape.nvert)
  body.state.step.assign(np.array([[H, H * H + H * cfg.damping, 0, 0]], np.float32))
  return body


def limit(body: Body, tolerance: float):
  """Sets the tolerance."""
  numbers = dict(zip(NUMBERS, body.numbers.numpy(), strict=True))
  bodies.renumber(body, numbers | {"tolerance": tolerance})


def load(shape: mesh.Mesh) -> np.ndarray:
  """Returns 1 N downwards over a patch of 6 mm at the top."""
  patch = np.linalg.norm(shape.rest - shape.rest[np.argmax(shape.rest[:, 2])], axis=1) < 6e-3
  return patch[:, None] * [0.0, 0.0, -1.0] / patch.sum()


def record(body: Body, work) -> wp.Graph:
  """Returns the graph of `work`."""
  with wp.ScopedDevice(body.device), wp.ScopedCapture(device=body.device) as capture:
    work()
  return capture.graph


def measure(device: str, nodes: int, tolerance: list[float], bend: float, args) -> list[dict]:
  """Returns the figures of one size, a row for each tolerance and preconditioner."""
  shape = sphere(nodes)
  start = time.perf_counter()
  body = make(shape, device, iterations=1000, bend=bend)
  wp.synchronize_device(body.device)
  made = time.perf_counter() - start
  auto = "multilevel" if bend and condition(body) >= coarse.threshold(body.device) else "jacobi"
  levels = body.levels
  levels.transfer.threshold = PRECONDITIONERS["multilevel"]
  press(shape, body, 20)
  rows = []
  for least in tolerance:
    for kind in args.preconditioner:
      limit(body, least)
      body.levels = levels if kind == "multilevel" else None
      row = {"device": device, "nodes": shape.nvert, "bend": bend, "tolerance": least}
      row |= {"preconditioner": kind}
      row |= timed(body, args.repeat)
      body.levels = levels
      row |= {"condition": condition(body), "auto": auto, "make_s": made}
      rows.append(row | {"bytes_a_node": size(body, kind == "multilevel")})
  return rows


def condition(body: Body) -> float:
  """Returns the condition number that the choice of a preconditioner goes by."""
  stiffness = body.levels.transfer.rate.numpy()[0, 0]
  return float(body.state.step.numpy()[0, 1] / (MASS / body.shape.nvert) * stiffness)


def press(shape: mesh.Mesh, body: Body, steps: int):
  """Moves the organ some steps under `load`."""
  state = body.state
  scenes.put(body, state.force_ext, load(shape))
  graph = record(body, lambda: stepping.step(body))
  u, v = np.zeros_like(shape.rest), np.zeros_like(shape.rest)
  for _ in range(steps):
    wp.capture_launch(graph)
    v += scenes.get(body, state.dvel)
    u += H * v
    scenes.put(body, state.disp, u)
    scenes.put(body, state.vel, v)


def timed(body: Body, repeat: int) -> dict:
  """Returns medians of a step, its assembly and its solve in ms, iterations and residual."""
  parts = {
    "step": record(body, lambda: stepping.step(body)),
    "assemble": record(body, lambda: stepping.assemble(body, Stage.FIRST)),
    "solve": record(body, lambda: stepping.solve(body, Stage.FIRST)),
  }
  times = {name: [] for name in parts}
  for _ in range(repeat):
    for name, part in parts.items():
      wp.synchronize_device(body.device)
      start = time.perf_counter()
      wp.capture_launch(part)
      wp.synchronize_device(body.device)
      times[name].append(time.perf_counter() - start)
  status = body.system.status.numpy()[0]
  out = {f"{name}_ms": 1e3 * float(np.median(values)) for name, values in times.items()}
  return out | {"iterations": int(status[0]), "residual": float(status[1])}


def size(body: Body, cycles: bool) -> int:
  """Returns the bytes a node of all arrays, those of the coarse meshes where they are in use."""
  unused = set() if cycles else {"e", "en", "t"}
  structs = [body.shape, body.tissue, body.state, body.system]
  if cycles:
    below = body.levels.body
    structs += [body.levels.transfer, below.shape, below.tissue, below.state, below.system]
  arrays = {}
  for each in structs:
    for name in each._cls.vars:
      value = getattr(each, name)
      if isinstance(value, wp.array) and name not in unused:
        arrays[value.ptr] = value.size * 4
  return round(sum(arrays.values()) / body.shape.nvert)


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--device", default="cpu", help="cpu or cuda:0 (%(default)s)")
  add("--nodes", type=int, nargs="+", default=[642, 2562, 10242])
  add("--tolerance", type=float, nargs="+", default=[1e-4])
  add("--repeat", type=int, default=50)
  add("--bend", type=float, nargs="+", default=[0.0, 1.0])
  add("--preconditioner", nargs="+", choices=PRECONDITIONERS, default=list(PRECONDITIONERS))


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a size and bending."""
  keys = {k: getattr(args, k) for k in ("device", "tolerance", "repeat", "preconditioner")}
  nodes = args.nodes[:1] if args.short else args.nodes
  return [
    [
      {"case": f"{n}-{bend:g}", "nodes": n, "bend": bend} | keys
      for n, bend in itertools.product(nodes, args.bend)
    ]
  ]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the rows of a size."""
  args = argparse.Namespace(**case)
  return measure(args.device, args.nodes, args.tolerance, args.bend, args)


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for bend in (0, 1):
    mine = sorted((r for r in rows if r["bend"] == bend and r["auto"] == r["preconditioner"]),
                  key=lambda r: r["nodes"])  # fmt: skip
    if mine:
      told = [f"{r['step_ms']:.2g} ms ({r['nodes']} nodes)" for r in (mine[0], mine[-1])]
      name = "with" if bend else "without"
      lines.append(f"A step from a cold start {name} bending takes {' to '.join(told)}.")
  chosen = [r["nodes"] for r in rows if r["auto"] == r["preconditioner"] == "multilevel"]
  if chosen:
    lines.append(f"The plugin takes the multilevel preconditioner from {min(chosen)} nodes on.")
  return lines


def draw(rows: list[Row], path: pathlib.Path) -> pathlib.Path:
  """Draws the step over the number of nodes."""
  panels: dict = {}
  for r in sorted(rows, key=lambda r: r["nodes"]):
    panel = panels.setdefault(f"bending {'on' if r['bend'] else 'off'}", {})
    x, y = panel.setdefault(r["preconditioner"], ([], []))
    x.append(r["nodes"])
    y.append(r["step_ms"])
  return plots.curves(path, "The organ's step alone", panels, "nodes", "step [ms]")


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page."""
  lines = [
    "A sphere of 5 cm pressed over 6 mm, E = 30 kPa, t = 2 mm, 0.1 kg, h = 1 ms, from a cold "
    "start; medians of graph replays. A star marks the preconditioner that the plugin takes by "
    "itself. " + results.link(path),
    "",
  ]
  table = []
  for row in rows:
    count = row["iterations"] if row["residual"] <= row["tolerance"] else f"> {row['iterations']}"
    table.append([row["nodes"], "on" if row["bend"] else "off", f"{row['tolerance']:g}",
                  row["preconditioner"], "*" if row["auto"] == row["preconditioner"] else "",
                  *(f"{row[k]:.3g} ms" for k in ("step_ms", "assemble_ms", "solve_ms")),
                  count, row["bytes_a_node"]])  # fmt: skip
  head = ["nodes", "bending", "tolerance", "preconditioner", "chosen", "step", "assemble", "solve"]
  lines += plots.table([*head, "iterations", "bytes a node"], table)
  name = path.stem.removesuffix("_cuda")
  pictures = [draw(rows, path.with_name(f"{name}.png"))]
  return results.Page("The organ's step alone", finding(rows), lines, pictures, name)


BENCH = Bench("solver", stages, run, report=report, arguments=arguments,
              file="solver_{device}")  # fmt: skip
