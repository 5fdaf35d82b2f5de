// What moves goes on as it moved: masses, displacements and velocities after a cut.
#pragma once
#include "cutting/snap.h"
#include "core/rotation.h"
#include "cutting/split.h"

namespace palpate {

// Vertices get the displacement of where they were moved to, and those around keep momentum and angular
// momentum: a slow rotation of them all about their centre. `from` has where moved ones were at rest;
// `vert` the vertices of triangles that changed.
template <class S>
PALPATE void carry_motion(const S& m, const Moving& x, const Move* move, int nmove, const D3* from,
                          const Few& vert) {
  D3 spin = {0.0, 0.0, 0.0}, centre = spin;
  double total = 0.0;
  for (int i = 0; i < nmove; ++i) {
    const int v = move[i].vert;
    const D3 disp = load(x.disp + 3 * v), now = disp + move[i].share * move[i].lead;
    const D3 back = from[i] + disp - m.place(v) - now;
    if (vert.has(v)) spin += x.mass[v] * cross(back, load(x.vel + 3 * v));
    store(x.disp + 3 * v, now);
  }
  if (vert.count < 3) return;
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    centre += x.mass[v] * (m.place(v) + load(x.disp + 3 * v));
    total += x.mass[v];
  }
  centre = (1.0 / total) * centre;
  double inertia[3][3] = {};
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    const D3 arm = m.place(v) + load(x.disp + 3 * v) - centre;
    const double a[3] = {arm.x, arm.y, arm.z}, square = dot(arm, arm);
    for (int k = 0; k < 9; ++k)
      inertia[k / 3][k % 3] += x.mass[v] * ((k / 3 == k % 3 ? square : 0.0) - a[k / 3] * a[k % 3]);
  }
  if (spin == D3{0.0, 0.0, 0.0}) return;
  const D3 omega = rotation_of(inertia, spin);
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    const D3 arm = m.place(v) + load(x.disp + 3 * v) - centre;
    store(x.vel + 3 * v, load(x.vel + 3 * v) + cross(omega, arm));
  }
}

// Vertices that were one share its mass by area; `share` gets their parts of it.
template <class S>
PALPATE void share_masses(const S& m, const Moving& x, const Split& split, double* share) {
  const unsigned char* all = nullptr;
  for (int first = 0, last; first < split.count; first = last) {
    const int v = split.group[first];
    const double whole = x.mass[v];
    double area = 0.0;
    for (last = first; last < split.count && split.group[last] == v; ++last)
      area += share[last] = area_around(m, split.member[last], all);
    for (int i = first; i < last; ++i) {
      const int w = split.member[i];
      share[i] /= area;
      x.mass[w] = share[i] * whole;
      store(x.disp + 3 * w, load(x.disp + 3 * v));
      store(x.vel + 3 * w, load(x.vel + 3 * v));
    }
  }
}

}  // namespace palpate
