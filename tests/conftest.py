"""What all tests share."""

import ctypes.util
import os
import sys

import pytest

# Draw without a screen. MuJoCo reads the variable once, when it is imported.
if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
  for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
    if ctypes.util.find_library(library):
      os.environ.setdefault("MUJOCO_GL", backend)

import scenes as builders


def pytest_collection_modifyitems(config, items):
  """Leaves out the long forms unless `-m` speaks of them."""
  if "slow" in config.getoption("-m"):
    return
  for item in items:
    if item.get_closest_marker("slow"):
      item.add_marker(pytest.mark.skip(reason="long form: run with -m slow"))


@pytest.fixture(scope="session")
def scenes():
  return builders


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=builders.needs_cuda)])
def device(request) -> str:
  return request.param
