// The surface of an organ that is cut: triangles and, of each vertex, the ring of its neighbours.
//
// A half-edge 3 t + k goes from corner k of triangle t to the next one; its twin is on the other side,
// -1 on a boundary. A ring is counter-clockwise, with the half-edges from its vertex ("spokes"): in an
// open one the last neighbour is reached by none, -1. Whole is what there was before the first cut.
#pragma once
#include "core/triangle.h"

AS_WRITTEN

namespace palpate {

PALPATE int next_half(int h) { return h % 3 == 2 ? h - 2 : h + 1; }
PALPATE int last_half(int h) { return h % 3 == 0 ? h + 2 : h - 1; }

template <class I>
struct Surface {
  // Of moves: least quality of a triangle, or so much of what it had; times its energy that the tissue around a
  // vertex may have when it moved; how much less it moves, how often; see `moves.h`.
  static constexpr int CORNERS = 3, ROUNDS = 22;
  static constexpr double THIN = 0.3, KEPT = 0.9, RISE = 1.01, SHORTER = 0.87, GIVES = 0.0;

  int nvert, nelem, most;
  double* rest;
  I *elem, *twin, *ring, *spoke, *degree;
  const I *whole_elem, *whole_twin;

  PALPATE D3 place(int v) const { return load(rest + 3 * v); }
  PALPATE int from(int h) const { return (int)elem[h]; }
  PALPATE int to(int h) const { return (int)elem[next_half(h)]; }
  PALPATE int opposite(int h) const { return (int)elem[last_half(h)]; }
  PALPATE int neighbour(int v, int k) const { return (int)ring[most * v + k]; }
  PALPATE int half(int v, int k) const { return (int)spoke[most * v + k]; }
  PALPATE bool on_rim(int v) const { return degree[v] == 0 || half(v, (int)degree[v] - 1) < 0; }
  // The half-edge to a neighbour, -1 for none.
  PALPATE int half_to(int v, int other) const {
    for (int k = 0; k < degree[v]; ++k)
      if (neighbour(v, k) == other) return half(v, k);
    return -1;
  }
  PALPATE bool has_both_sides(int v, int other) const {
    const int h = half_to(v, other);
    return h >= 0 && twin[h] >= 0;
  }
  PALPATE void corners(int t, D3* x) const {
    for (int c = 0; c < 3; ++c) x[c] = place((int)elem[3 * t + c]);
  }
  PALPATE int vert(int corner) const { return (int)elem[corner]; }
  PALPATE I* cells() const { return elem; }
  // An edge, 0 or 1, of the triangle of a corner that has its vertex; the edge beside one, -1 for none.
  PALPATE int facet(int corner, int k) const { return k ? last_half(corner) : corner; }
  PALPATE int beside(int half) const { return (int)twin[half]; }
  PALPATE int size() const { return nelem; }
  PALPATE int most_triangles() const { return 0; }
  PALPATE bool inside(int) const { return false; }
  PALPATE double quality(const D3* x) const { return shape_of(x); }
  // Calls body(corner) for the corners that a vertex has.
  template <class Body>
  PALPATE void each_corner(int v, Body body) const {
    for (int k = 0; k < degree[v]; ++k)
      if (half(v, k) >= 0) body(half(v, k));
  }
  template <class Body>
  PALPATE void each_triangle(int, Body) const {}
};

// The surface in arrays of such names.
template <class F>
PALPATE auto surface_of(const F& f) {
  using I = decltype(f.elem.data[0] + 0);
  return Surface<I>{f.nvert, f.nelem, f.most, f.rest.data, f.elem.data, f.twin.data, f.ring.data,
                    f.spoke.data, f.degree.data, f.whole_elem.data, f.whole_twin.data};
}

// What vertices carry.
struct Moving { double *mass, *disp, *vel; };

// Scratch; numbers that are taken are zero, unless they are room alone.
struct Scratch {
  int* ints;
  double* reals;
  int nint, nreal;
  bool full;

  PALPATE int* room(int n) {
    if (n > nint) return full = true, nullptr;
    int* out = ints;
    ints += n, nint -= n;
    return out;
  }
  PALPATE int* numbers(int n) {
    int* out = room(n);
    for (int i = 0; i < n && out; ++i) out[i] = 0;
    return out;
  }
  PALPATE double* values(int n) {
    if (n > nreal) return full = true, nullptr;
    double* out = reals;
    reals += n, nreal -= n;
    return out;
  }
};

// Different numbers, in the order in which they came; `put` tells whether one is new.
struct Few {
  int *list, *place;  // of a number: where it is in the list, from 1; 0 where it is not
  int count;

  PALPATE bool put(int number) {
    if (place[number]) return false;
    list[count++] = number;
    place[number] = count;
    return true;
  }
  PALPATE bool has(int number) const { return place[number] > 0; }
  PALPATE void clear() {
    for (int i = 0; i < count; ++i) place[list[i]] = 0;
    count = 0;
  }
  // Puts them in ascending order; they are under `end`.
  PALPATE void sort(int end) {
    int k = 0;
    for (int n = 0; n < end; ++n)
      if (place[n]) list[k++] = n, place[n] = k;
  }
};

PALPATE Few few(Scratch& memory, int most) {
  int* list = memory.room(most);
  return {list, memory.numbers(most), 0};
}

// The area around a vertex, summed over triangles in ascending order; of those that `loose` marks none.
template <class S, class L>
PALPATE double area_around(const S& m, int v, const L* loose) {
  double sum = 0.0;
  for (int t = -1;;) {
    int next = m.nelem;
    for (int k = 0; k < m.degree[v]; ++k) {
      const int h = m.half(v, k);
      if (h >= 0 && h / 3 > t && h / 3 < next) next = h / 3;
    }
    if (next == m.nelem) return sum;
    t = next;
    D3 x[3];
    m.corners(t, x);
    if (!loose || !loose[t]) sum += norm(0.5 * cross(x[1] - x[0], x[2] - x[0])) / 3.0;
  }
}

// Vertices that hang together have the lowest of them for a root.
struct Pieces {
  int* root;

  PALPATE int find(int v) const {
    while (root[v] != v) v = root[v] = root[root[v]];
    return v;
  }
  PALPATE void join(int v, int w) const {
    const int a = find(v), b = find(w);
    root[a > b ? a : b] = a < b ? a : b;
  }
};

PALPATE Pieces all_apart(Scratch& memory, int nvert) {
  Pieces out = {memory.room(nvert)};
  for (int v = 0; v < nvert && out.root; ++v) out.root[v] = v;
  return out;
}

// Marks triangles that a cut has freed from the foundation: of what it held together until now, it goes on to
// hold the largest piece.
template <class S, class I>
PALPATE bool let_go(const S& m, const Pieces& p, const I* home, unsigned char* loose, Scratch& memory) {
  int *best = memory.numbers(m.nelem), *many = memory.numbers(m.nelem);
  double* size = memory.values(m.nvert);
  if (memory.full) return false;
  for (int v = 0; v < m.nvert; ++v) size[v] = 0.0;
  for (int t = 0; t < m.nelem; ++t) {
    D3 x[3];
    for (int c = 0; c < 3; ++c) x[c] = m.place((int)m.elem[3 * t + c]);
    if (!loose[t]) size[p.find((int)m.elem[3 * t])] += norm(0.5 * cross(x[1] - x[0], x[2] - x[0]));
  }
  for (int t = 0; t < m.nelem; ++t) {  // `best` of a home: its largest piece, from 1
    const int v = p.find((int)m.elem[3 * t]), h = (int)home[t];
    if (size[v] == 0.0 || best[h] == v + 1) continue;
    const double most = best[h] ? size[best[h] - 1] : 0.0;
    many[h] = 1 + (best[h] > 0);
    if (size[v] > most || (size[v] == most && v + 1 < best[h])) best[h] = v + 1;
  }
  for (int t = 0; t < m.nelem; ++t) {
    const int h = (int)home[t];
    if (many[h] > 1 && p.find((int)m.elem[3 * t]) + 1 != best[h]) loose[t] = 1;
  }
  return true;
}

// Turns a symmetric matrix so that an entry beside its diagonal is 0 (Jacobi 1846), and with it `axes`.
PALPATE void turn_axes(double (*a)[3], double (*axes)[3], int p, int q) {
  if (a[p][q] == 0.0) return;
  const double theta = 0.5 * (a[q][q] - a[p][p]) / a[p][q];
  const double t = (theta >= 0.0 ? 1.0 : -1.0) / (fabs(theta) + sqrt(1.0 + theta * theta));
  const double c = 1.0 / sqrt(1.0 + t * t), s = t * c;
  for (int k = 0; k < 3; ++k) {
    const double x = a[k][p], y = a[k][q];
    a[k][p] = c * x - s * y, a[k][q] = s * x + c * y;
  }
  for (int k = 0; k < 3; ++k) {
    const double x = a[p][k], y = a[q][k];
    a[p][k] = c * x - s * y, a[q][k] = s * x + c * y;
  }
  a[p][q] = a[q][p] = 0.0;
  for (int k = 0; k < 3; ++k) {
    const double x = axes[k][p], y = axes[k][q];
    axes[k][p] = c * x - s * y, axes[k][q] = s * x + c * y;
  }
}

constexpr int SWEEPS = 6;

// Leaves the eigenvalues of a symmetric matrix on its diagonal, and its eigenvectors as columns of `axes`;
// rows that are 0 keep the axis of their own.
PALPATE void find_axes(double (*a)[3], double (*axes)[3]) {
  for (int i = 0; i < 9; ++i) axes[i / 3][i % 3] = i / 3 == i % 3;
  for (int k = 0; k < SWEEPS; ++k)
    for (int p = 0; p < 2; ++p)
      for (int q = p + 1; q < 3; ++q) turn_axes(a, axes, p, q);
}

// The nearest place of a surface: a triangle, weights of its corners, and how far it is.
struct Spot { int elem; D3 weight; double far; };

// The spot nearest to a point among the triangles around some vertices; `x` has where vertices are.
template <class S>
PALPATE Spot nearest_around(const S& m, const double* x, D3 point, const int* vert, int n) {
  Spot out = {0, {1.0, 0.0, 0.0}, 1e300};
  for (int i = 0; i < n; ++i)
    for (int k = 0; k < m.degree[vert[i]]; ++k) {
      const int h = m.half(vert[i], k);
      if (h < 0) continue;
      D3 corner[3];
      for (int c = 0; c < 3; ++c) corner[c] = load(x + 3 * m.elem[h - h % 3 + c]);
      const D3 w = barycentric(point, corner);
      const double far = norm(blend(corner, w) - point);
      if (far < out.far) out = {h / 3, w, far};
    }
  return out;
}

constexpr double BOX = 3.0;  // edges from points within which they are looked for first
constexpr double TIE = 1e-9;  // edges by which a triangle must be nearer than one with a nearer middle

// The box around points, and some room.
struct Box {
  D3 low, high;

  PALPATE Box(const double* point, int n, double room) : low(load(point)), high(low) {
    const D3 zero = {0.0, 0.0, 0.0}, more = {room, room, room};
    for (int i = 1; i < n; ++i) {
      high = vmax(high, load(point + 3 * i));
      low = zero - vmax(zero - low, zero - load(point + 3 * i));
    }
    low = low - more, high = high + more;
  }
  PALPATE bool has(D3 a) const {
    const D3 off = vmax(low - a, a - high);
    return off.x <= 0.0 && off.y <= 0.0 && off.z <= 0.0;
  }
};

// Triangles of a surface, all or those of a list.
template <class I>
struct Triangles {
  const I* elem;
  const double *x, *rest;  // where vertices are, now and at rest
  const int* among;
  const double* middles;  // of those of a list
  int count;

  PALPATE int of(int j) const { return among ? among[j] : j; }
  PALPATE D3 corner(int t, int c) const { return load(x + 3 * elem[3 * t + c]); }
  PALPATE D3 middle(int t) const { return (1.0 / 3.0) * (corner(t, 0) + corner(t, 1) + corner(t, 2)); }
  PALPATE D3 area_vector(int t) const {
    const D3 a = load(rest + 3 * elem[3 * t]), b = load(rest + 3 * elem[3 * t + 1]);
    return 0.5 * cross(b - a, load(rest + 3 * elem[3 * t + 2]) - a);
  }
  // How far a corner is from the middle of its triangle, at most.
  PALPATE double reach() const {
    double most = 0.0;
    for (int j = 0; j < count; ++j)
      for (int c = 0; c < 3; ++c) {
        const D3 arm = corner(of(j), c) - middle(of(j));
        most = dot(arm, arm) > most ? dot(arm, arm) : most;
      }
    return sqrt(most);
  }
  // The spot that is nearest to a point; on an edge, that of the triangle whose middle is nearer.
  PALPATE Spot nearest(D3 p, double tie, double reach) const {
    Spot out = {0, {1.0, 0.0, 0.0}, 1e300};
    double least = 1e300;
    for (int j = 0; j < count; ++j) {
      const int t = of(j);
      const D3 arm = (middles ? load(middles + 3 * j) : middle(t)) - p;
      const double far2 = dot(arm, arm), bound = out.far + tie + reach;
      if (far2 > bound * bound) continue;
      D3 x[3];
      for (int c = 0; c < 3; ++c) x[c] = corner(t, c);
      const D3 w = barycentric(p, x);
      const double off = norm(blend(x, w) - p);
      if (off < out.far - tie || (off < out.far + tie && far2 < least)) out = {t, w, off}, least = far2;
    }
    return out;
  }
  // The unit normal at rest at a spot, even across edges.
  PALPATE D3 normal(Spot spot) const {
    D3 sum[3] = {}, out = {0.0, 0.0, 0.0};
    for (int j = 0; j < count; ++j)
      for (int c = 0; c < 9; ++c)
        if (elem[3 * of(j) + c / 3] == elem[3 * spot.elem + c % 3]) sum[c % 3] += area_vector(of(j));
    const double weight[3] = {spot.weight.x, spot.weight.y, spot.weight.z};
    for (int c = 0; c < 3; ++c) out += (weight[c] / norm(sum[c])) * sum[c];
    return (1.0 / norm(out)) * out;
  }
};

// Finds the spots that are nearest to points, which `put` gets with the triangles around: looked for in a box
// around all points first, whose triangles and their middles `inside` and `middles` get.
template <class I, class Put>
PALPATE void nearest_spots(const Triangles<I>& all, const double* point, int n, double edge, int* inside,
                           double* middles, Put put) {
  const Box box(point, n, BOX * edge);
  Triangles<I> near = all;
  near.among = inside, near.middles = middles, near.count = 0;
  for (int t = 0; t < all.count; ++t) {
    if (!box.has(all.corner(t, 0))) continue;
    store(middles + 3 * near.count, all.middle(t));
    inside[near.count++] = t;
  }
  const double reach = near.reach();
  double most = 0.0;  // of all
  for (int i = 0; i < n; ++i) {
    const D3 p = load(point + 3 * i);
    const Spot spot = near.nearest(p, TIE * edge, reach);
    if (spot.far + 2.0 * reach < BOX * edge) {
      put(i, spot, near);
      continue;
    }
    most = most > 0.0 ? most : all.reach();
    put(i, all.nearest(p, TIE * edge, most), all);
  }
}

// The place of a polyline of dense samples that is nearest to a point, beside its nearest sample.
PALPATE D3 place_on(const double* line, int n, D3 p, double& far) {
  int near = 0;
  double least = 1e300;
  for (int i = 0; i < n; ++i) {
    const D3 arm = load(line + 3 * i) - p;
    if (dot(arm, arm) < least) least = dot(arm, arm), near = i;
  }
  D3 best = p;
  far = 1e300;
  for (int begin = near - 1; begin <= near; ++begin) {
    if (begin < 0 || begin > n - 2) continue;
    const D3 a = load(line + 3 * begin), b = load(line + 3 * begin + 3);
    double far2;
    const double share = along_edge(p, a, b, far2);
    if (sqrt(far2) < far) far = sqrt(far2), best = a + share * (b - a);
  }
  return best;
}

}  // namespace palpate
