// Where on a path behind a blade the mesh comes apart next.
#pragma once
#include "cutting/surface.h"

namespace palpate {

// Finds where a path is to end: of places `step` apart, between `first` from its beginning and `last`
// from its end, the one that is nearest to a vertex, those farther on sooner. `found` gets how many
// points of the path come before it, -1 where it is too short, and how many places there are; if these
// are more than there is room for nothing else is written.
template <class Fields>
PALPATE void find_stop(const Fields& f, Thread t, int) {
  if (t.tid) return;
  using I = decltype(f.elem.data[0] + 0);
  const Surface<I> m = {f.nvert, 0, f.most, f.rest.data, f.elem.data, nullptr, nullptr, f.spoke.data,
                        f.degree.data, nullptr, nullptr};
  const int npoint = f.asked.data[0], nouter = f.asked.data[1];
  const auto point = [&](int i) { return load(f.point.data + 3 * i); };
  double total = 0.0;
  for (int i = 1; i < npoint; ++i) total += norm(point(i) - point(i - 1));
  const double places = ceil((total - f.last - f.first) / f.step);
  const int n = places > 0.0 ? (int)places : 0;
  f.found.data[0] = -1, f.found.data[1] = n;
  if (!n || n > f.nplace) return;
  int at = 0;  // the point before a place
  double arc = 0.0, size = norm(point(1) - point(0));
  for (int k = 0; k < n; ++k) {
    const double way = f.first + k * f.step;
    while (at < npoint - 2 && way > arc + size) {
      arc += size, ++at;
      size = norm(point(at + 1) - point(at));
    }
    const double share = size > 0.0 ? (way - arc) / size : 0.0;
    store(f.place.data + 3 * k, point(at) + share * (point(at + 1) - point(at)));
    f.before.data[k] = at + 1;
  }
  // Vertices of the triangles that the places are in.
  int count = 0;
  nearest_spots(m, f.rest.data, nouter, f.place.data, n, f.edge, f.box.data, [&](int, Spot s) {
    for (int c = 0; c < 3; ++c) f.vert.data[count++] = (int)m.elem[3 * s.elem + c];
  });
  double least = 1e300;
  for (int k = 0; k < n; ++k) {
    double far = 1e300;
    for (int i = 0; i < count; ++i) {
      const double d = norm(load(f.place.data + 3 * k) - m.place(f.vert.data[i]));
      far = d < far ? d : far;
    }
    far -= f.farther * (f.first + k * f.step);
    if (far < least) least = far, f.found.data[0] = f.before.data[k], store(f.end.data, load(f.place.data + 3 * k));
  }
}

}  // namespace palpate
