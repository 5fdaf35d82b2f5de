// What moves goes on as it moved: a slow rotation keeps angular momentum after a cut.
#pragma once
#include "surface.h"

namespace palpate {

// Of vertices.
struct Moving { double *mass, *disp, *vel; };

constexpr double LITTLE = 1e-6;  // of the largest moment of inertia

// The slow rotation that has a given spin; none about an axis with hardly any inertia.
PALPATE D3 rotation_of(double (*inertia)[3], D3 spin) {
  double axes[3][3], largest = 0.0;
  find_axes(inertia, axes);
  for (int k = 0; k < 3; ++k) largest = inertia[k][k] > largest ? inertia[k][k] : largest;
  D3 out = {0.0, 0.0, 0.0};
  for (int k = 0; k < 3; ++k) {
    const D3 axis = {axes[0][k], axes[1][k], axes[2][k]};
    if (inertia[k][k] > LITTLE * largest) out += (dot(axis, spin) / inertia[k][k]) * axis;
  }
  return out;
}

// Adds to the velocities of vertices the slow rotation of them all about their centre that has a spin;
// `rest` has where they are at rest.
PALPATE void add_spin(const double* rest, const Moving& x, const Few& vert, D3 spin) {
  if (vert.count < 3 || spin == D3{0.0, 0.0, 0.0}) return;
  D3 centre = {0.0, 0.0, 0.0};
  double total = 0.0, inertia[3][3] = {};
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    centre += x.mass[v] * (load(rest + 3 * v) + load(x.disp + 3 * v));
    total += x.mass[v];
  }
  centre = (1.0 / total) * centre;
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    const D3 arm = load(rest + 3 * v) + load(x.disp + 3 * v) - centre;
    const double a[3] = {arm.x, arm.y, arm.z}, square = dot(arm, arm);
    for (int k = 0; k < 9; ++k)
      inertia[k / 3][k % 3] += x.mass[v] * ((k / 3 == k % 3 ? square : 0.0) - a[k / 3] * a[k % 3]);
  }
  const D3 omega = rotation_of(inertia, spin);
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    const D3 arm = load(rest + 3 * v) + load(x.disp + 3 * v) - centre;
    store(x.vel + 3 * v, load(x.vel + 3 * v) + cross(omega, arm));
  }
}

}  // namespace palpate
