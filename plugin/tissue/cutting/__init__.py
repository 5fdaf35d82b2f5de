"""Cuts: a path becomes edges or faces of a mesh, and the mesh comes apart there."""
