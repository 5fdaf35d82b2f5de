// A discrete elastic rod: stretching, bending and twisting (Bergou et al. 2008,
// doi:10.1145/1360612.1360662, and 2010, doi:10.1145/1778765.1778853), straight where nothing acts.
//
// Node i has four unknowns, its place and the turn of edge i, which leads to node i + 1, about itself.
// A turn is counted from the start of the step. The twist at a node between two edges is kept from step
// to step; it changes by the edges' turns, and by how the frames that the rod carries along turn with its
// tangents.
#pragma once
#include "core/triangle.h"
#include "solver/envelope.h"

AS_WRITTEN

namespace palpate {

// What edges nearly folded back on themselves have at least of |e||f| + e.f, of 2 |e||f|.
constexpr double FOLDED = 1e-4;

struct Bent {
  D3 e, f;           // edges
  double le, lf;     // their lengths
  double chi;        // |e||f| + e.f
  D3 curvature;      // binormal, 2 e x f / chi: of length 2 tan(angle / 2)
};

PALPATE Bent bent(const double* x, int i) {
  Bent b;
  b.e = load(x + 3 * i) - load(x + 3 * i - 3);
  b.f = load(x + 3 * i + 3) - load(x + 3 * i);
  b.le = norm(b.e) + 1e-300;
  b.lf = norm(b.f) + 1e-300;
  const double least = 2.0 * FOLDED * b.le * b.lf, chi = b.le * b.lf + dot(b.e, b.f);
  b.chi = chi > least ? chi : least;
  b.curvature = (2.0 / b.chi) * cross(b.e, b.f);
  return b;
}

// A vector that is normal to the unit vector a, carried to b by the smallest rotation.
PALPATE D3 carried(D3 u, D3 a, D3 b) {
  const double c = 1.0 + dot(a, b);
  return u - (dot(u, b) / (c > 1e-9 ? c : 1e-9)) * (a + b);
}

// By how much frames carried along in time turn against each other at a node, where its tangents a and b
// become a1 and b1.
PALPATE double turned_against(D3 a, D3 b, D3 a1, D3 b1) {
  const D3 axis = fabs(a.x) < 0.6 ? D3{1.0, 0.0, 0.0} : D3{0.0, 1.0, 0.0};
  const D3 u = unit(cross(a, axis));
  const D3 there = carried(carried(u, a, b), b, b1), here = carried(carried(u, a, a1), a1, b1);
  return atan2(dot(cross(here, there), b1), dot(here, there));
}

PALPATE D3 tangent(const double* x, int i) { return unit(load(x + 3 * i + 3) - load(x + 3 * i)); }

// The twist at a node inside, with edges turned by `turn` since the step began.
template <class Fields>
PALPATE double twist_at(const Fields& f, const double* x, const double* turn, int i) {
  const double* x0 = f.start.data;
  return f.own.twist.data[i] + turn[i] - turn[i - 1] +
         turned_against(tangent(x0, i - 1), tangent(x0, i), tangent(x, i - 1), tangent(x, i));
}

// The elastic energy [J].
template <class Fields>
PALPATE double rod_energy(const Fields& f, const double* x, const double* turn) {
  double sum = 0.0;
  for (int i = 0; i + 1 < f.nnode; ++i) {
    const double longer = norm(load(x + 3 * i + 3) - load(x + 3 * i)) - f.length.data[i];
    sum += 0.5 * f.stretch.data[i] * longer * longer;
    if (!i) continue;
    const D3 k = bent(x, i).curvature;
    sum += 0.5 * f.bend.data[i] * dot(k, k);
    if (f.twists) {
      const double m = twist_at(f, x, turn, i);
      sum += 0.5 * f.torsion.data[i] * m * m;
    }
  }
  return sum;
}

// Adds force * v to a gradient and stiffness v v^T to a matrix, v of `n` entries from unknown `at` on.
PALPATE void add_term(
    double* g, const Envelope& H, int at, const double* v, int n, double force, double stiffness) {
  for (int a = 0; a < n; ++a) {
    if (v[a] == 0.0) continue;
    g[at + a] += force * v[a];
    const double s = stiffness * v[a];
    double* row = H.row(at + a) + at;
    for (int b = 0; b <= a; ++b)
      if (v[b] != 0.0) row[b] += s * v[b];
  }
}

// Adds the gradient of the energy, and of its second derivative what is positive: that of the squares
// (Gauss and Newton), and the tension of edges.
template <class Fields>
PALPATE void add_rod(const Fields& f, const double* x, const double* turn, double* g, const Envelope& H) {
  for (int i = 0; i + 1 < f.nnode; ++i) {
    const D3 e = load(x + 3 * i + 3) - load(x + 3 * i);
    const double l = norm(e) + 1e-300, k = f.stretch.data[i], tension = k * (l - f.length.data[i]);
    const D3 t = (1.0 / l) * e;
    double v[7] = {-t.x, -t.y, -t.z, 0.0, t.x, t.y, t.z};
    const double across = tension > 0.0 ? tension / l : 0.0;
    add_term(g, H, 4 * i, v, 7, tension, k - across);
    for (int c = 0; c < 3; ++c) {
      H.at(4 * i + c, 4 * i + c) += across;
      H.at(4 * i + 4 + c, 4 * i + 4 + c) += across;
      H.at(4 * i + 4 + c, 4 * i + c) -= across;
    }
  }
  for (int i = 1; i + 1 < f.nnode; ++i) {
    const Bent b = bent(x, i);
    const double k[3] = {b.curvature.x, b.curvature.y, b.curvature.z}, per = 1.0 / b.chi;
    const D3 we = (b.lf / b.le) * b.e + b.f, wf = (b.le / b.lf) * b.f + b.e;
    const D3 axis[3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    for (int r = 0; r < 3; ++r) {
      // Row r of [a]x, as a vector, is axis x a.
      const D3 de = per * (-2.0 * cross(axis[r], b.f) - k[r] * we);
      const D3 df = per * (2.0 * cross(axis[r], b.e) - k[r] * wf);
      double v[11] = {};
      store(v, -1.0 * de);
      store(v + 4, de - df);
      store(v + 8, df);
      add_term(g, H, 4 * i - 4, v, 11, f.bend.data[i] * k[r], f.bend.data[i]);
    }
    if (!f.twists) continue;
    const D3 me = (0.5 / b.le) * b.curvature, mf = (0.5 / b.lf) * b.curvature;
    double v[11] = {};
    store(v, -1.0 * me);
    v[3] = -1.0;
    store(v + 4, me - mf);
    v[7] = 1.0;
    store(v + 8, mf);
    add_term(g, H, 4 * i - 4, v, 11, f.torsion.data[i] * twist_at(f, x, turn, i), f.torsion.data[i]);
  }
}

}  // namespace palpate
