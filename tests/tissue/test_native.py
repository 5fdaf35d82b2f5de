"""The native headers compile for CUDA, on machines without a GPU too."""

import pytest
import warp as wp
from palpate.engine import nodal
from palpate.engine.windows import nodes, proxies
from palpate.tissue import kernels, step

# Kernels are declared where they are used; these modules declare all of them.
DECLARING = (step, nodal, nodes, proxies)


@pytest.mark.skipif(not wp.get_cuda_supported_archs(), reason="this Warp knows no CUDA")
@pytest.mark.parametrize("module", kernels.MODULES["cuda"])
def test_header_compiles_for_cuda(module, tmp_path):
  wp.compile_aot_module(module, arch=90, module_dir=str(tmp_path), use_ptx=True)
  assert list(tmp_path.glob("*.ptx"))
