"""Any other device, over UDP: a program of its own sends poses and gets forces.

A packet to here, little-endian, 44 bytes:

| offset | type | what |
|---|---|---|
| 0 | 4 bytes | `PALP` |
| 4 | uint8 | 1, the version |
| 5 | uint8 | 1: there is an orientation; 2: there is an opening of the jaws |
| 6 | uint16 | buttons held: 1 clutch, 2 grip, 4 report, 8 pause |
| 8 | uint32 | number of the packet; one that is not above the last is thrown away |
| 12 | 3 float32 | place [m]: x to the right, y up, z towards the person |
| 24 | 4 float32 | orientation, w x y z |
| 40 | float32 | opening of the jaws, 1 is wide open, -1 squeezes |

Each is answered with the force of that moment, to where it came from, 36 bytes:

| offset | type | what |
|---|---|---|
| 0 | 4 bytes | `PALF` |
| 4 | uint8 | 1, the version |
| 5 | 3 bytes | 0 |
| 8 | uint32 | number of the last packet |
| 12 | 3 float32 | force on the hand [N], in the same axes |
| 24 | 3 float32 | torque on the hand [N m] |

A sender that hears nothing for 50 ms sets its forces to zero by itself. Who sent first is listened
to alone, until that one has said nothing for 2 s.
"""

from __future__ import annotations

import contextlib
import socket
import struct

from .device import DeviceError, Reading, Silent, Three

POSE = struct.Struct("<4sBBHI8f")
FORCE = struct.Struct("<4sB3xI6f")
NAMES = ("clutch", "grip", "report", "pause")
_VERSION = 1
_SILENT = 2.0  # after which another sender may come [s]


class Bridge(Silent):
  """A device behind a UDP port.

  Attributes:
    dropped: packets that were none, late, or another sender's
    port: that is listened on
  """

  name = "udp"
  relative = False

  def __init__(
    self, port: int = 5005, host: str = "127.0.0.1", rate: float = 500.0, force_limit: float = 3.0
  ):
    """Listens.

    Args:
      port: UDP port, 0 for any that is free
      host: address of this machine; others reach it only by one that is not 127.0.0.1
      rate: packets a second
      force_limit: largest force that the device can give [N]
    """
    self.rate, self.force_limit, self.torque_limit = rate, force_limit, 0.1
    self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    self._socket.setblocking(False)
    try:
      self._socket.bind((host, port))
    except (OSError, OverflowError) as error:
      self._socket.close()
      raise DeviceError(f"udp: cannot listen on {host}:{port}: {error}") from error
    self.port = self._socket.getsockname()[1]
    self.dropped, self._number, self._heard = 0, -1, 0.0
    self._peer: tuple | None = None

  def read(self, now: float) -> Reading | None:
    """Returns the last of the packets that have come."""
    found = None
    for _ in range(64):  # a flood does not stop the loop
      try:
        packet, peer = self._socket.recvfrom(256)
      except BlockingIOError:
        break
      except OSError as error:  # the peer's port is closed
        if isinstance(error, ConnectionError):
          continue
        raise DeviceError(f"udp: {error}") from error
      found = self._take(packet, peer, now) or found
    return found

  def _take(self, packet: bytes, peer: tuple, now: float) -> Reading | None:
    if now - self._heard > _SILENT:
      self._peer, self._number = None, -1
    fits = len(packet) == POSE.size and packet[:5] == b"PALP" + bytes([_VERSION])
    if not fits or self._peer not in (None, peer):
      self.dropped += 1
      return None
    _, _, flags, bits, number, *values = POSE.unpack(packet)
    if number <= self._number:
      self.dropped += 1
      return None
    self._peer, self._number, self._heard = peer, number, now
    x, y, z, qw, qx, qy, qz, jaw = values
    held = frozenset(name for i, name in enumerate(NAMES) if bits >> i & 1)
    return Reading(
      (x, y, z), (qw, qx, qy, qz) if flags & 1 else None, 0.0, jaw if flags & 2 else None, held
    )

  def send(self, force: Three, torque: Three) -> None:
    """Sends a force to the sender of the poses."""
    if self._peer is None:
      return
    packet = FORCE.pack(b"PALF", _VERSION, self._number, *force, *torque)
    with contextlib.suppress(OSError):  # a full queue; the next one follows in a millisecond
      self._socket.sendto(packet, self._peer)

  def close(self) -> None:
    """Sends zero force and lets go of the port."""
    if self._socket.fileno() >= 0:
      self.send((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
      self._socket.close()
