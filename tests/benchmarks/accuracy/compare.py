"""Runs of the error bench against their float64 reference."""

from __future__ import annotations

import functools
import math
import pathlib
import time
from collections.abc import Callable

import mujoco
import numpy as np
from benchmarks import scene
from benchmarks.accuracy import films
from benchmarks.accuracy.films import SAMPLE, SCRIPTS, Film
from benchmarks.runner import Case, Row
from benchmarks.scene import NATIVE
from reference import exact
from reference.inside import Inside

H = (0.125e-3, 0.25e-3, 0.5e-3, 1e-3, 2e-3, 5e-3, 1e-2)  # [s]
TAU = 3.125e-5  # time step of the finest reference [s]; every H is a whole number of them
LEVELS = (4, 2, 1)  # reference time steps in TAU, for its Richardson estimate
STEPS_CHECKED = 2  # steps of a run at 1 ms compared with their exact solution
RIGHT = "native, right weights"  # of the corners of touched triangles, as MuJoCo 4 has them
# Name in the figures, scheme and settings; `solver` and `mj_tolerance` are MuJoCo's.
RUNS = (
  ("implicit", "implicit", {}),
  ("implicit, tolerance 1e-2", "implicit", {"tolerance": 1e-2}),
  ("implicit, 3 Newton, tolerance 1e-6", "implicit", {"newton": 3, "tolerance": 1e-6}),
  ("implicit, window", "implicit", {"window": True}),
  ("implicit, 2 Newton, window", "implicit", {"window": True, "newton": 2}),
  ("midpoint", "midpoint", {}),
  ("midpoint, tolerance 1e-2", "midpoint", {"tolerance": 1e-2}),
  ("midpoint, window", "midpoint", {"window": True}),
  ("midpoint, 2 Newton, window", "midpoint", {"window": True, "newton": 2}),
  ("neumann", "neumann", {}),
  ("explicit", "explicit", {}),
  ("native", NATIVE, {}),
  (RIGHT, NATIVE, {}),
  ("native, Newton", NATIVE, {"solver": "Newton"}),
)
DRAWN = ("implicit", "implicit, window", "midpoint", "midpoint, window", "neumann", "explicit",
         "native", RIGHT, "native, Newton")  # fmt: skip
# The time within its step that a scheme's contact force belongs to; MuJoCo gives it with the step's
# end. That of an implicit step is the one at its end, others balance what is there at its start.
# A solid's implicit step, whose damping is h / 2 less, is between.
FORCE_AT = {"implicit": "end"}


def _reference_path(out: pathlib.Path, case: Case, level: int) -> pathlib.Path:
  name = f"{case['scene']}-{case['nodes']}-{case['elements']}-{level}.npz"
  return out / "reference" / name


def reference(case: Case, out: pathlib.Path) -> list[Row]:
  """Steps a scene explicitly in float64 through MuJoCo's passive callback and stores it."""
  h = case["level"] * TAU
  model = films.build(case, "passive", h, solver="Newton", mj_tolerance=1e-12)
  film = Film(case, model, weighs=True)
  nodes = film.state.dofs
  force = _within(case, h) if case["elements"] == "solid" else _on(case)

  def passive(data):
    data.qfrc_passive[nodes] += force(data.qpos[nodes], data.qvel[nodes])

  began = time.perf_counter()
  film.passive = passive
  film.move(film.script.duration)
  path = _reference_path(out, case, case["level"])
  path.parent.mkdir(parents=True, exist_ok=True)
  force = np.array(film.force).reshape(film.n, -1)
  every = round(H[0] / TAU) // case["level"]  # MuJoCo's force is that of the step before
  np.savez_compressed(
    path, force=force[every - 1 :: every].astype(np.float32), places=np.array(film.places)
  )
  row = {"kind": "reference", "run": "float64 explicit", "scheme": "explicit float64", "h": h}
  row |= {k: case[k] for k in ("scene", "nodes", "elements")}
  row["total_s"] = time.perf_counter() - began
  return [row | {"finite": int(film.good())}]


def _on(case: Case) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
  """Returns the force on the nodes of a surface, from their displacement and velocity."""
  mesh = scene.shape("sphere", case["nodes"])
  return exact.Elastic(mesh, films.config_of(case["elements"])).force


def _within(case: Case, h: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
  """Returns that of a solid; each call takes the step of the nodes inside, at rest at first."""
  mesh, tissue = scene.shape("sphere", case["nodes"]), films.ELEMENTS[case["elements"]]
  elastic = Inside(mesh, films.config_of(case["elements"]))
  n, mass = mesh.nvert, scene.masses(mesh, tissue)[:, None]
  u, v = np.zeros((2, elastic.mesh.nvert, 3))

  def force(disp: np.ndarray, vel: np.ndarray) -> np.ndarray:
    u[:n], v[:n] = disp, vel
    f = elastic.force(u, v)
    v[n:] += h * f[n:] / mass[n:]
    u[n:] += h * v[n:]
    return f[:n]

  return force


@functools.lru_cache(maxsize=2)
def truth_of(out: pathlib.Path, name: str, nodes: int, elements: str) -> dict:
  """Returns the extrapolated reference, its estimated error and observed order."""
  what = {"scene": name, "nodes": nodes, "elements": elements}
  found = []
  for level in (8, 4, 2, 1):
    path = _reference_path(out, what, level)
    if path.exists():
      with np.load(path) as stored:
        found.append((level, {k: stored[k].astype(float) for k in ("force", "places")}))
  if len(found) < 2:
    raise ValueError(f"no reference for {name}, {nodes} nodes, {elements}")
  found = found[-3:]
  fine, coarse = found[-1][1], found[-2][1]
  truth: dict = {k: 2 * fine[k] - coarse[k] for k in fine}  # first order: h and h / 2
  peak = {
    "force": np.abs(truth["force"]).max() if truth["force"].size else 1.0,
    "places": np.linalg.norm(truth["places"], axis=2).max(),
  }
  truth |= {f"{k}_peak": v for k, v in peak.items()}

  def rms(a, b, k):
    return math.sqrt(np.mean((a[k] - b[k]) ** 2)) / peak[k] if a[k].size else math.nan

  # What extrapolation moved the finest one by; its own error is smaller by a factor of its order.
  truth["force_error"] = rms(fine, coarse, "force")
  truth["places_error"] = rms(fine, coarse, "places")
  truth["order"] = math.nan
  if len(found) == 3:
    gap = rms(coarse, found[0][1], "places") / max(truth["places_error"], 1e-300)
    truth["order"] = math.log2(gap)
  return truth


class Check:
  """Compares a few steps of a run with their exact solution in float64."""

  def __init__(self, case: Case, film: Film, scheme: str, newton: int, twin):
    self.film, self.scheme, self.newton, self.twin = film, scheme, newton, twin
    mesh = film.mesh
    model, nodes = film.model, film.state.dofs
    assert nodes is not None  # all nodes have dofs here
    mass = model.body_mass[model.dof_bodyid[nodes[:, 0]]]
    elastic = exact.Elastic(mesh, films.config_of(case["elements"]))
    self.solve = exact.Step(elastic, mass, np.ones(mesh.nvert, bool))
    self.inertia = mass[:, None] + model.dof_armature[nodes]
    total = round(film.script.duration / film.h)
    self.at = {round(total * (k + 1) / (STEPS_CHECKED + 1)) for k in range(STEPS_CHECKED)}
    self.algebraic: list[float] = []
    self.nonlinear: list[float] = []

  def before(self):
    f = self.film
    if f.n not in self.at:
      return
    d, nodes = f.data, f.state.dofs
    self.u, self.v = d.qpos[nodes].copy(), d.qvel[nodes].copy()
    self.lagged = d.qfrc_constraint[nodes].copy()
    if self.twin is not None:
      for name in ("qpos", "qvel", "qacc_warmstart", "eq_active"):
        getattr(self.twin[1], name)[:] = getattr(d, name)
      mujoco.mj_step(*self.twin)

  def after(self):
    f = self.film
    if f.n - 1 not in self.at or not f.good():
      return
    nodes, h = f.state.dofs, f.h
    if self.twin is not None:
      wanted = self.twin[1].qvel[nodes] - self.v
      got = f.data.qvel[nodes] - self.v
      self.algebraic.append(_relative(got, wanted))
      return
    lagged = self.lagged if self.scheme != "explicit" else 0 * self.lagged
    got = h * (f.data.qfrc_passive[nodes] + lagged) / self.inertia
    if self.scheme == "explicit":
      wanted = h * self.solve.elastic.force(self.u, self.v) / self.solve.mass.reshape(-1, 3)
      self.algebraic.append(_relative(got, wanted))
      return
    scheme = "midpoint" if self.scheme == "midpoint" else "implicit"
    wanted = self.solve(h, self.u, self.v, lagged, self.newton, scheme)
    self.algebraic.append(_relative(got, wanted))
    if f.mesh.nvert <= 1000 and self.scheme == "implicit":
      self.nonlinear.append(_relative(got, self.solve(h, self.u, self.v, lagged, 8)))


def _relative(got: np.ndarray, wanted: np.ndarray) -> float:
  with np.errstate(all="ignore"):
    return float(np.linalg.norm(got - wanted) / max(np.linalg.norm(wanted), 1e-12))


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Runs a case: a reference, or all schemes at one time step, interleaved."""
  if case["kind"] == "reference":
    return reference(case, out)
  truth = truth_of(out, case["scene"], case["nodes"], case["elements"])
  h, script = case["h"], SCRIPTS[case["scene"]]
  sides = []
  for name, scheme, settings in RUNS:
    if not _applies(case, scheme, settings):
      continue
    if case["short"] and name not in DRAWN[:-1]:
      continue
    model = films.build(case, scheme, h, **settings)
    film = Film(case, model, ours=scheme != NATIVE, weighs=name == RIGHT)
    check = None
    if (case["nodes"] < 642 or abs(h - 1e-3) < 1e-9) and not settings.get("window"):
      twin = None
      if scheme == NATIVE and name != RIGHT and case["nodes"] <= 642:
        other = films.build(case, scheme, h, solver="Newton", mj_tolerance=1e-14)
        twin = (other, mujoco.MjData(other))
      if scheme != NATIVE or twin:
        check = Check(case, film, scheme, int(settings.get("newton", 1)), twin)
    sides.append((name, scheme, settings, film, check, film.organ))
  counts: dict[str, list[int]] = {side[0]: [] for side in sides}
  stretches = max(1, round(script.duration / SAMPLE))
  dead = set()
  for k in range(stretches):
    for name, _, _, film, check, organ in sides:
      if name in dead:
        continue
      film.move((k + 1) * SAMPLE, check.before if check else None, check.after if check else None)
      if organ is not None:
        counts[name].append(organ.iterations)
      if not film.good() or (organ is not None and organ.error):
        dead.add(name)
  rows = []
  for name, scheme, settings, film, check, _ in sides:
    row: Row = {"kind": "run", "run": name, "scheme": scheme, "h": h}
    row |= {k: case[k] for k in ("scene", "nodes", "elements")}
    row["newton"] = settings.get("newton", 1) if scheme in ("implicit", "midpoint") else ""
    row["tolerance"] = settings.get("tolerance", settings.get("mj_tolerance", ""))
    row["step_ms"] = 1e3 * float(np.median(film.times[1:]))
    row["total_s"] = row["step_ms"] * 1e-3 * script.duration / h
    row["finite"] = int(name not in dead)
    at = "start" if case["elements"] == "solid" else FORCE_AT.get(scheme, "start")
    row |= errors(film, truth, h, at) if name not in dead else {}
    if check is not None and check.algebraic:
      row["algebraic"] = float(np.median(check.algebraic))
    if check is not None and check.nonlinear:
      row["nonlinear"] = float(np.median(check.nonlinear))
    if counts[name]:
      row["iterations"] = float(np.mean(counts[name]))
    if film.overflow:
      row["finite"] = 0
    row |= {"reference_force": truth["force_error"], "reference_position": truth["places_error"]}
    row |= {"reference_order": truth["order"], "peak_N": truth["force_peak"]}
    rows.append(row | {"peak_mm": 1e3 * truth["places_peak"]})
  return rows


def _applies(case: Case, scheme: str, settings: dict) -> bool:
  """Returns whether a run of RUNS is made in a case."""
  script, large = SCRIPTS[case["scene"]], case["nodes"] > 642
  newton = settings.get("solver") == "Newton"
  solid = case["elements"] == "solid"
  if solid and not settings.get("window"):
    return False
  if not solid and settings.get("newton") == 2:
    return False  # their matrix is that of their forces
  if scheme == NATIVE and case["elements"] == "spring":
    return False  # MuJoCo's flex has no such element that its implicit step knows
  if settings.get("window") and (large or script.joined or not script.probe):
    return False  # no contact for it; large: its spare triangles count contacts twice
  if newton:  # a tenth of a second a step, a second with more nodes
    return not large and case["h"] >= 1e-3 and case["scene"] == "press"
  return True


def errors(film: Film, truth: dict, h: float, at: str) -> Row:
  """Returns the errors of a run as shares of the reference's peaks; forces belong to `at`."""
  places = np.array(film.places)
  gap = np.linalg.norm(places - truth["places"][: len(places)], axis=2)
  row: Row = {"position_rms": float(np.sqrt(np.mean(gap**2)) / truth["places_peak"])}
  if truth["force"].size:
    every = round(h / H[0])
    end = truth["force"][every - 1 :: every]
    wanted = {"start": np.concatenate([0 * end[:1], end[:-1]]), "end": end}
    force = np.array(film.force)
    # Where it lets go the force drops from one step to the next: which of them is chance.
    begins = h * np.arange(len(force))
    smooth = np.abs(begins + 0.5 * h - film.script.released) > 1.6 * h
    for time_level, values in wanted.items():
      gap = np.linalg.norm(force - values, axis=1)[smooth]
      row[f"force_rms_{time_level}"] = float(np.sqrt(np.mean(gap**2)) / truth["force_peak"])
    row["force_rms"] = row[f"force_rms_{at}"]
    highest = np.linalg.norm(force, axis=1).max()
    row["force_peak"] = float(abs(highest / np.linalg.norm(truth["force"], axis=1).max() - 1))
  return row
