// A path on a surface, as dense samples in the rest shape, in parts without gaps.
#pragma once
#include "cutting/surface.h"

namespace palpate {

// In edges of the mesh: between samples (as in `path.py`); from an older cut within which a path goes along it;
// between samples that are on both sides of a gap.
constexpr double SAMPLE = 0.25, ALONG = 0.2, JUMP = 2.0;

// Why nothing was cut.
enum { DONE, NO_ROOM, TOO_SHORT, PINNED };

// Samples first .. last - 1 of a path; `open` where they lie along an older cut: nothing to cut there.
struct Run { int first, last, open; };

struct Path {
  double edge;  // mean length of the edges
  const double* at;  // samples at rest
  const int* elem;  // triangles that they are in
  int count;
  Run* run;
  int nrun;
};

// Whether a place in a triangle lies along one of its edges that came apart before.
template <class S>
PALPATE bool along_cut(const S& m, int t, D3 at, double edge) {
  for (int h = 3 * t; h < 3 * t + 3; ++h) {
    double far2;
    if (m.twin[h] >= 0 || m.whole_twin[h] < 0) continue;
    along_edge(at, m.place(m.from(h)), m.place(m.to(h)), far2);
    if (far2 < ALONG * edge * (ALONG * edge)) return true;
  }
  return false;
}

template <class I>
PALPATE bool share_corner(const I* elem, int a, int b) {
  for (int i = 0; i < 9; ++i)
    if (elem[3 * a + i / 3] == elem[3 * b + i % 3]) return true;
  return false;
}

// Whether two triangles were neighbours before the first cut, and are no more.
template <class S>
PALPATE bool came_apart(const S& m, int a, int b) {
  return a != b && share_corner(m.whole_elem, a, b) && !share_corner(m.elem, a, b);
}

// Finds which samples go along an older cut, more than across it.
template <class S>
PALPATE void find_open(const S& m, const Path& path, int* open) {
  for (int i = 0; i < path.count; ++i)
    open[i] = along_cut(m, path.elem[i], load(path.at + 3 * i), path.edge);
  for (int first = 0, last; first < path.count; first = last) {
    for (last = first; last < path.count && open[last] == open[first]; ++last) {}
    if ((last - first) * SAMPLE < 1.0)
      for (int i = first; i < last; ++i) open[i] = 0;
  }
}

// Finds the parts of a path: where it crosses an older cut, or leaps, it begins anew.
template <class S>
PALPATE bool find_runs(const S& m, Path& path, Scratch& memory) {
  const int n = path.count;
  int* open = memory.numbers(n);
  path.run = (Run*)memory.numbers(3 * n);
  if (memory.full) return false;
  find_open(m, path, open);
  for (int first = 0, i = 1; i <= n; ++i) {
    const bool ends = i == n || norm(load(path.at + 3 * i) - load(path.at + 3 * i - 3)) > JUMP * path.edge ||
      (came_apart(m, path.elem[i - 1], path.elem[i]) && !open[i]) || open[i] != open[i - 1];
    if (!ends) continue;
    if (i - first > 1) path.run[path.nrun++] = {first, i, open[first]};
    first = i;
  }
  return true;
}

}  // namespace palpate
