"""Any other device, over UDP: a program of its own sends poses and gets forces.

The packets are in docs/live.md.
"""

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
  rate = 500.0
  force_limit, torque_limit = 3.0, 0.1

  def __init__(self, port: int, host: str):
    """Listens.

    Args:
      port: UDP port, 0 for any that is free
      host: address of this machine; others reach it only by one that is not 127.0.0.1
    """
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
