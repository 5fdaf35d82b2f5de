"""What acts on an organ beside its tissue, in one world of the plugin and in rows of worlds."""
