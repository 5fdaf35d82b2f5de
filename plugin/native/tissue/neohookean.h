// Stable neo-Hookean energy in double (Smith, de Goes and Kim 2018, doi:10.1145/3180491, eq. 14): its only
// definition; solid.h has the forces and the matrix of it in float.
#pragma once
#include "core/tet.h"

namespace palpate {

// A 3x3 matrix, row by row.
struct Rows { D3 row[3]; };

PALPATE void add(Rows& a, double s, const Rows& b) {
  for (int k = 0; k < 3; ++k) a.row[k] += s * b.row[k];
}

PALPATE Rows gradient_of(const D3* u, const D3* g) {
  Rows out = {};
  for (int k = 1; k < 4; ++k) {
    const D3 d = u[k] - u[0];
    out.row[0] += d.x * g[k], out.row[1] += d.y * g[k], out.row[2] += d.z * g[k];
  }
  return out;
}

// log(1 + x) to all digits (Goldberg 1991).
PALPATE double log_after(double x) {
  const double u = 1.0 + x;
  return u == 1.0 ? x : log(u) * (x / (u - 1.0));
}

// Of F = 1 + h: tr F^T F - 3, det F - 1, and the cofactors and the trace of h.
struct Change { double i, j, trace; Rows cof; };

PALPATE Change change_of(const Rows& h) {
  const D3 *r = h.row;
  Change out = {0.0, 0.0, r[0].x + r[1].y + r[2].z, {{cross(r[1], r[2]), cross(r[2], r[0]), cross(r[0], r[1])}}};
  out.i = 2.0 * out.trace + dot(r[0], r[0]) + dot(r[1], r[1]) + dot(r[2], r[2]);
  const D3* c = out.cof.row;
  out.j = out.trace + c[0].x + c[1].y + c[2].z + dot(r[0], c[0]);
  return out;
}

// The density of energy.
PALPATE double density_of(const Rows& h, double mu, double lam) {
  const Change a = change_of(h);
  const double shape = mu / 2.0 * (a.i - log_after(a.i / 4.0)) - 0.75 * mu * a.j;
  return shape + (lam + 0.625 * mu) / 2.0 * a.j * a.j;
}

// Its derivative.
PALPATE Rows stress_of(const Rows& h, double mu, double lam) {
  const Change a = change_of(h);
  const double tension = mu * (1.0 - 1.0 / (4.0 + a.i)), pressure = (lam + 0.625 * mu) * a.j - 0.75 * mu;
  const D3* r = h.row;
  const D3 turned[3] = {{r[0].x, r[1].x, r[2].x}, {r[0].y, r[1].y, r[2].y}, {r[0].z, r[1].z, r[2].z}};
  Rows out;
  for (int k = 0; k < 3; ++k) {
    const D3 one = {double(k == 0), double(k == 1), double(k == 2)};
    out.row[k] = tension * (one + r[k]) + pressure * (a.cof.row[k] + (1.0 + a.trace) * one - turned[k]);
  }
  return out;
}

// The energy of a tetrahedron with corners `x` and displacements `u`, by itself.
PALPATE double energy_of(const D3* x, const D3* u, double mu, double lam) {
  D3 g[4];
  const double volume = slopes_of(x, g);
  return volume * density_of(gradient_of(u, g), mu, lam);
}

// What tells the energy of tetrahedra.
struct Neohookean {
  bool has;
  double given;  // by so much that around a vertex may rise
  const double *mu, *lam, *disp;

  PALPATE double energy(int t, const D3* x, const D3* u) const { return energy_of(x, u, mu[t], lam[t]); }
  PALPATE void hold(int, D3, double&, double&) const {}
};

// Density and derivative of many gradients, a world each.
template <class Fields>
PALPATE void find_densities(const Fields& f, Thread t, int) {
  const double* from = f.slope.data + 9 * t.world;
  const Rows h = {{load(from), load(from + 3), load(from + 6)}};
  const double mu = f.mu.data[t.world], lam = f.lam.data[t.world];
  f.density.data[t.world] = density_of(h, mu, lam);
  const Rows stress = stress_of(h, mu, lam);
  for (int k = 0; k < 3; ++k) store(f.stress.data + 9 * t.world + 3 * k, stress.row[k]);
}

}  // namespace palpate
