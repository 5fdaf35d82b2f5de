"""Tables 7.1-7.4 and figures 7.6-7.14 of the thesis with today's program.

    palpate bench thesis
    palpate bench thesis --device cuda:0

V. Kotamraju, "A GPU-based integrated approach to simulation for deformable surface meshes", Simon
Fraser University, 2008: a 3.0 GHz Pentium 4 and a GeForce 7600 GS. The same work here: springs on a
closed grid of nodes, and a tool that a hand holds by a virtual coupling, at a haptic rate. The
organ weighs 1.2 kg whatever the size. For the tables it is pressed, with a window of nodes in
MuJoCo; for the figures one node is pulled, with all of them in MuJoCo.
"""

from __future__ import annotations

import argparse
import math
import pathlib
import time

import mujoco
import numpy as np
import palpate
import scenes
import warp as wp
from benchmarks import plots, results, runner, scene
from benchmarks.runner import Bench, Case, Row
from benchmarks.timing import loop
from palpate.app.console import CommandError

SIDES = (16, 32, 64, 128, 256)
DRAWN = (16, 64, 128)  # the sizes of the figures
SCHEMES = ("implicit", "neumann", "explicit")
H = 1e-3  # a haptic cycle [s]
TISSUE = scene.Tissue(
  elements="spring", stiffness=10.0, foundation=1e5, mass=1.2, damping=1e-4, thickness=0.0
)
TIP, TOOL_MASS = 0.006, 0.02  # [m], [kg]
COUPLING, COUPLING_DAMPING = 1000.0, 10.0  # of tool and hand [N/m], [N s/m]
DEPTH, ASIDE = 0.008, 0.004  # [m]
REPLAYS = 2000  # of the parts of a step
PERIOD = 1000  # cycles: pressed or pulled, held, back and free
# The thesis's own figures by side of the grid: Hz in 7.1, ms in the others. Its implicit scheme is
# our `neumann`.
RATE = {
  ("neumann", "cuda"): {16: 560, 64: 504, 128: 305},
  ("neumann", "cpu"): {16: 611, 64: 347, 128: 212},
  ("explicit", "cpu"): {16: 597, 64: 271, 128: 148},
}
INTEGRATION = {
  ("neumann", "cuda"): {16: 1.77, 64: 1.98, 128: 3.27},
  ("neumann", "cpu"): {16: 0.73, 64: 2.23, 128: 8.88},
  ("explicit", "cpu"): {16: 1.48, 64: 5.48, 128: 20.74},
}
GPU = {
  "to": {16: 1.18, 64: 1.22, 128: 1.68},
  "from": {16: 0.023, 64: 0.063, 128: 0.391},
  "step": {16: 0.57, 64: 0.703, 128: 1.20},
}
HEADLINE = 6.5  # times, of the implicit scheme on the GPU over `explicit` on the CPU
CPU = {
  "broad": {16: 0.001, 64: 0.001, 128: 0.002},
  "narrow": {16: 0.003, 64: 0.003, 128: 0.003},
  "assemble": {16: 0.11, 64: 1.28, 128: 7.29},  # Hessian set-up
}
PARTS = ("step", "assemble", "solve", "to", "from", "search")
_SPREAD = tuple(f"{part}_{what}" for part in PARTS for what in ("ms", "sd"))
_COLUMNS = (
  *("kind", "scheme", "device", "side", "nodes", "cycles", "cycle_ms", "cycle_sd", "rate_hz"),
  *_SPREAD,
  *("broad_ms", "narrow_ms", "contacts", "iterations", "diverged", "cycle", "force_N", "node_mm"),
  *("force_x_N", "node_x_mm"),
)


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--device", default="cpu", help="cpu or cuda:0 (%(default)s)")
  add("--cycles", type=int, default=10000, help="a tenth of it at 256 x 256 (%(default)s)")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a scheme and size for the tables, and those of the figures."""
  sides, drawn = (SIDES[:2], DRAWN[:1]) if args.short else (SIDES, DRAWN)
  cycles = min(args.cycles, PERIOD) if args.short else args.cycles
  device = {"device": args.device.partition(":")[0], "place": args.device}
  cases = [
    {"kind": "rate", "scheme": scheme, "side": side, "cycles": cycles // (10 if side > 128 else 1)}
    for side in reversed(sides)
    for scheme in SCHEMES
  ]
  cases += [
    {"kind": "trace", "scheme": scheme, "side": side, "cycles": PERIOD}
    for side in drawn
    for scheme in SCHEMES
  ]
  name = "{kind}-{scheme}-{side}"
  return [[{"case": name.format(**case)} | device | case for case in cases]]


def model(case: Case) -> mujoco.MjModel:
  """Returns the organ and the tool, on whose slides the hand's springs act."""
  mesh = scene.shape("octa", case["side"] ** 2)
  # In random order: MuJoCo's compiler hashes edges, and neighbours with near numbers collide.
  order = np.random.default_rng(0).permutation(mesh.nvert)
  rest, elem = mesh.rest[order], np.argsort(order)[mesh.elem]
  top = int(np.argmax(rest[:, 2]))
  pulled = case["kind"] == "trace"
  keys = {"integrator": case["scheme"], "device": case["place"], "mass": TISSUE.mass}
  keys = {k: v for k, v in TISSUE.keys().items() if k != "thickness"} | keys
  shape, contact = (rest, elem), {"solref": "0.02 1"}
  if pulled:
    organ = scenes.organ(*shape, contact=contact | {"contype": 0, "conaffinity": 0}, **keys)
  else:
    count = max(8, min(24, scene.window_side(mesh)))
    keys["resident"] = str(case["device"] != "cpu").lower()
    organ = scenes.windowed(*shape, count=f"{count} {count} 1", contact=contact, **keys)
  place = rest[top] + [0, 0, 0 if pulled else TIP + 0.0006]
  slides = "".join(
    f'<joint name="{name}" type="slide" axis="{axis}"/>'
    for name, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
  )
  touch = 'contype="0" conaffinity="0"' if pulled else 'condim="1" solref="0.02 1"'
  tool = (
    f'<body name="tool" pos="{place[0]} {place[1]} {place[2]}">{slides}'
    f'<geom size="{TIP}" mass="{TOOL_MASS}" {touch}/></body>'
  )
  spring = f'kp="{COUPLING}" kv="{COUPLING_DAMPING}"'
  hand = "".join(f'<position joint="{name}" {spring}/>' for name in "xyz")
  extra = f"<actuator>{hand}</actuator>"
  if pulled:
    # Stiff: a node is light, and MuJoCo's springs go with what hangs on them.
    firm = 'solref="0.002 1" solimp="0.999 0.9999 0.001"'
    tie = f'<connect body1="organ_{top}" body2="tool" anchor="0 0 0" {firm}/>'
    extra += f"<equality>{tie}</equality>"
  memory = max(200, 3 * mesh.nvert**2 // 10**6) if pulled else 200
  xml = scenes.world(organ, tool, h=H, solver="CG", tolerance=1e-8, memory=memory, extra=extra)
  return mujoco.MjModel.from_xml_string(xml)


def lead(cycle: int) -> float:
  """Returns what springs and dampers lead the tool to, 0 free to 1 pressed or pulled."""
  down, rate = scene.ramp(cycle % PERIOD * H, 0.3)
  back, rate_back = scene.ramp(cycle % PERIOD * H - 0.5, 0.3)
  return down - back + COUPLING_DAMPING / COUPLING * (rate - rate_back)


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case of the tables, or a row every 20th cycle of a figure."""
  if case["device"] != "cpu" and not wp.is_cuda_available():
    raise CommandError(f"no CUDA device for {case['place']!r}", code=1)
  m = model(case)
  d = mujoco.MjData(m)
  organ = palpate.Organ(m, d, "organ")
  head = {key: case[key] for key in ("kind", "scheme", "device", "side")} | {"nodes": organ.nvert}
  return pulled(case, head, m, d, organ) if case["kind"] == "trace" else [
    pressed(case, head, m, d, organ)
  ]  # fmt: skip


def pulled(case: Case, head: Row, m, d, organ) -> list[Row]:
  """Returns force and place of the pulled node, along the pull and across."""
  top = int(np.argmax(organ.xpos0[:, 2]))
  rows = []
  for cycle in range(case["cycles"]):
    d.ctrl[:] = lead(cycle) * np.array([ASIDE, 0.0, DEPTH])
    mujoco.mj_step(m, d)
    if cycle % 20 == 0:
      moved = 1e3 * organ.displacement[top]
      felt = {"force_N": d.actuator_force[2], "force_x_N": d.actuator_force[0]}
      rows.append(head | {"cycle": cycle, "node_mm": moved[2], "node_x_mm": moved[0]} | felt)
  for row in rows:
    row["diverged"] = int(organ.error is not None or scene.bad(d))
  return rows


def pressed(case: Case, head: Row, m, d, organ) -> Row:
  """Returns mean and standard deviation of a haptic cycle's time and of its parts' [ms]."""
  clock = runner.clock if case["device"] == "cpu" else time.perf_counter
  spent, iterations, contacts = np.zeros(case["cycles"]), [], 0
  for cycle in range(-20, case["cycles"]):
    place = -DEPTH * lead(max(cycle, 0))
    start = clock()
    d.ctrl[2] = place
    mujoco.mj_step(m, d)
    float(d.actuator_force[2])
    if cycle >= 0:
      spent[cycle] = 1e3 * (clock() - start)
      iterations.append(organ.iterations)
      contacts = max(contacts, d.ncon)
  row = head | {"cycles": case["cycles"], "contacts": contacts}
  row |= {"cycle_ms": spent.mean(), "cycle_sd": spent.std(), "rate_hz": 1e3 / spent.mean()}
  row |= {"iterations": float(np.mean(iterations))}
  row["diverged"] = int(organ.error is not None or scene.bad(d))
  count = min(REPLAYS, case["cycles"])
  mujoco.mj_resetData(m, d)
  row |= phases(m, d)
  for name, each in loop.times(scenes.workspace(organ), count, clock).items():
    if name in PARTS:
      row |= {f"{name}_ms": each.mean(), f"{name}_sd": each.std()}
  return row


def phases(m, d) -> Row:
  """Returns MuJoCo's broad and narrow phase, means of the cycles that press [ms]."""
  kinds = {"broad_ms": mujoco.mjtTimer.mjTIMER_COL_BROAD}
  kinds["narrow_ms"] = mujoco.mjtTimer.mjTIMER_COL_NARROW
  mujoco.set_mjcb_time(lambda: 1e3 * time.perf_counter())
  try:
    for cycle in range(400):
      if cycle == 300:
        before = {name: d.timer[kind].duration for name, kind in kinds.items()}
      d.ctrl[2] = -DEPTH * lead(cycle)
      mujoco.mj_step(m, d)
  finally:
    mujoco.set_mjcb_time(None)
  return {name: (d.timer[kind].duration - before[name]) / 100 for name, kind in kinds.items()}


def draw(rows: list[Row], out: pathlib.Path) -> list[pathlib.Path]:
  """Draws rate and integration time against size, and force and displacement against cycles."""
  return [_rates(rows, out), _traces(rows, out)]


_COLOURS = {
  ("implicit", "cuda"): "#08519c", ("implicit", "cpu"): "#6baed6", ("neumann", "cuda"): "#54278f",
  ("neumann", "cpu"): "#9e9ac8", ("explicit", "cuda"): "#00441b", ("explicit", "cpu"): "#2ca02c",
}  # fmt: skip


def _stable(rows: list[Row]) -> list[Row]:
  """Returns the rows of the tables whose run did not diverge: others have no rate."""
  return [r for r in rows if r["kind"] == "rate" and not r["diverged"]]


def _rates(rows: list[Row], out: pathlib.Path) -> pathlib.Path:
  figure, axes = plots.grid(1, 2, width=9.0, height=4.0)
  for ax, key, then, label in (
    (axes[0], "rate_hz", RATE, "haptic update rate [Hz]"),
    (axes[1], "step_ms", INTEGRATION, "integration [ms]"),
  ):
    for which, colour in _COLOURS.items():
      mine = [r for r in _stable(rows) if (r["scheme"], r["device"]) == which]
      mine.sort(key=lambda r: r["nodes"])
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
  figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=7,
                frameon=False)  # fmt: skip
  about = "Tables 7.1 and 7.2 of the thesis (crosses) and today's program (dots)"
  return plots.save(figure, out / "thesis_rate.png", about)


def _traces(rows: list[Row], out: pathlib.Path) -> pathlib.Path:
  """Draws a panel a scheme and size; the CPU's lines, and dots of CUDA, which lie on them."""
  traces = [r for r in rows if r["kind"] == "trace"]
  sides = sorted({r["side"] for r in traces})
  figure, axes = plots.grid(len(SCHEMES), max(1, len(sides)), 3.2 * max(1, len(sides)), 7.0)
  for line, scheme in zip(axes.reshape(len(SCHEMES), -1), SCHEMES, strict=True):
    for ax, side in zip(line, sides, strict=False):
      right = ax.twinx()
      for device, marks in (("cpu", ("-", "--")), ("cuda", (".", "."))):
        mine = [
          r for r in traces if (r["scheme"], r["device"], r["side"]) == (scheme, device, side)
        ]
        cycles = [r["cycle"] for r in mine]
        for axis, mark in zip(("", "_x"), marks, strict=True):
          ax.plot(cycles, [r[f"node{axis}_mm"] for r in mine], mark, color="#2f6f9f", lw=1.4, ms=3)
          right.plot(
            cycles, [r[f"force{axis}_N"] for r in mine], mark, color="#c1442e", lw=1.2, ms=3
          )
      right.tick_params(labelsize=8)
      right.spines["top"].set_visible(False)
      ax.set_title(f"{scheme}, {side} x {side}", loc="left", fontsize=9)
      if side == sides[0]:
        ax.set_ylabel("pulled node [mm]", color="#2f6f9f", fontsize=7)
      if side == sides[-1]:
        right.set_ylabel("force [N]", color="#c1442e", fontsize=8)
      if scheme == SCHEMES[-1]:
        ax.set_xlabel("haptic cycle", fontsize=8)
  about = "The pulled node, up and (dashed) across; dots: CUDA (figures 7.6-7.14)"
  return plots.save(figure, out / "thesis_trace.png", about)


def summarize(rows: list[Row], conditions: str = "") -> list[str]:
  """Returns the page: each table of the thesis with today's figures beside it.

  Args:
    rows: of all devices
    conditions: what else ran on the machine, see `conditions`
  """
  rates = {(r["scheme"], r["device"], r["side"]): r for r in _stable(rows)}
  traces = [r for r in rows if r["kind"] == "trace"]
  lines = [
    "",
    "Today, and in brackets the thesis (3.0 GHz Pentium 4, GeForce 7600 GS, 2008), whose implicit "
    "scheme is our `neumann`; our `implicit` solves to a residual of 1e-4. n x n is n^2 + 2 nodes. "
    "A haptic cycle is a whole `mj_step` with a window under the tool, which a hand presses 8 mm "
    "into an organ of 1.2 kg through a virtual coupling. Means of 10,000 cycles (1000 at 256 x "
    f"256) and of {REPLAYS} replays of a part, +- their standard deviation; on the CPU of the "
    "thread's own time. A run that diverged is marked and has no figures. "
    "[thesis_cpu.csv](thesis_cpu.csv), [thesis_cuda.csv](thesis_cuda.csv).",
    *(["", conditions] if conditions else []),
    "",
    *_tables(rates, {(r["scheme"], r["device"], r["side"]) for r in rows if r["diverged"]}),
    *_headline(rates),
    *_speedup(rates),
  ]
  held = [r for r in traces if 300 <= r["cycle"] < 500 and not r["diverged"]]
  gone = sum(abs(r["force_N"]) < 1e-3 for r in held)
  names = sorted({f"{r['scheme']} on {r['device']} at {r['side']} x {r['side']}"
                  for r in rows if r["diverged"]})  # fmt: skip
  behind = [
    f"{r[key]:.3g} {unit} for {was[k[:2]][k[2]]:g} ({k[0]} on {k[1]}, {k[2]} x {k[2]})"
    for k, r in rates.items()
    for key, was, unit, sign in (("rate_hz", RATE, "Hz", 1), ("step_ms", INTEGRATION, "ms", -1))
    if k[2] in was.get(k[:2], {}) and sign * (r[key] - was[k[:2]][k[2]]) < 0
  ]
  slow = [f"{k[0]} on {k[1]} at {k[2]} x {k[2]}" for k, r in rates.items() if r["rate_hz"] < 1000]
  return [
    *lines,
    "",
    f"Under 1 kHz: {', '.join(slow) or 'nothing'}. Slower than the thesis: "
    f"{'; '.join(behind) or 'nothing'}. Not stable at 1 ms: {', '.join(names) or 'nothing'}. Of "
    f"{len(held)} forces (every 20th cycle) while the node is held, {gone} are gone (figures 7.6 "
    "to 7.14: [trace](thesis_trace.png), whose steps are the inertia of a tool of 20 g where the "
    "hand starts and stops; rates: [rate](thesis_rate.png)).",
  ]


def _tables(rates: dict[tuple, Row], diverged: set[tuple]) -> list[str]:
  """Returns the tables 7.1 to 7.4; `diverged` has the runs without figures."""
  sides = sorted({key[2] for key in [*rates, *diverged]})
  devices = [device for device in ("cuda", "cpu") if any(k[1] == device for k in rates)]

  def cell(run: tuple, key: str, spread: str, then: float | None) -> str:
    row = rates.get(run)
    if row is None:
      return "diverged" if run in diverged else "-"
    sd = f" +- {row[spread]:.1g}" if row.get(spread, "") != "" else ""
    return f"{row[key]:.3g}{sd}" + (f" ({then:g})" if then else "")

  def table(title: str, lines: list[tuple]) -> list[str]:
    filled = [
      [scheme, device, *name, *(
        cell((scheme, device, side), key, spread, then.get(side)) for side in sides)]
      for scheme, device, name, key, spread, then in lines
    ]  # fmt: skip
    names = ["part"] if lines and lines[0][2] else []
    head = ["scheme", "device", *names, *(f"{side} x {side}" for side in sides)]
    return [f"## {title}", "", *plots.table(head, filled), ""] if lines else []

  pairs = [(scheme, device) for device in devices for scheme in SCHEMES]
  gpu = [("neumann", "cuda", [part], f"{part}_ms", f"{part}_sd", GPU[part]) for part in GPU]
  cpu = [("implicit", "cpu", ["plugin's search"], "search_ms", "search_sd", {})]
  cpu += [("implicit", "cpu", [f"{p} phase"], f"{p}_ms", "", CPU[p]) for p in ("broad", "narrow")]
  cpu += [
    ("implicit", "cpu", [name], f"{part}_ms", f"{part}_sd", CPU.get(part, {}))
    for part, name in (("assemble", "assembly (Hessian)"), ("solve", "solve"))
  ]
  return [
    *table("7.1 Haptic update rate [Hz]",
           [(*w, [], "rate_hz", "", RATE.get(w, {})) for w in pairs]),
    *table("Haptic cycle, of which 7.1 is the inverse [ms]",
           [(*w, [], "cycle_ms", "cycle_sd", {}) for w in pairs]),
    *table("7.2 Integration [ms]",
           [(*w, [], "step_ms", "step_sd", INTEGRATION.get(w, {})) for w in pairs]),
    *table("7.3 Parts of the GPU step [ms]", gpu if "cuda" in devices else []),
    *table("7.4 Parts of the CPU step [ms]", cpu if "cpu" in devices else []),
  ]  # fmt: skip


def _speedup(rates: dict[tuple, Row]) -> list[str]:
  """Returns how much faster a haptic cycle is with CUDA, and from how many nodes on."""
  out = []
  for scheme in SCHEMES:
    sides = [s for s in SIDES if {(scheme, "cuda", s), (scheme, "cpu", s)} <= set(rates)]
    if not sides:
      continue
    cpu, gpu = ([rates[scheme, device, s]["cycle_ms"] for s in sides] for device in ("cpu", "cuda"))
    ratio = np.array(cpu) / np.array(gpu)
    nodes = [rates[scheme, "cpu", s]["nodes"] for s in sides]
    beyond = np.flatnonzero(ratio > 1)
    if not beyond.size:
      crosses = "at no size"
    elif beyond[0] == 0:
      crosses = "from the smallest on"
    else:
      k = beyond[0]
      share = -math.log(ratio[k - 1]) / math.log(ratio[k] / ratio[k - 1])
      at = nodes[k - 1] * (nodes[k] / nodes[k - 1]) ** share
      crosses = f"from {at:.2g} nodes on"
    each = ", ".join(f"{r:.2g} at {n}" for r, n in zip(ratio, nodes, strict=True))
    out.append(f"{scheme}: times faster with the GPU {each}; faster {crosses}.")
  return out


def _headline(rates: dict[tuple, Row]) -> list[str]:
  """Returns the thesis's headline, the implicit scheme on the GPU over `explicit` on the CPU."""
  side, slow = 128, ("explicit", "cpu", 128)
  fast = [("neumann", "cuda", side), ("implicit", "cuda", side)]
  if not {slow, *fast} <= set(rates):
    return []

  def ratio(key: str, sign: int) -> str:
    each = ((rates[run][key] / rates[slow][key]) ** sign for run in fast)
    return " and ".join(f"{r:.2g} (`{run[0]}`)" for r, run in zip(each, fast, strict=True))

  then = INTEGRATION["explicit", "cpu"][side] / INTEGRATION["neumann", "cuda"][side]
  rate = RATE["neumann", "cuda"][side] / RATE["explicit", "cpu"][side]
  return [
    "## The thesis's headline", "",
    f"The thesis compares its implicit scheme on the GPU with `explicit` on the CPU and reports up "
    f"to {HEADLINE} times the speed at {side} x {side}. Its table 7.2 gives {then:.1f} times for "
    f"the integration and its table 7.1 {rate:.1f} times for the haptic rate. Today the "
    f"integration is {ratio('step_ms', -1)} times as fast, and the haptic rate "
    f"{ratio('rate_hz', 1)} times as high.",
    "",
  ]  # fmt: skip


def conditions(out: pathlib.Path) -> str:
  """Returns how many runs shared the machine; a single one had its card and cores to itself."""
  words = []
  for device in ("cuda", "cpu"):
    about = results.notes(out / f"thesis_{device}.csv")
    jobs = about.get("jobs") or 1
    if about and jobs > 1:
      where = f"{about['cores']} cores" + (" and one card" if device == "cuda" else "")
      words.append(f"`{device}`: {jobs} runs at a time shared {where}, so that a run alone may be "
                   "faster")  # fmt: skip
    elif about:
      words.append(f"`{device}`: one run at a time, the bench's only one on its card and cores")
  return f"Measured on {'; '.join(words)}." if words else ""


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with: the thesis's headline, and the rates on each device."""
  stable, lines = {(r["scheme"], r["device"], r["side"]): r for r in _stable(rows)}, []
  slow, fast = (stable.get((*which, 128)) for which in (("explicit", "cpu"), ("neumann", "cuda")))
  if slow and fast:
    lines.append(f"Implicit on the GPU over `explicit` on the CPU, 128 x 128: {HEADLINE} times in "
                 f"the thesis; today {slow['step_ms'] / fast['step_ms']:.0f} times in the "
                 f"integration and {fast['rate_hz'] / slow['rate_hz']:.1f} times in the whole "
                 "haptic cycle.")  # fmt: skip
  for device in ("cuda", "cpu"):
    found = []
    for which, then in RATE.items():
      if which[1] == device and (sides := [s for s in then if (*which, s) in stable]):
        side = max(sides)
        rate = stable[*which, side]["rate_hz"]
        found.append(f"{rate:.0f} Hz with `{which[0]}` at {side} x {side}, {rate / then[side]:.2g} "
                     f"times the thesis's {then[side]}")  # fmt: skip
    lines += [f"Haptic cycles on {device}: {'; '.join(found)}."] if found else []
  return lines


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Draws the figures and writes the page, of all devices that there are results of."""
  out, title = path.parent, "The tables of the thesis, measured today"
  rows = [r for path in sorted(out.glob("thesis_c*.csv")) for r in results.read(path)
          if r["status"] == "ok"]  # fmt: skip
  return results.Page(title, finding(rows), summarize(rows, conditions(out)), draw(rows, out))


BENCH = Bench(
  "thesis", stages, run, _COLUMNS, report, arguments, file="thesis_{device}", jobs=1, limit=500.0
)
