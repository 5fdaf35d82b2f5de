"""What a thread's configuration and shape make of its stiffness; see `native/tissue/rod.h`."""

import numpy as np

from .config import Config

LONGEST = 2.0  # of the mean edge, what edges become where nodes move along a thread


def check_edges(name: str, length: np.ndarray, radius: float):
  """Raises ValueError where an edge is shorter than the radius."""
  if length.min() < radius:
    k = int(length.argmin())
    raise ValueError(
      f"thread {name!r}: edge {k} is {1e3 * length[k]:.3g} mm long and radius is "
      f"{1e3 * radius:.3g} mm, expected edges no shorter than the radius"
    )


def check_refine(name: str, config: Config, length: np.ndarray, radius: float, clamped):
  """Raises ValueError where nodes are to move along a thread, and cannot."""
  refine, mean = config.refine, length.mean()
  if not refine:
    return
  what = f"thread {name!r}: refine is {1e3 * refine:.3g} mm and"
  if not radius <= refine < mean:
    raise ValueError(
      f"{what} its edges are {1e3 * mean:.3g} mm long, expected shorter ones, and no shorter than "
      f"the radius, {1e3 * radius:.3g} mm"
    )
  if len(config.young) > 1:
    raise ValueError(f"{what} young has {len(config.young)} values, expected one")
  if config.yield_strain:
    raise ValueError(f"{what} yield_strain is {config.yield_strain:g}, expected 0")
  if any(clamped):
    raise ValueError(
      f"{what} edge {int(np.argmax(clamped))} is between two pinned nodes, expected none next to "
      "each other"
    )


def check_apart(name: str, x: np.ndarray, radius: float, between: float, core: float):
  """Raises ValueError where edges that are no neighbours begin nearer than can be.

  Args:
    name: of the thread
    x: nodes [m]                                                         (nnode, 3)
    radius: of the thread [m]
    between: length of thread between edges that are no neighbours [m]
    core: least distance of their centre lines [m]
  """
  edge = np.diff(x, axis=0)
  length = np.linalg.norm(edge, axis=1)
  along = np.append(0.0, np.cumsum(length))
  i, j = np.triu_indices(len(edge), 2)
  middle = 0.5 * (x[1:] + x[:-1])
  near = along[j] - along[i + 1] >= between
  near &= np.linalg.norm(middle[i] - middle[j], axis=1) < core + 0.5 * (length[i] + length[j])
  i, j = i[near], j[near]
  # As `nearest` in native/tissue/rod_contact.h.
  p, d, q, e = x[i], edge[i], x[j], edge[j]
  r = p - q
  a, b, c = ((u * v).sum(axis=1) for u, v in ((d, d), (d, e), (e, e)))
  f, g = (e * r).sum(axis=1), (d * r).sum(axis=1)
  det = np.maximum(a * c - b * b, 1e-9 * a * c)
  t = np.clip((b * np.clip((b * f - g * c) / det, 0, 1) + f) / c, 0, 1)
  s = np.clip((b * t - g) / a, 0, 1)
  far = np.linalg.norm(r + s[:, None] * d - t[:, None] * e, axis=1)
  if far.min(initial=np.inf) <= core:
    k = int(far.argmin())
    raise ValueError(
      f"thread {name!r}: edges {i[k]} and {j[k]} start {1e3 * far[k]:.3g} mm from each other and "
      f"radius is {1e3 * radius:.3g} mm, expected a thread that does not intersect itself"
    )


def tension(constants: dict, x: np.ndarray, broken: np.ndarray) -> np.ndarray:
  """Returns the tension of the edges [N], (nnode - 1,).

  Args:
    constants: see `constants`
    x: places [m]                      (nnode, 3)
    broken: whether an edge has broken (nnode - 1,) bool
  """
  length = np.linalg.norm(np.diff(x, axis=0), axis=1)
  stretch = np.where(broken, 0.0, constants["stretch"][:-1])
  return (stretch * (length - constants["length"][:-1])).astype(float)


def energy(
  constants: dict, x: np.ndarray, twist: np.ndarray, rest: np.ndarray, broken: np.ndarray
) -> float:
  """Returns the elastic energy [J].

  Args:
    constants: see `constants`
    x: places [m]                      (nnode, 3)
    twist: at each node [rad]          (nnode,)
    rest: curvature at rest [-]        (nnode, 3)
    broken: whether an edge has broken (nnode - 1,) bool
  """
  edge = np.diff(x, axis=0)
  length = np.linalg.norm(edge, axis=1)
  stretched = 0.5 * tension(constants, x, broken) * (length - constants["length"][:-1])
  e, f = edge[:-1], edge[1:]
  chi = length[:-1] * length[1:] + (e * f).sum(axis=1)
  off = np.cross(e, f) - 0.5 * chi[:, None] * rest[1:-1]
  curvature2 = 4 * (off**2).sum(axis=1) / chi**2
  bent = 0.5 * np.where(broken[1:] | broken[:-1], 0.0, constants["bend"][1:-1]) * curvature2
  return float(stretched.sum() + bent.sum() + 0.5 * (constants["torsion"] * twist**2).sum())


def constants(
  length: np.ndarray, radius: float, config: Config, mass: np.ndarray, clamped: np.ndarray
) -> dict:
  """Returns the constants of a rod of round section.

  A = pi r^2, I = pi r^4 / 4, J = 2 I, G = E / (2 (1 + poisson)); bending and twisting have factors
  of their own, since the fibres of a braid slide on each other.

  Args:
    length: of each edge at rest [m]  (nnode - 1,)
    radius: of the section [m]
    config: its configuration
    mass: of each node [kg]           (nnode,)
    clamped: whether an edge is rigid (nnode - 1,) bool

  Returns:
    fields of the native struct by name
  """
  n = len(length) + 1
  young = np.broadcast_to(np.asarray(config.young, float), (n - 1,))
  area, second = np.pi * radius**2, np.pi * radius**4 / 4
  half = np.where(clamped, 0.0, 0.5 * length)
  at = half[1:] + half[:-1]  # what belongs to a node inside
  at[at == 0.0] = np.inf  # between rigid edges
  node_young = 0.5 * (young[1:] + young[:-1])
  shear = node_young / (2 * (1 + config.poisson))
  bend, torsion, along = np.zeros(n), np.zeros(n), np.append(0.0, np.cumsum(length))
  most_bent = np.zeros(n)
  bend[1:-1] = config.bend * node_young * second / at
  torsion[1:-1] = config.twist * shear * 2 * second / at
  most_bent[1:-1] = config.yield_strain / radius * at
  return {
    "nnode": n,
    # Else nothing holds a twist; but a bend that is kept turns with the thread.
    "twists": int((config.twist > 0 and clamped.sum() > 1) or config.yield_strain > 0),
    "yields": int(config.yield_strain > 0),
    "shortest": float(length.min()),
    "longest": max(float(length.max()), bool(config.refine) * LONGEST * float(length.mean())),
    "length": np.append(length, 0.0),
    "along": along,
    "drawn": along,
    "refine": config.refine,
    "mean": float(along[-1] / n),
    "axial": float(young[0] * area),
    "flexural": float(config.bend * young[0] * second),
    "viscous": config.drag,
    "stretch": np.append(young * area / length, 0.0),
    "drag": config.drag * 0.5 * (np.append(length, 0.0) + np.append(0.0, length)),
    "bend": bend,
    "torsion": torsion,
    "most_bent": most_bent,
    "spin": np.append(0.25 * (mass[1:] + mass[:-1]), 1.0) * radius**2,
  }
