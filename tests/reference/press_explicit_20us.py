"""Reference of the press: springs and foundation stepped explicitly, 20 us, in float64.

A sphere of edge springs on a Winkler foundation is pressed 12 mm by a ball on a position actuator
in 100 ms and held. Semi-implicit Euler through MuJoCo's passive callback: no plugin, no kernel.
A contact acts on the corners of a triangle by barycentric weights, as in MuJoCo 4.

  python press_explicit_20us.py    writes press_explicit_20us.csv: time [s], force [N]
"""

import pathlib

import mujoco
import numpy as np
import trimesh
from trimesh.triangles import closest_point, points_to_barycentric

RADIUS = 0.05  # of the sphere [m]
MASS = 0.1  # of all nodes [kg]
STIFFNESS = 200.0  # of each spring [N/m]
FOUNDATION = 4e4  # [Pa/m]
DAMPING = 0.002  # Rayleigh coefficient [s]
DEPTH = 0.012  # of the actuator [m]
HOLD = 0.1  # when the depth is reached [s]
DURATION = 0.25  # [s]
STEP = 2e-5  # [s]
EVERY = 1e-3  # between two rows [s]

# Three slots: the plugin's declaration, its keys and the time step.
MJCF = """
<mujoco><option timestep="{h}" integrator="Euler" solver="Newton" tolerance="1e-10" gravity="0 0 0"/>
<size memory="200M"/>{extension}
<worldbody>
  <flexcomp name="organ" type="direct" dim="2" mass="0.1" radius="0.0005" point="{point}" element="{element}">
    {plugin}<contact selfcollide="none" condim="1" solref="0.004 1" solimp="0.999 0.999 0.001"/><edge damping="1e-9"/>
  </flexcomp>
  <body pos="0 0 0.0565"><joint name="z" type="slide" axis="0 0 1"/>
    <geom size="0.006" mass="0.05" condim="1" solref="0.004 1"
      solimp="0.999 0.999 0.001"/></body>
</worldbody>
<actuator><position joint="z" kp="500" kv="10"/></actuator></mujoco>"""  # noqa: E501


def surface() -> trimesh.Trimesh:
  """Returns the sphere."""
  return trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)


def mjcf(h: float, extension: str = "", plugin: str = "") -> str:
  """Returns the scene."""
  mesh = surface()
  point = " ".join(f"{x:.17g}" for x in mesh.vertices.ravel())
  element = " ".join(map(str, mesh.faces.ravel()))
  return MJCF.format(h=h, point=point, element=element, extension=extension, plugin=plugin)


def press(model: mujoco.MjModel, duration: float = DURATION) -> np.ndarray:
  """Returns time and contact force on the ball of each millisecond, (nrow, 2)."""
  data = mujoco.MjData(model)
  h = model.opt.timestep
  every, rows = max(1, round(EVERY / h)), []
  for step in range(round(duration / h)):
    data.ctrl[0] = -DEPTH * min(1, data.time / HOLD)
    mujoco.mj_step(model, data)
    if (step + 1) % every == 0:
      rows.append((data.time, data.qfrc_constraint[model.nv - 1]))
  return np.array(rows)


def weigh(model: mujoco.MjModel, data: mujoco.MjData, dofs: np.ndarray):
  """Gives the corners of touched triangles their barycentric weights, one row a contact."""
  elem = model.flex_elem.reshape(-1, 3)
  for contact in (c for c in data.contact if c.efc_address >= 0):
    corners, row = elem[contact.elem[1]], contact.efc_address
    start, count = data.efc_J_rowadr[row], data.efc_J_rownnz[row]
    columns, values = data.efc_J_colind[start : start + count], data.efc_J.ravel()[start:]
    x, p = data.flexvert_xpos[corners][None], contact.pos[None]
    for corner, weight in zip(
      corners, points_to_barycentric(x, closest_point(x, p))[0], strict=True
    ):
      at = np.flatnonzero(np.isin(columns, dofs[corner]))
      values[at] *= weight / max(np.linalg.norm(values[at]), 1e-300)


def reference(duration: float = DURATION) -> np.ndarray:
  """Returns the explicit solution; see `press`."""
  mesh = surface()
  rest = np.array(mesh.vertices)
  (i, j), length0 = mesh.edges_unique.T, mesh.edges_unique_length
  area = np.bincount(mesh.faces.ravel(), np.repeat(mesh.area_faces / 3, 3))[:, None]
  model = mujoco.MjModel.from_xml_string(mjcf(STEP))
  start = np.array([model.body(f"organ_{p}").dofadr[0] for p in range(len(rest))])
  dofs = start[:, None] + np.arange(3)

  def passive(_, data):
    u, v = data.qpos[dofs], data.qvel[dofs]
    edge = rest[j] + u[j] - rest[i] - u[i]
    length = np.linalg.norm(edge, axis=1)
    along = edge / length[:, None]
    # Damping on the stiffness matrix, along the spring and, where it is stretched, across it.
    rate = v[j] - v[i]
    stretch = np.maximum(1 - length0 / length, 0)[:, None]
    rate = (1 - stretch) * (rate * along).sum(axis=1)[:, None] * along + stretch * rate
    pull = STIFFNESS * ((length - length0)[:, None] * along + DAMPING * rate)
    force = -FOUNDATION * area * (u + DAMPING * v)
    for c in range(3):
      force[:, c] += np.bincount(i, pull[:, c], len(rest)) - np.bincount(j, pull[:, c], len(rest))
    data.qfrc_passive[dofs] += force
    weigh(model, data, dofs)

  mujoco.set_mjcb_passive(passive)
  try:
    return press(model, duration)
  finally:
    mujoco.set_mjcb_passive(None)


if __name__ == "__main__":
  path = pathlib.Path(__file__).with_suffix(".csv")
  np.savetxt(path, reference(), fmt="%.7g", delimiter=",", header="time [s],force [N]", comments="")
