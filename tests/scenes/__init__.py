"""Builders of the scenes of all tests and benches, and helpers; the fixture `scenes` is this room.

Every size is in SI units.
"""

# ruff: noqa: F401, I001 - names for others, by where they come from
from palpate.models.block import box

from .bare import force, get, kernels, put, step
from .documents import ball, contacts, flex, organ, plugin, press, probed, ridge, windowed, world
from .numbers import bodies, dofs, lump, masses, qposs, slot_bodies, slots, workspace
from .resting import resting, watch
from .running import Warnings, abreast, adrift, beside, draw, drive, follow, goes_on, grasp, load
from .running import motion, off, run, settle, state
from .specs import servo
from .surfaces import RADIUS, sphere, strip, triangular
