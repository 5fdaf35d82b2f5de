"""CUSUM of a learner's attempts: when there is evidence of competence, and when it is lost again.

An attempt fails unless it is proficient (`score.Score.proficient`). Two failure rates are compared:
`ACCEPTABLE` p0, which a competent person may have, and `UNACCEPTABLE` p1. Skilled people fail in
0.05 (`score.PASSING`). The weight of an attempt is its log-likelihood ratio, Biau et al. 2008
(10.1002/bjs.6056), Biau and Porcher 2010 (10.1002/sim.3947):

    w = log((1 - p0) / (1 - p1))   after a success, 0.251 here
    w = log(p0 / p1)               after a failure, -1.099

Learning: S = max(0, S + w) from 0; competent as soon as S >= h (LC-CUSUM). The hypothesis that must
be refuted is that the learner fails too often, and early failures are not carried along.
Monitoring, from then on: S = min(0, S + w) from 0; competence is lost as soon as S <= -h, and
learning begins anew from 0. This is the CUSUM by which training programmes watch a procedure
(Bolsin and Colson 2000, 10.1093/intqhc/12.5.433), with the same weights.

h = `LIMIT` for both. Of a single test, which may decide for the one or the other, Wald's bound is
log((1 - beta) / alpha): 3.58 for the errors alpha = 0.025 and beta = 0.1. A sum that is held at 0
is many tests in a row and errs more often, so that h goes by what comes of it in 30 attempts,
exactly (`chance`): who fails in 0.3 is called competent with a chance of 3.9 %, who fails in 0.1
with 70 % (in 50 attempts 94 %). A competent person who fails in 0.1 loses the name with 4.5 %, one
who fails in 0.3 with 82 %. At h = 3.5, which fourteen successes in a row reach, the first would be
5.1 %.
"""

import dataclasses
import math
from collections.abc import Iterable

ACCEPTABLE, UNACCEPTABLE = 0.10, 0.30  # failure rates p0, p1 [-]
LIMIT = 3.6  # h [-]
_ROUNDING = 1e-9


@dataclasses.dataclass(frozen=True)
class Point:
  """The chart after an attempt.

  Attributes:
    value: of the sum, 0 to h while learning, -h to 0 while monitored [-]
    competent: whether there is evidence of competence now
    changed: whether this attempt crossed the limit
  """

  value: float
  competent: bool
  changed: bool


def weight(passed: bool) -> float:
  """Returns the log-likelihood ratio of an attempt [-], see the module's head."""
  if passed:
    return math.log((1 - ACCEPTABLE) / (1 - UNACCEPTABLE))
  return math.log(ACCEPTABLE / UNACCEPTABLE)


def chart(attempts: Iterable[bool]) -> list[Point]:
  """Returns the chart after each attempt, told whether each was proficient, in order."""
  points, value, competent = [], 0.0, False
  for passed in attempts:
    value, crossed = _step(value, passed, competent)
    competent ^= crossed
    points.append(Point(value, competent, crossed))
    value = 0.0 if crossed else value
  return points


def _step(value: float, passed: bool, competent: bool) -> tuple[float, bool]:
  """Returns the sum after an attempt, and whether it crossed the limit."""
  if competent:
    value = min(0.0, value + weight(passed))
    return value, value <= -LIMIT + _ROUNDING
  value = max(0.0, value + weight(passed))
  return value, value >= LIMIT - _ROUNDING


def chance(failing: float, attempts: int, competent: bool = False) -> float:
  """Returns how likely the limit is crossed within a number of attempts [-], exactly.

  Args:
    failing: true failure rate, in [0, 1] [-]
    attempts: how many there are
    competent: whether the learner is monitored; else learns
  """
  at, crossed = {0.0: 1.0}, 0.0  # sum -> how likely it is there, not having crossed
  for _ in range(attempts):
    then: dict[float, float] = {}
    for value, share in at.items():
      for passed, part in ((True, 1 - failing), (False, failing)):
        new, over = _step(value, passed, competent)
        if over:
          crossed += share * part
        else:
          new = round(new, 9)  # equal sums of weights in another order are one
          then[new] = then.get(new, 0.0) + share * part
    at = then
  return crossed
