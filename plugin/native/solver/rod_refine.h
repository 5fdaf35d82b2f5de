// Nodes that move along a rod, so that edges are short where it touches itself and long elsewhere: the mesh moves in the
// material between two steps (arbitrary Lagrangian-Eulerian, Donea et al. 2004, doi:10.1002/0470091355.ecm009, section 4).
//
// The state is how far each node has moved, in length at rest; lengths, stiffness and masses follow from it.
#pragma once
#include "solver/rod_step.h"

AS_WRITTEN

namespace palpate {

// Edges grow by this share of the distance from where the rod touches itself: parts of it whose centre lines are nearer
// than TOUCHING radii, which is less than there are between edges that are no neighbours of a straight rod.
constexpr double GROWTH = 0.3, TOUCHING = 3.0;
// Of the way to where it is to be, the share that a node goes in a step; of the shorter of its edges, the most; and how far
// the rod may go aside where it is bent, in radii.
constexpr double GOES = 0.1, COURANT = 0.1, ASIDE = 0.1;
constexpr double CLOSE_BY = 0.2;  // of its shorter edge, how far a node is from there before it goes
// Room between edges that touch, in radii, below which nodes stay: more than two strands may take of it in a step.
constexpr double ROOM = 3.0 * ASIDE;
constexpr double SHORTEST = 0.8;  // of `refine`, what edges become
constexpr double FAR = 1e9;  // from a contact, where there is none [nm]

// Length that belongs to a node, half of its edges.
template <class Fields>
PALPATE double tributary(const Fields& f, int i) { return 0.5 * (f.length.data[i] + (i ? f.length.data[i - 1] : 0.0)); }

// Mass of a node whose body has `body`: the bodies' masses are alike, those of nodes go with their length.
template <class Fields>
PALPATE double mass_of(const Fields& f, int i, double body) {
  return f.refine > 0.0 ? body * tributary(f, i) / f.mean : body;
}

// Takes lengths and what follows from them by where the nodes are.
template <class Fields>
PALPATE void measure(const Fields& f) {
  const int n = f.nnode;
  each_lane(0, n, [&](int i) { f.along.data[i] = f.drawn.data[i] + f.own.moved.data[i]; });
  each_lane(0, n - 1, [&](int i) {
    f.length.data[i] = f.along.data[i + 1] - f.along.data[i];
    f.stretch.data[i] = f.axial / f.length.data[i];
  });
  each_lane(0, n, [&](int i) {
    const double own = tributary(f, i);
    f.bend.data[i] = i && i < n - 1 ? f.flexural / own : 0.0;
    f.drag.data[i] = f.viscous * own;
    f.mass.data[i] = mass_of(f, i, f.body.data[i]);
  });
}

// Notes how far each node is from where the rod touches itself, along it [nm]; returns the least room between edges [m].
template <class Fields>
PALPATE double find_touching(const Fields& f, const double* x, int* far) {
  const int n = f.nnode;
  double room = FAR;
  each_lane(0, n, [&](int i) { far[i] = (int)FAR; });
  each_lane(0, f.count.data[1], [&](int p) {
    const int i = f.pair.data[2 * p], j = f.pair.data[2 * p + 1];
    if (!may_be_near(f, x, i, j, TOUCHING * f.radius)) return;
    const Nearest at = nearest_edges(x, i, j);
    const double distance = norm(at.off), gap = distance - 2.0 * CORE * f.radius;
    if (distance >= TOUCHING * f.radius) return;
    room = gap < room ? gap : room;
    const auto note = [&](int edge, double share) {
      const double before = 1e9 * share * f.length.data[edge], after = 1e9 * f.length.data[edge] - before;
      lower(far[edge], (int)before);
      lower(far[edge + 1], (int)after);
    };
    note(i, at.s);
    note(j, at.t);
  });
  one_lane([&] {
    const auto pass = [&](int from, int to, int edge) {
      const int there = far[from] + (int)(1e9 * f.length.data[edge]);
      if (there < far[to]) far[to] = there;
    };
    for (int i = 1; i < n; ++i) pass(i - 1, i, i - 1);
    for (int i = n - 1; i > 0; --i) pass(i, i - 1, i - 1);
  });
  return least_together(room);
}

// Marks nodes that stay: ends, those of broken edges, and those that do not move or that an equality holds.
template <class Fields>
PALPATE void find_fixed(const Fields& f, int* stays) {
  each_lane(0, f.nnode, [&](int i) {
    stays[i] = !i || i == f.nnode - 1 || !is_joint(f, i) || f.held.data[4 * i];
  });
  one_lane([&] {
    for (int r = 0; r < f.count.data[0]; ++r) {
      if (f.row_kind.data[r] != BOTH) continue;
      const double* J = f.row_value.data + (DOFS + 3) * r;
      for (int k = 0; k < DOFS; ++k)
        if (J[k] != 0.0) stays[f.row_node.data[r] + k / 3] = 1;
    }
  });
}

// The part of an edge that is near a contact, by length: 1 / (1 + GROWTH d / refine) at a distance d, summed along it.
template <class Fields>
PALPATE double near_part(const Fields& f, int edge, const int* far) {
  const double a = 1e-9 * far[edge], b = 1e-9 * far[edge + 1], per = GROWTH / f.refine;
  // Inside there is a contact, or there are two, and in their middle as far from them as that is below 0.
  const double inside = 0.5 * (a + b - f.length.data[edge]), turn = 1.0 + per * fabs(inside);
  const double ends = (1.0 + per * a) * (1.0 + per * b), there = turn * turn;
  return log(inside > 0.0 ? ends / there : ends * there) / per;
}

// Finds where nodes are to be along the rod: between two that stay, all edges have the same share of a density, the inverse of
// their length (equidistribution, de Boor 1974, doi:10.1007/BFb0069121). That is 1 / refine where the rod touches
// itself, and far from there what is left for it.
template <class Fields>
PALPATE void find_goals(const Fields& f, const int* stays, const double* near, double* goal) {
  one_lane([&] {
    for (int first = 0, last; first + 1 < f.nnode; first = last) {
      double part = 0.0;
      for (last = first; last == first || !stays[last]; ++last) part += near[last];
      const int count = last - first;
      const double whole = f.along.data[last] - f.along.data[first], fine = 1.0 / f.refine, apart = whole - part;
      double coarse = apart > 0.0 ? (count - fine * part) / apart : fine;
      coarse = coarse < 1.0 / f.longest ? 1.0 / f.longest : coarse < fine ? coarse : fine;
      const auto density = [&](int e) { return coarse * f.length.data[e] + (fine - coarse) * near[e]; };
      const double each = (coarse * whole + (fine - coarse) * part) / count;
      int edge = first;
      double left = density(edge), passed = 0.0;  // of this edge
      for (int i = first + 1; i < last; ++i) {
        double need = each;
        while (need > left - passed && edge + 1 < last) {
          need -= left - passed;
          left = density(++edge);
          passed = 0.0;
        }
        passed += need;
        goal[i] = f.along.data[edge] + passed / left * f.length.data[edge];
      }
    }
  });
}

// Moves a node by `far` along the rod: the tensions of its edges stay as they are, and so it goes about its neighbours on
// an ellipsoid. Momentum stays as well.
template <class Fields>
PALPATE void move_node(const Fields& f, double* x, double* v, int i, double far) {
  const D3 a = load(x + 3 * i - 3), p = load(x + 3 * i), b = load(x + 3 * i + 3);
  double &before = f.length.data[i - 1], &after = f.length.data[i];
  const double le = norm(p - a) * (1.0 + far / before), lf = norm(b - p) * (1.0 - far / after);
  const double chord = norm(b - a), sum = le + lf;
  const D3 way = (1.0 / chord) * (b - a);
  const D3 off = (p - a) - dot(p - a, way) * way;
  const double most = 2.0 * norm(off);
  double ahead = le / sum * chord, high2 = 0.0;  // where both are tensed alike and straight
  if (sum > chord) {
    ahead = (chord * chord + le * le - lf * lf) / (2.0 * chord);
    high2 = le * le - ahead * ahead;
  }
  const double high = high2 <= 0.0 ? 0.0 : high2 < most * most ? sqrt(high2) : most;
  store(x + 3 * i, a + ahead * way + (most > 0.0 ? 2.0 * high / most : 0.0) * off);
  store(v + 3 * i, load(v + 3 * i) + far / (before + after) * (load(v + 3 * i + 3) - load(v + 3 * i - 3)));
  f.along.data[i] += far;
  before += far;
  after -= far;
}

// How far a node is to go along the rod in this step.
template <class Fields>
PALPATE double way_of(const Fields& f, const double* x, int i, double goal) {
  const double before = f.length.data[i - 1], after = f.length.data[i], shorter = before < after ? before : after;
  const double bends = norm(bent(x, i).curvature), off = goal - f.along.data[i], slack = CLOSE_BY * shorter;
  double most = COURANT * shorter;
  if (bends * most > ASIDE * f.radius) most = ASIDE * f.radius / bends;
  const double goes = GOES * (off > slack ? off - slack : off < -slack ? off + slack : 0.0);
  return goes > most ? most : goes < -most ? -most : goes;
}

// That as far as its edges may get longer, and shorter: nodes that are held up by a bend are not run into.
template <class Fields>
PALPATE double allowed(const Fields& f, int i, double goes) {
  const double before = f.length.data[i - 1], after = f.length.data[i];
  const double longer = f.longest - (goes > 0.0 ? before : after), left = (goes > 0.0 ? after : before) - SHORTEST * f.refine;
  const double room = longer < left ? longer : left, most = room > 0.0 ? room : 0.0;
  return goes > most ? most : goes < -most ? -most : goes;
}

// Moves the nodes along the rod, as the step has ended at f.place with the velocities f.vel.
template <class Fields>
PALPATE void refine(const Fields& f) {
  int *far = f.below.data, *stays = f.last.data;
  double *x = f.place.data, *near = f.trial.data, *goes = f.gradient.data;
  if (find_touching(f, x, far) < ROOM * f.radius) return;
  find_fixed(f, stays);
  each_lane(0, f.nnode - 1, [&](int e) { near[e] = near_part(f, e, far); });
  find_goals(f, stays, near, goes);
  each_lane(0, f.nnode, [&](int i) { goes[i] = stays[i] ? 0.0 : way_of(f, x, i, goes[i]); });
  for (int odd = 1; odd >= 0; --odd) {
    each_lane(0, f.nnode / 2, [&](int k) {
      const int i = 2 * k + odd;
      const double way = stays[i] ? 0.0 : allowed(f, i, goes[i]);
      if (way != 0.0) move_node(f, x, f.vel.data, i, way);
    });
  }
  each_lane(0, f.nnode, [&](int i) { f.own.moved.data[i] = f.along.data[i] - f.drawn.data[i]; });
}

}  // namespace palpate
