"""A wound in an organ that ships: it is cut while it runs, sewn up, and pulled at."""

import importlib.util
import pathlib

import numpy as np
import pytest

FILE = pathlib.Path(__file__).parents[2] / "docs" / "close_wound.py"


@pytest.fixture(scope="module")
def script():
  spec = importlib.util.spec_from_file_location("close_wound", FILE)
  assert spec and spec.loader
  module = importlib.util.module_from_spec(spec)
  spec.loader.exec_module(module)
  return module


@pytest.mark.slow
def test_stitches_close_a_cut_of_a_gallbladder_and_hold_twice_the_pull(script):
  """Each is driven through both lips; without them twice the pull opens the cut by 4 mm.

  No hand holds it then: the needle is cut off, and the thread ends in a clip that lies on the wall.
  """
  sewn, bare = script.Surgery(), script.Surgery()
  sewn.stay(script.OPEN)
  sewn.wait(300)
  assert sewn.gaps.max() > 1.5e-3
  sewn.take_needle()
  for stitch in range(script.STITCHES):
    assert sewn.gaps.min() > -5e-5
    before = len(sewn.organ.pinholes)
    sewn.drive(stitch)
    sides = [(hole.rest - sewn.middle) @ sewn.frame[:, 1] for hole in sewn.organ.pinholes[before:]]
    assert len(sides) == 2
    assert min(sides) < -2e-3
    assert max(sides) > 2e-3
    assert all(hole.thread for hole in sewn.organ.pinholes)
    sewn.pull()
  sewn.clip()
  sewn.wait(500)
  assert sewn.gaps.max() < 5e-4
  for each in (sewn, bare):
    each.stay(script.MORE)
    each.wait(300)
    assert each.organ.error is None
  assert bare.gaps.max() > 3.5e-3
  assert sewn.gaps.max() < 1e-3
  bare.stay(-script.OPEN)  # pushed together, lips that did not touch overlapped by 3 mm
  bare.wait(400)
  assert -3e-4 < bare.gaps.min() < 0.0
  assert not np.any([hole.torn for hole in sewn.organ.pinholes])
  # The last stitch pulls at the clip alone, and that at the wall.
  last = int(-sewn.organ.pinholes[-1].along / script.EDGE)
  assert sewn.thread.tension[last] > 0.1
  assert sewn.thread.tension[: last - 8].max() < 1e-3
  assert np.linalg.norm(sewn.data.body("clip").xpos - sewn.organ.pinholes[-1].at) < 4e-3
