"""Contacts of organs with tools beside mujoco_warp."""
