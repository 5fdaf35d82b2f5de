"""Recordings for tests."""

import numpy as np
from palpate.tasks.recorder import Recorder, Settings

SETTINGS = Settings(
  force_limit=1.5,
  grip_limit=1.5,
  reference_length=0.1,
  idle_speed=0.06,
  tip_cutoff=None,
  movement_cutoff=25.0,  # half the rate of the recordings below: nothing is cut
)
# Columns that are drawn, and up to what.
DRAWN = {"strain": 1, "traction": 1, "deviation": 1e-3, "farthest": 1e-3, "excess": 1e-5}
DRAWN |= {"jagged": 1e-2, "depth": 1e-2} | dict.fromkeys((
  "current", "idle_current", "regrasped", "ring_time", "bite", "ring_force", "gap", "tension",
  "security", "torn",
), 1)  # fmt: skip


def exercise(steps=300, instruments=("left", "right"), seed=0, journal=None):
  """Everything that can be recorded, with two instruments that move and touch."""
  rng = np.random.RandomState(seed)
  info = {"task": "touch", "seed": seed}
  recorder = Recorder(instruments, SETTINGS, watch=["drop"], info=info, journal=journal)
  recorder.attach("curve", [[0, 0, 0], [0.05, 0, 0], [0.1, 0.02, 0]])
  recorder.attach("initial_state", rng.rand(7))
  pos = np.cumsum(rng.randn(steps, len(instruments), 3) * 1e-3, 0)
  for k in range(steps):
    half = 0.3 * np.sin(k / 40)
    quat = np.array([np.cos(half), 0, np.sin(half), 0])
    force = np.maximum(0, rng.randn(len(instruments), 3))
    drawn = {name: rng.rand(len(instruments)) * size for name, size in DRAWN.items()}
    drawn["security"] *= k > 0.9 * steps  # knots are tested at the end
    recorder.append(
      k * 0.02,
      pos[k],
      quat=[quat] * len(instruments),
      force=force,
      grip_force=np.maximum(0, rng.randn(len(instruments))),
      shaft_force=np.maximum(0, rng.randn(len(instruments))),
      surroundings_force=np.maximum(0, rng.randn(len(instruments))),
      area=np.full(len(instruments), 2e-5),
      freed=np.full(len(instruments), k / steps),
      **drawn,
      grip=np.full(len(instruments), k % 100 < 60),
      held=np.full(len(instruments), 10 < k % 100 < 40),
      visible=rng.rand(len(instruments)) > 0.1,
      centred=rng.rand(len(instruments)) > 0.3,
      horizon=rng.rand(len(instruments)),
      arrays={"qpos": rng.rand(9), "action": rng.rand(5).astype(np.float32), "step": k},
    )
  recorder.event("target", 1.0, 0.002, label="first")
  recorder.event("target", 2.0, 0.004, instrument=len(instruments) - 1)
  recorder.event("drop", 2.5)
  return recorder


def plain(pos, **columns):
  recorder = Recorder(settings=SETTINGS)
  for k, point in enumerate(pos):
    recorder.append(k * 0.02, point, **{n: v[k] for n, v in columns.items()})
  return recorder


LINE = np.stack([np.linspace(0, 0.12, 61), np.zeros(61), np.zeros(61)], 1)
