# ruff: noqa: F403
"""Skill metrics: pure functions of arrays, in SI units.

A metric that cannot be known (no contact, no motion, nothing recorded) is an `Unknown`: a NaN that
carries its reason, never a 0. A metric raises ValueError only for a mistake of the caller's: wrong
shapes, time that does not increase. Samples that are not finite make the metric unknown.

A function under `@metric(...)` in `force`, `motion` or `outcome` is a metric: `METRICS` lists it,
recordings compute it, and scores, reports and evaluations show it.
"""

from .definition import *
from .force import *
from .motion import *
from .outcome import *
from .samples import *
from .values import *
