// What windows' slots have of a mesh: where its vertices are at rest, and its triangles.
#pragma once
#include "core/d3.h"

namespace palpate {

// Writes what slots have of some vertices, where the mesh has changed. Triangles keep their numbers;
// those with one first corner are listed by these.
template <class Fields>
PALPATE void reshape_slots(const Fields& f, Thread, int) {
  const int most = f.most, n = f.nchanged;
  for (int k = 0; k < n; ++k) {
    const long long v = f.vert.data[k];
    const D3 own = load(f.mesh_rest.data + 3 * v);
    double longest = 0.0;  // square of an edge
    for (int j = 0; j < most; ++j) {
      const long long to = f.ring.data[v * most + j];
      if (to < 0) continue;
      const D3 arm = load(f.mesh_rest.data + 3 * to) - own;
      longest = dot(arm, arm) > longest ? dot(arm, arm) : longest;
    }
    store(f.rest.data + 3 * v, own);
    f.touch.data[v] = sqrt(longest) + f.radius;
    f.node_mass.data[v] = f.free.data[v] ? f.mass.data[v] : f.wall;
    f.begin.data[v] = -1;
    f.near.data[v] = 1;
  }
  for (int t = f.nelem - 1; t >= 0; --t) {
    const auto* corner = f.mesh_elem.data + 3 * t;
    const bool first = f.near.data[corner[0]];
    if (!first && !f.near.data[corner[1]] && !f.near.data[corner[2]]) continue;
    for (int k = 0; k < 3; ++k) f.elem.data[3 * t + k] = (int)corner[k];
    if (!first) continue;
    f.following.data[t] = f.begin.data[corner[0]];
    f.begin.data[corner[0]] = t;
  }
  for (int k = 0; k < n; ++k) f.near.data[f.vert.data[k]] = 0;
}

}  // namespace palpate
