// Symmetric matrices of which each row has entries from a column of its own on (Jennings 1966,
// doi:10.1093/comjnl/9.3.281): a direct solve, and the part of the inverse that lies in there.
#pragma once
#include "core/d3.h"

AS_WRITTEN

namespace palpate {

// The lower triangle: row i has the columns first[i] to i, at `start[i]`.
struct Envelope {
  double* value;
  const int* first;
  const int* start;
  int n;

  // Row i, to be indexed by the column.
  PALPATE double* row(int i) const { return value + start[i] - first[i]; }
  PALPATE double& at(int i, int j) const { return i >= j ? row(i)[j] : row(j)[i]; }
};

#if ON_CUDA
struct V4 {
  double x, y, z, w;
};
PALPATE V4 ld4(const double* p) { return {p[0], p[1], p[2], p[3]}; }
PALPATE void add_product(V4& s, V4 a, V4 b) {
  s.x += a.x * b.x, s.y += a.y * b.y, s.z += a.z * b.z, s.w += a.w * b.w;
}
#else
typedef double V4 __attribute__((ext_vector_type(4), aligned(8)));
PALPATE V4 ld4(const double* p) { return *(const V4*)p; }
PALPATE void add_product(V4& s, V4 a, V4 b) { s += a * b; }
#endif
PALPATE double sum_of(V4 s) { return (s.x + s.y) + (s.z + s.w); }

// Sum of products, in an order that does not depend on the compiler.
PALPATE double dot_of(const double* a, const double* b, int n) {
  V4 s = {0.0, 0.0, 0.0, 0.0};
  int k = 0;
  for (; k + 4 <= n; k += 4) add_product(s, ld4(a + k), ld4(b + k));
  double rest = 0.0;
  for (; k < n; ++k) rest += a[k] * b[k];
  return sum_of(s) + rest;
}

// L D L^T = A in place of A: the unit lower triangle L, and on its diagonal 1 / D. `u` is scratch, n long.
// Returns whether A is positive definite, and stops where it is not.
PALPATE bool factorize(const Envelope& A, double* u) {
  for (int i = 0; i < A.n; ++i) {
    const int lo = A.first[i];
    double* row = A.row(i);
    for (int j = lo; j < i; ++j) {  // u = L D of the row
      const int from = A.first[j] > lo ? A.first[j] : lo;
      u[j] = row[j] - dot_of(u + from, A.row(j) + from, j - from);
    }
    const double least = 1e-12 * row[i];
    double pivot = row[i];
    for (int j = lo; j < i; ++j) {
      row[j] = u[j] * A.row(j)[j];
      pivot -= row[j] * u[j];
    }
    if (!(pivot > least)) return false;
    row[i] = 1.0 / pivot;
  }
  return true;
}

// A^-1 b in place of b, from the factors.
PALPATE void solve_factorized(const Envelope& L, double* b) {
  for (int i = 0; i < L.n; ++i) {
    const int lo = L.first[i];
    b[i] -= dot_of(L.row(i) + lo, b + lo, i - lo);
  }
  for (int i = 0; i < L.n; ++i) b[i] *= L.row(i)[i];
  for (int i = L.n - 1; i >= 0; --i) {
    const double* row = L.row(i);
    for (int k = L.first[i]; k < i; ++k) b[k] -= row[k] * b[i];
  }
}

// The entries of A^-1 there, from the factors (Erisman and Tinney 1975, doi:10.1145/360680.360704).
PALPATE void invert_there(const Envelope& L, const Envelope& Z, int* below) {
  int count = 0;  // rows after i that have column i, the last one first
  for (int i = L.n - 1; i >= 0; --i) {
    int kept = 0;
    for (int k = 0; k < count; ++k)
      if (L.first[below[k]] <= i) below[kept++] = below[k];
    count = kept;
    double sum = L.row(i)[i];
    for (int a = 0; a < count; ++a) {
      double entry = 0.0;
      for (int b = 0; b < count; ++b) entry -= L.row(below[b])[i] * Z.at(below[a], below[b]);
      Z.at(below[a], i) = entry;
      sum -= L.row(below[a])[i] * entry;
    }
    Z.at(i, i) = sum;
    below[count++] = i;
  }
}

}  // namespace palpate
