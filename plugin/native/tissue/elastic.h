// Internal forces of the surface and the matrix of the implicit step.
//
// All kernels run over slices and gather: a node reads its fan of triangles, so that runs repeat to
// the bit. Impulses and the matrix follow from
//
//     A dv = h (F(x) + f_ext) - (h^2 + h damping) K v,    A = M + (h^2 + h damping) K
//
// (thesis eq. 5.19 with Rayleigh damping). K is the Hessian of the elastic energy with the
// compressive part of its geometric term left out, which keeps A positive definite.
#pragma once
#include "tissue/hinges.h"

namespace palpate {

// Membrane: St. Venant-Kirchhoff plane stress in the covariant basis (e1, e2) of a triangle,
// E_ab = (e_a . e_b - E_a . E_b) / 2, S = C : E,
// C^abcd = lambda' G^ab G^cd + mu (G^ac G^bd + G^ad G^bc), all times the volume.

struct Metric { V g11, g12, g22; };
struct Moduli { V c11, c22, c12, c13, c23, c33; };  // between the components 11, 22, 12
struct Stress { V s11, s12, s22; };

PALPATE Moduli moduli(Metric g, V mu, V lam) {
  const V g11 = g.g11, g12 = g.g12, g22 = g.g22, m2 = lam + 2.0f * mu;
  return {m2 * g11 * g11, m2 * g22 * g22, lam * g11 * g22 + 2.0f * mu * g12 * g12,
          m2 * g11 * g12, m2 * g22 * g12, lam * g12 * g12 + mu * (g11 * g22 + g12 * g12)};
}

// Stress of a tension along the sheet at rest [N/m], times the volume as the others: A T G^ab.
PALPATE Stress pretension(Metric g, float tension) {
  const V det = vmax(g.g11 * g.g22 - g.g12 * g.g12, splat(1e-30f));  // (2 A)^-2
  const V size = splat(0.5f * tension) / vsqrt(det);
  return {size * g.g11, size * g.g12, size * g.g22};
}

// Stress of a triangle with rest vectors r, t to its corners and displacements p, q of them.
PALPATE Stress stress(Moduli c, V3 r, V3 p, V3 t, V3 q) {
  const V e11 = dot(r, p) + 0.5f * dot(p, p);
  const V e22 = dot(t, q) + 0.5f * dot(q, q);
  const V e12 = dot(r, q) + dot(p, t) + dot(p, q);  // twice the component
  const V s11 = c.c11 * e11 + c.c12 * e22 + c.c13 * e12;
  const V s22 = c.c12 * e11 + c.c22 * e22 + c.c23 * e12;
  return {s11, c.c13 * e11 + c.c23 * e22 + c.c33 * e12, s22};
}

// Tensile part of the stress: the negative principal stress is dropped.
PALPATE Stress tensile(Stress s, Metric g) {
  const V zero = splat(0.0f);
  const V det = 1.0f / vmax(g.g11 * g.g22 - g.g12 * g.g12, splat(1e-30f));
  const V trace = 0.5f * det * (s.s11 * g.g22 - 2.0f * s.s12 * g.g12 + s.s22 * g.g11);
  const V root = vsqrt(vmax(trace * trace - det * (s.s11 * s.s22 - s.s12 * s.s12), zero));
  const V high = trace + root, low = trace - root;
  const V part = select(low >= zero, splat(1.0f),
                        select(high <= zero, zero, high / vmax(high - low, splat(1e-30f))));
  const V shift = vmin(low, zero);
  return {part * (s.s11 - shift * g.g11), part * (s.s12 - shift * g.g12),
          part * (s.s22 - shift * g.g22)};
}

// Stiffness between a node and the two other corners of a triangle, at a and b from it, signs
// turned: K_0b = -(K_1b + K_2b) with K_ab = C^acbd e_c e_d^T + S^ab I.
PALPATE M3 towards_a(Moduli c, Stress s, V3 a, V3 b) {
  const V i1 = c.c11 + c.c13, i2 = c.c13 + c.c33, i3 = c.c13 + c.c12, i4 = c.c33 + c.c23;
  return outer(a, i1 * a + i2 * b) + outer(b, i3 * a + i4 * b) + (s.s11 + s.s12);
}
PALPATE M3 towards_b(Moduli c, Stress s, V3 a, V3 b) {
  const V i2 = c.c13 + c.c33, i4 = c.c33 + c.c23, j3 = c.c12 + c.c23, j4 = c.c23 + c.c22;
  return outer(a, i2 * a + j3 * b) + outer(b, i4 * a + j4 * b) + (s.s12 + s.s22);
}

// Spring along an edge with rest vector t and difference of displacements q: its pull
// k (|l| - r) / |l| along t + q (thesis eq. 5.1), and its stiffness without compression.
struct Spring { V pull; S3 stiffness; };

PALPATE Spring spring(V k, V3 t, V3 q) {
  const V3 b = t + q;
  const V l2 = vmax(dot(b, b), splat(1e-30f)), il = 1.0f / vsqrt(l2);
  const V r0 = vsqrt(dot(t, t));
  const V stretch = (2.0f * dot(t, q) + dot(q, q)) / (vsqrt(l2) + r0);
  const V side = k * vmax(stretch * il, splat(0.0f)), along = (k - side) * il * il;
  return {k * stretch * il, square(along, b) + side};
}

// Rows of the matrix.

// What the rows of a world are made from, and where they go: the blocks of the first slices to `held`,
// as long as there is room, those of the others to `block`.
struct Rows {
  const float* disp;
  const float* vel;
  float *rhs, *diag, *inverse, *areavec, *normal, *block, *held;
  const int* held_adr;
  int room;  // floats of `held`

  PALPATE bool holds(int s) const { return room > 0 && held_adr[s + 1] <= room; }
  PALPATE float* blocks(int s, int row) const {
    return holds(s) ? held + held_adr[s] : block + 72 * (size_t)row;
  }
};

template <class Fields>
PALPATE Rows rows(const Fields& f, int world) {
  const size_t base = (size_t)world * f.shape.nslice;
  return {
    f.system.disp_trial.data + 24 * base, f.system.vel_trial.data + 24 * base,
    f.system.rhs.data + 24 * base, f.system.diag.data + 8 * base,
    f.system.inverse.data + 48 * base, f.system.areavec.data + 24 * base,
    f.system.normal.data + 24 * base,
    f.system.block.data + 72 * (size_t)world * f.shape.nslot, nullptr, f.shape.held_adr.data, 0
  };
}

// The fan of a slice's nodes, see `Shape`; entries [k] and [k + 1] are the k-th triangle.
struct Fan {
  int width;
  V degree;
  const int* node;
  const float* rest;
  const float* metric;
  const int* corner;
  const int* side;
  const float* factor;  // on the moduli of its triangles, or null
  float* block;
};

template <class Fields>
PALPATE Fan fan_of(const Fields& f, int world, const Rows& at, int s, Lane lane) {
  const int row = f.shape.slot_adr.data[s];
  const size_t mesh = mesh_of(f, world);
  return {
    f.shape.fan_width.data[mesh + s],
    ld(f.shape.degree.data + mesh, s, lane),
    f.shape.fan_node.data + mesh + 8 * (row + 2 * s),
    f.shape.fan_rest.data + mesh + 24 * (row + 2 * s),
    f.tissue.fan_metric.data + mesh + 40 * (row + s),
    f.shape.fan_corner.data + mesh + 8 * (row + s),
    f.shape.fan_side.data + mesh + 8 * (row + s),
    f.lump.fan.data ? f.lump.fan.data + 8 * ((size_t)world * (f.shape.nslot + f.shape.nslice) + row + s)
                    : nullptr,
    at.blocks(s, row),
  };
}

// What a fan adds up to at its node.
struct Sum {
  V3 force;  // elastic force [N]
  V3 rate;   // minus K v [N/s]
  S3 stiffness;  // [N/m]
  Carried area;  // area vector [m^2]
  V squeeze;  // (rest area / area)^2 of the most compressed triangle
};

// Motion of all nodes and of a slice's own.
struct Motion { const float* disp; const float* vel; V3 u, v; };

// What is asked of a fan: g = h^2 + h damping; `normal` has the stiffness that covers bending.
struct Wanted { float g, spring, shear, lame, tension; bool matrix, areas, bending; const float* normal; };

// Adds the triangle of entries a and b, at rest ra and rb, to the area vector.
PALPATE void area(Sum& sum, Metric g, V3 a, V3 b) {
  const V has = select(g.g11 > splat(0.0f), splat(1.0f), splat(0.0f));
  const V3 c = cross(a, b);
  sum.area = sum.area + has * c;
  const V d2 = (g.g11 * g.g22 - g.g12 * g.g12) * dot(c, c);
  sum.squeeze = vmax(sum.squeeze, has / vmax(d2, splat(0.01f)));
}

// Goes once around the fan, which is under tension or not, and writes the blocks of its edges.
template <bool TAUT>
PALPATE Sum around(const Fan& fan, const Motion& m, const Wanted& want, Lane lane) {
  const V zero = splat(0.0f);
  const V3 none = {zero, zero, zero};
  const M3 empty = {zero, zero, zero, zero, zero, zero, zero, zero, zero};
  Sum sum = {none, none, {zero, zero, zero, zero, zero, zero}, none, splat(1.0f)};
  M3 block = empty;  // towards entry k
  V cover = zero;
  Carried p = gather3(m.disp, fan.node, lane) - m.u, r = ld3(fan.rest, 0, lane);
  for (int k = 0; k <= fan.width; ++k) {
    const V3 q = gather3(m.disp, fan.node + 8 * (k + 1), lane) - m.u;
    const V3 t = ld3(fan.rest, 3 * k + 3, lane);
    const V3 a = r + p, b = t + q;
    const float* metric = fan.metric + 40 * k;
    const Metric g = {ld(metric, 0, lane), ld(metric, 1, lane), ld(metric, 2, lane)};
    const auto present = fan.degree > splat((float)k);
    M3 next;
    V over = zero;
    if (want.bending && want.matrix)
      over = select(g.g11 > zero, gather(want.normal, fan.corner + 8 * k, 3, lane), zero);
    if (!SPRINGS || want.spring == 0.0f) {
      V mu = want.shear * ld(metric, 3, lane), lambda = want.lame * ld(metric, 4, lane);
      if (fan.factor) {
        const V factor = ld(fan.factor, k, lane);
        mu = factor * mu;
        lambda = factor * lambda;
      }
      const Moduli c = moduli(g, mu, lambda);
      Stress s = stress(c, r, p, t, q);
      if (TAUT) {
        const Stress more = pretension(g, want.tension);
        s = {s.s11 + more.s11, s.s12 + more.s12, s.s22 + more.s22};
      }
      if (k > 0) sum.force += (s.s11 + s.s12) * a + (s.s12 + s.s22) * b;
      const Stress pulled = tensile(s, g);
      block = block + towards_a(c, pulled, a, b);
      next = select(present, splat(1.0f), zero) * towards_b(c, pulled, a, b);
    } else {
      const Spring edge = spring(select(present, splat(want.spring), zero), t, q);
      sum.force += edge.pull * b;
      next = full(edge.stiffness);
    }
    if (k > 0) {
      sum.rate += block * (gather3(m.vel, fan.node + 8 * k, lane) - m.v);
      if (want.matrix) {
        cover += over;  // after the product with the velocity above, which is exact
        block = block + cover;
        st9(fan.block + 72 * (k - 1), splat(-want.g) * block, lane);
        sum.stiffness = sum.stiffness + symmetric(block);
      }
      if (want.areas) area(sum, g, a, b);
    }
    block = next;
    cover = select(present, over, zero);
    p = q;
    r = t;
  }
  return sum;
}

// Inverse of a symmetric matrix, times `scale`.
PALPATE S3 inverse(S3 d, V scale) {
  const V xx = d.yy * d.zz - d.yz * d.yz, xy = d.xz * d.yz - d.xy * d.zz;
  const V xz = d.xy * d.yz - d.xz * d.yy;
  const V s = scale / vmax(d.xx * xx + d.xy * xy + d.xz * xz, splat(1e-37f));
  return {xx * s, xy * s, xz * s, (d.xx * d.zz - d.xz * d.xz) * s,
          (d.xy * d.xz - d.xx * d.yz) * s, (d.xx * d.yy - d.xy * d.xy) * s};
}

// Impulse of the hinges around a node: the corner forces of its triangles along their normals.
PALPATE V3 bending(const Fan& fan, const float* normal, const float* corner, V3 b, Lane lane) {
  for (int k = 1; k <= fan.width; ++k) {
    // Absent triangles point at the first one: mask them.
    const V has = select(ld(fan.metric, 5 * k, lane) > splat(0.0f), splat(1.0f), splat(0.0f));
    const V c = has * gather(corner, fan.side + 8 * k, 0, lane);
    b += c * gather3(normal, fan.corner + 8 * k, lane);
  }
  return b;
}

// What springs that hold nodes, and those between two, add to the diagonal block; in `b` they have it for what
// later iterations have changed already.
template <class Fields>
PALPATE S3 hold(const Fields& f, int world, int stage, int s, V3& b, Lane lane) {
  const V zero = splat(0.0f);
  S3 out = {zero, zero, zero, zero, zero, zero};
  const size_t base = (size_t)world * f.shape.nslice, at = base + s;
  const float* dvel = f.state.dvel.data + 24 * base;
  if (f.state.hold.data) {
    out = ld6(f.state.hold.data + 48 * at, lane);
    if (stage == LATER) b -= out * ld3(dvel + 24 * s, lane);
  }
  if (const float* pair = pair_hold(f, world)) {
    const S3 weight = ld6(pair + 48 * s, lane);
    if (stage == LATER) b -= weight * (ld3(dvel + 24 * s, lane) - gather3(dvel, f.state.pair_node.data + 8 * at, lane));
    out = out + weight;
  }
  return out;
}

// Writes what is on the diagonal of a slice, and the inverse of `self`, the block there: zero where a
// node cannot move, which keeps it out of the solve.
PALPATE void put_diagonal(float* diags, float* inverses, V free, V diag, S3 self, Lane lane) {
  st(diags, 0, diag, lane);
  const S3 inv = inverse(self, free);
  st3(inverses, 0, {inv.xx, inv.xy, inv.xz}, lane);
  st3(inverses, 3, {inv.yy, inv.yz, inv.zz}, lane);
}

// Right-hand side of each node and, for an implicit stage, its row of the matrix: one pass around
// the fan of each node.
template <class Fields>
struct Assembly {
  const Fields& f;
  const int world, stage;
  const Rows& at;

  const size_t mesh = mesh_of(f, world);
  const float* const step = f.state.step.data + 4 * world;
  const float* const number = numbers(f, world);
  const float h = step[0], g = step[1], gv = weight_of_rate(stage, step);
  const float foundation = number[FOUNDATION];
  const bool bends = BENDING && f.shape.nhingeslice > 0;
  const bool areas = bends || (VOLUMES && (number[BULK] != 0.0f || number[PRESSURE] != 0.0f));
  const bool matrix = stage == FIRST || stage == LATER;
  const float* const normal =
    f.system.elem_normal.data + 32 * (size_t)world * f.shape.nelemslice;
  const float* const corner =
    f.system.elem_corner.data + 24 * (size_t)world * f.shape.nelemslice;
  const Wanted want = {
    g, number[STIFFNESS], number[SHEAR], number[LAME], number[TENSION], matrix, areas, bends, normal
  };

  // Adds the bending of a fan to the impulse b, and says what the diagonal block has of it.
  PALPATE S3 bent(const Fan& fan, const Sum& sum, int s, V3& b, Lane lane) const {
    b = bending(fan, normal, corner, b, lane);
    // Hinges of squeezed triangles are stiffer than at rest; the normal's length makes up for it.
    const V scale = vsqrt(sum.squeeze / vmax(dot(sum.area, sum.area), splat(1e-30f)));
    const V3 n = scale * sum.area;
    st3(at.normal + 24 * s, n, lane);
    const size_t own = (size_t)world * f.shape.nslice + s;
    const float* bend = f.lump.bend_diag.data ? f.lump.bend_diag.data + 8 * own
                                              : f.tissue.bend_diag.data + mesh + 8 * s;
    return square(number[PLATE] * g * ld(bend, 0, lane), n);
  }

  PALPATE void row(int s, Lane lane) const {
    const size_t own = (size_t)world * f.shape.nslice + s;
    const Fan fan = fan_of(f, world, at, s, lane);
    const Motion m = {at.disp, at.vel, ld3(at.disp + 24 * s, lane), ld3(at.vel + 24 * s, lane)};
    Sum sum = TENSIONS && want.tension != 0.0f ? around<true>(fan, m, want, lane)
                                               : around<false>(fan, m, want, lane);
    const V mass = ld(f.state.mass.data + 8 * own, 0, lane);
    const V kf = splat(foundation) * ld(f.shape.area.data + mesh, s, lane), diag = mass + g * kf;
    V3 b = h * (sum.force + ld3(f.state.force_ext.data + 24 * own, lane) - kf * m.u)
      + gv * (sum.rate - kf * m.v);
    if (stage == LATER) b -= mass * ld3(f.state.dvel.data + 24 * own, lane);
    S3 self = splat(g) * sum.stiffness + diag;
    if (f.state.hold.data || pair_hold(f, world)) self = self + hold(f, world, stage, s, b, lane);
    if (areas) st3(at.areavec + 24 * s, sum.area, lane);
    if (bends) self = self + bent(fan, sum, s, b, lane);
    st3(at.rhs + 24 * s, b, lane);
    if (!matrix) return;
    const V free = ld(f.shape.free.data + mesh, s, lane);
    put_diagonal(at.diag + 8 * s, at.inverse + 48 * s, free, diag, self, lane);
  }
};

template <class Fields>
PALPATE void row(const Fields& f, Thread t, int stage) {
  const Rows at = rows(f, t.world);
  const Assembly<Fields> assembly{f, t.world, stage, at};
  each_slice(t, f.shape.nused, [&](int s, Lane lane) { assembly.row(s, lane); });
}

}  // namespace palpate
