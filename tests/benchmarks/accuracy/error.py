"""What a millisecond buys, scene by scene.

Scripted scenes run with every scheme, time step and tolerance, MuJoCo's native flex interleaved
with ours, and are compared with a float64 reference: explicit, refined until its error is known,
with barycentric weights of the corners of touched triangles. Kept apart: the error of the linear
solve, of the time step, and of the contact force. Run times are compared: use one process, or fewer
than there are idle cores.
"""

from __future__ import annotations

import argparse
import math
import pathlib
from collections.abc import Callable

import numpy as np
from benchmarks import plots, results
from benchmarks.accuracy.compare import DRAWN, LEVELS, RIGHT, TAU, H, run
from benchmarks.accuracy.films import LONGEST, SCRIPTS
from benchmarks.runner import Bench, Case, Row
from benchmarks.scene import NATIVE

SIZES = {642: ("membrane", "spring", "solid"), 2562: ("membrane",)}
LEVELS_WANTED = (0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
OURS = ("implicit", "midpoint")
_COLUMNS = (
  *("kind", "scene", "nodes", "elements", "run", "scheme", "h", "newton", "tolerance", "step_ms"),
  *("total_s", "force_rms", "force_rms_start", "force_rms_end", "force_peak", "position_rms"),
  *("algebraic", "nonlinear", "iterations", "finite", "reference_force", "reference_position"),
  *("reference_order", "peak_N", "peak_mm"),
)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns the references, then the runs, one case a scene, size, element and time step."""
  scenes = ("press", "vibrate") if args.short else tuple(SCRIPTS)
  sizes = {162: ("membrane",)} if args.short else SIZES
  hs = H[2:5] if args.short else H
  first, second = [], []
  short = {"short": int(args.short)}
  for nodes, kinds in sizes.items():
    for name in scenes:
      touches = SCRIPTS[name].probe and not SCRIPTS[name].joined
      for elements in kinds:
        if elements == "solid" and not touches:
          continue  # a solid has windows, which are for contacts
        what = {"scene": name, "nodes": nodes, "elements": elements}
        first += [
          {"case": f"reference-{name}-{nodes}-{elements}-{k}", "kind": "reference", "level": k}
          | what
          for k in _levels(args.short, nodes, elements)
        ]
        second += [
          {"case": f"{name}-{nodes}-{elements}-{h:g}", "kind": "run", "h": h} | what | short
          for h in hs
          if elements != "solid" or h <= LONGEST
        ]
  return [first, second]


def _levels(short: bool, nodes: int, elements: str) -> tuple[int, ...]:
  """Returns the time steps of a reference, in TAU; that of a solid takes long."""
  if short or elements == "solid":
    return LEVELS[:2]
  return LEVELS if nodes <= 642 else LEVELS[1:]


def groups(rows: list[Row]) -> dict[tuple, list[Row]]:
  """Returns the runs by (scene, nodes, elements)."""
  out: dict[tuple, list[Row]] = {}
  for row in rows:
    if row["kind"] == "run":
      out.setdefault((row["scene"], row["nodes"], row["elements"]), []).append(row)
  return out


def measure(row: Row) -> str:
  """Returns the error that a scene is judged by."""
  return "position_rms" if row["force_rms"] == "" else "force_rms"


def order(rows: list[Row], key: str, most: float = 1.01e-3) -> float:
  """Returns the observed order of convergence: slope of log error against log h, h <= `most`."""
  points = [(r["h"], r[key]) for r in rows if r[key] not in ("", 0) and r["h"] <= most]
  if len(points) < 2:
    return math.nan
  x, y = np.log(np.array(points)).T
  return float(np.polyfit(x, y, 1)[0])


def cheapest(rows: list[Row], level: float) -> tuple[float, Row | None]:
  """Returns the least run time [s] of the rows that reach an error level, and which row it is."""
  good = [r for r in rows if r[measure(r)] != "" and r[measure(r)] <= level]
  best = min(good, key=lambda r: r["total_s"], default=None)
  return (best["total_s"], best) if best else (math.inf, None)


def draw(rows: list[Row], out: pathlib.Path) -> list[pathlib.Path]:
  """Draws error against run time, one figure a scene, one panel a mesh and its elements."""
  written = []
  by_scene: dict[str, list[tuple]] = {}
  for key in groups(rows):
    by_scene.setdefault(key[0], []).append(key)
  for name, keys in by_scene.items():
    columns = min(2, len(keys))
    lines = -(-len(keys) // columns)
    figure, axes = plots.grid(lines, columns, width=4.8 * columns, height=3.7 * lines + 0.8)
    axes, handles = np.ravel(axes), {}
    for ax, key in zip(axes, keys, strict=False):
      mine = groups(rows)[key]
      what = measure(mine[0])
      for run_name in DRAWN:
        line = sorted((r for r in mine if r["run"] == run_name and r[what] != ""),
                      key=lambda r: r["h"])  # fmt: skip
        line = [r for r in line if r[what] < 2]
        colour, mark, style = plots.STYLES[run_name]
        if line:
          label = run_name.replace("native", "MuJoCo flex")
          (handles[label],) = ax.plot(
            [r["total_s"] for r in line], [100 * r[what] for r in line], style, marker=mark, ms=5,
            color=colour)  # fmt: skip
      floor = 100 * mine[0]["reference_force" if what == "force_rms" else "reference_position"]
      ax.axhline(floor, color="#999999", lw=0.8, ls=":")
      ax.annotate("reference", (1, floor), xycoords=("axes fraction", "data"), ha="right",
                  va="bottom", fontsize=8, color="#777777")  # fmt: skip
      ax.set(xscale="log", yscale="log", xlabel="run time of the scene [s]")
      ax.set_ylabel(f"{what.split('_')[0]} error, RMS [% of peak]")
      plots.plain(ax.xaxis, 2)
      plots.plain(ax.yaxis, 2)
      ax.set_title(f"{key[1]} nodes, {key[2]}", loc="left", fontsize=10)
    for ax in axes[len(keys) :]:
      ax.set_axis_off()
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3,
                  fontsize=9, frameon=False)  # fmt: skip
    written.append(
      plots.save(figure, out / f"error_{name}.png", f"{name}: below and left is better")
    )
  return written


_SIDES = """`ours`: `implicit` or `midpoint` with all nodes as MuJoCo's dofs, as the others have
them; `ours, window`: the same with window coupling (scenes with a contact), alone with solids
(10 kPa, nu 0.45, 0.5 kg), whose contacts have a time constant of 5 ms, others 20. `explicit` and
`neumann` are those of the thesis and its predecessor on our kernels. `MuJoCo flex` is what users of
the mujoco named above get: 3.17 weighs the corners of a touched triangle by inverse distance,
which is part of its force error in `press` and `slide`. `right weights` is the same flex with
barycentric weights, as MuJoCo 4.0 has them, from a passive callback whose 0.01 ms are in its
time."""


_ERRORS = ("force_rms", "force_peak", "position_rms")


def _race(found: dict[tuple, list[Row]]) -> tuple[list[str], list[list], list[str]]:
  """Returns head and rows of the table of least run times, and where a peer is faster than ours."""
  sides: dict[str, Callable[[Row], bool]] = {
    "ours": lambda r: r["scheme"] in OURS and "window" not in r["run"],
    "ours, window": lambda r: r["scheme"] in OURS and "window" in r["run"],
    "neumann": lambda r: r["scheme"] == "neumann",
    "explicit": lambda r: r["scheme"] == "explicit",
    "MuJoCo flex": lambda r: r["scheme"] == NATIVE and r["run"] != RIGHT,
    "right weights": lambda r: r["run"] == RIGHT,
  }
  table, lost = [], []
  for key, mine in found.items():
    for level in LEVELS_WANTED:
      cells, best = [], {}
      for label, belongs in sides.items():
        best[label], row = cheapest([r for r in mine if belongs(r)], level)
        which = f"{row['scheme']} " if row and label.startswith("ours") else ""
        if row and row["newton"] not in ("", 1):
          which += f"{row['newton']} Newton, "
        cells.append(f"{best[label]:.3g} ({which}{1e3 * row['h']:g} ms)" if row else "-")
      winner = min(best, key=lambda k: best[k])
      table.append([*key, f"{100 * level:g} %", *cells,
                    "none reaches it" if math.isinf(best[winner]) else winner])  # fmt: skip
      peer = min(list(sides)[2:], key=lambda k: best[k])
      if best[peer] < best["ours"]:
        ratio = best["ours"] / best[peer]
        by = "ours does not reach it" if math.isinf(ratio) else f"{ratio:.2f} times"
        lost.append(f"{key[0]}, {key[1]} nodes, {key[2]}, {100 * level:g} %: {peer}, {by}")
  return ["scene", "nodes", "elements", "error", *sides, "least"], table, lost


def summarize(rows: list[Row]) -> list[str]:
  """Returns the page: least run time to each error level, orders, errors at the default."""
  lines = [
    "Errors are RMS over the scene, of the reference's peak: contact force on the probe where "
    "there is one, node positions in `vibrate`. A force is that of the step's end for `implicit` "
    "and of its start for the others and for solids, the better one for each (both are in the CSV)."
    " The reference is explicit, in float64, at "
    f"{1e6 * TAU:g} us and multiples, extrapolated. Run time is the median step times the steps of "
    "the scene, in CPU time of the one thread, so that other load does not count.",
    "",
  ]
  found = groups(rows)
  lines += ["## Least run time [s] to an error level, over all h and settings", ""]
  head, table, lost = _race(found)
  lines += [*plots.table(head, table), ""]
  lines += [_SIDES, "", "A peer is faster: " + ("; ".join(lost) or "nowhere") + ".", ""]
  table = []
  for key, mine in found.items():
    at = {r["run"]: r for r in mine if abs(r["h"] - 1e-3) < 1e-9}
    for name in dict.fromkeys(r["run"] for r in mine):
      r, line = at.get(name, {}), [r for r in mine if r["run"] == name]
      cells = [100 * r[k] if r.get(k, "") != "" else "" for k in _ERRORS]
      ratio = at["native"]["step_ms"] / r["step_ms"] if r and "native" in at else ""
      orders = [order(line, k) for k in ("force_rms", "position_rms")]
      rest = [r.get(k, "") for k in ("algebraic", "nonlinear", "step_ms")]
      table.append([*key, name, *cells, *orders, *rest, ratio])
  head = ["scene", "nodes", "elements", "run", "force RMS [%]", "peak [%]", "position [%]"]
  head += ["order, force", "order, position", "algebraic", "nonlinear", "step [ms]"]
  lines += ["## At h = 1 ms, and the observed order of convergence for h <= 1 ms", ""]
  lines += [*plots.table([*head, "flex step / this"], table), ""]
  lines += [
    "Algebraic: one step against its exact solution in float64 (native: against MuJoCo's Newton "
    "solver at 1e-14 from the same state); neumann: against the implicit step. Nonlinear: against "
    "the converged implicit Euler step.",
    "",
  ]
  told = ("reference_order", "reference_position", "reference_force")
  table = [[*key, *(mine[0][k] for k in told)] for key, mine in found.items()]
  head = ["scene", "nodes", "elements", "order", "moved by, position", "moved by, force"]
  lines += ["## The reference", "", *plots.table(head, table), ""]
  ended = [r for r in rows if r["kind"] == "run" and r["finite"] == 0]
  if ended:
    words = sorted({f"{r['case']}: {r['run']}" for r in ended})
    lines += ["Diverged: " + "; ".join(words), ""]
  return lines


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for scene in ("press", "slide", "vibrate"):
    mine = [r for r in rows if r["kind"] == "run" and r["scene"] == scene
            and r["elements"] in ("membrane", "shell", "bending")]  # fmt: skip
    mine = [r for r in mine if r["nodes"] == min(r["nodes"] for r in mine)]
    best, ours = cheapest([r for r in mine if r["scheme"] in OURS], 0.01)
    others = {
      "`explicit`": cheapest([r for r in mine if r["scheme"] == "explicit"], 0.01)[0],
      "MuJoCo's flex": cheapest([r for r in mine if r["run"] == NATIVE], 0.01)[0],
      "the flex with right weights": cheapest([r for r in mine if r["run"] == RIGHT], 0.01)[0],
    }
    told = [f"{who} takes {time / best:.2g} times as long" if math.isfinite(time)
            else f"{who} does not reach it" for who, time in others.items()]  # fmt: skip
    if ours:
      lines.append(f"`{scene}`, {ours['nodes']} nodes, within 1 %: `{ours['run']}` with "
                   f"{1e3 * ours['h']:g} ms is cheapest of ours; {', '.join(told)}.")  # fmt: skip
  return lines


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Draws the figures and writes the page."""
  drawn = draw(rows, path.parent)
  lines = summarize(rows)
  for each in drawn[1:]:
    lines += [f"![Run time against error, {each.stem.removeprefix('error_')}]({each.name})", ""]
  return results.Page("Run time against error", finding(rows), lines, drawn)


BENCH = Bench("error", stages, run, _COLUMNS, report, jobs=1, limit=3600.0)
