"""What a batch on a GPU cannot do is refused by name, before anything is compiled for it."""

import mujoco
import palpate.batch
import pytest
import warp as wp
from scenes import RADIUS, load, needs_cuda, organ, press, probed, sphere, world

DEVICE = "warp-cpu"  # what mujoco_warp gets is the same


def make(made, **options):
  spec = made if isinstance(made, mujoco.MjSpec) else mujoco.MjSpec.from_string(made)
  return palpate.batch.make(spec, 2, device=DEVICE, **options)


def with_tool(kind: str, size: list[float]):
  spec = mujoco.MjSpec.from_string(press())
  spec.geoms[0].type = getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")
  spec.geoms[0].size = size
  return spec


def test_a_compiled_model():
  with pytest.raises(ValueError, match=r"expected the mujoco\.MjSpec"):
    palpate.batch.make(load(press())[0], 2, device=DEVICE)


def test_a_tool_that_it_does_not_know():
  with pytest.raises(ValueError, match="a cylinder; a batch on a GPU knows sphere, capsule"):
    make(with_tool("CYLINDER", [0.005, 0.005, 0]))


def test_a_solid():
  made = probed(keys={"elements": "solid", "young": 3e3, "foundation": None})
  with pytest.raises(ValueError, match="elements is 'solid', which a batch on a GPU cannot do"):
    make(made)


def test_what_does_not_move():
  made = world(organ(*sphere(1)), f'<geom type="plane" size="1 1 1" pos="0 0 {-2 * RADIUS}"/>')
  with pytest.raises(ValueError, match="which does not move"):
    make(made)


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
def test_the_kernels_compile_for_cuda(tmp_path):
  from palpate.batch import patch

  wp.compile_aot_module(patch.enter.cuda.module, arch=90, module_dir=str(tmp_path), use_ptx=True)
  assert any(tmp_path.iterdir())
