"""Recording an episode and replaying it to the bit."""

import dataclasses
import sys

import numpy as np
import pytest
from palpate import tasks
from palpate.tasks.core import episode, performer
from palpate.tasks.recording import Recording
from recordings import LINE, plain


def record(name="touch/easy", seed=0, style="expert", **kwargs):
  env = tasks.load(*name.split("/"), task_kwargs={"random": 5})
  return episode.run(env, performer.make(env, style, seed), seed, {"task_kwargs": {}}, **kwargs)


@pytest.mark.parametrize("name", ["touch/easy", "grasp/easy", "trace/easy"])
def test_replay_gives_everything_again_to_the_bit(name, tmp_path):
  first = record(name, states=name == "touch/easy")
  again = episode.replay(Recording.load(first.save(tmp_path / "a.npz")))
  assert episode.differences(first, again) == []
  assert again.info["outcome"] == first.info["outcome"] == "success"
  assert again.metrics() == first.metrics()


def test_a_changed_action_is_noticed():
  first = record()
  actions = first.arrays["action"].copy()
  actions[4, 0] += 1e-3
  first.arrays["action"] = actions
  again = episode.replay(first)
  assert "constant state_last" in episode.differences(first, again)


def test_what_was_recorded_before_an_error_is_kept(tmp_path):
  env = tasks.load("touch", "easy")
  good = iter([np.zeros(4)] * 3)
  with pytest.raises(
    episode.EpisodeError, match=r"touch/easy: step 3: ValueError: .*roll is nan"
  ) as e:
    episode.run(env, lambda _: next(good, np.array([0, 0, np.nan, 0])), 0)
  assert len(e.value.recording.time) == 1 + 3
  assert Recording.load(e.value.recording.save(tmp_path / "a.npz")).info["outcome"] == "error"

  def broken(_):
    raise RuntimeError("no idea")

  with pytest.raises(episode.EpisodeError, match="step 0: RuntimeError: no idea"):
    episode.run(env, broken, 0)


def test_a_policy_that_leaves_ends_its_episode():
  def leave(_):
    sys.exit("no GPU")

  with pytest.raises(episode.EpisodeError, match="touch/easy: step 0: SystemExit: no GPU"):
    episode.run(tasks.load("touch", "easy"), leave, 0)


def test_metrics_of_an_expert_are_known():
  metrics = record("trace/easy").metrics()
  for name in (
    "path_length",
    "peak_force",
    "trace_rms",
    "trace_frechet",
    "peak_pressure",
    "errors",
  ):
    assert np.isfinite(getattr(metrics, name)), (name, metrics.reasons())
  assert metrics.trace_rms < 0.005
  assert np.isfinite(record("grasp/easy").metrics().grasp_slips)


@pytest.mark.parametrize(
  ("entry", "said"),
  [
    ({"task": 3}, "'task' is 3: the recording is not one of an exercise"),
    ({"seed": "x"}, "'seed' is 'x'"),
    ({"task_kwargs": None}, "'task_kwargs' is None"),
    ({"task_kwargs": {"bogus": 1}}, "bogus"),
    ({"task": "touch/eazy"}, "task is 'touch/eazy', expected one of"),
  ],
)
def test_a_recording_that_cannot_be_replayed_says_why(entry, said):
  good = {"task": "touch/easy", "seed": 0, "task_kwargs": {}}
  recording = plain(LINE).recording()
  actions = {"action": np.zeros((len(LINE), 4))}
  odd = dataclasses.replace(recording, info=good | entry, arrays=actions)
  with pytest.raises(ValueError, match=said):
    episode.environment(odd)
