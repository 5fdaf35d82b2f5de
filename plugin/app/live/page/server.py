"""The page: who may load it, and one process for each that is open."""

import contextlib
import ipaddress
import json
import multiprocessing
import pathlib
import re
import secrets
import socket as socketlib
import threading
import urllib.parse
from http import HTTPStatus
from typing import Any

from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from ...trainee.keeping import Keeping
from . import worker

_STATIC = pathlib.Path(__file__).with_name("static")
_KINDS = {
  ".html": "text/html; charset=utf-8",
  ".js": "text/javascript; charset=utf-8",
  ".css": "text/css; charset=utf-8",
  ".svg": "image/svg+xml; charset=utf-8",
  ".webp": "image/webp",
}
# What is served, and nothing else.
_FILES = {"/": _STATIC / "page.html"} | {
  f"/{path.relative_to(_STATIC).as_posix()}": path
  for path in _STATIC.rglob("*")
  if path.suffix in _KINDS and path.name != "page.html"
}
_LARGEST = 4096  # message from a page [bytes]
_PATIENCE = 10.0  # for a page's process to keep its recording [s]
_POLICY = "default-src 'self'; connect-src 'self' {sockets}; frame-ancestors 'none'"
_HOST = re.compile(r"[\w.:\[\]-]+")


class Server:
  """Serves the page until it is closed.

  Attributes:
    url: where the page is, with its token
    port: that is listened on
  """

  def __init__(
    self,
    folder: pathlib.Path,
    host: str = "127.0.0.1",
    port: int = 0,
    token: str | None = None,
    device: str = "mouse",
    most: int = 2,
    kept: Keeping | None = None,
    scene: str = "",
  ):
    """Listens.

    Args:
      folder: where recordings are kept
      host: address of this machine; by any but its own, others reach the page, with the token alone
      port: 0 for any that is free
      token: that a page must know; made up where others can reach it and none is given
      device: see `devices.device`
      most: pages at a time
      kept: the record that recordings go to, None for the folder
      scene: MJCF file for free practice, empty for none
    """
    self.token = token or ("" if _own(host) else secrets.token_urlsafe(16))
    self._folder, self._device, self._kept, self._scene = folder, device, kept, scene
    self._places = threading.BoundedSemaphore(most)
    self._open: set[ServerConnection] = set()
    self._server = serve(
      self._page, host, port, process_request=self._answer, compression=None, max_size=_LARGEST,
      server_header=None,
    )  # fmt: skip
    self.port = self._server.socket.getsockname()[1]
    self._hosts = _names(host, self.port)
    shown = host if host not in ("0.0.0.0", "::") else socketlib.gethostname()
    query = f"?token={self.token}" if self.token else ""
    self.url = f"http://{f'[{shown}]' if ':' in shown else shown}:{self.port}/{query}"

  def run(self) -> None:
    """Serves until `close` is called from another thread, or a signal's handler."""
    self._server.serve_forever()

  def close(self) -> None:
    """Ends the pages, whose recordings are kept."""
    self._server.shutdown()
    for socket in tuple(self._open):
      socket.close(1001)

  def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
    """Refuses a stranger, sends a file, or lets a page in."""
    path, _, query = request.path.partition("?")
    host, *more = request.headers.get_all("Host") or [""]
    if more or not _HOST.fullmatch(host):
      return _response(HTTPStatus.BAD_REQUEST, "expected one Host, a name and a port")
    # A foreign page whose name leads here is as foreign as one that says so.
    if self._hosts and host not in self._hosts:
      return _response(HTTPStatus.FORBIDDEN, f"host is {host!r}, expected {self._hosts[0]}")
    given = urllib.parse.parse_qs(query).get("token", [""])[0]
    if self.token and path in ("/", "/socket"):
      if not secrets.compare_digest(given.encode(), self.token.encode()):
        return _response(HTTPStatus.FORBIDDEN, "no token, or a wrong one: use the printed address")
    if path == "/socket":
      origin = request.headers.get("Origin", "")
      if urllib.parse.urlsplit(origin).netloc != host:
        return _response(HTTPStatus.FORBIDDEN, f"origin is {origin!r}, expected this page")
      return None
    if path not in _FILES:
      return _response(HTTPStatus.NOT_FOUND, "no such page")
    file = _FILES[path]
    return _response(HTTPStatus.OK, file.read_bytes(), _KINDS[file.suffix], host)

  def _page(self, socket: ServerConnection) -> None:
    """Connects a page with a process of its own, in a thread of its own."""
    # A page that is loaded again comes before its former self has kept its recording and gone.
    if not self._places.acquire(timeout=_PATIENCE):
      socket.send(json.dumps({"type": "error", "text": "All places are taken; close another page"}))
      socket.close(1013)
      return
    self._open.add(socket)
    try:
      self._connect(socket)
    finally:
      self._open.discard(socket)
      self._places.release()

  def _connect(self, socket: ServerConnection) -> None:
    context = multiprocessing.get_context("spawn")
    near, far = context.Pipe()
    process = context.Process(
      target=worker.main,
      args=(far, str(self._folder), self._device, self._kept, self._scene),
      daemon=True,
    )
    process.start()
    far.close()
    pump = threading.Thread(target=_pump, args=(near, socket), daemon=True)
    pump.start()
    try:
      with contextlib.suppress(ConnectionClosed, OSError):
        for message in socket:
          near.send_bytes(message.encode() if isinstance(message, str) else message)
    finally:
      with contextlib.suppress(OSError):
        near.send_bytes(b'{"type": "end"}')
      process.join(_PATIENCE)
      if process.is_alive():
        process.kill()
      near.close()


def _pump(near: Any, socket: ServerConnection) -> None:
  """Hands on what a process says to its page."""
  with contextlib.suppress(EOFError, OSError, ConnectionClosed):
    while True:
      message = near.recv_bytes()
      socket.send(message[1:].decode() if message[:1] == b"T" else message[1:])
  with contextlib.suppress(ConnectionClosed, OSError):
    socket.close()


def _response(
  status: HTTPStatus, content: str | bytes, kind: str = "text/plain; charset=utf-8", host: str = ""
) -> Response:
  body = content.encode() if isinstance(content, str) else content
  sockets = f"ws://{host} wss://{host}" if host else ""  # older browsers: 'self' is http alone
  headers = Headers({
    "Content-Type": kind,
    "Content-Length": str(len(body)),
    "Content-Security-Policy": _POLICY.format(sockets=sockets),
    "Referrer-Policy": "no-referrer",  # the address has the token
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Connection": "close",
  })  # fmt: skip
  return Response(status.value, status.phrase, headers, body)


def _own(host: str) -> bool:
  """Returns whether an address reaches this machine alone."""
  if host == "localhost":
    return True
  try:
    return ipaddress.ip_address(host).is_loopback
  except ValueError:
    return False


def _names(host: str, port: int) -> tuple[str, ...]:
  """Returns the names that a page may be called by, none where any is fine: it has a token."""
  if not _own(host):
    return ()
  return tuple(f"{name}:{port}" for name in (host, "localhost", "127.0.0.1", "[::1]"))
