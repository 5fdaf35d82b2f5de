"""Times the implicit step alone, device by device, and checks CUDA against the CPU first.

    python tests/benchmarks/solver.py --device cuda:0 --nodes 16384 65536 -o results

Each size is an octahedral sphere of radius 5 cm pressed over a 6 mm patch (E = 30 kPa, t = 2 mm,
0.1 kg, h = 1 ms) and solved from a cold start; the median of graph replays is reported.
"""

import argparse
import csv
import pathlib
import sys
import time

import numpy as np
import palpate
import warp as wp
from palpate import config, elastic, mesh, solver, surface, types
from palpate.models import grid

H = 1e-3
MASS = 0.1
RADIUS = 0.05
VARIANTS = {
  "membrane": {"bend": 0.0},
  "bending": {},
  "closed": {"bulk": 1e4, "pressure": 50.0, "foundation": 1e4},
  "newton": {"newton": 3},
  "spring": {"elements": "spring", "stiffness": 200.0, "bend": 0.0},
}


def sphere(nodes: int) -> mesh.Mesh:
  """Returns an octahedral sphere of about `nodes` nodes."""
  made = grid.octasphere(max(2, round(np.sqrt((nodes - 2) / 4))))
  return mesh.build("sphere", np.asarray(made[0]) * RADIUS, np.asarray(made[1]))


def make(shape: mesh.Mesh, device: str, **keys) -> tuple[types.Surface, types.State]:
  """Returns the constants and a fresh state of an organ of that shape."""
  cfg = config.Config(young=(3e4,), poisson=0.3, device=device, **keys)
  pinned = shape.rest[:, 2] < -0.9 * RADIUS
  s = surface.make(shape, cfg, pinned, device)
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
    results = []
    for where in ("cpu", device, device):
      s, d = make(shape, where, tolerance=1e-6, iterations=500, **keys)
      put(s, d.pos, u)
      put(s, d.vel, v)
      put(s, d.force_ext, load(shape))
      solver.step(s, d)
      results.append((get(s, d.dvel), d.status.numpy()[0]))
    free = np.linalg.norm(results[0][0])
    difference = np.linalg.norm(results[0][0] - results[1][0]) / free
    repeats = np.array_equal(results[1][0], results[2][0])
    worst = max(worst, difference if repeats else np.inf)
    print(
      f"{name:10s} difference {difference:.2e}, repeats to the bit: {repeats}, "
      f"iterations {results[0][1][0]:.0f} / {results[1][1][0]:.0f}"
    )
  return worst


def measure(device: str, nodes: int, tolerance: float, bend: float, repeat: int) -> dict:
  """Returns the figures of one size."""
  shape = sphere(nodes)
  start = time.perf_counter()
  s, d = make(shape, device, tolerance=tolerance, iterations=1000, bend=bend)
  wp.synchronize_device(s.device)
  made = time.perf_counter() - start
  put(s, d.force_ext, load(shape))
  graph = record(s, lambda: solver.step(s, d))
  u, v = np.zeros_like(shape.rest), np.zeros_like(shape.rest)
  for _ in range(20):  # a pressed state
    wp.capture_launch(graph)
    v += get(s, d.dvel)
    u += H * v
    put(s, d.pos, u)
    put(s, d.vel, v)
  parts = {
    "step": graph,
    "assemble": record(s, lambda: elastic.assemble(s, d, elastic.Stage.FIRST)),
    "solve": record(s, lambda: solver.solve(s, d, first=True)),
  }
  row = {"device": device, "nodes": len(shape.rest), "bend": bend, "tolerance": tolerance}
  times = {name: [] for name in parts}
  for _ in range(repeat):
    for name, part in parts.items():
      wp.synchronize_device(s.device)
      start = time.perf_counter()
      wp.capture_launch(part)
      wp.synchronize_device(s.device)
      times[name].append(time.perf_counter() - start)
  row |= {f"{name}_ms": 1e3 * float(np.median(values)) for name, values in times.items()}
  status = d.status.numpy()[0]
  row |= {"iterations": int(status[0]), "residual": float(status[1]), "make_s": made}
  size = sum(
    a.size * 4 for x in (s, d) for a in vars(x).values() if isinstance(a, wp.array)
  )
  return row | {"bytes_a_node": round(size / len(shape.rest))}


def main():
  """Runs the benchmark."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--device", default="cpu")
  parser.add_argument("--nodes", type=int, nargs="+", default=[642, 2562, 10242])
  parser.add_argument("--tolerance", type=float, nargs="+", default=[1e-4])
  parser.add_argument("--repeat", type=int, default=50)
  parser.add_argument("-o", "--output", type=pathlib.Path)
  args = parser.parse_args()
  print(f"palpate {palpate.__version__}, warp {wp.__version__}, {wp.get_device(args.device).name}")
  if args.device != "cpu" and agreement(args.device) > 1e-4:
    sys.exit(f"{args.device} disagrees with the CPU")
  rows = []
  for nodes in args.nodes:
    for bend in (0.0, 1.0):
      for tolerance in args.tolerance:
        rows.append(measure(args.device, nodes, tolerance, bend, args.repeat))
        print({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in rows[-1].items()})
  if args.output:
    args.output.mkdir(parents=True, exist_ok=True)
    path = args.output / f"solver_{args.device.split(':')[0]}.csv"
    with open(path, "w", newline="") as file:
      writer = csv.DictWriter(file, rows[0])
      writer.writeheader()
      writer.writerows(rows)
    print(path)


if __name__ == "__main__":
  main()
