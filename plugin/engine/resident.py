"""An organ whose motion stays on its device between steps: when it is sent and when fetched.

The first number of the plugin state's tail is a stamp of the motion: 0 where the state was set from
outside and has to be sent, n where the plugin state holds motion n, -n where motion n is on the
device alone. A state that was saved with -n can be continued only by the device that still has it.

The device begins a step as soon as the last one has ended, and works while MuJoCo looks for
contacts and the user's program decides what to do. It takes for granted that what acts on the
organ besides contacts stays; where that was wrong the solve is done again.
"""

from __future__ import annotations

import itertools
import time
from typing import Any

import warp as wp

from . import window_slots
from .coupling import FORESEEN, PENDING
from .window_nodes import HALT

_stamps = itertools.count(time.time_ns() >> 10)  # never the same number twice


class Resident:
  """The motion of one windowed organ on a device.

  Args:
    w: the workspace
    nodes: the kernels' view of the nodes
    start: where the organ's numbers start in mjData.plugin_state
    end_step: launches the end of the last step on the device
    look_again: launches the search for nodes near the tools once more
  """

  def __init__(self, w, nodes, start: int, end_step, look_again):
    self.w, self.nodes = w, nodes
    self.state = w.views["plugin_state"].numpy()
    self.tail = self.state[-window_slots.TAIL :]
    self.device = w.body.device
    self.live = -1
    # Recorded graphs: the guess, on the CPU; the solve with it, on the device; what is left then.
    self.foresee: Any = None
    self.begin_graph: Any = None
    self.rest: list = []
    self._begun = False
    w.flags[FORESEEN] = 1
    self._end_step, self._look_again = end_step, look_again
    self._motion = (nodes.disp, nodes.velocity, nodes.last, nodes.before)
    self._staging = wp.zeros(
      4 * 3 * nodes.nvert, dtype=wp.float64, device="cpu", pinned=self.device.is_cuda
    )

  def send(self):
    """Sends the motion where the plugin state was set from outside.

    Raises:
      RuntimeError: the plugin state was saved while its motion was on a device.
    """
    stamp = int(self.tail[0])
    if abs(stamp) == self.live:
      return
    self._begun = False
    if stamp < 0:
      raise RuntimeError(
        "this state was saved or copied while its motion was on the device (resident='true'); "
        "call palpate.Organ.sync() before saving or copying it"
      )
    size = 3 * self.nodes.nvert
    self._staging.numpy()[:] = self.state[: 4 * size]
    for k, array in enumerate(self._motion):
      wp.copy(array, self._staging, src_offset=k * size, count=size)
    wp.synchronize_device(self.device)
    self.w.flags[PENDING] = self.w.views["inbox"].numpy()[3] = 0  # it ends no step
    self.live = next(_stamps)
    self.tail[0] = self.live

  def step(self, computed: bool):
    """Notes that a step was taken on the device alone, and begins the next one there.

    Not if the last guess was wrong: what acts on the organ changes from step to step then.

    Args:
      computed: whether forces were computed in this step, and so the device was waited for
    """
    self.live = next(_stamps)
    self.tail[0] = -self.live
    self._begun = False
    if not computed:
      return
    w = self.w
    wp.capture_launch(self.foresee)
    self._begun = bool(w.flags[FORESEEN]) and w.flags[PENDING] != HALT
    if self._begun:
      wp.capture_launch(self.begin_graph)
      w.flags[PENDING] = w.views["inbox"].numpy()[3] = 0  # this ends the last step

  def left_to_do(self) -> list:
    """Returns the graphs of the solve, or of what is left of one that was begun with the truth."""
    if self._begun and self.w.flags[FORESEEN]:
      return self.rest
    self._begun = False
    return self.w.solve

  def look(self):
    """Repeats the search within a shorter reach while it finds more than there is room for."""
    w, n = self.w, self.nodes
    inbox, outbox = w.views["inbox"].numpy(), w.views["outbox"].numpy()
    first = window_slots.SUMMARY + 12 * n.nslot
    found = outbox[first : first + n.nwindow]
    while found.max() > n.most:
      inbox[7] *= 0.75
      self._look_again()
      wp.synchronize_device(self.device)

  def stop(self):
    """Brings the motion into the plugin state and forgets the step that was begun."""
    self.fetch()
    self.live, self.w.flags[FORESEEN] = -1, 1

  def fetch(self):
    """Brings the motion into the plugin state."""
    stamp = int(self.tail[0])
    if stamp >= 0 or -stamp != self.live:
      return
    inbox, flags = self.w.views["inbox"].numpy(), self.w.flags
    inbox[3] = flags[PENDING]
    self._end_step()
    size = 3 * self.nodes.nvert
    for k, array in enumerate(self._motion):
      wp.copy(self._staging, array, dest_offset=k * size, count=size)
    wp.synchronize_device(self.device)
    self.state[: 4 * size] = self._staging.numpy()
    inbox[3] = flags[PENDING] = 0
    self.tail[0] = self.live
