"""An exercise by the keyboard, in MuJoCo's window and in real time."""

import pathlib
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from palpate.tasks.core import episode
from palpate.tasks.core.scenes import CAMERA
from palpate.tasks.display import Window
from palpate.tasks.recording import Recording

from .console import CommandError

_KEYS = {  # GLFW key -> component, sign
  265: ("pitch", 1.0),  # up
  264: ("pitch", -1.0),  # down
  262: ("yaw", 1.0),  # right
  263: ("yaw", -1.0),  # left
  ord("W"): ("insertion", -1.0),
  ord("S"): ("insertion", 1.0),
  ord("A"): ("roll", -1.0),
  ord("D"): ("roll", 1.0),
  ord("O"): ("jaw", 1.0),
  ord("C"): ("jaw", -1.0),
  ord("R"): ("report", 1.0),
}
_ESCAPE = 256
_HOLD = 0.15  # a key acts for this long [s]


class Hand:
  """Turns keys into actions."""

  def __init__(self, components: tuple[str, ...]):
    """Makes a hand for a task with these components of an action."""
    self._components = components
    self._pressed: dict[str, tuple[float, float]] = {}  # component -> sign, until
    self._jaw = 0.0
    self.ended = False

  def press(self, key: int) -> None:
    """Takes a key, by its GLFW number; called in the window's thread."""
    if key == _ESCAPE:
      self.ended = True
    elif key in _KEYS:
      component, sign = _KEYS[key]
      if component == "jaw":
        self._jaw = float(np.clip(self._jaw + 0.1 * sign, -1, 1))
      else:
        self._pressed[component] = sign, time.monotonic() + _HOLD

  def __call__(self, timestep: Any) -> np.ndarray:
    """Returns the action of the keys that are held."""
    now = time.monotonic()
    action = {name: sign for name, (sign, until) in self._pressed.items() if until > now}
    action["jaw"] = self._jaw
    return np.array([action.get(name, 0.0) for name in self._components])


def run(
  env,
  seed: int,
  info: Mapping[str, Any],
  watch: Callable[[Any], bool],
  journal: pathlib.Path | None = None,
) -> Recording:
  """Returns the recording of an episode, as `episode.run` does; Esc or the window ends it."""
  hand = Hand(env.task.components)
  # The episode starts with the first step; the window needs the model that it will have.
  env.task.random = np.random.RandomState(seed)
  env.reset()
  try:
    window = Window(env.physics, CAMERA, hand.press)
  except RuntimeError as error:
    raise CommandError(f"{error}; use another performer", code=1) from None
  with window:
    due = time.monotonic()

    def step(env) -> bool:
      nonlocal due
      there = window.show()
      due += env.control_timestep()
      time.sleep(max(0.0, due - time.monotonic()))
      return watch(env) or hand.ended or not there

    return episode.run(env, hand, seed, info, watch=step, journal=journal)
