// Vertices of a solid are moved onto a sheet in the rest shape, as far as its tetrahedra allow.
#pragma once
#include "tissue/neohookean.h"
#include "cutting/moves.h"
#include "cutting/solid/solid_mesh.h"
#include "cutting/solid/cut_surface.h"

namespace palpate {

constexpr double LIPS = 0.75;  // edges from the path within which a vertex of the skin goes to it
constexpr double ALONG = 0.02;  // edges from the path within which one gives way along it
constexpr int PASSES = 4;  // times that each goes farther by itself
constexpr int EXACT = 3;  // times that the volume is put right

// The point of the skin around a vertex that is nearest to a goal.
template <class S>
PALPATE D3 nearest_on_skin(const S& m, int v, D3 goal) {
  double least = 1e300;
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

// Where a vertex of the skin goes on it: to the path where that is near.
template <class S>
PALPATE D3 goal_on_skin(const S& m, const Sheet& sheet, double edge, int v, D3 goal) {
  double far;
  const D3 at = place_on(sheet.path, sheet.npath, m.place(v), far);
  return nearest_on_skin(m, v, far < LIPS * edge ? at : goal);
}

// Finds the tetrahedron in which a goal is, or which it is the least outside of, and the weights of its
// corners there.
template <class S>
PALPATE void find_weights(const S& m, int v, D3 goal, Move& out) {
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

// How a vertex moves to a goal.
template <class S>
PALPATE Move shift_to(const S& m, int v, D3 goal, const double* disp) {
  Move a = {v};
  a.share = 1.0;
  find_weights(m, v, goal, a);
  a.way = goal - m.place(v);
  a.lead = at_corners(m, disp, a) - load(disp + 3 * v);
  return a;
}

// Vertices that move, what is around them, and the energy around each before and now.
template <class S>
struct Settling {
  const S& m;
  const Few& movers;
  const Neohookean& p;
  const Sheet& sheet;
  double edge;
  Move* shift;
  Nearby near;
  double *old, *now;

  PALPATE void place_of(int t, D3* x) const {
    for (int c = 0; c < 4; ++c) x[c] = moved_place(m, shift, movers.place, m.vert(4 * t + c));
  }
  // Adds to the energy around the corners of a tetrahedron.
  PALPATE void add(int t, double more) {
    for (int c = 0; c < 4; ++c) {
      const int k = movers.place[m.vert(4 * t + c)] - 1;
      if (k >= 0) now[k] += more;
    }
  }
  // A tetrahedron around a vertex that is too thin, -1 for none.
  PALPATE int thin(int i) const {
    int out = -1;
    m.each_corner(shift[i].vert, [&](int corner) {
      D3 x[4];
      const int t = corner / 4;
      place_of(t, x);
      if (out < 0 && quality_of(x) < near.least[near.elem.place[t] - 1]) out = t;
    });
    return out;
  }
  PALPATE bool turns(int i) const {
    bool out = false;
    m.each_triangle(shift[i].vert, [&](int t) {
      const D3 normal = near.normal[near.side.place[t] - 1];
      out = out || dot(moved_normal(m, shift, movers.place, t), normal) < TURNED;
    });
    return out;
  }
  // Takes the energy of what is around a vertex as it is now; returns whether that may be.
  PALPATE bool weigh(int i) {
    bool may = true;
    m.each_corner(shift[i].vert, [&](int corner) {
      const int t = corner / 4, n = near.elem.place[t] - 1;
      D3 x[4], u[4];
      place_of(t, x);
      for (int c = 0; c < 4; ++c) u[c] = moved_disp(p.disp, shift, movers.place, m.vert(4 * t + c));
      near.next[n] = p.energy(t, x, u);
      add(t, near.next[n] - near.has[n]);
    });
    m.each_corner(shift[i].vert, [&](int corner) {
      for (int c = corner - corner % 4; c < corner - corner % 4 + 4; ++c) {
        const int k = movers.place[m.vert(c)] - 1;
        may = may && (k < 0 || now[k] <= S::RISE * old[k] + p.given);
      }
    });
    m.each_corner(shift[i].vert, [&](int corner) {
      const int t = corner / 4, n = near.elem.place[t] - 1;
      if (may) near.has[n] = near.next[n];
      else add(t, near.has[n] - near.next[n]);
    });
    return may;
  }
  // Lets a vertex move otherwise, where the others stay; returns whether it may.
  PALPATE bool takes(int i, const Move& other) {
    const Move before = shift[i];
    shift[i] = other;
    if (thin(i) < 0 && !turns(i) && (!p.has || weigh(i))) return true;
    shift[i] = before;
    return false;
  }
  PALPATE bool goes(int i, double share) {
    Move other = shift[i];
    other.share = share;
    return takes(i, other);
  }
  // Where a vertex gives way to: one of the skin along the path, if it is there.
  PALPATE D3 aside(int v, D3 here, D3 goal) const {
    double far;
    if (v >= m.nskin) return goal;
    place_on(sheet.path, sheet.npath, here, far);
    if (far > ALONG * edge) return here;
    return nearest_on_skin(m, v, place_on(sheet.path, sheet.npath, goal, far));
  }
  // Lets a vertex of the skin have a share of its way where others of a tetrahedron that would be thin give
  // way.
  PALPATE bool gets_room(int i, double wanted) {
    const double share = shift[i].share;
    shift[i].share = wanted;
    const int t = thin(i);
    D3 x[4], g[4];
    if (t >= 0) place_of(t, x);
    shift[i].share = share;
    if (t < 0) return false;
    normals_of(x, g);
    for (int c = 0; c < 4; ++c) {
      const int v = m.vert(4 * t + c), k = movers.place[v] - 1;
      if (k < 0 || k == i) continue;
      const Move before = shift[k];
      for (double part = 0.1; part < 0.7; part *= 2.0) {
        const D3 goal = aside(v, x[c], x[c] + part * edge * g[c]);
        if (goal == x[c]) break;
        const Move other = shift_to(m, v, goal, p.disp);
        if (!takes(k, other)) break;
        if (goes(i, wanted)) return true;
      }
      takes(k, before);
    }
    return false;
  }
};

// Finds how far of its way each vertex goes: so far that no tetrahedron gets thin and the skin does not
// turn, and that the energy around none rises. All go as far as they may together, and then each farther
// where the others leave it room.
template <class S>
PALPATE bool find_shares(const S& m, const Sheet& sheet, double edge, Move* shift, const Few& movers,
                         const Neohookean& p, Scratch& memory) {
  Settling<S> all = {m, movers, p, sheet, edge, shift, {}};
  all.old = memory.values(movers.count), all.now = memory.values(movers.count);
  int* less = memory.numbers(movers.count);
  if (memory.full || !find_nearby(m, movers, p, all.near, memory)) return false;
  shorten_moves(m, shift, movers, p, all.near, all.old, all.now, less);
  weigh_moves(m, shift, movers, p, all.near, all.old, all.now, less);
  for (int k = 0; k < 2 * PASSES; ++k)  // those of the skin first, where the path is seen
    for (int i = 0; i < movers.count; ++i) {
      const double share = shift[i].share;
      const bool outer = shift[i].vert < m.nskin;
      if (share == 1.0 || outer != (k % 2 == 0) || shift[i].way == D3{0.0, 0.0, 0.0}) continue;
      for (double part = 1.0; part > 0.2; part *= 0.5) {
        const double wanted = share + part * (1.0 - share);
        if (all.goes(i, wanted) || (outer && all.gets_room(i, wanted))) break;
      }
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
                    const Neohookean& p, Few& movers, Move*& shift, double* rest, Scratch& memory) {
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
  // Those inside beside the skin's may make room for them.
  for (int i = 0, n = movers.count = count; i < n; ++i)
    m.each_corner(movers.list[i], [&](int corner) {
      for (int k = 0; k < 3 && movers.list[i] < m.nskin; ++k) {
        const int v = m.vert(other_corner(corner, k));
        if (v >= m.nskin && !pinned[v]) movers.put(v);
      }
    });
  const int helpers = count;
  count = movers.count;
  shift = (Move*)memory.values(count * (int)(sizeof(Move) / sizeof(double)));
  if (memory.full) return false;
  for (int i = 0; i < count; ++i) {
    const int v = movers.list[i];
    D3 goal = i < helpers ? where[v].at : m.place(v);
    if (v < m.nskin) goal = goal_on_skin(m, sheet, edge, v, goal);
    shift[i] = shift_to(m, v, goal, p.disp);
    if (i >= helpers) shift[i].share = 0.0, shift[i].way = {0.0, 0.0, 0.0};
  }
  if (!find_shares(m, sheet, edge, shift, movers, p, memory)) return false;
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
