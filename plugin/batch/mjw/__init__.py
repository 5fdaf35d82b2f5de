"""What batches take of mujoco_warp: arrays, private modules, kernels compiled ahead."""
