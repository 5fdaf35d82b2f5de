"""Builders of the scenes of all tests and benches, and helpers; the fixture `scenes` is this room.

Every size is in SI units.
"""

from palpate.models.block import box

from .bare import force, get, kernels, put, step
from .documents import (
  ball,
  contacts,
  flex,
  organ,
  plugin,
  press,
  probed,
  ridge,
  windowed,
  world,
)
from .numbers import bodies, dofs, lump, masses, qposs, slot_bodies, slots, workspace
from .resting import resting, watch
from .running import (
  Warnings,
  adrift,
  beside,
  drive,
  follow,
  goes_on,
  grasp,
  load,
  motion,
  run,
  settle,
  state,
)
from .specs import servo
from .surfaces import RADIUS, sphere, strip, triangular

__all__ = [
  "RADIUS", "Warnings", "adrift", "ball", "beside", "bodies", "box", "contacts", "dofs", "drive",
  "flex", "follow", "force", "get", "goes_on", "grasp", "kernels", "load", "lump", "masses",
  "motion", "organ", "plugin", "press", "probed", "put", "qposs", "resting", "ridge", "run",
  "servo", "settle", "slot_bodies", "slots", "sphere", "state", "step", "strip", "triangular",
  "watch", "windowed", "workspace", "world",
]  # fmt: skip
