// Symmetric banded matrices: a direct solve, and the part of the inverse that lies in the band.
//
// Row i holds the entries (i, i - BAND) to (i, i), the diagonal last.
#pragma once
#include "core/d3.h"

AS_WRITTEN

namespace palpate {

constexpr int BAND = 10, WIDTH = BAND + 1;

PALPATE double& entry(double* A, int i, int j) { return A[WIDTH * i + BAND + j - i]; }
PALPATE int first_in_band(int i) { return i < BAND ? 0 : i - BAND; }

// L D L^T = A in place of A: the unit lower triangle L, and on its diagonal 1 / D. Pivots of a matrix
// that is not positive definite are replaced, so that the solution is finite.
PALPATE void factorize(double* A, int n) {
  double u[BAND];  // L D of the row
  for (int i = 0; i < n; ++i) {
    const int lo = first_in_band(i);
    double* row = A + WIDTH * i + BAND - i;
    double pivot = row[i];
    for (int j = lo; j < i; ++j) {
      const double* other = A + WIDTH * j + BAND - j;
      double sum = row[j];
      for (int k = lo; k < j; ++k) sum -= u[k - lo] * other[k];
      u[j - lo] = sum;
    }
    for (int j = lo; j < i; ++j) {
      row[j] = u[j - lo] * entry(A, j, j);
      pivot -= row[j] * u[j - lo];
    }
    row[i] = 1.0 / (pivot > 1e-300 ? pivot : 1e300);
  }
}

// A^-1 b in place of b, from the factors.
PALPATE void solve_factorized(const double* L, double* b, int n) {
  for (int i = 0; i < n; ++i) {
    const double* row = L + WIDTH * i + BAND - i;
    double sum = b[i];
    for (int k = first_in_band(i); k < i; ++k) sum -= row[k] * b[k];
    b[i] = sum;
  }
  for (int i = 0; i < n; ++i) b[i] *= L[WIDTH * i + BAND];
  for (int i = n - 1; i >= 0; --i) {
    const double* row = L + WIDTH * i + BAND - i;
    for (int k = first_in_band(i); k < i; ++k) b[k] -= row[k] * b[i];
  }
}

// The entries of A^-1 in the band, from the factors (Erisman and Tinney 1975,
// doi:10.1145/360680.360704).
PALPATE void invert_in_band(double* L, double* Z, int n) {
  for (int i = n - 1; i >= 0; --i) {
    const int last = i + BAND < n ? i + BAND : n - 1;
    for (int j = last; j >= i; --j) {
      double sum = i == j ? entry(L, i, i) : 0.0;
      for (int k = i + 1; k <= last; ++k) sum -= entry(L, k, i) * (k > j ? entry(Z, k, j) : entry(Z, j, k));
      entry(Z, j, i) = sum;
    }
  }
}

}  // namespace palpate
