// Three doubles: positions, velocities and forces beside MuJoCo.
#pragma once
#include "core/simd.h"

AS_WRITTEN

namespace palpate {

struct D3 { double x, y, z; };

PALPATE D3 load(const double* p) { return {p[0], p[1], p[2]}; }
PALPATE D3 load(const float* p) { return {p[0], p[1], p[2]}; }
PALPATE void store(double* p, D3 a) { p[0] = a.x; p[1] = a.y; p[2] = a.z; }
PALPATE void store(float* p, D3 a) { p[0] = (float)a.x; p[1] = (float)a.y; p[2] = (float)a.z; }

// A node's numbers in a vector of slices; they start at `offset_of(node)`.
PALPATE int offset_of(int node) { return node / LANES * 3 * LANES + node % LANES; }
PALPATE D3 load_lane(const float* p) { return {p[0], p[LANES], p[2 * LANES]}; }
PALPATE void store_lane(float* p, D3 a) {
  p[0] = (float)a.x;
  p[LANES] = (float)a.y;
  p[2 * LANES] = (float)a.z;
}

PALPATE D3 operator+(D3 a, D3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
PALPATE D3 operator-(D3 a, D3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
PALPATE D3 operator*(double s, D3 a) { return {s * a.x, s * a.y, s * a.z}; }
PALPATE D3& operator+=(D3& a, D3 b) { return a = a + b; }
PALPATE bool operator==(D3 a, D3 b) { return a.x == b.x && a.y == b.y && a.z == b.z; }
PALPATE bool operator!=(D3 a, D3 b) { return !(a == b); }
PALPATE double dot(D3 a, D3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
PALPATE D3 vmax(D3 a, D3 b) {
  return {a.x > b.x ? a.x : b.x, a.y > b.y ? a.y : b.y, a.z > b.z ? a.z : b.z};
}
PALPATE D3 vabs(D3 a) { return {fabs(a.x), fabs(a.y), fabs(a.z)}; }
PALPATE double norm(D3 a) { return sqrt(dot(a, a)); }
PALPATE D3 cross(D3 a, D3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
// R x, with R row by row.
template <class Number>
PALPATE D3 turned(const Number* R, D3 x) {
  return {R[0] * x.x + R[1] * x.y + R[2] * x.z, R[3] * x.x + R[4] * x.y + R[5] * x.z,
          R[6] * x.x + R[7] * x.y + R[8] * x.z};
}
// a + R^T x, with R row by row.
PALPATE D3 add_turned(D3 a, const double* R, D3 x) {
  return {a.x + R[0] * x.x + R[3] * x.y + R[6] * x.z, a.y + R[1] * x.x + R[4] * x.y + R[7] * x.z,
          a.z + R[2] * x.x + R[5] * x.y + R[8] * x.z};
}

// What many numbers are divided by: on CUDA, where a division takes as long as dozens of products, by its inverse.
#if ON_CUDA
struct Divisor {
  const double inverse;
  PALPATE Divisor(double a) : inverse(1.0 / a) {}
};
PALPATE double operator/(double a, Divisor b) { return a * b.inverse; }
#else
using Divisor = double;
#endif

}  // namespace palpate
