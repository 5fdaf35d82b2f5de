// What moves goes on as it moved: masses, displacements and velocities after a cut.
#pragma once
#include "core/rotation.h"
#include "cutting/moves.h"

namespace palpate {

// What vertices have together: mass, centre, momentum, angular momentum about the origin, energy, and moments of
// inertia about the centre.
struct Sums { double mass, energy, inertia[3][3]; D3 centre, momentum, spin; };

template <class S, class L>
PALPATE Sums sums_of(const S& m, const Moving& x, const Few& vert, const L* pinned) {
  Sums out = {};
  const auto place = [&](int v) { return m.place(v) + load(x.disp + 3 * v); };
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    if (pinned[v]) continue;
    const D3 vel = load(x.vel + 3 * v), p = x.mass[v] * vel;
    out.mass += x.mass[v], out.energy += 0.5 * dot(p, vel);
    out.centre += x.mass[v] * place(v), out.momentum += p, out.spin += cross(place(v), p);
  }
  out.centre = (1.0 / out.mass) * out.centre;
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    if (pinned[v]) continue;
    const D3 arm = place(v) - out.centre;
    const double a[3] = {arm.x, arm.y, arm.z}, square = dot(arm, arm);
    for (int k = 0; k < 9; ++k)
      out.inertia[k / 3][k % 3] += x.mass[v] * ((k / 3 == k % 3 ? square : 0.0) - a[k / 3] * a[k % 3]);
  }
  return out;
}

// Vertices get the displacement of where they were moved to, and those around keep momentum and angular
// momentum: a slow rotation of them all about their centre. `from` has where moved ones were at rest;
// `vert` the vertices of triangles that changed, none of which is pinned.
template <class S, class L>
PALPATE void carry_motion(const S& m, const Moving& x, const Move* move, int nmove, const D3* from,
                          const Few& vert, const L* pinned) {
  D3 spin = {0.0, 0.0, 0.0};
  for (int i = 0; i < nmove; ++i) {
    const int v = move[i].vert;
    const D3 disp = load(x.disp + 3 * v), now = disp + move[i].share * move[i].lead;
    const D3 back = from[i] + disp - m.place(v) - now;
    if (vert.has(v)) spin += x.mass[v] * cross(back, load(x.vel + 3 * v));
    store(x.disp + 3 * v, now);
  }
  if (vert.count < 3 || spin == D3{0.0, 0.0, 0.0}) return;
  Sums all = sums_of(m, x, vert, pinned);
  const D3 omega = rotation_of(all.inertia, spin);
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    const D3 arm = m.place(v) + load(x.disp + 3 * v) - all.centre;
    store(x.vel + 3 * v, load(x.vel + 3 * v) + cross(omega, arm));
  }
}

// Vertices that were one, `v`, share its mass by the size of what is around each, which `share` has: it gets
// their parts.
PALPATE void share_mass(const Moving& x, int v, const int* member, double* share, int n) {
  const double mass = x.mass[v];
  double whole = 0.0;
  for (int i = 0; i < n; ++i) whole += share[i];
  x.mass[v] = 0.0;  // it may be none of them
  for (int i = 0; i < n; ++i) {
    const int w = member[i];
    share[i] /= whole;
    x.mass[w] = share[i] * mass;
    store(x.disp + 3 * w, load(x.disp + 3 * v)), store(x.vel + 3 * w, load(x.vel + 3 * v));
  }
}

}  // namespace palpate
