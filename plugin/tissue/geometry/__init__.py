"""Surfaces and the inside of solids before there is a tissue: no kernels."""
