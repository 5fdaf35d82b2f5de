// Points of triangles.
#pragma once
#include "core/d3.h"

namespace palpate {

PALPATE D3 unit(D3 a) {
  const double size = norm(a);
  return (1.0 / (size > 1e-300 ? size : 1e-300)) * a;
}

// A vector that `s` has along its axes x, y and z.
template <class Axes>
PALPATE D3 in_axes(const Axes& s, D3 a) { return a.x * s.x + a.y * s.y + a.z * s.z; }

// Makes the axes those of a triangle: its first edge, its normal, and what is across to both.
template <class Axes>
PALPATE void set_axes(Axes& s, D3 edge, D3 other) {
  const D3 zero = {0.0, 0.0, 0.0}, area = cross(edge, other);
  const double length = norm(edge), size = norm(area);
  s.x = length > 0.0 ? (1.0 / length) * edge : zero;
  s.z = size > 0.0 ? (1.0 / size) * area : zero;
  s.y = cross(s.z, s.x);
}

// 1 of an equilateral triangle.
PALPATE double shape_of(const D3* x) {
  const D3 a = x[1] - x[0], b = x[2] - x[1], c = x[0] - x[2];
  return 2.0 * sqrt(3.0) * norm(cross(a, x[2] - x[0])) / (dot(a, a) + dot(b, b) + dot(c, c));
}

// The barycentric weights of the point nearest to p on the edge from a to b; `far2` gets the square
// of its distance.
PALPATE double along_edge(D3 p, D3 a, D3 b, double& far2) {
  const D3 e = b - a, r = p - a;
  const double e2 = dot(e, e);
  double t = e2 > 0.0 ? dot(r, e) / e2 : 0.0;
  t = t < 0.0 ? 0.0 : t > 1.0 ? 1.0 : t;
  const D3 off = r - t * e;
  far2 = dot(off, off);
  return t;
}

// The barycentric weights of the point of a triangle that is nearest to p. With edges e, g from
// corner 0 those of p's projection solve [e.e e.g; e.g g.g] (v, w) = (e.r, g.r), r = p - x0 (Ericson
// 2005, Real-Time Collision Detection, 3.4); one outside has its nearest point on an edge.
PALPATE D3 barycentric(D3 p, const D3* x) {
  const D3 e = x[1] - x[0], g = x[2] - x[0], r = p - x[0];
  const double ee = dot(e, e), eg = dot(e, g), gg = dot(g, g), er = dot(e, r), gr = dot(g, r);
  const double det = ee * gg - eg * eg;
  if (det > 0.0) {
    const double v = (gg * er - eg * gr) / det, w = (ee * gr - eg * er) / det;
    if (v >= 0.0 && w >= 0.0 && v + w <= 1.0) return {1.0 - v - w, v, w};
  }
  double far0, far1, far2;
  const double t0 = along_edge(p, x[0], x[1], far0), t1 = along_edge(p, x[1], x[2], far1);
  const double t2 = along_edge(p, x[2], x[0], far2);
  if (far0 <= far1 && far0 <= far2) return {1.0 - t0, t0, 0.0};
  return far1 <= far2 ? D3{0.0, 1.0 - t1, t1} : D3{t2, 0.0, 1.0 - t2};
}

// The place in a triangle that weights mean.
PALPATE D3 blend(const D3* x, D3 w) { return w.x * x[0] + w.y * x[1] + w.z * x[2]; }

}  // namespace palpate
