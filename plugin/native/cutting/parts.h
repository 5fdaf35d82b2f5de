// What comes apart at marked facets: edges of a sheet, faces of a solid. A vertex becomes as many as there are
// parts of what is around it.
#pragma once
#include "cutting/surface.h"

namespace palpate {

// What is around vertices, in parts that hang together by facets that are not open: of each part its vertex,
// its first corner, how many corners it has, and how it is called then.
struct Parts {
  int *vert, *first, *size, *name, count;
  int *part;  // of a corner, from 1; 0 for those that are around none of the vertices
  int *corner, ncorner, *queue;

  PALPATE void clear() {
    for (int i = 0; i < ncorner; ++i) part[corner[i]] = 0;
    count = ncorner = 0;
  }
  // The end of the parts of a vertex that begin at one.
  PALPATE int end(int begin) const {
    int k = begin;
    while (k < count && vert[k] == vert[begin]) ++k;
    return k;
  }
};

PALPATE Parts parts_of(Scratch& memory, int ncorner) {
  Parts out = {};
  int** lists[] = {&out.vert, &out.first, &out.size, &out.name, &out.corner, &out.queue};
  for (int i = 0; i < 6; ++i) *lists[i] = memory.room(ncorner);
  out.part = memory.numbers(ncorner);
  return out;
}

// Adds the parts around a vertex, in the order of their first corners; `cut` marks facets that come apart.
template <class S>
PALPATE int find_parts(const S& m, int v, const int* cut, Parts& out) {
  constexpr int N = S::CORNERS;
  const int begin = out.ncorner, had = out.count;
  m.each_corner(v, [&](int corner) { out.corner[out.ncorner++] = corner; });
  for (int i = begin; i < out.ncorner; ++i) {
    if (out.part[out.corner[i]]) continue;
    int queued = 0;
    const int k = out.count++;
    out.vert[k] = v, out.first[k] = out.corner[i], out.size[k] = 0;
    out.queue[queued++] = out.corner[i];
    out.part[out.corner[i]] = k + 1;
    while (queued) {
      const int corner = out.queue[--queued];
      ++out.size[k];
      for (int j = 0; j < N - 1; ++j) {
        const int facet = m.facet(corner, j), mate = cut[facet] ? -1 : m.beside(facet);
        if (mate < 0) continue;
        for (int c = mate - mate % N, n = 0; n < N; ++c, ++n)
          if (m.vert(c) == v && !out.part[c]) out.part[c] = k + 1, out.queue[queued++] = c;
      }
    }
  }
  return out.count - had;
}

// Gives parts their numbers: the largest one of a vertex that keeps its own has it, others those that follow.
template <class Keeps>
PALPATE void name_parts(Parts& p, int& following, Keeps keeps) {
  for (int first = 0, last; first < p.count; first = last) {
    int kept = first;
    last = p.end(first);
    for (int k = first; k < last; ++k) kept = p.size[k] > p.size[kept] ? k : kept;
    const bool has = keeps(p.vert[first]);
    for (int k = first; k < last; ++k) p.name[k] = has && k == kept ? p.vert[k] : following++;
  }
}

// Lets the corners around have the names of their parts, or their old ones again.
template <class S>
PALPATE void rename(const S& m, const Parts& p, bool back) {
  for (int i = 0; i < p.ncorner; ++i) {
    const int k = p.part[p.corner[i]] - 1;
    m.cells()[p.corner[i]] = back ? p.vert[k] : p.name[k];
  }
}

// Calls body(first, last) for the parts of each vertex that does not stay as it was.
template <class Body>
PALPATE void each_divided(const Parts& p, Body body) {
  for (int first = 0, last; first < p.count; first = last) {
    last = p.end(first);
    if (last > first + 1 || p.name[first] != p.vert[first]) body(first, last);
  }
}

}  // namespace palpate
