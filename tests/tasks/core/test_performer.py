"""Experts solve every task; novices differ from them; no observation is constant on the way."""

import sys
import types

import numpy as np
import pytest
from palpate import tasks
from palpate.models import trocar
from palpate.tasks import suite
from palpate.tasks.core import base, episode, performer

EASY = ["/".join(pair) for pair in tasks.EASY]
OTHERS = ["/".join(pair) for pair in tasks.ALL_TASKS if pair not in tasks.EASY]
# Least norms that an expert's observations never reach [N, -]; a hook divides without touching.
BELOW = {"shaft_force": 0.05, "hook_shaft_force": 0.05, "burnt": 0.1}
UNTOUCHED = {"hook_contact_force", "hook_peak_force"}
# Searches, strokes, lines, rings and seams of 15 s and more are slow; most easy ones are not here.
LONG = {"probe/palpate_standard", "probe/palpate_hard"}
LONG |= {"needle/transfer_standard", "needle/transfer_hard"}  # the first in tests/tasks
LONG |= {f"suture/running_{level}" for level in ("easy", "standard", "hard")}
LONG |= {f"suture/extracorporeal_{level}" for level in ("standard", "hard")}
LONG |= {f"suture/{task}_{level}" for task in ("knot", "stitch") for level in ("easy", "standard")}
LONG |= {
  f"{domain}/{task}" for domain in ("bimanual", "cut", "tease") for task in ("standard", "hard")
}

# A laparoscope meets nothing, and marks without a pin have no side. An expert's needle drivers
# enter beside what they meet, a ring or a bite has one way, and a needle that is driven is held.
CONSTANT = {
  "navigate": {"contact_force", "peak_force", "surface", "side"},
  "needle": {"left_psm_shaft_force", "way"},
  "suture": {"holds", "way", "left_psm_shaft_force"},
}


def wins(name, seeds):
  env = tasks.load(*suite.split(name), task_kwargs={"random": 0})
  count = 0
  for seed in seeds:
    env.task.random = np.random.RandomState(seed)
    act = performer.make(env, seed=seed)
    timestep, seen, total = env.reset(), [], 0.0
    while not timestep.last():
      timestep = env.step(act(timestep))
      seen.append(timestep.observation)
      total += timestep.reward
    count += env.task.outcome == "success"
    assert total <= 1 + 1e-9
    for key in timestep.observation:
      values = np.array([observation[key] for observation in seen])
      if key in BELOW:
        worst = np.linalg.norm(values, axis=1).max()
        assert worst < BELOW[key], f"observation {key} reaches {worst}"
      elif key not in UNTOUCHED | CONSTANT.get(name.split("/")[0], set()):
        assert np.ptp(values, axis=0).max() > 0, f"observation {key} is constant"
  return count


@pytest.mark.parametrize("name", [name for name in EASY if name not in LONG])
def test_expert_solves_the_easy_tasks(name):
  assert wins(name, range(1)) == 1


# What an expert solves when easy and when hard it solves in between.
@pytest.mark.parametrize("name", [
  pytest.param(name, marks=pytest.mark.slow) if name.endswith("standard") else name
  for name in OTHERS
  if name not in LONG
])  # fmt: skip
def test_expert_solves_the_others(name):
  assert wins(name, range(1)) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["/".join(pair) for pair in tasks.ALL_TASKS])
def test_expert_solves_95_percent_of_50_seeds(name):
  assert wins(name, range(50)) >= 48


def test_novices_differ_in_the_stated_way():
  def measure(name, style):
    env = tasks.load(*suite.split(name), task_kwargs={"random": 0})
    return episode.run(env, performer.make(env, style, seed=0), 0).metrics()

  expert = measure("touch/easy", "expert")
  assert measure("touch/easy", "tremor").log_dimensionless_jerk < expert.log_dimensionless_jerk
  assert measure("touch/easy", "delay").time > expert.time + 0.5
  assert measure("touch/easy", "detour").path_length > 1.1 * expert.path_length
  assert measure("touch/easy", "overshoot").path_length > 1.1 * expert.path_length
  assert (
    measure("probe/easy", "force").peak_force > 1.3 * measure("probe/easy", "expert").peak_force
  )


def test_a_late_reaction_moves_later():
  env = tasks.load("touch", "easy", task_kwargs={"random": 0})

  def begin(style):
    env.task.random = np.random.RandomState(0)
    act, timestep, actions = performer.make(env, style), env.reset(), []
    for _ in range(15):
      actions.append(act(timestep))
      timestep = env.step(actions[-1])
    return np.array(actions)

  prompt, late = begin(performer.Style()), begin(performer.Style(reaction=0.1))
  assert np.abs(late[:5]).max() < 1e-9 < np.abs(prompt[0]).max()
  np.testing.assert_allclose(late[5:], prompt[:10], atol=0.02)


@pytest.mark.parametrize("name", ["probe/standard", "grasp/standard"])
def test_the_tip_is_where_the_moved_trocar_says(name):
  env = tasks.load(*suite.split(name), task_kwargs={"random": 3})
  for _ in range(2):
    env.reset()
    physics = env.physics
    told = trocar.forward(physics.trocar(), physics.joints()[[0, 1, 3]])
    np.testing.assert_allclose(physics.tip_pos(), told, atol=1e-6)


def test_skilled_people_are_many_and_come_again():
  styles = [performer.skilled(seed) for seed in range(50)]
  assert len(set(styles)) == 50 and styles[3] == performer.skilled(3)
  for name, (low, high) in performer.SKILLED.items():
    values = [getattr(style, name) for style in styles]
    assert low <= min(values) < max(values) <= high
    assert np.ptp(values) > 0.8 * (high - low)
  assert performer.find("skilled") is performer.skilled
  novices = [performer.novice(seed) for seed in range(20)]
  for name, (low, high) in performer.SKILLED.items():
    end = low if name == "speed" else high  # novices begin where skilled people end
    worse = [getattr(novice, name) <= end for novice in novices]
    assert all(worse) if name == "speed" else not any(worse)


def test_a_task_without_an_expert_says_so():
  env = tasks.load("touch", "easy")
  env.task.expert = types.MethodType(base.Task.expert, env.task)
  act = performer.make(env)
  with pytest.raises(ValueError, match="touch/easy: no expert is written for it"):
    act(env.reset())


def test_unknown_performer_lists_the_choices():
  env = tasks.load("touch", "easy")
  with pytest.raises(ValueError, match="performer is 'exprt', expected one of expert, tremor"):
    performer.make(env, "exprt")


def test_policies_are_found_by_name(tmp_path, monkeypatch):
  (tmp_path / "mine.py").write_text(
    "import numpy as np\nclass P:\n  def __init__(self, env, seed): self.env = env\n"
    "  def __call__(self, timestep): return np.zeros(4)\n"
    "def still(observation): return np.zeros(4)\nnumber = 3\n"
    "class Lost:\n  def __init__(self, env, seed): raise OSError('no weights')\n"
  )
  monkeypatch.chdir(tmp_path)
  monkeypatch.setattr(sys, "path", sys.path.copy())
  env = tasks.load("touch", "easy")
  timestep = env.reset()
  for spec in ("mine:P", "mine:still"):
    assert performer.make(env, spec)(timestep).shape == (4,)
  for spec, text in (
    ("mine", "performer is .mine., expected one of expert"),
    (":mine", "expected module:object"),
    ("mine:nothing", "mine has no 'nothing'"),
    ("mine:number", "is a int, expected something to call"),
    ("nowhere:x", "ModuleNotFoundError"),
  ):
    with pytest.raises(ValueError, match=text):
      performer.find(spec)
  (tmp_path / "leaves.py").write_text("raise SystemExit('no GPU')")
  with pytest.raises(ValueError, match="policy 'leaves:x': SystemExit: no GPU"):
    performer.find("leaves:x")
  with pytest.raises(ValueError, match="policy 'mine:Lost': OSError: no weights"):
    performer.make(env, "mine:Lost")
