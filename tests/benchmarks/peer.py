"""Times a whole mj_step in contact against MuJoCo's native flex, interleaved in one run.

    python tests/benchmarks/peer.py --nodes 642 2562 10242 -o tests/benchmarks/results

The same icosphere, mass, documented constants, contact and instrument on all sides, one thread
each: the peer with `integrator="discrete"` and the CG solver, ours with nodal and with window
coupling. MuJoCo 3.17's `elastic2d="stretch"` reaches a documented (E, nu) with nu' = nu / 2 and
E' = 4 E (1 + nu / 2) / (1 + nu) (fixed in 4.0).
"""

import argparse
import csv
import pathlib
import time

import mujoco
import numpy as np
import palpate
import trimesh

YOUNG, POISSON, THICKNESS, MASS, DAMPING = 3e4, 0.3, 0.002, 0.1, 0.002
RADIUS, H = 0.05, 1e-3
SCENES = (("stretch", 0), ("both", 1))  # the peer's elastic2d, our bend


SIDES = ("peer", "nodal", "window")


def model(subdivisions: int, side: str, peer: str, bend: int) -> mujoco.MjModel:
  """Returns a sphere pinned below and pressed from above, on one of `SIDES`."""
  mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
  point = " ".join(f"{x:.9g}" for x in mesh.vertices.ravel())
  element = " ".join(map(str, mesh.faces.ravel()))
  pin = " ".join(map(str, np.flatnonzero(mesh.vertices[:, 2] < -0.9 * RADIUS)))
  shape = f'type="direct" dim="2" radius="0.0005" point="{point}" element="{element}"'
  keys = {"young": YOUNG, "poisson": POISSON, "thickness": THICKNESS, "damping": DAMPING}
  keys |= {"bend": bend, "device": "cpu"}
  if side == "window":
    keys |= {"window": "window", "mass": MASS, "pin": pin}
  config = "".join(f'<config key="{k}" value="{v}"/>' for k, v in keys.items())
  plugin = f'<plugin plugin="palpate.organ">{config}</plugin>'
  option = '<option timestep="0.001" integrator="Euler" solver="CG" gravity="0 0 0"/>'
  contact = '<contact selfcollide="none" condim="3"/>'
  if side == "peer":
    nu = POISSON / 2
    young = 4 * YOUNG * (1 + POISSON / 2) / (1 + POISSON)
    inside = (
      f'<elasticity young="{young}" poisson="{nu}" thickness="{THICKNESS}" damping="{DAMPING}" '
      f'elastic2d="{peer}"/>'
    )
    option = '<option timestep="0.001" integrator="discrete" solver="CG" gravity="0 0 0"/>'
    organ = f"""<flexcomp name="organ" mass="{MASS}" {shape}>
      {inside}{contact}<pin id="{pin}"/></flexcomp>"""
  elif side == "nodal":
    organ = f"""<flexcomp name="organ" mass="{MASS}" {shape}>
      <edge damping="1e-9"/>{plugin}{contact}<pin id="{pin}"/></flexcomp>"""
  else:
    organ = f"""<body name="organ">{plugin}<flexcomp name="organ" rigid="true" {shape}>
      <contact contype="0" conaffinity="0" selfcollide="none"/></flexcomp></body>
    <flexcomp name="window" type="grid" count="10 8 1" spacing=".01 .01 .01" dim="2"
      mass="{80 * MASS / len(mesh.vertices)}" radius="0.0005">
      <edge damping="1e-9"/>{contact}</flexcomp>"""
  return mujoco.MjModel.from_xml_string(f"""
<mujoco>{option}<size memory="2G"/><extension><plugin plugin="palpate.organ"/></extension>
<worldbody>
  {organ}
  <body pos="0 0 {RADIUS + 0.0056}"><joint name="z" type="slide" axis="0 0 1"/>
    <geom size="0.005" mass="0.05"/></body>
</worldbody>
<actuator><position joint="z" kp="500" kv="10"/></actuator></mujoco>""")


def main():
  """Runs the benchmark."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--nodes", type=int, nargs="+", default=[642, 2562, 10242])
  parser.add_argument("--steps", type=int, default=100)
  parser.add_argument("-o", "--output", type=pathlib.Path)
  args = parser.parse_args()
  rows = []
  for nodes in args.nodes:
    subdivisions = round(np.log((nodes - 2) / 10) / np.log(4))
    for peer, bend in SCENES:
      sides = {}
      for name in SIDES:
        start = time.perf_counter()
        m = model(subdivisions, name, peer, bend)
        sides[name] = (m, mujoco.MjData(m), time.perf_counter() - start)
      times = {name: [] for name in sides}
      iterations, residuals = [], []
      organ = palpate.Organ(*sides["nodal"][:2], "organ")
      for step in range(args.steps + 20):
        for name, (m, d, _) in sides.items():
          d.ctrl[0] = -0.05 * m.opt.timestep * step - 0.001
          start = time.perf_counter()
          mujoco.mj_step(m, d)
          times[name].append(time.perf_counter() - start)
        iterations.append(organ.iterations)
        residuals.append(organ.residual)
      median = {name: 1e3 * float(np.median(values[20:])) for name, values in times.items()}
      row = {"nodes": organ.nvert, "bending": bend}
      row |= {f"{name}_ms": value for name, value in median.items()}
      row |= {f"{name}_ratio": median["peer"] / median[name] for name in SIDES[1:]}
      for name, (m, d, _) in sides.items():
        row |= {f"{name}_force_N": float(d.qfrc_constraint[m.nv - 1]), f"{name}_contacts": d.ncon}
      row |= {"iterations": float(np.mean(iterations[20:])), "residual_max": max(residuals[20:])}
      row["compile_s"] = sides["nodal"][2]
      rows.append(row)
      print({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()}, flush=True)
  if args.output:
    args.output.mkdir(parents=True, exist_ok=True)
    with open(args.output / "peer_cpu.csv", "w", newline="") as file:
      writer = csv.DictWriter(file, rows[0])
      writer.writeheader()
      writer.writerows(rows)


if __name__ == "__main__":
  main()
