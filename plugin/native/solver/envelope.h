// Symmetric matrices of which each row has entries from a column of its own on (Jennings 1966,
// doi:10.1093/comjnl/9.3.281): a direct solve, and the part of the inverse that lies in there.
#pragma once
#include "core/d3.h"
#include "core/lanes.h"

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
PALPATE bool factorize(const Envelope& A, double* u);

// A^-1 b in place of b, from the factors.
CALLED void solve_factorized(const Envelope& L, double* b);

// The entries of A^-1 there, from the factors (Erisman and Tinney 1975, doi:10.1145/360680.360704). `below` and `u`
// are scratch, n and 2 n long.
PALPATE void invert_there(const Envelope& L, const Envelope& Z, int* below, double* u);

#if ON_CUDA

// L^-1 u in place of u, ROWS times, from column `lo`, before which it is 0, to `hi`. A lane has a column of every
// TOGETHER.
template <int ROWS>
PALPATE void substitute(const Envelope& L, int lo, int hi, double* u) {
  for (int from = lo; from < hi; from += TOGETHER) {
    const int j = from + own_lane(), end = from + TOGETHER < hi ? from + TOGETHER : hi;
    const int first = j < hi ? L.first[j] : end;
    const double* row = j < hi ? L.row(j) : nullptr;
    double own[ROWS];
    for (int r = 0; r < ROWS; ++r) own[r] = j < hi ? u[r * L.n + j] : 0.0;
    for (int k = first > lo ? first : lo; k < from; ++k)
      for (int r = 0; r < ROWS; ++r) own[r] -= u[r * L.n + k] * row[k];
    __syncwarp();
    for (int k = from; k < end; ++k) {
      const double l = k >= first && k < j ? row[k] : 0.0;
      for (int r = 0; r < ROWS; ++r) own[r] -= __shfl_sync(0xffffffffu, own[r], k - from) * l;
    }
    for (int r = 0; r < ROWS && j < hi; ++r) u[r * L.n + j] = own[r];
    meet_lanes();
  }
}

template <int ROWS>
PALPATE bool factorize(const Envelope& A, double* u) {
  for (int i = 0; i < A.n; i += ROWS) {
    const int lo = A.first[i];
    each_lane(lo, i, [&](int j) {
      for (int r = 0; r < ROWS; ++r) u[r * A.n + j] = A.row(i + r)[j];
    });
    substitute<ROWS>(A, lo, i, u);  // u = L D of the rows
    for (int r = 0; r < ROWS; ++r) {
      double *row = A.row(i + r), *own = u + r * A.n, pivot = 0.0;
      for (int j = i; j < i + r; ++j) {
        double sum = 0.0;
        each_lane(lo, j, [&](int k) { sum += own[k] * A.row(j)[k]; });
        sum = sum_together(sum);
        one_lane([&] { own[j] = row[j] - sum; });
      }
      each_lane(lo, i + r, [&](int j) {
        row[j] = own[j] * A.row(j)[j];
        pivot += row[j] * own[j];
      });
      const double whole = row[i + r], rest = whole - sum_together(pivot);
      if (!(rest > 1e-12 * whole)) return false;
      one_lane([&] { row[i + r] = 1.0 / rest; });
    }
  }
  return true;
}

CALLED void solve_factorized(const Envelope& L, double* b) {
  substitute<1>(L, 0, L.n, b);
  each_lane(0, L.n, [&](int i) { b[i] *= L.row(i)[i]; });
  for (int i = L.n - 1; i >= 0; --i) {
    const double* row = L.row(i);
    each_lane(L.first[i], i, [&](int k) { b[k] -= row[k] * b[i]; });
  }
}

PALPATE void invert_there(const Envelope& L, const Envelope& Z, int*, double* column) {
  int last = L.n - 1;  // row that has column i
  for (int i = L.n - 1; i >= 0; --i) {
    while (L.first[last] > i) --last;
    each_lane(i + 1, last + 1, [&](int k) { column[k] = L.first[k] <= i ? L.row(k)[i] : 0.0; });
    double sum = 0.0;
    each_lane(i + 1, last + 1, [&](int k) {
      if (L.first[k] > i) return;
      double product = 0.0;
      for (int m = i + 1; m <= last; ++m)
        if (column[m] != 0.0) product += Z.at(k, m) * column[m];
      Z.at(k, i) = -product;
      sum += column[k] * product;
    });
    sum = sum_together(sum);
    one_lane([&] { Z.at(i, i) = L.row(i)[i] + sum; });
  }
}

#else

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

#endif

}  // namespace palpate
