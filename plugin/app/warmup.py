"""`palpate warmup`: compiles and loads everything ahead, so that no first run has to wait."""

import argparse
import os
import time
from concurrent.futures import ThreadPoolExecutor

from palpate import register

from .console import CommandError, Progress, table


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.add_argument("--device", help="compile for this device only: cpu, cuda:0, ... (all)")


def main(args: argparse.Namespace) -> int:
  """Loads every module with kernels on every device, some at once; prints what each took."""
  register()
  import palpate.batch  # noqa: F401 - declares the kernels of many worlds
  import warp as wp
  from palpate.tissue import device as devices
  from palpate.tissue import kernels

  devices.init()
  known = [device.alias for device in wp.get_devices()]
  if args.device and args.device not in known:
    raise CommandError(f"no device {args.device!r}, expected one of {', '.join(known)}")
  jobs = [
    (device, module)
    for device in ([args.device] if args.device else known)
    for module in kernels.longest_first("cpu" if device == "cpu" else "cuda")
  ]

  def load(job: tuple[str, str]) -> float:
    start = time.perf_counter()
    wp.load_module(job[1], device=job[0])
    return time.perf_counter() - start

  progress, rows, start = Progress(), [], time.perf_counter()
  with ThreadPoolExecutor(os.cpu_count()) as pool:
    for (device, module), seconds in zip(jobs, pool.map(load, jobs), strict=True):
      progress.show(f"{module.rpartition('.')[2]} on {device}", always=True)
      rows.append((f"{device}  {module}", f"{seconds:.2f} s"))
  progress.clear()
  print(table([*rows, ("all", f"{time.perf_counter() - start:.2f} s")]))
  return 0
