"""Internal forces of the surface and the matrix of the implicit step.

All kernels run over slices (see `simd`) and gather: a node reads its fan of triangles, so that runs
repeat to the bit. Impulses and the matrix follow from

    A dv = h (F(x) + f_ext) - (h^2 + h damping) K v,    A = M + (h^2 + h damping) K

(thesis eq. 5.19 with Rayleigh damping). K is the Hessian of the elastic energy with the compressive
part of its geometric term left out, which keeps A positive definite.
"""

from __future__ import annotations

import enum

import warp as wp

from . import simd
from .types import State, Surface


class Stage(enum.IntEnum):
  """What the right-hand side is for, which decides the weight of K v in it.

  FIRST and LATER are Newton iterations. The first stands at x + share h v, share in `step`, and
  has the rest of the step ahead in it: h^2 (1 - share) + h damping; later ones are residuals at the
  trial state, h damping. EXPLICIT has h damping, and NEUMANN brings its own. RESPONSE is the answer
  to impulses alone, with the matrix of the last solve.
  """

  FIRST = 0
  LATER = 1
  EXPLICIT = 2
  NEUMANN = 3
  RESPONSE = 4

# Rest vector plus difference of displacements: float32 keeps the digits of small strains.
_EDGE = """
// Weight of K v on the right-hand side: see Stage.
#define AHEAD(stage, step) ((stage) == 3 ? 0.0f \\
  : (step)[1] - ((stage) == 0 ? (step)[3] : 1.0f) * (step)[0] * (step)[0])
#define EDGE(name, rest, row, node, origin) \\
  V name##x = LD(rest, row) + GATHER(U, node, 0) - origin##x; \\
  V name##y = LD(rest, row + 1) + GATHER(U, node, 1) - origin##y; \\
  V name##z = LD(rest, row + 2) + GATHER(U, node, 2) - origin##z;
#define VECTOR(name, array, node) \\
  V name##x = GATHER(array, node, 0), name##y = GATHER(array, node, 1), \\
    name##z = GATHER(array, node, 2);
#define REST(name, rest, row) \\
  const V name##x = LD(rest, row), name##y = LD(rest, row + 1), name##z = LD(rest, row + 2);
#define DOT(a, b) (a##x * b##x + a##y * b##y + a##z * b##z)
#define CROSS(name, a, b) \\
  V name##x = a##y * b##z - a##z * b##y, name##y = a##z * b##x - a##x * b##z, \\
    name##z = a##x * b##y - a##y * b##x;
"""


@wp.func_native(
  _EDGE
  + simd.slices("""
  const float* U = pos.data + 24 * (size_t)world * nnodeslice;
  const int* node = elem_node.data + 24 * s;
  const float* rest = elem_rest.data + 48 * s;
  VECTOR(u, U, node)
  EDGE(a, rest, 0, node + 8, u)
  EDGE(b, rest, 3, node + 16, u)
  CROSS(n, a, b)
  // Below a tenth of its rest area a triangle's normal fades, and the hinge forces with it.
  REST(ra, rest, 0)
  REST(rb, rest, 3)
  CROSS(rn, ra, rb)
  const V scale = 1.0f / SQRT(MAX(DOT(n, n), 0.01f * DOT(rn, rn) + 1e-30f));
  float* out = normal.data + 32 * ((size_t)world * nslice + s);
  ST(out, 0, nx * scale);
  ST(out, 1, ny * scale);
  ST(out, 2, nz * scale);
""")
)
def _elem_normal_slices(
  world: int,
  tid: int,
  nslice: int,
  nnodeslice: int,
  elem_node: wp.array3d[int],
  elem_rest: wp.array3d[float],
  pos: wp.array4d[float],
  normal: wp.array4d[float],
): ...


@wp.kernel(enable_backward=False)
def _elem_normal(
  nslice: int,
  nnodeslice: int,
  # Surface:
  elem_node: wp.array3d[int],
  elem_rest: wp.array3d[float],
  # State in:
  pos_in: wp.array4d[float],
  # State out:
  elem_normal_out: wp.array4d[float],
):
  world, tid = wp.tid()
  _elem_normal_slices(
    world, tid, nslice, nnodeslice, elem_node, elem_rest, pos_in, elem_normal_out
  )


# Angle psi = 2 sin(theta / 2) of a hinge: no inverse trigonometry and bounded when folded. Gradient
# of theta: Bergou et al. 2006 and Grinspun et al. 2003, with the apexes' heights and feet.
@wp.func_native(
  _EDGE
  + simd.slices("""
  const float h = step.data[4 * world];
  const float gv = AHEAD(stage, step.data + 4 * world);
  const float* U = pos.data + 24 * (size_t)world * nnodeslice;
  const float* W = vel.data + 24 * (size_t)world * nnodeslice;
  const float* N = elem_normal.data + 32 * (size_t)world * nelemslice;
  const int* node = hinge_node.data + 32 * s;
  const int* elem = hinge_elem.data + 16 * s;
  const float* rest = hinge_rest.data + 72 * s;
  VECTOR(u, U, node)
  EDGE(e, rest, 0, node + 8, u)
  EDGE(a, rest, 3, node + 16, u)
  EDGE(b, rest, 6, node + 24, u)
  VECTOR(l, N, elem)
  VECTOR(r, N, elem + 8)
  const V length2 = MAX(DOT(e, e), SPLAT(1e-30f));
  const V sl = DOT(a, e) / length2, sr = DOT(b, e) / length2;
  CROSS(t, l, r)
  // Past a right angle the half angle comes from its sine, which is better conditioned there.
  const V cosine = DOT(l, r), sine = DOT(t, e) / SQRT(length2);
  const V chalf = SQRT(MAX(0.5f + 0.5f * cosine, SPLAT(1e-12f)));
  const V shalf = SQRT(MAX(0.5f - 0.5f * cosine, SPLAT(1e-12f)));
  const V zero = SPLAT(0.0f), size = SELECT(sine < zero, -sine, sine);
  const V half = SELECT(cosine > zero, chalf, 0.5f * size / shalf);
  const V psi = SELECT(cosine > zero, sine / chalf, 2.0f * SELECT(sine < zero, -shalf, shalf));
  ax -= sl * ex; ay -= sl * ey; az -= sl * ez;
  bx -= sr * ex; by -= sr * ey; bz -= sr * ez;
  VECTOR(v, W, node)
  VECTOR(w, W, node + 8)
  VECTOR(c, W, node + 16)
  VECTOR(d, W, node + 24)
  cx -= vx + sl * (wx - vx); cy -= vy + sl * (wy - vy); cz -= vz + sl * (wz - vz);
  dx -= vx + sr * (wx - vx); dy -= vy + sr * (wy - vy); dz -= vz + sr * (wz - vz);
  // Heights of the apexes, not below a tenth of those at rest.
  REST(re, rest, 0)
  REST(ra, rest, 3)
  REST(rb, rest, 6)
  CROSS(na, ra, re)
  CROSS(nb, rb, re)
  const V rest2 = 0.01f / MAX(DOT(re, re), SPLAT(1e-30f));
  const V rate = -DOT(l, c) / SQRT(MAX(DOT(a, a), DOT(na, na) * rest2 + 1e-30f))
    - DOT(r, d) / SQRT(MAX(DOT(b, b), DOT(nb, nb) * rest2 + 1e-30f));
  const size_t out = (size_t)world * nslice + s;
  const V change = psi - LD(angle0.data, s);
  ST(angle.data, out, h * change + gv * half * rate);
  ST(half_out.data, out, half);
  // What the bending matrix may leave out here, see _elem_corner_slices.
  const V fold = 4.0f - 4.0f * half * half + 2.0f * change * change;
  ST(rough.data, out, LD(hinge_gain.data, 5 * s) * fold);
""")
)
def _hinge_angle_slices(
  world: int,
  tid: int,
  nslice: int,
  nnodeslice: int,
  nelemslice: int,
  stage: int,
  hinge_node: wp.array3d[int],
  hinge_rest: wp.array3d[float],
  hinge_elem: wp.array3d[int],
  hinge_gain: wp.array3d[float],
  angle0: wp.array2d[float],
  step: wp.array2d[float],
  pos: wp.array4d[float],
  vel: wp.array4d[float],
  elem_normal: wp.array4d[float],
  angle: wp.array3d[float],
  half_out: wp.array3d[float],
  rough: wp.array3d[float],
): ...


@wp.kernel(enable_backward=False)
def _hinge_angle(
  nslice: int,
  nnodeslice: int,
  nelemslice: int,
  stage: int,
  # Surface:
  hinge_node: wp.array3d[int],
  hinge_rest: wp.array3d[float],
  hinge_elem: wp.array3d[int],
  hinge_gain: wp.array3d[float],
  hinge_angle0: wp.array2d[float],
  # State in:
  step_in: wp.array2d[float],
  pos_in: wp.array4d[float],
  vel_in: wp.array4d[float],
  elem_normal_in: wp.array4d[float],
  # State out:
  hinge_angle_out: wp.array3d[float],
  hinge_half_out: wp.array3d[float],
  hinge_rough_out: wp.array3d[float],
):
  world, tid = wp.tid()
  _hinge_angle_slices(
    world,
    tid,
    nslice,
    nnodeslice,
    nelemslice,
    stage,
    hinge_node,
    hinge_rest,
    hinge_elem,
    hinge_gain,
    hinge_angle0,
    step_in,
    pos_in,
    vel_in,
    elem_normal_in,
    hinge_angle_out,
    hinge_half_out,
    hinge_rough_out,
  )


@wp.func_native(
  simd.slices("""
  const float* X = angle.data + 8 * (size_t)world * nslice;
  const int* near = hinge_near.data + 32 * s;
  const float* gain = hinge_gain.data + 40 * s;
  V sum = LD(gain, 0) * LD(X, s);
  for (int k = 0; k < 4; ++k) sum += LD(gain, k + 1) * GATHER(X, near + 8 * k, 0);
  const size_t out = (size_t)world * nslice + s;
  ST(moment.data, out, sum * LD(half.data, out));
""")
)
def _hinge_moment_slices(
  world: int,
  tid: int,
  nslice: int,
  hinge_near: wp.array3d[int],
  hinge_gain: wp.array3d[float],
  angle: wp.array3d[float],
  half: wp.array3d[float],
  moment: wp.array3d[float],
): ...


@wp.kernel(enable_backward=False)
def _hinge_moment(
  nslice: int,
  # Surface:
  hinge_near: wp.array3d[int],
  hinge_gain: wp.array3d[float],
  # State in:
  hinge_angle_in: wp.array3d[float],
  hinge_half_in: wp.array3d[float],
  # State out:
  hinge_moment_out: wp.array3d[float],
):
  world, tid = wp.tid()
  _hinge_moment_slices(
    world, tid, nslice, hinge_near, hinge_gain, hinge_angle_in, hinge_half_in, hinge_moment_out
  )


# A triangle's part of minus moment times grad theta lies along its normal: one number a corner.
#
# The bending matrix n Q n^T takes normals of nodes for those of triangles, and rest heights. The
# step is stable while the matrix is at least half the true Hessian; on thick shells, folded,
# crushed or curved like their thickness, it fell short by factors of 10 to 100. What it leaves out
# grows with a hinge's angle squared, and with moment times change of angle in the Hessian's second
# derivatives; over the heights squared that is a stiffness, which the triangle's edges get. It
# acts on dv alone, so no rest state depends on it, and a product with the matrix costs the same.
@wp.func_native(
  _EDGE
  + simd.slices("""
  const float* U = pos.data + 24 * (size_t)world * nnodeslice;
  const float* T = moment.data + 8 * (size_t)world * nhingeslice;
  const float* R = rough.data + 8 * (size_t)world * nhingeslice;
  const int* node = elem_node.data + 24 * s;
  const int* hinge = elem_hinge.data + 24 * s;
  const float* rest = elem_rest.data + 48 * s;
  VECTOR(u, U, node)
  EDGE(a, rest, 0, node + 8, u)
  EDGE(b, rest, 3, node + 16, u)
  const V cx = bx - ax, cy = by - ay, cz = bz - az;
  CROSS(n, a, b)
  REST(ra, rest, 0)
  REST(rb, rest, 3)
  CROSS(rn, ra, rb)
  const V scale = 1.0f / SQRT(MAX(DOT(n, n), 0.01f * DOT(rn, rn) + 1e-30f));
  const V aa = DOT(a, a), bb = DOT(b, b), cc = DOT(c, c), ab = DOT(a, b);
  const V ac = DOT(a, c), bc = DOT(b, c);
  // Moment over height, and shares of the edge's two ends: 1 / height = |edge| / (2 area).
  const V m0 = GATHER(T, hinge, 0) * scale, m1 = GATHER(T, hinge + 8, 0) * scale;
  const V m2 = GATHER(T, hinge + 16, 0) * scale;
  const V l0 = SQRT(cc), l1 = SQRT(bb), l2 = SQRT(aa);
  const V i0 = m0 / MAX(l0, SPLAT(1e-15f)), i1 = m1 / MAX(l1, SPLAT(1e-15f));
  const V i2 = m2 / MAX(l2, SPLAT(1e-15f));
  // Edge 1 -> 2 seen from 0, edge 2 -> 0 from 1, edge 0 -> 1 from 2.
  const V s0 = m0 * l0 - i1 * (bb - ab) - i2 * (aa - ab);
  const V s1 = m1 * l1 - i0 * bc - i2 * ab;
  const V s2 = m2 * l2 + i0 * ac - i1 * ab;
  float* out = corner.data + 24 * ((size_t)world * nslice + s);
  ST(out, 0, s0);
  ST(out, 1, s1);
  ST(out, 2, s2);
  const V cover = scale * scale
    * (GATHER(R, hinge, 0) * cc + GATHER(R, hinge + 8, 0) * bb + GATHER(R, hinge + 16, 0) * aa);
  ST(normal.data + 32 * ((size_t)world * nslice + s), 3, cover);
""")
)
def _elem_corner_slices(
  world: int,
  tid: int,
  nslice: int,
  nnodeslice: int,
  nhingeslice: int,
  elem_node: wp.array3d[int],
  elem_rest: wp.array3d[float],
  elem_hinge: wp.array3d[int],
  pos: wp.array4d[float],
  moment: wp.array3d[float],
  rough: wp.array3d[float],
  normal: wp.array4d[float],
  corner: wp.array4d[float],
): ...


@wp.kernel(enable_backward=False)
def _elem_corner(
  nslice: int,
  nnodeslice: int,
  nhingeslice: int,
  # Surface:
  elem_node: wp.array3d[int],
  elem_rest: wp.array3d[float],
  elem_hinge: wp.array3d[int],
  # State in:
  pos_in: wp.array4d[float],
  hinge_moment_in: wp.array3d[float],
  hinge_rough_in: wp.array3d[float],
  # State out:
  elem_normal_out: wp.array4d[float],
  elem_corner_out: wp.array4d[float],
):
  world, tid = wp.tid()
  _elem_corner_slices(
    world,
    tid,
    nslice,
    nnodeslice,
    nhingeslice,
    elem_node,
    elem_rest,
    elem_hinge,
    pos_in,
    hinge_moment_in,
    hinge_rough_in,
    elem_normal_out,
    elem_corner_out,
  )


# One pass around the fan of each node. Membrane: St. Venant-Kirchhoff plane stress in the covariant
# basis (e1, e2) of each triangle, E_ab = (e_a . e_b - E_a . E_b) / 2, S = C : E,
# C^abcd = lambda' G^ab G^cd + mu (G^ac G^bd + G^ad G^bc); force on the node S^ab summed, blocks
# K_0b = -(K_1b + K_2b) with K_ab = C^acbd e_c e_d^T + S^ab I. Springs: thesis eq. 5.1.
@wp.func_native(
  _EDGE
  + simd.slices("""
  const float h = step.data[4 * world], g = step.data[4 * world + 1];
  const float gv = AHEAD(stage, step.data + 4 * world);
  const bool matrix = stage < 2;
  const size_t base = (size_t)world * nslice;
  const float* U = pos.data + 24 * base;
  const float* W = vel.data + 24 * base;
  const float* N = elem_normal.data + 32 * (size_t)world * nelemslice;
  const float* C = elem_corner.data + 24 * (size_t)world * nelemslice;
  const int row0 = slot_adr.data[s], width = slot_adr.data[s + 1] - row0;
  const int* node = fan_node.data + 8 * (row0 + 2 * s);
  const float* rest = fan_rest.data + 24 * (row0 + 2 * s);
  const float* metric = fan_metric.data + 40 * (row0 + s);
  const int* corner = fan_corner.data + 8 * (row0 + s);
  const int* side = fan_side.data + 8 * (row0 + s);
  float* K = block.data + 72 * ((size_t)world * nslot + row0);
  const V zero = SPLAT(0.0f);
  const V degree_ = LD(degree.data, s);
  const V ux = LD(U + 24 * s, 0), uy = LD(U + 24 * s, 1), uz = LD(U + 24 * s, 2);
  const V vx = LD(W + 24 * s, 0), vy = LD(W + 24 * s, 1), vz = LD(W + 24 * s, 2);
  V fx = zero, fy = zero, fz = zero;        // elastic force [N]
  V jx = zero, jy = zero, jz = zero;        // impulse of damping and of the step ahead [N s]
  V ox = zero, oy = zero, oz = zero;        // area vector
  V squeeze = SPLAT(1.0f);
  V dxx = zero, dxy = zero, dxz = zero, dyy = zero, dyz = zero, dzz = zero;
  V k0 = zero, k1 = zero, k2 = zero, k3 = zero, k4 = zero;
  V k5 = zero, k6 = zero, k7 = zero, k8 = zero, cover = zero;
  // Entry k of the fan as displacement difference d and edge e.
  V px = GATHER(U, node, 0) - ux, py = GATHER(U, node, 1) - uy, pz = GATHER(U, node, 2) - uz;
  V rx = LD(rest, 0), ry = LD(rest, 1), rz = LD(rest, 2);
  for (int k = 0; k <= width; ++k) {
    const int* next = node + 8 * (k + 1);
    const V qx = GATHER(U, next, 0) - ux, qy = GATHER(U, next, 1) - uy;
    const V qz = GATHER(U, next, 2) - uz;
    const V tx = LD(rest, 3 * k + 3), ty = LD(rest, 3 * k + 4), tz = LD(rest, 3 * k + 5);
    const V ax = rx + px, ay = ry + py, az = rz + pz;
    const V bx = tx + qx, by = ty + qy, bz = tz + qz;
    const V G11 = LD(metric, 5 * k), G12 = LD(metric, 5 * k + 1), G22 = LD(metric, 5 * k + 2);
    V n0, n1, n2, n3, n4, n5, n6, n7, n8, over = zero;
    if (bending && matrix) over = SELECT(G11 > zero, GATHER(N, corner + 8 * k, 3), zero);
    if (spring == 0.0f) {
      const V mu = LD(metric, 5 * k + 3), lam = LD(metric, 5 * k + 4);
      const V E11 = DOT(r, p) + 0.5f * DOT(p, p);
      const V E22 = DOT(t, q) + 0.5f * DOT(q, q);
      const V E12 = DOT(r, q) + DOT(p, t) + DOT(p, q);  // twice the component
      const V m2 = lam + 2.0f * mu;
      const V c11 = m2 * G11 * G11, c22 = m2 * G22 * G22;
      const V c12 = lam * G11 * G22 + 2.0f * mu * G12 * G12;
      const V c13 = m2 * G11 * G12, c23 = m2 * G22 * G12;
      const V c33 = lam * G12 * G12 + mu * (G11 * G22 + G12 * G12);
      const V S11 = c11 * E11 + c12 * E22 + c13 * E12;
      const V S22 = c12 * E11 + c22 * E22 + c23 * E12;
      const V S12 = c13 * E11 + c23 * E22 + c33 * E12;
      if (k > 0) {
        const V s1 = S11 + S12, s2 = S12 + S22;
        fx += s1 * ax + s2 * bx; fy += s1 * ay + s2 * by; fz += s1 * az + s2 * bz;
      }
      // Tensile part of S: drop the negative principal stress.
      const V det = 1.0f / MAX(G11 * G22 - G12 * G12, SPLAT(1e-30f));
      const V trace = 0.5f * det * (S11 * G22 - 2.0f * S12 * G12 + S22 * G11);
      const V root = SQRT(MAX(trace * trace - det * (S11 * S22 - S12 * S12), zero));
      const V high = trace + root, low = trace - root;
      const V part = SELECT(low >= zero, SPLAT(1.0f),
                            SELECT(high <= zero, zero, high / MAX(high - low, SPLAT(1e-30f))));
      const V shift = MIN(low, zero);
      const V T11 = part * (S11 - shift * G11), T12 = part * (S12 - shift * G12);
      const V T22 = part * (S22 - shift * G22);
      // Blocks towards entry k (B) and towards entry k + 1 (n).
      const V i1 = c11 + c13, i2 = c13 + c33, i3 = c13 + c12, i4 = c33 + c23;
      const V j3 = c12 + c23, j4 = c23 + c22;
      const V lx = i1 * ax + i2 * bx, ly = i1 * ay + i2 * by, lz = i1 * az + i2 * bz;
      const V mx = i3 * ax + i4 * bx, my = i3 * ay + i4 * by, mz = i3 * az + i4 * bz;
      const V dl = T11 + T12, dn = T12 + T22;
      k0 += ax * lx + bx * mx + dl; k1 += ax * ly + bx * my; k2 += ax * lz + bx * mz;
      k3 += ay * lx + by * mx; k4 += ay * ly + by * my + dl; k5 += ay * lz + by * mz;
      k6 += az * lx + bz * mx; k7 += az * ly + bz * my; k8 += az * lz + bz * mz + dl;
      const V wx = i2 * ax + j3 * bx, wy = i2 * ay + j3 * by, wz = i2 * az + j3 * bz;
      const V zx = i4 * ax + j4 * bx, zy = i4 * ay + j4 * by, zz = i4 * az + j4 * bz;
      const V on = SELECT(degree_ > SPLAT((float)k), SPLAT(1.0f), zero);
      n0 = on * (ax * wx + bx * zx + dn); n1 = on * (ax * wy + bx * zy);
      n2 = on * (ax * wz + bx * zz); n3 = on * (ay * wx + by * zx);
      n4 = on * (ay * wy + by * zy + dn); n5 = on * (ay * wz + by * zz);
      n6 = on * (az * wx + bz * zx); n7 = on * (az * wy + bz * zy);
      n8 = on * (az * wz + bz * zz + dn);
    } else {
      const V on = SELECT(degree_ > SPLAT((float)k), SPLAT(spring), zero);
      const V l2 = MAX(DOT(b, b), SPLAT(1e-30f)), il = 1.0f / SQRT(l2);
      const V r0 = SQRT(DOT(t, t));
      const V stretch = (2.0f * DOT(t, q) + DOT(q, q)) / (SQRT(l2) + r0);
      const V pull = on * stretch * il;
      fx += pull * bx; fy += pull * by; fz += pull * bz;
      const V dn = on * MAX(stretch * il, zero), j = (on - dn) * il * il;
      n0 = j * bx * bx + dn; n1 = j * bx * by; n2 = j * bx * bz;
      n3 = n1; n4 = j * by * by + dn; n5 = j * by * bz;
      n6 = n2; n7 = n5; n8 = j * bz * bz + dn;
    }
    if (k > 0) {
      const V wx = GATHER(W, node + 8 * k, 0) - vx, wy = GATHER(W, node + 8 * k, 1) - vy;
      const V wz = GATHER(W, node + 8 * k, 2) - vz;
      jx += k0 * wx + k1 * wy + k2 * wz;
      jy += k3 * wx + k4 * wy + k5 * wz;
      jz += k6 * wx + k7 * wy + k8 * wz;
      if (matrix) {
        float* out = K + 72 * (k - 1);
        cover += over;  // after the product with the velocity above, which is exact
        k0 += cover; k4 += cover; k8 += cover;
        ST(out, 0, -g * k0); ST(out, 1, -g * k1); ST(out, 2, -g * k2);
        ST(out, 3, -g * k3); ST(out, 4, -g * k4); ST(out, 5, -g * k5);
        ST(out, 6, -g * k6); ST(out, 7, -g * k7); ST(out, 8, -g * k8);
        dxx += k0; dxy += 0.5f * (k1 + k3); dxz += 0.5f * (k2 + k6);
        dyy += k4; dyz += 0.5f * (k5 + k7); dzz += k8;
      }
      if (areas) {
        const V has = SELECT(G11 > zero, SPLAT(1.0f), zero);
        CROSS(c, a, b)
        ox += has * cx; oy += has * cy; oz += has * cz;
        // (rest area / area)^2 of the most compressed triangle.
        const V d2 = (G11 * G22 - G12 * G12) * DOT(c, c);
        squeeze = MAX(squeeze, has / MAX(d2, SPLAT(0.01f)));
      }
    }
    k0 = n0; k1 = n1; k2 = n2; k3 = n3; k4 = n4; k5 = n5; k6 = n6; k7 = n7; k8 = n8;
    cover = SELECT(degree_ > SPLAT((float)k), over, zero);
    px = qx; py = qy; pz = qz;
    rx = tx; ry = ty; rz = tz;
  }
  const size_t at = base + s;
  const V m = LD(mass.data, at), kf = foundation * LD(area.data, s);
  const V md = m + g * kf;
  const float* F = force_ext.data + 24 * at;
  const float* D = dvel.data + 24 * at;
  V bx = h * (fx + LD(F, 0) - kf * ux) + gv * (jx - kf * vx);
  V by = h * (fy + LD(F, 1) - kf * uy) + gv * (jy - kf * vy);
  V bz = h * (fz + LD(F, 2) - kf * uz) + gv * (jz - kf * vz);
  if (stage == 1) { bx -= m * LD(D, 0); by -= m * LD(D, 1); bz -= m * LD(D, 2); }
  dxx = md + g * dxx; dyy = md + g * dyy; dzz = md + g * dzz;
  dxy *= g; dxz *= g; dyz *= g;
  if (areas) {
    float* out = areavec.data + 24 * at;
    ST(out, 0, ox); ST(out, 1, oy); ST(out, 2, oz);
  }
  if (bending) {
    for (int k = 1; k <= width; ++k) {
      // Absent triangles point at the first one: mask them.
      const V has = SELECT(LD(metric, 5 * k) > zero, SPLAT(1.0f), zero);
      const V c = has * GATHER(C, side + 8 * k, 0);
      bx += c * GATHER(N, corner + 8 * k, 0);
      by += c * GATHER(N, corner + 8 * k, 1);
      bz += c * GATHER(N, corner + 8 * k, 2);
    }
    // Hinges of squeezed triangles are stiffer than at rest; the normal's length makes up for it.
    const V scale = SQRT(squeeze / MAX(DOT(o, o), SPLAT(1e-30f)));
    ox *= scale; oy *= scale; oz *= scale;
    float* out = normal.data + 24 * at;
    ST(out, 0, ox); ST(out, 1, oy); ST(out, 2, oz);
    const V q = g * LD(bend_diag.data, s);
    dxx += q * ox * ox; dxy += q * ox * oy; dxz += q * ox * oz;
    dyy += q * oy * oy; dyz += q * oy * oz; dzz += q * oz * oz;
  }
  float* B = rhs.data + 24 * at;
  ST(B, 0, bx); ST(B, 1, by); ST(B, 2, bz);
  if (matrix) {
    ST(diag.data, at, md);
    // Inverse of the diagonal block; zero where a node cannot move, which keeps it out of the
    // solve.
    const V ixx = dyy * dzz - dyz * dyz, ixy = dxz * dyz - dxy * dzz, ixz = dxy * dyz - dxz * dyy;
    const V scale = LD(free_.data, s) / MAX(dxx * ixx + dxy * ixy + dxz * ixz, SPLAT(1e-37f));
    float* I = inverse.data + 48 * at;
    ST(I, 0, ixx * scale); ST(I, 1, ixy * scale); ST(I, 2, ixz * scale);
    ST(I, 3, (dxx * dzz - dxz * dxz) * scale); ST(I, 4, (dxy * dxz - dxx * dyz) * scale);
    ST(I, 5, (dxx * dyy - dxy * dxy) * scale);
  }
""")
)
def _assembly_slices(
  world: int,
  tid: int,
  nslice: int,
  nelemslice: int,
  nslot: int,
  stage: int,
  areas: int,
  bending: int,
  spring: float,
  foundation: float,
  slot_adr: wp.array[int],
  fan_node: wp.array2d[int],
  fan_rest: wp.array3d[float],
  fan_metric: wp.array3d[float],
  fan_corner: wp.array2d[int],
  fan_side: wp.array2d[int],
  degree: wp.array2d[float],
  area: wp.array2d[float],
  free_: wp.array2d[float],
  bend_diag: wp.array2d[float],
  step: wp.array2d[float],
  pos: wp.array4d[float],
  vel: wp.array4d[float],
  mass: wp.array3d[float],
  force_ext: wp.array4d[float],
  dvel: wp.array4d[float],
  elem_normal: wp.array4d[float],
  elem_corner: wp.array4d[float],
  block: wp.array4d[float],
  diag: wp.array3d[float],
  inverse: wp.array4d[float],
  rhs: wp.array4d[float],
  areavec: wp.array4d[float],
  normal: wp.array4d[float],
): ...


@wp.kernel(enable_backward=False)
def _assembly(
  nslice: int,
  nelemslice: int,
  nslot: int,
  stage: int,
  areas: int,
  bending: int,
  spring: float,
  foundation: float,
  # Surface:
  slot_adr: wp.array[int],
  fan_node: wp.array2d[int],
  fan_rest: wp.array3d[float],
  fan_metric: wp.array3d[float],
  fan_corner: wp.array2d[int],
  fan_side: wp.array2d[int],
  degree: wp.array2d[float],
  area: wp.array2d[float],
  free: wp.array2d[float],
  bend_diag: wp.array2d[float],
  # State in:
  step_in: wp.array2d[float],
  pos_in: wp.array4d[float],
  vel_in: wp.array4d[float],
  mass_in: wp.array3d[float],
  force_ext_in: wp.array4d[float],
  dvel_in: wp.array4d[float],
  elem_normal_in: wp.array4d[float],
  elem_corner_in: wp.array4d[float],
  # State out:
  block_out: wp.array4d[float],
  diag_out: wp.array3d[float],
  inverse_out: wp.array4d[float],
  rhs_out: wp.array4d[float],
  areavec_out: wp.array4d[float],
  normal_out: wp.array4d[float],
):
  world, tid = wp.tid()
  _assembly_slices(
    world,
    tid,
    nslice,
    nelemslice,
    nslot,
    stage,
    areas,
    bending,
    spring,
    foundation,
    slot_adr,
    fan_node,
    fan_rest,
    fan_metric,
    fan_corner,
    fan_side,
    degree,
    area,
    free,
    bend_diag,
    step_in,
    pos_in,
    vel_in,
    mass_in,
    force_ext_in,
    dvel_in,
    elem_normal_in,
    elem_corner_in,
    block_out,
    diag_out,
    inverse_out,
    rhs_out,
    areavec_out,
    normal_out,
  )


def _hinge_angles(s: Surface, d: State, stage: Stage):
  wp.launch(
    _elem_normal,
    dim=(d.nworld, simd.threads(s.device, s.nelemslice)),
    inputs=[s.nelemslice, s.nslice, s.elem_node, s.elem_rest, d.pos_trial],
    outputs=[d.elem_normal],
    device=s.device,
  )
  wp.launch(
    _hinge_angle,
    dim=(d.nworld, simd.threads(s.device, s.nhingeslice)),
    inputs=[
      s.nhingeslice,
      s.nslice,
      s.nelemslice,
      int(stage),
      s.hinge_node,
      s.hinge_rest,
      s.hinge_elem,
      s.hinge_gain,
      s.hinge_angle0,
      d.step,
      d.pos_trial,
      d.vel_trial,
      d.elem_normal,
    ],
    outputs=[d.hinge_angle, d.hinge_half, d.hinge_rough],
    device=s.device,
  )


def _bending(s: Surface, d: State, stage: Stage):
  _hinge_angles(s, d, stage)
  wp.launch(
    _hinge_moment,
    dim=(d.nworld, simd.threads(s.device, s.nhingeslice)),
    inputs=[s.nhingeslice, s.hinge_near, s.hinge_gain, d.hinge_angle, d.hinge_half],
    outputs=[d.hinge_moment],
    device=s.device,
  )
  wp.launch(
    _elem_corner,
    dim=(d.nworld, simd.threads(s.device, s.nelemslice)),
    inputs=[
      s.nelemslice,
      s.nslice,
      s.nhingeslice,
      s.elem_node,
      s.elem_rest,
      s.elem_hinge,
      d.pos_trial,
      d.hinge_moment,
      d.hinge_rough,
    ],
    outputs=[d.elem_normal, d.elem_corner],
    device=s.device,
  )


def assemble(s: Surface, d: State, stage: Stage):
  """Writes the right-hand side, and for an implicit stage the matrix, at `pos_trial`, `vel_trial`.

  Args:
    s: the organ
    d: its state; `step`, `mass`, `force_ext` and, after the first iteration, `dvel` are read too
    stage: what the right-hand side is for
  """
  if s.has_bending:
    _bending(s, d, stage)
  rows(s, d, stage)


def rows(s: Surface, d: State, stage: Stage):
  """Writes what `assemble` does, from the hinges' moments that are there: the last pass of it."""
  wp.launch(
    _assembly,
    dim=(d.nworld, simd.threads(s.device, s.nslice)),
    inputs=[
      s.nslice,
      s.nelemslice,
      s.nslot,
      int(stage),
      int(s.has_bending or s.has_volume),
      int(s.has_bending),
      s.spring,
      s.foundation,
      s.slot_adr,
      s.fan_node,
      s.fan_rest,
      s.fan_metric,
      s.fan_corner,
      s.fan_side,
      s.degree,
      s.area,
      s.free,
      s.bend_diag,
      d.step,
      d.pos_trial,
      d.vel_trial,
      d.mass,
      d.force_ext,
      d.dvel,
      d.elem_normal,
      d.elem_corner,
    ],
    outputs=[d.block, d.diag, d.inverse, d.rhs, d.areavec, d.normal],
    device=s.device,
  )


def calibrate(s: Surface, d: State):
  """Stores the rest angles as the kernels see them, so that a rest shape is at rest to the bit."""
  if not s.has_bending:
    return
  for array in (d.pos_trial, d.vel_trial, s.hinge_angle0):
    array.zero_()
  d.step.fill_(0.0)
  wp.copy(d.step, wp.array([1.0], dtype=float, device=s.device), count=1)
  _hinge_angles(s, d, Stage.EXPLICIT)
  wp.copy(s.hinge_angle0.flatten(), d.hinge_angle[0].flatten())
