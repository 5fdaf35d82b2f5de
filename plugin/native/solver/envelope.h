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

// L D L^T = A in place of A: the unit lower triangle L, and on its diagonal 1 / D. Every ROWS rows have the same
// first column and are taken together. `u` is scratch, ROWS n long. Returns whether A is positive definite, and
// stops where it is not.
template <int ROWS>
PALPATE bool factorize(const Envelope& A, double* u) {
  for (int i = 0; i < A.n; i += ROWS) {
    const int lo = A.first[i];
    for (int j = lo; j < i; ++j) {  // u = L D of the rows
      const double* other = A.row(j);
      const int from = A.first[j] > lo ? A.first[j] : lo;
      V4 sum[ROWS];
      for (int r = 0; r < ROWS; ++r) sum[r] = {0.0, 0.0, 0.0, 0.0};
      int k = from;
      for (; k + 4 <= j; k += 4)
        for (int r = 0; r < ROWS; ++r) add_product(sum[r], ld4(u + r * A.n + k), ld4(other + k));
      for (int r = 0; r < ROWS; ++r) {
        double rest = sum_of(sum[r]);
        for (int c = k; c < j; ++c) rest += u[r * A.n + c] * other[c];
        u[r * A.n + j] = A.row(i + r)[j] - rest;
      }
    }
    for (int r = 0; r < ROWS; ++r) {
      double *row = A.row(i + r), *own = u + r * A.n;
      for (int j = i; j < i + r; ++j) own[j] = row[j] - dot_of(own + lo, A.row(j) + lo, j - lo);
      const double least = 1e-12 * row[i + r];
      double pivot = row[i + r];
      for (int j = lo; j < i + r; ++j) {
        row[j] = own[j] * A.row(j)[j];
        pivot -= row[j] * own[j];
      }
      if (!(pivot > least)) return false;
      row[i + r] = 1.0 / pivot;
    }
  }
  return true;
}

// A^-1 b in place of b, from the factors.
CALLED void solve_factorized(const Envelope& L, double* b) {
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

// The entries of A^-1 there, from the factors (Erisman and Tinney 1975, doi:10.1145/360680.360704). `below` and `u`
// are scratch, n and 2 n long.
PALPATE void invert_there(const Envelope& L, const Envelope& Z, int* below, double* u) {
  double *column = u, *product = u + L.n;  // of L, and of Z with it
  int count = 0;  // rows after i that have column i, the last one first
  for (int i = L.n - 1; i >= 0; --i) {
    int kept = 0;
    for (int k = 0; k < count; ++k)
      if (L.first[below[k]] <= i) below[kept++] = below[k];
    count = kept;
    const int last = count ? below[0] : i;
    for (int k = i + 1; k <= last; ++k) column[k] = product[k] = 0.0;
    for (int a = 0; a < count; ++a) column[below[a]] = L.row(below[a])[i];
    for (int a = 0; a < count; ++a) {
      const int k = below[a];
      const double *row = Z.row(k), l = column[k];
      product[k] += dot_of(row + i + 1, column + i + 1, k - i);
      for (int m = i + 1; m < k; ++m) product[m] += row[m] * l;
    }
    double sum = L.row(i)[i];
    for (int a = 0; a < count; ++a) {
      Z.at(below[a], i) = -product[below[a]];
      sum += column[below[a]] * product[below[a]];
    }
    Z.at(i, i) = sum;
    below[count++] = i;
  }
}

}  // namespace palpate
