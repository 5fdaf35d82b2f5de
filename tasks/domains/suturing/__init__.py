"""Exercises with needles and threads, and the scenes they play in."""
