"""The coach: says what to do next and what goes wrong, and afterwards what to do better."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from palpate.tasks.metrics import METRICS, SUCCESS, Spec, number
from palpate.tasks.people.report import ending
from palpate.tasks.people.score import Score, score, tells
from palpate.tasks.recording import Recording

_STAYS = 0.6  # how long a warning is shown [s]
_STILL = 1e-3  # path of a hand that has not moved [m]
# What helps, by metric; those that are left out say so by their names.
ADVICE = {
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
  "time": "be quicker where nothing is touched",
  "path_length": "go straight to the target",
  "path_inefficiency": "go straight to the target",
  "log_dimensionless_jerk": "make one smooth movement in place of several corrections",
  "angular_path": "turn the instrument less",
  "depth_path": "find the depth first, then go in once",
  "number_of_movements": "make fewer, longer movements",
  "idle_time": "plan the next movement during the present one",
  "idle_share": "plan the next movement during the present one",
  "out_of_view": "keep the tip in the picture",
  "off_centre": "keep what is worked on in the middle of the picture",
  "horizon_angle": "turn the camera back whenever you roll the scope",
  "regrasps": "plan how the other hand is to take it before you hand it over",
  "ring_contact": "turn the needle about its circle in place of pushing it",
  "peak_ring_force": "turn the needle about its circle in place of pushing it",
  "final_gap": "pull the thread until the edges meet, and hold it so",
  "peak_tension": "pull the thread slowly, and no harder than closes the cut",
  "tearing": "pull the thread slowly, and no harder than closes the cut",
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


def _words(text: str) -> str:
  return "".join(c for c in text if not c.isdigit() and c != ".")


@dataclasses.dataclass(frozen=True)
class Judged:
  """What an exercise came to.

  Attributes:
    result: against the limits of skilled people, None without them
    better: metrics that are over their limits, the worst first
    good: metrics in which the person was better than most skilled people, the best first
  """

  result: Score | None
  better: tuple[str, ...] = ()
  good: tuple[str, ...] = ()


def judge(recording: Recording, reference: Mapping[str, Any] | None) -> Judged:
  """Returns what an exercise came to, by a reference of skilled people, see `score`."""
  if reference is None or not len(recording.time):
    return Judged(None)
  result = score(recording.metrics(), reference, recording.outcome)
  good = []
  if recording.outcome == SUCCESS:
    good = [k for k, z in result.z.items() if math.isfinite(z) and z > 0.5 and k not in result.over]
  better = sorted(result.over, key=lambda name: result.z[name])
  return Judged(result, tuple(better), tuple(sorted(good, key=lambda name: -result.z[name])))


def _help(name: str, recording: Recording) -> str:
  """Returns what helps with a metric; one movement cannot be made of several."""
  single = name == "log_dimensionless_jerk" and recording.metrics().number_of_movements < 2
  return "" if single else ADVICE.get(name, "")


def _row(name: str, recording: Recording, reference: Mapping[str, Any] | None) -> dict[str, Any]:
  """Returns a metric for people: its label, value and limit, with their unit."""
  spec = METRICS[name]
  unit = "" if spec.shown in ("-", "count") else f" {spec.shown}"
  limit = reference["metrics"].get(name) if reference is not None else None
  return {
    "label": spec.label,
    "value": _shown(getattr(recording.metrics(), name), spec) + unit,
    "limit": number(limit["limit"], spec) + unit if limit else "",
    "least": spec.better == "higher",
  }


def card(recording: Recording, reference: Mapping[str, Any] | None) -> dict[str, Any]:
  """Returns the score card of an exercise, JSON.

  First what counts: whether it is `done`, what was `good`, what to do `better`; then all metrics in
  `rows`, and the score of what was done.
  """
  metrics, judged = recording.metrics(), judge(recording, reference)
  result, done = judged.result, recording.outcome == SUCCESS
  known = reference if len(recording.time) else None
  rows = [
    _row(name, recording, known) | {"over": result is not None and name in result.over}
    for name, spec in METRICS.items()
    if math.isfinite(getattr(metrics, name)) and tells(spec, recording.outcome)
  ]
  score_of = result.composite if done and result is not None else math.nan
  helps = dict.fromkeys(_help(name, recording) for name in judged.better)
  return {
    "outcome": recording.outcome,
    "done": done,
    "proficient": result is not None and result.proficient,
    "ending": ending(recording),
    "good": [METRICS[name].label for name in judged.good[:3]],
    "better": [_row(name, recording, known) for name in judged.better[:3]],
    "helps": [what for what in helps if what][:3],
    "moved": bool(metrics.path_length > _STILL),
    "composite": round(score_of, 2) if math.isfinite(score_of) else None,
    "rows": rows,
    "said": [],
  }
