"""The organ's forces and implicit step in float64, written independently of the kernels.

Membrane (St. Venant-Kirchhoff, plane stress), edge springs and foundation, with Rayleigh damping
on the same stiffness matrix as the plugin's: the Hessian of the energy with the compressive part of
its geometric term left out. The reference of the benches; `tests/benchmarks` checks it against
`palpate.tissue.energy`.
"""

from __future__ import annotations

import numpy as np
from palpate.tissue import config as configuration
from palpate.tissue import step as stepping
from palpate.tissue.config import Config
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from scipy import sparse
from scipy.sparse import linalg


class Elastic:
  """Internal force and stiffness of a surface without bending, volume and pressure.

  Args:
    mesh: the surface at rest
    config: material; `bend`, `bulk` and `pressure` must be off
  """

  def __init__(self, mesh: Mesh, config: Config):
    if config.bend or config.bulk or config.pressure:
      raise ValueError("bend, bulk and pressure are not part of the float64 reference")
    self.mesh, self.config = mesh, config
    n = mesh.nvert
    area = topology.vertex_areas(mesh.rest, mesh.elem)
    self.foundation = (config.foundation * area)[:, None]
    self.spring = config.elements == "spring"
    if self.spring:
      half = np.arange(len(mesh.twin))
      once = (mesh.twin < 0) | (half < mesh.twin)
      ends = np.stack([mesh.elem.ravel()[once], mesh.elem[:, [1, 2, 0]].ravel()[once]], axis=1)
      self.vert = ends
      self.side = np.array([[-1.0], [1.0]])  # of corner p in edge vector a
    else:
      self.vert = mesh.elem
      self.side = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    corner = mesh.rest[self.vert]
    self.edge0 = np.einsum("pa,mpi->mai", self.side, corner)
    count, most = self.vert.shape
    rows = self.vert.ravel()
    self._sum = sparse.csr_matrix(
      (np.ones(rows.size), (rows, np.arange(rows.size))), (n, rows.size)
    )
    axis = np.arange(3)
    at = 3 * self.vert[:, :, None] + axis
    self._row = np.broadcast_to(at[:, :, None, :, None], (count, most, most, 3, 3)).ravel()
    self._col = np.broadcast_to(at[:, None, :, None, :], (count, most, most, 3, 3)).ravel()
    if self.spring:
      self.length0 = np.linalg.norm(self.edge0[:, 0], axis=1)
      return
    metric = np.einsum("mai,mbi->mab", self.edge0, self.edge0)
    self.inverse = np.linalg.inv(metric)
    self.volume = 0.5 * np.sqrt(np.linalg.det(metric)) * config.thickness
    lam, mu = configuration.lame(config, mesh.nelem)
    g = self.inverse
    weight = self.volume
    self.tangent = np.einsum("m,mac,mbd->macbd", lam * weight, g, g)
    self.tangent += np.einsum("m,mab,mcd->macbd", mu * weight, g, g)
    self.tangent += np.einsum("m,mad,mcb->macbd", mu * weight, g, g)
    self._rest = self.edge0[:, 0].T.copy(), self.edge0[:, 1].T.copy()
    self._det = 1 / (g[:, 0, 0] * g[:, 1, 1] - g[:, 0, 1] ** 2)
    c = self.tangent
    self._voigt = (
      *(c[:, 0, 0, 0, 0], c[:, 1, 1, 1, 1], c[:, 0, 0, 1, 1]),
      *(c[:, 0, 0, 0, 1], c[:, 1, 1, 0, 1], c[:, 0, 1, 0, 1]),
    )

  def force(self, u: np.ndarray, v: np.ndarray | None = None) -> np.ndarray:
    """Returns elastic force, and with `v` also damping, on each node [N], (nvert, 3)."""
    d = self._differences(u)
    rate = None if v is None else self._differences(v)
    if self.spring:
      pull = self._springs(d[:, 0], None if rate is None else rate[:, 0])[:, None]
    else:
      pull = self._membrane(d, rate)
    corner = np.einsum("pa,mai->mpi", self.side, pull).reshape(-1, 3)
    moved = u if v is None else u + self.config.damping * v
    return -(self._sum @ corner) - self.foundation * moved

  def stiffness(self, u: np.ndarray) -> sparse.csc_matrix:
    """Returns K, positive semi-definite [N/m], (3 nvert, 3 nvert)."""
    d = self._differences(u)
    edge = self.edge0 + d
    if self.spring:
      length = np.linalg.norm(edge[:, 0], axis=1)
      n = edge[:, 0] / length[:, None]
      stretch = np.maximum(1 - self.length0 / length, 0.0)[:, None, None]
      nn = n[:, :, None] * n[:, None, :]
      block = (self.config.stiffness * ((1 - stretch) * nn + stretch * np.eye(3)))[:, None, None]
    else:
      block = np.einsum("macbd,mci,mdj->mabij", self.tangent, edge, edge)
      block += self._tension(self._stress(d))[..., None, None] * np.eye(3)
    nodal = np.einsum("pa,qb,mabij->mpqij", self.side, self.side, block)
    size = 3 * self.mesh.nvert
    k = sparse.coo_matrix((nodal.ravel(), (self._row, self._col)), (size, size)).tocsc()
    return k + sparse.diags(np.repeat(self.foundation, 3)).tocsc()

  def edges(self) -> np.ndarray:
    """Returns the ends of every edge, (nedge, 2)."""
    elem = self.mesh.elem
    return np.unique(np.sort(np.stack([elem, elem[:, [1, 2, 0]]], -1).reshape(-1, 2), 1), axis=0)

  def energy(self, u: np.ndarray) -> float:
    """Returns the elastic energy [J]."""
    d = self._differences(u)
    whole = 0.5 * float((self.foundation * u * u).sum())
    if self.spring:
      stretch = self._stretch(d[:, 0])[0]
      return whole + float(0.5 * self.config.stiffness * (stretch**2).sum())
    return whole + float(0.5 * (self._stress(d) * self._strain(d)).sum())

  def _differences(self, u: np.ndarray) -> np.ndarray:
    return u[self.vert[:, 1:]] - u[self.vert[:, :1]]

  def _stretch(self, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns elongation [m] and unit vector of each edge, without loss of digits."""
    rest = self.edge0[:, 0]
    edge = rest + d
    length = np.linalg.norm(edge, axis=1)
    grown = (2 * (rest * d).sum(1) + (d * d).sum(1)) / (length + self.length0)
    return grown, edge / length[:, None]

  def _springs(self, d: np.ndarray, rate: np.ndarray | None) -> np.ndarray:
    grown, n = self._stretch(d)
    pull = self.config.stiffness * grown[:, None] * n
    if rate is None:
      return pull
    length = self.length0 + grown
    s = np.maximum(grown / length, 0.0)[:, None]
    along = (rate * n).sum(1)[:, None] * n
    return pull + self.config.damping * self.config.stiffness * ((1 - s) * along + s * rate)

  def _strain(self, d: np.ndarray) -> np.ndarray:
    """Returns the covariant Green strain, (nelem, 2, 2)."""
    mixed = np.einsum("mai,mbi->mab", self.edge0, d)
    return 0.5 * (mixed + mixed.transpose(0, 2, 1) + np.einsum("mai,mbi->mab", d, d))

  def _stress(self, d: np.ndarray) -> np.ndarray:
    """Returns contravariant stress times volume [N m / m^2], (nelem, 2, 2)."""
    e = self._strain(d)
    ge = self.inverse @ e
    lam, mu = configuration.lame(self.config, self.mesh.nelem)
    trace = lam * self.volume * (ge[:, 0, 0] + ge[:, 1, 1])
    return trace[:, None, None] * self.inverse + (2 * mu * self.volume)[:, None, None] * (
      ge @ self.inverse
    )

  def _tension(self, s: np.ndarray) -> np.ndarray:
    """Returns the stress without its negative principal part, (nelem, 2, 2)."""
    t11, t22, t12 = self._tensile(s[:, 0, 0], s[:, 1, 1], s[:, 0, 1])
    return np.stack([t11, t12, t12, t22], axis=1).reshape(-1, 2, 2)

  def _tensile(self, s11, s22, s12):
    g11, g22, g12 = self.inverse[:, 0, 0], self.inverse[:, 1, 1], self.inverse[:, 0, 1]
    mean = 0.5 * self._det * (s11 * g22 - 2 * s12 * g12 + s22 * g11)
    root = np.sqrt(np.maximum(mean * mean - self._det * (s11 * s22 - s12 * s12), 0.0))
    high, low = mean + root, mean - root
    share = np.where(low >= 0, 1.0, np.where(high <= 0, 0.0, high / np.maximum(2 * root, 1e-300)))
    shift = np.minimum(low, 0.0)
    return share * (s11 - shift * g11), share * (s22 - shift * g22), share * (s12 - shift * g12)

  def _membrane(self, d: np.ndarray, rate: np.ndarray | None) -> np.ndarray:
    """Returns the pull along each edge vector [N], (nelem, 2, 3).

    In components, which numpy does faster than small matrices: the reference spends its time here.
    """
    (r, t), (p, q) = self._rest, (d[:, 0].T, d[:, 1].T)
    a, b = r + p, t + q

    def dot(x, y):
      return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]

    e11, e22 = dot(r, p) + 0.5 * dot(p, p), dot(t, q) + 0.5 * dot(q, q)
    twice = dot(r, q) + dot(p, t) + dot(p, q)
    c11, c22, c12, c13, c23, c33 = self._voigt
    s11 = c11 * e11 + c12 * e22 + c13 * twice
    s22 = c12 * e11 + c22 * e22 + c23 * twice
    s12 = c13 * e11 + c23 * e22 + c33 * twice
    one, two = s11 * a + s12 * b, s12 * a + s22 * b
    if rate is not None:
      # K v without the matrix: C^acbd e_c (e_d . w_b) + T^ab w_b.
      w, z = rate[:, 0].T, rate[:, 1].T
      f11, f22, both = dot(a, w), dot(b, z), dot(a, z) + dot(b, w)
      t11, t22, t12 = self._tensile(s11, s22, s12)
      c1 = c11 * f11 + c12 * f22 + c13 * both
      c2 = c12 * f11 + c22 * f22 + c23 * both
      c3 = c13 * f11 + c23 * f22 + c33 * both
      beta = self.config.damping
      one += beta * (c1 * a + c3 * b + t11 * w + t12 * z)
      two += beta * (c3 * a + c2 * b + t12 * w + t22 * z)
    return np.stack([one.T, two.T], axis=1)


class Step:
  """One step of an organ in float64, solved exactly: `implicit`, or `midpoint` but for the first.

  Args:
    elastic: forces
    mass: nodal masses [kg], (nvert,)
    free: nodes that move, (nvert,) bool
  """

  def __init__(self, elastic: Elastic, mass: np.ndarray, free: np.ndarray):
    self.elastic = elastic
    self.edge = elastic.edges()
    self.mass = np.repeat(mass, 3)
    self.keep = np.repeat(free, 3)

  def __call__(
    self,
    h: float,
    u: np.ndarray,
    v: np.ndarray,
    force: np.ndarray,
    newton: int = 1,
    scheme: str = "implicit",
  ) -> np.ndarray:
    """Returns the change of velocity, (nvert, 3); see `tissue/elastic.h` for the equations.

    Args:
      h: time step [s]
      u: displacement [m], (nvert, 3)
      v: velocity [m/s], (nvert, 3)
      force: external and contact force [N], (nvert, 3)
      newton: Newton iterations, of `implicit`
      scheme: `implicit` or `midpoint`
    """
    e, beta = self.elastic, self.elastic.config.damping
    gain = h * h + h * beta
    share = self._share(h * v)
    if scheme == "midpoint":
      newton, share, gain = 1, 0.0, 0.5 * gain
    dv = np.zeros_like(u)
    for it in range(newton):
      w = v + dv
      x = u + h * (share * v if it == 0 else w)
      k = e.stiffness(x)
      rhs = h * (e.force(x) + force).ravel() - h * beta * (k @ w.ravel()) - self.mass * dv.ravel()
      if it == 0 and scheme == "implicit":
        rhs -= (1 - share) * h * h * (k @ v.ravel())
      a = (sparse.diags(self.mass) + gain * k).tocsc()[self.keep][:, self.keep]
      change = np.zeros(u.size)
      change[self.keep] = np.asarray(linalg.spsolve(a, rhs[self.keep]))
      dv = dv + change.reshape(-1, 3)
      if it and np.abs(change).max() < 1e-12 * np.abs(dv).max():
        break
    return dv

  def _share(self, move: np.ndarray) -> float:
    """Returns how much of a move the first iteration makes; see `palpate.tissue.step`."""
    i, j = self.edge.T
    length = np.linalg.norm(self.elastic.mesh.rest[j] - self.elastic.mesh.rest[i], axis=1)
    change = (np.linalg.norm(move[j] - move[i], axis=1) / length).max()
    return min(1.0, stepping.AHEAD / max(change, 1e-300))
