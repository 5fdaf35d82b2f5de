"""Devices that a machine may lack."""

import pytest
import warp as wp

needs_cuda = pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")
