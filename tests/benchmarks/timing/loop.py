"""Times the whole loop, mj_step with a probe in contact with a windowed organ, and where it goes.

    palpate bench loop --device cuda:0 --nodes 16384 65536 262144
    palpate bench loop --solid --nodes 1000 4000 --tip 0.005 --tolerance 1e-2
    palpate bench loop --draw

An octahedral sphere of radius 5 cm (E = 30 kPa, t = 2 mm, 0.1 kg, foundation 1e5 Pa/m, h = 1 ms),
pinned below, is pressed 1.5 mm deep by a probe of 5 mm, or as thick as `--tip` says, and slid
over, solved to the tolerance given. With `--solid` it is the liver, filled (E = 5 kPa, nu = 0.45,
1.2 kg), pressed 6 mm deep, by contacts as firm as those of `add_organ`. On CUDA the motion stays
on the device (`resident`). Bending is off unless `--bend 1`. Times on the CPU are CPU time. The
last columns are medians of what one step spends: MuJoCo itself, the CPU's side of the coupling, and
waiting for the device (search, transfer and what is left of the solve, which a resident organ
begins before MuJoCo looks for contacts); `rest_ms` is a step with the probe away and the organ
asleep. The parts of the device's work are timed by themselves after the run, in the state of its
last step. loop.md says what they cost a node.
"""

import argparse
import itertools
import pathlib
import time

import mujoco
import numpy as np
import palpate
import scenes
import warp as wp
from benchmarks import plots, results, runner
from benchmarks.runner import Bench, Case, Row
from palpate.engine import workspace
from palpate.engine.layout import HEAD, MODE
from palpate.engine.windows import windowed
from palpate.models import shapes
from palpate.models.meshing import grid
from palpate.tissue import step as stepping
from palpate.tissue.types import Stage

RADIUS, H = 0.05, 1e-3
DEEP = 0.006  # of the press on a solid [m]
SHELL = {"young": 3e4, "poisson": 0.3, "foundation": 1e5}
SOLID = {"elements": "solid", "young": 5e3, "poisson": 0.45, "mass": 1.2, "damping": 0.002}


def shape(nodes: int, solid: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns points and triangles of an organ of about `nodes` nodes, and which are held."""
  if solid:
    point, elem = shapes.liver(nodes)
    point = point - point.mean(axis=0)
    height = point[:, 2] - point[:, 2].min()
    return point, elem, height < 0.3 * height.max()
  point, elem = grid.octasphere(max(2, round(np.sqrt((nodes - 2) / 4))))
  # In random order: MuJoCo's compiler hashes edges, and neighbours with near numbers collide.
  order = np.random.default_rng(0).permutation(len(point))
  point, elem = np.asarray(point)[order] * RADIUS, np.argsort(order)[np.asarray(elem)]
  return point, elem, point[:, 2] < -0.9 * RADIUS


def model(
  nodes: int,
  device: str,
  tolerance: float,
  bend: float,
  slots: int,
  condim: int,
  tip: float,
  solid: str = "",
) -> mujoco.MjModel:
  """Returns an organ of about `nodes` nodes with a window under a probe of radius `tip`."""
  point, elem, held = shape(nodes, solid)
  side = round(np.sqrt(slots))
  tissue = SOLID if solid else SHELL | {"bend": bend}
  # That of `add_organ` for solids: at MuJoCo's own a tip sinks into meshes of light nodes.
  solref = "0.004 1" if solid else "0.02 1"
  organ = scenes.windowed(
    point,
    elem,
    count=f"{side} {side} 1",
    radius=0.0002,
    contact={"condim": condim, "solimp": "0.99 0.999 0.001", "solref": solref},
    device=device,
    tolerance=tolerance,
    resident=str(device != "cpu").lower(),
    pin=" ".join(map(str, np.flatnonzero(held))),
    **tissue,
  )
  x, y, top = point[point[:, 2].argmax()] if solid else (0, 0, RADIUS)
  probe = f"""<body pos="{x} {y} {top + tip + 0.0002}"><joint name="z" type="slide" axis="0 0 1"/>
    <joint name="x" type="slide" axis="1 0 0"/>
    <geom size="{tip}" mass="0.05" condim="1" solref="{solref}"/></body>"""
  drive = """<actuator><position joint="z" kp="500" kv="10"/>
    <position joint="x" kp="500" kv="10"/></actuator>"""
  xml = scenes.world(organ, probe, h=H, solver="CG", tolerance=1e-8, memory=2048, extra=drive)
  return mujoco.MjSpec.from_string(xml).compile()


def measure(
  nodes: int,
  device: str,
  tolerance: float,
  bend: float,
  slots: int,
  condim: int,
  tip: float,
  steps: int,
  solid: str = "",
) -> dict:
  """Returns medians over the last half of `steps` steps, in ms."""
  start = time.perf_counter()
  m = model(nodes, device, tolerance, bend, slots, condim, tip, solid)
  d = mujoco.MjData(m)
  made = time.perf_counter() - start
  organ = palpate.Organ(m, d, "organ")
  w = scenes.workspace(organ)
  spent = {"cpu": 0.0, "device": 0.0}
  clock = runner.clock if device == "cpu" else time.perf_counter
  timed(w, spent, clock)
  rows, iterations, contacts = [], [], []
  for k in range(steps):
    d.ctrl[0] = -(DEEP if solid else 0.0015) * min(1.0, k / (0.3 * steps))
    d.ctrl[1] = 0.002 * max(0.0, k / steps - 0.4)
    spent["cpu"] = spent["device"] = 0.0
    before = clock()
    mujoco.mj_step(m, d)
    rows.append((clock() - before, spent["cpu"], spent["device"]))
    iterations.append(organ.iterations)
    contacts.append(d.ncon)
  total, cpu, dev = 1e3 * np.median(np.array(rows[steps // 2 :]), axis=0)
  out = {
    "device": organ.device,
    "nodes": organ.nvert,
    "bend": bend,
    "tolerance": tolerance,
    "slots": w.organ.windows.nslot,
    "condim": condim,
    "tip_m": tip,
    "contacts": int(np.median(contacts[steps // 2 :])),
    "iterations": float(np.mean(iterations[steps // 2 :])),
    "force_N": float(d.qfrc_constraint[m.nv - 2]),
    "residual": organ.residual,
    "missed": organ.window_overflow[0],
    "step_ms": total,
    "mujoco_ms": total - cpu - dev,
    "coupling_ms": cpu,
    "device_ms": dev,
    "rate_Hz": 1e3 / total,
    "make_s": made,
  }
  out |= parts(w, clock)
  out["rest_ms"] = rest(m, d, organ, clock)
  assert organ.error is None, organ.error
  return out


def timed(w, spent: dict, clock=time.perf_counter):
  """Makes a workspace note what its parts take."""

  def wrap(function, key):
    def call(*args):
      before = clock()
      inner = spent["device"] if key == "cpu" else 0.0
      function(*args)
      taken = clock() - before
      spent[key] += taken - (spent["device"] - inner if key == "cpu" else 0.0)

    return call

  original = wp.capture_launch
  rest = w.graphs.resident.rest if w.graphs.resident else []
  device_graphs = {id(graph) for _, graph in [*w.graphs.solve, *w.graphs.respond, *rest]}

  def capture_launch(graph, *args):
    if id(graph) not in device_graphs:
      return original(graph, *args)
    before = clock()
    original(graph, *args)
    if w.body.device.is_cuda:
      wp.synchronize_device(w.body.device)
    spent["device"] += clock() - before

  wp.capture_launch = capture_launch
  w.run = wrap(w.run, "cpu")
  w.step = wrap(w.step, "cpu")


def parts(w, clock=time.perf_counter) -> dict:
  """Returns what each part of a step's work on the organ's device takes, medians in ms."""
  median = {name: float(np.median(each)) for name, each in times(w, clock=clock).items()}
  rest_of_step = median["step"] - median["assemble"] - median["solve"]
  return {
    "search_ms": median["search"],
    "transfer_ms": median.get("to", 0.0) + median.get("from", 0.0),
    "assemble_ms": median["assemble"],
    "solve_ms": median["solve"],
    "integrate_ms": median["enter"] + median["end"] + max(0.0, rest_of_step),
  }


def times(w, count: int = 20, clock=time.perf_counter) -> dict[str, np.ndarray]:
  """Returns how long the parts of a step's work on the organ's device take [ms], (count,) each.

  `step` is the scheme's, with `assemble` and `solve` in it where it has them; `to` and `from` are
  what crosses to a device and back.
  """
  body, scheme = w.body, w.config.integrator
  workspace.sync(w)
  state = w.plugin_state
  kept = state.copy()
  works = {"step": lambda: stepping.step(body, scheme)}
  if stepping.SCHEMES[scheme].respond:
    works["assemble"] = lambda: stepping.assemble(body, Stage.FIRST)
    works["solve"] = lambda: stepping.solve(body, Stage.FIRST)
  out = replay(body.device, works, count, clock)
  phases = windowed.Phases(w.host, w.views, w.share)
  side = wp.get_device(phases.side)
  boxes = [(wp.clone(w.views[name], device=side), w.views[name]) for name in ("inbox", "outbox")]
  phases.boxes["inbox"].head.numpy()[HEAD.mode] = MODE.commit  # there is a step to end
  works = {"enter": phases.enter, "search": phases.look, "end": phases.end}
  if side.is_cuda:
    works["to"] = lambda: wp.copy(*boxes[0])
    works["from"] = lambda: wp.copy(*reversed(boxes[1]))
  out |= replay(side, works, count, clock)
  state[:] = kept
  workspace.bind(w, w.model)
  return out


def replay(device, works: dict, count: int, clock=time.perf_counter) -> dict[str, np.ndarray]:
  """Returns the times of recorded graphs of `works`, in turn [ms], (count,) each."""
  graphs, spent = {}, {name: [] for name in works}
  for name, work in works.items():
    with wp.ScopedDevice(device), wp.ScopedCapture(device=device) as capture:
      work()
    graphs[name] = capture.graph
  for name in count * list(works):
    if device.is_cuda:
      start, end = (wp.Event(device, enable_timing=True) for _ in range(2))
      wp.record_event(start)
      wp.capture_launch(graphs[name])
      wp.record_event(end)
      spent[name].append(wp.get_event_elapsed_time(start, end))
    else:
      before = clock()
      wp.capture_launch(graphs[name])
      spent[name].append(1e3 * (clock() - before))
  return {name: np.array(each) for name, each in spent.items()}


def rest(m, d, organ, clock) -> float:
  """Returns a step's time in ms with the probe away and the organ asleep; NaN if it is awake."""
  d.ctrl[:] = 0.08, 0.0
  for _ in range(300):
    mujoco.mj_step(m, d, nstep=10)
    if organ.asleep:
      break
  times = []
  for _ in range(50):
    before = clock()
    mujoco.mj_step(m, d)
    times.append(clock() - before)
  return 1e3 * float(np.median(times)) if organ.asleep else float("nan")


def table(out: pathlib.Path) -> list[str]:
  """Returns the lines of the page, microseconds a step and nanoseconds a node."""
  lines = [
    "Microseconds; device: its work by itself, which on CUDA goes on beside MuJoCo's. Per node:",
    "the device's work in ns. From loop_cpu.csv and loop_cuda.csv; `palpate bench loop --help`",
    "says how they were measured.",
    "",
    *_rows(out, "loop_c*.csv"),
  ]
  solids = _rows(out, "loop_solid_c*.csv")
  about = "The filled liver, `--solid --tip 0.005 --tolerance 1e-2`; nodes on its surface."
  return lines + (["", "## Solids", "", about, "", *solids] if len(solids) > 2 else [])


def _rows(out: pathlib.Path, files: str) -> list[str]:
  """Returns the table of the rows in files."""
  lines = [
    f"| device | nodes | condim | contacts | iterations | mj_step | rate | {' | '.join(_COLUMNS)} "
    "| device per node | asleep |",
    "|" + "---|" * (9 + len(_COLUMNS)),
  ]
  for path in sorted(out.glob(files)):
    for row in results.read(path):
      cost = [1e3 * float(row[f"{name}_ms"]) for name in _COLUMNS.values()]
      own = sum(cost[2:]) * 1e3 / row["nodes"]
      cells = [row["device"], row["nodes"], row["condim"], row["contacts"]]
      cells += [f"{row['iterations']:.0f}", _digits(1e3 * row["step_ms"])]
      cells += [f"{row['rate_Hz']:.0f} Hz", *map(_digits, cost), f"{own:.1f} ns"]
      lines.append(f"| {' | '.join(map(str, [*cells, _digits(1e3 * float(row['rest_ms']))]))} |")
  return lines


# Columns of the table: the whole step's first, then the parts of the device's work.
_COLUMNS = {
  "MuJoCo": "mujoco",
  "coupling": "coupling",
  "search": "search",
  "transfer": "transfer",
  "assemble": "assemble",
  "solve": "solve",
  "integrate": "integrate",
}


def _digits(value: float) -> str:
  return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--device", default="cpu", help="cpu or cuda:0 (%(default)s)")
  add("--nodes", type=int, nargs="+", default=[642, 2562, 4096, 10242])
  add("--tolerance", type=float, default=1e-3)
  add("--bend", type=float, default=0.0)
  add("--slots", type=int, default=100)
  add("--condim", type=int, nargs="+", default=[3], help="1 is without friction")
  add("--tip", type=float, nargs="+", default=[0.0025], help="radius [m]")
  add("--steps", type=int, default=400)
  add("--solid", action="store_const", const="_solid", default="", help="the filled liver")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a size, tip and kind of contact."""
  keys = {k: getattr(args, k) for k in ("device", "tolerance", "bend", "slots", "steps", "solid")}
  nodes = args.nodes[:1] if args.short else args.nodes
  return [
    [
      {"case": f"{n}-{tip:g}-{condim}", "nodes": n, "condim": condim, "tip": tip} | keys
      for n, tip, condim in itertools.product(nodes, args.tip, args.condim)
    ]
  ]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  return [measure(**{key: value for key, value in case.items() if key != "case"})]


def _rates(out: pathlib.Path) -> dict[str, list[Row]]:
  """Returns the rows with friction of each kind of device, skins before solids."""
  found = {}
  for path in sorted(out.glob("loop_*.csv")):
    rows = [r for r in results.read(path) if r["status"] == "ok" and r["condim"] == 3]
    if rows:
      name = f"{'solid, ' * ('solid' in path.stem)}{rows[0]['device'].partition(':')[0]}"
      found[name] = sorted(rows, key=lambda r: r["nodes"])
  return found


def finding(out: pathlib.Path) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for name, rows in _rates(out).items():
    fast = [r for r in rows if r["rate_Hz"] >= 1000]
    if fast and "solid" not in name:
      lines.append(f"On `{name}` a whole step with a probe in contact runs at 1 kHz or faster up "
                   f"to {fast[-1]['nodes']} nodes ({fast[-1]['rate_Hz']:.0f} Hz).")  # fmt: skip
  solids = [f"{rows[-1]['rate_Hz']:.0f} Hz on `{name.removeprefix('solid, ')}` "
            f"({rows[-1]['nodes']} surface nodes)"
            for name, rows in _rates(out).items() if "solid" in name]  # fmt: skip
  return [*lines, *(["The largest solid: " + ", ".join(solids) + "."] if solids else [])][:3]


def draw(out: pathlib.Path) -> pathlib.Path:
  """Draws the rate over the number of nodes."""
  panels = {"": {name: ([r["nodes"] for r in rows], [r["rate_Hz"] for r in rows])
                 for name, rows in _rates(out).items()}}  # fmt: skip
  title = "Whole steps with a probe in contact"
  return plots.curves(out / "loop.png", title, panels, "nodes", "steps a second")


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page, of all devices that there are results of."""
  out, title = path.parent, "What a step costs, and where the time goes"
  return results.Page(title, finding(out), table(out), [draw(out)])


BENCH = Bench("loop", stages, run, report=report, arguments=arguments, file="loop{solid}_{device}")
