"""Exercises of one's own: what registers them, and what is wrong with them."""

import pathlib
import re
import subprocess
import sys

import pytest

PAGE = pathlib.Path(__file__).parents[2] / "docs" / "extending.md"
RECIPE = PAGE.read_text(encoding="utf-8").split("\n## An exercise\n")[1].split("\n## ")[0]


def package(folder, name, text):
  """Writes a module that an installed package has as an entry point."""
  about = folder / f"{name}-1.dist-info"
  about.mkdir()
  (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
  (about / "entry_points.txt").write_text(f"[palpate.tasks]\n{name} = {name}\n")
  (folder / f"{name}.py").write_text(text)


def run(folder, *lines):
  code = "\n".join(["import sys", f"sys.path.insert(0, {str(folder)!r})", *lines])
  return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)


USE = """
import gymnasium, numpy as np
SINGLE
MANY
from palpate.tasks import suite
from palpate.tasks.core import performer
assert suite.summary("hover", "easy") == "hold the tip 1 cm above a point, within 4 mm"
acts = []
for k in range(2):
  alone = gymnasium.make("palpate/HoverEasy-v0", disable_env_checker=True)
  alone.reset(seed=3 + k)
  acts.append((alone, performer.make(alone.unwrapped.environment)))

class First:
  first = lambda self: not steps

seen, _ = many.reset(seed=3)
over, steps = np.zeros(2, bool), 0
while not over.all():
  actions = np.array([act(First()) for _, act in acts])
  seen, _, ended, _, info = many.step(actions)
  for k, (alone, _) in enumerate(acts):
    if not over[k]:
      one, _, done, _, told = alone.step(actions[k])
      assert done == ended[k]
      last = info["final_obs"][k] if done else {name: seen[name][k] for name in seen}
      for name in one:
        np.testing.assert_allclose(last[name], one[name], atol=2e-3, err_msg=name)
      if done:
        assert told["outcome"] == info["final_info"]["outcome"][k] == "success"
        over[k] = True
        acts[k] = alone, lambda step: np.zeros(4)
  steps += 1
  assert steps < 400
"""


def test_the_recipe_of_an_exercise_is_short_and_makes_one_for_one_world_and_for_many(tmp_path):
  pytest.importorskip("gymnasium")
  text, use = re.findall(r"^```python\n(.*?)^```", RECIPE, re.M | re.S)
  assert len(text.splitlines()) <= 50
  single, many = use.strip().splitlines()
  package(tmp_path, "hover", text)
  done = run(tmp_path, USE.replace("SINGLE", single).replace("MANY", many))
  assert done.returncode == 0, done.stderr


MALFORMED = [
  ('"hover/easy", 10, "easy"', '"Hover", 10', "exercise is 'Hover', expected \"domain/task\""),
  ('"hover/easy", 10, "easy"', '"touch/easy", 10', "touch/easy: it is registered already, by"),
  ('10, "easy"', '"10", "easy"', "hover/easy: time_limit is '10', expected a number > 0"),
  ('10, "easy"', "-1", "hover/easy: time_limit is -1, expected a number > 0"),
  ('"easy",', '"eazy",', "hover/easy: tag is 'eazy', expected one of easy, hard, bimanual"),
  ('asks="Hold', 'says="Hold', "hover/easy: Hover has no docstring"),
  ('"held")', '"hold")', "hover.State: 'hold' is no field, expected one of control_timestep"),
  ("held: float", "held: int", "hover.State: 'held' is told and <class 'int'>, expected float"),
  ("goal: int", "goal: str", "hover.State: 'goal' is <class 'str'>, expected int, float"),
  ("def observe(s, o):", "def observe(s):", "hover.State: observe is <function observe"),
]
# Imports the tasks in a copy of the process for each folder, which is first on its path.
IMPORT = """
import os
import gymnasium, palpate.models
for folder in folders:
  if not os.fork():
    sys.path.insert(0, folder)
    sys.stderr = open(f"{folder}/said", "w")
    import palpate.tasks
    os._exit(0)
  os.wait()
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory):
  """Returns what the import of each malformed exercise says, by what is told of it."""
  text = re.search(r"^```python\n(.*?)^```", RECIPE, re.M | re.S)[1]
  folders = {}
  for old, new, message in MALFORMED:
    folders[message] = tmp_path_factory.mktemp("malformed")
    assert old in text
    package(folders[message], "hover", text.replace(old, new))
  names = [str(each) for each in folders.values()]
  done = run(tmp_path_factory.mktemp("run"), f"folders = {names}", IMPORT)
  assert done.returncode == 0, done.stderr
  return {message: (folder / "said").read_text() for message, folder in folders.items()}


@pytest.mark.parametrize("message", [message for _, _, message in MALFORMED])
def test_what_is_malformed_is_an_error_at_import_that_names_the_entry_point(said, message):
  assert message in said[message]
  assert "entry point 'hover' of palpate.tasks" in said[message]


def test_an_attribute_that_begin_forgets_is_named(tmp_path):
  text = re.search(r"^```python\n(.*?)^```", RECIPE, re.M | re.S)[1]
  package(tmp_path, "hover", text.replace("goal: int", "goal: int\n  depth: float"))
  done = run(tmp_path, "from palpate import tasks", "tasks.load('hover', 'easy')")
  assert "hover/easy: Hover has no 'depth', which is a field of its state" in done.stderr


def test_packages_are_there_with_the_package(tmp_path):
  done = run(tmp_path, "import palpate", "print(palpate.models.load, palpate.tasks.load)",
             "palpate.batch.make", "palpate.tusks")  # fmt: skip
  assert "<function load" in done.stdout
  assert "module 'palpate' has no attribute 'tusks'" in done.stderr
