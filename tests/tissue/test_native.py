"""The native headers compile for CUDA, on machines without a GPU too."""

import pytest
import warp as wp
from palpate.engine import nodal
from palpate.engine.windows import nodes, proxies
from palpate.tissue import kernels, step

# Kernels are declared where they are used; these modules declare all of them.
DECLARING = (step, nodal, nodes, proxies)
# What runs on the CPU alone: threads outside of batches, cuts, rows that they change, and forces
# that have a text for many worlds.
HOST = ("coupling.mujoco_rod", "cutting.cut", "cutting.solid.solid_cut", "tissue.rows")


def runs_on_cuda(name):
  return name.removeprefix("palpate.cuda.") not in HOST and f"{name}.worlds" not in MODULES


MODULES = kernels.MODULES["cuda"]
PARAMS = [n if runs_on_cuda(n) else pytest.param(n, marks=pytest.mark.slow) for n in MODULES]


@pytest.mark.skipif(not wp.get_cuda_supported_archs(), reason="this Warp knows no CUDA")
@pytest.mark.parametrize("module", PARAMS)
def test_header_compiles_for_cuda(module, tmp_path):
  wp.compile_aot_module(module, arch=90, module_dir=str(tmp_path), use_ptx=True)
  assert list(tmp_path.glob("*.ptx"))
