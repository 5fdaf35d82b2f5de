"""C++ of the kernels, one text for the CPU and CUDA; `palpate.tissue.kernels` binds it."""
