"""Surgical threads: diameters by size, and what materials are like, with sources.

Diameters are the middle of the limits that the pharmacopoeia sets on the average diameter of a size
(USP <861>). Strength is the least average that it asks for in a knot-pull test (USP <881>), of
synthetic absorbable threads and of non-absorbable ones of class I; these are quoted at second hand.
Threads that are sold bear about twice as much: Naleway et al. 2015 (doi:10.1002/jbm.b.33171)
measured 18.9 N of knotted polypropylene of size 3-0.
"""

import dataclasses
from collections.abc import Mapping

DIAMETER: Mapping[str, float] = {"3-0": 0.225e-3, "4-0": 0.175e-3, "5-0": 0.125e-3}  # [m]


@dataclasses.dataclass(frozen=True)
class Suture:
  """A material.

  Attributes:
    young: initial tensile modulus [Pa]
    bend: bending rigidity as a share of that of a solid rod
    twist: twisting rigidity as such a share
    density: mass per volume of the round section [kg/m^3]
    friction: of the thread on tissue, steel and itself
    strength: breaking force by size, that in a knot [N]
  """

  young: float
  bend: float
  twist: float
  density: float
  friction: float
  strength: Mapping[str, float]


_G = 9.80665
_ABSORBABLE = {"3-0": 1.77 * _G, "4-0": 0.95 * _G, "5-0": 0.68 * _G}
_CLASS_I = {"3-0": 0.96 * _G, "4-0": 0.60 * _G, "5-0": 0.40 * _G}

# The moduli of silk and polyglactin 910 (of its fast form) are those of straight threads of size
# 3-0 by Naleway et al. 2015. That of polypropylene, the friction, which is no constant but falls
# with tension, and is higher of braids (Surg Gynecol Obstet 161 (1985), 12-16), and how much less a
# braid resists bending than a solid rod, since its fibres slide, are estimates. Densities are those
# of the materials. With a friction of 0.3 surgeon's 2-1-1 knots hold in both braids, as knots of
# four throws do (doi:10.20944/preprints202309.0029.v1); with 0.2 they untie.
SUTURES: Mapping[str, Suture] = {
  "vicryl": Suture(9.3e9, 0.02, 0.02, 1500.0, 0.3, _ABSORBABLE),  # polyglactin 910, braided
  "silk": Suture(8.7e9, 0.02, 0.02, 1330.0, 0.3, _CLASS_I),  # braided
  "polypropylene": Suture(3e9, 1.0, 1.0, 910.0, 0.15, _CLASS_I),  # monofilament
}
