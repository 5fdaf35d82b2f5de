// The chain of edges near a path along which the mesh may come apart.
#pragma once
#include "cutting/path.h"

namespace palpate {

// In edges: between vertices that the chain must pass; from a boundary from which a cut opens it; of the
// band around the path in which it lies.
constexpr double WAY = 8.0, RIM = 0.5, BAND = 1.5, CLOSED = 3.0;

// Vertices around a run, ascending, and how far each is from it.
struct Band { Few vert; double* far; };

template <class S>
PALPATE void find_band(const S& m, const Path& path, const Run& run, Band& band) {
  Few& v = band.vert;
  v.clear();
  for (int i = run.first; i < run.last; ++i)
    for (int c = 0; c < 3; ++c) v.put((int)m.elem[3 * path.elem[i] + c]);
  for (int i = 0, n = v.count; i < n; ++i)
    for (int k = 0; k < m.degree[v.list[i]]; ++k) v.put(m.neighbour(v.list[i], k));
  v.sort(m.nvert);
  int count = 0;
  for (int i = 0; i < v.count; ++i) {
    const int vert = v.list[i];
    double far;
    place_on(path.at + 3 * run.first, run.last - run.first, m.place(vert), far);
    v.place[vert] = 0;
    if (!(far < BAND * path.edge)) continue;
    v.list[count] = vert, band.far[count] = far;
    v.place[vert] = ++count;
  }
  v.count = count;
}

// The vertex of a band nearest to a sample; of a boundary alone, not `other`, where `rim` says so.
template <class S>
PALPATE int nearest_in(const S& m, const Band& band, D3 at, bool rim, int other, double& least) {
  int best = 0;
  least = 1e300;
  for (int i = 0; i < band.vert.count; ++i) {
    if (rim && (i == other || !m.on_rim(band.vert.list[i]))) continue;
    const double far = norm(at - m.place(band.vert.list[i]));
    if (far < least) least = far, best = i;
  }
  return best;
}

// Finds numbers of vertices of the band that the chain passes, its ends among them; returns how many.
template <class S>
PALPATE int find_ways(const S& m, const Path& path, const Run& run, const Band& band, int* way) {
  const double* at = path.at + 3 * run.first;
  const int n = run.last - run.first;
  double total = 0.0, least;
  for (int i = 1; i < n; ++i) total += norm(load(at + 3 * i) - load(at + 3 * i - 3));
  int parts = (int)rint(total / (WAY * path.edge));
  const double gap = norm(load(at + 3 * (n - 1)) - load(at));
  const bool closes = total > CLOSED * path.edge && gap < SAMPLE * path.edge;
  const int fewest = closes ? 3 : 1;
  parts = parts < fewest ? fewest : parts;
  double along = 0.0;
  for (int p = 0, i = 0; p <= parts; ++p) {
    const double goal = p == parts ? total : p * (total / parts);
    for (; i < n - 1 && along < goal; ++i) along += norm(load(at + 3 * i + 3) - load(at + 3 * i));
    way[p] = nearest_in(m, band, load(at + 3 * i), false, -1, least);
  }
  if (closes) return way[parts] = way[0], parts + 1;
  for (int end = 0; end < 2; ++end) {
    const int own = end ? parts : 0, near = nearest_in(m, band, load(at + 3 * (end ? n - 1 : 0)), true,
                                                       way[parts - own], least);
    if (least < RIM * path.edge) way[own] = near;
  }
  return parts + 1;
}

// What finding the shortest way takes, a number for each vertex of the band.
struct Search { double* cost; int *before, *front; };

// Finds the way between two vertices of a band along which it costs least to cut (Dijkstra 1959); a
// vertex's `before` is the one that it is reached from, -1 for none.
template <class S>
PALPATE void find_way(const S& m, double edge, const Band& band, int begin, int end, Search& search) {
  const Few& v = band.vert;
  for (int i = 0; i < v.count; ++i) search.cost[i] = 1e300, search.before[i] = -1;
  search.cost[begin] = 0.0;
  int front = 0;
  search.front[front++] = begin;
  while (front) {
    int best = 0;
    for (int i = 1; i < front; ++i)
      if (search.cost[search.front[i]] < search.cost[search.front[best]]) best = i;
    const int a = search.front[best], vert = v.list[a];
    search.front[best] = search.front[--front];
    if (a == end) return;
    for (int k = 0; k < m.degree[vert]; ++k) {
      const int other = m.neighbour(vert, k), b = v.place[other] - 1;
      if (b < 0) continue;
      const double fa = band.far[a], fb = band.far[b], size = norm(m.place(vert) - m.place(other));
      const double cost = search.cost[a] + size * (0.05 + (fa * fa + fb * fb) / (edge * edge));
      if (!(cost < search.cost[b])) continue;
      if (search.cost[b] == 1e300) search.front[front++] = b;
      search.cost[b] = cost, search.before[b] = a;
    }
  }
}

// Appends a vertex to a chain, without spikes and repeats.
PALPATE void extend(int* chain, int& count, int vert) {
  if (count && chain[count - 1] == vert) return;
  if (count > 1 && chain[count - 2] == vert) --count;
  else chain[count++] = vert;
}

// Finds the chain of vertices near a run, each a neighbour of the one before; returns how many, -1 where
// they are more than `most`.
template <class S>
PALPATE int find_chain(const S& m, const Path& path, const Run& run, Band& band, Search& search,
                       int* way, int* chain, int most) {
  find_band(m, path, run, band);
  if (band.vert.count < 2) return 0;
  const int nway = find_ways(m, path, run, band, way);
  int count = 0;
  extend(chain, count, band.vert.list[way[0]]);
  for (int i = 0; i + 1 < nway; ++i) {
    find_way(m, path.edge, band, way[i], way[i + 1], search);
    int length = 0;
    for (int k = way[i + 1]; k >= 0 && k != way[i]; k = search.before[k]) search.front[length++] = k;
    const bool reached = length == 0 || search.before[search.front[length - 1]] == way[i];
    if (!reached) continue;
    if (count + length > most) return -1;
    while (length) extend(chain, count, band.vert.list[search.front[--length]]);
  }
  return count;
}

}  // namespace palpate
