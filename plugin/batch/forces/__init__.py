"""What acts on an organ beside its tissue, in all worlds."""
