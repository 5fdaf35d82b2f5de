"""Exercises of the probe: pressing, and palpation."""
