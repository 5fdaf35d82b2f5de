"""What acts on an organ beside its tissue: ties, bonds, supports, relaxation."""
