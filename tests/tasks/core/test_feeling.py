"""What who palpates remembers of what was felt."""

import types

import numpy as np
import pytest
from palpate import tasks
from palpate.tasks.domains.probing import feeling
from palpate.tasks.learn import lessons

GRID = np.array([(0.008 * x, 0.008 * y, 0.0) for x in range(-3, 4) for y in range(-3, 4)])
UP = np.array([0.0, 0.0, 1.0])


def pressed(*presses):
  """Returns notes of presses at (x, y) in steps of the grid, with a force [N], 4 mm deep."""
  notes = types.SimpleNamespace(radius=0.012)
  feeling.start(notes, GRID, np.tile(UP, (len(GRID), 1)), feeling.sides(GRID, UP))
  for x, y, force in presses:
    for depth in (0.001, 0.004, 0.002):
      feeling.press(notes, np.array([0.008 * x, 0.008 * y, -depth]), force)
    feeling.press(notes, np.array([0.0, 0.0, 0.01]), 0.0)
  return notes


def test_a_press_is_noted_where_it_was_deepest_and_what_is_far_is_left():
  notes = pressed((0, 0, 0.4))
  assert list(feeling.felt(notes).values()) == pytest.approx([100.0])
  far = np.linalg.norm(GRID[notes.next])
  assert 0.014 <= far < 0.017  # the nearest of those that are not felt with the first
  feeling.press(notes, np.array([0.0, 0.016, -0.001]), 0.2)  # too light to tell
  assert len(feeling.felt(notes)) == 1
  all_of_it = [(x, y, 0.2) for x in (-3, -1, 1, 3) for y in (-3, -1, 1, 3)]
  assert pressed(*all_of_it).next >= 0  # beside the stiffest
  sides = [(x, y, 0.2) for x, y in ((-3, -2), (-2, -3))]
  notes = pressed(*all_of_it, *sides)
  assert notes.next == len(GRID) // 2  # nothing is stiff: it is not sure, and goes on in the middle
  assert not feeling.sure(notes) and notes.doubt > 0.02
  everywhere = [(x, y, 0.2) for x in range(-3, 4) for y in range(-3, 4)]
  assert pressed(*everywhere).next < 0


def test_what_is_stiff_is_felt_around_and_expected_in_the_middle():
  stiff = [(1, 0, 0.4), (-2, -2, 0.2), (-2, 2, 0.2)]
  asked = []
  for force in (0.39, 0.3, 0.35, 0.3):
    side = GRID[pressed(*stiff).next] / 0.008
    asked.append(tuple(np.round(side[:2]).astype(int)))
    stiff.append((*asked[-1], force))
  assert sorted(asked) == [(0, 0), (1, -1), (1, 1), (2, 0)]
  notes = pressed(*stiff)
  assert notes.next < 0 and feeling.sure(notes) and not feeling.sure(pressed(*stiff[:3]))
  np.testing.assert_allclose(notes.likely, (0.008, 0, 0), atol=0.003)
  lone = pressed((3, 3, 0.4), (-3, -3, 0.2))
  assert len({lone.next, *map(int, lone.beside[len(GRID) - 1])} - {-1}) == 2


def test_an_exercise_tells_where_to_feel_next_and_in_the_end_where_to_report():
  env = tasks.load("probe", "palpate_easy", task_kwargs={"random": 9, "surroundings": "none"})
  timestep, act, asked = env.reset(), lessons.Teacher(env), []
  while not timestep.last():
    seen = timestep.observation
    place = seen["tip_pos"] + seen["target"]
    if not asked or not np.allclose(place, asked[-1], atol=1e-9):
      asked.append(place)
      assert not seen["contact_force"].any() or np.linalg.norm(seen["contact_force"]) > 0.1
    timestep = env.step(act(timestep))
  assert env.task.outcome == "success" and seen["left"] == 0
  assert np.linalg.norm(asked[1] - asked[0]) > 0.007
  assert np.linalg.norm(asked[-1] - env.task.inclusion) < env.task.tolerance
