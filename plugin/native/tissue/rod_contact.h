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
constexpr double LISTED = 2.0, AHEAD = 3.0;
constexpr double STRETCHED = 1.2;  // more than an edge ever is
// Most dofs of bodies that a row lets yield to the rod, and nodes that stand for these, three each.
constexpr int REACH = 12, STANDINS = REACH / 3;

// The points of two segments, from p along d and from q along e, that are nearest (Ericson 2005, 5.1.9).
struct Nearest {
  double s, t;
  D3 off;                 // from the second to the first
  bool moves_s, moves_t;  // as the segments do; else it is an end
};

PALPATE double clamped(double a) { return a < 0.0 ? 0.0 : a > 1.0 ? 1.0 : a; }

PALPATE Nearest nearest(D3 p, D3 d, D3 q, D3 e) {
  const D3 r = p - q;
  const double a = dot(d, d), c = dot(e, e), f = dot(e, r), g = dot(d, r), b = dot(d, e);
  const double det = a * c - b * b;
  const double inner = det > 1e-9 * a * c ? (b * f - g * c) / det : 0.5;
  double s = clamped(inner), t = (b * s + f) / c;
  bool moves_s = s == inner && det > 1e-9 * a * c, moves_t = true;
  if (t < 0.0 || t > 1.0) {
    moves_t = false;
    t = clamped(t);
    const double free = (b * t - g) / a;
    s = clamped(free);
    moves_s = s == free;
  }
  return {s, t, r + s * d - t * e, moves_s, moves_t};
}

CALLED Nearest nearest_edges(const double* x, int i, int j) {
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
  each_lane(0, f.nnode, [&](int i) {
    const double v = norm(load(f.vel.data + 3 * i));
    fastest = v > fastest ? v : fastest;
  });
  return LISTED * f.radius + AHEAD * h * most_together(fastest);
}

// Lists the pairs of edges that are near each other at x; returns whether there is room for all.
template <class Fields>
CALLED bool list_near(const Fields& f, const double* x) {
  const int n = f.nnode;
  const double far = 2.0 * f.radius + f.reach.data[0], reach = far + f.longest;
  double broken = 0.0;
  each_lane(0, n - 1, [&](int i) { broken += is_whole(f, i) ? 0.0 : 1.0; });
  const bool whole = sum_together(broken) == 0.0;
  const int count = each_after(n - 1, [&](int i, int at) {
    if (!is_whole(f, i)) return 0;
    int own = 0;
    const D3 a = 0.5 * (load(x + 3 * i) + load(x + 3 * i + 3));
    const double beyond = f.along.data[i + 1] + NEIGHBOURS * f.radius;
    for (int j = i + 2, skip; j + 1 < n && f.collides; j += skip) {
      skip = 1;
      if (f.along.data[j] < beyond || !is_whole(f, j)) continue;
      const D3 b = 0.5 * (load(x + 3 * j) + load(x + 3 * j + 3));
      const double d2 = dot(a - b, a - b);
      if (d2 > reach * reach) {  // so are all edges up to where the thread could be back
        if (whole) skip = 1 + (int)((sqrt(d2) - reach) / (STRETCHED * f.longest));
        continue;
      }
      const D3 off = nearest_edges(x, i, j).off;
      if (dot(off, off) > far * far) continue;
      if (at >= 0 && at + own < f.most_pairs) {
        f.pair.data[2 * (at + own)] = i;
        f.pair.data[2 * (at + own) + 1] = j;
      }
      ++own;
    }
    return own;
  });
  if (count > f.most_pairs) return false;
  one_lane([&] { f.count.data[1] = count; });
  each_lane(0, 3 * n, [&](int a) { f.listed.data[a] = x[a]; });
  return true;
}

// Whether two edges can be no further from each other than `far`, by where their middles are.
template <class Fields>
PALPATE bool may_be_near(const Fields& f, const double* x, int i, int j, double far) {
  const D3 a = load(x + 3 * i) + load(x + 3 * i + 3), b = load(x + 3 * j) + load(x + 3 * j + 3);
  const double d2 = dot(a - b, a - b), most = 2.0 * (far + STRETCHED * f.longest);
  if (d2 >= most * most) return false;
  const double reach = 2.0 * far + STRETCHED * (f.length.data[i] + f.length.data[j]);
  return d2 < reach * reach;
}

#if ON_CUDA
PALPATE int bits(unsigned word) { return __popc(word); }
PALPATE int lowest_bit(unsigned word) { return __ffs(word) - 1; }
#else
PALPATE int bits(unsigned word) { return __builtin_popcount(word); }
PALPATE int lowest_bit(unsigned word) { return __builtin_ctz(word); }
#endif

// The nodes, and those that stand for bodies which yield, three of their coordinates each.
template <class Fields>
PALPATE int nodes_of(const Fields& f) { return f.nnode + f.count.data[3]; }

// Joins what rows of constraints connect.
template <class Fields, class Join>
PALPATE void join_bodies(const Fields& f, Join join) {
  const int last = nodes_of(f);
  each_lane(f.nnode, last, [&](int i) { join(i, i); });
  each_lane(0, f.count.data[0], [&](int r) {
    const int* body = f.row_yields.data + STANDINS * r;
    for (int k = 0; k < STANDINS && body[k] >= 0; ++k) {
      join(body[k], f.row_node.data[r]);
      if (f.row_node.data[r] + 1 < f.nnode) join(body[k], f.row_node.data[r] + 1);
      for (int other = 0; other < k; ++other) join(body[k], body[other]);
    }
  });
}

// Orders the nodes so that those that have to do with each other are near: next comes, of those that a
// node before has to do with, the one that adds the fewest (King 1970, doi:10.1002/nme.1620020406).
template <class Fields>
CALLED void order_nodes(const Fields& f, const double* x) {
  const int n = nodes_of(f), words = (n + 31) / 32;
  unsigned* near = (unsigned*)f.near.data;
  const auto mark = [&](unsigned* row, int i) { set_bits(row[i / 32], 1u << (i % 32)); };
  const auto has = [&](const unsigned* row, int i) { return row[i / 32] >> (i % 32) & 1; };
  each_lane(0, (n + 1) * words, [&](int a) { near[a] = 0; });
  const auto join = [&](int i, int j) {
    mark(near + i * words, j);
    mark(near + j * words, i);
  };
  each_lane(0, f.nnode, [&](int i) {
    for (int j = i; j < f.nnode && j < i + 3; ++j) join(i, j);
  });
  join_bodies(f, join);
  each_lane(0, f.count.data[1], [&](int p) {
    const int i = f.pair.data[2 * p], j = f.pair.data[2 * p + 1];
    if (!may_be_near(f, x, i, j, 2.5 * f.radius) || norm(nearest_edges(x, i, j).off) > 2.5 * f.radius) return;
    for (int a = i; a < i + 2; ++a)
      for (int b = j; b < j + 2; ++b) join(a, b);
  });
  unsigned* seen = near + n * words;  // what a node before has to do with, and these
  int *rank = f.rank.data, *front = f.below.data;  // what is seen, in that order; those from `first` on may have no rank yet
  each_lane(0, n, [&](int i) { rank[i] = -1; });
  int count = 0, first = 0, next = 0;
  for (int own = 0; own < n; ++own) {
    while (first < count && rank[front[first]] >= 0) ++first;
    int least = n * (n + 1);  // how many it adds, and where it is in front
    each_lane(first, count, [&](int k) {
      if (rank[front[k]] >= 0) return;
      int adds = 0;
      for (int a = 0; a < words; ++a) adds += bits(near[front[k] * words + a] & ~seen[a]);
      const int key = adds * n + k;
      least = key < least ? key : least;
    });
    while (first == count && has(seen, next)) ++next;
    const int node = first < count ? front[least_together(least) % n] : next;
    one_lane([&] {
      rank[node] = own;
      seen[node / 32] |= 1u << (node % 32);
    });
    count += each_after(words, [&](int a, int at) {
      unsigned adds = near[node * words + a] & ~seen[a];
      const int more = bits(adds);
      if (at < 0) return more;
      seen[a] |= adds;
      for (int* to = front + count + at; adds; adds &= adds - 1) *to++ = 32 * a + lowest_bit(adds);
      return more;
    });
  }
}

// Lists pairs, as far away as there is room, and orders the nodes.
template <class Fields>
PALPATE void list_pairs(const Fields& f, const double* x) {
  while (!list_near(f, x)) one_lane([&] { f.reach.data[0] *= 0.5; });
  order_nodes(f, x);
}

// Unknowns of a node in the matrix.
template <class Fields>
PALPATE int unknowns_of(const Fields& f) { return f.twists ? 4 : 3; }

template <class Fields>
PALPATE RodMatrix matrix_of(const Fields& f) {
  const int per = unknowns_of(f);
  return {{f.matrix.data, f.first.data, f.start_of_row.data, f.last.data, per * nodes_of(f)}, f.rank.data, per};
}

// The rows' first columns: of two neighbours along the rod, and of what touches at x or began the step so.
template <class Fields>
PALPATE void lay_out(const Fields& f, const double* x) {
  const int n = nodes_of(f), per = unknowns_of(f);
  const int* rank = f.rank.data;
  int* lowest = f.below.data;  // rank of what a node has to do with
  each_lane(0, n, [&](int i) { lowest[i] = rank[i]; });
  const auto join = [&](int i, int j) {
    lower(lowest[j], rank[i]);
    lower(lowest[i], rank[j]);
  };
  each_lane(0, f.nnode, [&](int i) {
    for (int j = i + 1; j < f.nnode && j < i + 3; ++j) join(i, j);
  });
  join_bodies(f, join);
  each_lane(0, f.count.data[1], [&](int p) {
    const int i = f.pair.data[2 * p], j = f.pair.data[2 * p + 1];
    if (!(f.pressure.data[p] > 0.0)) {
      if (!may_be_near(f, x, i, j, 2.0 * f.radius)) return;
      const D3 off = nearest_edges(x, i, j).off;
      if (dot(off, off) >= 4.0 * f.radius * f.radius) return;
    }
    for (int a = i; a < i + 2; ++a)
      for (int b = j; b < j + 2; ++b) join(a, b);
  });
  each_lane(0, n, [&](int i) {
    for (int c = 0; c < per; ++c) f.first.data[per * rank[i] + c] = per * lowest[i];
  });
  const int entries = each_after(per * n, [&](int a, int at) {
    if (at >= 0) f.start_of_row.data[a] = at;
    return a - f.first.data[a] + 1;
  });
  one_lane([&] { f.count.data[2] = entries; });
}

// Adds what a force between two edges does as they turn and as their nearest points move: the second derivative
// of their distance, but for that along their normal, times `stiffness`, which is force over distance.
PALPATE void add_turning(Terms<4>& terms, const double* x, const int* node, Nearest at, const double* w, double stiffness) {
  terms.add_each(w, stiffness);
  // The points are where the derivatives of half the distance squared by s and t are 0, or at an end.
  const D3 d = load(x + 3 * node[1]) - load(x + 3 * node[0]), e = load(x + 3 * node[3]) - load(x + 3 * node[2]);
  double by_s[12], by_t[12];
  for (int k = 0; k < 4; ++k) {
    const double of_d = k == 0 ? -1.0 : k == 1 ? 1.0 : 0.0, of_e = k == 2 ? -1.0 : k == 3 ? 1.0 : 0.0;
    store(by_s + 3 * k, w[k] * d + of_d * at.off);
    store(by_t + 3 * k, -w[k] * e - of_e * at.off);
  }
  const double a = dot(d, d), b = -dot(d, e);
  double c = dot(e, e);
  if (at.moves_s) {
    terms.add(by_s, 0.0, -stiffness / a);
    for (int k = 0; k < 12; ++k) by_t[k] -= b / a * by_s[k];
    c -= b * b / a;
  }
  if (at.moves_t) terms.add(by_t, 0.0, -stiffness / c);
}

// Friction of a pair by the displacement u along it: mu lambda f0(|u|), smooth below `slow`.
struct Slip { double energy, per, along; };  // f0, f0' / y, (f0'' - f0' / y) / y^2

PALPATE Slip slip(double y, double slow) {
  if (y >= slow) return {y, 1.0 / y, -1.0 / (y * y * y)};
  const double z = y / slow;
  const double along = y > 1e-12 * slow ? -1.0 / (slow * slow * y) : 0.0;
  return {slow * (z * z - z * z * z / 3.0 + 1.0 / 3.0), (2.0 - z) / slow, along};
}

// What a pair notes as a step begins: where it touches on each edge, the normal, and the velocity below which its
// friction is viscous, which is a share of its own: so friction is smooth for the solver as it slides, and
// as it comes to rest the share goes with it.
constexpr int TOUCH = 5;
constexpr double SMOOTH = 0.3;

// Of a vector of all nodes, such as their places, how much more the first edge of a pair has than the second,
// where they touch and across the normal.
template <class Fields>
PALPATE D3 slid(const Fields& f, int p, const double* x) {
  const int i = f.pair.data[2 * p], j = f.pair.data[2 * p + 1];
  const double* touch = f.touch.data + TOUCH * p;
  const D3 normal = load(touch + 2), u = (1.0 - touch[0]) * load(x + 3 * i) + touch[0] * load(x + 3 * i + 3) -
                                         (1.0 - touch[1]) * load(x + 3 * j) - touch[1] * load(x + 3 * j + 3);
  return u - dot(u, normal) * normal;
}

// What a pair adds.
struct PairTerms {
  int node[4];
  union { Terms<4> terms; };  // there where it is asked for

  PALPATE PairTerms() {}
  PALPATE Terms<4>& begin(int i, int j) {
    node[0] = i, node[1] = i + 1, node[2] = j, node[3] = j + 1;
    return terms = Terms<4>();
  }
};

// The energy of this lane's contacts at x; adds the gradient and second derivative of all where there are a gradient
// and a matrix, see `add_rod`.
template <class Fields>
CALLED double contacts_energy(const Fields& f, const double* x, double h, double* g, const RodMatrix* H, bool exact) {
  const double slow = h * f.smooth.data[0];
  double sum = 0.0;
  const auto add_pair = [&](int p, PairTerms& own) {
    const int i = f.pair.data[2 * p], j = f.pair.data[2 * p + 1];
    const double limit = f.friction * f.pressure.data[p];
    if (!(limit > 0.0) && (limit < 0.0 || !may_be_near(f, x, i, j, 2.0 * f.radius))) return false;
    const Nearest at = nearest_edges(x, i, j);
    const double distance = norm(at.off);
    const Barrier b = barrier(f, distance);
    const bool touches = b.energy > 0.0;
    if (!touches && !(limit > 0.0)) return false;
    Terms<4>& terms = own.begin(i, j);
    if (touches) {
      sum += b.energy;
      if (g) {
        const double w[4] = {1.0 - at.s, at.s, at.t - 1.0, -at.t}, per = exact ? b.slope / distance : 0.0;
        terms.add(w, (1.0 / distance) * at.off, b.slope, b.bend - per);
        if (exact) add_turning(terms, x, own.node, at, w, per);
      }
    }
    if (limit > 0.0) {
      const double* touch = f.touch.data + TOUCH * p;
      const double w[4] = {1.0 - touch[0], touch[0], touch[1] - 1.0, -touch[1]};
      const D3 normal = load(touch + 2), u = slid(f, p, x) - slid(f, p, f.start.data);
      const double y = norm(u);
      const Slip s = slip(y, slow);
      sum += limit * s.energy;
      if (g) {
        const D3 one = unit(cross(normal, fabs(normal.x) < 0.6 ? D3{1.0, 0.0, 0.0} : D3{0.0, 1.0, 0.0}));
        const D3 along = y > 1e-12 * slow ? (1.0 / y) * u : one, across = cross(normal, along);
        terms.add(w, along, limit * s.per * y, limit * (s.per + s.along * y * y));
        terms.add(w, across, 0.0, limit * s.per);
      }
    }
    return g != nullptr;
  };
  each_in_turn<PairTerms>(f.count.data[1], add_pair, [&](const PairTerms& own) { own.terms.scatter_together(own.node, g, *H); });
  return sum;
}

// Notes the pressure of each listed pair at the start of the step, and where it acts; -1 of pairs that are
// nearer than can be, as where a state was set so: they do not meet until they are apart.
template <class Fields>
CALLED void note_pressure(const Fields& f) {
  double fastest = f.slow;
  each_lane(0, f.count.data[1], [&](int p) {
    const int i = f.pair.data[2 * p], j = f.pair.data[2 * p + 1];
    f.pressure.data[p] = 0.0;
    if (!may_be_near(f, f.start.data, i, j, 2.0 * f.radius)) return;
    const Nearest at = nearest_edges(f.start.data, i, j);
    const double distance = norm(at.off);
    const Barrier b = barrier(f, distance);
    f.pressure.data[p] = distance <= 2.0 * CORE * f.radius ? -1.0 : -b.slope;
    double* touch = f.touch.data + TOUCH * p;
    touch[0] = at.s;
    touch[1] = at.t;
    store(touch + 2, unit(at.off));
    const double slides = SMOOTH * norm(slid(f, p, f.vel.data));
    if (f.pressure.data[p] > 0.0 && slides > fastest) fastest = slides;
  });
  fastest = most_together(fastest);
  one_lane([&] { f.smooth.data[0] = fastest; });
}

// How far nodes have moved since pairs were listed, at most.
template <class Fields>
PALPATE double moved_since(const Fields& f, const double* x) {
  double most = 0.0;
  each_lane(0, f.nnode, [&](int i) {
    const double far = norm(load(x + 3 * i) - load(f.listed.data + 3 * i));
    most = far > most ? far : most;
  });
  return most_together(most);
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
CALLED double safe_part(const Fields& f, const double* x, const double* move, int stride) {
  double part = 1.0, most = 0.0;
  each_lane(0, f.nnode, [&](int i) {
    const double far = norm(load(move + stride * i));
    most = far > most ? far : most;
  });
  most = most_together(most);
  if (!f.collides) return part;
  const double room = 0.5 * f.reach.data[0] - moved_since(f, x);  // for what is not listed
  if (part * most > room) part = room / most;
  each_lane(0, f.count.data[1], [&](int p) {
    const int i = f.pair.data[2 * p], j = f.pair.data[2 * p + 1];
    if (f.pressure.data[p] < 0.0) return;
    const double meets = 2.0 * CORE * f.radius + 2.0 / (1.0 - LEFT) * part * most;
    if (may_be_near(f, x, i, j, meets)) part = safe_for(f, x, move, stride, i, j, part);
  });
  part = least_together(part);
  return part > 0.0 ? part : 0.0;
}

}  // namespace palpate
