"""What cuts and tears organs in all worlds."""
