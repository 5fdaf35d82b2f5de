"""Asks what a solve would gain by leaving out the nodes whose residual is under the tolerance.

The loop's scene (`loop.py`: a probe presses a windowed sphere, slides and stays) is stepped; at
some steps the linear system is read back and solved in float64 from the warm start, once on all
nodes and once on the fewest nodes that carry all but half of the tolerance, grown by rings of
neighbours to whole slices of eight, and enlarged where the residual on all nodes is still above the
tolerance (the bound on the error: both stop by the same rule on all nodes). The best number of
rings is taken and only products are counted: the gain is an upper bound.
"""

import argparse
import itertools
import pathlib

import mujoco
import numpy as np
import palpate
import scenes
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from benchmarks.timing import loop
from palpate.tissue.body import Body
from palpate.tissue.order import from_slices
from scipy import sparse

RINGS = (1, 2, 4, 8, 16, 32)


def system(body: Body) -> tuple[sparse.csr_array, sparse.csr_array, np.ndarray, np.ndarray]:
  """Returns A, the inverse of its diagonal blocks, b and the warm start of the last solve."""
  s, d = body.shape, body.system
  n, slot, fan = s.nnode, s.slot_adr.numpy(), s.fan_node.numpy()
  slices = np.repeat(np.arange(s.nslice), np.diff(slot))
  offset = fan[np.arange(slot[-1]) + 2 * slices + 1]
  col = offset // 24 * 8 + offset % 24
  row = 8 * slices[:, None] + np.arange(8)
  block = np.moveaxis(d.block.numpy()[0].astype(float), 1, -1).reshape(-1, 3, 3)
  row, col = row.ravel(), col.ravel()
  diag = from_slices(d.diag.numpy()[0])[:, None, None] * np.eye(3)
  np.subtract.at(diag, row, block)
  blocks = np.concatenate([block, diag])
  at = np.stack([np.concatenate([row, np.arange(n)]), np.concatenate([col, np.arange(n)])])
  within = np.stack(np.meshgrid(np.arange(3), np.arange(3), indexing="ij"))
  index = 3 * at[:, :, None, None] + within[:, None]
  a = sparse.coo_array((blocks.ravel(), index.reshape(2, -1)), shape=(3 * n, 3 * n)).tocsr()
  if body.has_bending:
    adr, value = s.bend_adr.numpy(), body.tissue.bend_gain.numpy().astype(float)
    row = 8 * np.repeat(np.arange(s.nslice), np.diff(adr))[:, None] + np.arange(8)
    q = sparse.coo_array((value.ravel(), (row.ravel(), s.bend_node.numpy().ravel())), shape=(n, n))
    normal = from_slices(d.normal.numpy()[0]).astype(float)
    at = np.repeat(np.arange(n), 3)
    lift = sparse.csr_array((normal.ravel(), (np.arange(3 * n), at)), shape=(3 * n, n))
    a = a + float(body.state.step.numpy()[0, 1]) * (lift @ q.tocsr() @ lift.T)
  free = np.repeat(from_slices(s.free.numpy()), 3).astype(float)
  keep = sparse.diags_array(free)
  inverse = from_slices(d.inverse.numpy()[0])[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]].astype(float)
  jacobi = sparse.bsr_array((inverse, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))
  b, warm = (free * from_slices(x.numpy()[0]).ravel() for x in (d.rhs, body.state.dvel_warm))
  return (keep @ a @ keep).tocsr(), jacobi.tocsr(), b, warm


def pcg(a, jacobi, b, x, target, mask=1.0) -> tuple[np.ndarray, int]:
  """Returns the solution with r^T D^-1 r under `target` on the nodes of `mask`; iterations."""
  r = mask * (b - a @ x)
  z = jacobi @ r
  p, rz, count = z, r @ z, 0
  while rz > target and count < 1000:
    q = mask * (a @ p)
    alpha = rz / (p @ q)
    x, r = x + alpha * p, r - alpha * q
    z = jacobi @ r
    before, rz = rz, r @ z
    p, count = z + rz / before * p, count + 1
  return x, count


def carriers(energy: np.ndarray, rest: float) -> np.ndarray:
  """Returns a mask of the fewest nodes without which no more than `rest` of the sum is left."""
  order = np.argsort(energy)
  mask = np.ones(len(energy))
  mask[order[np.cumsum(energy[order]) <= rest]] = 0
  return mask


def study(body: Body, tolerance: float) -> dict:
  """Returns the figures of one step."""
  a, jacobi, b, warm = system(body)
  norm = b @ (jacobi @ b)
  target = tolerance**2 * norm
  curved = warm @ (a @ warm)
  warm = warm * ((warm @ b) / curved if curved > 0 else 0.0)
  graph = sparse.coo_array(abs(a))
  edges = (graph.row // 3, graph.col // 3)
  graph = sparse.csr_array((np.ones(graph.nnz), edges), shape=(body.shape.nnode, body.shape.nnode))

  def energy(x):
    r = b - a @ x
    return (r * (jacobi @ r)).reshape(-1, 3).sum(axis=1)

  start = energy(warm)
  _, whole = pcg(a, jacobi, b, warm, target)
  best, share = np.inf, 1.0
  for rings in RINGS:
    active, x, cost = np.zeros(len(start)), warm, 0.0
    for _ in range(5):
      left = energy(x)
      if left.sum() <= target:
        break
      more = carriers(left, 0.25 * target)
      for _ in range(rings):
        more = np.minimum(graph @ more, 1.0)
      active = np.maximum(active, np.repeat(more.reshape(-1, 8).max(axis=1), 8))
      x, count = pcg(a, jacobi, b, x, 0.25 * target, np.repeat(active, 3))
      cost += count * active.sum() / body.shape.nvert + 1
    if energy(x).sum() <= target and cost < best:
      best, share = cost, active.sum() / body.shape.nvert
  return {
    "warm_residual": float(np.sqrt(start.sum() / norm)),
    "carriers": carriers(start, 0.25 * target).sum() / body.shape.nvert,
    "iterations": whole,
    "active": share,
    "active_cost": best,
  }


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--nodes", type=int, nargs="+", default=[642, 2562, 10242])
  add("--tolerance", type=float, nargs="+", default=[1e-3, 1e-4])
  add("--steps", type=int, default=200)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a size, bending and tolerance."""
  nodes = args.nodes[:1] if args.short else args.nodes
  return [
    [
      {"case": f"{n}-{bend:g}-{limit:g}", "nodes": n, "bend": bend, "tolerance": limit}
      | {"steps": args.steps}
      for n, bend, limit in itertools.product(nodes, (0.0, 1.0), args.tolerance)
    ]
  ]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case, medians over the steps that were looked at."""
  steps, tolerance = case["steps"], case["tolerance"]
  m = loop.model(case["nodes"], "cpu", tolerance, case["bend"], 64, 3, 0.0025)
  d = mujoco.MjData(m)
  w = scenes.workspace(palpate.Organ(m, d, "organ"))
  found = []
  for step in range(steps):
    d.ctrl[0] = -0.0015 * min(1.0, step / (0.3 * steps))
    d.ctrl[1] = 0.002 * max(0.0, min(step / steps, 0.7) - 0.4)
    mujoco.mj_step(m, d)
    if step % (steps // 8) == steps // 8 - 1 and w.seen.status[0] > 0:
      found.append(study(w.body, tolerance))
  row = {"nodes": w.body.shape.nvert, "bend": case["bend"], "tolerance": tolerance}
  row |= {key: float(np.median([each[key] for each in found])) for key in found[0]}
  return [row | {"gain": 1 - row["active_cost"] / row["iterations"]}]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  good = [r for r in rows if r["gain"] > 0]
  best = max(rows, key=lambda r: r["gain"])
  return [
    f"Solving on a part of the nodes alone saves products in {len(good)} of {len(rows)} cases.",
    f"It saves most, {best['gain']:.0%}, with {best['nodes']} nodes and a tolerance of "
    f"{best['tolerance']:g}.",
    "So the solver always solves on all nodes.",
  ]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  table = [
    [r["nodes"], r["bend"], r["tolerance"], float(r["warm_residual"]), f"{r['carriers']:.0%}",
     r["iterations"], f"{r['active']:.0%}", float(r["active_cost"]), f"{r['gain']:+.0%}"]
    for r in rows
  ]  # fmt: skip
  head = ["nodes", "bend", "tolerance", "warm residual", "its carriers", "iterations", "active"]
  lines = [str(__doc__).partition("\n\n")[2], "", *plots.table([*head, "cost", "gain"], table)]
  title = "What leaving out nodes would gain"
  return [results.page(out / "locality.md", title, about, lines, finding(rows))]


BENCH = Bench("locality", stages, run, report=report, arguments=arguments,
              folder="development")  # fmt: skip
