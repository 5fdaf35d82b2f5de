"""Tables 7.1-7.4 and figures 7.6-7.14 of the thesis with today's program.

V. Kotamraju, "A GPU-based integrated approach to simulation for deformable surface meshes", Simon
Fraser University, 2008: a 3.0 GHz Pentium 4 and a GeForce 7600 GS. The same work here: springs on a
closed grid of nodes, probed at a haptic rate. Every node weighs 1 g whatever the size, so that the
explicit scheme runs at every size.
"""

from __future__ import annotations

import argparse
import pathlib
import time
from collections.abc import Callable

import mujoco
import numpy as np
import scenes
import warp as wp
from benchmarks import plots, results, runner, scene
from benchmarks.runner import Bench, Case, Row
from palpate.tissue import shape as making
from palpate.tissue import step as stepping
from palpate.tissue.body import Body
from palpate.tissue.config import Config
from palpate.tissue.mesh import Mesh
from palpate.tissue.types import Stage

SIDES = (16, 32, 64, 128, 256)
H = 1e-3  # a haptic cycle [s]
NODE_MASS, STIFFNESS, FOUNDATION = 1e-3, 60.0, 2e5  # [kg], [N/m], [Pa/m]
DEPTH = 0.008  # [m]
CYCLES = 400
LARGEST = 20000  # nodes; with more, MuJoCo's collision asks for gigabytes and the step runs alone
WINDOW = "implicit, window"  # which gives MuJoCo only the nodes near the probe
SCHEMES = (("implicit", "cuda:0"), ("implicit", "cpu"), ("neumann", "cuda:0"), ("neumann", "cpu"),
           ("explicit", "cpu"), (WINDOW, "cpu"))  # fmt: skip
# The thesis's own figures by side of the grid: Hz in 7.1, ms in the others.
RATE = {
  ("implicit", "cuda:0"): {16: 560, 64: 504, 128: 305},
  ("implicit", "cpu"): {16: 611, 64: 347, 128: 212},
  ("explicit", "cpu"): {16: 597, 64: 271, 128: 148},
}
INTEGRATION = {
  ("explicit", "cpu"): {16: 1.48, 64: 5.48, 128: 20.74},
  ("implicit", "cpu"): {16: 0.73, 64: 2.23, 128: 8.88},
  ("implicit", "cuda:0"): {16: 1.77, 64: 1.98, 128: 3.27},
}
GPU = {
  "to_ms": {16: 1.18, 64: 1.22, 128: 1.68},
  "from_ms": {16: 0.023, 64: 0.063, 128: 0.391},
  "solve_ms": {16: 0.57, 64: 0.703, 128: 1.20},
}
CPU = {
  "collision_ms": {16: 0.004, 64: 0.004, 128: 0.005},  # broad and narrow phase
  "assemble_ms": {16: 0.11, 64: 1.28, 128: 7.29},  # Hessian set-up
}
_COLUMNS = (
  *("kind", "scheme", "device", "side", "nodes", "rate_hz", "step_ms", "slowest_ms"),
  *("integration_ms", "assemble_ms", "solve_ms", "to_ms", "from_ms", "collision_ms", "contacts"),
  *("iterations", "compile_s", "cycle", "force_N", "node_mm"),
)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns the cases: every scheme at every size; CUDA ones are empty without such a device."""
  sides = SIDES[:2] if args.short else SIDES
  return [
    [
      {"case": f"{scheme}-{device}-{side}", "scheme": scheme, "device": device, "side": side}
      for side in sides
      for scheme, device in SCHEMES
    ]
  ]


def _motion(cycle: int) -> tuple[float, float]:
  """Returns the probe's displacement and velocity: pressed, held, back and free."""
  down, rate_down = scene.ramp(cycle * H, 0.1)
  back, rate_back = scene.ramp(cycle * H - 0.2, 0.1)
  return -DEPTH * (down - back), -DEPTH * (rate_down - rate_back)


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Runs a case and returns its figures, and every fourth cycle of its trace."""
  if case["device"] != "cpu" and not wp.is_cuda_available():
    return [{"kind": "no device", "scheme": case["scheme"], "device": case["device"],
             "side": case["side"]}]  # fmt: skip
  mesh = scene.shape("octa", case["side"] ** 2)
  window = case["scheme"] == WINDOW
  scheme = case["scheme"].removesuffix(", window")
  if mesh.nvert > LARGEST:
    if window:
      return [{"kind": "not run", **{k: case[k] for k in ("scheme", "device", "side")}}]
    return [_alone(case, mesh)]
  tissue = scene.Tissue(
    elements="spring", stiffness=STIFFNESS, foundation=FOUNDATION, mass=NODE_MASS * mesh.nvert
  )
  top = int(np.argmax(mesh.rest[:, 2]))
  began = time.perf_counter()
  place = mesh.rest[top] + [0, 0, scene.PROBE + 0.0006]
  model = scene.build(
    mesh, tissue, scheme, H, probe=place, window=window, device=case["device"]
  )
  data = mujoco.MjData(model)
  row: Row = {"kind": "rate", "compile_s": time.perf_counter() - began, "nodes": mesh.nvert}
  row |= {k: case[k] for k in ("scheme", "device", "side")}
  probe, organ = scene.probe_dofs(model), scene.handle(model, data)
  nodes, space = scene.Nodes(model, data, mesh, organ), scenes.workspace(organ)
  rows, cycles, iterations, contacts = [], [], [], 0
  collision: list[float] = []
  clock = _clock(case["device"])
  limit = clock() + 60
  for cycle in range(CYCLES):
    start = clock()
    # A haptic cycle: the device's place, a step, the force.
    depth, velocity = _motion(cycle)
    scene.put(data, probe, np.array([0, 0, depth]), np.array([0, 0, velocity]))
    mujoco.mj_step(model, data)
    force = float(data.qfrc_constraint[probe[2]])
    cycles.append(clock() - start)
    iterations.append(organ.iterations)
    contacts = max(contacts, data.ncon)
    if cycle % 4 == 0:
      moved = 1e3 * nodes.state()[0][top, 2]
      trace = {"kind": "trace", "cycle": cycle, "force_N": force, "node_mm": moved}
      rows.append(trace | {k: case[k] for k in ("scheme", "device", "side")})
    if cycle in (150, 160, 170):
      collision += _times(lambda: mujoco.mj_collision(model, data), 5, clock)
    if clock() > limit:
      break
    if cycle == 150:
      row |= _parts(space.body, scheme)
  timed = np.array(cycles[10:])
  row["step_ms"] = 1e3 * float(np.median(timed))
  row["slowest_ms"] = 1e3 * float(np.max(timed))
  row["rate_hz"] = 1e3 / row["step_ms"]
  row["collision_ms"] = 1e3 * float(np.median(collision)) if collision else ""
  row |= {"contacts": contacts, "iterations": float(np.mean(iterations))}
  return [row, *rows]


def _clock(device: str) -> Callable[[], float]:
  """Returns the clock for work on a device: CPU time of the thread, or time on the wall."""
  return runner.clock if device == "cpu" else time.perf_counter


def _times(work, repeat: int, clock: Callable[[], float]) -> list[float]:
  out = []
  for _ in range(repeat):
    start = clock()
    work()
    out.append(clock() - start)
  return out


def _alone(case: Case, mesh: Mesh) -> Row:
  """Returns the times of a step outside of MuJoCo."""
  began = time.perf_counter()
  config = Config(
    elements="spring", stiffness=STIFFNESS, foundation=FOUNDATION, bend=0.0, device=case["device"]
  )
  body = making.make(mesh, config, np.zeros(mesh.nvert, bool), case["device"])
  state = body.state
  scenes.put(body, state.mass, NODE_MASS)
  state.step.assign(np.array([[H, H * H + H * config.damping, 0, 0]], np.float32))
  patch = np.linalg.norm(mesh.rest - mesh.rest[np.argmax(mesh.rest[:, 2])], axis=1) < scene.PROBE
  scenes.put(body, state.force_ext, patch[:, None] * [0.0, 0.0, -1.0] / patch.sum())
  row: Row = {"kind": "rate", "nodes": mesh.nvert, "compile_s": time.perf_counter() - began}
  row |= {k: case[k] for k in ("scheme", "device", "side")}
  row |= _parts(body, case["scheme"])
  return row | {"iterations": float(body.system.status.numpy()[0][0])}


def _parts(body: Body, scheme: str, repeat: int = 30) -> Row:
  """Returns median times of the step's parts, each as a recorded graph [ms]."""
  state, device = body.state, body.device
  down = [getattr(state, k) for k in ("step", "disp", "vel", "mass", "force_ext", "dvel_warm")]
  up = [state.dvel, body.system.status]
  host = {each.ptr: wp.clone(each, device="cpu", pinned=device.is_cuda) for each in (*down, *up)}
  wp.synchronize_device(device)

  def to_device():
    for each in down:
      wp.copy(each, host[each.ptr])

  def from_device():
    for each in up:
      wp.copy(host[each.ptr], each)

  works = {"integration_ms": lambda: stepping.step(body, scheme)}
  if scheme == "implicit":
    works["assemble_ms"] = lambda: stepping.assemble(body, Stage.FIRST)
    works["solve_ms"] = lambda: stepping.solve(body, Stage.FIRST)
  if device.is_cuda:
    works |= {"to_ms": to_device, "from_ms": from_device}
  row: Row = {}
  for name, work in works.items():
    with wp.ScopedDevice(device), wp.ScopedCapture(device=device) as capture:
      work()

    def once(graph: wp.Graph = capture.graph):  # type: ignore[assignment]
      wp.capture_launch(graph)
      wp.synchronize_device(device)

    row[name] = 1e3 * float(np.median(_times(once, repeat, _clock(device.alias))))
  return row


def draw(rows: list[Row], out: pathlib.Path) -> list[pathlib.Path]:
  """Draws rate and integration time against size, and force and displacement against cycles."""
  rows = [row for row in rows if row["status"] == "ok"]
  rates = [row for row in rows if row["kind"] == "rate"]
  traces = [row for row in rows if row["kind"] == "trace"]
  if not rates:
    return []
  figure, axes = plots.grid(1, 2, width=9.0, height=4.0)
  shades = ("#08519c", "#4292c6", "#54278f", "#9e9ac8", "#2ca02c", "#000000")
  colours = dict(zip(SCHEMES, shades, strict=True))
  for ax, key, then, label in (
    (axes[0], "rate_hz", RATE, "haptic update rate [Hz]"),
    (axes[1], "integration_ms", INTEGRATION, "integration [ms]"),
  ):
    for which, colour in colours.items():
      mine = sorted((r for r in rates if (r["scheme"], r["device"]) == which and r[key] != ""),
                    key=lambda r: r["nodes"])  # fmt: skip
      if mine:
        ax.plot([r["nodes"] for r in mine], [r[key] for r in mine], "o-", ms=4, color=colour,
                label=f"{which[0]}, {which[1]}")  # fmt: skip
      if which in then:
        ax.plot([side**2 for side in then[which]], list(then[which].values()), "x:", ms=5,
                color=colour, label=f"{which[0]}, {which[1]}: thesis")  # fmt: skip
    ax.set(xscale="log", yscale="log", xlabel="nodes", ylabel=label)
    plots.plain(ax.xaxis)
    plots.plain(ax.yaxis)
  axes[0].axhline(1000, color="#999999", lw=0.8)
  axes[0].annotate("1 kHz", (0, 1000), xycoords=("axes fraction", "data"), fontsize=7, va="bottom")
  handles = dict(zip(*reversed(axes[0].get_legend_handles_labels()), strict=True))
  handles |= dict(zip(*reversed(axes[1].get_legend_handles_labels()), strict=True))
  figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=7,
                frameon=False)  # fmt: skip
  about = "Tables 7.1 and 7.2 of the thesis (crosses) and today's program (dots)"
  written = [plots.save(figure, out / "thesis_rate.png", about)]
  sides = [side for side in (16, 64, 128) if any(r["side"] == side for r in traces)]
  sides = sides or sorted({r["side"] for r in traces})
  kinds = [w for w in SCHEMES if w[0] in ("implicit", "explicit") and any(
    (r["scheme"], r["device"]) == w for r in traces)]  # fmt: skip
  if sides and kinds:
    figure, axes = plots.grid(len(kinds), len(sides), 3.2 * len(sides), 2.5 * len(kinds) + 0.4)
    axes = np.reshape(axes, (len(kinds), len(sides)))
    for line, which in zip(axes, kinds, strict=True):
      for ax, side in zip(line, sides, strict=True):
        mine = [r for r in traces if (r["scheme"], r["device"], r["side"]) == (*which, side)]
        cycles = [r["cycle"] for r in mine]
        ax.plot(cycles, [-r["node_mm"] for r in mine], color="#2f6f9f", lw=1.4)
        right = ax.twinx()
        right.plot(cycles, [r["force_N"] for r in mine], color="#c1442e", lw=1.2)
        right.tick_params(labelsize=8)
        right.spines["top"].set_visible(False)
        ax.set_title(f"{which[0]}, {which[1]}, {side} x {side}", loc="left", fontsize=9)
        if side == sides[0]:
          ax.set_ylabel("node nearest to the probe [mm]", color="#2f6f9f", fontsize=7)
        if side == sides[-1]:
          right.set_ylabel("force [N]", color="#c1442e", fontsize=8)
        if which == kinds[-1]:
          ax.set_xlabel("haptic cycle", fontsize=8)
    about = "Displacement and force (figures 7.6-7.14)"
    written.append(plots.save(figure, out / "thesis_trace.png", about))
  return written


def summarize(rows: list[Row]) -> list[str]:
  """Returns the page: each table of the thesis with today's figures beside it."""
  rates = {
    (r["scheme"], r["device"], r["side"]): r
    for r in rows
    if r["status"] == "ok" and r["kind"] == "rate"
  }
  lines = [
    "",
    "Thesis (3.0 GHz Pentium 4, GeForce 7600 GS, 2008) / today. Its implicit scheme is our "
    "`neumann`; our `implicit` solves to a residual of 1e-4. n x n is n^2 + 2 nodes here. A haptic "
    "cycle is a whole mj_step with all nodes as degrees of freedom, but for `window`, where MuJoCo "
    "has those near the probe alone; at 256 x 256 only the step of the organ itself was run. Times "
    "on the CPU are CPU time of the one thread: other load does not count.",
    "",
    *_tables(rates),
  ]
  if not any(key[1] != "cpu" for key in rates):
    lines += ["No CUDA device on this machine: its rows are missing.", ""]
  slow = [
    f"{k[0]} on {k[1]} at {k[2]} x {k[2]}"
    for k, r in rates.items()
    if r["rate_hz"] != "" and r["rate_hz"] < 1000
  ]
  lines += [f"Under 1 kHz: {', '.join(slow) or 'none'}.", ""]
  behind = [
    f"{r[key]:.3g} {unit} for {was[k[:2]][k[2]]:g} ({k[0]} on {k[1]}, {k[2]} x {k[2]})"
    for k, r in rates.items()
    for key, was, unit, sign in (
      ("rate_hz", RATE, "Hz", 1),
      ("integration_ms", INTEGRATION, "ms", -1),
    )
    if r[key] != "" and k[2] in was.get(k[:2], {}) and sign * (r[key] - was[k[:2]][k[2]]) < 0
  ]
  return [*lines, f"Slower than the thesis: {'; '.join(behind) or 'nothing'}."]


def _tables(rates: dict[tuple, Row]) -> list[str]:
  """Returns the tables 7.1 to 7.4, a cell the thesis's figure and today's."""
  sides = sorted({key[2] for key in rates})
  head, lines = [f"{side} x {side}" for side in sides], []

  def cells(which: tuple, key: str, then: dict, always: bool = False) -> list[str] | None:
    now = [rates.get((*which, side), {}).get(key) for side in sides]
    if not always and all(v in (None, "") for v in now):
      return None
    return [
      f"{then.get(side, '-')} / {'-' if value in (None, '') else f'{value:.3g}'}"
      for side, value in zip(sides, now, strict=True)
    ]

  for title, key, then in (("7.1 Haptic update rate [Hz]", "rate_hz", RATE),
                           ("7.2 Integration [ms]", "integration_ms", INTEGRATION)):  # fmt: skip
    made = {w: cells(w, key, then.get(w, {}), always=w in then) for w in SCHEMES}
    table = [[*which, *line] for which, line in made.items() if line]
    lines += [f"## {title}", "", *plots.table(["scheme", "device", *head], table), ""]
  for title, device, parts, then in (
    ("7.3 Parts of the GPU step [ms]", "cuda:0", ("to_ms", "from_ms", "solve_ms"), GPU),
    ("7.4 Parts of the CPU step [ms]", "cpu", ("collision_ms", "assemble_ms", "solve_ms"), CPU),
  ):
    made = {part: cells(("implicit", device), part, then.get(part, {})) for part in parts}
    table = [[part.removesuffix("_ms"), device, *line] for part, line in made.items() if line]
    if table:
      lines += [f"## {title}", "", *plots.table(["part", "device", *head], table), ""]
  return lines


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Draws the figures and writes the page."""
  title = "The tables of the thesis, measured today"
  page = results.page(out / "thesis.md", title, about, summarize(rows))
  return [*draw(rows, out), page]


BENCH = Bench("thesis", stages, run, _COLUMNS, report, jobs=1, limit=500.0)
