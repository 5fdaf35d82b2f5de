"""What a batch on a GPU cannot do is refused by name, before anything is compiled for it."""

import copy
import pickle
import subprocess
import sys

import mujoco
import numpy as np
import palpate
import palpate.batch
import pytest
import warp as wp
from devices import needs_cuda
from scenes import load, press, probed

DEVICE = "warp-cpu"  # what mujoco_warp gets is the same


def make(made, **options):
  spec = made if isinstance(made, mujoco.MjSpec) else mujoco.MjSpec.from_string(made)
  return palpate.batch.make(spec, 2, device=DEVICE, **options)


def test_a_compiled_model():
  with pytest.raises(ValueError, match=r"expected the mujoco\.MjSpec"):
    palpate.batch.make(load(press())[0], 2, device=DEVICE)


def test_a_tool_that_it_does_not_know():
  spec = mujoco.MjSpec.from_string(press())
  spec.add_hfield(name="hills", nrow=2, ncol=2, size=[1, 1, 1, 1], userdata=[0, 0, 0, 0])
  spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="hills", pos=[0, 0, -3])
  with pytest.raises(ValueError, match="of type hfield; a batch on a GPU knows sphere, ellipsoid"):
    make(spec)


@pytest.mark.parametrize(
  "extra",
  [
    '<sensor><framepos objtype="body" objname="organ_3"/></sensor>',
    '<equality><weld body1="organ_3" body2="ball"/></equality>',
  ],
)
def test_what_hangs_on_an_organs_nodes(extra):
  with pytest.raises(ValueError, match="without the organs' nodes"):
    make(press(subdivisions=1).replace("</mujoco>", extra + "</mujoco>"))


def test_a_thread_with_another_solver():
  spec = mujoco.MjSpec()
  palpate.add_thread(spec, np.linspace((0, 0, 0), (0.02, 0, 0), 9), "t")
  spec.option.solver = mujoco.mjtSolver.mjSOL_CG
  with pytest.raises(ValueError, match="thread 't': solver is CG, expected Newton in a batch"):
    make(spec)


def test_tissues_of_worlds_without_a_gpu_to_step_them():
  batch = palpate.batch.make(mujoco.MjSpec.from_string(probed()), 2)
  tissue = batch.organ("organ")
  with pytest.raises(ValueError, match="'mass' cannot change while running"):
    tissue.configure(mass=0.2)
  with pytest.raises(ValueError, match="geom 'tip': friction is -1"):
    batch.configure(friction={"tip": -1})
  with pytest.raises(ValueError, match=r"gravity|broadcast"):
    batch.configure(gravity=[0, 0])


def test_options():
  with pytest.raises(ValueError, match=r"nodes is 2, expected \[4, 48\]"):
    make(press(), nodes=2)
  with pytest.raises(ValueError, match="integrator is implicit,"):
    make(press(integrator="implicit"))
  with pytest.raises(ValueError, match="nthread is 0"):
    palpate.batch.make(mujoco.MjSpec.from_string(probed()), 2, nthread=0)


@pytest.mark.skipif(wp.is_cuda_available(), reason="has CUDA")
def test_a_device_that_is_not_there():
  with pytest.raises(ValueError, match="no CUDA device"):
    palpate.batch.make(mujoco.MjSpec.from_string(press()), 2, device="cuda:0")


@needs_cuda
def test_more_worlds_than_memory():
  with pytest.raises(ValueError, match=r"expected at most \d+"):
    palpate.batch.make(mujoco.MjSpec.from_string(press()), 10**8, device="cuda:0")


@pytest.mark.skipif(not wp.get_cuda_supported_archs(), reason="this Warp knows no CUDA")
def test_a_whole_step_in_a_block_compiles_for_cuda(tmp_path, scenes):
  from palpate.tissue import device, step

  _, _, body = scenes.kernels(*scenes.sphere(1))
  kinds = {"bends": True, "springs": True, "volumes": True}
  body.plan = device.Plan(own=2, threads=160, per_sm=2, nbytes=0, whole=True, **kinds)
  (kernel,) = step.kernels(body)
  wp.compile_aot_module(kernel.cuda.module, arch=90, module_dir=str(tmp_path), use_ptx=True)
  assert any(tmp_path.iterdir())


@pytest.fixture(params=["cpu", DEVICE, pytest.param("cuda:0", marks=needs_cuda)])
def batch(request):
  return palpate.batch.make(mujoco.MjSpec.from_string(probed()), 2, device=request.param)


@pytest.mark.parametrize(
  ("do", "message"),
  [
    (lambda b: b.configure(gravity=[0, 0, np.nan]), "gravity has numbers that are not finite"),
    (lambda b: b.configure(gravity=[0, 0]), r"gravity has shape \(2,\), expected \(2, 3\)"),
    (lambda b: b.configure(friction={"tap": 1}), "no geom 'tap' in the model. Valid names: .*tip"),
    (lambda b: b.organ("organ").configure(iterations=1.5), "iterations is '1.5', expected a whole"),
    (lambda b: b.place("bed", np.zeros((2, 3)), np.zeros((2, 4))), "quat is zero, expected orient"),
    (lambda b: b.pose(["nope"], np.zeros((2, 1))), "no joint 'nope' in the model"),
  ],
)
def test_numbers_and_names_that_cannot_be(do, message):
  spec = mujoco.MjSpec.from_string(probed())
  spec.worldbody.add_body(name="bed")
  for device in ("cpu", DEVICE):
    with pytest.raises(ValueError, match=message):
      do(palpate.batch.make(spec, 2, device=device))


def test_a_state_that_is_not_finite_or_of_another_organ(batch):
  data = mujoco.MjData(batch.model)
  batch.get_state(0, data)
  batch.set_state(1, data)
  spec = mujoco.MjSpec.from_string(probed())
  spec.flexes[0].vert = 1.1 * np.asarray(spec.flexes[0].vert)  # larger, of as many vertices
  other = spec.compile()
  strange = mujoco.MjData(other)
  mujoco.mj_step(other, strange, 3)
  for take in (batch.start, lambda data: batch.set_state(0, data)):
    with pytest.raises(ValueError, match="organ 'organ': data's plugin_state is not one of this"):
      take(strange)
    for name in ("qpos", "plugin_state"):
      wrong = mujoco.MjData(batch.model)
      getattr(wrong, name)[0] = np.nan
      with pytest.raises(ValueError, match=f"data.{name} has numbers that are not finite"):
        take(wrong)
  batch.step(2)
  assert not batch.failures.numpy().any()


def test_more_worlds_than_there_is_memory_for():
  for device in ("cpu", DEVICE):
    with pytest.raises(ValueError, match=r"nworld is 1000000000, .* free; expected at most \d+"):
      palpate.batch.make(mujoco.MjSpec.from_string(probed()), 10**9, device=device)


def test_a_batch_is_neither_pickled_nor_copied_nor_taken_into_a_fork(batch):
  for take in (pickle.dumps, copy.deepcopy):
    with pytest.raises(TypeError, match="a batch cannot be pickled or copied"):
      take(batch)


def test_a_forked_process_is_told_to_make_its_own():
  code = """
import os, sys, mujoco, palpate.batch
b = palpate.batch.make(mujoco.MjSpec.from_string(sys.argv[1]), 2)
b.step()
pid = os.fork()
if not pid:
  try:
    b.step()
  except RuntimeError as error:
    print(error, flush=True)
  os._exit(0)
os.waitpid(pid, 0)
"""
  told = subprocess.run([sys.executable, "-c", code, probed()], capture_output=True, timeout=120)
  assert b"does not work in a process that was forked" in told.stdout
