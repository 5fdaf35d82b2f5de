"""Devices for the hand."""
