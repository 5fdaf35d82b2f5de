"""Second-order schemes in float64 beside the implicit step, coupled to MuJoCo as the plugin is.

  python second_order.py -o FOLDER    writes second_order.csv, .md and .png

Implicit Euler, the plugin's `midpoint`, BDF2 and TR-BDF2, each linearly implicit with exact solves,
on the press and the free vibration of `palpate bench error`, 162 nodes. A scheme hands MuJoCo the
velocity that moves x to where it wants it, (x1 - x) / h, and keeps what it needs of the past. The
contact force is that of the last step, corrected by the effective inertia, as in
`palpate.coupling`.
"""

import argparse
import csv
import pathlib

import mujoco
import numpy as np
from benchmarks import error, plots, runner, scene
from palpate.engine import inertia
from palpate.tissue import shape as surface
from palpate.tissue import types
from reference import exact
from scipy import sparse
from scipy.sparse import linalg

ABOUT = str(__doc__)

NODES = 162
SOLVES = {"implicit": 1, "midpoint": 1, "BDF2": 1, "TR-BDF2": 2}
COLOURS = {"implicit": "#08519c", "midpoint": "#000000", "BDF2": "#c1442e", "TR-BDF2": "#2ca02c"}
HS = error.H[1:6]  # [s]
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


def _inertia(scheme: Scheme, film: error._Film) -> np.ndarray:
  """Returns what the scheme makes a contact meet at each node [kg], (nvert,)."""
  mesh, config = film.mesh, scheme.elastic.config
  free = np.ones(mesh.nvert, bool)
  s = surface.make(mesh, config, ~free, "cpu")
  state = types.make_state(s)
  state.mass.fill_(1.0)
  mass = scheme.mass[:, 0] * scheme.share
  gain = scheme.gain * scheme.share
  return inertia.effective_inertia(s, state, mesh, mass, free, scheme.h, scene.PROBE, gain)


def run(name: str, where: str, h: float) -> error._Film:
  """Runs a scheme on a scene of the error bench."""
  case = {"scene": where, "nodes": NODES, "elements": "membrane"}
  model = error._build(case, "passive", h, solver="Newton", mj_tolerance=1e-10)
  film = error._Film(case, model)
  dofs = film.state.dofs
  mass = model.body_mass[model.dof_bodyid[dofs[:, 0]]]
  scheme = Scheme(name, exact.Elastic(film.mesh, error._config("membrane")), mass, h)
  meets = _inertia(scheme, film)
  model.dof_armature[dofs] = (meets - mass)[:, None]
  weights = model.dof_invweight0.copy(), model.body_invweight0.copy()
  mujoco.mj_setConst(model, mujoco.MjData(model))
  model.dof_invweight0[:], model.body_invweight0[:] = weights
  now = {"f": np.zeros_like(film.mesh.rest)}

  def passive(_, data):
    x, v = data.qpos[dofs].copy(), data.qvel[dofs].copy()
    to, end = scheme.step(x, v, now["f"])
    data.qfrc_passive[dofs] += meets[:, None] * (to - v) / h - now["f"]
    now.update(x=x, v=v, to=to, end=end)

  def after():
    scheme.moved(now["x"], now["v"], now["end"], film.data.qvel[dofs] - now["to"])
    now["f"] = film.data.qfrc_constraint[dofs].copy()

  mujoco.set_mjcb_passive(passive)
  try:
    film.move(film.script.duration, after=after)
  finally:
    mujoco.set_mjcb_passive(None)
  return film


def measure(out: pathlib.Path) -> list[dict]:
  """Returns a row for every scheme, scene and time step; references go to `out`."""
  rows = []
  for where in ("press", "vibrate"):
    case = {"scene": where, "nodes": NODES, "elements": "membrane", "kind": "reference"}
    for level in (2, 1):
      error._reference(case | {"level": level}, out)
    truth = error._truth(out, where, NODES, "membrane")
    for name in SOLVES:
      for h in HS:
        film = run(name, where, h)
        row = {"scene": where, "scheme": name, "h": h, "finite": int(film.good())}
        row["solves"] = SOLVES[name] * film.n
        at = error.FORCE_AT.get(name, "start")
        row |= error._errors(film, truth, h, at) if film.good() else {}
        rows.append(row)
        print({k: f"{v:.3g}" if isinstance(v, float) else v for k, v in row.items()}, flush=True)
  return rows


def report(rows: list[dict], out: pathlib.Path):
  """Writes CSV, picture and page."""
  columns = list(dict.fromkeys(key for row in rows for key in row))
  with open(out / "second_order.csv", "w", newline="", encoding="utf-8") as file:
    writer = csv.DictWriter(file, columns, restval="")
    writer.writeheader()
    writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in r.items()}
                     for r in rows)  # fmt: skip
  figure, axes = plots.grid(1, 2, width=8.6, height=3.8)
  about = runner.machine() | {"cases": len(rows), "done": len(rows)}
  lines = ["# Schemes of second order, in float64", "", runner.caption(about), ""]
  lines += ["    python tests/benchmarks/second_order.py -o FOLDER", "", ABOUT.split("\n\n")[2]]
  lines += ["", "Errors in % of the reference's peak: contact force, taken for that of the better "
            "end of its step, or positions. TR-BDF2 has two solves a step.", ""]  # fmt: skip
  table = []
  for ax, where, key in ((axes[0], "press", "force_rms"), (axes[1], "vibrate", "position_rms")):
    for name, colour in COLOURS.items():
      mine = [r for r in rows if r["scene"] == where and r["scheme"] == name]
      mine = [r for r in mine if r.get(key, "") != ""]
      value = [100 * (min(r["force_rms_start"], r["force_rms_end"]) if where == "press" else r[key])
               for r in mine]  # fmt: skip
      ax.plot([r["solves"] for r in mine], value, "o-", ms=4, color=colour, label=name)
      order = error.order(mine, key, most=1.01e-3)
      table.append([where, name, *(f"{v:.3g}" for v in value), f"{order:.2f}"])
    ax.set(xscale="log", yscale="log", xlabel="linear solves")
    ax.set_ylabel(f"{where}: {key.split('_')[0]} error, RMS [% of peak]", fontsize=9)
    plots.plain(ax.xaxis, 2)
    plots.plain(ax.yaxis, 2)
  axes[1].legend(frameon=False, fontsize=8)
  head = ["scene", "scheme", *(f"{1e3 * h:g} ms" for h in HS), "order, h <= 1 ms"]
  lines += [*plots.table(head, table), ""]
  plots.save(figure, out / "second_order.png", "Below and left is better")
  (out / "second_order.md").write_text("\n".join(lines), encoding="utf-8")


def main():
  """Runs all and writes the files."""
  parser = argparse.ArgumentParser(description=ABOUT.splitlines()[0])
  parser.add_argument("-o", "--out", type=pathlib.Path, default=pathlib.Path("out", "bench"))
  parser.add_argument("--draw", action="store_true", help="only draw the rows there are")
  args = parser.parse_args()
  args.out.mkdir(parents=True, exist_ok=True)
  runner.register_quietly()
  rows = runner.read(args.out / "second_order.csv") if args.draw else measure(args.out)
  report(rows, args.out)


if __name__ == "__main__":
  main()
