"""Behaviour cloning: how many demonstrations a small network needs.

`palpate export` makes episodes of an expert whose instrument is shaken, in robomimic's format.
scikit-learn fits a network to the first of them, from what is observed to what the expert meant to
do. `palpate evaluate` tells how often it succeeds in seeds that it has not seen.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import time
from collections.abc import Sequence

import h5py
import numpy as np
from benchmarks import results
from benchmarks.results import Row
from benchmarks.runner import SEED, Bench, Case
from palpate.app import cli, evaluate, options, workers
from palpate.app.datasets.robomimic import FILE
from palpate.tasks import policy

TASK = "touch/standard"
NOISE = 0.3
# Without velocities and drives: they tell what was done before, and copying that is a way to fit
# an expert that does not do the work (de Haan, Jayaraman and Levine 2019).
OBSERVATIONS = ("joints", "tip_pos", "contact_force", "target", "normal", "held")
COUNTS = (200, 100, 50)
UNSEEN = 100_000  # seed of the first episode to be judged by
LAYERS = (128, 128)
EPOCHS = 40
ENDS = ("success", "damage", "time limit")
RATE = 1e-3  # at which it learns, falling to nothing


def read(
  path: pathlib.Path, count: int, names: Sequence[str] = OBSERVATIONS
) -> tuple[np.ndarray, np.ndarray]:
  """Returns what was observed and what was done in the first episodes of a data set."""
  seen, done = [], []
  with h5py.File(path / FILE) as file:
    demos = sorted(file["data"].values(), key=lambda demo: demo.attrs["seed"])[:count]
    for demo in demos:
      parts = [demo[f"obs/{name}"][:] for name in names]
      seen.append(np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1))
      done.append(demo["actions"][:])
  return np.concatenate(seen), np.concatenate(done)


def learn(
  seen: np.ndarray, done: np.ndarray, about: policy.About, epochs: int = EPOCHS
) -> tuple[policy.Policy, float]:
  """Returns the policy that does what was done, and what is left of the squared error."""
  from sklearn.neural_network import MLPRegressor
  from threadpoolctl import threadpool_limits

  mean, scale = seen.mean(axis=0), 1 / np.maximum(seen.std(axis=0), 1e-6)
  x, y = ((seen - mean) * scale).astype(np.float32), done.astype(np.float32)
  network = MLPRegressor(
    hidden_layer_sizes=LAYERS, activation="tanh", batch_size=256, random_state=SEED
  )
  random = np.random.RandomState(SEED)
  for epoch in range(epochs):
    network.set_params(learning_rate_init=RATE * (1 - epoch / epochs))
    order = random.permutation(len(x))
    with threadpool_limits(1):  # its matrices are small
      network.partial_fit(x[order], y[order])
  layers = [(w.T, b) for w, b in zip(network.coefs_, network.intercepts_, strict=True)]
  return policy.Policy(about, mean, scale, layers), float(network.loss_)


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--episodes", metavar="N", type=int, help="to judge by (50; 2 if short)")
  add("--data", metavar="FOLDER", default="out/cloning", help="of data and policies (%(default)s)")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a number of demonstrations, all of one data set."""
  counts = (1, 2) if args.short else COUNTS
  each = {"most": max(counts), "judged": args.episodes or (2 if args.short else 50)}
  each |= {"epochs": 2 if args.short else EPOCHS, "data": str(pathlib.Path(args.data).resolve())}
  return [[{"case": f"{n} demonstrations", "demonstrations": n} | each for n in counts]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a number of demonstrations; their data set is made if it is not there."""
  folder = pathlib.Path(case["data"])
  data = folder / f"data_{case['most']}"
  words = ["export", TASK, "-o", data, "--format", "robomimic", "--noise", NOISE, "--resume"]
  words += ["--episodes", case["most"], "--observations", *OBSERVATIONS]
  if not data.exists() and cli.main([str(word) for word in words]):
    raise results.BenchError("the data set was not made; --resume goes on", code=1)
  start = time.perf_counter()
  seen, done = read(data, case["demonstrations"])
  env = options.environment(TASK, "{}")
  about = policy.About(
    TASK, env.task.components, OBSERVATIONS, env.control_timestep(),
    training={"by": "behaviour cloning", "demonstrations": case["demonstrations"], "noise": NOISE},
  )  # fmt: skip
  made, loss = learn(seen, done, about, case["epochs"])
  seconds = time.perf_counter() - start
  path = folder / f"policy_{case['demonstrations']}{policy.SUFFIX}"
  policy.save(path, made)
  crew = workers.Processes(os.cpu_count() or 1)
  seeds = range(UNSEEN, UNSEEN + case["judged"])
  ends = [r.outcome for r in evaluate.evaluate(TASK, str(path), seeds, crew)]
  return [
    {
      "demonstrations": case["demonstrations"],
      "steps": len(seen),
      "train_s": round(seconds, 1),
      "loss": round(loss, 5),
      "episodes": len(ends),
      **{end.replace(" ", "_"): ends.count(end) for end in ENDS},
      "percent": round(100 * ends.count("success") / len(ends), 1),
    }
  ]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  lines = ["| demonstrations | steps | training | success | damage | time limit |",
           "|---|---|---|---|---|---|"]  # fmt: skip
  for r in rows:
    if r["status"] == "ok":
      lines.append(
        f"| {r['demonstrations']} | {r['steps']} | {r['train_s']} s | {r['success']} of "
        f"{r['episodes']} | {r['damage']} | {r['time_limit']} |"
      )
  head = (f"`{TASK}`: an expert shaken by {NOISE} of the greatest rate, cloned by a network of "
          f"{' and '.join(map(str, LAYERS))} tanh units (scikit-learn, {EPOCHS} epochs), judged in "
          f"seeds from {UNSEEN} on.")  # fmt: skip
  path = out / "cloning.md"
  results.page(path, "Behaviour cloning", about, [head, "\n".join(lines)])
  return [path]


BENCH = Bench("cloning", stages, run, report=report, arguments=arguments)
