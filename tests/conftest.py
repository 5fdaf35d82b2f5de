"""What all tests share."""

import subprocess
import sys

import palpate  # noqa: F401 - it chooses how to draw
import pytest
import scenes as builders
from devices import needs_cuda


def pytest_addoption(parser):
  parser.addoption("--seed", type=int, help="of the one fuzz case to run")


def pytest_sessionstart(session):
  """Compiles the kernels once, where each of several processes would."""
  config = session.config
  if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
    words = [sys.executable, "-m", "palpate", "warmup", "--device", "cpu"]
    subprocess.run(words, stdout=subprocess.DEVNULL)


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


@pytest.fixture(scope="session")
def can_render():
  """Skips where nothing can draw."""
  import mujoco

  try:
    mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
  except Exception as error:
    pytest.skip(f"no OpenGL here: {error}")


@pytest.fixture
def here(tmp_path, monkeypatch):
  """Works in an empty folder; it and the path of modules are as they were afterwards."""
  monkeypatch.chdir(tmp_path)
  monkeypatch.setattr(sys, "path", sys.path.copy())


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=needs_cuda)])
def device(request) -> str:
  return request.param
