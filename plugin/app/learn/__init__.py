"""Policies: trained, evaluated, and the data that others learn from."""
