"""What MuJoCo sees of an organ through windows: small flexes that slide over it, under the tools.

Only nodes near a tool need degrees of freedom of MuJoCo: the organ's state lives in `plugin_state`,
and each window's vertex bodies ("slots") stand on the nodes nearest to the tool, with their
position, velocity and effective inertia. The window's triangles are the organ's triangles between
them. Forces follow the formula of `coupling`; a node outside the window moves by dv exactly as it
would with dofs of its own and no contact.

plugin_state: displacement (3 nvert), velocity (3 nvert), last dv (3 nvert), contact force (3 W),
slots (W; node + 1, 0 for the slot's default node, -1 for a slot that is not used).
"""

from __future__ import annotations

import mujoco
import numpy as np
import warp as wp

from . import inertia, mjstruct, solver
from . import window_kernels as kernels
from .coupling import Launches, mass_addresses, option_views, wrap

# Nodes within this many mean edges of a tool may be in its window.
_REACH = 4.0


def launches(w, model: int, instance: int) -> Launches:
  """Returns the launches of window coupling for a workspace."""
  m, d = mjstruct.Model.from_address(model), mjstruct.Data.from_address(w.data)
  organ, s, host, win = w.organ, w.surface, w.host, w.organ.windows
  nvert, nslot, nwindow = organ.mesh.nvert, win.nslot, len(win.flex)
  start = int(mjstruct.view(m.plugin_stateadr, m.nplugin, np.int32)[instance])

  def ints(values) -> wp.array:
    return wp.array(np.asarray(values, np.int32).ravel(), dtype=int, device="cpu")

  def doubles(values) -> wp.array:
    return wp.array(np.asarray(values, np.float64).ravel(), dtype=wp.float64, device="cpu")

  node = s.node.numpy()
  dofs = (win.dofadr[:, None] + np.arange(3)).ravel()
  incidence = np.argsort(organ.mesh.elem.ravel(), kind="stable") // 3
  near_adr = np.concatenate([[0], np.cumsum(np.bincount(organ.mesh.elem.ravel(), minlength=nvert))])
  edge = organ.mesh.rest[organ.mesh.elem[:, [1, 2, 0]]] - organ.mesh.rest[organ.mesh.elem]
  spacing = float(np.linalg.norm(edge, axis=2).mean())
  radius = float(mjstruct.view(m.flex_radius, m.nflex)[win.flex].max())
  if not w.views:
    w.views = {
      "placed": ints(np.full(nslot, -2)),
      "taken": ints(np.full(nvert, -1)),
      "chosen": ints(np.zeros(nvert)),
      "candidate": ints(np.zeros(nvert)),
      "distance": doubles(np.zeros(nvert)),
      "flags": ints(np.zeros(4)),
      "inertia": doubles(np.zeros(nvert)),
    }
    w.flags = w.views["flags"].numpy()
  v = w.views
  v |= option_views(model) | {
    "node": ints((node // 8) * 24 + node % 8),
    "node_mass": doubles(win.mass),
    "rest": doubles(organ.mesh.rest),
    "elem": ints(organ.mesh.elem),
    "near_adr": ints(near_adr),
    "near": ints(incidence),
    "home": ints(win.home),
    "qhome": doubles(win.qhome),
    "dofadr": ints(win.dofadr),
    "massadr": ints(mass_addresses(m, dofs)),
    "qposadr": ints(win.qposadr),
    "bodyid": ints(win.body),
    "window_adr": ints(win.adr),
    "elem_adr": ints(win.elem_adr),
    "elem_num": ints(win.elem_num),
    "geom_adr": ints(win.geom_adr),
    "geom": ints(win.geom if win.geom.size else [0]),
    "frame": doubles(organ.frame),
    "origin": doubles(organ.origin),
    "reach": doubles([_REACH * spacing + radius]),
    "touch": doubles([spacing + radius]),
    "geom_type": wrap(m.geom_type, m.ngeom, wp.int32),
    "geom_size": wrap(m.geom_size, 3 * m.ngeom),
    "geom_aabb": wrap(m.geom_aabb, 6 * m.ngeom),
    "geom_rbound": wrap(m.geom_rbound, m.ngeom),
    "body_mass": wrap(m.body_mass, m.nbody),
    "flex_elem": wrap(m.flex_elem, m.nflexelemdata, wp.int32),
    "dof_armature": wrap(m.dof_armature, m.nv),
    "dof_M0": wrap(m.dof_M0, m.nv),
    "dof_invweight0": wrap(m.dof_invweight0, m.nv),
    "body_invweight0": wrap(m.body_invweight0, 2 * m.nbody),
    "geom_xpos": wrap(d.geom_xpos, 3 * m.ngeom),
    "geom_xmat": wrap(d.geom_xmat, 9 * m.ngeom),
    "qpos": wrap(d.qpos, m.nq),
    "qvel": wrap(d.qvel, m.nv),
    "M": wrap(d.M, m.nC),
    "qfrc_applied": wrap(d.qfrc_applied, m.nv),
    "qfrc_passive": wrap(d.qfrc_passive, m.nv),
    "qfrc_constraint": wrap(d.qfrc_constraint, m.nv),
    "xfrc_applied": wrap(d.xfrc_applied, 6 * m.nbody),
    "plugin_state": wrap(d.plugin_state + 8 * start, 9 * nvert + 4 * nslot),
  }
  mass = np.ones(s.nnode)
  mass[node] = win.mass
  host["mass"].assign(mass.reshape(1, -1, 8).astype(np.float32))

  def pick(*names: str) -> list[wp.array]:
    return [v[name] for name in names]

  def run(kernel, numbers, inputs, outputs):
    wp.launch(kernel, dim=1, inputs=[*numbers, *inputs], outputs=outputs, device="cpu")

  def gather():
    numbers = [nvert, nslot, int(mujoco.mjtDisableBit.mjDSBL_GRAVITY), s.damping, solver.REST]
    inputs = pick("node", "node_mass", "home", "placed", "dofadr", "bodyid", "frame", "timestep")
    inputs += pick("gravity", "disableflags", "body_mass", "qfrc_applied", "qfrc_passive")
    inputs += pick("xfrc_applied", "plugin_state")
    outputs = [host[k] for k in ("step", "pos", "vel", "force_ext", "dvel_warm")]
    run(kernels.gather, numbers, inputs, [*outputs, w.ext, v["flags"]])

  def scatter():
    inputs = pick("node", "placed", "dofadr", "massadr", "timestep", "M")
    inputs += [w.ext, host["dvel"], host["status"]]
    run(kernels.scatter, [nslot], inputs, [v["qfrc_passive"]])

  def place(force: bool):
    inputs = pick("rest", "node_mass", "inertia", "elem", "near_adr", "near", "home", "qhome")
    inputs += pick("dofadr", "qposadr", "bodyid", "window_adr", "elem_adr", "elem_num")
    inputs += pick("body_mass", "plugin_state")
    outputs = pick("placed", "taken", "flex_elem", "dof_armature", "dof_M0", "dof_invweight0")
    outputs += pick("body_invweight0", "qpos", "qvel", "flags")
    run(kernels.place, [nvert, nslot, nwindow, int(force)], inputs, outputs)

  def advance():
    inputs = pick("node", "rest", "home", "qhome", "placed", "dofadr", "qposadr", "window_adr")
    inputs += pick("geom_adr", "geom", "frame", "origin", "reach", "touch", "timestep")
    inputs += pick("geom_type", "geom_size", "geom_aabb", "geom_rbound", "geom_xpos", "geom_xmat")
    inputs += [*pick("qpos", "qvel", "qfrc_constraint"), host["dvel"], host["status"]]
    outputs = pick("plugin_state", "taken", "chosen", "candidate", "distance", "flags")
    run(kernels.advance, [nvert, nslot, nwindow], inputs, outputs)
    place(force=False)

  return Launches(gather, scatter, advance, lambda: place(force=True))


def set_inertia(w, m):
  """Stores the effective inertia of every node for the present time step."""
  organ, win = w.organ, w.organ.windows
  h = float(m.opt.timestep)
  if w.config.integrator == "explicit":
    nodal = win.mass
  else:
    nodal = inertia.of_nodes(m, organ, win.mass, h, int(win.flex[0]))
  w.views["inertia"].assign(nodal)


def settle(w, model: int):
  """Readies the compiled model and the state for the default slots."""
  m = mjstruct.Model.from_address(model)
  organ = w.organ
  set_inertia(w, m)
  w.views["plugin_state"].fill_(0.0)  # MuJoCo has not cleared it yet
  # A rigid flex's vertices are only looked at by `draw`: spare MuJoCo their rotation.
  mjstruct.view(m.flex_centered, m.nflex, np.bool_)[organ.flex] = True


def draw(w, model: int, data: int):
  """Writes the deformed surface where renderers read it."""
  m, d = mjstruct.Model.from_address(model), mjstruct.Data.from_address(data)
  organ = w.organ
  start = int(mjstruct.view(m.flex_vertadr, m.nflex, np.int32)[organ.flex])
  n = organ.mesh.nvert
  out = mjstruct.view(d.flexvert_xpos, (m.nflexvert, 3))[start : start + n]
  u = w.views["plugin_state"].numpy()[: 3 * n].reshape(n, 3)
  out[:] = organ.origin + (organ.mesh.rest + u) @ organ.frame.T
