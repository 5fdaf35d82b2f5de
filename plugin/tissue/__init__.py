"""The physics of soft tissue: meshes, energies, the implicit step. Knows nothing of MuJoCo."""
