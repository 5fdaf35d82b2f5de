// A discrete elastic rod: stretching, bending and twisting (Bergou et al. 2008,
// doi:10.1145/1360612.1360662, and 2010, doi:10.1145/1778765.1778853), straight where nothing acts, unless it
// has yielded: then a node has a curvature at rest.
//
// Node i has four unknowns, its place and the turn of edge i, which leads to node i + 1, about itself.
// A turn is counted from the start of the step. The twist at a node between two edges is kept from step
// to step; it changes by the edges' turns, and by how the frames that the rod carries along turn with its
// tangents.
#pragma once
#include "core/lanes.h"
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

// Whether an edge is there: not if it has broken.
template <class Fields>
PALPATE bool is_whole(const Fields& f, int edge) { return f.own.broken.data[edge] == 0.0; }

// Whether a node inside bends and twists.
template <class Fields>
PALPATE bool is_joint(const Fields& f, int i) { return is_whole(f, i - 1) && is_whole(f, i); }

template <class Fields>
PALPATE double tension_of(const Fields& f, const double* x, int edge) {
  if (!is_whole(f, edge)) return 0.0;
  return f.stretch.data[edge] * (norm(load(x + 3 * edge + 3) - load(x + 3 * edge)) - f.length.data[edge]);
}

// The tension of an edge after a move, four numbers a node, by how its ends part along it.
template <class Fields>
PALPATE double expected_tension(const Fields& f, const double* x, const double* move, int edge) {
  const D3 parts = load(move + 4 * edge + 4) - load(move + 4 * edge);
  return is_whole(f, edge) ? tension_of(f, x, edge) + f.stretch.data[edge] * dot(parts, tangent(x, edge)) : 0.0;
}

// The twist at a node inside, with edges turned by `turn` since the step began.
template <class Fields>
PALPATE double twist_at(const Fields& f, const double* x, const double* turn, int i) {
  const double* x0 = f.start.data;
  return f.own.twist.data[i] + turn[i] - turn[i - 1] +
         turned_against(tangent(x0, i - 1), tangent(x0, i), tangent(x, i - 1), tangent(x, i));
}

// A vector turned by the smallest rotation from the unit vector a to b.
PALPATE D3 turned_along(D3 u, D3 a, D3 b) {
  const double c = 1.0 + dot(a, b);
  return u - (dot(u, a + b) / (c > 1e-9 ? c : 1e-9)) * (a + b) + 2.0 * dot(a, u) * b;
}

// The curvature at rest of a node, turned as one of its edges has since the step began.
template <class Fields>
PALPATE D3 rest_by(const Fields& f, const double* x, const double* turn, int i, int edge) {
  const D3 a = tangent(f.start.data, edge), b = tangent(x, edge);
  const D3 u = turned_along(load(f.own.rest_curvature.data + 3 * i), a, b);
  const double c = cos(turn[edge]), s = sin(turn[edge]);
  return c * u + s * cross(b, u) + ((1.0 - c) * dot(b, u)) * b;
}

// The mean of both, as long as the edges turn alike.
template <class Fields>
PALPATE D3 rest_at(const Fields& f, const double* x, const double* turn, int i) {
  return 0.5 * (rest_by(f, x, turn, i, i - 1) + rest_by(f, x, turn, i, i));
}

// The elastic energy of this lane's nodes [J].
template <class Fields>
CALLED double rod_energy(const Fields& f, const double* x, const double* turn) {
  double sum = 0.0;
  each_lane(0, f.nnode - 1, [&](int i) {
    const double longer = norm(load(x + 3 * i + 3) - load(x + 3 * i)) - f.length.data[i];
    if (is_whole(f, i)) sum += 0.5 * f.stretch.data[i] * longer * longer;
    if (!i || !is_joint(f, i)) return;
    D3 k = bent(x, i).curvature;
    if (f.yields) k = k - rest_at(f, x, turn, i);
    sum += 0.5 * f.bend.data[i] * dot(k, k);
    if (f.twists) {
      const double m = twist_at(f, x, turn, i);
      sum += 0.5 * f.torsion.data[i] * m * m;
    }
  });
  return sum;
}

// A matrix over the unknowns of nodes in an order in which those that have to do with each other are near.
// Without twist a node has three.
struct RodMatrix : Envelope {
  const int* rank;  // of a node in that order
  int per;          // unknowns of a node

  PALPATE int of(int node, int c) const { return per * rank[node] + c; }

  // Adds value(c, d) for rows c of one node and columns d of another; of the same node's the lower triangle.
  template <class Value>
  PALPATE void add(int node, int rows, int other, int columns, Value value) const {
    const int p = of(node, 0), q = of(other, 0);
    if (q > p) {
      for (int d = 0; d < columns; ++d) {
        double* to = row(q + d) + p;
        for (int c = 0; c < rows; ++c) to[c] += value(c, d);
      }
      return;
    }
    for (int c = 0; c < rows; ++c) {
      double* to = row(p + c) + q;
      for (int d = 0; d < (p == q ? c + 1 : columns); ++d) to[d] += value(c, d);
    }
  }
};

#if ON_CUDA
// Adds value(a, b) for each two of `count` unknowns, whose numbers in the matrix are of(a), by all lanes together.
template <class Of, class Value>
PALPATE void add_together(const RodMatrix& H, int count, Of of, Value value) {
  each_lane(0, count * (count + 1) / 2, [&](int pair) {
    const Corner at = corner(pair);
    const double more = value(at.row, at.column);
    if (more != 0.0) H.at(of(at.row), of(at.column)) += more;
  });
}
#endif

// What nodes add to the gradient, and to the matrix: the places of each, not its turn.
template <int NODES>
struct Terms {
  static constexpr int COUNT = 3 * NODES;
  double g[COUNT] = {}, K[COUNT][COUNT] = {};  // of K the lower triangle

  // Force v, and stiffness v v^T.
  PALPATE void add(const double* v, double force, double stiffness) {
    for (int a = 0; a < COUNT; ++a) {
      g[a] += force * v[a];
      const double s = stiffness * v[a];
      const int most = a / 4 * 4 + 4;  // to the diagonal, by whole vectors
      for (int b = 0; b < COUNT && b < most; ++b) K[a][b] += s * v[b];
    }
  }
  // Along `axis`, by the nodes' weights.
  PALPATE void add(const double* w, D3 axis, double force, double stiffness) {
    double v[COUNT];
    for (int k = 0; k < NODES; ++k) store(v + 3 * k, w[k] * axis);
    add(v, force, stiffness);
  }
  // Along every axis.
  PALPATE void add_each(const double* w, double stiffness) {
    for (int k = 0; k < NODES; ++k)
      for (int m = 0; m <= k; ++m)
        for (int c = 0; c < 3; ++c) K[3 * k + c][3 * m + c] += stiffness * w[k] * w[m];
  }
  PALPATE void scatter(const int* node, double* into, const RodMatrix& H) const {
    for (int k = 0; k < NODES; ++k) {
      for (int c = 0; c < 3; ++c) into[4 * node[k] + c] += g[3 * k + c];
      for (int m = 0; m <= k; ++m)
        H.add(node[k], 3, node[m], 3, [&](int c, int d) { return K[3 * k + c][3 * m + d]; });
    }
  }
  // The same where all lanes have these terms.
  PALPATE void scatter_together(const int* node, double* into, const RodMatrix& H) const {
#if ON_CUDA
    each_lane(0, COUNT, [&](int a) { into[4 * node[a / 3] + a % 3] += g[a]; });
    add_together(H, COUNT, [&](int a) { return H.of(node[a / 3], a % 3); }, [&](int a, int b) { return K[a][b]; });
#else
    scatter(node, into, H);
#endif
  }
};

// Adds the gradient and second derivative of the twist at node i, but for that of the twist itself.
template <class Fields>
PALPATE void add_twist(const Fields& f, const Bent& b, int i, double twist, double* g, const RodMatrix& H) {
  const D3 me = (0.5 / b.le) * b.curvature, mf = (0.5 / b.lf) * b.curvature;
  double v[12] = {};  // of three nodes, and their turns
  store(v, -1.0 * me);
  v[3] = -1.0;
  store(v + 4, me - mf);
  v[7] = 1.0;
  store(v + 8, mf);
  const double k = f.torsion.data[i];
  for (int a = 0; a < 11; ++a) g[4 * i - 4 + a] += k * twist * v[a];
  for (int n = 0; n < 3; ++n)
    for (int m = 0; m <= n; ++m)
      H.add(i - 1 + n, n < 2 ? 4 : 3, i - 1 + m, m < 2 ? 4 : 3, [&](int c, int d) { return k * v[4 * n + c] * v[4 * m + d]; });
}

// Adds the gradient of the bending of node i, which may have a curvature at rest, and its second derivative: where that
// is not to be `exact` the part by the first derivatives (Gauss-Newton). Unknowns are both edges e and f, each with its
// turn about itself, until they are spread to the nodes.
template <class Fields>
PALPATE void add_bend(
    const Fields& f, const double* x, const double* turn, const Bent& b, int i, double* g, const RodMatrix& H,
    bool exact) {
  const D3 rest[2] = {rest_by(f, x, turn, i, i - 1), rest_by(f, x, turn, i, i)};
  const D3 k = b.curvature, off = k - 0.5 * (rest[0] + rest[1]), edge[2] = {b.e, b.f};
  const double length[2] = {b.le, b.lf}, per = 1.0 / b.chi;
  // Of each unknown: what it adds to `off`, how it turns its edge, and what it adds to chi; products of these.
  D3 by[8], turns[8];
  double chi[8] = {}, bends[8] = {}, along[8], across[8], along_edge[8] = {};
  for (int s = 0; s < 2; ++s) {
    const D3 other = edge[1 - s], own = (1.0 / length[s]) * edge[s], before = tangent(f.start.data, i - 1 + s);
    // It turns about itself as it is moved: the smallest rotation from where it was does.
    const D3 about = (1.0 / (1.0 + dot(before, own) + 1e-300)) * cross(before, own);
    for (int c = 0; c < 4; ++c) {
      const int a = 4 * s + c;
      const D3 axis = {c == 0 ? 1.0 : 0.0, c == 1 ? 1.0 : 0.0, c == 2 ? 1.0 : 0.0};
      D3 curves = {0.0, 0.0, 0.0};
      turns[a] = own;
      if (c < 3) {
        along_edge[a] = dot(own, axis);
        chi[a] = length[1 - s] * along_edge[a] + dot(other, axis);
        curves = per * (2.0 * (s ? cross(other, axis) : cross(axis, other)) - chi[a] * k);
        turns[a] = (1.0 / length[s]) * (cross(own, axis) - dot(about, axis) * own);
      }
      bends[a] = dot(off, curves);
      by[a] = curves - 0.5 * cross(turns[a], rest[s]);
      along[a] = dot(turns[a], off), across[a] = dot(turns[a], rest[s]);
    }
  }
  const double whole = dot(off, k), o[3] = {off.x, off.y, off.z};
  double slope[8], M[8][8];
  for (int p = 0; p < 8; ++p) {
    slope[p] = dot(off, by[p]);
    for (int q = 0; q <= p; ++q) {
      double value = dot(by[p], by[q]);
      if (exact) {
        const int s = p / 4, c = p % 4, d = q % 4;
        const double same = c == d ? 1.0 : 0.0;
        value -= per * (bends[p] * chi[q] + bends[q] * chi[p]);
        if (s == q / 4)  // how the edge turns its curvature at rest further
          value += 0.5 * dot(off, rest[s]) * dot(turns[p], turns[q]) - 0.25 * (along[p] * across[q] + across[p] * along[q]);
        if (c < 3 && d < 3) {
          const double both = s == q / 4 ? length[1 - s] / length[s] * (same - along_edge[p] * along_edge[q])
                                         : same + along_edge[p] * along_edge[q];
          const double crossed = s == q / 4 || c == d ? 0.0 : (c - d + 3) % 3 == 1 ? o[3 - c - d] : -o[3 - c - d];
          value += per * (2.0 * crossed - whole * both);
        }
      }
      M[p][q] = M[q][p] = value;
    }
  }
  const auto spread = [](const double* v, int a) {
    return a < 3 ? -v[a] : a == 3 || a == 7 ? v[a] : a < 7 ? v[a - 4] - v[a] : v[a - 4];
  };
  const double B = f.bend.data[i];
  double rows[11][8];
  for (int a = 0; a < 11; ++a) {
    g[4 * i - 4 + a] += B * spread(slope, a);
    for (int q = 0; q < 8; ++q) rows[a][q] = spread(M[q], a);
  }
  for (int n = 0; n < 3; ++n)
    for (int m = 0; m <= n; ++m) {
      const auto value = [&](int c, int d) { return B * spread(rows[4 * n + c], 4 * m + d); };
      H.add(i - 1 + n, n < 2 ? 4 : 3, i - 1 + m, m < 2 ? 4 : 3, value);
    }
}

// Keeps the bend by which a node is bent further than it bears at the end of a step, at x (perfect plasticity; return
// mapping, Simo and Hughes 1998, doi:10.1007/b98904, section 1.4).
template <class Fields>
PALPATE void yield_at(const Fields& f, const double* x, const double* turn, int i) {
  double* own = f.own.rest_curvature.data + 3 * i;
  const D3 mean = rest_at(f, x, turn, i);
  const double most = f.most_bent.data[i], length = norm(mean);
  D3 rest = length > 0.0 ? (norm(load(own)) / length) * mean : mean;  // as long as before
  const D3 off = bent(x, i).curvature - rest;
  const double far = norm(off);
  if (far > most) rest = rest + (1.0 - most / far) * off;
  store(own, rest);
}

// Adds the gradient of the energy and its second derivative, or where that is not to be `exact` a part of it
// that is positive: without the thrust of edges, and without what a moment does as edges turn. Edges resist turning by
// the tension that a whole move led to expect, `f.pull`: as a light node swings far its edge gets longer for now, and by
// that tension the node would seem held.
template <class Fields>
PALPATE void add_rod(const Fields& f, const double* x, const double* turn, double* g, const RodMatrix& H, bool exact) {
  each_apart<2>(0, f.nnode - 1, [&](int i) {
    if (!is_whole(f, i)) return;
    const D3 e = load(x + 3 * i + 3) - load(x + 3 * i);
    const double l = norm(e) + 1e-300, k = f.stretch.data[i], tension = k * (l - f.length.data[i]);
    const double w[2] = {-1.0, 1.0}, pull = f.pull.data[i], across = exact || pull > 0.0 ? pull / l : 0.0;
    Terms<2> terms;
    terms.add(w, (1.0 / l) * e, tension, k - across);
    terms.add_each(w, across);
    const int node[2] = {i, i + 1};
    terms.scatter(node, g, H);
  });
  each_apart<3>(1, f.nnode - 1, [&](int i) {
    if (!is_joint(f, i)) return;
    // The energy is 2 B t^2, t the tangent of half the angle between the edges: in their plane a function
    // of that angle, across it of how they turn against each other and with each other.
    const Bent b = bent(x, i);
    if (f.yields) {
      add_bend(f, x, turn, b, i, g, H, exact);
      add_twist(f, b, i, twist_at(f, x, turn, i), g, H);
      return;
    }
    const double t = 0.5 * norm(b.curvature), B = f.bend.data[i], more = 1.0 + t * t;
    const D3 e = (1.0 / b.le) * b.e, d = (1.0 / b.lf) * b.f;
    const D3 axis = fabs(e.x) < 0.6 ? D3{1.0, 0.0, 0.0} : D3{0.0, 1.0, 0.0};
    const D3 n = unit(t > 1e-12 ? b.curvature : cross(e, axis)), pe = cross(n, e), pf = cross(n, d);
    const double re = 1.0 / b.le, rf = 1.0 / b.lf, moment = 2.0 * B * t * more;
    const D3 at_e = -moment * re * pe, at_f = moment * rf * pf;
    store(g + 4 * i - 4, load(g + 4 * i - 4) - at_e);
    store(g + 4 * i, load(g + 4 * i) + at_e - at_f);
    store(g + 4 * i + 4, load(g + 4 * i + 4) + at_f);
    // By the edges e and f, in their plane and across it.
    const double in = B * more * (1.0 + 3.0 * t * t), turns = exact ? B * t * t * more : 0.0, bends = exact ? moment : 0.0;
    const double E[3] = {e.x, e.y, e.z}, F[3] = {d.x, d.y, d.z}, N[3] = {n.x, n.y, n.z};
    const double P[3] = {pe.x, pe.y, pe.z}, Q[3] = {pf.x, pf.y, pf.z};
    double ee[3][3], fe[3][3], ff[3][3];
    for (int c = 0; c < 3; ++c)
      for (int k = 0; k < 3; ++k) {
        const double across = N[c] * N[k];
        ee[c][k] = re * re * (in * P[c] * P[k] + (B * more - turns) * across + bends * (E[c] * P[k] + P[c] * E[k]));
        ff[c][k] = rf * rf * (in * Q[c] * Q[k] + (B * more - turns) * across - bends * (F[c] * Q[k] + Q[c] * F[k]));
        fe[c][k] = -re * rf * (in * Q[c] * P[k] + (B * more + turns) * across);
      }
    H.add(i - 1, 3, i - 1, 3, [&](int c, int k) { return ee[c][k]; });
    H.add(i, 3, i - 1, 3, [&](int c, int k) { return fe[c][k] - ee[c][k]; });
    H.add(i, 3, i, 3, [&](int c, int k) { return ee[c][k] - fe[c][k] - fe[k][c] + ff[c][k]; });
    H.add(i + 1, 3, i - 1, 3, [&](int c, int k) { return -fe[c][k]; });
    H.add(i + 1, 3, i, 3, [&](int c, int k) { return fe[c][k] - ff[c][k]; });
    H.add(i + 1, 3, i + 1, 3, [&](int c, int k) { return ff[c][k]; });
    if (f.twists) add_twist(f, b, i, twist_at(f, x, turn, i), g, H);
  });
}

}  // namespace palpate
