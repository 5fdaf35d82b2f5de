"""The table of passive forces, which both hosts read."""

from .attachments import Attachments
from .cohesive_bonds import Bonds
from .cutters import Cutters
from .lips import Lips
from .needles import Needles
from .passive import Force
from .relaxation import Relaxation
from .supports import Supports
from .tears import Tears

# In the order in which they act. What a host cannot do it refuses by the keys of the kind.
FORCES: dict[str, type[Force]] = {
  "attachments": Attachments,
  "bonds": Bonds,
  "supports": Supports,
  "relaxation": Relaxation,
  "needles": Needles,
  "lips": Lips,
  "tears": Tears,
  "cutters": Cutters,
}
