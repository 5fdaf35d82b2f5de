"""Counts PCG iterations with block Jacobi and with the multilevel preconditioner.

    python tests/benchmarks/preconditioner.py -o tests/benchmarks/results

The organs are the spheres of `solver.py` and the liver and the stomach of the models, refined by
halving edges (t = 2 mm, 0.1 kg, h = 1 ms), after ten steps under a load at the top, solved from a
cold start. The counts do not depend on the device but for rounding.
"""

import argparse
import csv
import itertools
import pathlib

import numpy as np
import palpate
import trimesh
from palpate import models as _models
from palpate.tissue import elastic, hierarchy, mesh, solver, types
from palpate.tissue import shape as surface
from solver import MASS, PRECONDITIONERS, make, press, sphere

MOST = 1000  # iterations
TOLERANCES = (1e-3, 1e-4)


def organ(name: str, halvings: int) -> mesh.Mesh:
  """Returns an organ of the models with its edges halved so many times."""
  path = pathlib.Path(_models.__file__).parent / name / "assets" / f"{name}.obj"
  shape = trimesh.load(path, process=False)
  vertices, faces = np.asarray(shape.vertices, float), np.asarray(shape.faces)
  for _ in range(halvings):
    vertices, faces = trimesh.remesh.subdivide(vertices, faces)
  return mesh.build(name, vertices, np.asarray(faces))


def count(s: types.Surface, d: types.State) -> dict:
  """Returns the iterations of each preconditioner to each tolerance, one more than MOST if not."""
  coarse, out = s.levels, {}
  elastic.assemble(s, d, elastic.Stage.FIRST)
  solver.multilevel().assemble(s, d)
  for kind, tolerance in itertools.product(PRECONDITIONERS, TOLERANCES):
    s.levels = coarse if kind == "multilevel" else None
    s.tolerance = tolerance
    solver.solve(s, d, elastic.Stage.FIRST)
    iterations, residual = d.status.numpy()[0, :2]
    out[f"{kind}_{tolerance:g}"] = int(iterations) if residual <= tolerance else MOST + 1
  s.levels = coarse
  return out


def main():
  """Runs the benchmark."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  sizes = [642, 2562, 10242, 40962, 163842, 262144]
  parser.add_argument("--nodes", type=int, nargs="*", default=sizes, help="of the spheres")
  parser.add_argument("--young", type=float, nargs="+", default=[3e3, 3e4, 3e6])
  parser.add_argument("--halvings", type=int, nargs="*", default=[0, 1, 2], help="of the organs")
  parser.add_argument("--device", default="cpu")
  parser.add_argument("-o", "--output", type=pathlib.Path)
  args = parser.parse_args()
  print("palpate", palpate.__version__, args.device)
  shapes = [("sphere", n, lambda n=n: sphere(n)) for n in args.nodes]
  for name, k in itertools.product(("liver", "stomach"), args.halvings):
    shapes.append((name, k, lambda name=name, k=k: organ(name, k)))
  build, rows = hierarchy.build, []
  print("| organ | nodes | levels | E [kPa] | bending | condition | block Jacobi | multilevel |")
  print("|---|---|---|---|---|---|---|---|")
  for name, _, make_shape in shapes:
    shape = make_shape()
    coarse = build(shape, surface.COARSEST)
    hierarchy.build = lambda *_, coarse=coarse: coarse  # the same for every stiffness
    for young, bend in itertools.product(args.young, (0.0, 1.0)):
      s, d = make(shape, args.device, young=(young,), bend=bend, iterations=MOST, tolerance=1e-3)
      s.levels.threshold = 0.0
      press(shape, s, d, 10)
      condition = d.step.numpy()[0, 1] / (MASS / s.nvert) * s.levels.rate.numpy()[0, 0]
      row = {"organ": name, "nodes": s.nvert, "levels": s.levels.nlevel, "young": young}
      row |= {"bend": bend, "condition": float(condition)} | count(s, d)
      rows.append(row)
      told = [
        " / ".join(f"{n}" if n <= MOST else f"> {MOST}" for n in numbers)
        for numbers in ([row[f"{kind}_{t:g}"] for t in TOLERANCES] for kind in PRECONDITIONERS)
      ]
      print(
        f"| {name} | {s.nvert} | {s.levels.nlevel} | {young / 1e3:g} | {'yes' if bend else 'no'} | "
        f"{condition:.0f} | {told[0]} | {told[1]} |",
        flush=True,
      )
  if args.output:
    args.output.mkdir(parents=True, exist_ok=True)
    with open(args.output / "preconditioner.csv", "w", newline="") as file:
      writer = csv.DictWriter(file, rows[0])
      writer.writeheader()
      writer.writerows(rows)


if __name__ == "__main__":
  main()
