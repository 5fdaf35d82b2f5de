"""Times the whole loop, mj_step with a probe in contact with a windowed organ, and where it goes.

    python tests/benchmarks/loop.py --device cuda:0 --nodes 16384 65536 262144 -o results

An octahedral sphere of radius 5 cm (E = 30 kPa, t = 2 mm, 0.1 kg, foundation 1e5 Pa/m, h = 1 ms),
pinned below, is pressed 1.5 mm deep by a probe of 5 mm, or as thick as `--tip` says, and slid
over, solved to the tolerance given. On CUDA the motion stays on the device (`resident`). Bending is
off unless `--bend 1`. The last columns are medians of what one step spends: MuJoCo itself, the
CPU's side of the coupling, and waiting for the device (search, transfer and what is left of the
solve, which a resident organ begins before MuJoCo looks for contacts); `rest_ms` is a step with the
probe away and the organ asleep.
"""

import argparse
import csv
import itertools
import json
import pathlib
import time

import mujoco
import numpy as np
import palpate
import warp as wp
from palpate import engine
from palpate.models import grid

RADIUS, H = 0.05, 1e-3


def model(
  nodes: int, device: str, tolerance: float, bend: float, slots: int, condim: int, tip: float
) -> mujoco.MjModel:
  """Returns a sphere of about `nodes` nodes with a window under a probe of radius `tip`."""
  point, elem = grid.octasphere(max(2, round(np.sqrt((nodes - 2) / 4))))
  # In random order: MuJoCo's compiler hashes edges, and neighbours with near numbers collide.
  order = np.random.default_rng(0).permutation(len(point))
  point, elem = np.asarray(point)[order] * RADIUS, np.argsort(order)[np.asarray(elem)]
  pin = np.flatnonzero(point[:, 2] < -0.9 * RADIUS)
  side = round(np.sqrt(slots))
  keys = {
    "young": 3e4,
    "poisson": 0.3,
    "foundation": 1e5,
    "bend": bend,
    "device": device,
    "tolerance": tolerance,
    "window": "window",
    "mass": 0.1,
    "resident": str(device != "cpu").lower(),
    "pin": " ".join(map(str, pin)),
  }
  config = "".join(f'<config key="{k}" value="{v}"/>' for k, v in keys.items())
  spec = mujoco.MjSpec.from_string(f"""
<mujoco><option timestep="{H}" solver="CG" gravity="0 0 0"/><size memory="2G"/>
<extension><plugin plugin="palpate.organ"/></extension>
<worldbody>
  <body name="organ"><plugin plugin="palpate.organ">{config}</plugin>
    <flexcomp name="organ" rigid="true" type="direct" dim="2" radius="0.0002"
      point="{" ".join(f"{x:.8g}" for x in point.ravel())}"
      element="{" ".join(map(str, np.asarray(elem).ravel()))}">
      <contact contype="0" conaffinity="0" selfcollide="none"/></flexcomp></body>
  <flexcomp name="window" type="grid" count="{side} {side} 1" spacing=".01 .01 .01" dim="2"
    mass="{slots * 0.1 / len(point)}" radius="0.0002"><edge damping="1e-9"/>
    <contact selfcollide="none" condim="{condim}" solref="0.004 1"
      solimp="0.99 0.999 0.001"/></flexcomp>
  <body pos="0 0 {RADIUS + tip + 0.0002}"><joint name="z" type="slide" axis="0 0 1"/>
    <joint name="x" type="slide" axis="1 0 0"/><geom size="{tip}" mass="0.05" condim="1"/></body>
</worldbody>
<actuator><position joint="z" kp="500" kv="10"/><position joint="x" kp="500" kv="10"/></actuator>
</mujoco>""")
  return spec.compile()


def measure(
  nodes: int,
  device: str,
  tolerance: float,
  bend: float,
  slots: int,
  condim: int,
  tip: float,
  steps: int,
) -> dict:
  """Returns medians over the last half of `steps` steps, in ms."""
  start = time.perf_counter()
  m = model(nodes, device, tolerance, bend, slots, condim, tip)
  d = mujoco.MjData(m)
  made = time.perf_counter() - start
  organ = palpate.Organ(m, d, "organ")
  w = engine.find(d._address, 0)
  spent = {"cpu": 0.0, "device": 0.0}
  timed(w, spent)
  rows, iterations, contacts = [], [], []
  for step in range(steps):
    d.ctrl[0] = -0.0015 * min(1.0, step / (0.3 * steps))
    d.ctrl[1] = 0.002 * max(0.0, step / steps - 0.4)
    spent["cpu"] = spent["device"] = 0.0
    before = time.perf_counter()
    mujoco.mj_step(m, d)
    rows.append((time.perf_counter() - before, spent["cpu"], spent["device"]))
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
  out["rest_ms"] = rest(m, d, organ)
  assert organ.error is None, organ.error
  return out


def timed(w, spent: dict):
  """Makes a workspace note what its parts take."""

  def wrap(function, key):
    def call(*args):
      before = time.perf_counter()
      inner = spent["device"] if key == "cpu" else 0.0
      function(*args)
      taken = time.perf_counter() - before
      spent[key] += taken - (spent["device"] - inner if key == "cpu" else 0.0)

    return call

  original = wp.capture_launch
  rest = w.resident.rest if w.resident else []
  device_graphs = {id(graph) for _, graph in [*w.solve, *w.respond, *rest]}

  def capture_launch(graph, *args):
    if id(graph) not in device_graphs:
      return original(graph, *args)
    before = time.perf_counter()
    original(graph, *args)
    if w.surface.device.is_cuda:
      wp.synchronize_device(w.surface.device)
    spent["device"] += time.perf_counter() - before

  wp.capture_launch = capture_launch
  w.run = wrap(w.run, "cpu")
  w.step = wrap(w.step, "cpu")


def rest(m, d, organ) -> float:
  """Returns a step's time in ms with the probe away and the organ asleep; NaN if it is awake."""
  d.ctrl[:] = 0.08, 0.0
  for _ in range(300):
    mujoco.mj_step(m, d, nstep=10)
    if organ.asleep:
      break
  times = []
  for _ in range(50):
    before = time.perf_counter()
    mujoco.mj_step(m, d)
    times.append(time.perf_counter() - before)
  return 1e3 * float(np.median(times)) if organ.asleep else float("nan")


def main():
  """Runs the benchmark."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--device", default="cpu")
  parser.add_argument("--nodes", type=int, nargs="+", default=[642, 2562, 4096, 10242])
  parser.add_argument("--tolerance", type=float, default=1e-3)
  parser.add_argument("--bend", type=float, default=0.0)
  parser.add_argument("--slots", type=int, default=100)
  parser.add_argument("--condim", type=int, nargs="+", default=[3], help="1 is without friction")
  parser.add_argument("--tip", type=float, nargs="+", default=[0.0025], help="radius [m]")
  parser.add_argument("--steps", type=int, default=400)
  parser.add_argument("-o", "--output", type=pathlib.Path)
  args = parser.parse_args()
  rows = []
  for nodes, tip, condim in itertools.product(args.nodes, args.tip, args.condim):
    scene = (args.tolerance, args.bend, args.slots, condim, tip)
    row = measure(nodes, args.device, *scene, args.steps)
    rows.append(row)
    print(json.dumps({k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}))
  if args.output:
    args.output.mkdir(parents=True, exist_ok=True)
    kind = "cpu" if args.device == "cpu" else "cuda"
    with open(args.output / f"loop_{kind}.csv", "w", newline="") as file:
      writer = csv.DictWriter(file, rows[0])
      writer.writeheader()
      writer.writerows(rows)


if __name__ == "__main__":
  main()
