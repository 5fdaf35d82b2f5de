"""A step of worlds by one kernel is that of many."""

import dataclasses
import types

import numpy as np
import pytest
from palpate.models.meshing import grid
from palpate.tissue import device as devices
from palpate.tissue import step

KINDS = [
  {"bend": 0.0},
  {"bend": 1.0, "bulk": 1e5, "pressure": 100.0, "pin": range(5)},
  {"bend": 0.0, "elements": "spring", "stiffness": 300.0},
]


def make(scenes, device, plan, bend, pin=(), **config):
  """Returns a body in three worlds that are pushed and move."""
  points, elem = grid.octasphere(6)
  points, random = 0.05 * np.asarray(points), np.random.RandomState(0)
  config = {"young": 3e4, "foundation": 1e4, "tolerance": 1e-5, "bend": bend} | config
  config = {k: v for k, v in config.items() if k != "young" or "stiffness" not in config}
  _, settings, body = scenes.kernels(points, elem, 3, device, pin, **config)
  if plan:
    kinds = {"bends": bend > 0, "springs": "stiffness" in config, "volumes": "bulk" in config}
    nheld = int(body.shape.held_adr.numpy()[-1])
    body.plan = devices.plan(body.device, body.shape.nslice, nheld, **kinds)
    if plan == "crowded" and body.device.is_cuda:
      body.plan = dataclasses.replace(body.plan, nbytes=body.plan.nbytes // 2, whole=False)
  free = np.ones((len(points), 1))
  free[list(pin)] = 0
  sizes = {"disp": 1e-3, "vel": 0.2, "force_ext": 0.01, "dvel_warm": 1e-3}
  for name, size in sizes.items():
    moved = size * random.randn(3, len(points), 3) * (1 if name == "force_ext" else free)
    scenes.put(body, getattr(body.state, name), moved.astype(np.float32))
  mass = np.full((3, len(points)), 0.1 / len(points), np.float32)
  scenes.put(body, body.state.mass, mass)
  h = 1e-3
  row = np.array([h, h * h + h * settings.damping, 1e-12, 0], np.float32)
  body.state.step.assign(np.tile(row, (3, 1)))
  return body


def stepped(scenes, body):
  """Returns the change of velocity of a step, the answer to a push, and iterations."""
  step.step(body, "implicit")
  change = scenes.get(body, body.state.dvel)
  iterations = body.system.status.numpy()[:, 0].copy()
  push = np.zeros((3, body.shape.nvert, 3), np.float32)
  push[:, 0] = 1e-4
  body.system.rhs.zero_()
  scenes.put(body, body.system.rhs, push)
  step.SCHEMES["implicit"].respond(body)
  assert not body.system.status.numpy()[:, 3].any()
  return change, scenes.get(body, body.system.sol), iterations


@pytest.mark.parametrize("kind", KINDS, ids=["membrane", "shell", "springs"])
def test_one_kernel_steps_as_many_do(scenes, device, kind):
  many, answer, iterations = stepped(scenes, make(scenes, device, None, **kind))
  for plan in ("roomy", "crowded"):
    one, other, count = stepped(scenes, make(scenes, device, plan, **kind))
    np.testing.assert_allclose(one, many, atol=2e-5 * np.abs(many).max())
    np.testing.assert_allclose(other, answer, atol=1e-3 * np.abs(answer).max())
    assert np.abs(count - iterations).max() <= 1


@pytest.mark.parametrize("memory", [48, 99, 163, 227])  # of a block [KiB], from old GPUs to an H100
@pytest.mark.parametrize("nodes", [64, 250, 1000, 1600, 2048, 4000])
@pytest.mark.parametrize("bends", [False, True])
def test_what_nodes_tell_each_other_has_room_in_a_block_or_several_share_a_world(
  memory, nodes, bends
):
  device = types.SimpleNamespace(is_cuda=True, max_shared_memory_per_block=1024 * memory)
  rows = 7 * 9 * nodes  # of stiffness blocks, in floats
  plan = devices.plan(device, nodes // 8, rows, bends=bends, springs=False, volumes=False)
  told = 4 * (16 if bends else 13) * nodes
  room = 1024 * memory - 4096  # less what the kernel has of its own
  assert (plan is None) == (nodes > 2048 or told > room)
  if plan:
    assert plan.own * plan.threads >= nodes and told <= plan.nbytes <= room
    assert plan.whole == (told + 4 * rows <= room)
