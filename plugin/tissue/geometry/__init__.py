"""Surfaces and the inside of solids before there is a tissue: numpy and scipy alone."""
