"""`run.py error`: what a millisecond buys, scene by scene.

Scripted scenes run with every scheme, time step and tolerance, MuJoCo's native flex interleaved
with ours, and are compared with a float64 reference (explicit, refined until its error is known).
Kept apart: the error of the linear solve, of the time step, and of the contact force.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import pathlib
import time
from collections.abc import Callable

import mujoco
import numpy as np
from benchmarks import plots, runner, scene
from benchmarks.runner import Bench, Case, Row
from benchmarks.scene import NATIVE, Tissue
from palpate.tissue.config import Config
from reference import exact

H = (0.125e-3, 0.25e-3, 0.5e-3, 1e-3, 2e-3, 5e-3, 1e-2)  # [s]
TAU = 3.125e-5  # time step of the finest reference [s]; every H is a whole number of them
LEVELS = (4, 2, 1)  # reference time steps in TAU, for its Richardson estimate
SAMPLE = 1e-2  # between compared positions [s]; a multiple of every H
STEPS_CHECKED = 2  # steps of a run at 1 ms compared with their exact solution
SIZES = {642: ("membrane", "spring"), 2562: ("membrane",)}
ELEMENTS = {
  "membrane": Tissue(),
  "spring": Tissue(elements="spring", stiffness=60.0),
}
# Name in the figures, scheme and settings; `solver` and `mj_tolerance` are MuJoCo's.
RUNS = (
  ("implicit", "implicit", {}),
  ("implicit, tolerance 1e-2", "implicit", {"tolerance": 1e-2}),
  ("implicit, 3 Newton, tolerance 1e-6", "implicit", {"newton": 3, "tolerance": 1e-6}),
  ("implicit, window", "implicit", {"window": True}),
  ("midpoint", "midpoint", {}),
  ("midpoint, tolerance 1e-2", "midpoint", {"tolerance": 1e-2}),
  ("midpoint, window", "midpoint", {"window": True}),
  ("neumann", "neumann", {}),
  ("explicit", "explicit", {}),
  ("native", NATIVE, {}),
  ("native, Newton", NATIVE, {"solver": "Newton"}),
)
DRAWN = ("implicit", "implicit, window", "midpoint", "midpoint, window", "neumann", "explicit",
         "native", "native, Newton")  # fmt: skip
LEVELS_WANTED = (0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
# The time within its step that a scheme's contact force belongs to; MuJoCo gives it with the step's
# end. That of an implicit step is the one at its end, others balance what is there at its start.
FORCE_AT = {"implicit": "end"}
OURS = ("implicit", "midpoint")


@dataclasses.dataclass(frozen=True)
class Script:
  """A scripted scene.

  Attributes:
    duration: [s]
    probe: whether there is one
    motion: displacement and velocity of the probe at a time, from its start
    joined: whether the top nodes hang on the probe
    friction: of the contact
    released: time at which they no longer do [s]
    begin: displacement of the nodes at first, from their rest positions
  """

  duration: float
  probe: bool = True
  motion: Callable[[float], tuple[np.ndarray, np.ndarray]] | None = None
  joined: bool = False
  friction: float = 0.0
  released: float = math.inf
  begin: Callable[[np.ndarray], np.ndarray] | None = None


def _along(*legs: tuple[float, float, tuple[float, float, float]]):
  """Returns a motion of smooth legs: start [s], duration [s], displacement [m]."""

  def motion(now: float) -> tuple[np.ndarray, np.ndarray]:
    place, speed = np.zeros(3), np.zeros(3)
    for start, duration, move in legs:
      done, rate = scene.ramp(now - start, duration)
      place += done * np.array(move)
      speed += rate * np.array(move)
    return place, speed

  return motion


def _bulge(rest: np.ndarray) -> np.ndarray:
  """Returns a smooth mode: the sphere stretched along z, 5 %."""
  return 0.05 * rest * [-0.5, -0.5, 1.0]


SCRIPTS = {
  "press": Script(0.16, motion=_along((0.0, 0.1, (0, 0, -0.012)))),
  # Without friction: with it the probe sticks on a facet and jumps off it, and when is chance.
  "slide": Script(0.2, motion=_along((0.0, 0.08, (0, 0, -0.008)), (0.08, 0.12, (0.012, 0, 0)))),
  "pull": Script(0.2, motion=_along((0.0, 0.08, (0, 0, 0.01))), joined=True, released=0.1),
  "vibrate": Script(0.08, probe=False, begin=_bulge),
}
_COLUMNS = (
  *("kind", "scene", "nodes", "elements", "run", "scheme", "h", "newton", "tolerance", "step_ms"),
  *("total_s", "force_rms", "force_rms_start", "force_rms_end", "force_peak", "position_rms"),
  *("algebraic", "nonlinear", "iterations", "finite", "reference_force", "reference_position"),
  *("reference_order", "peak_N", "peak_mm"),
)


def stages(short: bool) -> list[list[Case]]:
  """Returns the references, then the runs, one case a scene, size, element and time step."""
  scenes = ("press", "vibrate") if short else tuple(SCRIPTS)
  sizes = {162: ("membrane",)} if short else SIZES
  hs = H[2:5] if short else H
  first, second = [], []
  for nodes, kinds in sizes.items():
    for name in scenes:
      for elements in kinds:
        what = {"scene": name, "nodes": nodes, "elements": elements}
        first += [
          {"case": f"reference-{name}-{nodes}-{elements}-{k}", "kind": "reference", "level": k}
          | what
          for k in (LEVELS[:2] if short else LEVELS if nodes <= 642 else LEVELS[1:])
        ]
        second += [
          {"case": f"{name}-{nodes}-{elements}-{h:g}", "kind": "run", "h": h, "short": int(short)}
          | what
          for h in hs
        ]
  return [first, second]


def _config(elements: str) -> Config:
  t = ELEMENTS[elements]
  return Config(**{k: v for k, v in t.keys().items() if k != "young"}, young=(t.young,))


def _build(case: Case, scheme: str, h: float, **keys) -> mujoco.MjModel:
  script = SCRIPTS[case["scene"]]
  mesh = scene.shape("sphere", case["nodes"])
  top = mesh.rest[np.argmax(mesh.rest[:, 2])]
  probe = joined = None
  if script.probe:
    probe = top + np.array([0, 0, 0.0 if script.joined else scene.PROBE + 0.0006])
  if script.joined:
    near = np.linalg.norm(mesh.rest - top, axis=1)
    joined = np.flatnonzero(near < 1.2 * np.sort(near)[1])
  tissue = ELEMENTS[case["elements"]]
  return scene.build(
    mesh,
    tissue,
    scheme,
    h,
    probe=probe,
    joined=joined,
    friction=script.friction,
    lumped=True,
    **keys,
  )


class _Film:
  """A run that can be advanced a stretch at a time."""

  def __init__(self, case: Case, model: mujoco.MjModel, ours: bool = False):
    self.script = SCRIPTS[case["scene"]]
    self.model, self.data = model, mujoco.MjData(model)
    self.h = model.opt.timestep
    self.mesh = scene.shape("sphere", case["nodes"])
    self.organ = scene.handle(model, self.data) if ours else None
    self.state = scene.Nodes(model, self.data, self.mesh, self.organ)
    self.overflow = 0  # nodes that a window had no room for
    self.probe = scene.probe_dofs(model) if self.script.probe else None
    self.force: list[np.ndarray] = []
    self.places: list[np.ndarray] = []
    self.times: list[float] = []
    self.n = 0
    if self.script.begin:
      self.state.put(self.script.begin(self.mesh.rest))

  def move(self, until: float, before=None, after=None):
    """Advances to a time, calling `before` and `after` around each step."""
    every = round(SAMPLE / self.h)
    while self.n < round(until / self.h):
      now = self.n * self.h
      if self.probe is not None and self.script.motion:
        place, speed = self.script.motion(now)
        scene.put(self.data, self.probe, place, speed)
        if now >= self.script.released - 1e-9:
          self.data.eq_active[:] = 0
      if before:
        before()
      start = runner.clock()
      mujoco.mj_step(self.model, self.data)
      self.times.append(runner.clock() - start)
      self.n += 1
      if after:
        after()
      if self.probe is not None:
        self.force.append(self.data.qfrc_constraint[self.probe].copy())
      if self.n % every == 0:
        self.places.append(self.state.state()[0].copy())
      if self.state.organ:
        self.overflow = max(self.overflow, *self.state.organ.window_overflow)

  def good(self) -> bool:
    if scene.bad(self.data) or not np.isfinite(self.data.qpos).all():
      return False
    return self.organ is None or not self.organ.error


def _reference_path(out: pathlib.Path, case: Case, level: int) -> pathlib.Path:
  name = f"{case['scene']}-{case['nodes']}-{case['elements']}-{level}.npz"
  return out / "reference" / name


def _reference(case: Case, out: pathlib.Path) -> list[Row]:
  """Steps a scene explicitly in float64 through MuJoCo's passive callback and stores it."""
  h = case["level"] * TAU
  model = _build(case, "passive", h, solver="Newton", mj_tolerance=1e-12)
  elastic = exact.Elastic(scene.shape("sphere", case["nodes"]), _config(case["elements"]))
  film = _Film(case, model)
  nodes = film.state.dofs

  def passive(_, data):
    data.qfrc_passive[nodes] += elastic.force(data.qpos[nodes], data.qvel[nodes])

  began = time.perf_counter()
  mujoco.set_mjcb_passive(passive)
  try:
    film.move(film.script.duration)
  finally:
    mujoco.set_mjcb_passive(None)
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


@functools.lru_cache(maxsize=2)
def _truth(out: pathlib.Path, name: str, nodes: int, elements: str) -> dict:
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


class _Check:
  """Compares a few steps of a run with their exact solution in float64."""

  def __init__(self, case: Case, film: _Film, scheme: str, newton: int, twin):
    self.film, self.scheme, self.newton, self.twin = film, scheme, newton, twin
    mesh = film.mesh
    model, nodes = film.model, film.state.dofs
    assert nodes is not None  # all nodes have dofs here
    mass = model.body_mass[model.dof_bodyid[nodes[:, 0]]]
    elastic = exact.Elastic(mesh, _config(case["elements"]))
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
    return _reference(case, out)
  truth = _truth(out, case["scene"], case["nodes"], case["elements"])
  h, script = case["h"], SCRIPTS[case["scene"]]
  sides = []
  for name, scheme, settings in RUNS:
    if not _applies(case, scheme, settings):
      continue
    if case["short"] and name not in DRAWN[:-1]:
      continue
    model = _build(case, scheme, h, **settings)
    film = _Film(case, model, ours=scheme != NATIVE)
    check = None
    if (case["nodes"] < 642 or abs(h - 1e-3) < 1e-9) and not settings.get("window"):
      twin = None
      if scheme == NATIVE and case["nodes"] <= 642:
        other = _build(case, scheme, h, solver="Newton", mj_tolerance=1e-14)
        twin = (other, mujoco.MjData(other))
      if scheme != NATIVE or twin:
        check = _Check(case, film, scheme, int(settings.get("newton", 1)), twin)
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
    row["newton"] = settings.get("newton", 1) if scheme == "implicit" else ""
    row["tolerance"] = settings.get("tolerance", settings.get("mj_tolerance", ""))
    row["step_ms"] = 1e3 * float(np.median(film.times[1:]))
    row["total_s"] = row["step_ms"] * 1e-3 * script.duration / h
    row["finite"] = int(name not in dead)
    row |= _errors(film, truth, h, FORCE_AT.get(scheme, "start")) if name not in dead else {}
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
  if scheme == NATIVE and case["elements"] == "spring":
    return False  # MuJoCo's flex has no such element that its implicit step knows
  if settings.get("window") and (large or script.joined or not script.probe):
    return False  # no contact for it; large: its spare triangles count contacts twice
  if newton:  # a tenth of a second a step, a second with more nodes
    return not large and case["h"] >= 1e-3 and case["scene"] == "press"
  return True


def _errors(film: _Film, truth: dict, h: float, at: str) -> Row:
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


def groups(rows: list[Row]) -> dict[tuple, list[Row]]:
  """Returns the runs by (scene, nodes, elements)."""
  out: dict[tuple, list[Row]] = {}
  for row in rows:
    if row["kind"] == "run" and row["status"] == "ok":
      out.setdefault((row["scene"], row["nodes"], row["elements"]), []).append(row)
  return out


def measure(row: Row) -> str:
  """Returns the error that a scene is judged by."""
  return "position_rms" if row["force_rms"] == "" else "force_rms"


def order(rows: list[Row], key: str, most: float = 1.01e-3) -> float:
  """Returns the observed order of convergence: slope of log error against log h, h <= `most`."""
  points = [(r["h"], r[key]) for r in rows if r[key] not in ("", 0) and r["h"] <= most]
  if len(points) < 2:
    return math.nan
  x, y = np.log(np.array(points)).T
  return float(np.polyfit(x, y, 1)[0])


def cheapest(rows: list[Row], level: float) -> tuple[float, Row | None]:
  """Returns the least run time [s] of the rows that reach an error level, and which row it is."""
  good = [r for r in rows if r[measure(r)] != "" and r[measure(r)] <= level]
  best = min(good, key=lambda r: r["total_s"], default=None)
  return (best["total_s"], best) if best else (math.inf, None)


def draw(rows: list[Row], out: pathlib.Path) -> list[pathlib.Path]:
  """Draws error against run time and error against h, one figure a scene."""
  written = []
  by_scene: dict[str, list[tuple]] = {}
  for key in groups(rows):
    by_scene.setdefault(key[0], []).append(key)
  for name, keys in by_scene.items():
    figure, axes = plots.grid(2, len(keys), width=4.6 * len(keys) + 1.0, height=7.2)
    axes = np.reshape(axes, (2, len(keys)))
    for column, key in enumerate(keys):
      mine = groups(rows)[key]
      what = measure(mine[0])
      label = f"{what.split('_')[0]} error, RMS [% of peak]"
      for ax, x, text in ((axes[0, column], "total_s", "run time of the scene [s]"),
                          (axes[1, column], "h", "time step [ms]")):  # fmt: skip
        scale = 1e3 if x == "h" else 1.0
        for run_name in DRAWN:
          line = sorted((r for r in mine if r["run"] == run_name and r[what] != ""),
                        key=lambda r: r["h"])  # fmt: skip
          line = [r for r in line if r[what] < 2]
          colour, mark, style = plots.STYLES[run_name]
          if line:
            label_of = run_name.replace("native", "MuJoCo flex")
            ax.plot([scale * r[x] for r in line], [100 * r[what] for r in line], style,
                    marker=mark, ms=4, color=colour, label=label_of)  # fmt: skip
        floor = 100 * mine[0]["reference_force" if what == "force_rms" else "reference_position"]
        ax.axhline(floor, color="#999999", lw=0.8, ls=":")
        ax.annotate("reference", (1, floor), xycoords=("axes fraction", "data"), ha="right",
                    va="bottom", fontsize=7, color="#777777")  # fmt: skip
        ax.set(xscale="log", yscale="log", xlabel=text)
        plots.plain(ax.xaxis, 2)
        plots.plain(ax.yaxis, 2)
        if column == 0:
          ax.set_ylabel(label, fontsize=9)
      axes[0, column].set_title(f"{key[1]} nodes, {key[2]}", loc="left", fontsize=10)
    handles = {}
    for ax in axes.ravel():
      handles |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center",
                  ncols=3 * len(keys), fontsize=8, frameon=False)  # fmt: skip
    written.append(
      plots.save(figure, out / f"error_{name}.png", f"{name}: below and left is better")
    )
  return written


def _race(found: dict[tuple, list[Row]]) -> tuple[list[str], list[list], list[str]]:
  """Returns head and rows of the table of least run times, and where a peer is faster than ours."""
  sides: dict[str, Callable[[Row], bool]] = {
    "ours": lambda r: r["scheme"] in OURS and "window" not in r["run"],
    "ours, window": lambda r: r["scheme"] in OURS and "window" in r["run"],
    "neumann": lambda r: r["scheme"] == "neumann",
    "explicit": lambda r: r["scheme"] == "explicit",
    "MuJoCo flex": lambda r: r["scheme"] == NATIVE,
  }
  table, lost = [], []
  for key, mine in found.items():
    for level in LEVELS_WANTED:
      cells, best = [], {}
      for label, belongs in sides.items():
        best[label], row = cheapest([r for r in mine if belongs(r)], level)
        which = f"{row['scheme']} " if row and label.startswith("ours") else ""
        cells.append(f"{best[label]:.3g} ({which}{1e3 * row['h']:g} ms)" if row else "-")
      winner = min(best, key=lambda k: best[k])
      table.append([*key, f"{100 * level:g} %", *cells,
                    "none reaches it" if math.isinf(best[winner]) else winner])  # fmt: skip
      peer = min(("neumann", "explicit", "MuJoCo flex"), key=lambda k: best[k])
      if best[peer] < best["ours"]:
        ratio = best["ours"] / best[peer]
        by = "ours does not reach it" if math.isinf(ratio) else f"{ratio:.2f} times"
        lost.append(f"{key[0]}, {key[1]} nodes, {key[2]}, {100 * level:g} %: {peer}, {by}")
  return ["scene", "nodes", "elements", "error", *sides, "least"], table, lost


def summarize(rows: list[Row], about: dict) -> str:
  """Returns the page: least run time to each error level, orders, errors at the default."""
  lines = ["# Run time against error", "", runner.caption(about), ""]
  lines += [f"    run.py error{' --short' if about.get('short') else ''}", ""]
  lines += [
    "Errors are RMS over the scene, of the reference's peak: contact force on the probe where "
    "there is one, node positions in `vibrate`. A force is that of the step's end for `implicit` "
    "and of its start for the others, which is the better one for each (both are in the CSV). The "
    "reference is explicit, in float64, at "
    f"{1e6 * TAU:g} us and multiples, extrapolated. Run time is the median step times the steps of "
    "the scene, in CPU time of the one thread, so that other load does not count.",
    "",
  ]
  found = groups(rows)
  lines += ["## Least run time [s] to an error level, over all h and settings", ""]
  head, table, lost = _race(found)
  lines += [*plots.table(head, table), ""]
  lines += [
    "`ours`: `implicit` or `midpoint` with all nodes as MuJoCo's dofs, as the others have them; "
    "`ours, window`: the same with window coupling (scenes with a contact). `explicit` and "
    "`neumann` are those of the thesis and its predecessor on our kernels.",
    "",
    "A peer is faster: " + ("; ".join(lost) or "nowhere") + ".",
    "",
  ]
  table = []
  for key, mine in found.items():
    at = {r["run"]: r for r in mine if abs(r["h"] - 1e-3) < 1e-9}
    for name in at:
      r = at[name]
      cells = [
        100 * r[k] if r[k] != "" else "" for k in ("force_rms", "force_peak", "position_rms")
      ]
      ratio = at["native"]["step_ms"] / r["step_ms"] if "native" in at else ""
      table.append([*key, name, *cells, r["algebraic"], r["nonlinear"], r["step_ms"], ratio])
  head = ["scene", "nodes", "elements", "run", "force RMS [%]", "peak [%]", "position [%]"]
  head += ["algebraic", "nonlinear", "step [ms]", "flex step / this"]
  lines += ["## At h = 1 ms", "", *plots.table(head, table), ""]
  lines += [
    "Algebraic: one step against its exact solution in float64 (native: against MuJoCo's Newton "
    "solver at 1e-14 from the same state); neumann: against the implicit step. Nonlinear: against "
    "the converged implicit Euler step.",
    "",
  ]
  table = []
  for key, mine in found.items():
    for name in dict.fromkeys(r["run"] for r in mine):
      line = [r for r in mine if r["run"] == name]
      table.append([*key, name, order(line, "position_rms"), order(line, "force_rms"),
                    mine[0]["reference_order"], mine[0]["reference_position"],
                    mine[0]["reference_force"]])  # fmt: skip
  head = ["scene", "nodes", "elements", "run", "order, position", "order, force"]
  head += ["reference: order", "moved by, position", "force"]
  lines += ["## Observed order of convergence, h <= 1 ms", "", *plots.table(head, table), ""]
  ended = [r for r in rows if r["kind"] == "run" and (r["status"] != "ok" or r["finite"] == 0)]
  if ended:
    words = sorted({f"{r['case']}: {r['run'] or r['status']}" for r in ended})
    lines += ["Diverged or not run: " + "; ".join(words), ""]
  return "\n".join(lines)


BENCH = Bench("error", "benchmarks.error", _COLUMNS, stages, run, draw, summarize, limit=3600.0)


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  runner.add_arguments(parser, BENCH)
  parser.epilog = "Run times are compared: use one process, or fewer than there are idle cores."


def main(args: argparse.Namespace) -> int:
  """Runs the bench."""
  return runner.main(BENCH, args)
