"""What who palpates remembers of what was felt."""

import numpy as np
import pytest
from palpate import tasks
from palpate.tasks import lessons
from palpate.tasks.feeling import Notes

GRID = np.array([(0.008 * x, 0.008 * y, 0.0) for x in range(-3, 4) for y in range(-3, 4)])
UP = np.array([0.0, 0.0, 1.0])


def pressed(*presses):
  """Returns notes of presses at (x, y) in steps of the grid, with a force [N], 4 mm deep."""
  notes = Notes(GRID, np.tile(UP, (len(GRID), 1)), UP)
  for x, y, force in presses:
    for depth in (0.001, 0.004, 0.002):
      notes.press(np.array([0.008 * x, 0.008 * y, -depth]), force)
    notes.press(np.array([0.0, 0.0, 0.01]), 0.0)
  return notes


def test_a_press_is_noted_where_it_was_deepest_and_what_is_beside_is_left():
  notes = pressed((0, 0, 0.4))
  assert list(notes.felt().values()) == pytest.approx([100.0])
  assert notes.summary() == pytest.approx([100, 100, 0, 0, 0, 0])
  far = np.linalg.norm(GRID[notes.left(np.zeros(3))])
  assert 0.014 <= far < 0.017  # the nearest of those that are not felt with the first
  notes.press(np.array([0.0, 0.016, -0.001]), 0.2)  # too light to tell
  assert len(notes.felt()) == 1


def test_stiffness_of_the_sides_is_told_where_it_was_felt_and_where_the_field_ends():
  notes = pressed((0, 0, 0.4), (1, 0, 0.3), (2, 2, 0.2), (-2, 0, 0.2))
  soft, top, *sides = notes.summary()
  assert (soft, top) == pytest.approx((50, 100)) and sorted(sides) == pytest.approx([0, 0, 0, 75])
  edge = pressed((3, 3, 0.4))
  assert sorted(edge.summary()[2:]) == [-1, -1, 0, 0]


def test_where_all_is_felt_nothing_is_left():
  notes = pressed(*((x, y, 0.2) for x in (-3, -1, 1, 3) for y in (-3, -1, 1, 3)))
  assert notes.left(np.zeros(3)) is None


def test_what_an_exercise_tells_of_what_was_felt_is_from_the_tip():
  env = tasks.load("probe", "palpate_easy", task_kwargs={"random": 2, "surroundings": "none"})
  timestep, act = env.reset(), lessons.Teacher(env)
  assert not timestep.observation["stiffness"].any() and not timestep.observation["stiffest"].any()
  before = seen = timestep.observation
  while not seen["stiffness"].any():
    before, timestep = seen, env.step(act(timestep))
    seen = timestep.observation
  place = before["tip_pos"] + before["unfelt"]
  np.testing.assert_allclose(seen["tip_pos"] + seen["stiffest"], place, atol=1e-9)
  assert np.linalg.norm(seen["unfelt"] - seen["stiffest"]) >= 0.014
  assert seen["stiffness"][0] == seen["stiffness"][1] > 30
