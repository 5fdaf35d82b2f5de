"""Devices: what they read and refuse, and those behind makers' libraries, without hardware."""

import math
import socket
import sys
import time
import types

import numpy as np
import pytest
from palpate.app import live
from palpate.app.live.devices import bridge
from palpate.app.live.devices.haptic import quaternion
from palpate.app.live.devices.relative import Desk


def test_a_desk_adds_up_what_it_is_told():
  desk = Desk("mouse")
  assert desk.read(1.0).pos == (0.0, 0.0, 0.0)
  desk.feed(move=(0.001, 0.002, 0.0, 0.1), buttons=["grip"])
  desk.feed(move=(0.001, 0.0, 0.0, 0.0), rate=(0.0, 0.0, -1.0, 0.5), buttons=["clutch"])
  reading = desk.read(1.01)
  assert reading.pos == pytest.approx((0.002, 0.002, -0.06 * 0.01))
  assert reading.roll == pytest.approx(0.1 + 0.01) and reading.buttons == {"clutch"}
  assert reading.lean == (0.0, 0.0)
  desk.feed(move=(0, 0, 0, 0, 0.1, 0.2), rate=(0, 0, 0, 0, 0, -1))
  assert desk.read(1.02).lean == pytest.approx((0.1, 0.2 - 0.01))
  desk.feed(jaw=-0.5)
  assert desk.read(1.02).jaw == -0.5


@pytest.mark.parametrize(
  ("what", "said"),
  [
    ({"move": (math.nan, 0, 0, 0)}, "move is"),
    ({"move": (1, 2)}, "expected 4 or 6 numbers"),
    ({"move": ("1", 0, 0, 0)}, "move is"),
    ({"rate": (2, 0, 0, 0)}, r"rate is .* in \[-1, 1\]"),
    ({"jaw": 3.0}, "jaw is"),
    ({"buttons": ["shoot"]}, "button is 'shoot', expected clutch, grip, pause, report"),
  ],
)
def test_a_desk_names_what_is_no_movement(what, said):
  desk = Desk()
  with pytest.raises(ValueError, match=said):
    desk.feed(**what)
  assert desk.read(0.0).pos == (0.0, 0.0, 0.0)


@pytest.fixture
def udp():
  device = live.device("udp:0")
  sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
  sender.settimeout(2.0)
  sender.connect(("127.0.0.1", device.port))
  yield device, sender
  sender.close()
  device.close()


def packet(number, pos, bits=0, flags=0, quat=(1, 0, 0, 0), jaw=0.0):
  return bridge.POSE.pack(b"PALP", 1, flags, bits, number, *pos, *quat, jaw)


def read(device, now):
  """Waits for the system to hand over what was sent."""
  for _ in range(200):
    if reading := device.read(now):
      return reading
    time.sleep(0.005)
  return None


def test_udp_reads_poses_and_answers_with_forces(udp):
  device, sender = udp
  assert device.read(0.0) is None
  device.send((1, 2, 3), (0, 0, 0))  # nobody there yet
  sender.send(packet(1, (0.01, 0.02, 0.03), bits=5))
  reading = read(device, 0.0)
  assert reading.pos == pytest.approx((0.01, 0.02, 0.03))
  assert reading.quat is None and reading.jaw is None and reading.buttons == {"clutch", "report"}
  sender.send(packet(2, (0, 0, 0), flags=3, quat=(0, 1, 0, 0), jaw=-0.5))
  reading = read(device, 0.01)
  assert reading.quat == (0.0, 1.0, 0.0, 0.0) and reading.jaw == -0.5
  device.send((0.5, -1.0, 2.0), (0.01, 0.0, 0.0))
  name, version, number, *values = bridge.FORCE.unpack(sender.recv(100))
  assert (name, version, number) == (b"PALF", 1, 2)
  np.testing.assert_allclose(values, [0.5, -1.0, 2.0, 0.01, 0, 0], rtol=1e-6)


def test_udp_throws_away_what_is_late_foreign_or_none(udp):
  device, sender = udp
  for bad in (b"", b"PALP", b"X" * 44, packet(1, (0, 0, 0))[:-1]):
    sender.send(bad)
  sender.send(packet(7, (0.01, 0, 0)))
  assert read(device, 0.0).pos[0] == pytest.approx(0.01)
  other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
  other.sendto(packet(9, (0.5, 0, 0)), ("127.0.0.1", device.port))
  sender.send(packet(6, (0.02, 0, 0)))
  sender.send(packet(8, (0.03, 0, 0)))
  assert read(device, 0.1).pos[0] == pytest.approx(0.03)
  assert device.dropped == 6
  other.sendto(packet(1, (0.04, 0, 0)), ("127.0.0.1", device.port))  # the first has fallen silent
  assert read(device, 5.0).pos[0] == pytest.approx(0.04)
  other.close()


def test_a_port_in_use_is_one_line(udp):
  device, _ = udp
  with pytest.raises(live.DeviceError, match=f"udp: cannot listen on 127.0.0.1:{device.port}"):
    live.device(f"udp:{device.port}")


@pytest.mark.parametrize(
  ("name", "said"),
  [
    ("glove", "device is 'glove', expected one of mouse, keyboard"),
    ("udp:x", "port is 'x'"),
    ("udp:70000", "port is '70000'"),
    ("gamepad:x", "device 'gamepad:x'"),
  ],
)
def test_a_name_that_is_none_is_named(name, said):
  with pytest.raises(ValueError, match=said):
    live.device(name)


@pytest.mark.parametrize(
  ("name", "module"),
  [
    ("spacemouse", "pyspacemouse"),
    ("openhaptics", "pyOpenHaptics"),
    ("forcedimension", "forcedimension_core"),
    ("haply", "HaplyHardwareAPI"),
    ("gamepad", "pygame"),
  ],
)
def test_a_missing_library_says_what_to_install(name, module, monkeypatch):
  for known in [k for k in sys.modules if k.split(".")[0] == module]:
    monkeypatch.delitem(sys.modules, known)
  monkeypatch.setitem(sys.modules, module, None)
  with pytest.raises(live.DeviceError, match=rf"pip install 'palpate\[{name}\]'"):
    live.device(name)


def test_spacemouse(monkeypatch):
  state = types.SimpleNamespace(x=1.0, y=0.5, z=-1.0, yaw=0.0, buttons=[1, 0])
  mouse = types.SimpleNamespace(read=lambda: state, close=lambda: None)
  library = types.SimpleNamespace(open=lambda axis_convention: mouse)
  monkeypatch.setitem(sys.modules, "pyspacemouse", library)
  device = live.device("spacemouse")
  device.read(0.0)
  reading = device.read(0.05)
  x, y, z = reading.pos
  assert x == pytest.approx(0.06 * 0.05) and y == pytest.approx(-x) and -x < z < 0
  assert reading.buttons == {"clutch"}
  mouse.read = lambda: (_ for _ in ()).throw(OSError("unplugged"))
  with pytest.raises(live.DeviceError, match="spacemouse: unplugged"):
    device.read(0.1)


def settle(device):
  """Returns a reading that came after what was sent last."""
  for _ in range(3):
    reading = None
    while reading is None:
      reading = device.read(0.0)
  return reading


def test_force_dimension(monkeypatch):
  sent = []

  def frame(pos, mat, ID):
    time.sleep(1e-4)
    pos[:] = [0.03, 0.01, 0.02]
    for i in range(3):
      mat[i][:] = [float(i == j) for j in range(3)]
    return 0

  dhd = types.SimpleNamespace(
    openID=lambda index: 4,
    enableForce=lambda on, ID: 0,
    setForceAndTorque=lambda f, t, ID: sent.append((tuple(f), tuple(t))) or 0,
    getPositionAndOrientationFrame=frame,
    getButtonMask=lambda ID: 1,
    hasGripper=lambda ID: False,
    stop=lambda ID: 0,
    close=lambda ID: 0,
    errorGetLastStr=lambda: "no device",
  )
  package = types.ModuleType("forcedimension_core")
  monkeypatch.setitem(sys.modules, "forcedimension_core", package)
  monkeypatch.setitem(sys.modules, "forcedimension_core.dhd", dhd)
  device = live.device("forcedimension")
  device.send((1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
  reading = settle(device)
  assert reading.pos == (0.01, 0.02, 0.03) and reading.buttons == {"clutch"}
  np.testing.assert_allclose(reading.quat, (1, 0, 0, 0))
  assert ((3.0, 1.0, 2.0), (0.3, 0.1, 0.2)) in sent
  time.sleep(0.08)  # the loop has fallen silent: it lets go
  settle(device)
  assert sent[-1] == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
  device.close()
  dhd.openID = lambda index: -1
  with pytest.raises(live.DeviceError, match="no device 0: no device"):
    live.device("forcedimension")


def test_haply(monkeypatch):
  sent = []

  class Inverse3:
    def __init__(self, stream):
      pass

    def device_wakeup_dict(self):
      return {}

    def end_effector_force(self, force):
      time.sleep(1e-4)
      sent.append(tuple(force))
      return (0.01, -0.03, 0.02), (0.0, 0.0, 0.0)

  ports = ["a"]
  library = types.SimpleNamespace(
    detect_inverse3s=lambda: ports, SerialStream=lambda port: port, Inverse3=Inverse3
  )
  monkeypatch.setitem(sys.modules, "HaplyHardwareAPI", library)
  device = live.device("haply")
  device.send((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
  assert settle(device).pos == (0.01, 0.02, 0.03) and (1.0, -3.0, 2.0) in sent
  device.close()
  assert sent[-1] == (0.0, 0.0, 0.0)
  ports.clear()
  with pytest.raises(live.DeviceError, match="no Inverse3 with number 0"):
    live.device("haply")


def test_openhaptics(monkeypatch):
  sent, calls = [], []
  columns = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [10, 20, 30, 1]]  # x stays, y goes to z
  hd = types.SimpleNamespace(
    set_force=sent.append, get_transform=lambda: columns, get_buttons=lambda: 2
  )

  class HapticDevice:
    id = 0

    def __init__(self, callback):
      calls.append(callback)

    def close(self):
      calls.clear()

  names = {
    "hd": hd,
    "hd_callback": types.SimpleNamespace(hd_callback=lambda f: f),
    "hd_device": types.SimpleNamespace(HapticDevice=HapticDevice),
  }
  monkeypatch.setitem(sys.modules, "pyOpenHaptics", types.ModuleType("pyOpenHaptics"))
  for name, module in names.items():
    monkeypatch.setitem(sys.modules, f"pyOpenHaptics.{name}", module)
  device = live.device("openhaptics")
  assert device.read(0.0) is None
  device.send((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
  calls[0]()
  reading = device.read(0.0)
  assert reading.pos == pytest.approx((0.01, 0.02, 0.03)) and reading.buttons == {"grip"}
  np.testing.assert_allclose(reading.quat, (math.sqrt(0.5), math.sqrt(0.5), 0, 0))
  assert sent == [[1.0, 2.0, 3.0]]
  hd.get_transform = lambda: 1 / 0
  calls[0]()
  with pytest.raises(live.DeviceError, match="openhaptics: ZeroDivisionError"):
    device.read(0.0)
  device.close()


@pytest.mark.parametrize("seed", range(4))
def test_quaternion_of_a_matrix(seed):
  random = np.random.RandomState(seed)
  q = random.normal(size=4)
  q /= np.linalg.norm(q)
  w, x, y, z = q
  mat = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ]
  assert abs(np.dot(quaternion(mat), q)) == pytest.approx(1.0)
