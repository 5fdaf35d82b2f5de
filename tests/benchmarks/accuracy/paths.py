"""How near cuts of surfaces follow their path, and what of mass and volume they keep.

    palpate bench paths

`Organ.cut` along curves on a sheet of 15 by 10 cm and on a closed ball of 5 cm radius, through the
whole wall of 2 mm. `off` is how far an edge that came apart is from the path at most, anywhere
along it, and `missed` how far the path is from the nearest of these edges, ends included.
"""

import argparse
import itertools
import math
import pathlib

import mujoco
import numpy as np
import palpate
import scenes
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate.tissue.cutting import path as paths
from palpate.tissue.geometry import mesh as topology
from scipy.spatial import ConvexHull

RADIUS, THICKNESS = 0.05, 2e-3  # [m]
CURVES = {"sheet": ("line", "wave", "circle"), "ball": ("arc", "wave", "circle")}
COLUMNS = ("shape", "curve", "seed", "nodes", "length_mm", "deviation_mm", "off_mm", "missed_mm",
           "mass", "wall", "volume", "pieces")  # fmt: skip


def surface(shape: str, nodes: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns points and triangles of a surface with about so many vertices."""
  if shape == "sheet":
    nx = round(np.sqrt(1.3 * nodes))
    return scenes.triangular(0.15, 0.10, nx, round(nx / 1.3), 0.2, seed)
  k = np.arange(nodes) + 0.5  # evenly along a spiral
  z, turn = 1 - 2 * k / nodes, np.pi * (1 + np.sqrt(5)) * k + seed
  wide = np.sqrt(1 - z * z)
  points = RADIUS * np.stack([wide * np.cos(turn), wide * np.sin(turn), z], axis=1)
  elem = ConvexHull(points).simplices
  inward = (topology.area_vectors(points, elem) * points[elem[:, 0]]).sum(axis=1) < 0
  elem[inward] = elem[inward][:, ::-1]
  return points, elem


def path_of(shape: str, curve: str, seed: int) -> np.ndarray:
  """Returns a curve as dense points (n, 3) [m], somewhat elsewhere for each seed."""
  t = np.linspace(0.0, 1.0, 800)
  random = np.random.RandomState(seed)
  if shape == "sheet":
    start = np.array([0.02, random.uniform(-0.005, 0.005)])
    x = start[0] + 0.11 * t
    round_ = np.stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t)], axis=1)
    flat = {
      "line": np.stack([x, start[1] + random.uniform(-0.03, 0.03) * t], axis=1),
      "wave": np.stack([x, start[1] + 0.02 * np.sin(60 * x)], axis=1),
      "circle": [0.07, start[1]] + 0.025 * round_,
    }[curve]
    return np.column_stack([flat, 0 * t])
  low, turn = {
    "arc": (0.9 + 0 * t, 1.6 * t),
    "wave": (0.7 + 0.25 * np.sin(9 * t), 2.2 * t),
    "circle": (0.5 + 0 * t, 2 * np.pi * t),
  }[curve]
  points = np.stack([np.sin(low) * np.cos(turn), np.sin(low) * np.sin(turn), np.cos(low)], axis=1)
  axes = np.linalg.qr(random.normal(size=(3, 3)))[0]
  return RADIUS * points @ axes


def enclosed(organ) -> float:
  """Returns what the triangles enclose, also where edges came apart [m^3]."""
  x = organ.xpos[organ.elem]
  return float(np.einsum("ij,ij->", x[:, 0], np.cross(x[:, 1], x[:, 2])) / 6)


def measure(shape: str, curve: str, nodes: int, seed: int) -> Row:
  """Returns the row of a cut."""
  spec = mujoco.MjSpec()
  spec.option.gravity = (0, 0, 0)
  palpate.add_organ(spec, surface(shape, nodes, seed), "organ", windows=True, mass=0.05, young=2e5,
                    thickness=THICKNESS, spare="auto", device="cpu")  # fmt: skip
  model, data, organ = scenes.load(spec)
  mujoco.mj_step(model, data)
  points = path_of(shape, curve, seed)
  (before,) = organ.pieces
  had, inside, nvert = organ.mass.sum(), enclosed(organ), organ.nvert
  report = organ.cut(points)
  assert not report.stopped and organ.error is None, organ.error
  share = np.linspace(0.0, 1.0, 9)[:, None, None]
  along = np.concatenate(
    [(line[:-1] + share * np.diff(line, axis=0)).reshape(-1, 3) for line in report.path]
  )
  missed = np.min([paths.distance(line, points)[0] for line in report.path], axis=0)
  now = organ.pieces
  return {
    "shape": shape,
    "curve": curve,
    "seed": seed,
    "nodes": nvert,
    "length_mm": 1e3 * report.length,
    "deviation_mm": 1e3 * report.deviation,
    "off_mm": 1e3 * float(paths.distance(points, along)[0].max()),
    "missed_mm": 1e3 * float(missed.max()),
    "mass": float(organ.mass.sum() / had - 1),
    "wall": sum(piece.volume for piece in now) / before.volume - 1,
    "volume": enclosed(organ) / inside - 1 if shape == "ball" else 0.0,
    "pieces": len(now),
  }


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a surface, size, curve and seed."""
  nodes, seeds = (args.nodes[:1], 1) if args.short else (args.nodes, args.seeds)
  every = [(shape, curve) for shape, curves in CURVES.items() for curve in curves]
  return [
    [
      {"case": f"{shape}-{curve}-{n}-{seed}", "shape": shape, "curve": curve, "n": n, "seed": seed}
      for n, (shape, curve), seed in itertools.product(nodes, every, range(seeds))
    ]
  ]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  return [measure(case["shape"], case["curve"], case["n"], case["seed"])]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.add_argument("--nodes", type=int, nargs="+", default=[1000, 4000])
  parser.add_argument("--seeds", type=int, default=10)


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for low, high in ((0, 2000), (2000, math.inf)):
    mine = [row for row in rows if low <= float(row["nodes"]) < high]
    if mine:
      off = max(float(row["off_mm"]) for row in mine)
      few, many = (pick(int(row["nodes"]) for row in mine) for pick in (min, max))
      lines.append(f"Cuts of organs of {few} to {many} nodes stay within {off:.2g} mm of their "
                   "path.")  # fmt: skip
  if rows:
    mass = max(abs(float(row["mass"])) for row in rows)
    lines.append(f"Mass changes by at most {mass:.1g} of itself, which is rounding.")
  return lines


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page: the worst of all seeds."""
  groups: dict[tuple, list[Row]] = {}
  for row in rows:
    size = 10 ** round(np.log10(float(row["nodes"])) * 4)
    groups.setdefault((row["shape"], row["curve"], size), []).append(row)
  table = []
  for (shape, curve, _), some in groups.items():
    most = {k: max(abs(float(row[k])) for row in some) for k in COLUMNS[4:-1]}
    table.append(
      [shape, curve, str(round(np.mean([float(row["nodes"]) for row in some]))), str(len(some)),
       *(f"{most[k]:.2f}" for k in ("length_mm", "off_mm", "missed_mm")),
       *(f"{most[k]:.1e}" for k in ("mass", "wall", "volume"))]
    )  # fmt: skip
  head = ["surface", "path", "nodes", "cuts", "length [mm]", "off [mm]", "missed [mm]", "mass",
          "volume of the wall", "enclosed"]  # fmt: skip
  lines = [*(__doc__ or "").split("\n\n", 2)[2].splitlines(), ""]
  lines += ["The worst of all cuts; mass and volumes are changes, relative. "
            + results.link(path), "", *plots.table(head, table)]  # fmt: skip
  names = [f"{line[0]}, {line[1]}, {line[2]} nodes" for line in table]
  picture = plots.bars(path.with_suffix(".png"), "How far a cut is from its path at most", names,
                       {"": [float(line[5]) for line in table]}, "[mm]")  # fmt: skip
  title = "How near cuts follow their path"
  return results.Page(title, finding(rows), lines, [picture])


BENCH = Bench("paths", stages, run, COLUMNS, report, arguments)
