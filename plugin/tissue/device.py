"""Devices: which one an organ is solved on, how many threads, and a quiet start of Warp.

Warp starts without its greeting, without a line for every module, and without a word on CUDA: a
machine without an NVIDIA driver is an ordinary place to run, but Warp's library says so on standard
error whatever the log level is. `palpate doctor` lists the devices.
"""

import ctypes
import dataclasses
import functools
import os
import sys
import tempfile

import warp as wp
from warp._src import context as warp_context

from .order import LANES

# With fewer nodes the CPU solves a step before a GPU has met its barriers (`palpate bench solver`).
_CUDA_FROM = 2000
BLOCK = 512  # threads of a block, at most
MAX_BLOCKS = 512  # of one world
SPLIT = 4  # threads of a node of a solid, which share its neighbours, where there is one world
WORDS = 2 * MAX_BLOCKS + 1  # of 128 bits that a world's threads exchange
_MOST = 512  # threads of a block that has a world to itself; with more it gets no 223 KiB
_MANY = 1024  # nodes up to which a thread has two
_FEW = 128  # nodes of which a thread has one
_STATIC = 4096  # bytes of its memory that others have [B]
_REGISTERS = 65536 // 128  # threads of a multiprocessor that have 128 registers
_DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
_NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"


def lower_log_level():
  """Lets Warp speak of warnings and errors only, unless a level other than its default was set."""
  if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING


@functools.cache
def init():
  """Initialises Warp, once a process."""
  try:
    ctypes.CDLL(_DRIVER)
  except OSError:
    _init_without_driver()
  else:
    wp.init()


def _init_without_driver():
  sys.stderr.flush()
  kept = os.dup(2)
  with tempfile.TemporaryFile() as heard:
    os.dup2(heard.fileno(), 2)
    try:
      wp.init()
    finally:
      sys.stderr.flush()
      os.dup2(kept, 2)
      os.close(kept)
      heard.seek(0)
      for line in heard.read().decode(errors="replace").splitlines():
        if _NO_DRIVER not in line:
          print(line, file=sys.stderr)


def cuda() -> list[str]:
  """Returns the names of the CUDA devices."""
  init()
  return [device.alias for device in wp.get_cuda_devices()] if wp.is_cuda_available() else []


def resolve(name: str, nvert: int) -> wp.Device:
  """Returns the Warp device that `name` asks for; `auto` is the faster one for `nvert` nodes.

  Raises:
    ValueError: there is no such device.
  """
  if name == "auto":
    name = "cuda:0" if wp.is_cuda_available() and nvert >= _CUDA_FROM else "cpu"
  if name != "cpu":
    present = cuda()
    if name not in present:
      have = ", ".join(present) or "no CUDA device"
      raise ValueError(f"device is {name!r}, but this machine has {have}; expected 'cpu' or 'auto'")
  return wp.get_device(name)


def block(device, nslice: int) -> int:
  """Returns the threads of a block for code made by `group`.

  Small blocks spread few nodes over more multiprocessors.
  """
  return BLOCK // 2 if device.is_cuda and nslice * LANES <= BLOCK // 2 * device.sm_count else BLOCK


def group_size(device, nslice: int, nworld: int, per_sm: int = 1) -> int:
  """Returns the threads of a world for code made by `group`, to launch in blocks of `block`.

  Args:
    device: where they run
    nslice: slices of nodes
    nworld: number of worlds
    per_sm: blocks on one multiprocessor that the kernel's bounds allow
  """
  if not device.is_cuda:
    return 1
  # Blocks of one world wait for each other, so all of them must be resident.
  most = max(1, min(per_sm * device.sm_count // nworld, MAX_BLOCKS))
  size = block(device, nslice)
  return size * max(1, min(most, -(-nslice * LANES // size)))


def patch(device, nslice: int, split: int = 1) -> int:
  """Returns the nodes that a block has of one world of `nslice` slices, 0 on the CPU.

  Args:
    device: where they are
    nslice: slices of nodes
    split: threads of a node
  """
  if not device.is_cuda:
    return 0
  nblock = group_size(device, split * nslice, 1) // block(device, split * nslice)
  return LANES * -(-nslice // nblock)


@dataclasses.dataclass(frozen=True)
class Plan:
  """How a block takes a world's whole step, see solver/step.h.

  Attributes:
    own: nodes of a thread, 0 on the CPU
    threads: of a block
    per_sm: blocks that a multiprocessor has at once
    nbytes: memory of a block
    whole: whether the whole matrix has room there
    bends: whether there is bending
    springs: whether elements are springs
    volumes: whether there may be volume stiffness or pressure
    tensions: whether the rest shape is under tension
    meshes: whether worlds have meshes of their own
  """

  own: int
  threads: int
  per_sm: int
  nbytes: int
  whole: bool
  bends: bool
  springs: bool
  volumes: bool
  tensions: bool = False
  meshes: bool = False


def plan(device, nslice: int, nheld: int, **kinds: bool) -> Plan | None:
  """Returns how a block takes the whole step of a world; None where that is too large for one.

  What nodes tell each other must have room in the block's memory. Rows of the matrix have what is
  left; the others stay outside. An organ that is too large is stepped by a kernel for each part of
  the step, by blocks that share a world.

  Args:
    device: where it runs
    nslice: slices of nodes
    nheld: floats of all stiffness blocks, see `order.banks`
    **kinds: what the tissue has, see `Plan`
  """
  if not device.is_cuda:
    return Plan(0, 1, 1, 0, False, **kinds)
  nodes = LANES * nslice
  own = 1 if nodes <= _FEW else 2 if nodes <= _MANY else 4
  threads = -(-nodes // (32 * own)) * 32
  room = device.max_shared_memory_per_block - _STATIC
  told = 4 * (16 if kinds["bends"] else 13) * nodes
  if threads > _MOST or told > room:
    return None
  wanted = told + 4 * nheld
  per_sm = max(1, min(3, room // (wanted + _STATIC), _REGISTERS // threads))
  return Plan(own, threads, per_sm, min(wanted, room), wanted <= room, **kinds)


def reserve(kernel: wp.Kernel, device, plan: Plan):
  """Gives the launches of a kernel that follow the memory of a plan."""
  if not device.is_cuda:
    return
  # Warp knows no other way than tiles, whose sizes are compiled in.
  module = kernel.module.load(device, plan.threads)
  assert module is not None  # else loading has raised
  hooks = module.get_kernel_hooks(kernel)
  core = warp_context.runtime.core
  if not core.wp_cuda_configure_kernel_shared_memory(hooks.forward, plan.nbytes):
    raise RuntimeError(f"{device} has no {plan.nbytes} bytes of shared memory for a block")
  hooks.forward_smem_bytes = plan.nbytes


def threads(device, nslice: int) -> int:
  """Returns the launch dimension for `nslice` slices: one thread on the CPU, one a lane on CUDA."""
  return nslice * LANES if device.is_cuda else 1


def free_memory() -> float:
  """Returns how many bytes this machine has free, infinity where it does not say."""
  try:
    return os.sysconf("SC_AVPHYS_PAGES") * float(os.sysconf("SC_PAGE_SIZE"))
  except (AttributeError, ValueError, OSError):  # not on every system
    return float("inf")


def room_of(device) -> float:
  """Returns how many bytes of a device worlds may take."""
  return 0.95 * (device.free_memory if device.is_cuda else free_memory())


def refuse_crowd(nworld: int, each: float, room: float, where: str, what: str = "nworld is"):
  """Raises ValueError where worlds of so many bytes do not fit; says how many do."""
  if nworld * each > room:
    raise ValueError(
      f"{what} {nworld}, which takes about {nworld * each / 1e9:.1f} GB, but {where} has "
      f"{room / 1e9:.1f} GB free; expected at most {int(room / each)}"
    )
