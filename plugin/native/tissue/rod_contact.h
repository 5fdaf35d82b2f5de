// Contacts of a rod with itself: a barrier between its edges (Li et al. 2020, doi:10.1145/3386569.3392425),
// which are round and a bit soft, and friction by the pressure with which a step begins.
#pragma once
#include "tissue/rod.h"

AS_WRITTEN

namespace palpate {

// Of the room before two edges meet, the share that an iteration leaves; how near to that it is found.
constexpr double LEFT = 0.2, FOUND = 0.9;
// How far two edges that are listed may be apart before they touch: in radii, and in what the fastest
// node goes in a step.
constexpr double LISTED = 4.0, AHEAD = 3.0;

// The points of two segments, from p along d and from q along e, that are nearest (Ericson 2005, 5.1.9).
struct Nearest { double s, t; D3 off; };

PALPATE double clamped(double a) { return a < 0.0 ? 0.0 : a > 1.0 ? 1.0 : a; }

PALPATE Nearest nearest(D3 p, D3 d, D3 q, D3 e) {
  const D3 r = p - q;
  const double a = dot(d, d), c = dot(e, e), f = dot(e, r), g = dot(d, r), b = dot(d, e);
  const double det = a * c - b * b;
  double s = det > 1e-9 * a * c ? clamped((b * f - g * c) / det) : 0.5, t = (b * s + f) / c;
  if (t < 0.0 || t > 1.0) {
    t = clamped(t);
    s = clamped((b * t - g) / a);
  }
  return {s, t, r + s * d - t * e};
}

PALPATE Nearest nearest_edges(const double* x, int i, int j) {
  const D3 p = load(x + 3 * i), q = load(x + 3 * j);
  return nearest(p, load(x + 3 * i + 3) - p, q, load(x + 3 * j + 3) - q);
}

// A pair's barrier -k (g - w)^2 ln(g / w) of the gap g = distance - core below the width w, and two
// derivatives.
struct Barrier { double energy, slope, bend; };

template <class Fields>
PALPATE Barrier barrier(const Fields& f, double distance) {
  const double core = 2.0 * CORE * f.radius, w = 2.0 * f.radius - core, g = distance - core;
  if (g >= w) return {0.0, 0.0, 0.0};
  if (!(g > 0.0)) return {1e30, 0.0, 0.0};
  const double k = f.hardness, d = g - w, l = log(g / w);
  return {-k * d * d * l, -k * (2.0 * d * l + d * d / g), -k * (2.0 * l + 4.0 * d / g - d * d / (g * g))};
}

// How far listed edges may be apart, for the velocities that the step begins with.
template <class Fields>
PALPATE double reach_of(const Fields& f, double h) {
  double fastest = 0.0;
  for (int i = 0; i < f.nnode; ++i) {
    const double v = norm(load(f.vel.data + 3 * i));
    fastest = v > fastest ? v : fastest;
  }
  return LISTED * f.radius + AHEAD * h * fastest;
}

// Lists the pairs of edges that are near each other at x; returns whether there is room for all.
template <class Fields>
PALPATE bool list_near(const Fields& f, const double* x) {
  const int n = f.nnode;
  int count = 0;
  const double far = 2.0 * f.radius + f.reach.data[0];
  for (int i = 0; i + 1 < n; ++i) {
    const D3 a = 0.5 * (load(x + 3 * i) + load(x + 3 * i + 3));
    double between = 0.0;
    for (int j = i + 2; j + 1 < n && f.collides; ++j) {
      between += f.length.data[j - 1];
      if (between < NEIGHBOURS * f.radius) continue;
      const D3 b = 0.5 * (load(x + 3 * j) + load(x + 3 * j + 3));
      const double reach = far + f.longest, d2 = dot(a - b, a - b);
      if (d2 > reach * reach) continue;
      const D3 off = nearest_edges(x, i, j).off;
      if (dot(off, off) > far * far) continue;
      if (count >= f.most_pairs) return false;
      f.pair.data[2 * count] = i;
      f.pair.data[2 * count + 1] = j;
      ++count;
    }
  }
  f.count.data[1] = count;
  for (int a = 0; a < 3 * n; ++a) f.listed.data[a] = x[a];
  return true;
}

// Lists them, as far away as there is room.
template <class Fields>
PALPATE void list_pairs(const Fields& f, const double* x) {
  while (!list_near(f, x)) f.reach.data[0] *= 0.5;
}

// The rows' first columns: of two neighbours along the rod, and of what touches at x or began the step so.
template <class Fields>
PALPATE void lay_out(const Fields& f, const double* x) {
  const int n = 4 * f.nnode;
  int* first = f.first.data;
  for (int a = 0; a < n; ++a) {
    const int node = a / 4, reach = a % 4 < 3 ? 2 : 1;
    first[a] = node > reach ? 4 * (node - reach) : 0;
    if (a % 4 == 3 && !f.twists) first[a] = a;
  }
  for (int p = 0; p < f.count.data[1]; ++p) {
    const int i = f.pair.data[2 * p], j = f.pair.data[2 * p + 1];
    const D3 off = nearest_edges(x, i, j).off;
    if (f.pressure.data[p] == 0.0 && dot(off, off) >= 4.0 * f.radius * f.radius) continue;
    for (int a = 4 * j; a < 4 * j + 7; ++a)
      if (first[a] > 4 * i && a != 4 * j + 3) first[a] = 4 * i;
  }
  int at = 0;
  for (int a = 0; a < n; ++a) {
    f.start_of_row.data[a] = at;
    at += a - first[a] + 1;
  }
  f.count.data[2] = at;
}

template <class Fields>
PALPATE Envelope matrix_of(const Fields& f) {
  return {f.matrix.data, f.first.data, f.start_of_row.data, 4 * f.nnode};
}

// Adds force (w . v) and stiffness v v^T for a vector v = w_k axis of the four nodes of a pair.
PALPATE void add_pair(double* g, const Envelope& H, const int* node, const double* w, D3 axis, double force, double stiffness) {
  const double a[3] = {axis.x, axis.y, axis.z};
  for (int k = 0; k < 4; ++k) {
    for (int c = 0; c < 3; ++c) {
      const int row = 4 * node[k] + c;
      const double v = w[k] * a[c];
      g[row] += force * v;
      if (stiffness == 0.0) continue;
      for (int m = 0; m <= k; ++m)
        for (int d = 0; d < 3; ++d)
          if (4 * node[m] + d <= row) H.row(row)[4 * node[m] + d] += stiffness * v * w[m] * a[d];
    }
  }
}

// Friction of a pair by the displacement u along it: mu lambda f0(|u|), smooth below `slow`.
struct Slip { double energy, per, along; };  // f0, f0' / y, (f0'' - f0' / y) / y^2

PALPATE Slip slip(double y, double slow) {
  if (y >= slow) return {y, 1.0 / y, -1.0 / (y * y * y)};
  const double z = y / slow;
  const double along = y > 1e-12 * slow ? -1.0 / (slow * slow * y) : 0.0;
  return {slow * (z * z - z * z * z / 3.0 + 1.0 / 3.0), (2.0 - z) / slow, along};
}

// The energy of contacts at x; adds its gradient and second derivative where there are a gradient and a matrix.
template <class Fields>
PALPATE double contacts_energy(const Fields& f, const double* x, double h, double* g, const Envelope* H) {
  const double slow = f.slow * h;
  double sum = 0.0;
  for (int p = 0; p < f.count.data[1]; ++p) {
    const int i = f.pair.data[2 * p], j = f.pair.data[2 * p + 1];
    const int node[4] = {i, i + 1, j, j + 1};
    const Nearest at = nearest_edges(x, i, j);
    const double distance = norm(at.off);
    const Barrier b = barrier(f, distance);
    if (b.energy > 0.0 && f.pressure.data[p] >= 0.0) {
      sum += b.energy;
      if (g) {
        const double w[4] = {1.0 - at.s, at.s, at.t - 1.0, -at.t};
        add_pair(g, *H, node, w, (1.0 / distance) * at.off, b.slope, b.bend);
      }
    }
    const double limit = f.friction * f.pressure.data[p];
    if (!(limit > 0.0)) continue;
    const double* touch = f.touch.data + 5 * p;  // s, t and the normal as the step began
    const double w[4] = {1.0 - touch[0], touch[0], touch[1] - 1.0, -touch[1]};
    const D3 normal = load(touch + 2);
    D3 u = {0.0, 0.0, 0.0};
    for (int k = 0; k < 4; ++k) u += w[k] * (load(x + 3 * node[k]) - load(f.start.data + 3 * node[k]));
    u = u - dot(u, normal) * normal;
    const double y = norm(u);
    const Slip s = slip(y, slow);
    sum += limit * s.energy;
    if (!g) continue;
    const D3 one = unit(cross(normal, fabs(normal.x) < 0.6 ? D3{1.0, 0.0, 0.0} : D3{0.0, 1.0, 0.0}));
    const D3 along = y > 1e-12 * slow ? (1.0 / y) * u : one, across = cross(normal, along);
    add_pair(g, *H, node, w, along, limit * s.per * y, limit * (s.per + s.along * y * y));
    add_pair(g, *H, node, w, across, 0.0, limit * s.per);
  }
  return sum;
}

// Notes the pressure of each listed pair at the start of the step, and where it acts; -1 of pairs that are
// nearer than can be, as where a state was set so: they do not meet until they are apart.
template <class Fields>
PALPATE void note_pressure(const Fields& f) {
  for (int p = 0; p < f.count.data[1]; ++p) {
    const Nearest at = nearest_edges(f.start.data, f.pair.data[2 * p], f.pair.data[2 * p + 1]);
    const double distance = norm(at.off);
    const Barrier b = barrier(f, distance);
    f.pressure.data[p] = distance <= 2.0 * CORE * f.radius ? -1.0 : -b.slope;
    double* touch = f.touch.data + 5 * p;
    touch[0] = at.s;
    touch[1] = at.t;
    store(touch + 2, unit(at.off));
  }
}

// How far nodes have moved since pairs were listed, at most.
template <class Fields>
PALPATE double moved_since(const Fields& f, const double* x) {
  double most = 0.0;
  for (int i = 0; i < f.nnode; ++i) {
    const double far = norm(load(x + 3 * i) - load(f.listed.data + 3 * i));
    most = far > most ? far : most;
  }
  return most;
}

// Whether pairs have to be listed again: half of what they may move has gone.
template <class Fields>
PALPATE bool is_stale(const Fields& f, const double* x) {
  return f.collides && moved_since(f, x) > 0.3 * f.reach.data[0];
}

// The points of two edges after part of a move.
PALPATE Nearest nearest_after(const double* x, const double* move, int stride, int i, int j, double part) {
  D3 at[4];
  const int node[4] = {i, i + 1, j, j + 1};
  for (int k = 0; k < 4; ++k) at[k] = load(x + 3 * node[k]) + part * load(move + stride * node[k]);
  return nearest(at[0], at[1] - at[0], at[2], at[3] - at[2]);
}

// How much of a move, no more than `part`, leaves two edges room between them: by steps of which none can
// be too long (Li et al. 2021, doi:10.1145/3450626.3459767, algorithm 1).
template <class Fields>
PALPATE double safe_for(const Fields& f, const double* x, const double* move, int stride, int i, int j, double part) {
  const double core = 2.0 * CORE * f.radius;
  double closing = 0.0;  // of their points no two come nearer by more
  for (int a = 0; a < 2; ++a) {
    for (int b = 0; b < 2; ++b) {
      const double far = norm(load(move + stride * (i + a)) - load(move + stride * (j + b)));
      closing = far > closing ? far : closing;
    }
  }
  double gap = norm(nearest_edges(x, i, j).off) - core;
  if (part * closing <= (1.0 - LEFT) * gap) return part;
  const double least = LEFT * gap;
  double done = 0.0;
  for (int k = 0; k < 100 && done < part; ++k) {
    const double next = done + FOUND * (gap - FOUND * least) / closing;
    if (next >= part) return part;
    gap = norm(nearest_after(x, move, stride, i, j, next).off) - core;
    if (gap < least) return done;
    done = next;
  }
  return done;
}

// How much of a move of all nodes, a distance `stride` apart in `move`, can be taken so that no edges go
// through each other. The list must have all pairs that may meet.
template <class Fields>
PALPATE double safe_part(const Fields& f, const double* x, const double* move, int stride) {
  double part = 1.0, most = 0.0;
  for (int i = 0; i < f.nnode; ++i) {
    const double far = norm(load(move + stride * i));
    most = far > most ? far : most;
  }
  if (!f.collides) return part;
  const double room = 0.5 * f.reach.data[0] - moved_since(f, x);  // for what is not listed
  if (part * most > room) part = room / most;
  for (int p = 0; p < f.count.data[1]; ++p) {
    if (f.pressure.data[p] >= 0.0)
      part = safe_for(f, x, move, stride, f.pair.data[2 * p], f.pair.data[2 * p + 1], part);
  }
  return part > 0.0 ? part : 0.0;
}

}  // namespace palpate
