"""Knots by name: constructed curves, as they are, shaken, and seen from anywhere."""

import numpy as np
import pytest
from palpate.tasks.metrics import knots

T = np.linspace(0, 2 * np.pi, 50, endpoint=False)


def torus(turns):
  """The torus knot T(2, 2 |turns| + 1), right-handed where turns are positive."""
  q = 2 * abs(turns) + 1
  across = 2 + np.cos(q * T)
  height = -np.sign(turns) * np.sin(q * T)
  return np.stack([across * np.cos(2 * T), across * np.sin(2 * T), height], axis=1)


def throws(*turns):
  """A closed polygon with these knots one after the other."""
  out, at = [], 0.0
  for each in turns:
    one = torus(each)
    one = one[np.r_[np.argmax(one[:, 1]) : len(one), : np.argmax(one[:, 1])]]  # opened at its top
    out.append(one + np.array([at, 0, 0]))
    at += 8.0
  top = np.array([[at, 9.0, 0], [-8.0, 9.0, 0]])
  return np.concatenate([*out, top])


@pytest.mark.parametrize(
  ("turns", "name"),
  [
    ((1,), "overhand"), ((-1,), "overhand"), ((2,), "double throw"), ((1, -1), "square"),
    ((1, 1), "granny"), ((-1, -1), "granny"), ((2, -1), "surgeon's"), ((-2, 1), "surgeon's"),
    ((2, 1), "surgeon's granny"), ((2, -1, 1), "surgeon's 2-1-1"),
  ],
)  # fmt: skip
def test_knots_have_their_names(turns, name):
  polygon = throws(*turns)
  assert sorted(knots.throws(polygon)) == sorted(turns)
  assert knots.name(polygon) == name


def test_a_circle_shaken_and_turned_is_no_knot():
  rng = np.random.RandomState(0)
  for _ in range(5):
    circle = np.stack([np.cos(T), np.sin(T), 0.5 * np.sin(3 * T)], axis=1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert knots.name(circle @ turn + rng.normal(0, 0.02, circle.shape)) == "none"


@pytest.mark.parametrize("turns", [(1, -1), (1, 1)])
def test_a_knot_is_itself_from_anywhere(turns):
  rng = np.random.RandomState(1)
  polygon = throws(*turns)
  found = knots.jones(polygon)
  for _ in range(3):
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn[:, 0] *= np.sign(np.linalg.det(turn))
    assert knots.jones((polygon + rng.normal(0, 0.05, polygon.shape)) @ turn) == found


def test_other_knots_have_no_name():
  across = 2 + np.cos(2 * T)
  eight = np.stack([across * np.cos(3 * T), across * np.sin(3 * T), np.sin(4 * T)], axis=1)
  assert knots.throws(eight) is None
  assert knots.name(eight) == "other"


def test_an_open_thread_is_closed_far_away():
  t = np.linspace(-2.1, 2.1, 100)
  open_ = np.stack([t**3 - 3 * t, t**4 - 4 * t**2, (t**5 - 10 * t) / 5], axis=1)
  assert knots.name(knots.closed(open_)) == "overhand"
  assert knots.name(knots.closed(open_[:50])) == "none"
