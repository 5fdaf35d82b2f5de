"""Training live: a paced loop, devices for the hand, virtual coupling, coach, page and record.

from palpate.app import live

hand = live.device("udp:5005")
recording = live.Session(env, hand).run()
"""

from .coupling import Link, Options
from .devices.device import Device, DeviceError, Reading
from .devices.hand import Hand
from .devices.registry import NAMES, device
from .loop import Loop
from .realtime_clock import Lateness, Pace
from .session import Session

__all__ = [
  "NAMES", "Device", "DeviceError", "Hand", "Lateness", "Link", "Loop", "Options", "Pace",
  "Reading", "Session", "device",
]  # fmt: skip
