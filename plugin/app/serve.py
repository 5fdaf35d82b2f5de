"""`palpate serve`: a page to train on."""

import argparse
import pathlib
import threading
import webbrowser

from palpate import register

from . import console
from .console import CommandError
from .trainee import keeping

_LOOK = 0.2  # between looks at whether Ctrl-C was pressed [s]


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.epilog = (
    "Only this machine reaches the page. With another --host other machines reach it "
    "with the printed address and its token. The connection is not encrypted: use a proxy that "
    "encrypts."
  )
  add = parser.add_argument
  add("--host", default="127.0.0.1", help="address to listen on (%(default)s)")
  add("--port", type=int, default=8090, help="0 for any that is free (%(default)s)")
  add("--token", help="that a page must send; made up if other machines can reach the page")
  add(
    "--device", metavar="NAME", default="mouse",
    help="mouse for the controls of the page, or gamepad, spacemouse, udp, openhaptics, "
    "forcedimension, haply, hand (%(default)s)",
  )  # fmt: skip
  add("--pages", metavar="N", type=int, default=2, help="most pages open at a time (%(default)s)")
  add("-o", "--out", metavar="FOLDER", default="out/live", help="of recordings (%(default)s)")
  add("--scene", metavar="FILE", help="MJCF file with an organ, for free practice")
  keeping.add_arguments(parser)
  add("--open", action="store_true", help="open the page in a browser")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  register()
  from .live.devices import registry

  with console.one_line():
    registry.check(args.device)
  if not 0 <= args.port < 65536:
    raise CommandError(f"port is {args.port}, expected a whole number in [0, 65535]")
  console.check_counts(args, "pages")
  return run(
    pathlib.Path(args.out), args.host, args.port, args.token, args.device, args.pages, args.open,
    kept=keeping.read(args, pages=True), scene=_scene(args.scene),
  )  # fmt: skip


def _scene(path: str | None) -> str:
  """Returns the file of an own scene, empty for none; CommandError where it has no organ."""
  if path is None:
    return ""
  from .live.practice import own

  if not pathlib.Path(path).is_file():
    raise CommandError(f"scene is {path!r}, expected an MJCF file")
  with console.one_line():
    own(pathlib.Path(path), ())
  return str(pathlib.Path(path).resolve())


def run(
  folder: pathlib.Path,
  host: str = "127.0.0.1",
  port: int = 0,
  token: str | None = None,
  device: str = "mouse",
  pages: int = 2,
  show: bool = True,
  task: str = "",
  kept: keeping.Keeping | None = None,
  scene: str = "",
) -> int:
  """Serves until Ctrl-C and returns the exit code; arguments as the options.

  Args:
    folder: of recordings
    host: address to listen on
    port: 0 for any that is free
    token: that a page must know
    device: its name
    pages: that may be open at a time
    show: whether a browser is opened
    task: that is chosen at first
    kept: the record that recordings go to, None for the folder
    scene: MJCF file for free practice, empty for none
  """
  console.need("live", "websockets")
  from .live.page.server import Server

  folder = console.output_folder("out", folder)
  try:
    server = Server(folder, host, port, token, device, pages, kept, scene)
  except OSError as error:
    raise CommandError(f"cannot listen on {host}:{port}: {error}", code=1) from None
  url = f"{server.url}#task={task}" if task else server.url
  thread = threading.Thread(target=server.run, daemon=True)
  with console.Interrupt() as interrupt:
    thread.start()
    place = kept if kept and kept.folder else folder
    print(f"page       {url}\nrecordings {place}\nCtrl-C ends", flush=True)
    if show:
      webbrowser.open(url)
    while not interrupt.seen and thread.is_alive():
      thread.join(_LOOK)
    server.close()
  return 0
