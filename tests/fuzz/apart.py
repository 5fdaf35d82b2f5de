"""Runs fuzz cases by seed in a process of its own: `python tests/fuzz/apart.py KIND FIRST LAST`."""

from __future__ import annotations

import importlib
import pathlib
import subprocess
import sys
import traceback

TESTS = pathlib.Path(__file__).parents[1]
BLOCK = 250  # seeds a process
MOST = 20  # failures that are looked for


def one(kind: str, seed: int):
  """Checks a case; what fails names its seed."""
  check = importlib.import_module(f"fuzz.{kind}").check
  try:
    check(seed)
  except Exception as error:
    again = f"python -m pytest tests/fuzz -k {kind} --seed {seed}"
    raise AssertionError(f"{kind}, seed {seed}: {error!r}; again: {again}") from error


def sweep(kind: str, end: int) -> dict[int, str]:
  """Returns what fails of the seeds under `end`, whatever it does to its process.

  Ends where there are more than MOST of them.

  Returns:
    how each fails, by seed
  """
  failed: dict[int, str] = {}
  first = 0
  while first < end and len(failed) <= MOST:
    last = min(first + BLOCK, end)
    words = [sys.executable, __file__, kind, str(first), str(last)]
    done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    seed = first
    for line in done.stdout.splitlines():
      if line.startswith("seed "):
        seed = int(line.split()[1])
      elif line.startswith("failed "):
        failed[seed] = line.removeprefix("failed ")
    if done.returncode:
      failed[seed] = f"ended its process with {done.returncode}: {done.stdout[-500:]}"
    first = seed + 1
  return failed


def measure(program: str, *words) -> list[int]:
  """Returns the numbers with which a program of this folder ends.

  Raises:
    AssertionError: it fails.
  """
  command = [sys.executable, str(TESTS / "fuzz" / program), *map(str, words)]
  done = subprocess.run(command, capture_output=True, text=True)
  assert done.returncode == 0, f"{program} {words}:\n{done.stderr[-2000:]}"
  return [int(word) for word in done.stdout.split()[-2:]]


def main(kind: str, first: int, last: int):
  """Runs the cases and prints which they are and how they fail."""
  sys.path.insert(0, str(TESTS))
  for seed in range(first, last):
    print(f"seed {seed}", flush=True)
    try:
      one(kind, seed)
    except AssertionError as error:
      traceback.print_exc()
      print("failed", " ".join(str(error).split()), flush=True)


if __name__ == "__main__":
  main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
