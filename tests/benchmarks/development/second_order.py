"""Second-order schemes in float64 beside the implicit step, coupled to MuJoCo as the plugin is.

Implicit Euler, the plugin's `midpoint`, BDF2 and TR-BDF2, each linearly implicit with exact solves,
on the press and the free vibration of the bench `error`, 162 nodes. A scheme hands MuJoCo the
velocity that moves x to where it wants it, (x1 - x) / h, and keeps what it needs of the past. The
contact force is that of the last step, corrected by the effective inertia, as in
the plugin's coupling.
"""

import argparse
import dataclasses
import pathlib

import mujoco
import numpy as np
from benchmarks import plots, results, scene
from benchmarks.accuracy import compare, error, films
from benchmarks.accuracy.films import Film
from benchmarks.runner import Bench, Case, Row
from palpate.engine.model import inertia
from palpate.tissue import shape as making
from reference import exact
from scipy import sparse
from scipy.sparse import linalg

NODES = 162
SCENES = ("press", "vibrate")
_COLUMNS = (
  *("scene", "scheme", "h", "finite", "solves", "position_rms", "force_rms_start"),
  *("force_rms_end", "force_rms", "force_peak"),
)
SOLVES = {"implicit": 1, "midpoint": 1, "BDF2": 1, "TR-BDF2": 2}
COLOURS = {"implicit": "#08519c", "midpoint": "#000000", "BDF2": "#c1442e", "TR-BDF2": "#2ca02c"}
HS = compare.H[1:6]  # [s]
SPLIT = 2 - np.sqrt(2)  # part of a TR-BDF2 step that is TR: Bank et al. 1985


class Scheme:
  """One scheme on one organ.

  Args:
    name: one of SOLVES
    elastic: forces
    mass: nodal masses [kg], (nvert,)
    h: time step [s]
  """

  def __init__(self, name: str, elastic: exact.Elastic, mass: np.ndarray, h: float):
    self.name, self.elastic, self.mass, self.h = name, elastic, mass[:, None], h
    self.past = None  # displacement a step ago
    self.v = None  # true velocity, where it is not MuJoCo's
    beta = elastic.config.damping
    c = {"BDF2": 2 / 3, "TR-BDF2": SPLIT / 2}.get(name, 1.0) * h
    half = 0.5 if name == "midpoint" else 1.0
    self.gain = half * (c * c + c * beta)  # factor of K in A [s^2]
    # A contact meets this times A: h^2 over how far a unit force moves a unit mass.
    self.share = {"BDF2": 9 / 4, "TR-BDF2": 2.0}.get(name, 1.0)
    self.kick = {"BDF2": 1.5, "TR-BDF2": 2.0}.get(name, 1.0)  # of v by one of the velocity handed

  def solve(self, x, v, rhs, gx, gv) -> np.ndarray:
    """Returns dv of M dv = rhs(F), F - K (gx dv) - damping K (gv dv) linear about (x, v)."""
    e, beta = self.elastic, self.elastic.config.damping
    k = e.stiffness(x)
    force = e.force(x) - beta * (k @ v.ravel()).reshape(-1, 3)
    a = sparse.diags(np.repeat(self.mass, 3)) + (gx + gv * beta) * k
    return np.asarray(linalg.spsolve(a.tocsc(), rhs(force).ravel())).reshape(-1, 3)

  def step(self, x, seen, f) -> tuple[np.ndarray, np.ndarray]:
    """Returns the velocity that moves x, and the true one at the end.

    Args:
      x: displacement [m], (nvert, 3)
      seen: velocity that MuJoCo has [m/s], (nvert, 3)
      f: contact force of the last step [N], (nvert, 3)
    """
    h, m = self.h, self.mass
    if self.name == "midpoint":
      part = 0.5 if self.past is None else 1.0
      gain = 0.5 * part * h
      v1 = seen + self.solve(x, seen, lambda F: part * h * (F + f), gain * h, gain)
      return v1, v1
    v = seen if self.v is None else self.v
    if self.name == "implicit" or (self.name == "BDF2" and self.past is None):
      v1 = v + self.solve(x + h * v, v, lambda F: h * (F + f), h * h, h)
      return v1, v1
    if self.name == "BDF2" and self.past is not None:
      c = 2 / 3 * h
      back = (v - self.past[1]) / 3
      guess = (4 * x - self.past[0]) / 3 + c * v
      dv = self.solve(guess, v, lambda F: m * back + c * (F + f), c * c, c)
      return (guess + c * dv - x) / h, v + dv
    d = SPLIT / 2 * h
    here = self.elastic.force(x, v)
    dv = self.solve(x + 2 * d * v, v, lambda F: d * (here + F + 2 * f), d * d, d)
    mid_v, mid_x = v + dv, x + d * (2 * v + dv)
    a = 1 / (SPLIT * (2 - SPLIT))
    b = a - 1
    guess = a * mid_x - b * x + d * mid_v
    rise = a * mid_v - b * v - mid_v
    dv = self.solve(guess, mid_v, lambda F: m * rise + d * (F + f), d * d, d)
    return (guess + d * dv - x) / h, mid_v + dv

  def moved(self, x, v, end, correction):
    """Notes a step: `correction` is what MuJoCo's new contacts changed of the velocity handed."""
    self.past = (x, v if self.v is None else self.v)
    if self.name in ("BDF2", "TR-BDF2"):
      self.v = end + self.kick * correction


def _inertia(scheme: Scheme, film: Film) -> np.ndarray:
  """Returns what the scheme makes a contact meet at each node [kg], (nvert,)."""
  mesh, config = film.mesh, scheme.elastic.config
  free = np.ones(mesh.nvert, bool)
  body = making.make(mesh, dataclasses.replace(config, tolerance=1e-2, newton=1), ~free, "cpu")
  mass = scheme.mass[:, 0] * scheme.share
  gain = scheme.gain * scheme.share
  return inertia.effective_inertia(body, mesh, mass, free, scheme.h, scene.PROBE, gain)


def film_of(name: str, where: str, h: float) -> Film:
  """Runs a scheme on a scene of the error bench."""
  case = {"scene": where, "nodes": NODES, "elements": "membrane"}
  model = films.build(case, "passive", h, solver="Newton", mj_tolerance=1e-10)
  film = Film(case, model, weighs=True)
  dofs = film.state.dofs
  mass = model.body_mass[model.dof_bodyid[dofs[:, 0]]]
  scheme = Scheme(name, exact.Elastic(film.mesh, films.config_of("membrane")), mass, h)
  meets = _inertia(scheme, film)
  model.dof_armature[dofs] = (meets - mass)[:, None]
  weights = model.dof_invweight0.copy(), model.body_invweight0.copy()
  mujoco.mj_setConst(model, mujoco.MjData(model))
  model.dof_invweight0[:], model.body_invweight0[:] = weights
  now = {"f": np.zeros_like(film.mesh.rest)}

  def passive(data):
    x, v = data.qpos[dofs].copy(), data.qvel[dofs].copy()
    to, end = scheme.step(x, v, now["f"])
    data.qfrc_passive[dofs] += meets[:, None] * (to - v) / h - now["f"]
    now.update(x=x, v=v, to=to, end=end)

  def after():
    scheme.moved(now["x"], now["v"], now["end"], film.data.qvel[dofs] - now["to"])
    now["f"] = film.data.qfrc_constraint[dofs].copy()

  film.passive = passive
  film.move(film.script.duration, after=after)
  return film


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns the references, then a case a scheme, scene and time step."""
  places = SCENES[:1] if args.short else SCENES
  first = [
    {"case": f"reference-{where}-{level}", "scene": where, "level": level}
    for where in places
    for level in (2, 1)
  ]
  second = [
    {"case": f"{where}-{name}-{h:g}", "scene": where, "scheme": name, "h": h}
    for where in places
    for name in SOLVES
    for h in (HS[2:3] if args.short else HS)
  ]
  return [first, second]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Runs a case: a reference, whose file goes to `out`, or a scheme."""
  where = case["scene"]
  if "level" in case:
    what = {"nodes": NODES, "elements": "membrane", "kind": "reference"}
    compare.reference(case | what, out)
    return []
  truth = compare.truth_of(out, where, NODES, "membrane")
  name, h = case["scheme"], case["h"]
  film = film_of(name, where, h)
  row = {"scene": where, "scheme": name, "h": h, "finite": int(film.good())}
  row["solves"] = SOLVES[name] * film.n
  at = compare.FORCE_AT.get(name, "start")
  return [row | (compare.errors(film, truth, h, at) if film.good() else {})]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with: of steps of 1 ms."""
  lines = []
  for where, what in (("press", "force"), ("vibrate", "position")):
    mine = [r for r in rows if r["scene"] == where and abs(r["h"] - 1e-3) < 1e-9]
    told = []
    for r in mine:
      keys = ("force_rms_start", "force_rms_end") if what == "force" else ("position_rms",)
      told.append(f"{r['scheme']} {100 * min(r[key] for key in keys):.2g} %")
    if told:
      lines.append(f"`{where}` at 1 ms, {what} error: {', '.join(told)}.")
  return [*lines, "TR-BDF2 takes two solves a step, the others one."]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Draws the picture and writes the page."""
  rows = [row for row in rows if row["scheme"] != ""]
  figure, axes = plots.grid(1, 2, width=8.6, height=3.8)
  lines = [str(__doc__).partition("\n\n")[2]]
  lines += ["", "Errors in % of the reference's peak: contact force, taken for that of the better "
            "end of its step, or positions. TR-BDF2 has two solves a step.", ""]  # fmt: skip
  table = []
  keys = {"press": "force_rms", "vibrate": "position_rms"}
  for ax, where in zip(axes, dict.fromkeys(row["scene"] for row in rows), strict=False):
    key = keys[where]
    for name, colour in COLOURS.items():
      mine = [r for r in rows if (r["scene"], r["scheme"]) == (where, name) and r[key] != ""]
      value = [100 * (min(r["force_rms_start"], r["force_rms_end"]) if where == "press" else r[key])
               for r in mine]  # fmt: skip
      ax.plot([r["solves"] for r in mine], value, "o-", ms=4, color=colour, label=name)
      order = error.order(mine, key, most=1.01e-3)
      table.append([where, name, *(f"{v:.3g}" for v in value), f"{order:.2f}"])
    ax.set(xscale="log", yscale="log", xlabel="linear solves")
    ax.set_ylabel(f"{where}: {key.split('_')[0]} error, RMS [% of peak]", fontsize=9)
    plots.plain(ax.xaxis, 2)
    plots.plain(ax.yaxis, 2)
  axes[0].legend(frameon=False, fontsize=8)
  head = ["scene", "scheme", *(f"{1e3 * h:g} ms" for h in HS), "order, h <= 1 ms"]
  lines += [*plots.table(head, table), ""]
  picture = plots.save(figure, out / "second_order.png", "Below and left is better")
  page = out / "second_order.md"
  title = "Schemes of second order, in float64"
  return [picture, results.page(page, title, about, lines, finding(rows), picture)]


BENCH = Bench("second_order", stages, run, _COLUMNS, report,
              folder="development")  # fmt: skip
