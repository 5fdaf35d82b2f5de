// Vertices near a path are moved onto it in the rest shape, as far as no triangle gets thin and no energy
// is made.
#pragma once
#include "cutting/chain.h"

namespace palpate {

constexpr double SHAPE = 0.3, KEEP = 0.9;  // least shape of a triangle, or so much of what it had
constexpr double TURN = 0.95;  // least cosine between a triangle's normals before and after
constexpr double CORNER = -0.8;  // greatest one between a boundary's edges where a vertex slides on it
constexpr double RISE = 1.01;  // times its energy that the tissue around a vertex may have when it moved
constexpr double LESS = 0.87;
constexpr int TRIES = 22;
enum { NO_ENERGY, MEMBRANE, SPRINGS_OF_EDGES };

// What tells the energy around vertices: of triangles, and of the springs that hold vertices.
struct Material {
  int kind, held;
  double thickness, stiffness, given;  // `given`: what cuts has brought so much around each vertex
  const double *lame, *shear;  // of triangles
  const double *whole, *pull, *hard;  // of vertices: energy of springs, force, stiffness
};

// A vertex that moves to a place of the surface.
struct Move { int vert, elem; double share; D3 weight, own, way, lead; };

PALPATE D3 at_corners(const double* values, const int* corner, D3 w) {
  return w.x * load(values + 3 * corner[0]) + w.y * load(values + 3 * corner[1]) +
         w.z * load(values + 3 * corner[2]);
}

// The energy of a triangle with corners `rest` and displacements `u`, as tissue/energy.py has it.
PALPATE double energy_of(const Material& p, int t, const D3* rest, const D3* u) {
  if (p.kind == MEMBRANE) {
    const D3 r1 = rest[1] - rest[0], r2 = rest[2] - rest[0], p1 = u[1] - u[0], p2 = u[2] - u[0];
    const double g11 = dot(r1, r1), g12 = dot(r1, r2), g22 = dot(r2, r2), det = g11 * g22 - g12 * g12;
    const double e11 = dot(r1, p1) + 0.5 * dot(p1, p1), e22 = dot(r2, p2) + 0.5 * dot(p2, p2);
    const double e12 = 0.5 * (dot(r1, p2) + dot(r2, p1) + dot(p1, p2));
    const double trace = (g22 * e11 - 2.0 * g12 * e12 + g11 * e22) / det;
    const double square = trace * trace - 2.0 * (e11 * e22 - e12 * e12) / det;
    const double lame = p.lame[t], shear = p.shear[t];
    return 0.5 * sqrt(det) * p.thickness * (0.5 * lame * trace * trace + shear * square);
  }
  double sum = 0.0;
  for (int c = 0; c < 3; ++c) {
    const int d = (c + 1) % 3;
    const double longer = norm(rest[d] + u[d] - rest[c] - u[c]) - norm(rest[d] - rest[c]);
    sum += longer * longer;
  }
  return 0.25 * p.stiffness * sum;
}

// The unit normal of a triangle, and its shape: 1 of an equilateral one.
PALPATE D3 form(const D3* x, double& shape) {
  const D3 a = x[1] - x[0], b = x[2] - x[1], c = x[0] - x[2], area = cross(a, x[2] - x[0]);
  const double size = norm(area);
  shape = 2.0 * sqrt(3.0) * size / (dot(a, a) + dot(b, b) + dot(c, c));
  return (1.0 / (size > 1e-300 ? size : 1e-300)) * area;
}

// Where a vertex of a boundary goes: along it; returns whether it may.
template <class S>
PALPATE bool slide(const S& m, int v, D3& goal) {
  const D3 here = m.place(v), way = goal - here;
  const D3 a = m.place(m.neighbour(v, 0)) - here, b = m.place(m.neighbour(v, (int)m.degree[v] - 1)) - here;
  const D3 one = (1.0 / norm(a)) * a, two = (1.0 / norm(b)) * b;
  const double first = dot(way, one), second = dot(way, two);
  const double x = first > 0.0 ? first : 0.0, y = second > 0.0 ? second : 0.0;
  goal = here + (x >= y ? x * one : y * two);
  return dot(one, two) < CORNER;
}

// The triangles around vertices that move, as they are before.
struct Patch {
  Few elem;
  D3* normal;
  double *least, *had;
};

// Places and displacements of a triangle's corners, of which `mover` tells which move, from 1.
template <class S>
PALPATE void moved_corners(const S& m, const double* disp, const Move* move, const int* mover, int t,
                           D3* rest, D3* u) {
  for (int c = 0; c < 3; ++c) {
    const int v = (int)m.elem[3 * t + c], k = mover[v] - 1;
    rest[c] = m.place(v), u[c] = load(disp + 3 * v);
    if (k < 0) continue;
    rest[c] += move[k].share * move[k].way;
    u[c] += move[k].share * move[k].lead;
  }
}

// Adds up the energy around each vertex that moves, before and with its share; marks in `less` those
// around which a triangle gets thin or turns.
template <class S>
PALPATE void weigh_moves(const S& m, const double* disp, const Material& p, const Patch& patch,
                         const Move* move, const int* mover, double* old, double* now, int* less) {
  for (int i = 0; i < patch.elem.count; ++i) {
    D3 rest[3], u[3];
    const int t = patch.elem.list[i];
    moved_corners(m, disp, move, mover, t, rest, u);
    double shape;
    const D3 normal = form(rest, shape);
    const bool bad = shape < patch.least[i] || dot(normal, patch.normal[i]) < TURN;
    const double has = p.kind == NO_ENERGY || bad ? patch.had[i] : energy_of(p, t, rest, u);
    for (int c = 0; c < 3; ++c) {
      const int k = mover[m.elem[3 * t + c]] - 1;
      if (k < 0) continue;
      old[k] += patch.had[i], now[k] += has;
      if (bad) less[k] = 1;
    }
  }
}

// Finds how far of its way each vertex goes: a vertex gets the displacement of where it goes to, and
// an uneven strain is another one after it.
template <class S>
PALPATE void find_shares(const S& m, const double* disp, const Material& p, Move* move, const Few& movers,
                         Scratch& memory) {
  const int n = movers.count;
  double *old = memory.values(n), *now = memory.values(n);
  int* less = memory.numbers(n);
  Patch patch = {few(memory, m.nelem), nullptr, nullptr, nullptr};
  if (memory.full) return;
  for (int i = 0; i < n; ++i)
    for (int k = 0; k < m.degree[movers.list[i]]; ++k) {
      const int h = m.half(movers.list[i], k);
      if (h >= 0) patch.elem.put(h / 3);
    }
  patch.elem.sort(m.nelem);
  const int count = patch.elem.count;
  patch.normal = (D3*)memory.values(3 * count);
  patch.least = memory.values(count), patch.had = memory.values(count);
  if (memory.full) return;
  for (int i = 0; i < count; ++i) {
    D3 rest[3], u[3];
    double shape;
    m.corners(patch.elem.list[i], rest);
    for (int c = 0; c < 3; ++c) u[c] = load(disp + 3 * m.elem[3 * patch.elem.list[i] + c]);
    patch.normal[i] = form(rest, shape);
    patch.least[i] = KEEP * shape < SHAPE ? KEEP * shape : SHAPE;
    patch.had[i] = p.kind == NO_ENERGY ? 0.0 : energy_of(p, patch.elem.list[i], rest, u);
  }
  for (int k = 0; k <= TRIES; ++k) {
    for (int i = 0; i < n; ++i) old[i] = now[i] = 0.0, less[i] = 0;
    weigh_moves(m, disp, p, patch, move, movers.place, old, now, less);
    bool any = false;
    for (int i = 0; i < n; ++i) {
      const int v = movers.list[i];
      const D3 lead = move[i].share * move[i].lead;
      if (p.kind != NO_ENERGY && p.held) {
        old[i] += p.whole[v];
        now[i] += p.whole[v] + dot(lead, load(p.pull + 3 * v)) + 0.5 * p.hard[v] * dot(lead, lead);
      }
      if (!less[i] && !(p.kind != NO_ENERGY && now[i] > RISE * old[i] + p.given)) continue;
      move[i].share *= k + 1 < TRIES ? LESS : 0.0;
      any = true;
    }
    if (!any) return;
  }
}

// Finds where vertices move to: those in `movers`, in ascending order, with `goal` each.
template <class S>
PALPATE void find_moves(const S& m, const double* disp, const Material& p, const D3* goal, const Few& movers,
                       Move* move, Scratch& memory) {
  for (int i = 0; i < movers.count; ++i) {
    const int v = movers.list[i];
    const Spot spot = nearest_around(m, m.rest, goal[i], &v, 1);
    Move& a = move[i];
    a.vert = v, a.elem = spot.elem, a.share = 1.0, a.weight = spot.weight;
    int corner[3];
    for (int c = 0; c < 3; ++c) corner[c] = (int)m.elem[3 * spot.elem + c];
    a.own = {(double)(corner[0] == v), (double)(corner[1] == v), (double)(corner[2] == v)};
    a.way = at_corners(m.rest, corner, a.weight) - m.place(v);
    a.lead = at_corners(disp, corner, a.weight) - load(disp + 3 * v);
  }
  find_shares(m, disp, p, move, movers, memory);
}

// Leaves the moves that go anywhere; returns how many.
PALPATE int those_that_move(Move* move, int n) {
  int count = 0;
  for (int i = 0; i < n; ++i) {
    Move a = move[i];
    a.weight = a.own + a.share * (a.weight - a.own);
    if (a.weight != a.own) move[count++] = a;
  }
  return count;
}

}  // namespace palpate
