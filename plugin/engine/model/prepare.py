"""Everything that is written to a compiled mjModel outside of a step.

MuJoCo calls the plugin while it compiles, so that plain MJCF needs no helper: what is written here
stays in the model, and in its copies and files.
"""

import hashlib

import numpy as np
from palpate.tissue.body import Body
from palpate.tissue.config import Config
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.step import SCHEMES

from . import inertia, mjstruct
from .declare import Declaration

_KNOWN = 64
_FIRM = 0.1  # inertia by which contacts with a thread are as firm as they are [kg]
_AHEAD = 2.0  # radii from a thread within which there are contacts
_PARTS = 8  # that cuts may make of a node
_made_for: dict[bytes, tuple] = {}  # digest of an armature of ours -> time step and material


def fit(m: mjstruct.Struct, organ: Declaration, body: Body):
  """Makes a model fit an organ that it declares, with the tissue `body`."""
  # MuJoCo warns of a flex without forces of its own; an <edge damping> silences it and, zero here,
  # costs nothing while running. The plugin's own damping acts instead.
  m.flex_edgedamping[organ.flexes] = 0.0
  if organ.windows is None:
    give_armature(m, organ, body, organ.config)
    if len(organ.mesh.tet):
      give_weights(m, organ)
    return
  win = organ.windows
  m.body_pos[win.body] = win.stand
  # A slot must be no heavier than the lightest node that it may stand on.
  light = win.mass[win.mass > 0].min() / (_PARTS if organ.mesh.spare else 1)
  m.body_mass[win.body] = np.minimum(m.body_mass[win.body], light)


def fit_thread(m: mjstruct.Struct, flex: int, body: np.ndarray):
  """Makes a model fit a thread, whose moving vertices have these bodies.

  The inertia of its nodes is that of each step. Contacts would be soft by their masses, of a
  microgram.
  """
  m.flex_edgedamping[flex] = 0.0
  m.flex_margin[flex] = max(m.flex_margin[flex], _AHEAD * m.flex_radius[flex])
  dof = m.body_dofadr[body][:, None] + np.arange(3)
  m.body_invweight0[body, 0] = 1 / _FIRM
  m.dof_invweight0[dof] = 1 / _FIRM


def give_armature(m: mjstruct.Struct, organ: Declaration, body: Body, config: Config):
  """Gives the organ's dofs the effective inertia as armature, unless the MJCF gave them one.

  Ours are recognised by their digest, so that they can follow the time step and the tissue.

  Args:
    m: the mjModel
    organ: the organ
    body: its tissue
    config: its configuration in force
  """
  if not SCHEMES[organ.config.integrator].spreads:
    return  # steps are those of the masses
  armature = m.dof_armature
  dofs = organ.dofs
  present = armature[dofs]
  of = (float(m.opt.timestep), *inertia.material(config))
  if present.any() and _made_for.get(_digest(present), of) == of:
    return
  mass = inertia.masses(m, organ)
  found = inertia.of_nodes(m, organ, body, config, mass, organ.flex)
  theirs, own = m.body_mass[organ.body], organ.jointed
  total = np.maximum(found, theirs)[own]  # of solids, MuJoCo's mass of a node may be more
  added = np.repeat(total - theirs[own], 3)
  armature[dofs] = added
  if len(_made_for) >= _KNOWN:
    _made_for.pop(next(iter(_made_for)))
  _made_for[_digest(added)] = of
  # mj_setConst gives the same: M0 has the armature, the inverse weights, which scale the contacts'
  # softness, are those of the masses alone for such dofs.
  m.dof_M0[dofs] = np.repeat(total, 3)


def give_weights(m: mjstruct.Struct, organ: Declaration):
  """Makes contacts with a solid as soft as its nodes' masses, which are not MuJoCo's, have it.

  MuJoCo spreads the mass evenly over the vertices, the nodes inside have their part of it.
  """
  own = organ.jointed
  mass = organ.mass[own]
  weight = 1 / np.where(mass > 0, mass, mass[mass > 0].mean())  # some wait for cuts
  m.body_invweight0[organ.body[own], 0] = weight
  m.dof_invweight0[organ.dofs] = np.repeat(weight, 3)


def show(m: mjstruct.Struct, organ: Declaration, shown: bool):
  """Lets MuJoCo see a windowed organ's own flex, or hides it, so that a step spends nothing on it.

  It touches nothing and is drawn from what `window.draw` writes, but MuJoCo updates its vertices,
  boxes and bounding volumes in every step, which can take longer than the organ's step. A scene has
  room for the flex whether it was made with the one or the other: 2 (shells + elements).
  """
  flex, mesh = organ.flex, organ.mesh.whole
  nvert, shells = drawn(mesh), int((mesh.twin < 0).sum())
  counts = (nvert, mesh.nelem, shells) if shown else (0, 0, shells + mesh.nelem)
  names = ("flex_vertnum", "flex_elemnum", "flex_shellnum", "flex_bvhnum", "flex_bvhadr")
  for name, count in zip(names, (*counts, 0, -1), strict=True):
    getattr(m, name)[flex] = count
  # The broad phase passes over vertices of the world; the first one still tells whose they are.
  start = int(m.flex_vertadr[flex])
  body = m.flex_vertbodyid[start : start + nvert]
  body[1:] = body[0] if shown else 0


def drawn(mesh: Mesh) -> int:
  """Returns how many vertices of an organ a flex has: those on the surface, and spare ones."""
  return mesh.nskin


def group(m: mjstruct.Struct, skin: int, flex: int, groups: tuple[int, int]):
  """Puts an organ's skin and its own surface into groups, which viewers draw or do not."""
  m.skin_group[skin] = groups[0]
  m.flex_group[flex] = groups[1]


def _digest(values: np.ndarray) -> bytes:
  return hashlib.sha256(np.ascontiguousarray(values).tobytes()).digest()
