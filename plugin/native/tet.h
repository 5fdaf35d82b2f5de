// One tetrahedron: its volume, its shape, and its energy.
#pragma once
#include "triangle.h"

namespace palpate {

PALPATE D3 unit(D3 a) {
  const double size = norm(a);
  return (1.0 / (size > 1e-300 ? size : 1e-300)) * a;
}

// The gradients of the shares of a tetrahedron's corners; returns its volume.
PALPATE double gradients_of(const D3* x, D3* g) {
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

// log(1 + x) to all digits (Goldberg 1991).
PALPATE double log_after(double x) {
  const double u = 1.0 + x;
  return u == 1.0 ? x : log(u) * (x / (u - 1.0));
}

// The energy of a tetrahedron with corners `x` and displacements `u`, as energy.of_gradients has it.
PALPATE double energy_of(const D3* x, const D3* u, double mu, double lam) {
  D3 g[4], h[3] = {};  // rows of the gradient
  const double volume = gradients_of(x, g);
  for (int k = 1; k < 4; ++k) {
    const D3 d = u[k] - u[0];
    h[0] += d.x * g[k], h[1] += d.y * g[k], h[2] += d.z * g[k];
  }
  const D3 cof[3] = {cross(h[1], h[2]), cross(h[2], h[0]), cross(h[0], h[1])};
  const double trace = h[0].x + h[1].y + h[2].z;
  const double i = 2.0 * trace + dot(h[0], h[0]) + dot(h[1], h[1]) + dot(h[2], h[2]);
  const double j = trace + cof[0].x + cof[1].y + cof[2].z + dot(h[0], cof[0]);
  const double shape = mu / 2.0 * (i - log_after(i / 4.0)) - 0.75 * mu * j;
  return volume * (shape + (lam + 0.625 * mu) / 2.0 * j * j);
}

// The unit vectors along which the corners of a tetrahedron add to its volume.
PALPATE void normals_of(const D3* x, D3* g) {
  for (int c = 0; c < 4; ++c) {
    const D3 a = x[(c + 1) % 4], normal = unit(cross(x[(c + 2) % 4] - a, x[(c + 3) % 4] - a));
    g[c] = c % 2 ? normal : -1.0 * normal;
  }
}

}  // namespace palpate
