// A solid that is cut: tetrahedra whose faces are opened, and what is around its vertices.
//
// A corner has the number 4 t + k, of tetrahedron t; a face that of the corner opposite. Whole is what there
// was before the first cut. Tetrahedra keep their numbers, so that the corners around a vertex are some of
// those that were around the one that it comes from.
#pragma once
#include "core/tet.h"
#include "cutting/surface.h"

namespace palpate {

// The corner k, 0 to 2, of a face, counter-clockwise from outside.
PALPATE int corner_of(int face, int k) {
  constexpr int FACES[4][3] = {{1, 2, 3}, {0, 3, 2}, {0, 1, 3}, {0, 2, 1}};
  return face - face % 4 + FACES[face % 4][k];
}
// The corner k, 0 to 2, of the others of its tetrahedron, and the face opposite to it.
PALPATE int other_corner(int corner, int k) { return corner - corner % 4 + k + (k >= corner % 4); }

template <class I>
struct Solid {
  // Of moves, see `Surface`; share of its way down to which a vertex inside gives way to the skin's.
  static constexpr int CORNERS = 4, ROUNDS = 10;
  static constexpr double THIN = 0.15, KEPT = 0.9, RISE = 1.005, SHORTER = 0.7, GIVES = 0.1;

  int nvert, ntet, nelem, most_elem, most, nskin, nspare;  // triangles of the skin, and at most; `ring` is
                                                          // so wide
  double* rest;
  I *tet, *ring, *degree, *elem, *of_tet;
  const I *whole_tet, *whole_degree, *mate;
  const int *begin, *around;  // corners around each vertex of the whole
  int *seat, *triangle;  // a corner of each vertex, -1 for none; the triangle that a face is, -1 for none
  int room;  // neighbours that a spare vertex has room for

  PALPATE D3 place(int v) const { return load(rest + 3 * v); }
  PALPATE int vert(int corner) const { return (int)tet[corner]; }
  PALPATE int size() const { return ntet; }
  PALPATE int most_triangles() const { return most_elem; }
  PALPATE bool inside(int v) const { return v >= nskin; }
  PALPATE double quality(const D3* x) const { return quality_of(x); }
  PALPATE int face_vert(int face, int k) const { return (int)tet[corner_of(face, k)]; }
  PALPATE I* cells() const { return tet; }
  // The face that a triangle is.
  PALPATE int face_of(int triangle) const {
    const I* corner = of_tet + 3 * triangle;
    return (int)(corner[0] - corner[0] % 4 + 6 - corner[0] % 4 - corner[1] % 4 - corner[2] % 4);
  }
  // A face of the tetrahedron of a corner, 0 to 2, that has its vertex; the face beside one, -1 for none.
  PALPATE int facet(int corner, int k) const { return other_corner(corner, k); }
  PALPATE int beside(int face) const { return triangle[face] >= 0 ? -1 : (int)mate[face]; }
  // How many neighbours a vertex has room for.
  PALPATE int room_of(int v) const {
    return v < nskin && v >= nskin - nspare ? room : (int)whole_degree[v];
  }
  PALPATE void corners(int t, D3* x) const {
    for (int c = 0; c < 4; ++c) x[c] = place((int)tet[4 * t + c]);
  }
  // Calls body(corner) for the corners that a vertex has, ascending.
  template <class Body>
  PALPATE void each_corner(int v, int from, Body body) const {
    if (from < 0) return;
    const int origin = (int)whole_tet[from];
    for (int i = begin[origin]; i < begin[origin + 1]; ++i)
      if (tet[around[i]] == v) body(around[i]);
  }
  template <class Body>
  PALPATE void each_corner(int v, Body body) const { each_corner(v, seat[v], body); }
  // Calls body(triangle) for the triangles that have a vertex, some of them twice.
  template <class Body>
  PALPATE void each_triangle(int v, Body body) const {
    each_corner(v, [&](int corner) {
      for (int k = 0; k < 3; ++k) {
        const int t = triangle[other_corner(corner, k)];
        if (t >= 0) body(t);
      }
    });
  }
};

template <class F>
PALPATE auto solid_of(const F& f) {
  using I = decltype(f.tet.data[0] + 0);
  return Solid<I>{f.nvert, f.ntet, f.nelem, f.most_elem, f.most, f.nskin, f.nspare, f.rest.data, f.tet.data,
                  f.ring.data, f.degree.data, f.elem.data, f.of_tet.data, f.whole_tet.data,
                  f.whole_degree.data, f.mate.data, f.begin.data, f.around.data, f.seat.data,
                  f.triangle.data, f.most_spare};
}

// The neighbours of a vertex, ascending; returns how many; `seen` is as long as there are vertices.
template <class S>
PALPATE int find_ring(const S& m, int v, int from, int* ring, int* seen) {
  int count = 0;
  m.each_corner(v, from, [&](int corner) {
    for (int k = 0; k < 3; ++k) {
      const int other = m.vert(other_corner(corner, k));
      if (seen[other]) continue;
      seen[other] = 1;
      int at = count++;
      for (; at > 0 && ring[at - 1] > other; --at) ring[at] = ring[at - 1];
      ring[at] = other;
    }
  });
  for (int i = 0; i < count; ++i) seen[ring[i]] = 0;
  return count;
}

// Numbers by a key each, ascending; what has the same key stays in its order. `more` has room for as many.
PALPATE void sort_by(int* list, int n, const double* key, int* more) {
  for (int width = 1; width < n; width *= 2) {
    for (int low = 0; low < n; low += 2 * width) {
      const int mid = low + width < n ? low + width : n, high = low + 2 * width < n ? low + 2 * width : n;
      for (int i = low, a = low, b = mid; i < high; ++i) {
        const bool first = a < mid && (b >= high || key[list[a]] <= key[list[b]]);
        more[i] = first ? list[a++] : list[b++];
      }
    }
    for (int i = 0; i < n; ++i) list[i] = more[i];
  }
}

}  // namespace palpate
