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

// Sum of products, in an order that does not depend on the compiler.
PALPATE double dot_of(const double* a, const double* b, int n) {
  double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
  int k = 0;
  for (; k + 4 <= n; k += 4) {
    s0 += a[k] * b[k];
    s1 += a[k + 1] * b[k + 1];
    s2 += a[k + 2] * b[k + 2];
    s3 += a[k + 3] * b[k + 3];
  }
  for (; k < n; ++k) s0 += a[k] * b[k];
  return (s0 + s1) + (s2 + s3);
}

// L D L^T = A in place of A: the unit lower triangle L, and on its diagonal 1 / D. `u` is scratch, n long.
// Pivots of a matrix that is not positive definite are replaced, so that the solution is finite.
PALPATE void factorize(const Envelope& A, double* u) {
  for (int i = 0; i < A.n; ++i) {
    const int lo = A.first[i];
    double* row = A.row(i);
    for (int j = lo; j < i; ++j) {  // u = L D of the row
      const int from = A.first[j] > lo ? A.first[j] : lo;
      u[j] = row[j] - dot_of(u + from, A.row(j) + from, j - from);
    }
    double pivot = row[i];
    for (int j = lo; j < i; ++j) {
      row[j] = u[j] * A.row(j)[j];
      pivot -= row[j] * u[j];
    }
    row[i] = 1.0 / (pivot > 1e-300 ? pivot : 1e300);
  }
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
  for (int i = L.n - 1; i >= 0; --i) {
    int count = 0;  // rows whose envelope has column i
    for (int k = i + 1; k < L.n; ++k)
      if (L.first[k] <= i) below[count++] = k;
    for (int a = count - 1; a >= 0; --a) {
      double sum = 0.0;
      for (int b = 0; b < count; ++b) sum -= L.row(below[b])[i] * Z.at(below[a], below[b]);
      Z.at(below[a], i) = sum;
    }
    double sum = L.row(i)[i];
    for (int b = 0; b < count; ++b) sum -= L.row(below[b])[i] * Z.at(below[b], i);
    Z.at(i, i) = sum;
  }
}

}  // namespace palpate
