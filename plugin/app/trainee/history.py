"""What a person's episodes amount to: attempts at each task, judged."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
  from palpate.tasks.people.limits import Lookup

  from .record import Episode


def attempts(episodes: Iterable[Episode], assessments: bool = False) -> dict[str, list[Episode]]:
  """Returns task -> attempts at it, in order; what an error or a kill ended is none.

  Args:
    episodes: of a person, in order
    assessments: whether those with the coach are left out
  """
  from palpate.tasks.recording import INTERRUPTED

  found: dict[str, list[Episode]] = {}
  for episode in episodes:
    if episode.outcome not in ("error", INTERRUPTED) and (episode.assessment or not assessments):
      found.setdefault(episode.task, []).append(episode)
  return found


def passed(episodes: Iterable[Episode]) -> dict[str, list[bool]]:
  """Returns task -> whether each attempt at it was proficient."""
  return {task: [e.proficient for e in done] for task, done in attempts(episodes).items()}


def judged(episodes: Sequence[Episode], references: Lookup) -> list[Episode]:
  """Returns the episodes with score and proficiency by other references."""
  from palpate.tasks.people.score import score

  found = []
  for episode in episodes:
    reference = references(episode.task)
    if reference is not None:
      result = score(episode.metrics, reference, episode.outcome)
      value = result.composite if math.isfinite(result.composite) else None
      episode = dataclasses.replace(episode, score=value, proficient=result.proficient)
    found.append(episode)
  return found
