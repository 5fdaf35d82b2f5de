"""`palpate warmup`: compiles and loads everything ahead, so that no first run has to wait."""

from __future__ import annotations

import argparse
import time

from palpate import register

from .console import CommandError, Progress, table


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.add_argument("--device", help="compile for this device only: cpu, cuda:0, ... (all)")


def main(args: argparse.Namespace) -> int:
  """Loads every module with kernels on every device; prints the seconds each took."""
  register()
  import warp as wp
  from palpate.tissue import device as devices
  from palpate.tissue import kernels

  devices.init()
  known = [device.alias for device in wp.get_devices()]
  if args.device and args.device not in known:
    raise CommandError(f"no device {args.device!r}, expected one of {', '.join(known)}")
  progress, rows, total = Progress(), [], 0.0
  for device in [args.device] if args.device else known:
    for module in kernels.MODULES["cpu" if device == "cpu" else "cuda"]:
      progress.show(f"{module.rpartition('.')[2]} on {device}", always=True)
      start = time.perf_counter()
      wp.load_module(module, device=device)
      rows.append((f"{device}  {module}", f"{time.perf_counter() - start:.2f} s"))
      total += time.perf_counter() - start
  progress.clear()
  print(table([*rows, ("all", f"{total:.2f} s")]))
  return 0
