"""What a grasper has between its jaws, from the contacts of their inner faces."""

import mujoco as mj
import numpy as np

FACING = 0.5  # least cosine between a contact's normal and that of the inner face


class Jaws:
  """The two jaws of a grasper: bodies whose x is across them, the left one on the side of +x.

  Attributes:
    names: of the bodies, left and right
    side: of each geom, +1 on the left jaw, -1 on the right, 0 elsewhere and in the last place, that
      of no geom, -1
  """

  def __init__(self, model: mj.MjModel, prefix: str):
    """Finds the jaws `jaw_left` and `jaw_right` of an instrument, say "grasper/"."""
    self.names = [f"{prefix}jaw_{side}" for side in ("left", "right")]
    self._bodies = [model.body(name).id for name in self.names]
    self.side = np.zeros(model.ngeom + 1)
    for body, side in zip(self._bodies, (1.0, -1.0), strict=True):
      self.side[:-1][model.geom_bodyid == body] = side

  def inner_force(self, model: mj.MjModel, data: mj.MjData) -> np.ndarray:
    """Returns the normal force of the inner faces on what is between them, left and right [N] (2,).

    To be called after a solve, before the next step's contacts are found. Only what presses a jaw
    away from the other counts: a side that leans on tissue, or tips pressed into it, do not.
    """
    contact = data.contact
    geom = self.side[contact.geom]
    tissue = contact.geom.min(axis=1) < 0  # not what is rigid
    mine = np.flatnonzero(geom.any(axis=1) & tissue & (contact.efc_address >= 0))
    if not len(mine):
      return np.zeros(2)
    side = geom[mine].sum(axis=1)
    normal = contact.frame[mine, :3] * np.where(geom[mine, :1] != 0, -1, 1)  # towards the jaw
    across = data.xmat[self._bodies, 0::3]  # x of the left and the right jaw  (2, 3)
    along = side * (normal * across[np.where(side > 0, 0, 1)]).sum(axis=1)
    # An elliptic cone has the normal force in its first row, a pyramid the sum of its edges.
    start, dim = contact.efc_address[mine], contact.dim[mine]
    elliptic = model.opt.cone == mj.mjtCone.mjCONE_ELLIPTIC
    count = np.where(elliptic | (dim == 1), 1, 2 * (dim - 1))
    total = np.concatenate([[0.0], data.efc_force.cumsum()])
    force = (total[start + count] - total[start]) * along * (along > FACING)
    return np.array([force[side > 0].sum(), force[side < 0].sum()])
