// The stiffness that makes the hinges of a triangle a Kirchhoff plate; tissue/geometry/plate.py says how.
#pragma once
#include "cutting/surface.h"

namespace palpate {

struct D2 { double x, y; };
PALPATE D2 operator+(D2 a, D2 b) { return {a.x + b.x, a.y + b.y}; }
PALPATE D2 operator-(D2 a, D2 b) { return {a.x - b.x, a.y - b.y}; }
PALPATE D2 operator*(double s, D2 a) { return {s * a.x, s * a.y}; }

// Of a triangle: the stiffness between its hinges [N m], and each hinge's angle by normal displacements of
// the half-edge's start and end, the triangle's apex and the other one [1/m].
struct Plate { double gain[3][3], weight[3][4]; };

// Where the apex of a half-edge has its foot, as a share of the edge, and its height.
template <class S>
PALPATE void find_foot(const S& m, int h, double& share, double& height) {
  const D3 start = m.place(m.from(h)), edge = m.place(m.to(h)) - start, arm = m.place(m.opposite(h)) - start;
  share = dot(arm, edge) / dot(edge, edge);
  height = norm(arm - share * edge);
}

// The values of the curvatures' deflections, at an apex and above the foot of its height.
PALPATE D3 modes(D2 p) { return {p.x * p.x / 2.0, p.y * p.y / 2.0, p.x * p.y}; }
PALPATE D3 bend_of(D2 apex, double share, double height, D3 start, D3 end) {
  return (1.0 / height) * (modes(apex) - ((1.0 - share) * start + share * end));
}

// The angle of a triangle's hinge by curvature kxx, kyy, kxy.
template <class S>
PALPATE D3 angle_of(const S& m, int h, const D2* flat, double* weight) {
  const int c = h % 3, other = m.twin[h] >= 0 ? (int)m.twin[h] : h;
  const D2 p0 = flat[c], p1 = flat[(c + 1) % 3], inner = flat[(c + 2) % 3];
  double share, height, beyond, far;
  find_foot(m, h, share, height);
  find_foot(m, other, beyond, far);
  beyond = 1.0 - beyond;
  D2 inward = inner - p0 - share * (p1 - p0);
  inward = (1.0 / sqrt(inward.x * inward.x + inward.y * inward.y)) * inward;
  const D2 outer = p0 + beyond * (p1 - p0) - far * inward;
  weight[0] = (1.0 - share) / height + (1.0 - beyond) / far;
  weight[1] = share / height + beyond / far;
  weight[2] = -1.0 / height, weight[3] = -1.0 / far;
  const D3 start = modes(p0), end = modes(p1), zero = {0.0, 0.0, 0.0};
  return zero - bend_of(inner, share, height, start, end) - bend_of(outer, beyond, far, start, end);
}

constexpr double RAISED = 0.05, NONE = 1e-9;  // of the largest eigenvalue

// Inverts a flexibility between hinges, small eigenvalues of which are raised; absent hinges have no
// stiffness. At a boundary two hinges can have one curvature between them: how else they fold has no
// stiffness where `loose`, in coarse meshes, whose cycles what is stiffer than the tissue holds up.
PALPATE void stiffen(double (*flex)[3], const bool* there, double size, bool loose, double (*gain)[3]) {
  const bool folds = loose && !(there[0] && there[1] && there[2]);
  double axes[3][3], largest = 0.0, inverse[3];
  find_axes(flex, axes);
  for (int k = 0; k < 3; ++k) largest = flex[k][k] > largest ? flex[k][k] : largest;
  for (int k = 0; k < 3; ++k) {
    const double value = flex[k][k];
    const double raised = value > RAISED * largest ? value : RAISED * largest;
    const bool none = !there[k] || largest <= 0.0 || (folds && value < NONE * largest);
    inverse[k] = none ? 0.0 : 1.0 / raised;
  }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      double sum = 0.0;
      for (int k = 0; k < 3; ++k) sum += axes[i][k] * inverse[k] * axes[j][k];
      gain[i][j] = there[i] && there[j] ? size * sum : 0.0;
    }
}

template <class S>
PALPATE Plate plate_of(const S& m, int t, double rigidity, double nu, bool loose) {
  Plate out;
  D3 x[3], angle[3];
  m.corners(t, x);
  const D3 along = x[1] - x[0], edge = (1.0 / norm(along)) * along;
  const D3 normal = 0.5 * cross(x[1] - x[0], x[2] - x[0]);
  const double area = norm(normal);
  const D3 up = cross((1.0 / area) * normal, edge);
  D2 flat[3];
  bool there[3];
  for (int c = 0; c < 3; ++c) flat[c] = {dot(x[c] - x[0], edge), dot(x[c] - x[0], up)};
  for (int c = 0; c < 3; ++c) {
    angle[c] = angle_of(m, 3 * t + c, flat, out.weight[c]);
    there[c] = m.twin[3 * t + c] >= 0;
  }
  const double by = 1.0 / (1.0 - nu * nu), twist = 1.0 / (2.0 * (1.0 - nu));
  double flex[3][3];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const D3 a = angle[i], b = {by * (angle[j].x - nu * angle[j].y), by * (angle[j].y - nu * angle[j].x),
                                  twist * angle[j].z};
      flex[i][j] = there[i] && there[j] ? dot(a, b) : 0.0;
    }
  stiffen(flex, there, area * rigidity, loose, out.gain);
  return out;
}

}  // namespace palpate
