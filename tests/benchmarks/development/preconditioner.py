"""Counts PCG iterations with block Jacobi and with the multilevel preconditioner.

    palpate bench preconditioner

The organs are the spheres of `solver.py` and the liver and the stomach of the models, refined by
halving edges (t = 2 mm, 0.1 kg, h = 1 ms), after ten steps under a load at the top, solved from a
cold start. The counts do not depend on the device but for rounding.
"""

import argparse
import itertools
import pathlib

import numpy as np
import trimesh
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from benchmarks.timing.solver import PRECONDITIONERS, condition, limit, make, press, sphere
from palpate import models as _models
from palpate.tissue import coarse as coarsening
from palpate.tissue import step as stepping
from palpate.tissue.body import Body
from palpate.tissue.geometry import mesh
from palpate.tissue.types import Stage

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


def count(body: Body) -> dict:
  """Returns the iterations of each preconditioner to each tolerance, one more than MOST if not."""
  levels, out = body.levels, {}
  stepping.assemble(body, Stage.FIRST)
  for kind, tolerance in itertools.product(PRECONDITIONERS, TOLERANCES):
    body.levels = levels if kind == "multilevel" else None
    limit(body, tolerance)
    stepping.solve(body, Stage.FIRST)
    iterations, residual = body.system.status.numpy()[0, :2]
    out[f"{kind}_{tolerance:g}"] = int(iterations) if residual <= tolerance else MOST + 1
  body.levels = levels
  return out


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  sizes = [642, 2562, 10242, 40962, 163842, 262144]
  add("--nodes", type=int, nargs="*", default=sizes, help="of the spheres")
  add("--young", type=float, nargs="+", default=[3e3, 3e4, 3e6])
  add("--halvings", type=int, nargs="*", default=[0, 1, 2], help="of the organs")
  add("--device", default="cpu")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a mesh."""
  meshes = [("sphere", n) for n in (args.nodes[:1] if args.short else args.nodes)]
  if not args.short:
    meshes += itertools.product(("liver", "stomach"), args.halvings)
  keys = {"young": args.young, "device": args.device}
  return [[{"case": f"{name}-{size}", "name": name, "size": size} | keys for name, size in meshes]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns a row a stiffness and bending."""
  name, build, rows = case["name"], coarsening.build, []
  shape = sphere(case["size"]) if name == "sphere" else organ(name, case["size"])
  coarse = build(shape)
  coarsening.build = lambda *_: coarse  # the same for every stiffness
  try:
    for young, bend in itertools.product(case["young"], (0.0, 1.0)):
      keys = {"young": (young,), "bend": bend, "iterations": MOST, "tolerance": 1e-3}
      body = make(shape, case["device"], **keys)
      transfer = body.levels.transfer
      transfer.threshold = 0.0
      press(shape, body, 10)
      row = {"organ": name, "nodes": shape.nvert, "levels": transfer.nlevel, "young": young}
      rows.append(row | {"bend": bend, "condition": condition(body)} | count(body))
  finally:
    coarsening.build = build
  return rows


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  ratios = {
    (r["organ"], r["nodes"], r["young"], r["bend"]): r["jacobi_0.0001"] / r["multilevel_0.0001"]
    for r in rows
  }
  pays = sum(ratio > 10 for ratio in ratios.values())
  most = max(ratios, key=lambda key: ratios[key])
  return [
    f"Block Jacobi takes {min(ratios.values()):.2g} to {ratios[most]:.2g} times as many iterations "
    "as multilevel cycles, to 1e-4.",
    f"A cycle costs eight products and more: it pays in {pays} of {len(ratios)} cases, where the "
    "ratio is above 10.",
    f"The ratio is largest for {most[0]}, {most[1]} nodes, {most[2] / 1e3:g} kPa.",
  ]


def draw(rows: list[Row], out: pathlib.Path) -> pathlib.Path:
  """Draws iterations over nodes, on the first organ."""
  panels: dict = {}
  for young, bend in sorted({(r["young"], r["bend"]) for r in rows}):
    mine = [
      r for r in rows if (r["organ"], r["young"], r["bend"]) == (rows[0]["organ"], young, bend)
    ]
    mine.sort(key=lambda r: r["nodes"])
    if bend or all(not r["bend"] for r in rows):
      panels[f"{rows[0]['organ']}, {young / 1e3:g} kPa{', bending' * bool(bend)}"] = {
        kind: ([r["nodes"] for r in mine], [r[f"{kind}_0.0001"] for r in mine])
        for kind in PRECONDITIONERS
      }
  return plots.curves(out / "preconditioner.png", "To a residual of 1e-4", panels, "nodes",
                      "iterations")  # fmt: skip


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  kinds = sorted({(row["young"], row["bend"]) for row in rows})
  head = [f"{young / 1e3:g} kPa{', bending' if bend else ''}" for young, bend in kinds]
  cells: dict[tuple, dict] = {}
  for row in rows:
    told = [
      " / ".join(f"{n}" if n <= MOST else f"> {MOST}" for n in numbers)
      for numbers in ([row[f"{kind}_{t:g}"] for t in TOLERANCES] for kind in PRECONDITIONERS)
    ]
    mesh = cells.setdefault((row["organ"], row["nodes"]), {})
    mesh[row["young"], row["bend"]] = "; ".join(told)
  table = [
    [f"{organ}, {nodes}", *(found.get(kind, "") for kind in kinds)]
    for (organ, nodes), found in cells.items()
  ]
  lines = [
    f"PCG iterations to {' / '.join(f'{t:g}' for t in TOLERANCES)} with block Jacobi; then with "
    "the multilevel cycle. A sphere of 5 cm and two organs, t = 2 mm, 0.1 kg, h = 1 ms, ten steps "
    "into a load of 1 N on 6 mm, from a cold start. " + results.link(out / "preconditioner.csv"),
    "",
    *plots.table(["organ, nodes", *head], table),
  ]
  title = "Iterations with each preconditioner"
  picture = draw(rows, out)
  page = out / "preconditioner.md"
  return [picture, results.page(page, title, about, lines, finding(rows), picture)]


BENCH = Bench("preconditioner", stages, run, report=report, arguments=arguments,
              folder="development")  # fmt: skip
