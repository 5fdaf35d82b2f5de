"""What a control step costs the patient: `cost` of constrained reinforcement learning.

| part | what | size |
|---|---|---|
| `force` | the step's largest force over its limit, of the tip or the shaft | share of the limit |
| `shaft` | more than `SHAFT_CONTACT` on the shaft | force / limit, to 1 |
| `surroundings` | more than `BRUSHED` on what is around | force / limit, to 1 |
| `damage` | a force above the damage limit | 1 |

Their sum is the cost: 0 for a gentle step, 1 for one with twice the limit. A shaft has the limits
of the tip, or `SHAFT_LIMIT` and `SHAFT_DAMAGE` where those are of jaws and higher; so has what
presses on the surroundings.
"""

import dataclasses

SHAFT_CONTACT = 0.1  # what lies on the shaft with less, such as a flap, is no contact [N]
BRUSHED = 0.3  # what brushes along fat, or moves it aside, with less is no contact [N]
SHAFT_LIMIT, SHAFT_DAMAGE = 1.5, 3.0  # [N]


@dataclasses.dataclass(frozen=True)
class Cost:
  """The parts of a control step's cost, see the module's head."""

  force: float = 0.0
  shaft: float = 0.0
  surroundings: float = 0.0
  damage: float = 0.0

  @property
  def total(self) -> float:
    """Their sum."""
    return self.force + self.shaft + self.surroundings + self.damage


def parts(
  peak_force: float, shaft_force: float, surroundings: float, limit: float, damage: float
) -> tuple[float, float, float, float]:
  """Returns the parts of a control step's `Cost`; a vectorised exercise has it in a kernel.

  Args:
    peak_force: largest force of tissue on the tip, or on a jaw, in the step [N]
    shaft_force: largest force of it on the shaft [N]
    surroundings: largest force on what is around [N]
    limit: of the force on the tip [N]
    damage: force above which the tip damages [N]
  """
  least = max(min(limit, damage), 1e-6)
  shaft_limit = min(least, SHAFT_LIMIT)
  beside = max(shaft_force, surroundings)
  over = max(max(peak_force / least, beside / shaft_limit) - 1.0, 0.0)
  lies = min(shaft_force / shaft_limit, 1.0) if shaft_force > SHAFT_CONTACT else 0.0
  pushes = min(surroundings / shaft_limit, 1.0) if surroundings > BRUSHED else 0.0
  harmed = peak_force > damage or beside > min(damage, SHAFT_DAMAGE)
  return over, lies, pushes, 1.0 if harmed else 0.0
