"""Forces of a pressed block: theory, another library's finite elements, and ours."""

import numpy as np
import pytest
from benchmarks.accuracy import truth


def test_hertz_and_the_other_finite_elements_agree():
  pytest.importorskip("skfem")
  from reference import elements

  width = np.sqrt(truth.SIZE[0] * truth.SIZE[1] / np.pi)
  fine = elements.layer(
    truth.SIZE[2], width, truth.RADIUS, truth.DEPTHS, truth.YOUNG, truth.POISSON, 5e-4
  )
  theory = [truth.hertz(truth.RADIUS, depth, truth.SIZE[2]) for depth in truth.DEPTHS]
  np.testing.assert_allclose(fine, theory, rtol=0.02)


def pressed(edges, depths):
  """Returns ours over Hertz with the correction for the layer."""
  from palpate.app.fit.indentation import Test

  edge = np.sqrt(truth.RADIUS * depths[-1]) / edges
  ours, _ = truth.held(Test("sphere", truth.RADIUS, truth.SIZE, edge=edge, step=0.002), depths)
  return ours / [truth.hertz(truth.RADIUS, depth, truth.SIZE[2]) for depth in depths]


def test_a_block_is_pressed_with_the_force_of_hertz_where_the_contact_is_an_edge_wide():
  np.testing.assert_allclose(pressed(1.4, truth.DEPTHS[1:]), 1, atol=0.05)


@pytest.mark.slow
def test_a_block_is_pressed_with_the_force_of_hertz():
  np.testing.assert_allclose(pressed(4.5, truth.DEPTHS[1:]), 1, atol=0.03)
