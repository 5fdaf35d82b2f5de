"""The coach: says what to do next and what goes wrong, and afterwards what to do better."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from palpate.tasks.metrics import METRICS, Spec, number
from palpate.tasks.people.report import ending
from palpate.tasks.people.score import SUCCESS, score
from palpate.tasks.recording import Recording

_STAYS = 0.6  # how long a warning is shown [s]
# What helps, by metric; those that are left out say so by their names.
_ADVICE = {
  "peak_force": "approach slowly and stop at the first resistance",
  "mean_force": "stay in light contact, less is enough",
  "force_breaches": "watch the force bar, and ease off before it turns red",
  "excess_impulse": "ease off at once when the force bar turns red",
  "force_rate": "press and let go gradually",
  "peak_grip": "close the jaws only until they hold",
  "mean_grip": "close the jaws only until they hold",
  "shaft_contact": "keep the shaft away from the organ; look at more than the tip",
  "peak_shaft_force": "keep the shaft away from the organ; look at more than the tip",
  "peak_surroundings_force": "go around what is not yours to touch",
  "time": "plan the next movement during the present one",
  "path_length": "go straight to the target",
  "path_inefficiency": "go straight to the target",
  "log_dimensionless_jerk": "make one smooth movement in place of several corrections",
  "angular_path": "turn the instrument less",
  "depth_path": "find the depth first, then go in once",
  "number_of_movements": "make fewer, longer movements",
  "idle_time": "plan the next movement during the present one",
  "idle_share": "plan the next movement during the present one",
  "out_of_view": "keep the tip in the picture",
  "errors": "touch only what is asked for",
  "grasp_slips": "take more tissue between the jaws before you pull",
  "target_error": "look at the target from where the light shows its place, then touch",
  "trace_frechet": "slow down in the bends of the line",
  "trace_rms": "slow down in the bends of the line",
}


class Coach:
  """Looks on and speaks, or, in an assessment, looks on alone.

  Attributes:
    instruction: what to do next; empty in an assessment
    warning: what goes wrong now; empty where nothing does, and in an assessment
    kind: of the warning: `force`, `shaft`, `view`
  """

  def __init__(self, assessment: bool = False):
    """Makes a coach; in an `assessment` it says nothing."""
    self.assessment = assessment
    self.instruction, self.warning, self.kind = "", "", ""
    self._now = 0.0
    self._said: list[dict[str, Any]] = []
    self._until = -math.inf

  def begin(self, env: Any) -> None:
    """Starts with an episode."""
    self._said, self._until, self.warning, self.kind = [], -math.inf, "", ""
    self.look(env)

  def look(self, env: Any) -> None:
    """Looks at what a control step has made."""
    self._now = now = float(env.physics.time())
    if self.assessment:
      return
    task, physics = env.task, env.physics
    instruction = task.instruct(physics)
    # "2 s more" and "1.9 s more" are one hint.
    if instruction != self.instruction and _words(instruction) != _words(self.instruction):
      self._say("instruction", now, instruction)
    self.instruction = instruction
    kind, warning = self._warning(task, physics)
    if warning and warning != self.warning and _words(warning) != _words(self.warning):
      self._say("warning", now, warning)
    if warning or now > self._until:
      self.kind, self.warning = kind, warning
      self._until = now + _STAYS

  def hint(self, text: str) -> None:
    """Notes a hint that was given on request, for the recording."""
    self._say("hint", self._now, text)

  def _warning(self, task: Any, physics: Any) -> tuple[str, str]:
    peak, limit = physics.peak_tissue, task.force_limit
    if peak > limit:
      return "force", f"Too much force: {peak:.1f} N, expected at most {limit:.1f} N"
    if task.cost.shaft:
      return "shaft", f"The shaft presses on the organ with {physics.peak_shaft:.1f} N"
    if task.cost.surroundings:
      return "shaft", f"You press on what is around with {physics.peak_surroundings:.1f} N"
    if not physics.tip_visible():
      return "view", "The tip is out of the picture"
    return "", ""

  def _say(self, kind: str, time: float, text: str) -> None:
    self._said.append({"kind": kind, "time": round(time, 3), "text": text})

  def log(self) -> dict[str, Any]:
    """Returns what was said, for the recording."""
    return {"assessment": self.assessment, "hints": self._said}


def _shown(value: float, spec: Spec) -> str:
  """Returns a number for people, who take what is next to nothing for nothing."""
  text = number(value, spec)
  return "0" if "e\N{MINUS SIGN}" in text else text


def _tells(spec: Spec, recording: Recording) -> bool:
  """Returns whether a metric says something: an exercise that ends early is short for no merit."""
  return recording.outcome == SUCCESS or spec.group not in ("efficiency", "time")


def _words(text: str) -> str:
  return "".join(c for c in text if not c.isdigit() and c != ".")


def advice(recording: Recording, reference: Mapping[str, Any] | None, most: int = 4) -> list[str]:
  """Returns sentences about an exercise: how it ended, what to do better, what was good.

  Args:
    recording: of the exercise
    reference: of skilled people, see `score.make_reference`; without it only the end is known
    most: sentences about what to do better
  """
  said = [f"{ending(recording)}."]
  if reference is None or not len(recording.time):
    return said
  metrics = recording.metrics()
  result = score(metrics, reference, recording.outcome)
  ended = [name for name in result.over if _tells(METRICS[name], recording)]
  order, given = sorted(ended, key=lambda name: result.z[name]), set()
  for name in order[:most]:
    spec, row = METRICS[name], reference["metrics"][name]
    unit = "" if spec.shown in ("-", "count") else f" {spec.shown}"
    bound = "at most" if spec.better == "lower" else "at least"
    text = (
      f"{spec.label}: {number(getattr(metrics, name), spec)}{unit}, skilled people have {bound} "
      f"{number(row['limit'], spec)}{unit}"
    )
    single = name == "log_dimensionless_jerk" and metrics.number_of_movements < 2
    what = "" if single else _ADVICE.get(name, "")  # one movement cannot be made of several
    said.append(f"{text}: {what}." if what and what not in given else f"{text}.")  # once
    given.add(what)
  if recording.outcome == SUCCESS:
    good = [k for k, z in result.z.items() if math.isfinite(z) and z > 0.5 and k not in result.over]
    good.sort(key=lambda name: -result.z[name])
    if good:
      labels = (METRICS[name].label for name in good[:3])
      labels = ", ".join(label[0].lower() + label[1:] for label in labels)
      said.append(f"Better than most skilled people: {labels}.")
    if result.proficient:
      said.append("Every metric is within its limit: this was a proficient episode.")
  return said


def card(recording: Recording, reference: Mapping[str, Any] | None) -> dict[str, Any]:
  """Returns the score card of an exercise, JSON."""
  metrics = recording.metrics()
  result = None
  if reference is not None and len(recording.time):
    result = score(metrics, reference, recording.outcome)
  rows = []
  for name, spec in METRICS.items():
    value = getattr(metrics, name)
    if not math.isfinite(value) or not _tells(spec, recording):
      continue
    limit = "" if result is None else reference["metrics"].get(name)  # pyright: ignore
    rows.append({
      "label": spec.label,
      "group": spec.group,
      "value": _shown(value, spec),
      "unit": spec.shown,
      "limit": number(limit["limit"], spec) if limit else "",
      "over": result is not None and name in result.over,
    })  # fmt: skip
  composite = None
  if result is not None and math.isfinite(result.composite):
    composite = round(result.composite, 2)
  return {
    "outcome": recording.outcome,
    "advice": advice(recording, reference),
    "composite": composite,
    "proficient": result is not None and result.proficient,
    "rows": rows,
  }
