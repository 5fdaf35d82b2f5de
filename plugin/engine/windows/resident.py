"""An organ whose motion stays on its device between steps: when it is sent and when fetched.

The first number of the plugin state's tail is a stamp of the motion: 0 where the state was set from
outside and has to be sent, n where the plugin state holds motion n, -n where motion n is on the
device alone. A state that was saved with -n can be continued only by the device that still has it.

The device begins a step as soon as the last one has ended, and works while MuJoCo looks for
contacts and the user's program decides what to do. It takes for granted that what acts on the
organ besides contacts stays; where that was wrong the solve is done again.
"""

import itertools
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import warp as wp

from ..layout import FLAG, HEAD, MODE, TAIL

_stamps = itertools.count(time.time_ns() >> 10)  # never the same number twice


class Resident:
  """The motion of one windowed organ on a device.

  Args:
    flags: see `layout.FLAG`
    boxes: blocks of the plugin state and of what crosses, see `Workspace`
    state: the organ's own numbers
    motion: the motion on the device, the numbers of `layout.Motion`
    end_step: launches the end of the last step on the device
    look_again: launches the search for nodes near the tools once more
  """

  def __init__(
    self,
    flags: memoryview,
    boxes: Mapping[str, Any],
    state: np.ndarray,
    motion: wp.array,
    end_step: Callable[[], None],
    look_again: Callable[[], None],
  ):
    self._flags = flags
    own, inbox, outbox = (boxes[name] for name in ("own", "inbox", "outbox"))
    self.state = state[: motion.size]  # the motion comes first there
    self.tail, self.head = own.tail.numpy(), inbox.head.numpy()
    self.found = outbox.found.numpy()
    self.most, _ = outbox.record.shape
    self.device = wp.get_device(motion.device)
    self.live = -1
    # Recorded graphs: the guess, on the CPU; the solve with it, on the device; what is left then.
    self.foresee: Any = None
    self.begin_graph: Any = None
    self.rest: list = []
    self._begun = False
    flags[FLAG.foreseen] = 1
    self._end_step, self._look_again, self._motion = end_step, look_again, motion
    self._staging = wp.zeros(
      motion.size, dtype=wp.float64, device="cpu", pinned=self.device.is_cuda
    )

  def send(self):
    """Sends the motion where the plugin state was set from outside.

    Raises:
      RuntimeError: the plugin state was saved while its motion was on a device.
    """
    stamp = int(self.tail[TAIL.stamp])
    if abs(stamp) == self.live:
      return
    self._begun = False
    if stamp < 0:
      raise RuntimeError(
        "this state was saved or copied while its motion was on the device (resident='true'); "
        "call palpate.Organ.sync() before saving or copying it"
      )
    self._staging.numpy()[:] = self.state
    wp.copy(self._motion, self._staging)
    wp.synchronize_device(self.device)
    self._flags[FLAG.pending] = self.head[HEAD.mode] = MODE.still  # it ends no step
    self.live = next(_stamps)
    self.tail[TAIL.stamp] = self.live

  def step(self, computed: bool):
    """Notes that a step was taken on the device alone, and begins the next one there.

    Not if the last guess was wrong: what acts on the organ changes from step to step then.

    Args:
      computed: whether forces were computed in this step, and so the device was waited for
    """
    self.live = next(_stamps)
    self.tail[TAIL.stamp] = -self.live
    self._begun = False
    if not computed:
      return
    wp.capture_launch(self.foresee)
    flags = self._flags
    self._begun = bool(flags[FLAG.foreseen]) and flags[FLAG.pending] != MODE.halt
    if self._begun:
      wp.capture_launch(self.begin_graph)
      flags[FLAG.pending] = self.head[HEAD.mode] = MODE.still  # this ends the last step

  def left_to_do(self, solve: list) -> list:
    """Returns the graphs of the solve, or of what is left of one that was begun with the truth."""
    if self._begun and self._flags[FLAG.foreseen]:
      return self.rest
    self._begun = False
    return solve

  def look(self):
    """Repeats the search within a shorter reach while it finds more than there is room for."""
    while self.found[0] > self.most:
      self.head[HEAD.reach] *= 0.75
      self._look_again()
      wp.synchronize_device(self.device)

  def stop(self):
    """Brings the motion into the plugin state and forgets the step that was begun."""
    self.fetch()
    self.live, self._flags[FLAG.foreseen] = -1, 1

  def renew(self):
    """Notes that the motion in the plugin state was changed, and has to be sent."""
    self.stop()
    self.tail[TAIL.stamp] = 0.0

  def fetch(self):
    """Brings the motion into the plugin state."""
    stamp = int(self.tail[TAIL.stamp])
    if stamp >= 0 or -stamp != self.live:
      return
    flags = self._flags
    self.head[HEAD.mode] = flags[FLAG.pending]
    self._end_step()
    wp.copy(self._staging, self._motion)
    wp.synchronize_device(self.device)
    self.state[:] = self._staging.numpy()
    self.head[HEAD.mode] = flags[FLAG.pending] = MODE.still
    self.tail[TAIL.stamp] = self.live
