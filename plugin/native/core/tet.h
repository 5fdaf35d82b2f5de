// One tetrahedron: its volume and its shape.
#pragma once
#include "core/triangle.h"

namespace palpate {

// Writes the gradients of the shares of a tetrahedron's corners; returns its volume.
PALPATE double slopes_of(const D3* x, D3* g) {
  const D3 a = x[1] - x[0], b = x[2] - x[0], c = x[3] - x[0];
  const double det = dot(a, cross(b, c));
  g[1] = (1.0 / det) * cross(b, c), g[2] = (1.0 / det) * cross(c, a), g[3] = (1.0 / det) * cross(a, b);
  g[0] = -1.0 * (g[1] + g[2] + g[3]);
  return det / 6.0;
}

PALPATE double volume_of(const D3* x) { return dot(x[1] - x[0], cross(x[2] - x[0], x[3] - x[0])) / 6.0; }

// 1 for a regular tetrahedron.
PALPATE double quality_of(const D3* x) {
  double sum = 0.0;
  for (int i = 0; i < 4; ++i)
    for (int j = i + 1; j < 4; ++j) sum += dot(x[j] - x[i], x[j] - x[i]);
  const double length2 = sum / 6.0 > 1e-300 ? sum / 6.0 : 1e-300;
  return 6.0 * sqrt(2.0) * volume_of(x) / (length2 * sqrt(length2));
}

// The unit vectors along which the corners of a tetrahedron add to its volume.
PALPATE void normals_of(const D3* x, D3* g) {
  for (int c = 0; c < 4; ++c) {
    const D3 a = x[(c + 1) % 4], normal = unit(cross(x[(c + 2) % 4] - a, x[(c + 3) % 4] - a));
    g[c] = c % 2 ? normal : -1.0 * normal;
  }
}

}  // namespace palpate
