// The inside of a solid: tetrahedra of the stable neo-Hookean energy (Smith, de Goes and Kim 2018,
// doi:10.1145/3180491, eq. 14), most of which acts on means over nodes (Puso and Solberg 2006,
// doi:10.1002/nme.1457). With the gradient of the displacement H, F = I + H, and
//
//     i = tr F^T F - 3 = 2 tr H + H : H,    j = det F - 1,    C = dj/dH = cof F = I + c
//
// the density of energy is mu / 2 (i - ln(1 + i / 4)) - 3/4 mu j + (lambda + 5/8 mu) / 2 j^2: of a
// tetrahedron with OWN_SHARE of mu alone, of a node with the rest of mu and lambda, H then the mean
// of the tetrahedra around it. All of it is of the order of H, so that float32 keeps the digits of
// small strains and a solid at rest is at rest to the bit.
#pragma once
#include "tissue/elastic.h"
#include "solver/product.h"

namespace palpate {

// Parts of a 3 x 3 matrix.
PALPATE V trace(const M3& a) { return a.xx + a.yy + a.zz; }
PALPATE V inner(const M3& a, const M3& b) {
  return a.xx * b.xx + a.xy * b.xy + a.xz * b.xz + a.yx * b.yx + a.yy * b.yy + a.yz * b.yz
    + a.zx * b.zx + a.zy * b.zy + a.zz * b.zz;
}
PALPATE M3 operator*(const M3& a, const M3& b) {
  const V3 x = a * V3{b.xx, b.yx, b.zx}, y = a * V3{b.xy, b.yy, b.zy};
  const V3 z = a * V3{b.xz, b.yz, b.zz};
  return {x.x, y.x, z.x, x.y, y.y, z.y, x.z, y.z, z.z};
}
PALPATE M3 transposed(const M3& a) {
  return {a.xx, a.yx, a.zx, a.xy, a.yy, a.zy, a.xz, a.yz, a.zz};
}
PALPATE M3 cofactors(const M3& a) {
  return {a.yy * a.zz - a.yz * a.zy, a.yz * a.zx - a.yx * a.zz, a.yx * a.zy - a.yy * a.zx,
          a.xz * a.zy - a.xy * a.zz, a.xx * a.zz - a.xz * a.zx, a.xy * a.zx - a.xx * a.zy,
          a.xy * a.yz - a.xz * a.yy, a.xz * a.yx - a.xx * a.yz, a.xx * a.yy - a.xy * a.yx};
}

// Gradient of a vector field in a tetrahedron, sum_k x_k g_k^T over its corners 1, 2, 3, relative to
// corner 0.
PALPATE M3 gradient(const float* field, const int* node, const float* g, Lane lane) {
  const V3 x0 = gather_shared(field, node, lane);
  const M3 a = outer(gather_shared(field, node + 8, lane) - x0, ld3(g, 0, lane));
  const M3 b = outer(gather_shared(field, node + 16, lane) - x0, ld3(g, 3, lane));
  return a + b + outer(gather_shared(field, node + 24, lane) - x0, ld3(g, 6, lane));
}

// Changes of volume: j, and c with cof F = I + c.
struct Swelling { V j; M3 c; };

PALPATE Swelling swelling(const M3& h) {
  const V t = trace(h);
  const M3 cof = cofactors(h);
  const V det = h.xx * cof.xx + h.xy * cof.xy + h.xz * cof.xz;
  return {t + trace(cof) + det, splat(-1.0f) * transposed(h) + t + cof};
}

// The rotation nearest to F, by Newton's iteration with Higham's scaling (Higham 1986,
// doi:10.1137/0907079): two or three of them, of a stretch of two to 1e-3, for the matrix and damping
// alone. Of a tetrahedron inside out it is a reflection, which serves as well.
struct Turn {
  M3 x, cof;
  V det, size2;  // of x

  // One more; the last is near enough to do without scaling.
  PALPATE void next(bool scaled) {
    const V least = 1e-4f * size2 * vsqrt(size2) + 1e-30f, zero = splat(0.0f);
    const V d = select(det < zero, vmin(det, -least), vmax(det, least));
    const V part = inner(cof, cof) / (d * d * vmax(size2, splat(1e-30f)));
    const V scale = scaled ? vsqrt(vsqrt(part)) : splat(1.0f);
    x = (0.5f * scale) * x + (0.5f / (scale * d)) * cof;
  }
  PALPATE void measure() {
    cof = cofactors(x);
    det = x.xx * cof.xx + x.xy * cof.xy + x.xz * cof.xz;
  }
};

PALPATE M3 turn(const M3& F, const M3& cof, V det, V size2, V stretched) {
  constexpr float NEAR = 0.03f;  // of the squares of the stretches, of 3: the last makes 1e-4 of it
  constexpr float SMALL = 4e-4f;  // of `stretched`: twice the squares of the strains
  Turn turn = {F, cof, det, size2};
  for (int k = 0; k < 2; ++k) {
    if (!any_above(k ? turn.size2 - (3.0f + NEAR) : stretched - SMALL, 0.0f)) break;
    turn.next(true);
    turn.measure();
    turn.size2 = inner(turn.x, turn.x);
  }
  turn.next(false);
  return turn.x;
}

// Stress of the energy, h times; the pressure impulse p comes in place of h lambda j.
PALPATE M3 stress(const M3& H, const Swelling& now, V mu, V p, float h) {
  const V i = 2.0f * trace(H) + inner(H, H);
  return (0.75f * h * mu) * (H + splat(-1.0f) * now.c)
    + (0.25f * h * mu * i / (4.0f + i)) * (H + splat(1.0f)) + p * (now.c + splat(1.0f));
}

// Stress of each node for the mean gradient of the tetrahedra around it, which its neighbours say,
// with what damping adds to the pressure.
template <class Fields>
PALPATE void node_stress(const Fields& f, Thread t, int stage) {
  const float* step = f.state.step.data + 4 * t.world;
  const float h = step[0], gv = weight_of_rate(stage, step);
  const size_t base = 96 * (size_t)t.world * f.shape.nslice;
  const float* motion = f.system.node_motion.data + base;
  const float* number = numbers(f, t.world);
  const size_t mesh = mesh_of(f, t.world);
  const float* moduli = f.lump.node_moduli.data ? f.lump.node_moduli.data + base / 6
                                                : f.tissue.node_moduli.data + mesh;
  each_slice(t, f.shape.nused, [&](int s, Lane lane) {
    const int row = f.shape.slot_adr.data[s], width = f.shape.fan_width.data[mesh + s];
    const int* node = f.shape.fan_node.data + mesh + 8 * (row + 2 * s + 1);
    const float* slope = f.shape.fan_slope.data + mesh + 24 * (size_t)row;
    const V3 u = ld3(f.system.disp_trial.data + base / 4 + 24 * s, lane);
    const V3 v = ld3(f.system.vel_trial.data + base / 4 + 24 * s, lane);
    const V zero = splat(0.0f);
    M3 H = {zero, zero, zero, zero, zero, zero, zero, zero, zero}, rate = H;
    for (int k = 0; k < width; ++k) {
      const V3 g = ld3(slope, 3 * k, lane);
      H = H + outer(gather_shared(motion, node + 8 * k, lane) - u, g);
      rate = rate + outer(gather_shared(motion + 32, node + 8 * k, lane) - v, g);
    }
    const V mu = number[SHEAR] * ld(moduli, 2 * s, lane);
    const V lam = number[LAME] * ld(moduli, 2 * s + 1, lane);
    const Swelling now = swelling(H);
    const V p = lam * (h * now.j + gv * (trace(rate) + inner(now.c, rate)));
    const M3 P = stress(H, now, mu, p + (0.625f * h) * mu * now.j, h);
    float* to = f.system.node_stress.data + base + 96 * s;
    share(to, {P.xx, P.xy, P.xz}, p, lane);
    share(to + 32, {P.yx, P.yy, P.yz}, lane);
    share(to + 64, {P.zx, P.zy, P.zz}, lane);
  });
}

// Mean stress and pressure of a tetrahedron's corners.
PALPATE M3 mean_stress(const float* stress, const int* node, V& pressure, Lane lane) {
  V p, none;
  const V3 x = gather_four(stress, node, p, lane), y = gather_four(stress + 32, node, none, lane);
  const V3 z = gather_four(stress + 64, node, none, lane);
  pressure = 0.25f * p;
  return splat(0.25f) * M3{x.x, x.y, x.z, y.x, y.y, y.z, z.x, z.y, z.z};
}

// How far a tetrahedron is crushed, turned inside out or drawn long, 0 to 1: by its volume over that of a cube
// of edges about as long, which is 1 after a rotation.
constexpr float CRUSHED = 0.5f;
PALPATE V crushed(V volume, V size2) {
  const V edge2 = vmax((1.0f / 3.0f) * size2, splat(1.0f)), cube = (0.5f * CRUSHED) * edge2 * (1.0f + edge2);
  const V less = cube - volume;
  return any_above(less, 0.0f) ? vmin(vmax(less, splat(0.0f)) / cube, splat(1.0f)) : splat(0.0f);
}
constexpr float LINGERS = 2.0f;  // time steps of damping that it then has besides

// What a tetrahedron gives to its corners: impulses, and for the matrix its turned gradients times
// the root of g volume and of the modulus mu, beside which are lambda and 1 + tension over mu.
//
// The matrix is that of small strains in the turned frame, which leaves rotations free, with all of
// the moduli in the tetrahedra: no mean over nodes is stiffer, and no neighbours beyond the edges'
// take part. A change of volume C : dF hangs on the faces: their mean is in lambda, and what they
// differ by is covered by an isotropic stiffness, lambda times its square, so that the matrix is at
// least half the true Hessian for every direction ((a + b)^2 <= 2 a^2 + 2 b^2). The stress adds a
// geometric stiffness between principal directions a and b: (P_a + P_b) / (s_a + s_b) of a tension
// to rotations, of which `tension` is an upper bound, and the pressure times the third stretch to
// shear, which mu has. K v is without both. Where a tetrahedron is crushed such bounds change within a step,
// and what the matrix has beyond the energy would come out as motion: there K v is more.
template <class Fields>
PALPATE void tet_stress(const Fields& f, Thread t, int stage) {
  const float* step = f.state.step.data + 4 * t.world;
  const float h = step[0], weight = step[1], gv = weight_of_rate(stage, step), per_h = 1.0f / h;
  constexpr float THIRD = 1.0f / 3.0f;
  const bool implicit = stage == FIRST || stage == LATER;
  const float lingers = implicit && weight > 0.0f ? LINGERS * h * h : 0.0f;
  const size_t base = 96 * (size_t)t.world * f.shape.nslice;
  const float* motion = f.system.node_motion.data + base;
  const float* nodal = f.system.node_stress.data + base;
  const float* number = numbers(f, t.world);
  const size_t mesh = mesh_of(f, t.world);
  each_slice(t, f.shape.ntetslice, [&](int s, Lane lane) {
    const int* node = f.shape.tet_node.data + mesh + 32 * s;
    const float* g = f.shape.tet_gradient.data + mesh + 72 * s;
    const size_t at = (size_t)t.world * f.shape.ntetslice + s;
    const float* own = f.tissue.tet_moduli.data + mesh + 24 * s;
    const float* moduli = f.lump.tet_moduli.data ? f.lump.tet_moduli.data + 16 * at : own + 8;
    const V volume = ld(own, 0, lane);
    const V mu = number[SHEAR] * ld(moduli, 0, lane), lam = number[LAME] * ld(moduli, 1, lane);
    float* arm = f.system.tet_arm.data + 128 * at;
    float* impulse = f.system.tet_impulse.data + 128 * at;
    const M3 H = gradient(motion, node, g, lane), rate = gradient(motion + 32, node, g, lane);
    const V zero = splat(0.0f);
    const Swelling now = swelling(H);
    const M3 F = H + splat(1.0f), C = now.c + splat(1.0f);
    const V size2 = inner(F, F);
    const V shrunk = vmax(-now.j, zero);
    // tr F^T F - 3 - 2 ln det F, by the first terms of it: twice the squares of small strains.
    const V stretched = 2.0f * trace(H) + inner(H, H) - now.j * (2.0f - now.j)
      + (2.0f * THIRD) * shrunk * shrunk * shrunk;
    const M3 Q = turn(F, C, now.j + 1.0f, size2, stretched), strain = transposed(Q) * rate;
    const V alone = OWN_SHARE * mu;
    V p;
    const M3 elastic = mean_stress(nodal, node, p, lane)
      + stress(H, now, alone, (0.625f * h) * alone * now.j, h);
    const V shear = 0.75f * mu + (per_h * vmax(-p, zero)) * vsqrt(THIRD * size2);
    const V more = lingers * crushed(now.j + 1.0f, size2);
    M3 viscous = (0.75f * gv * mu + more * shear) * (Q * (strain + transposed(strain)));
    if (any_above(more, 0.0f)) viscous = viscous + (more * lam * inner(C, rate)) * C;
    const M3 P = splat(-1.0f) * volume * (elastic + viscous);
    const V3 g1 = ld3(g, 0, lane), g2 = ld3(g, 3, lane), g3 = ld3(g, 6, lane);
    const V3 b1 = P * g1, b2 = P * g2, b3 = P * g3;
    share(impulse, splat(-1.0f) * (b1 + b2 + b3), lane);
    share(impulse + 32, b1, lane);
    share(impulse + 64, b2, lane);
    share(impulse + 96, b3, lane);
    if (!implicit) return;
    const V mean = THIRD * inner(Q, elastic), even = THIRD * inner(Q, C);
    const V rest = vmax(inner(elastic, elastic) - 3.0f * mean * mean, zero);
    const V uneven = vmax(inner(C, C) - 3.0f * even * even, zero);
    const V tension = per_h * vmax(mean + 0.40825f * vsqrt(rest), zero) + lam * uneven;
    const V part = 1.0f / shear, beside = two(lam * even * even * part, 1.0f + tension * part);
    const M3 scaled = vsqrt((weight + more) * volume * shear) * Q;
    const V3 a1 = scaled * g1, a2 = scaled * g2, a3 = scaled * g3;
    share(arm, splat(-1.0f) * (a1 + a2 + a3), beside, lane);
    share(arm + 32, a1, beside, lane);
    share(arm + 64, a2, beside, lane);
    share(arm + 96, a3, beside, lane);
  });
}

// The blocks of each edge, one for either end, from the tetrahedra around it. What rounding to 16 bits
// may take from the matrix is added as an isotropic stiffness along the edges where it is more than
// CARRIED of the nodes' masses, so that the matrix stays positive definite.
constexpr float ROUNDING = 1.0f / 2048.0f, CARRIED = 0.02f, MOST_HALF = 6e4f;

template <class Fields>
PALPATE void edge_block(const Fields& f, Thread t, int) {
  const float* arm = f.system.tet_arm.data + 128 * (size_t)t.world * f.shape.ntetslice;
  Half* out = f.system.half.data + 72 * (size_t)t.world * f.shape.nslot;
  const float* mass = f.state.mass.data + 8 * (size_t)t.world * f.shape.nslice;
  const float whole = unit(f, t.world), per_unit = whole > 0.0f ? 1.0f / whole : 0.0f;
  const size_t mesh = mesh_of(f, t.world);
  const int *from = f.shape.edge_from.data + mesh, *to = f.shape.edge_to.data + mesh;
  each_slice(t, f.shape.nedgeslice, [&](int s, Lane lane) {
    const V zero = splat(0.0f);
    M3 block = {zero, zero, zero, zero, zero, zero, zero, zero, zero};
    for (int k = f.shape.edge_adr.data[s]; k < f.shape.edge_adr.data[s + 1]; ++k) {
      V beside;
      const V3 a = gather_shared(arm, from + 8 * k, beside, lane);
      const V3 c = gather_shared(arm, to + 8 * k, lane);
      block = block + outer(first_of(beside) * a, c) + outer(c, a) + second_of(beside) * dot(a, c);
    }
    block = splat(per_unit) * block;
    const V size = vsqrt(inner(block, block)) + 1e-7f;
    const int* end = f.shape.edge_node.data + mesh + 16 * s;
    const V light = vmin(gather(mass, end, 0, lane), gather(mass, end + 8, 0, lane));
    const V taken = vmax(ROUNDING * size - (CARRIED * per_unit) * light, zero);
    block = vmin(splat(1.0f), MOST_HALF / size) * block + splat(-1.0f) * taken;
    const int* at = f.shape.edge_slot.data + mesh + 16 * s;
    put9(out, at, block, lane);
    put9(out, at + 8, transposed(block), lane);
  });
}

// Right-hand side of each node and, for an implicit stage, what is on the diagonal of the matrix: from
// the tetrahedra around the node, and the blocks of its edges.
template <class Fields>
PALPATE void solid_row(const Fields& f, Thread t, int stage) {
  const float* step = f.state.step.data + 4 * t.world;
  const float h = step[0], g = step[1], gv = weight_of_rate(stage, step);
  const float foundation = numbers(f, t.world)[FOUNDATION];
  const bool implicit = stage == FIRST || stage == LATER;
  const size_t base = (size_t)t.world * f.shape.nslice;
  const size_t tet = (size_t)t.world * f.shape.ntetslice;
  const float* impulse = f.system.tet_impulse.data + 128 * tet;
  const size_t mesh = mesh_of(f, t.world);
  const int* around = f.shape.around_corner.data + mesh;
  each_slice(t, f.shape.nused, [&](int s, Lane lane) {
    const size_t at = base + s;
    const V mass = ld(f.state.mass.data + 8 * at, 0, lane);
    const V kf = splat(foundation) * ld(f.shape.area.data + mesh, s, lane), diag = mass + g * kf;
    const V3 u = ld3(f.system.disp_trial.data + 24 * at, lane);
    const V3 v = ld3(f.system.vel_trial.data + 24 * at, lane);
    V3 b = h * (ld3(f.state.force_ext.data + 24 * at, lane) - kf * u) - gv * kf * v;
    if (stage == LATER) b -= mass * ld3(f.state.dvel.data + 24 * at, lane);
    for (int k = f.shape.around_adr.data[s]; k < f.shape.around_adr.data[s + 1]; ++k)
      b += gather_shared(impulse, around + 8 * k, lane);
    const V zero = splat(0.0f);
    S3 held = {zero, zero, zero, zero, zero, zero};
    if (f.state.hold.data || pair_hold(f, t.world)) held = hold(f, t.world, stage, s, b, lane);
    if (f.shape.ncapsule) {  // see `capsule_row`
      b += ld3(f.system.rhs.data + 24 * at, lane);
      held = held + ld6(f.system.inverse.data + 48 * at, lane);
    }
    st3(f.system.rhs.data + 24 * at, b, lane);
    if (!implicit) return;
    S3 self = {zero, zero, zero, zero, zero, zero};
    const Half* block = f.system.half.data + 72 * (size_t)t.world * f.shape.nslot;
    const int row = f.shape.slot_adr.data[s], end = row + f.shape.fan_width.data[mesh + s];
    for (int j = row; j < end; ++j)
      self = self + symmetric(ld9(block + 72 * (size_t)j, lane));
    put_diagonal(f.system.diag.data + 8 * at, f.system.inverse.data + 48 * at,
                 ld(f.shape.free.data + mesh, s, lane), diag, splat(-unit(f, t.world)) * self + diag + held, lane);
  });
}

}  // namespace palpate
