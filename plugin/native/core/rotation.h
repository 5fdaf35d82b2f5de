// The slow rotation that gives back an angular momentum.
#pragma once
#include "cutting/surface.h"

namespace palpate {

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

}  // namespace palpate
