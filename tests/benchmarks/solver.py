"""Times the implicit step alone, device by device, and checks CUDA against the CPU first.

    python tests/benchmarks/run.py solver --device cuda:0 --nodes 678 16386 65538 262146

Each size is an octahedral sphere of radius 5 cm pressed over a 6 mm patch (E = 30 kPa, t = 2 mm,
0.1 kg, h = 1 ms) and solved from a cold start with each preconditioner; the median of graph replays
is reported. `condition` is what the choice between them goes by, `auto` what it is.
"""

import argparse
import itertools
import pathlib
import time

import numpy as np
import warp as wp
from benchmarks import plots, results
from benchmarks.results import BenchError
from benchmarks.runner import Bench, Case, Row
from palpate.models import grid
from palpate.tissue import config, elastic, levels, mesh, solver, types
from palpate.tissue import shape as surface

H = 1e-3
MASS = 0.1
RADIUS = 0.05
VARIANTS = {
  "membrane": {"bend": 0.0},
  "bending": {},
  "closed": {"bulk": 1e4, "pressure": 50.0, "foundation": 1e4},
  "newton": {"newton": 3},
  "spring": {"elements": "spring", "stiffness": 200.0, "bend": 0.0},
  "stiff": {"young": (3e6,)},
}
PRECONDITIONERS = {"jacobi": np.inf, "multilevel": 0.0}  # condition number to use cycles from


def sphere(nodes: int) -> mesh.Mesh:
  """Returns an octahedral sphere of about `nodes` nodes."""
  made = grid.octasphere(max(2, round(np.sqrt((nodes - 2) / 4))))
  return mesh.build("sphere", np.asarray(made[0]) * RADIUS, np.asarray(made[1]))


def make(
  shape: mesh.Mesh, device: str, scale: float = np.inf, **keys
) -> tuple[types.Surface, types.State]:
  """Returns the constants and a fresh state of an organ of that shape, with coarse meshes."""
  cfg = config.Config(**({"young": (3e4,), "poisson": 0.3, "device": device} | keys))
  pinned = shape.rest[:, 2] < shape.rest[:, 2].min() + 0.05 * np.ptp(shape.rest[:, 2])
  s = surface.make(shape, cfg, pinned, device, scale)
  d = types.make_state(s)
  with wp.ScopedDevice(s.device):
    elastic.calibrate(s, d)
  put(s, d.mass, np.full(len(shape.rest), MASS / len(shape.rest)), padding=1.0)
  d.step.assign(np.array([[H, H * H + H * cfg.damping, 0, 0]], np.float32))
  return s, d


def put(s: types.Surface, array: wp.array, values: np.ndarray, padding=0.0):
  """Writes per-vertex values."""
  vert = s.vert.numpy()
  full = np.full((s.nnode, *values.shape[1:]), padding)
  full[vert >= 0] = values[vert[vert >= 0]]
  array.assign(surface.to_slices(full.astype(np.float32))[None])


def get(s: types.Surface, array: wp.array) -> np.ndarray:
  """Reads per-vertex values."""
  vert = s.vert.numpy()
  out = np.zeros((s.nvert, *array.shape[2:-1]))
  out[vert[vert >= 0]] = surface.from_slices(array.numpy()[0])[vert >= 0]
  return out


def load(shape: mesh.Mesh) -> np.ndarray:
  """Returns 1 N downwards over a patch of 6 mm at the top."""
  patch = np.linalg.norm(shape.rest - shape.rest[np.argmax(shape.rest[:, 2])], axis=1) < 6e-3
  return patch[:, None] * [0.0, 0.0, -1.0] / patch.sum()


def record(s: types.Surface, work) -> wp.Graph:
  """Returns the graph of `work`."""
  with wp.ScopedDevice(s.device), wp.ScopedCapture(device=s.device) as capture:
    work()
  return capture.graph


def agreement(device: str) -> float:
  """Returns the largest relative difference from the CPU over all variants, printing each."""
  shape = sphere(578)
  rng = np.random.RandomState(0)
  u = 5e-4 * rng.standard_normal(shape.rest.shape)
  v = 0.05 * rng.standard_normal(shape.rest.shape)
  worst = 0.0
  for name, keys in VARIANTS.items():
    for kind, threshold in PRECONDITIONERS.items():
      results = []
      for where in ("cpu", device, device):
        s, d = make(shape, where, tolerance=1e-6, iterations=1000, **keys)
        s.levels.threshold = threshold
        put(s, d.pos, u)
        put(s, d.vel, v)
        put(s, d.force_ext, load(shape))
        solver.step(s, d)
        results.append((get(s, d.dvel), d.status.numpy()[0].copy()))
      free = np.linalg.norm(results[0][0])
      difference = np.linalg.norm(results[0][0] - results[1][0]) / free
      repeats = np.array_equal(results[1][0], results[2][0])
      worst = max(worst, difference if repeats else np.inf)
      print(
        f"{name:10s} {kind:10s} difference {difference:.2e}, repeats to the bit: {repeats}, "
        f"iterations {results[0][1][0]:.0f} / {results[1][1][0]:.0f}",
        flush=True,
      )
  return worst


def measure(device: str, nodes: int, tolerance: list[float], bend: float, args) -> list[dict]:
  """Returns the figures of one size, a row for each tolerance and preconditioner."""
  shape = sphere(nodes)
  start = time.perf_counter()
  s, d = make(shape, device, iterations=1000, bend=bend)
  wp.synchronize_device(s.device)
  made = time.perf_counter() - start
  coarse = s.levels
  condition = float(d.step.numpy()[0, 1] / (MASS / s.nvert) * coarse.rate.numpy()[0, 0])
  auto = "multilevel" if bend and condition >= levels.threshold(s.device) else "jacobi"
  coarse.threshold = PRECONDITIONERS["multilevel"]
  press(shape, s, d, 20)
  rows = []
  for limit in tolerance:
    for kind in args.preconditioner:
      s.tolerance = limit
      s.levels = coarse if kind == "multilevel" else None
      row = {"device": device, "nodes": s.nvert, "bend": bend, "tolerance": limit}
      row |= {"preconditioner": kind}
      row |= timed(s, d, args.repeat)
      row |= {"condition": condition, "auto": auto, "make_s": made, "bytes_a_node": size(s, d)}
      rows.append(row)
  return rows


def press(shape: mesh.Mesh, s: types.Surface, d: types.State, steps: int):
  """Moves the organ some steps under `load`."""
  put(s, d.force_ext, load(shape))
  graph = record(s, lambda: solver.step(s, d))
  u, v = np.zeros_like(shape.rest), np.zeros_like(shape.rest)
  for _ in range(steps):
    wp.capture_launch(graph)
    v += get(s, d.dvel)
    u += H * v
    put(s, d.pos, u)
    put(s, d.vel, v)


def timed(s: types.Surface, d: types.State, repeat: int) -> dict:
  """Returns medians of a step, its assembly and its solve in ms, iterations and residual."""

  def assemble():
    elastic.assemble(s, d, elastic.Stage.FIRST)
    if s.levels is not None:
      solver.multilevel().assemble(s, d)

  parts = {
    "step": record(s, lambda: solver.step(s, d)),
    "assemble": record(s, assemble),
    "solve": record(s, lambda: solver.solve(s, d, elastic.Stage.FIRST)),
  }
  times = {name: [] for name in parts}
  for _ in range(repeat):
    for name, part in parts.items():
      wp.synchronize_device(s.device)
      start = time.perf_counter()
      wp.capture_launch(part)
      wp.synchronize_device(s.device)
      times[name].append(time.perf_counter() - start)
  status = d.status.numpy()[0]
  out = {f"{name}_ms": 1e3 * float(np.median(values)) for name, values in times.items()}
  return out | {"iterations": int(status[0]), "residual": float(status[1])}


def size(s: types.Surface, d: types.State) -> int:
  """Returns the bytes a node of all arrays, those of the coarse meshes where they are in use."""
  parts = [s, d]
  if s.levels is not None:
    parts += [s.levels, s.levels.surface, d.coarse]
  arrays = {id(a): a for x in parts for a in vars(x).values() if isinstance(a, wp.array)}
  if s.levels is None:
    for unused in (d.e, d.en, d.t):
      arrays.pop(id(unused))
  return round(sum(a.size * 4 for a in arrays.values()) / s.nvert)


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


def begin(args: argparse.Namespace):
  """Checks the device against the CPU."""
  if args.device != "cpu" and agreement(args.device) > 1e-4:
    raise BenchError(f"{args.device} disagrees with the CPU", code=1)


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the rows of a size."""
  args = argparse.Namespace(**case)
  return measure(args.device, args.nodes, args.tolerance, args.bend, args)


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page, of the device that there are results of."""
  path = out / f"solver_{str(rows[0]['device']).partition(':')[0]}.csv"
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
  name = "solver.md" if path.stem == "solver_cuda" else f"{path.stem}.md"
  return [results.page(out / name, "The organ's step alone", about, lines)]


BENCH = Bench("solver", stages, run, report=report, arguments=arguments, begin=begin,
              file="solver_{device}")  # fmt: skip
