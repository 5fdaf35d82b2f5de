"""Forces of tissue against closed forms, another library's finite elements, and measurements.

Each row is our force over the reference, with the error in percent.

- A sphere presses a solid block without friction, as `palpate fit` simulates it. The references are
  Hertz's half space with the correction for a layer that is bonded at its bottom (Dimitriadis et
  al. 2002, doi:10.1016/S0006-3495(02)75620-8, eq. 14) and fine quadratic finite elements of
  scikit-fem at small strains. `edges` is the radius of the contact in edges of triangles.
- Closed forms of a bar and of Lame's hollow sphere, and a clamped beam by scikit-fem. The clamp
  hinders the beam's sides, by which it sags 2 to 8 % less than Timoshenko's.
- Organs, solids and shipped skins, under the shipped 5 mm probe, whose end and the surface, 1 mm
  thick, meet as a sphere of 3.5 mm. The reference is a solid of the measured modulus with edges of
  1.5 mm under such a sphere, equally deep from the first touch; by the rows above it is right
  within some 5 %.
- `mesh`: the shipped skins with fewer triangles, even or `fine` under the probe, over 16,000 nodes,
  with contacts as firm as those of `fine`; and as they ship, with `subgrid="true"`.
- `small`: a ball on a block, over Hertz's layer, and on a skin with a foundation and
  `subgrid="true"`, over the closed form of a plate on a foundation (`reference/plates.py`), on a
  node and between nodes. The last rows are its largest force over the smallest while it slides over
  an edge, equally deep and without friction.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import pathlib
from collections.abc import Mapping

import numpy as np
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate import models, register
from palpate.app.console import CommandError
from palpate.models import catalog
from reference import closed, plates

YOUNG, POISSON = 5000.0, 0.45
SIZE, RADIUS = (0.08, 0.08, 0.04), 0.04  # of the block and the sphere [m]
# [m]; a 300th to an 80th of the radius: where it is a tenth, a neo-Hookean solid has 3 to 5 % less
# force than Hertz's, on fine meshes too.
DEPTHS = (1.25e-4, 2.5e-4, 5e-4)
EDGES = (1.0, 2.0, 3.0, 4.0)  # in the contact's radius at the middle depth
SMALL = (0.25, 0.5, 1.0, 2.0)  # the same, of a contact that is small for the mesh
PLACES = {"on a node": (1, 0, 0), "on an edge": (0.5, 0.5, 0), "between nodes": (1 / 3,) * 3}
PROBE = 0.0035  # [m], the radius of the shipped probe and of the flexes
FINE = 0.0015  # edges of the organs that are the reference [m]
NODES = 1000  # of the others
FLEX = 0.0005  # radius of the flex under the small ball [m]
SUBGRID = {"subgrid": "true"}
SKIN = {"thickness": 0.002, "foundation": 2e5, "mass": 0.05} | SUBGRID  # under it
SHIPPED = {
  "skin on foundation": {},
  "skin on foundation, 3 mm under the probe": {"coupling": "window", "fine": 3e-3},
  "solid, even triangles": {"coupling": "window", "interior": "solid"},
  "solid, 3 mm under the probe": {"coupling": "window", "interior": "solid", "fine": 3e-3},
}
# Foundations with which skins push as hard as a solid of their Young's modulus does [Pa/m].
AS_SOLID = {"liver": 3e4, "kidney": 8e4}
ORGAN_DEPTHS = (2e-3, 4e-3)  # of the probe's tip under the vertices [m]
# Nodes, and edges under the probe [m] or None for even triangles; the last is the reference.
MESHES = ((250, None), (1000, None), (4000, None), (1000, 3e-3), (1000, 2e-3), (16000, None))
ALLOWED = {"hertz": 3.0, "elements": 3.0, "bar": 3.0, "cantilever": 5.0, "lame": 5.0, "mesh": 5.0,
           "organ": 10.0, "small": 5.0}  # fmt: skip
_COLUMNS = ("kind", "what", "edges", "nodes", "depth_mm", "reference", "ours", "unit", "error")

# What was published and what stands in the way of a row above: (source, what it has, why not).
PUBLISHED = (
  ("Truth Cube, Kerdok et al. 2003, doi:10.1016/s1361-8415(03)00008-2; page "
   "biorobotics.harvard.edu/truthcube, no licence seen",
   "silicone cube of 80 mm: 798 N/m by indentation, 780 with beads; displacements at 5, 12.5 and "
   "18.25 % of compression, and under a sphere of 25.4 mm at 22 and 36 %",
   "no indenter of the 798 N/m, no force of the others, no Young's modulus on the page"),
  ("PMC6925591, table 1 (author's manuscript)",
   "shear moduli: pig liver 1.8 (0.4) kPa, gallbladder 85 (8.2), stomach 0.64",
   "the catalogue's constants are these; they are no forces"),
  ("Johnson et al. 2020, J Biomech, abstract", "pig gallbladder in tension at 500 %/s: modulus "
   "9.03 MPa, failure at 1.83 MPa", "37 times the catalogue's modulus, which is quasistatic: "
   "no organ of the catalogue is meant for such rates"),
  ("Johnson et al. 2021, doi:10.3390/biomechanics1020022, CC BY",
   "pig kidney and liver, compressed, and probed by a flat tip of 4.9 mm",
   "the tables could not be read here"),
  ("Gao et al. 2010, PMC2822045", "pig liver in tension, Ogden's constants of ten samples",
   "the table could not be read here"),
  ("Kerdok et al. 2006, doi:10.1016/j.jbiomech.2005.07.005",
   "perfused pig liver: creep under 6.9 to 34.7 kPa, strains up to 50 %, over 1.86 and 51.3 s",
   "the abstract has no force at a depth; the figures could not be read here"),
  ("Samur et al. 2007, doi:10.1016/j.media.2007.04.001, hal-03177346",
   "pig liver in vivo, force at a depth", "the figures could not be read here"),
  ("\"Biomechanical and microstructural characterisation of the porcine stomach wall\", Acta "
   "Biomaterialia 2020, abstract",
   "wall in biaxial tension, greatest stresses: corpus 201.5, antrum 73.1, fundus 26.6 kPa along, "
   "15.7, 39.7, 26.2 kPa around", "the stretches that they belong to could not be read here"),
  ("\"Regional differences in stomach stretch during organ filling\", 2024, abstract",
   "pig stomach at 3.5 l: strains around of 13.2 % (antrum), 22 % (corpus), 67.8 % (fundus), the "
   "corpus then beyond 400 kPa", "the pressure could not be read here"),
  ("Indentation with large relaxation, PMC7595329", "kidney, spleen and liver, poroelastic",
   "the tables could not be read here; no fluid flows through ours"),
  ("Capilnasiu et al. 2020, doi:10.1007/s10237-020-01297-5, CC BY",
   "cattle's liver in large oscillating shear, 1 to 50 %", "the constants could not be read here"),
  ("Rosen et al. 2008, J Biomech Eng", "seven pig organs in a grasper, stress and strain",
   "the fits could not be read here"),
  ("Malik et al. 2022, doi:10.1371/journal.pone.0268608, CC BY", "pig organs in and ex vivo",
   "the data files could not be had here"),
  ("Zhang et al. 2024, doi:10.1371/journal.pone.0307778, CC BY", "pig kidney cortex in tension",
   "the data files could not be had here"),
  ("Mishra and Cleveland 2024, doi:10.3389/fbioe.2024.1386955, CC BY",
   "pig liver and kidney in shear, 0.1 to 9.5 Hz at 0.1 %", "the tables could not be read here"),
)  # fmt: skip


def begin(args: argparse.Namespace):
  """Raises CommandError where the other library is missing."""
  if importlib.util.find_spec("skfem") is None:
    raise CommandError("scikit-fem is not installed: pip install 'palpate[bench]'", code=1)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns the cases, the slow ones first."""
  cases: list[Case] = []
  if not args.short:
    cases += [
      {"case": f"mesh {name} {contact}", "kind": "mesh", "organ": name, "contact": contact}
      for name in ("liver", "kidney")
      for contact in ("firm", "subgrid")
    ]
    cases += [
      {"case": f"organ {name}", "kind": "organ", "organ": name} for name in ("liver", "kidney")
    ]
  cases += [
    {"case": f"small {kind} {edges:g}", "kind": "small", "tissue": kind, "edges": edges}
    for kind in ("solid", "skin")
    for edges in ((0.5,) if args.short else SMALL)
  ]
  cases += [
    {"case": f"press {edges:g}", "kind": "press", "edges": edges}
    for edges in (EDGES[:1] if args.short else EDGES[::-1])
  ]
  nus = (0.45,) if args.short else (0.3, 0.45, 0.49)
  cases += [{"case": f"bar {nu}", "kind": "bar", "nu": nu} for nu in nus]
  spacings = (0.02,) if args.short else (0.02, 0.01, 0.00667)
  cases += [
    {"case": f"cantilever {nu} {spacing}", "kind": "cantilever", "nu": nu, "spacing": spacing}
    for nu in nus
    for spacing in spacings
  ]
  levels = (2,) if args.short else (3, 4)
  cases += [
    {"case": f"lame {nu} {level}", "kind": "lame", "nu": nu, "level": level}
    for nu in nus
    for level in levels
  ]
  return [cases]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the rows of a case."""
  register()
  if case["kind"] == "press":
    return _press(case["edges"])
  if case["kind"] == "organ":
    return _organ(case["organ"])
  if case["kind"] == "small":
    return _small(case["tissue"], case["edges"])
  if case["kind"] == "mesh":
    return _meshes(case["organ"], case["contact"])
  if case["kind"] == "bar":
    found = closed.bar(case["nu"])[:2]
    what = f"bar in tension, nu {case['nu']}: strain", ""
  elif case["kind"] == "cantilever":
    from reference import elements

    ours = closed.cantilever(case["nu"], case["spacing"])[0]
    bar = closed.LENGTH, closed.SIDE, closed.LOAD, closed.YOUNG
    found = ours, elements.cantilever(*bar, case["nu"], 0.004)
    across = round(closed.SIDE / case["spacing"])
    what = f"cantilever of {across} elements across, nu {case['nu']}: sag", "m"
  else:
    found = closed.hollow_sphere(case["nu"], case["level"])
    what = f"Lame's hollow sphere, level {case['level']}, nu {case['nu']}: growth", "m"
  return [_row(case["kind"], what[0], *found, what[1])]


def _row(kind: str, what: str, ours: float, reference: float, unit: str, **more) -> Row:
  error = 100 * (ours / reference - 1)
  blank = {"edges": "", "nodes": "", "depth_mm": ""}
  row = {"kind": kind, "what": what, "reference": reference, "ours": ours, "unit": unit}
  return blank | row | {"error": error} | more


def held(test, depths) -> tuple[np.ndarray, int]:
  """Returns the force of a test held at these depths [N], (ndepth,), and its nodes."""
  from palpate.app.fit.indentation import Indentation
  from palpate.app.fit.measured import Record

  go, stay = 0.1, 0.15  # [s]
  time, depth = [0.0], [0.0]
  for each in depths:
    time += [time[-1] + go, time[-1] + go + stay]
    depth += [each, each]
  times = np.array(time)
  sim = Indentation(test, Record(times, np.array(depth), np.ones_like(times)))
  return sim.force({"young": YOUNG, "poisson": POISSON, "damping": 0.005})[2::2], sim.nodes


def _press(edges: float) -> list[Row]:
  """Returns rows of the block, against the closed form and the finite elements."""
  from palpate.app.fit.indentation import Test
  from reference import elements

  edge = math.sqrt(RADIUS * DEPTHS[1]) / edges
  ours, nodes = held(Test("sphere", RADIUS, SIZE, edge=edge, step=0.002), DEPTHS)
  width = math.sqrt(SIZE[0] * SIZE[1] / math.pi)  # of a round block of the same area
  exact = elements.layer(SIZE[2], width, RADIUS, DEPTHS, YOUNG, POISSON, 2.5e-4)
  rows = []
  for depth, force, fine in zip(DEPTHS, ours, exact, strict=True):
    more = {"edges": math.sqrt(RADIUS * depth) / edge, "nodes": nodes, "depth_mm": 1e3 * depth}
    theory = hertz(RADIUS, depth, SIZE[2])
    rows.append(_row("hertz", "sphere on a block, Hertz", float(force), theory, "N", **more))
    what = "sphere on a block, scikit-fem"
    rows.append(_row("elements", what, float(force), float(fine), "N", **more))
  return rows


def _small(kind: str, edges: float) -> list[Row]:
  """Returns rows of a ball whose contact's radius is `edges` edges, and of its sliding."""
  edge = 0.008
  depth = (edges * edge) ** 2 / RADIUS
  radius = RADIUS + FLEX
  if kind == "skin":
    rigidity = YOUNG * SKIN["thickness"] ** 3 / (12 * (1 - POISSON**2))
    reference = plates.ball(radius, depth, SKIN["foundation"], rigidity)
  else:
    reference = hertz(radius, depth, SIZE[2])
  rows, more = [], {"edges": edges, "depth_mm": round(1e3 * depth, 3)}
  for place, at in PLACES.items():
    force, nodes, _ = _touched(kind, edge, depth, at)
    what = f"ball on a {kind}, {place}"
    rows.append(_row("small", what, force, reference, "N", nodes=nodes, **more))
  _, nodes, slid = _touched(kind, edge, depth, (1, 0, 0), slides=edge)
  what = f"ball sliding on a {kind}, greatest force over least"
  return [*rows, _row("small", what, slid.max() / slid.min(), 1.0, "", nodes=nodes, **more)]


def _touched(kind: str, edge: float, depth: float, at, slides: float = 0.0):
  """Returns the force of a ball at a depth [N], nodes, and forces where it slides on from there."""
  import mujoco
  import palpate
  from palpate.models.block import box

  points, elem = box(SIZE, edge)
  top = points[:, 2].max()
  upper = elem[(points[elem][:, :, 2] > top - 1e-6).all(axis=1)]
  middle = upper[np.argmin(np.linalg.norm(points[upper].mean(axis=1)[:, :2], axis=1))]
  x, y = (np.array(at) @ points[middle])[:2]
  keys = {"elements": "solid", "mass": 0.25, "pin": np.flatnonzero(points[:, 2] < 1e-6 - top)}
  if kind == "skin":
    kept, elem = np.unique(upper, return_inverse=True)
    points, elem = points[kept], elem.reshape(-1, 3)
    keys = SKIN
  drive = '<position joint="z" kp="2e4" kv="200"/><position joint="x" kp="2e4" kv="200"/>'
  spec = mujoco.MjSpec.from_string(f"""<mujoco><option gravity="0 0 0" timestep="0.001"
    integrator="implicitfast" cone="elliptic"/><size memory="1G"/><worldbody>
    <body name="tool" pos="{x} {y} {top + RADIUS + FLEX}">
    <joint name="z" type="slide" axis="0 0 1"/><joint name="x" type="slide" axis="1 0 0"/>
    <geom size="{RADIUS}" mass="0.5" condim="1"/></body></worldbody>
    <actuator>{drive}</actuator></mujoco>""")
  keys |= {"young": YOUNG, "poisson": POISSON, "damping": 0.005, "tolerance": 1e-5}
  how = {"radius": FLEX, "contact": {"condim": 1}, "windows": {"nodes": 300}, "device": "cpu"}
  palpate.add_organ(spec, (points, elem), "organ", **keys, **how)
  data = mujoco.MjData(spec.compile())
  force, slid, last = 0.0, [], 700 + round(slides / 2e-5)
  for k in range(last):
    data.ctrl[:] = -depth * min(1, k / 300), max(0, k - 700) * 2e-5
    mujoco.mj_step(data.model, data)
    force = float(data.joint("z").qfrc_constraint[0])
    slid += [force] if k >= 700 else []
  return force, len(points), np.array(slid)


def hertz(radius: float, depth: float, height: float) -> float:
  """Returns the force on a sphere in a layer that is bonded at its bottom [N]."""
  a0 = -(1.2876 - 1.4678 * POISSON + 1.3442 * POISSON**2) / (1 - POISSON)
  b0 = (0.6387 - 1.0277 * POISSON + 1.5164 * POISSON**2) / (1 - POISSON)
  x, pi = math.sqrt(radius * depth) / height, math.pi
  factor = 1 - 2 * a0 / pi * x + 4 * a0**2 / pi**2 * x**2
  factor -= 8 / pi**3 * (a0**3 + 4 * pi**2 / 15 * b0) * x**3
  factor += 16 * a0 / pi**4 * (a0**3 + 3 * pi**2 / 5 * b0) * x**4
  return factor * 4 / 3 * YOUNG / (1 - POISSON**2) * math.sqrt(radius * depth**3)


def _organ(name: str) -> list[Row]:
  """Returns rows of an organ as it ships and filled, against a solid that is fine at the probe."""
  from palpate.app.fit.indentation import Test

  place = catalog.entry(name).ports[0].landmark
  test = Test("sphere", PROBE, organ=name, place=place, edge=FINE, step=5e-4)
  presses = {what: _shipped(name, NODES, **how) for what, how in SHIPPED.items()}
  softer = f"skin, foundation {AS_SOLID[name]:g} Pa/m, 3 mm under the probe"
  presses[softer] = _shipped(
    name, NODES, False, {"foundation": f"{AS_SOLID[name]:g}"}, coupling="window", fine=3e-3
  )
  depth = {what: np.array([p.depth + p.touch for p in mine]) for what, mine in presses.items()}
  mean = np.mean(list(depth.values()), axis=0)
  fine, rows = _solid(test, name, mean), []
  for what, mine in presses.items():
    exact = fine * (depth[what] / mean) ** 1.5  # they differ by some 0.02 mm
    for press, d, reference in zip(mine, depth[what], exact, strict=True):
      more = {"nodes": NODES, "depth_mm": round(1e3 * d, 2)}
      rows.append(_row("organ", f"{name}, {what}", press.force, float(reference), "N", **more))
  return rows


def _solid(test, name: str, depths: np.ndarray) -> np.ndarray:
  """Returns the force on a probe that is held in a solid of the catalogue's constants [N]."""
  from palpate.app.fit.indentation import Indentation
  from palpate.app.fit.measured import Record

  go, stay = 0.2, 0.2
  time, depth = [0.0], [0.0]
  for each in depths:
    time += [time[-1] + go, time[-1] + go + stay]
    depth += [each, each]
  sim = Indentation(test, Record(np.array(time), np.array(depth), np.ones(len(time))))
  tissue = catalog.TISSUES[name]
  keys = {"young": tissue.young, "poisson": tissue.poisson, "damping": tissue.damping}
  return sim.force(keys)[2::2]


def _meshes(name: str, contact: str) -> list[Row]:
  """Returns rows of an organ's skin by its mesh, over that of the last one."""
  firm, keys = contact == "firm", SUBGRID if contact == "subgrid" else None
  meshes = [(nodes, fine) for nodes, fine in MESHES if firm or not fine]
  *forces, finest = [
    [press.force for press in _shipped(name, n, firm, keys, coupling="window", fine=fine)]
    for n, fine in meshes
  ]
  rows = []
  for (nodes, fine), ours in zip(meshes, forces, strict=False):
    under = f"{1e3 * fine:g} mm under the probe" if fine else "even"
    for depth, force, reference in zip(ORGAN_DEPTHS, ours, finest, strict=True):
      what = f"{name}, skin, contacts {contact}, triangles {under}"
      rows.append(_row("mesh", what, force, reference, "N", nodes=nodes, depth_mm=1e3 * depth))
  return rows


def _shipped(
  name: str, nodes: int, firm: bool = False, keys: Mapping[str, str] | None = None, **how
) -> list:
  """Returns presses by the shipped probe to the depths; `keys` are set in the configuration."""
  from palpate.models import measure

  spec = models.load(name, nodes=nodes, **how)
  for flex in spec.flexes if firm else ():
    flex.solimp[:3] = 0.99, 0.999, 1e-4
  for plugin in spec.plugins if keys else ():
    plugin.config = dict(plugin.config) | dict(keys or {})
  model = spec.compile()
  return [measure.press(model, name, depth) for depth in ORGAN_DEPTHS]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for kinds, what in ((("hertz", "elements"), "a sphere on a solid block"),
                      (("bar", "cantilever", "lame"), "closed forms of solids"),
                      (("organ",), "organs under the 5 mm probe")):  # fmt: skip
    mine = [r for r in rows if r["kind"] in kinds]
    if mine:
      errors = sorted(abs(r["error"]) for r in mine)
      inside = sum(abs(r["error"]) <= ALLOWED[r["kind"]] for r in mine)
      lines.append(f"{what[0].upper()}{what[1:]}: the median error is "
                   f"{errors[len(errors) // 2]:.2g} %, {inside} of {len(mine)} cases are within "
                   f"{' to '.join(sorted({f'{ALLOWED[k]:g}' for k in kinds}))} %.")  # fmt: skip
  return lines


def draw(rows: list[Row], out: pathlib.Path) -> pathlib.Path:
  """Draws the median and the largest error of each kind of case."""
  errors = {kind: sorted(abs(r["error"]) for r in rows if r["kind"] == kind) for kind in ALLOWED}
  errors = {kind: found for kind, found in errors.items() if found}
  groups = {
    "median": [found[len(found) // 2] for found in errors.values()],
    "largest": [found[-1] for found in errors.values()],
  }
  title = "Errors of forces and shapes"
  return plots.bars(out / "truth.png", title, list(errors), groups, "error [%]")


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page."""
  lines = [str(__doc__).partition("\n\n")[2], ""]
  head = ["", "edges", "nodes", "depth [mm]", "reference", "ours", "error [%]", ""]
  for kind, most in ALLOWED.items():
    mine = [r for r in rows if r["kind"] == kind]
    mine.sort(key=lambda r: (r["what"], str(r["nodes"])))
    if not mine:
      continue
    table = []
    for r in mine:
      verdict = "" if abs(r["error"]) <= most else f"outside of {most:g} %"
      numbers = [f"{r[key]:.3g} {r['unit']}" for key in ("reference", "ours")]
      edges = f"{r['edges']:.1f}" if r["edges"] != "" else ""
      cells = [r["what"], edges, r["nodes"], r["depth_mm"], *numbers, f"{r['error']:+.1f}", verdict]
      table.append(cells)
    outside = sum(abs(r["error"]) > most for r in mine)
    lines += [f"## {kind}: {outside} of {len(mine)} outside of {most:g} %", ""]
    lines += [*plots.table(head, table), ""]
  lines += ["## Measurements that are no rows above", ""]
  lines += [*plots.table(["source", "what it has", "why"], PUBLISHED), ""]
  lines += [results.link(path)]
  title = "Forces against theory, other finite elements, measurements"
  return results.Page(title, finding(rows), lines, [draw(rows, path.parent)])


BENCH = Bench("truth", stages, run, columns=_COLUMNS, report=report, begin=begin)
