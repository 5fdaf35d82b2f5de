"""The configuration keys: what is accepted, and what an error says."""

import math

import numpy as np
import pytest
from palpate.tissue.config import KEYS, Config, lame, parse, rigidity

NELEM = 4

REFUSED = [
  ("young", "abc", "a number > 0"),
  ("young", "-1", "a number > 0"),
  ("young", "nan", "a number > 0"),
  ("young", "0", "a number > 0"),
  ("capsule_young", "0", "a number > 0"),
  ("young", "1 2", "1 or 4"),
  ("young", "1 2 nan 4", "has nan for element 2"),
  ("young", "1_0", "a number > 0"),
  ("young", "٣", "a number > 0"),
  ("newton", "1_0", "[1, 100]"),
  ("pin", "٣", "vertex numbers"),
  ("poisson", "0.5", "[0, 0.5)"),
  ("poisson", "-0.1", "[0, 0.5)"),
  ("poisson", "soft", "[0, 0.5)"),
  ("thickness", "0", "a number > 0"),
  ("thickness", "inf", "a number > 0"),
  ("stiffness", "0", "a number > 0"),
  ("stiffness", "stiff", "a number > 0"),
  ("bend", "-1", "a number >= 0"),
  ("foundation", "-1", "a number >= 0"),
  ("bulk", "nan", "a number >= 0"),
  ("tension", "-1", "a number >= 0"),
  ("twist", "-1", "a number >= 0"),
  ("strength", "-1", "a number >= 0"),
  ("yield_strain", "-0.1", "a number >= 0"),
  ("drag", "-1", "a number >= 0"),
  ("refine", "-1", "a number >= 0"),
  ("pressure", "inf", "a finite number"),
  ("damping", "-0.002", "a number >= 0"),
  ("integrator", "euler", "'implicit'"),
  ("iterations", "0", "[1, 10000]"),
  ("iterations", "2.5", "[1, 10000]"),
  ("tolerance", "0", "[1e-10, 1)"),
  ("tolerance", "1", "[1e-10, 1)"),
  ("tolerance", "1e-20", "[1e-10, 1)"),
  ("newton", "0", "[1, 100]"),
  ("newton", "two", "[1, 100]"),
  ("device", "tpu", "'cpu'"),
  ("device", "cuda:x", "'cpu'"),
  ("elements", "tetrahedron", "'membrane' or 'spring'"),
  ("tetrahedra", "inside.msh", "only with elements='solid'"),
  ("mass", "0", "> 0"),
  ("pin", "1 -2", "vertex numbers"),
  ("relax_share", "1", "[0, 1)"),
  ("relax_time", "0", "> 0"),
  ("attach", "rib 500", "a stiffness > 0 and vertices"),
  ("attach", "rib soft 3", "a stiffness > 0 and vertices"),
  ("bonds", "bed 1e7 2e3", "'near' and a distance"),
  ("bonds", "bed 1e7 2e3 2 by 0.01", "'near' and a distance"),
  ("carrier", "two words", "the name of a body"),
  ("skin", "two words", "the name of a skin"),
  ("tear", "-0.1", "a number >= 0"),
  ("cutters", "a b c 160", "a geom, or two of scissors, and an energy > 0"),
  ("needles", "needle -800", "a body, an energy > 0"),
  ("spare", "-1", "a whole number >= 0 or 'auto'"),
  ("spare", "some", "a whole number >= 0 or 'auto'"),
  ("resident", "yes", "'true' or 'false'"),
  ("subgrid", "on", "'auto' or 'true' or 'false'"),
  ("walls", "two words", "the name of a flexcomp"),
]


@pytest.mark.parametrize(("key", "value", "allowed"), REFUSED)
def test_a_bad_value_is_refused_with_organ_key_value_and_what_is_allowed(key, value, allowed):
  with pytest.raises(ValueError) as error:
    parse("liver", {key: value}, NELEM, closed=True)
  text = str(error.value)
  for part in ("'liver'", key, allowed):
    assert part in text
  assert value in text or "2 values" in text or "element" in text


def test_every_key_has_a_refused_value_in_this_file():
  in_the_model = {"window", "follow", "support"}  # names; see test_window.py and test_rests.py
  assert set(KEYS) == {key for key, _, _ in REFUSED} | in_the_model


def test_an_unknown_key_is_refused_with_the_list_of_keys():
  with pytest.raises(ValueError, match=r"'liver'.*'yuong'.*young, poisson"):
    parse("liver", {"yuong": "5000"}, NELEM, closed=True)


@pytest.mark.parametrize(
  ("texts", "closed", "words"),
  [
    ({"stiffness": "200"}, True, ("stiffness is 200", "elements='spring'")),
    ({"elements": "spring"}, True, ("elements is 'spring'", "stiffness is missing")),
    ({"bulk": "1000"}, False, ("bulk is 1000", "closed surface")),
    ({"pressure": "-5"}, False, ("pressure is -5", "closed surface")),
    (
      {"elements": "spring", "stiffness": "200", "tension": "3"},
      True,
      ("tension is 3", "elements='membrane'"),
    ),
    ({"elements": "solid", "tension": "3"}, True, ("tension is 3", "elements='membrane'")),
    ({"relax_share": "0.5", "tension": "3"}, True, ("relax_share is set", "tension is 0")),
  ],
)
def test_a_wrong_combination_is_refused(texts, closed, words):
  with pytest.raises(ValueError, match="organ 'liver'") as error:
    parse("liver", texts, NELEM, closed)
  for word in words:
    assert word in str(error.value)


def test_unset_and_empty_keys_take_the_documented_defaults():
  config = parse("liver", {"young": "", "damping": " "}, NELEM, closed=False)
  assert config == Config()
  assert (config.young, config.poisson, config.thickness) == ((5000.0,), 0.45, 0.002)
  assert (config.bend, config.damping, config.foundation) == (1.0, 0.002, 0.0)
  assert (config.iterations, config.tolerance, config.newton) == (200, 1e-4, 1)
  assert (config.elements, config.integrator, config.device) == ("membrane", "implicit", "auto")


def test_values_are_read_with_spaces_and_exponents():
  texts = {"young": " 5.4e3\n", "poisson": " 0.3", "newton": "2 ", "pressure": "-1e2"}
  config = parse("liver", texts, NELEM, closed=True)
  assert (config.young, config.poisson) == ((5400.0,), 0.3)
  assert (config.newton, config.pressure) == (2, -100.0)


def test_each_element_may_have_its_own_young():
  config = parse("liver", {"young": "1 2 3 4"}, NELEM, closed=False)
  lam, mu = lame(config, NELEM)
  np.testing.assert_allclose(mu / mu[0], [1, 2, 3, 4])
  np.testing.assert_allclose(lam / lam[0], [1, 2, 3, 4])


def test_constants_are_those_of_plane_stress_and_of_the_plate():
  config = Config(young=(5000.0,), poisson=0.3, thickness=0.002, bend=2.0)
  lam, mu = lame(config, 1)
  # Uniaxial plane stress gives back E and nu.
  np.testing.assert_allclose(4 * mu * (lam + mu) / (lam + 2 * mu), 5000)
  np.testing.assert_allclose(lam / (lam + 2 * mu), 0.3)
  assert math.isclose(rigidity(config, 1)[0], 2 * 5000 * 0.002**3 / (12 * (1 - 0.09)))


def test_a_key_that_is_misspelt_is_guessed():
  with pytest.raises(ValueError, match=r"unknown key 'yuong', .*; did you mean 'young'\?"):
    parse("organ", {"yuong": "1e4"}, 20, True)
