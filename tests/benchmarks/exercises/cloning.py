"""Behaviour cloning: how many demonstrations a small network needs.

`palpate export` makes episodes of an expert in robomimic's format, in some of them shaken.
scikit-learn fits a network to the first of both, from what is observed to what the expert meant to
do. `palpate evaluate` tells how often it succeeds in seeds that it has not seen. A clone of calm
episodes alone knows no way back, one of shaken ones alone stops where the organ is just touched.
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
from palpate.app import cli, options, workers
from palpate.app.console import CommandError
from palpate.app.datasets.robomimic import FILE
from palpate.app.learn import evaluate
from palpate.tasks.learn import policy

TASK = "touch/standard"
NOISE = 0.3
# Without velocities and drives: they tell what was done before, and copying that is a way to fit
# an expert that does not do the work (de Haan, Jayaraman and Levine 2019).
OBSERVATIONS = ("joints", "tip_pos", "contact_force", "target", "normal", "held")
COUNTS = (250, 120, 60)
SHAKEN = 0.2  # share of the demonstrations
FIRST = {"calm": 1000, "shaken": 2000}  # seeds
UNSEEN = 100_000  # seed of the first episode to be judged by
LAYERS = (128, 128)
EPOCHS = 40
RATES = {1e-3: 0.5, 3e-4: 0.25, 1e-4: 0.25}  # at which it learns: shares of the epochs
ENDS = ("success", "damage", "time limit")


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
    hidden_layer_sizes=LAYERS, activation="tanh", batch_size=256, random_state=SEED, warm_start=True
  )
  with threadpool_limits(1):  # its matrices are small
    for rate, share in RATES.items():
      network.set_params(learning_rate_init=rate, max_iter=max(1, round(share * epochs)))
      network.fit(x, y)
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


def made_data(folder: pathlib.Path, kind: str, count: int) -> pathlib.Path:
  """Returns a data set, made if it is not there."""
  path = folder / f"{kind}_{count}"
  words = ["export", TASK, "-o", path, "--format", "robomimic", "--resume", "--episodes", count]
  words += ["--seed", FIRST[kind], "--observations", *OBSERVATIONS]
  words += ["--noise", NOISE] if kind == "shaken" else []
  if not path.exists() and cli.main([str(word) for word in words]):
    raise CommandError("the data set was not made; --resume goes on", code=1)
  return path


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a number of demonstrations; their data sets are made if need be."""
  folder = pathlib.Path(case["data"])
  start, parts = time.perf_counter(), []
  for kind, share in (("calm", 1 - SHAKEN), ("shaken", SHAKEN)):
    count, most = (max(1, round(share * case[key])) for key in ("demonstrations", "most"))
    parts.append(read(made_data(folder, kind, most), count))
  seen, done = (np.concatenate(part) for part in zip(*parts, strict=True))
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


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  return [
    f"{r['demonstrations']} demonstrations: {r['success']} of {r['episodes']} episodes succeed."
    for r in sorted((r for r in rows if r["status"] == "ok"), key=lambda r: r["demonstrations"])
  ][-3:]


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
  head = (f"`{TASK}`: an expert, {SHAKEN:.0%} of the episodes shaken by {NOISE}, cloned by a "
          f"network of {' and '.join(map(str, LAYERS))} tanh units (scikit-learn), judged in seeds "
          f"from {UNSEEN} on.")  # fmt: skip
  path = out / "cloning.md"
  results.page(path, "Behaviour cloning", about, [head, "\n".join(lines)], finding(rows))
  return [path]


BENCH = Bench("cloning", stages, run, report=report, arguments=arguments)
