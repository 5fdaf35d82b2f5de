// Vertices near a path are moved onto it in the rest shape.
#pragma once
#include "cutting/chain.h"
#include "cutting/moves.h"

namespace palpate {

constexpr double CORNER = -0.8;  // greatest cosine between a boundary's edges where a vertex slides on it
enum { NO_ENERGY, MEMBRANE, SPRINGS_OF_EDGES };

// What tells the energy around vertices: of triangles, and of the springs that hold vertices.
struct Material {
  int kind, held;
  double thickness, tension, stiffness, given;  // `given`: what cuts has brought so much around each vertex
  const double *lame, *shear;  // of triangles
  const double *whole, *pull, *hard;  // of vertices: energy of springs, force, stiffness
  const double* disp;
  bool has;  // whether there is any

  // The energy of a triangle with corners `rest` and displacements `u`, as tissue/energy.py has it.
  PALPATE double energy(int t, const D3* rest, const D3* u) const {
    if (kind == MEMBRANE) {
      const D3 r1 = rest[1] - rest[0], r2 = rest[2] - rest[0], p1 = u[1] - u[0], p2 = u[2] - u[0];
      const double g11 = dot(r1, r1), g12 = dot(r1, r2), g22 = dot(r2, r2), det = g11 * g22 - g12 * g12;
      const double e11 = dot(r1, p1) + 0.5 * dot(p1, p1), e22 = dot(r2, p2) + 0.5 * dot(p2, p2);
      const double e12 = 0.5 * (dot(r1, p2) + dot(r2, p1) + dot(p1, p2));
      const double trace = (g22 * e11 - 2.0 * g12 * e12 + g11 * e22) / det;
      const double square = trace * trace - 2.0 * (e11 * e22 - e12 * e12) / det;
      const double area = 0.5 * sqrt(det), taut = 0.5 * tension / (thickness * (lame[t] + shear[t]));
      return area * thickness * (0.5 * lame[t] * trace * trace + shear[t] * square)
        + area * tension * (trace + taut);
    }
    double sum = 0.0;
    for (int c = 0; c < 3; ++c) {
      const int d = (c + 1) % 3;
      const double longer = norm(rest[d] + u[d] - rest[c] - u[c]) - norm(rest[d] - rest[c]);
      sum += longer * longer;
    }
    return 0.25 * stiffness * sum;
  }
  // Adds the energy of the springs of a vertex, before and with another displacement.
  PALPATE void hold(int v, D3 lead, double& old, double& now) const {
    if (!held) return;
    old += whole[v];
    now += whole[v] + dot(lead, load(pull + 3 * v)) + 0.5 * hard[v] * dot(lead, lead);
  }
};

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

// Finds how vertices move, as far as they may: those in `movers`, in ascending order, with `goal` each.
template <class S>
PALPATE bool find_moves(const S& m, const Material& p, const D3* goal, const Few& movers, Move* move,
                        Scratch& memory) {
  double *old = memory.values(movers.count), *now = memory.values(movers.count);
  int* less = memory.numbers(movers.count);
  Nearby near = {};
  if (memory.full || !find_nearby(m, movers, p, near, memory)) return false;
  for (int i = 0; i < movers.count; ++i) {
    const int v = movers.list[i];
    const Spot spot = nearest_around(m, m.rest, goal[i], &v, 1);
    const double weight[3] = {spot.weight.x, spot.weight.y, spot.weight.z};
    Move& a = move[i];
    a.vert = v, a.share = 1.0;
    for (int c = 0; c < 3; ++c) a.corner[c] = m.vert(3 * spot.elem + c), a.weight[c] = weight[c];
    a.way = at_corners(m, m.rest, a) - m.place(v);
    a.lead = at_corners(m, p.disp, a) - load(p.disp + 3 * v);
  }
  shorten_moves(m, move, movers, p, near, old, now, less);
  return true;
}

// Leaves the moves that go anywhere; returns how many.
PALPATE int those_that_move(Move* move, int n) {
  int count = 0;
  for (int i = 0; i < n; ++i)
    if (move[i].share > 0.0 && move[i].way != D3{0.0, 0.0, 0.0}) move[count++] = move[i];
  return count;
}

}  // namespace palpate
