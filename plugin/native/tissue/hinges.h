// Bending: the angles of hinges between triangles, their moments, and the forces on corners.
#pragma once
#include "core/simd.h"

namespace palpate {

// Weight of K v on the right-hand side of a stage; `step` is h, h^2 + h damping, ., share ahead.
PALPATE float weight_of_rate(int stage, const float* step) {
  if (stage == NEUMANN) return 0.0f;
  return step[1] - (stage == EXPLICIT ? 1.0f : step[3]) * step[0] * step[0];
}

// Triangles.

// A triangle's edges from corner 0, present and at rest. Rest vector plus difference of
// displacements: float32 keeps the digits of small strains.
struct Triangle {
  V3 a, b, rest_a, rest_b;

  // One over twice the area, which counts as a tenth of that at rest where it is less.
  PALPATE V scale() const {
    const V3 n = cross(a, b), rn = cross(rest_a, rest_b);
    return 1.0f / vsqrt(vmax(dot(n, n), 0.01f * dot(rn, rn) + 1e-30f));
  }
};

PALPATE Triangle triangle(const float* disp, const int* node, const float* rest, Lane lane) {
  const V3 ra = ld3(rest, 0, lane), rb = ld3(rest, 3, lane), u = gather3(disp, node, lane);
  return {ra + gather3(disp, node + 8, lane) - u, rb + gather3(disp, node + 16, lane) - u, ra, rb};
}

// Unit normal of each triangle; below a tenth of its rest area it fades, and the hinge forces too.
template <class Fields>
PALPATE void elem_normal(const Fields& f, Thread t, int) {
  const float* disp = f.system.disp_trial.data + 24 * (size_t)t.world * f.shape.nslice;
  const size_t mesh = mesh_of(f, t.world);
  each_slice(t, f.shape.nelemslice, [&](int s, Lane lane) {
    const int* node = f.shape.elem_node.data + mesh + 24 * s;
    const Triangle e = triangle(disp, node, f.shape.elem_rest.data + mesh + 48 * s, lane);
    float* out = f.system.elem_normal.data + 32 * ((size_t)t.world * f.shape.nelemslice + s);
    st3(out, e.scale() * cross(e.a, e.b), lane);
  });
}

// Hinges.

// Angle psi = 2 sin(theta / 2) between the normals l and r about an edge e, and cos(theta / 2): no
// inverse trigonometry, and bounded when folded. Past a right angle the half angle comes from its
// sine, which is better conditioned there.
struct Angle { V psi, half; };

PALPATE Angle angle(V3 l, V3 r, V3 e, V length2) {
  const V cosine = dot(l, r), sine = dot(cross(l, r), e) / vsqrt(length2);
  const V chalf = vsqrt(vmax(0.5f + 0.5f * cosine, splat(1e-12f)));
  const V shalf = vsqrt(vmax(0.5f - 0.5f * cosine, splat(1e-12f)));
  const V zero = splat(0.0f), size = select(sine < zero, -sine, sine);
  return {select(cosine > zero, sine / chalf, 2.0f * select(sine < zero, -shalf, shalf)),
          select(cosine > zero, chalf, 0.5f * size / shalf)};
}

// Strain impulse of each hinge: h (psi - psi0) and what K v has of it, by the gradient of theta
// with the apexes' heights and feet (Bergou et al. 2006, Grinspun et al. 2003).
template <class Fields>
PALPATE void hinge_angle(const Fields& f, Thread t, int stage) {
  const float* step = f.state.step.data + 4 * t.world;
  const float h = step[0], gv = weight_of_rate(stage, step);
  const float plate = numbers(f, t.world)[PLATE];
  const size_t base = 24 * (size_t)t.world * f.shape.nslice;
  const float* disp = f.system.disp_trial.data + base;
  const float* vel = f.system.vel_trial.data + base;
  const float* normal = f.system.elem_normal.data + 32 * (size_t)t.world * f.shape.nelemslice;
  const size_t mesh = mesh_of(f, t.world);
  each_slice(t, f.shape.nhingeslice, [&](int s, Lane lane) {
    const int* node = f.shape.hinge_node.data + mesh + 32 * s;
    const int* elem = f.shape.hinge_elem.data + mesh + 16 * s;
    const float* rest = f.shape.hinge_rest.data + mesh + 72 * s;
    const V3 re = ld3(rest, 0, lane), ra = ld3(rest, 3, lane), rb = ld3(rest, 6, lane);
    const V3 u = gather3(disp, node, lane);
    const V3 e = re + gather3(disp, node + 8, lane) - u;
    V3 a = ra + gather3(disp, node + 16, lane) - u;
    V3 b = rb + gather3(disp, node + 24, lane) - u;
    const V3 l = gather3(normal, elem, lane), r = gather3(normal, elem + 8, lane);
    const V length2 = vmax(dot(e, e), splat(1e-30f));
    const Angle now = angle(l, r, e, length2);
    // From the apexes' feet on the edge to the apexes, and how these move against their feet.
    const V foot_l = dot(a, e) / length2, foot_r = dot(b, e) / length2;
    a -= foot_l * e;
    b -= foot_r * e;
    const V3 v = gather3(vel, node, lane), w = gather3(vel, node + 8, lane);
    V3 c = gather3(vel, node + 16, lane), d = gather3(vel, node + 24, lane);
    c -= v + foot_l * (w - v);
    d -= v + foot_r * (w - v);
    // Heights of the apexes, not below a tenth of those at rest.
    const V3 na = cross(ra, re), nb = cross(rb, re);
    const V rest2 = 0.01f / vmax(dot(re, re), splat(1e-30f));
    const V rate = -dot(l, c) / vsqrt(vmax(dot(a, a), dot(na, na) * rest2 + 1e-30f))
      - dot(r, d) / vsqrt(vmax(dot(b, b), dot(nb, nb) * rest2 + 1e-30f));
    const size_t out = (size_t)t.world * f.shape.nhingeslice + s;
    const V change = now.psi - ld(f.shape.hinge_angle0.data + mesh, s, lane);
    st(f.system.hinge_angle.data + 8 * out, 0, h * change + gv * now.half * rate, lane);
    st(f.system.hinge_half.data + 8 * out, 0, now.half, lane);
    // What the bending matrix may leave out here, see elem_corner.
    const V fold = 4.0f - 4.0f * now.half * now.half + 2.0f * change * change;
    V gain = plate * ld(f.tissue.hinge_gain.data + mesh, 5 * s, lane);
    if (f.lump.hinge.data) {
      const float* factor = f.lump.hinge.data + 16 * out;
      gain = gain * vmax(ld(factor, 0, lane), ld(factor, 1, lane));
    }
    st(f.system.hinge_rough.data + 8 * out, 0, gain * fold, lane);
  });
}

// Moment impulse of each hinge: a plate's hinges of one triangle act on each other.
template <class Fields>
PALPATE void hinge_moment(const Fields& f, Thread t, int) {
  const size_t base = (size_t)t.world * f.shape.nhingeslice;
  const float* angle = f.system.hinge_angle.data + 8 * base;
  const float plate = numbers(f, t.world)[PLATE];
  const size_t mesh = mesh_of(f, t.world);
  each_slice(t, f.shape.nhingeslice, [&](int s, Lane lane) {
    const int* near = f.shape.hinge_near.data + mesh + 32 * s;
    const float* gain = f.tissue.hinge_gain.data + mesh + 40 * s;
    const V own = ld(angle, s, lane);
    V sum = ld(gain, 0, lane) * own;
    if (f.lump.hinge.data) {
      // Two neighbours are the left triangle's, two the right one's.
      const float* factor = f.lump.hinge.data + 16 * (base + s);
      const V l = ld(factor, 0, lane), r = ld(factor, 1, lane);
      sum = r * sum + (l - r) * ld(f.lump.hinge_left.data, s, lane) * own;
      for (int k = 0; k < 4; ++k)
        sum += (k < 2 ? l : r) * ld(gain, k + 1, lane) * gather(angle, near + 8 * k, 0, lane);
    } else {
      for (int k = 0; k < 4; ++k)
        sum += ld(gain, k + 1, lane) * gather(angle, near + 8 * k, 0, lane);
    }
    const V half = ld(f.system.hinge_half.data + 8 * base, s, lane);
    st(f.system.hinge_moment.data + 8 * base, s, plate * sum * half, lane);
  });
}

// A triangle's part of minus moment times grad theta lies along its normal: one number a corner.
//
// The bending matrix n Q n^T takes normals of nodes for those of triangles, and rest heights. The
// step is stable while the matrix is at least half the true Hessian; on thick shells, folded,
// crushed or curved like their thickness, it fell short by factors of 10 to 100. What it leaves out
// grows with a hinge's angle squared, and with moment times change of angle in the Hessian's second
// derivatives; over the heights squared that is a stiffness, which the triangle's edges get. It
// acts on dv alone, so no rest state depends on it, and a product with the matrix costs the same.
template <class Fields>
PALPATE void elem_corner(const Fields& f, Thread t, int) {
  const float* disp = f.system.disp_trial.data + 24 * (size_t)t.world * f.shape.nslice;
  const float* moment = f.system.hinge_moment.data + 8 * (size_t)t.world * f.shape.nhingeslice;
  const float* rough = f.system.hinge_rough.data + 8 * (size_t)t.world * f.shape.nhingeslice;
  const size_t mesh = mesh_of(f, t.world);
  each_slice(t, f.shape.nelemslice, [&](int s, Lane lane) {
    const int* node = f.shape.elem_node.data + mesh + 24 * s;
    const int* hinge = f.shape.elem_hinge.data + mesh + 24 * s;
    const Triangle e = triangle(disp, node, f.shape.elem_rest.data + mesh + 48 * s, lane);
    const V3 a = e.a, b = e.b, c = b - a;
    const V scale = e.scale();
    const V aa = dot(a, a), bb = dot(b, b), cc = dot(c, c), ab = dot(a, b);
    const V ac = dot(a, c), bc = dot(b, c);
    // Moment over height, and shares of the edge's two ends: 1 / height = |edge| / (2 area).
    const V m0 = gather(moment, hinge, 0, lane) * scale;
    const V m1 = gather(moment, hinge + 8, 0, lane) * scale;
    const V m2 = gather(moment, hinge + 16, 0, lane) * scale;
    const V l0 = vsqrt(cc), l1 = vsqrt(bb), l2 = vsqrt(aa);
    const V i0 = m0 / vmax(l0, splat(1e-15f)), i1 = m1 / vmax(l1, splat(1e-15f));
    const V i2 = m2 / vmax(l2, splat(1e-15f));
    const size_t at = (size_t)t.world * f.shape.nelemslice + s;
    // Edge 1 -> 2 seen from 0, edge 2 -> 0 from 1, edge 0 -> 1 from 2.
    st3(f.system.elem_corner.data + 24 * at,
        {m0 * l0 - i1 * (bb - ab) - i2 * (aa - ab), m1 * l1 - i0 * bc - i2 * ab,
         m2 * l2 + i0 * ac - i1 * ab}, lane);
    const V cover = scale * scale
      * (gather(rough, hinge, 0, lane) * cc + gather(rough, hinge + 8, 0, lane) * bb
         + gather(rough, hinge + 16, 0, lane) * aa);
    st(f.system.elem_normal.data + 32 * at, 3, cover, lane);
  });
}

}  // namespace palpate
