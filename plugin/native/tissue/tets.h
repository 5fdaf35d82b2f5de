// What the inside of a solid has in `Shape` and `Tissue`: rows of nodes, tetrahedra and edges of these. Each
// is a function of the mesh alone, and so are its bits; but an edge that a cut has divided takes places that
// wait, whichever are free.
//
// Tetrahedra are in the order of the arrays, six pairs of corners each.
#pragma once
#include "tissue/rows.h"
#include "core/tet.h"

namespace palpate {

// The vertices of a solid, each with those that edges lead to.
template <class I>
struct Star {
  int most;
  const double* rest_of;
  const I *ring, *degree;

  PALPATE D3 place(int v) const { return load(rest_of + 3 * v); }
  PALPATE int neighbour(int v, int k) const { return (int)ring[most * v + k]; }
  PALPATE int half(int, int) const { return -1; }
  PALPATE int entry(int v, int other) const {
    int k = 0;
    while (neighbour(v, k) != other) ++k;
    return k;
  }
};

// The number of a corner; a slice of tetrahedra has eight times four.
PALPATE int number_of(int tet, int corner) { return tet / LANES * 4 * LANES + corner * LANES + tet % LANES; }

template <class F, class S>
PALPATE double measure_tet(const F& f, const S& m, int t, D3* g) {
  D3 x[4];
  for (int c = 0; c < 4; ++c) x[c] = m.place(f.tet.data[4 * t + c]);
  return slopes_of(x, g);
}

template <class F, class S>
PALPATE void put_tet(const F& f, const S& m, int t) {
  D3 g[4];
  const double volume = measure_tet(f, m, t, g), has[3] = {volume, f.mu.data[t], f.lam.data[t]};
  const int s = t / LANES, lane = t % LANES;
  for (int c = 0; c < 4; ++c) {
    f.tet_node.data[4 * LANES * s + c * LANES + lane] = offset_in(f.node.data[f.tet.data[4 * t + c]], 3);
    if (c) store_lane(f.tet_gradient.data + 9 * LANES * s + 3 * (c - 1) * LANES + lane, g[c]);
  }
  for (int c = 0; c < 3; ++c) f.tet_moduli.data[3 * LANES * s + c * LANES + lane] = (float)has[c];
}

// The stiffness of a corner of the stiffest tetrahedron.
template <class F, class S>
PALPATE double stiffest(const F& f, const S& m) {
  double out = 0.0;
  for (int i = 0; i < f.nchanged; ++i) f.steep.data[f.changed.data[i]] = 0.0;
  for (int t = 0; t < f.ntet; ++t) {
    double& steep = f.steep.data[t];
    D3 g[4];
    if (steep == 0.0) {  // it has changed, or was never asked for
      const double volume = measure_tet(f, m, t, g);
      for (int c = 0; c < 4; ++c) steep = dot(g[c], g[c]) > steep ? dot(g[c], g[c]) : steep;
      steep *= volume;
    }
    const double stiff = steep * (f.mu.data[t] + f.lam.data[t]);
    out = stiff > out ? stiff : out;
  }
  return out;
}

// The tetrahedra around a vertex and the means over these; `origin` is what it was before the first cut.
template <class F, class S>
PALPATE void put_means(const F& f, const S& m, int v, int origin, D3* sum) {
  const int own = f.node.data[v], s = own / LANES, lane = own % LANES, degree = (int)m.degree[v];
  int row = f.around_adr.data[s];
  double total = 0.0, mu = 0.0, lam = 0.0;
  for (int k = 0; k < degree; ++k) sum[k] = {0.0, 0.0, 0.0};
  for (int i = f.begin.data[origin]; i < f.begin.data[origin + 1]; ++i) {
    const int corner = f.around.data[i], t = corner / 4;
    if (f.tet.data[corner] != v) continue;
    f.around_corner.data[LANES * row++ + lane] = number_of(t, corner % 4);
    D3 g[4];
    const double quarter = measure_tet(f, m, t, g) / 4.0;
    total += quarter, mu += quarter * (1.0 - f.own) * f.mu.data[t], lam += quarter * f.lam.data[t];
    for (int c = 0; c < 4; ++c)
      if (c != corner % 4) sum[m.entry(v, f.tet.data[4 * t + c])] += quarter * g[c];
  }
  while (row < f.around_adr.data[s + 1]) f.around_corner.data[LANES * row++ + lane] = number_of(f.ntet, 0);
  const double part = 1.0 / (total > 1e-300 ? total : 1e-300);
  f.node_moduli.data[2 * LANES * s + lane] = (float)(mu * part);
  f.node_moduli.data[2 * LANES * s + LANES + lane] = (float)(lam * part);
  for (int k = 0; k < f.slot_adr.data[s + 1] - f.slot_adr.data[s]; ++k) {
    const int at = f.slot_adr.data[s] + k;
    store_lane(f.fan_slope.data + 3 * LANES * at + lane, k < degree ? part * sum[k] : D3{0.0, 0.0, 0.0});
  }
}

// No block of a node is left of former neighbours.
template <class F>
PALPATE void clear_blocks(const F& f, int v) {
  const int own = f.node.data[v], s = own / LANES, lane = own % LANES;
  for (int k = 9 * f.slot_adr.data[s]; k < 9 * f.slot_adr.data[s + 1]; ++k) f.half.data[LANES * k + lane] = 0;
}

// The vertices that the ends of an edge are now, each pair once, ascending; returns how many pairs.
template <class F>
PALPATE int ends_of(const F& f, int edge, int* a, int* b) {
  int count = 0;
  for (int i = f.edge_begin.data[edge]; i < f.edge_begin.data[edge + 1]; ++i) {
    const int pair = f.edge_pair.data[i], t = 4 * (pair / 6);
    const int one = f.tet.data[t + f.first.data[pair]], two = f.tet.data[t + f.last.data[pair]];
    int at = 0;
    while (at < count && (a[at] < one || (a[at] == one && b[at] < two))) ++at;
    if (at < count && a[at] == one && b[at] == two) continue;
    for (int k = count++; k > at; --k) a[k] = a[k - 1], b[k] = b[k - 1];
    a[at] = one, b[at] = two;
  }
  return count;
}

template <class F>
PALPATE void clear_edge(const F& f, int place) {
  const int s = place / LANES, lane = place % LANES;
  for (int k = f.edge_adr.data[s]; k < f.edge_adr.data[s + 1]; ++k)
    f.edge_from.data[LANES * k + lane] = f.edge_to.data[LANES * k + lane] = number_of(f.ntet, 0);
  f.edge_slot.data[2 * LANES * s + lane] = f.edge_slot.data[2 * LANES * s + LANES + lane] = -1;
}

// The tetrahedra around an edge between two vertices, of those around what it was before the first cut.
template <class F, class S>
PALPATE void put_edge(const F& f, const S& m, int edge, int a, int b, int place) {
  const int s = place / LANES, lane = place % LANES, ends[2] = {a, b};
  int row = f.edge_adr.data[s];
  clear_edge(f, place);
  for (int i = f.edge_begin.data[edge]; i < f.edge_begin.data[edge + 1]; ++i) {
    const int pair = f.edge_pair.data[i], t = pair / 6, first = f.first.data[pair], last = f.last.data[pair];
    if (f.tet.data[4 * t + first] != a || f.tet.data[4 * t + last] != b) continue;
    f.edge_from.data[LANES * row + lane] = number_of(t, first);
    f.edge_to.data[LANES * row++ + lane] = number_of(t, last);
  }
  for (int k = 0; k < 2; ++k) {
    const int own = f.node.data[ends[k]], at = f.slot_adr.data[own / LANES] + m.entry(ends[k], ends[1 - k]);
    f.edge_slot.data[2 * LANES * s + k * LANES + lane] = 9 * LANES * at + own % LANES;
    f.edge_node.data[2 * LANES * s + k * LANES + lane] = own;
  }
}

// The edge that has a place that waits, -1 for none: from the corners of the first tetrahedron there.
template <class F>
PALPATE int owner_of(const F& f, int place) {
  const int s = place / LANES, lane = place % LANES, row = LANES * f.edge_adr.data[s] + lane;
  if (f.edge_slot.data[2 * LANES * s + lane] < 0) return -1;
  const int from = f.edge_from.data[row], to = f.edge_to.data[row];
  const int t = from / (4 * LANES) * LANES + from % LANES;
  for (int pair = 6 * t; pair < 6 * t + 6; ++pair)
    if (number_of(t, f.first.data[pair]) == from && number_of(t, f.last.data[pair]) == to) return f.which.data[pair];
  return -1;
}

// Writes edges: what each has become beside itself goes to places that wait. Returns whether there were
// enough of these; nothing was written otherwise.
template <class F, class S>
PALPATE bool put_edges(const F& f, const S& m, const Few& edges, int* a, int* b) {
  const int first = f.nplace - f.nwait;
  const auto may_take = [&](int place) {
    const int owner = owner_of(f, place);
    return owner < 0 || edges.has(owner);
  };
  int wanted = 0, has = 0;
  for (int i = 0; i < edges.count; ++i) wanted += ends_of(f, edges.list[i], a, b) - 1;
  for (int i = first; i < f.nplace; ++i) has += may_take(i);
  if (wanted > has) return false;
  for (int i = first; i < f.nplace; ++i)
    if (may_take(i)) clear_edge(f, i);
  for (int i = 0, free = first; i < edges.count; ++i) {
    const int edge = edges.list[i], n = ends_of(f, edge, a, b);
    put_edge(f, m, edge, a[0], b[0], f.place.data[edge]);
    for (int k = 1; k < n; ++k) {
      while (owner_of(f, free) >= 0) ++free;
      put_edge(f, m, edge, a[k], b[k], free);
    }
  }
  return true;
}

// The areas of vertices that the foundation holds.
template <class F, class S>
PALPATE void put_areas(const F& f, const S& m, double* area) {
  for (int v = 0; v < f.nskin; ++v) area[v] = 0.0;
  for (int t = 0; t < f.nelem; ++t) {
    const auto* vert = f.elem.data + 3 * t;
    if (f.loose.data[t]) continue;
    const D3 a = m.place((int)vert[0]), b = m.place((int)vert[1]), c = m.place((int)vert[2]);
    const double third = norm(0.5 * cross(b - a, c - a)) / 3.0;
    for (int k = 0; k < 3; ++k) area[vert[k]] += third;
  }
  for (int v = 0; v < f.nskin; ++v) f.area.data[f.node.data[v]] = (float)area[v];
}

// Writes what has a tetrahedron among those that changed; returns whether there was room for the edges.
template <class F, class S>
PALPATE bool write_solid(const F& f, const S& m, Scratch& memory) {
  Few touched = few(memory, f.nvert), ends = few(memory, f.nvert), edges = few(memory, f.nedge);
  int *origin = memory.numbers(f.nvert), *a = memory.numbers(f.most_around), *b = memory.numbers(f.most_around);
  double* area = memory.values(f.nvert);
  D3* sum = (D3*)memory.values(3 * f.most);
  for (int i = 0; i < 4 * f.nchanged; ++i) {
    const int corner = 4 * f.changed.data[i / 4] + i % 4, was = f.before.data[i], is = f.tet.data[corner];
    touched.put(was), touched.put(is);
    origin[was] = origin[is] = f.whole_tet.data[corner];
    if (was == is) continue;
    // Where a vertex has another number, the blocks of all that are beside it lie elsewhere.
    for (int c = corner - i % 4; c < corner - i % 4 + 4; ++c) ends.put(f.tet.data[c]);
    for (int c = i - i % 4; c < i - i % 4 + 4; ++c) ends.put(f.before.data[c]);
  }
  for (int t = 0; t < f.ntet; ++t) {
    bool near = f.every != 0;
    for (int c = 0; c < 4; ++c) near = near || ends.has(f.tet.data[4 * t + c]);
    for (int k = 6 * t; k < 6 * t + 6 && near; ++k) edges.put(f.which.data[k]);
  }
  edges.sort(f.nedge);
  if (!put_edges(f, m, edges, a, b)) return false;
  for (int i = 0; i < f.nchanged; ++i) put_tet(f, m, f.changed.data[i]);
  f.stiffness.data[0] = (float)stiffest(f, m);
  for (int i = 0; i < touched.count; ++i) {
    const int v = touched.list[i];
    put_means(f, m, v, origin[v], sum);
    if (f.every) continue;
    put_neighbours(f, m, v);
    if (f.clears) clear_blocks(f, v);
  }
  if (!f.every) put_areas(f, m, area);
  return true;
}

// The same with the arrays that are written to some words on.
template <class F>
PALPATE F skipped_solid(F f) {
  const auto n = f.skip;
  f.fan_node.data += n, f.fan_rest.data += n, f.fan_width.data += n, f.degree.data += n;
  f.rest.data += n, f.free.data += n, f.area.data += n, f.tet_node.data += n, f.tet_gradient.data += n;
  f.around_corner.data += n, f.fan_slope.data += n, f.edge_from.data += n, f.edge_to.data += n;
  f.edge_node.data += n, f.edge_slot.data += n;
  f.tet_moduli.data += n, f.node_moduli.data += n, f.stiffness.data += n;
  return f;
}

template <class Fields>
PALPATE void fill_solid(const Fields& fields, Thread t, int) {
  if (t.tid) return;
  const Fields f = skipped_solid(fields);
  using I = decltype(f.ring.data[0] + 0);
  const Star<I> m = {f.most, f.mesh_rest.data, f.ring.data, f.mesh_degree.data};
  Scratch memory = {f.ints.data, f.reals.data, f.nint, f.nreal, false};
  f.found.data[0] = write_solid(f, m, memory);
}

}  // namespace palpate
