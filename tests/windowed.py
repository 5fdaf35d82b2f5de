"""A sphere with a window under a probe, and how the tests drive the probe."""

import mujoco
import numpy as np
import trimesh

RADIUS = 0.05
KEYS = {"young": 3e4, "poisson": 0.3, "foundation": 1e4, "tolerance": 1e-6, "device": "cpu"}


def scene(window=True, *, keys=None, count="9 6 1", frame="", condim=3, h=1e-3, cone="pyramidal"):
  """Returns MJCF of a sphere under a probe on two slides; with a window or with nodal dofs."""
  mesh = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS)
  point = " ".join(f"{x:.9g}" for x in mesh.vertices.ravel())
  element = " ".join(map(str, mesh.faces.ravel()))
  texts = {**KEYS, **(keys or {})}
  if window:
    texts = {"window": "window", "mass": 0.1, **texts}
  config = "".join(f'<config key="{k}" value="{v}"/>' for k, v in texts.items() if v is not None)
  plugin = f'<plugin plugin="palpate.organ">{config}</plugin>'
  shape = f'type="direct" dim="2" radius="0.0005" point="{point}" element="{element}"'
  collide = f'selfcollide="none" condim="{condim}" friction="0.5" solref="0.004 1"'
  if window:
    organ = f"""<body name="organ">{plugin}<flexcomp name="organ" rigid="true" {shape}>
      <contact contype="0" conaffinity="0" selfcollide="none"/></flexcomp></body>
    <flexcomp name="window" type="grid" count="{count}" spacing=".01 .01 .01" dim="2" mass="0.01"
      radius="0.0005"><edge damping="1e-9"/><contact {collide}/></flexcomp>"""
  else:
    organ = f"""<flexcomp name="organ" mass="0.1" {shape}><edge damping="1e-9"/>{plugin}
      <contact {collide}/></flexcomp>"""
  return f"""<mujoco><option timestep="{h}" cone="{cone}" tolerance="1e-10" gravity="0 0 0"/>
<size memory="50M"/><extension><plugin plugin="palpate.organ"/></extension>
<worldbody><body name="frame" {frame}>{organ}
  <body name="tool" pos="0.0013 0.0007 {RADIUS + 0.0067}">
    <joint name="z" type="slide" axis="0 0 1"/><joint name="x" type="slide" axis="1 0 0"/>
    <geom name="tip" size="0.006" mass="0.05" condim="{condim}" friction="0.5"/></body>
</body></worldbody>
<actuator><position joint="z" kp="500" kv="10"/><position joint="x" kp="500" kv="10"/></actuator>
</mujoco>"""


def drive(m, d, steps):
  """Presses 6 mm, slides 10 mm, releases; returns the tool's forces."""
  out = []
  for _ in range(steps):
    t = d.time
    d.ctrl[0] = -0.008 * min(1, t / 0.08) + 0.02 * max(0, min(1, (t - 0.25) / 0.05))
    d.ctrl[1] = 0.01 * max(0, min(1, (t - 0.12) / 0.1))
    mujoco.mj_step(m, d)
    out.append(d.qfrc_constraint[-2:].copy())
  return np.array(out)
