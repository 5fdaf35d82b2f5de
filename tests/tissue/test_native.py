"""The native headers compile for CUDA, on machines without a GPU too."""

import pytest
import warp as wp
from palpate.engine import nodal
from palpate.engine.windows import nodes, proxies
from palpate.tissue import kernels, step

# Kernels are declared where they are used; these modules declare all of them.
DECLARING = (step, nodal, nodes, proxies)
# Threads run on CUDA in batches alone: `world_rods`, whose step is the same text.
SLOW = {"palpate.cuda.coupling.mujoco_rod"}
MODULES = [
  pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name
  for name in kernels.MODULES["cuda"]
]


@pytest.mark.skipif(not wp.get_cuda_supported_archs(), reason="this Warp knows no CUDA")
@pytest.mark.parametrize("module", MODULES)
def test_header_compiles_for_cuda(module, tmp_path):
  wp.compile_aot_module(module, arch=90, module_dir=str(tmp_path), use_ptx=True)
  assert list(tmp_path.glob("*.ptx"))
