"""Where the numbers of an organ are: bodies, dofs, places in qpos, slots, masses."""

import mujoco
import numpy as np
from palpate.engine import plugin as engine
from palpate.tissue.geometry import mesh as topology


def bodies(organ):
  """Returns the body of each vertex of an organ, (nvert,)."""
  flex = mujoco.mj_name2id(organ.model, mujoco.mjtObj.mjOBJ_FLEX, organ.name)
  start = organ.model.flex_vertadr[flex]
  return organ.model.flex_vertbodyid[start : start + organ.nvert]


def dofs(organ):
  """Returns the degrees of freedom of each moving vertex, (nfree, 3)."""
  return organ.model.body_dofadr[bodies(organ)[organ.free]][:, None] + np.arange(3)


def qposs(organ):
  """Returns the places of each moving vertex in qpos, (nfree, 3)."""
  joint = organ.model.body_jntadr[bodies(organ)[organ.free]]
  return organ.model.jnt_qposadr[joint][:, None] + np.arange(3)


def workspace(organ):
  """Returns what the engine keeps of an organ in its mjData."""
  instance = organ.model.body_plugin[bodies(organ)].max()
  return engine.find(organ.data._address, int(instance))


def slots(organ):
  """Returns the node in each slot of an organ's windows, -1 in an empty one."""
  return workspace(organ).views["placed"].numpy()


def slot_bodies(organ):
  """Returns the body of each slot of an organ's windows."""
  return workspace(organ).organ.windows.body


def lump(organ, mass=0.1):
  """Gives an organ whose nodes are MuJoCo's the masses of a windowed one."""
  area = topology.vertex_areas(organ.xpos0, organ.elem)
  organ.model.body_mass[bodies(organ)[organ.free]] = (mass * area / area.sum())[organ.free]
  mujoco.mj_setConst(organ.model, mujoco.MjData(organ.model))


def masses(organ):
  """Returns the mass of each vertex, (nvert,)."""
  windows = workspace(organ).organ.windows
  return organ.model.body_mass[bodies(organ)] if windows is None else windows.mass
