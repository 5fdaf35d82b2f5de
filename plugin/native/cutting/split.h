// The mesh comes apart along edges: vertices on them are doubled. Triangles keep their numbers.
#pragma once
#include "cutting/chain.h"
#include "cutting/parts.h"

namespace palpate {

// The edges that come apart, both of their half-edges marked.
struct Seam {
  int *pair, count;  // their vertices, two each
  int* cut;  // of a half-edge
};

// Marks the first edges of a seam, or clears the marks.
template <class S>
PALPATE void mark(const S& m, Seam& seam, int count, int value) {
  for (int i = 0; i < count; ++i) {
    const int h = m.half_to(seam.pair[2 * i], seam.pair[2 * i + 1]);
    seam.cut[h] = seam.cut[m.twin[h]] = value;
  }
}

// Takes of the edges as many, from the first one, as there are spare vertices for, none where none would
// come apart; returns whether they are fewer for want of these.
template <class S>
PALPATE bool find_room(const S& m, Seam& seam, int left, Few& vert, Parts& parts) {
  bool fewer = false;
  while (seam.count) {
    mark(m, seam, seam.count, 1);
    vert.clear(), parts.clear();
    int need = 0;
    for (int i = 0; i < 2 * seam.count; ++i)
      if (vert.put(seam.pair[i])) need += find_parts(m, seam.pair[i], seam.cut, parts) - 1;
    if (need && need <= left) return fewer;
    mark(m, seam, seam.count, 0);
    const int over = need - left;
    if (need) seam.count -= over < seam.count ? over : seam.count, fewer = true;
    else seam.count = 0;  // it was cut already
  }
  vert.clear(), parts.clear();
  return fewer;
}

// The vertices that were one: `group` has the first, `member` each of them.
struct Split { int *group, *member, count, following; };

template <class S>
PALPATE void double_vertices(const S& m, Parts& parts, Split& out) {
  name_parts(parts, out.following, [](int) { return true; });
  rename(m, parts, false);
  each_divided(parts, [&](int first, int last) {
    for (int k = first; k < last; ++k)
      out.group[out.count] = parts.vert[k], out.member[out.count++] = parts.name[k];
  });
}

// Walks around a vertex by its spokes, of which `row` has those that it or what it came from had.
template <class S>
PALPATE void walk(const S& m, int v, const int* row, int n) {
  int first = -1;
  bool open = false;
  for (int k = 0; k < n; ++k) {
    const int h = row[k];
    if (h < 0 || m.elem[h] != v || open) continue;
    open = m.twin[h] < 0;
    if (open || first < 0 || h < first) first = h;
  }
  auto* ring = m.ring + m.most * v;
  auto* spoke = m.spoke + m.most * v;
  int degree = 0;
  for (int h = first; h >= 0;) {
    ring[degree] = m.to(h), spoke[degree++] = h;
    const int last = last_half(h), next = (int)m.twin[last];
    if (next < 0) ring[degree] = m.from(last), spoke[degree++] = -1;
    h = next == first ? -1 : next;
  }
  m.degree[v] = degree;
  for (int k = degree; k < m.most; ++k) ring[k] = spoke[k] = -1;
}

// Gives triangles the twins that they have now, and vertices their rings.
//
// Args: the triangles around all that moved or came apart, ascending, with the corners that they had;
// which of these were moved; the split; lists. Leaves in `elem` the triangles that are not as they were, and
// in `before` their corners.
template <class S>
PALPATE void rejoin(const S& m, Few& elem, int* before, const Few& moved, const Split& split,
                    Few& vert, int* row, int* source) {
  int count = 0;
  vert.clear();
  for (int i = 0; i < split.count; ++i) source[split.member[i]] = split.group[i] + 1;
  for (int i = 0; i < elem.count; ++i) {
    const int t = elem.list[i];
    bool cut = false, goes = false;
    for (int c = 0; c < 3; ++c) {
      const int h = 3 * t + c, other = (int)m.whole_twin[h];
      const bool joined = other >= 0 && m.from(h) == m.to(other) && m.to(h) == m.from(other);
      cut = cut || before[3 * i + c] != m.elem[h] || m.twin[h] != (joined ? other : -1);
      m.twin[h] = joined ? other : -1;
      goes = goes || moved.has(before[3 * i + c]);
    }
    for (int c = 0; c < 3 && cut; ++c) vert.put(before[3 * i + c]), vert.put((int)m.elem[3 * t + c]);
    elem.place[t] = 0;
    if (!cut && !goes) continue;
    for (int c = 0; c < 3; ++c) before[3 * count + c] = before[3 * i + c];
    elem.list[count++] = t;
  }
  elem.count = count;
  // New vertices first: what they come from has its old row until then.
  for (int old = 0; old < 2; ++old)
    for (int i = 0; i < vert.count; ++i) {
      const int v = vert.list[i], from = source[v] ? source[v] - 1 : v;
      if ((from == v) != (old == 1)) continue;
      const int n = (int)m.degree[from];
      for (int k = 0; k < n; ++k) row[k] = m.half(from, k);
      walk(m, v, row, n);
    }
}

}  // namespace palpate
