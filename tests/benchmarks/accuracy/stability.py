"""Where each scheme breaks, over a thousand runs and more.

Each run presses an organ (or starts it from a wild state), lets it go and is judged: finite, energy
not growing without input, penetration bounded, back to rest. Others let a solid lie, stand or be
pressed flat, and watch whether its force comes to rest.
"""

from __future__ import annotations

import argparse
import math
import pathlib
import time
from collections.abc import Iterator

import numpy as np
import scenes
from benchmarks import plots, results, runner, scene
from benchmarks.accuracy.judge import CHATTER, DEPTH, FAILURES, JUDGEMENT, STEPS, VERDICTS
from benchmarks.accuracy.judge import run as judged
from benchmarks.runner import Bench, Case, Row
from scenes.resting import LYING, PRESSED

H = (5e-4, 1e-3, 2e-3, 3e-3, 5e-3, 8e-3, 12.5e-3, 2e-2)  # [s]
YOUNG = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7)  # [Pa]
NODES = (162, 642, 2562, 10242)
# What is run side by side: scheme and coupling by name.
SIDES = {
  "implicit": ("implicit", "nodal"),
  "implicit, window": ("implicit", "window"),
  "midpoint": ("midpoint", "nodal"),
  "neumann": ("neumann", "nodal"),
  "explicit": ("explicit", "nodal"),
  "MuJoCo flex": (scene.NATIVE, "nodal"),
}
# Solids on the map, with a window, and what they are made of.
SOLIDS = {
  f"solid, nu {nu:g}": {"elements": "solid", "poisson": nu, "mass": 0.5} for nu in (0.3, 0.45, 0.49)
}
SIDES |= dict.fromkeys(SOLIDS, ("implicit", "window"))
# Sides that meet something flat, by what `scenes.resting` calls them.
FLAT = {"solid": "nodal", "solid, window": "window", "MuJoCo flex": "flex"}
QUIET = 2e-3  # speed of the fastest node of what rests [m/s]
STARTS = ("flattened", "crushed", "folded", "inverted", "scattered")
DRAWS = 1000
BLOCK = 40  # draws that are run together, the slow ones first
# Span of each factor of the hypercube, drawn evenly on a logarithmic scale.
SPANS = {
  "h": (5e-4, 2e-2),
  "young": (1e2, 1e7),
  "thickness": (5e-4, 1e-2),
  "damping": (1e-4, 1e-2),
  "mass": (1e-3, 1e1),
  "speed": (2e-2, 2.0),
  "share": (0.1, 10.0),  # foundation over young thickness / RADIUS^2
}
USUAL = {
  "thickness": 2e-3,
  "damping": 2e-3,
  "mass": 0.1,
  "speed": 0.1,
  "share": 4.0,
  "bulk": 0.0,
  "shape": "sphere",
  "start": "rest",
  "nodes": 642,
}
_COLUMNS = (
  *("side", "set", "scheme", "coupling", "shape", "start", "nodes", "h", "young", "thickness"),
  *("damping", "mass", "foundation", "bulk", "speed", "stiff", "verdict", "steps"),
  *("simulated_s", "wall_s"),
  *("growth", "excess", "penetration_mm", "sunk_mm", "chatter", "left"),
  *("force_N", "overflow", "iterations", "residual", "std", "speed_mm_s"),
)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns the cases: maps of h and E for every side, wild starts, slivers and a hypercube.

  The hypercube comes in blocks of draws: where time runs out, the draws so far cover all of it.
  """
  maps, starts, cube = [], [], []
  small = 162 if args.short else 642
  for side in ("implicit", "MuJoCo flex", "solid, nu 0.49") if args.short else SIDES:
    for h in H[1::3] if args.short else H:
      for young in YOUNG[1::3] if args.short else YOUNG:
        if args.short and side in SOLIDS and (h, young) != (H[4], YOUNG[1]):
          continue
        what = {"nodes": small} | SOLIDS.get(side, {})
        maps.append(USUAL | _of("map", side, h=h, young=young) | what)
  for start in ("flattened", "scattered") if args.short else (*STARTS, "sliver"):
    for shape in scene.SHAPES[:1] if args.short or start == "sliver" else scene.SHAPES:
      for h in (2e-3,) if args.short else (1e-3, 5e-3, 2e-2):
        for young in (1e4,) if args.short else (1e3, 1e5, 1e7):
          for side in ("implicit", "implicit, window", "MuJoCo flex"):
            case = USUAL | _of("start", side, h=h, young=young, shape=shape)
            case |= {"start": start, "nodes": small}
            if start == "sliver":
              case |= {"shape": "sliver", "start": "rest"}
            case["case"] += f"-{start}"
            starts.append(case)
  for number, draw in enumerate(_draws(8 if args.short else DRAWS)):
    if args.short:
      draw["nodes"] = min(draw["nodes"], 642)
    sides = ["implicit"]
    if number % 2 == 0:
      sides.append("implicit, window")
    if number % 4 == 0:
      sides.append("midpoint")
    # Its flex preserves no volume, and larger ones take it minutes a run.
    most = 162 if args.short else 642 if number % 8 else 2562
    if not draw["bulk"] and draw["nodes"] <= most:
      sides.append("MuJoCo flex")
    for side in sides:
      case = draw | _of("hypercube", side, h=draw["h"], young=draw["young"])
      cube.append(case | {"case": f"{case['case']}-{number}", "block": number // BLOCK})
  starts += list(_flat(args.short))
  # Slow ones first, so that no process is left alone with them at the end.
  ordered = [sorted(maps + starts, key=lambda case: -_effort(case))]
  ordered.append(sorted(cube, key=lambda case: (case["block"], -_effort(case))))
  return [[case for group in ordered for case in group]]


def _flat(short: bool) -> Iterator[Case]:
  """Yields the cases of solids against something flat."""
  for kind in ("plane", "plate") if short else (*LYING, *PRESSED):
    for h in (2e-3,) if short else (1e-3, 2e-3, 5e-3, 1e-2):
      for young in (1e4,) if short else (3e3, 1e4, 1e5, 1e6):
        for side, coupling in FLAT.items():
          name = side.replace(", ", "-").replace(" ", "-")
          if kind == "organ" and coupling != "nodal":
            continue  # windows do not feel each other, and a flex lies on no organ
          case = {"case": f"flat-{kind}-{name}-{h:g}-{young:g}", "side": side, "set": "flat"}
          case |= {"scheme": "implicit", "coupling": coupling, "start": kind, "speed": 1.0}
          yield case | {"h": h, "young": young, "damping": 2e-3, "mass": 0.064, "nodes": 162}


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Runs a case and returns its row."""
  if case["set"] != "flat":
    return judged(case, out)
  began = time.perf_counter()
  keys = {"coupling": case["coupling"], "young": case["young"], "mass": case["mass"]}
  made, _ = scenes.resting(case["start"], case["h"], damping=case["damping"], **keys)
  force, speed, _, organ = scenes.watch(made)
  row = {k: v for k, v in case.items() if k in _COLUMNS} | {"simulated_s": 1.5}
  mean = float(np.linalg.norm(force.mean(axis=0))) if len(force) else 0.0
  std = float(force.std(axis=0).max()) / mean if mean else math.inf
  broken = not mean or bool(organ and organ.error)
  verdict = "not finite" if broken else "chatters" if std > CHATTER else "moving"
  if verdict == "moving" and speed < QUIET:
    verdict = "rest"
  row |= {"verdict": verdict, "force_N": mean, "std": std, "speed_mm_s": 1e3 * speed}
  return [row | {"wall_s": time.perf_counter() - began}]


def _effort(case: Case) -> float:
  stroke = min(DEPTH / case["speed"] / case["h"], STEPS[case["nodes"]])
  slow = {"MuJoCo flex": 10.0, "implicit, window": 0.6}.get(case["side"], 1.0)
  return case["nodes"] * slow * (stroke + 0.5 * STEPS[case["nodes"]])


def _of(group: str, side: str, **what) -> Case:
  scheme, coupling = SIDES[side]
  words = [f"{v:g}" if isinstance(v, float) else str(v) for v in what.values()]
  name = scheme if coupling == "nodal" else f"{scheme}-{coupling}"
  name = side.replace(", nu ", "-") if side in SOLIDS else name
  start = {"set": group, "case": "-".join([group, name, *words]), "side": side}
  return start | {"scheme": scheme, "coupling": coupling} | what


def _draws(count: int) -> list[Case]:
  """Returns a Latin hypercube over SPANS, nodes, shapes and volume preservation."""
  from scipy.stats import qmc

  names = (*SPANS, "nodes", "shape", "bulk")
  unit = qmc.LatinHypercube(len(names), rng=np.random.default_rng(runner.SEED)).random(count)
  cases = []
  for row in unit:
    case = dict(USUAL)
    for name, u in zip(names, row, strict=True):
      if name in SPANS:
        low, high = SPANS[name]
        case[name] = float(f"{low * (high / low) ** u:.4g}")
    case["nodes"] = NODES[int(u_of(row, names, "nodes") * len(NODES))]
    case["shape"] = scene.SHAPES[int(u_of(row, names, "shape") * len(scene.SHAPES))]
    case["bulk"] = 3 * case["young"] if u_of(row, names, "bulk") > 0.5 else 0.0
    cases.append(case)
  return cases


def u_of(row: np.ndarray, names: tuple[str, ...], name: str) -> float:
  """Returns the draw of a factor."""
  return float(row[names.index(name)])


def draw(rows: list[Row], out: pathlib.Path) -> list[pathlib.Path]:
  """Draws a map of h and E for each scheme, the hypercube, and the wild starts."""
  written = []
  maps = [row for row in rows if row["set"] == "map"]
  sides = [s for s in SIDES if any(row["side"] == s for row in maps)]
  if sides:
    columns = min(3, len(sides))
    lines = -(-len(sides) // columns)
    figure, axes = plots.grid(lines, columns, width=3.1 * columns, height=2.7 * lines + 0.7)
    axes = np.ravel(axes)
    for ax, side in zip(axes, sides, strict=False):
      _map(ax, [row for row in maps if row["side"] == side])
      ax.set_title(side, loc="left", fontsize=10)
    for ax in axes[len(sides) :]:
      ax.set_axis_off()
    for ax in axes[::columns]:
      ax.set_ylabel("Young's modulus [Pa]")
    _legend(figure, 5)
    nodes = maps[0]["nodes"]
    about = f"Sphere of {nodes} nodes, t = 2 mm, 0.1 kg, pressed 8 mm at 0.1 m/s"
    written.append(plots.save(figure, out / "stability_map.png", about))
  cube = [row for row in rows if row["set"] == "hypercube"]
  if cube:
    sides = [s for s in SIDES if any(row["side"] == s for row in cube)]
    columns = min(2, len(sides))
    lines = -(-len(sides) // columns)
    figure, axes = plots.grid(lines, columns, width=4.8 * columns, height=3.6 * lines + 0.7)
    for ax, side in zip(np.ravel(axes), sides, strict=False):
      mine = [row for row in cube if row["side"] == side]
      ax.set_title(f"{side}, {len(mine)} runs", loc="left", fontsize=10)
      for verdict, colour in reversed(VERDICTS.items()):
        at = [row for row in mine if row["verdict"] == verdict]
        fails = verdict in FAILURES
        ax.plot([1e3 * r["h"] for r in at], [r["stiff"] for r in at], "X" if fails else "o",
                ms=7 if fails else 4, mec="#333333" if fails else "none", mew=0.5,
                color=colour)  # fmt: skip
      ax.set(xscale="log", yscale="log", xlabel="time step [ms]")
      plots.plain(ax.xaxis)
      ax.set_ylim(0.5 * min(r["stiff"] for r in cube), 2 * max(r["stiff"] for r in cube))
    for ax in np.ravel(axes)[len(sides) :]:
      ax.set_axis_off()
    for ax in np.ravel(axes)[::columns]:
      ax.set_ylabel("h² E t / nodal mass [-]")
    _legend(figure, 5)
    about = "Draws over h, E, thickness, damping, mass, speed, foundation, volume, nodes, shapes"
    written.append(plots.save(figure, out / "stability_hypercube.png", about))
  return written


def _map(ax, rows: list[Row]):
  hs, youngs = sorted({r["h"] for r in rows}), sorted({r["young"] for r in rows})
  for row in rows:
    at = hs.index(row["h"]), youngs.index(row["young"])
    ax.add_patch(plots.cell(at, VERDICTS[row["verdict"]]))
  ax.set_xlim(-0.5, len(hs) - 0.5)
  ax.set_ylim(-0.5, len(youngs) - 0.5)
  ax.set_xticks(range(len(hs)), [f"{1e3 * h:g}" for h in hs])
  ax.set_yticks(range(len(youngs)), [f"1e{round(math.log10(y))}" for y in youngs])
  ax.set_xlabel("time step [ms]")


def _legend(figure, columns: int):
  from matplotlib.patches import Patch

  handles = [Patch(color=colour, label=verdict) for verdict, colour in VERDICTS.items()]
  figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=9,
                frameon=False)  # fmt: skip


def summarize(rows: list[Row]) -> list[str]:
  """Returns the page: what counts as failed, and counts of verdicts."""
  lines = [JUDGEMENT, ""]
  for group in ("map", "start", "hypercube", "flat"):
    here = [row for row in rows if row["set"] == group]
    table = []
    for side in dict.fromkeys((*SIDES, *FLAT)):
      for low, high, span in ((0, 5.001e-3, "h <= 5 ms"), (5.001e-3, 1, "h > 5 ms")):
        mine = [r for r in here if r["side"] == side and low <= r["h"] < high]
        if mine:
          counts = [sum(r["verdict"] == v for r in mine) for v in VERDICTS]
          failed = sum(r["verdict"] in FAILURES for r in mine)
          table.append([side, span, len(mine), f"{100 * failed / len(mine):.0f} %", *counts])
    if table:
      head = ["side", "", "runs", "failed", *VERDICTS]
      lines += [f"## {group}", "", *plots.table(head, table), ""]
  lines += _rested(rows)
  pressed = [row for row in rows if row["set"] != "flat"]
  lines += _beside(pressed)
  failed = sum(r["scheme"] == "implicit" and r["verdict"] in FAILURES for r in pressed)
  lines += [f"{failed} runs of the implicit scheme failed; [stability.csv](stability.csv) has "
            "them all. One again: `palpate bench stability --only CASE`.", ""]  # fmt: skip
  return lines


def _rested(good: list[Row]) -> list[str]:
  """Returns a table of how solids rest against something flat: the force's standard deviation."""
  rows = [row for row in good if row["set"] == "flat"]
  if not rows:
    return []
  steps = sorted({row["h"] for row in rows})
  table = []
  for kind in dict.fromkeys(row["start"] for row in rows):
    for side in FLAT:
      mine = [row for row in rows if (row["start"], row["side"]) == (kind, side)]
      for young in sorted({row["young"] for row in mine}):
        each = {row["h"]: row for row in mine if row["young"] == young}
        cells = [
          f"{100 * each[h]['std']:.2f} % ({each[h]['speed_mm_s']:.3g})" if h in each else ""
          for h in steps
        ]
        table.append([kind, side, f"{1e-3 * young:g} kPa", *cells])
  head = ["against", "side", "E", *(f"{1e3 * h:g} ms" for h in steps)]
  about = (
    "A cube of 40 mm, 64 g, nu 0.45, with `add_organ`'s contacts, or MuJoCo's flex of the same "
    "tetrahedra: standard deviation of the force from 1.2 to 1.5 s, of its mean, and in brackets "
    "the speed of the fastest node [mm/s]. A corner tilts gravity, a plate presses by a tenth."
  )
  return [about, "", *plots.table(head, table), ""]


def _beside(good: list[Row]) -> list[str]:
  """Returns lines about the cases that ran on two sides."""
  both: dict[tuple, dict] = {}
  names = ("set", "shape", "start", "nodes", "h", "young", "thickness", "damping", "mass", "speed")
  for row in good:
    both.setdefault(tuple(row[k] for k in names), {})[row["side"]] = row["verdict"] in FAILURES
  lines = []
  for other in SIDES:
    pairs = [p for p in both.values() if "implicit" in p and other in p]
    if pairs and other != "implicit":
      ours, theirs = (sum(p[side] for p in pairs) for side in ("implicit", other))
      lines.append(
        f"{len(pairs)} cases ran with both implicit and {other}; failed: implicit {ours}, {other} "
        f"{theirs}; implicit alone {sum(p['implicit'] and not p[other] for p in pairs)}, {other} "
        f"alone {sum(p[other] and not p['implicit'] for p in pairs)}."
      )
  return [word for line in lines for word in (line, "")]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for group, what in (("map", "time steps and moduli"), ("hypercube", "random draws")):
    told = []
    for side in dict.fromkeys(SIDES):
      mine = [r for r in rows if (r["set"], r["side"]) == (group, side) and r["h"] <= 5.001e-3]
      if mine:
        share = 100 * sum(r["verdict"] in FAILURES for r in mine) / len(mine)
        told.append(f"{share:.0f} % {side}")
    if told:
      lines.append(f"Failures over {what}, at up to 5 ms: {'; '.join(told)}.")
  return lines


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Draws the figures and writes the page."""
  drawn = draw(rows, path.parent)
  return results.Page("Where each scheme breaks", finding(rows), summarize(rows), drawn)


BENCH = Bench("stability", stages, run, _COLUMNS, report, jobs=1, limit=150.0)
