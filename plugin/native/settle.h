// Vertices of a solid are moved onto a sheet in the rest shape, as far as its tetrahedra allow.
#pragma once
#include "neohookean.h"
#include "parts.h"
#include "sheet.h"

namespace palpate {

constexpr double THICK = 0.15, KEPT = 0.9;  // least quality of a tetrahedron, or so much of what it had
constexpr double TURNED = 0.95;  // least cosine between a triangle's normals before and after
constexpr int ROUNDS = 10;
constexpr double ABOVE = 1.005;  // times its energy that the tissue around a vertex may have when it moved
constexpr double SHORTER = 0.7;
constexpr double GIVES = 0.1;  // share of its way down to which a vertex inside gives way to the skin's
constexpr double LIPS = 0.75;  // edges from the path within which a vertex of the skin goes to it
constexpr int EXACT = 3;  // times that the volume is put right

// A vertex that moves to a place in a tetrahedron.
struct Shift { int vert, corner[4]; double share, weight[4]; D3 way, lead; };

// 1 for a regular tetrahedron.
PALPATE double quality_of(const D3* x) {
  double sum = 0.0;
  for (int i = 0; i < 4; ++i)
    for (int j = i + 1; j < 4; ++j) sum += dot(x[j] - x[i], x[j] - x[i]);
  const double length2 = sum / 6.0 > 1e-300 ? sum / 6.0 : 1e-300;
  return 6.0 * sqrt(2.0) * volume_of(x) / (length2 * sqrt(length2));
}

// Where a vertex of the skin goes on it: to the path where that is near.
template <class S>
PALPATE D3 goal_on_skin(const S& m, const Sheet& sheet, double edge, int v, D3 goal) {
  double far, least = 1e300;
  const D3 at = nearest_on(sheet.path, sheet.npath, m.place(v), far);
  if (far < LIPS * edge) goal = at;
  D3 best = goal;
  int low = -1;
  m.each_triangle(v, [&](int t) {
    if (t >= m.nelem) return;
    D3 x[3];
    for (int c = 0; c < 3; ++c) x[c] = m.place((int)m.elem[3 * t + c]);
    const D3 on = blend(x, barycentric(goal, x));
    const double off = norm(on - goal);
    if (off < least || (off == least && t < low)) least = off, best = on, low = t;
  });
  return best;
}

// Finds the tetrahedron in which a goal is, or which it is the least outside of, and the weights of its
// corners there.
template <class S>
PALPATE void find_weights(const S& m, int v, D3 goal, Shift& out) {
  double most = -1e300;
  m.each_corner(v, [&](int corner) {
    const int t = corner / 4;
    D3 x[4];
    m.corners(t, x);
    const D3 a = x[1] - x[0], b = x[2] - x[0], c = x[3] - x[0], g = goal - x[0];
    const double det = dot(a, cross(b, c));
    double w[4] = {0.0, dot(g, cross(b, c)) / det, dot(g, cross(c, a)) / det, dot(g, cross(a, b)) / det};
    w[0] = 1.0 - (w[1] + w[2] + w[3]);
    double least = w[0];
    for (int k = 1; k < 4; ++k) least = w[k] < least ? w[k] : least;
    if (least <= most) return;
    most = least;
    for (int k = 0; k < 4; ++k) out.corner[k] = m.vert(4 * t + k), out.weight[k] = w[k];
  });
}

PALPATE D3 at_corners(const double* values, const Shift& a) {
  D3 out = {0.0, 0.0, 0.0};
  for (int k = 0; k < 4; ++k) out += a.weight[k] * load(values + 3 * a.corner[k]);
  return out;
}

// The tetrahedra and triangles around vertices that move, as they are before.
struct Nearby {
  Few tet, side;
  double *least, *had;
  D3* normal;
};

// Where a vertex is, and its displacement, with its share of its way; `mover` tells which moves, from 1.
template <class S>
PALPATE D3 moved_place(const S& m, const Shift* shift, const int* mover, int v) {
  const int k = mover[v] - 1;
  return k < 0 ? m.place(v) : m.place(v) + shift[k].share * shift[k].way;
}
PALPATE D3 moved_disp(const double* disp, const Shift* shift, const int* mover, int v) {
  const int k = mover[v] - 1;
  return k < 0 ? load(disp + 3 * v) : load(disp + 3 * v) + shift[k].share * shift[k].lead;
}

template <class S>
PALPATE D3 moved_normal(const S& m, const Shift* shift, const int* mover, int t) {
  D3 x[3];
  for (int c = 0; c < 3; ++c) x[c] = moved_place(m, shift, mover, (int)m.elem[3 * t + c]);
  return unit(cross(x[1] - x[0], x[2] - x[0]));
}

// Finds what is around vertices that do not move yet.
template <class S>
PALPATE bool find_nearby(const S& m, const Few& movers, const Shift* shift, const Neohookean& p,
                         Nearby& out, Scratch& memory) {
  for (int i = 0; i < movers.count; ++i) {
    m.each_corner(movers.list[i], [&](int corner) { out.tet.put(corner / 4); });
    m.each_triangle(movers.list[i], [&](int t) { out.side.put(t); });
  }
  out.tet.sort(m.ntet);
  out.least = memory.values(out.tet.count), out.had = memory.values(out.tet.count);
  out.normal = (D3*)memory.values(3 * out.side.count);
  if (memory.full) return false;
  for (int i = 0; i < out.tet.count; ++i) {
    const int t = out.tet.list[i];
    D3 x[4], u[4];
    m.corners(t, x);
    for (int c = 0; c < 4; ++c) u[c] = load(p.disp + 3 * m.tet[4 * t + c]);
    const double kept = KEPT * quality_of(x);
    out.least[i] = kept < THICK ? kept : THICK;
    out.had[i] = p.has ? energy_of(x, u, p.mu[t], p.lam[t]) : 0.0;
  }
  for (int i = 0; i < out.side.count; ++i) {
    D3 x[3];
    for (int c = 0; c < 3; ++c) x[c] = m.place((int)m.elem[3 * out.side.list[i] + c]);
    out.normal[i] = unit(cross(x[1] - x[0], x[2] - x[0]));
  }
  return true;
}

// Marks in `less` the vertices of a thin tetrahedron that are to move less: those inside give way to those
// of the skin, where the path is seen.
template <class S>
PALPATE void mark_thin(const S& m, const Shift* shift, const int* mover, int t, int* less) {
  bool any = false;
  for (int pass = 0; pass < 2; ++pass)
    for (int c = 0; c < 4; ++c) {
      const int v = m.vert(4 * t + c), k = mover[v] - 1;
      const bool gives = k >= 0 && v >= m.nskin && shift[k].share > GIVES;
      any = any || gives;
      if (pass && k >= 0 && (gives || !any)) less[k] = 1;
    }
}

// Marks in `less` the vertices that are to move less.
template <class S>
PALPATE void weigh_shifts(const S& m, const Shift* shift, const Few& movers, const Neohookean& p,
                          const Nearby& near, double* old, double* now, int* less) {
  const int* mover = movers.place;
  for (int i = 0; i < movers.count; ++i) old[i] = now[i] = 0.0, less[i] = 0;
  for (int i = 0; i < near.tet.count; ++i) {
    const int t = near.tet.list[i];
    D3 x[4], u[4];
    for (int c = 0; c < 4; ++c) x[c] = moved_place(m, shift, mover, m.vert(4 * t + c));
    const bool bad = quality_of(x) < near.least[i];
    if (bad) mark_thin(m, shift, mover, t, less);
    if (!p.has) continue;
    double has = near.had[i];
    for (int c = 0; c < 4 && !bad; ++c) u[c] = moved_disp(p.disp, shift, mover, m.vert(4 * t + c));
    if (!bad) has = energy_of(x, u, p.mu[t], p.lam[t]);
    for (int c = 0; c < 4; ++c) {
      const int k = mover[m.vert(4 * t + c)] - 1;
      if (k >= 0) old[k] += near.had[i], now[k] += has;
    }
  }
  for (int i = 0; i < near.side.count; ++i) {
    const int t = near.side.list[i];
    if (dot(moved_normal(m, shift, mover, t), near.normal[i]) >= TURNED) continue;
    for (int c = 0; c < 3; ++c) {
      const int k = mover[m.elem[3 * t + c]] - 1;
      if (k >= 0) less[k] = 1;
    }
  }
  for (int i = 0; i < movers.count && p.has; ++i)
    if (now[i] > ABOVE * old[i] + p.given) less[i] = 1;
}

// Finds how far of its way each vertex goes: so far that no tetrahedron gets thin and the skin does not
// turn, and that the energy around none rises.
template <class S>
PALPATE bool find_shares(const S& m, Shift* shift, const Few& movers, const Neohookean& p, Scratch& memory) {
  Nearby near = {few(memory, m.ntet), few(memory, m.most_elem), nullptr, nullptr, nullptr};
  double *old = memory.values(movers.count), *now = memory.values(movers.count);
  int* less = memory.numbers(movers.count);
  if (memory.full || !find_nearby(m, movers, shift, p, near, memory)) return false;
  for (int k = 0; k <= ROUNDS; ++k) {
    weigh_shifts(m, shift, movers, p, near, old, now, less);
    bool any = false;
    for (int i = 0; i < movers.count; ++i) {
      if (!less[i] || shift[i].share == 0.0) continue;
      shift[i].share *= k + 1 < ROUNDS ? SHORTER : 0.0;
      any = true;
    }
    if (!any) break;
  }
  return true;
}

// Six times the volume that triangles enclose with a point; with `area`, theirs go to their corners.
template <class S>
PALPATE double enclosed(const S& m, const double* rest, const Few& side, D3 origin, D3* area) {
  double sum = 0.0;
  for (int i = 0; i < side.count; ++i) {
    const auto* vert = m.elem + 3 * side.list[i];
    const D3 a = load(rest + 3 * vert[0]), b = load(rest + 3 * vert[1]), c = load(rest + 3 * vert[2]);
    sum += dot(a - origin, cross(b - origin, c - origin));
    for (int k = 0; k < 3 && area; ++k) area[vert[k]] += (1.0 / 6.0) * cross(b - a, c - a);
  }
  return sum;
}

// Moves vertices of the skin along its normals by so little that what it encloses stays; `rest` has where
// they were moved to.
template <class S>
PALPATE bool keep_volume(const S& m, double* rest, const Few& vert, Scratch& memory) {
  if (!vert.count) return true;
  Few side = few(memory, m.most_elem);
  D3* area = (D3*)memory.values(3 * m.nvert);
  if (memory.full) return false;
  for (int i = 0; i < vert.count; ++i) m.each_triangle(vert.list[i], [&](int t) { side.put(t); });
  side.sort(m.most_elem);
  const D3 origin = m.place(vert.list[0]);
  for (int k = 0; k < EXACT; ++k) {
    for (int v = 0; v < m.nvert; ++v) area[v] = {0.0, 0.0, 0.0};
    const double before = enclosed(m, m.rest, side, origin, nullptr);
    const double lost = (before - enclosed(m, rest, side, origin, area)) / 6.0;
    double square = 0.0;
    for (int i = 0; i < vert.count; ++i) square += dot(area[vert.list[i]], area[vert.list[i]]);
    for (int i = 0; i < vert.count; ++i) {
      const int v = vert.list[i];
      store(rest + 3 * v, load(rest + 3 * v) + (lost / square) * area[v]);
    }
  }
  return true;
}

// Moves vertices onto a sheet, as far as may be; `where` has where they are beside it. Leaves in `movers`
// those that have moved, with the shift of each, and in `rest` where all are then.
template <class S, class P>
PALPATE bool settle(const S& m, const Sheet& sheet, double edge, const Where* where, const P* pinned,
                    const Neohookean& p, Few& movers, Shift*& shift, double* rest, Scratch& memory) {
  Few outer = few(memory, m.nvert);
  int count = 0;
  // Those on the walls of older cuts stay.
  for (int i = 0; i < movers.count; ++i) {
    const int v = movers.list[i];
    bool stays = pinned[v];
    m.each_triangle(v, [&](int t) { stays = stays || t >= m.nelem; });
    movers.place[v] = 0;
    if (!stays) movers.list[count++] = v, movers.place[v] = count;
  }
  movers.count = count;
  shift = (Shift*)memory.values(count * (int)(sizeof(Shift) / sizeof(double)));
  if (memory.full) return false;
  for (int i = 0; i < count; ++i) {
    Shift& a = shift[i];
    a.vert = movers.list[i], a.share = 1.0;
    const D3 goal = a.vert < m.nskin ? goal_on_skin(m, sheet, edge, a.vert, where[a.vert].at) : where[a.vert].at;
    find_weights(m, a.vert, goal, a);
    a.way = goal - m.place(a.vert);
    a.lead = at_corners(p.disp, a) - load(p.disp + 3 * a.vert);
  }
  if (!find_shares(m, shift, movers, p, memory)) return false;
  count = 0;
  for (int i = 0; i < movers.count; ++i) {
    const int v = shift[i].vert;
    movers.place[v] = 0;
    if (shift[i].share == 0.0) continue;
    store(rest + 3 * v, m.place(v) + shift[i].share * shift[i].way);
    if (v < m.nskin) outer.put(v);
    shift[count] = shift[i], movers.list[count++] = v, movers.place[v] = count;
  }
  movers.count = count;
  return keep_volume(m, rest, outer, memory);
}

}  // namespace palpate
