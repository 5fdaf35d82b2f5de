"""Batches: many worlds of one scene, stepped together on a GPU or on the threads of the CPU.

    batch = palpate.batch.make(spec, nworld=4096, device="cuda:0")
    batch.ctrl = actions  # (nworld, nu)
    batch.step(10)
    batch.reset(done)  # (nworld,) of bool
    force = batch.organ("liver").contact_force  # (nworld, nvert, 3), on the device

The same code runs with `device="cpu"`.
"""

from collections.abc import Sequence

import mujoco
from palpate.tissue.reading import count_of

from .base import Batch, Contacts, Tissue
from .multi_device import Several
from .threads import Threads
from .worlds import Worlds

__all__ = ["Batch", "Contacts", "Tissue", "make"]


def make(
  scene: mujoco.MjSpec | mujoco.MjModel,
  nworld: int,
  device: str | Sequence[str] = "cpu",
  *,
  nodes: int | dict[str, int] | None = None,
  deterministic: bool = False,
  nthread: int | None = None,
) -> Batch:
  """Returns `nworld` worlds of a scene at rest.

  Args:
    scene: the scene, with organs declared as ever; a GPU needs the `mujoco.MjSpec`, which stays as
      it is
    nworld: number of worlds
    device: `cpu`, where the plugin steps copies of the model on threads; `cuda:N`, where
      mujoco_warp steps tools and contacts, and the organs' kernels all worlds in one launch;
      `warp-cpu`, the same kernels without a GPU, to test and slow; or several of these, which share
      the worlds
    nodes: on a GPU, the most nodes of an organ that tools touch at once, and their neighbours: a
      number, or one by the organ's name; None for what the tools' sizes ask for
    deterministic: on a GPU, whether runs repeat to the bit whatever it does, at a cost; on the CPU
      they do
    nthread: on the CPU, threads; None for as many as the machine has cores

  Raises:
    ValueError: an argument is not allowed, the machine has no such device or no room for so many
      worlds, or the scene has what a batch cannot do; the message names it.
  """
  nworld = count_of("nworld", nworld)
  if not isinstance(scene, mujoco.MjSpec | mujoco.MjModel):
    kind = type(scene).__name__
    raise ValueError(f"scene is a {kind}, expected a mujoco.MjSpec or mujoco.MjModel")
  if not isinstance(device, str | Sequence):
    raise ValueError(f"device is {device!r}, expected a name such as 'cpu', or several")
  if device == "cpu":
    return Threads(scene, nworld, nthread)
  if not isinstance(scene, mujoco.MjSpec):
    raise ValueError(
      f"scene is a compiled model, which cannot be taken apart for device {device!r}; expected "
      "the mujoco.MjSpec"
    )
  if not isinstance(device, str):
    return Several(scene, nworld, list(device), nodes, deterministic)
  return Worlds(scene, nworld, device, nodes, deterministic)
