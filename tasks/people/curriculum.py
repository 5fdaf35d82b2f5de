"""The order in which the exercises are learnt, and which of them are open to a learner.

An exercise is open once the one before it, `AFTER`, was done by the rule of proficiency, see
`score.trained`: two proficient attempts in a row and ten more. One that stands not here is open to
everybody.
"""

from collections.abc import Mapping, Sequence

from .score import CONSECUTIVE, REPEATS, trained

# Exercise -> the one to be proficient in first. In the order in which they are recommended.
AFTER: dict[str, str | None] = {
  "touch/easy": None,
  "navigate/easy": None,
  "probe/easy": "touch/easy",
  "trace/easy": "touch/easy",
  "grasp/easy": "touch/easy",
  "retract/easy": "grasp/easy",
  "tease/easy": "probe/easy",
  "dissect/easy": "retract/easy",
  "cut/easy": "trace/easy",
  "bimanual/easy": "dissect/easy",
}
_DOMAINS = [name.partition("/")[0] for name in AFTER]
for _domain in _DOMAINS:
  AFTER[f"{_domain}/standard"] = f"{_domain}/easy"
  if _domain == "probe":
    AFTER["probe/depth"] = "probe/easy"
AFTER |= {
  "probe/palpate_easy": "probe/standard",
  "probe/palpate_standard": "probe/palpate_easy",
  **{f"{domain}/hard": f"{domain}/standard" for domain in _DOMAINS},
  "needle/transfer_easy": "grasp/easy",
  "needle/transfer_standard": "needle/transfer_easy",
  "needle/transfer_hard": "needle/transfer_standard",
  "suture/drive_easy": "needle/transfer_easy",
  "suture/drive_standard": "suture/drive_easy",
  "suture/drive_hard": "suture/drive_standard",
  "suture/running_easy": "suture/drive_easy",
  "suture/running_standard": "suture/running_easy",
  "suture/running_hard": "suture/running_standard",
  "suture/extracorporeal_easy": "touch/easy",
  "suture/extracorporeal_standard": "suture/extracorporeal_easy",
  "suture/extracorporeal_hard": "suture/extracorporeal_standard",
  "suture/knot_easy": "needle/transfer_easy",
  "suture/knot_standard": "suture/knot_easy",
  "suture/stitch_easy": "suture/knot_easy",
  "suture/stitch_standard": "suture/stitch_easy",
  "probe/palpate_hard": "probe/palpate_standard",
}
RULE = f"{CONSECUTIVE} proficient attempts in a row and {REPEATS} more"


def done(attempts: Mapping[str, Sequence[bool]]) -> set[str]:
  """Returns the exercises in which a learner has met the rule of proficiency.

  Args:
    attempts: exercise -> whether each attempt was proficient, in order
  """
  return {task for task, passed in attempts.items() if trained(passed) is not None}


def locked(task: str, met: set[str]) -> str | None:
  """Returns the exercise that comes first, None if the task is open.

  Args:
    task: such as "touch/standard"
    met: exercises in which the rule was met, see `done`
  """
  before = AFTER.get(task)
  return None if before is None or before in met else before


def following(met: set[str]) -> str | None:
  """Returns the exercise to do next: the first that is open and not done; None if all are."""
  return next((task for task in AFTER if task not in met and not locked(task, met)), None)


def left(passed: Sequence[bool]) -> int:
  """Returns how many attempts the rule still asks for, were all of them proficient.

  Args:
    passed: whether each attempt so far was proficient, in order
  """
  more = range(CONSECUTIVE + REPEATS + 1)
  return next(k for k in more if trained([*passed, *[True] * k]) is not None)
