// Faces of a solid are opened: a vertex becomes as many as there are parts of the tetrahedra around it. Those
// of the skin come first, those inside last; what comes on to the surface takes the numbers between, of
// spare vertices, and its old ones are used no more.
#pragma once
#include "cutting/parts.h"
#include "cutting/solid/solid_mesh.h"

namespace palpate {

constexpr double FEWER = 0.85;  // share of the faces that is tried where there is no room for all

// The faces that come apart, one of each pair, and what becomes of the vertices around them.
struct Opening {
  int *face, count;  // those that are left
  int *parting, nparting;  // of these, those that part something, in the same order
  int* cut;  // marks both of each pair of the latter
  Parts parts;
  Few vert, renew;  // corners of the faces; vertices on the skin that become spare ones, with more room
  int nouter, following;  // vertices on the surface, before and then
  int *ring, *seen;
  bool stopped;  // whether they are fewer for want of room
};

template <class S>
PALPATE void mark_faces(const S& m, Opening& o, const int* face, int count, int value) {
  for (int i = 0; i < count; ++i) o.cut[face[i]] = o.cut[m.mate[face[i]]] = value;
}

// Finds the parts around the vertices of the faces, and leaves out those faces that part nothing.
template <class S>
PALPATE void find_opening(const S& m, Opening& o) {
  o.parts.clear();
  o.vert.clear();
  mark_faces(m, o, o.face, o.count, 1);
  for (int i = 0; i < 3 * o.count; ++i) o.vert.put(m.face_vert(o.face[i / 3], i % 3));
  o.vert.sort(m.nvert);
  int* many = o.ring;  // of each vertex
  for (int i = 0; i < o.vert.count; ++i)
    many[i] = find_parts(m, o.vert.list[i], o.cut, o.parts);
  mark_faces(m, o, o.face, o.count, 0);
  o.nparting = 0;
  for (int i = 0; i < o.count; ++i) {
    bool idle = true;
    for (int k = 0; k < 3; ++k) idle = idle && many[o.vert.place[m.face_vert(o.face[i], k)] - 1] == 1;
    if (!idle) o.parting[o.nparting++] = o.face[i];
  }
  mark_faces(m, o, o.parting, o.nparting, 1);
  o.parts.clear();
  o.vert.clear();
  for (int i = 0; i < 3 * o.nparting; ++i) o.vert.put(m.face_vert(o.parting[i / 3], i % 3));
  o.vert.sort(m.nvert);
  for (int i = 0; i < o.vert.count; ++i)
    find_parts(m, o.vert.list[i], o.cut, o.parts);
  mark_faces(m, o, o.parting, o.nparting, 0);
}

// Calls body(corner) for the corners of tetrahedra that get other vertices.
template <class Body>
PALPATE void each_apart(const Parts& p, Body body) {
  for (int i = 0; i < p.ncorner; ++i) {
    const int k = p.part[p.corner[i]] - 1;
    for (int n = 0; n < 4 && p.name[k] != p.vert[k]; ++n) body(p.corner[i] / 4 * 4 + n);
  }
}

// Puts into `tight` the vertices that would have no room for their neighbours, as they are called now.
template <class S>
PALPATE void find_tight(const S& m, Opening& o, Few& near, Few& tight) {
  near.clear();
  tight.clear();
  rename(m, o.parts, false);
  each_apart(o.parts, [&](int corner) {
    const int v = m.vert(corner), k = o.parts.part[corner] - 1;
    if (!near.put(v)) return;
    if (find_ring(m, v, corner, o.ring, o.seen) > m.room_of(v)) tight.put(k < 0 ? v : o.parts.vert[k]);
  });
  rename(m, o.parts, true);
}

// Leaves as many faces, from where the path begins, as there is room for; returns whether there are any.
template <class S>
PALPATE bool fit(const S& m, Opening& o, int ntriangle, Scratch& memory) {
  Few near = few(memory, m.nvert), tight = few(memory, m.nvert);
  if (memory.full) return false;
  o.stopped = false;
  for (;;) {
    bool named = false;
    o.renew.clear();
    find_opening(m, o);
    for (bool again = true; again;) {
      again = false, o.following = o.nouter;
      name_parts(o.parts, o.following, [&](int v) { return v < m.nskin && !o.renew.has(v); });
      named = o.following <= m.nskin;
      if (!named) break;
      find_tight(m, o, near, tight);
      for (int i = 0; i < tight.count; ++i)
        if (tight.list[i] < m.nskin - m.nspare) again = o.renew.put(tight.list[i]) || again;
    }
    if (named && tight.count) {  // around these it hangs together
      int left = 0;
      for (int i = 0; i < o.count; ++i) {
        bool beside = false;
        for (int k = 0; k < 3; ++k) beside = beside || tight.has(m.face_vert(o.face[i], k));
        if (!beside) o.face[left++] = o.face[i];
      }
      o.count = left < o.count ? left : 0;
      continue;
    }
    if (named && ntriangle + 2 * o.nparting <= m.most_elem) return true;
    if (!o.count) return false;
    o.count = (int)(FEWER * o.count), o.stopped = true;
  }
}

// Opens the faces: vertices get their numbers, the new ones the place of the old, faces their triangles. The faces of
// a pair are in ascending order in every other cut, in descending order in the others: so cuts can be told apart.
template <class S>
PALPATE void open_faces(const S& m, Opening& o, int ntriangle, Few& near) {
  const Parts& p = o.parts;
  near.clear();
  each_apart(p, [&](int corner) { near.put(m.vert(corner)); });
  rename(m, p, false);
  each_apart(p, [&](int corner) { near.put(m.vert(corner)); });
  for (int k = 0; k < p.count; ++k) {
    const int v = p.vert[k], w = p.name[k];
    if (w != v) store(m.rest + 3 * w, m.place(v));
    if (k == 0 || p.vert[k - 1] != v) m.seat[v] = -1;
  }
  for (int k = 0; k < p.count; ++k) m.seat[p.name[k]] = p.first[k];
  const bool descends = ntriangle > m.nelem && m.face_of(ntriangle - 2) < m.face_of(ntriangle - 1);
  for (int i = 0; i < o.nparting; ++i)
    for (int side = 0; side < 2; ++side) {
      const int one = o.parting[i], two = (int)m.mate[one], t = ntriangle + 2 * i + side;
      const int face = (one < two) == (side == descends) ? one : two;
      for (int k = 0; k < 3; ++k) m.of_tet[3 * t + k] = corner_of(face, k);
      m.triangle[face] = t;
    }
  for (int i = 0; i < 3 * (ntriangle + 2 * o.nparting); ++i) m.elem[i] = m.tet[m.of_tet[i]];
  for (int i = 0; i < near.count; ++i) {
    const int v = near.list[i], n = find_ring(m, v, m.seat[v], o.ring, o.seen);
    m.degree[v] = n;
    for (int k = 0; k < m.most; ++k) m.ring[m.most * v + k] = k < n ? o.ring[k] : -1;
  }
}

}  // namespace palpate
