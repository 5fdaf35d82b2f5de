// Vertices of a sheet or a solid are moved in the rest shape, as far as none of its elements, triangles or
// tetrahedra, gets thin, no triangle turns and no energy is made.
#pragma once
#include "cutting/surface.h"

namespace palpate {

constexpr double TURNED = 0.95;  // least cosine between a triangle's normals before and after

// A vertex that moves to a place in an element: `way` at rest, where its displacement changes by `lead`.
struct Move { int vert, corner[4]; double share, weight[4]; D3 way, lead; };

template <class S>
PALPATE D3 at_corners(const S&, const double* values, const Move& a) {
  D3 out = {0.0, 0.0, 0.0};
  for (int k = 0; k < S::CORNERS; ++k) out += a.weight[k] * load(values + 3 * a.corner[k]);
  return out;
}

PALPATE D3 normal_of(const D3* x) { return unit(cross(x[1] - x[0], x[2] - x[0])); }

// The elements around vertices that move, and the triangles of a solid, as they are before.
struct Nearby {
  Few elem, side;
  double *least, *had, *has, *next;  // quality; energies before, now, and with what is tried
  D3* normal;  // of triangles
};

// Where a vertex is, and its displacement, with its share of its way; `mover` tells which moves, from 1.
template <class S>
PALPATE D3 moved_place(const S& m, const Move* move, const int* mover, int v) {
  const int k = mover[v] - 1;
  return k < 0 ? m.place(v) : m.place(v) + move[k].share * move[k].way;
}
PALPATE D3 moved_disp(const double* disp, const Move* move, const int* mover, int v) {
  const int k = mover[v] - 1;
  return k < 0 ? load(disp + 3 * v) : load(disp + 3 * v) + move[k].share * move[k].lead;
}

template <class S>
PALPATE D3 moved_normal(const S& m, const Move* move, const int* mover, int t) {
  D3 x[3];
  for (int c = 0; c < 3; ++c) x[c] = moved_place(m, move, mover, (int)m.elem[3 * t + c]);
  return normal_of(x);
}

// Finds what is around vertices that do not move yet; `p` tells the energy of elements.
template <class S, class P>
PALPATE bool find_nearby(const S& m, const Few& movers, const P& p, Nearby& out, Scratch& memory) {
  constexpr int N = S::CORNERS;
  out.elem = few(memory, m.size());
  if (N == 4) out.side = few(memory, m.most_triangles());
  if (memory.full) return false;
  for (int i = 0; i < movers.count; ++i) {
    m.each_corner(movers.list[i], [&](int corner) { out.elem.put(corner / N); });
    if (N == 4) m.each_triangle(movers.list[i], [&](int t) { out.side.put(t); });
  }
  out.elem.sort(m.size());
  double** lists[] = {&out.least, &out.had, &out.has, &out.next};
  for (int i = 0; i < 4; ++i) *lists[i] = memory.values(out.elem.count);
  const Few& flat = N == 4 ? out.side : out.elem;
  out.normal = (D3*)memory.values(3 * flat.count);
  if (memory.full) return false;
  for (int i = 0; i < out.elem.count; ++i) {
    const int t = out.elem.list[i];
    D3 x[N], u[N];
    m.corners(t, x);
    for (int c = 0; c < N; ++c) u[c] = load(p.disp + 3 * m.vert(N * t + c));
    const double kept = S::KEPT * m.quality(x);
    out.least[i] = kept < S::THIN ? kept : S::THIN;
    out.had[i] = p.has ? p.energy(t, x, u) : 0.0;
  }
  for (int i = 0; i < flat.count; ++i) {
    D3 x[3];
    for (int c = 0; c < 3; ++c) x[c] = m.place((int)m.elem[3 * flat.list[i] + c]);
    out.normal[i] = normal_of(x);
  }
  return true;
}

// Marks in `less` the vertices of a thin element that are to move less: those inside of a solid give way to
// those of the skin, where the path is seen.
template <class S>
PALPATE void mark_thin(const S& m, const Move* move, const int* mover, int t, int* less) {
  bool any = false;
  for (int pass = 0; pass < 2; ++pass)
    for (int c = 0; c < S::CORNERS; ++c) {
      const int v = m.vert(S::CORNERS * t + c), k = mover[v] - 1;
      const bool gives = k >= 0 && m.inside(v) && move[k].share > S::GIVES;
      any = any || gives;
      if (pass && k >= 0 && (gives || !any)) less[k] = 1;
    }
}

// Marks in `less` the vertices that are to move less; leaves the energy around each before and with its share.
template <class S, class P>
PALPATE void weigh_moves(const S& m, const Move* move, const Few& movers, const P& p, Nearby& near, double* old,
                         double* now, int* less) {
  constexpr int N = S::CORNERS;
  const int* mover = movers.place;
  for (int i = 0; i < movers.count; ++i) old[i] = now[i] = 0.0, less[i] = 0;
  for (int i = 0; i < near.elem.count; ++i) {
    const int t = near.elem.list[i];
    D3 x[N], u[N];
    for (int c = 0; c < N; ++c) x[c] = moved_place(m, move, mover, m.vert(N * t + c));
    bool bad = m.quality(x) < near.least[i];
    if (N == 3) bad = bad || dot(normal_of(x), near.normal[i]) < TURNED;
    if (bad) mark_thin(m, move, mover, t, less);
    if (!p.has) continue;
    double has = near.had[i];
    for (int c = 0; c < N && !bad; ++c) u[c] = moved_disp(p.disp, move, mover, m.vert(N * t + c));
    if (!bad) has = p.energy(t, x, u);
    near.has[i] = has;
    for (int c = 0; c < N; ++c) {
      const int k = mover[m.vert(N * t + c)] - 1;
      if (k >= 0) old[k] += near.had[i], now[k] += has;
    }
  }
  for (int i = 0; i < near.side.count; ++i) {
    const int t = near.side.list[i];
    if (dot(moved_normal(m, move, mover, t), near.normal[i]) >= TURNED) continue;
    for (int c = 0; c < 3; ++c) {
      const int k = mover[m.elem[3 * t + c]] - 1;
      if (k >= 0) less[k] = 1;
    }
  }
  for (int i = 0; i < movers.count && p.has; ++i) {
    p.hold(movers.list[i], move[i].share * move[i].lead, old[i], now[i]);
    if (now[i] > S::RISE * old[i] + p.given) less[i] = 1;
  }
}

// Lets all go as far of their way as they may together. A vertex gets the displacement of where it goes to, and an
// uneven strain is another one after it.
template <class S, class P>
PALPATE void shorten_moves(const S& m, Move* move, const Few& movers, const P& p, Nearby& near, double* old,
                           double* now, int* less) {
  for (int k = 0; k <= S::ROUNDS; ++k) {
    weigh_moves(m, move, movers, p, near, old, now, less);
    bool any = false;
    for (int i = 0; i < movers.count; ++i) {
      if (!less[i] || move[i].share == 0.0) continue;
      move[i].share *= k + 1 < S::ROUNDS ? S::SHORTER : 0.0;
      any = true;
    }
    if (!any) return;
  }
}

}  // namespace palpate
