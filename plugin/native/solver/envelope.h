// Symmetric matrices of which each row has entries from a column of its own on (Jennings 1966,
// doi:10.1093/comjnl/9.3.281): a direct solve, and the part of the inverse that lies in there.
#pragma once
#include "core/d3.h"
#include "core/lanes.h"

AS_WRITTEN

namespace palpate {

// The lower triangle: row i has the columns first[i] to i, at `start[i]`; `last`, of which each column has a number, is
// scratch.
struct Envelope {
  double* value;
  const int* first;
  const int* start;
  int* last;
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

// Of the lower triangle of a matrix, row by row, the entry of a number.
struct Corner { int row, column; };
PALPATE Corner corner(int number) {
  int row = (int)(0.5f * (sqrtf(8.0f * number + 1.0f) - 1.0f));
  if (row * (row + 1) / 2 > number) --row;
  if ((row + 1) * (row + 2) / 2 <= number) ++row;
  return {row, number - row * (row + 1) / 2};
}

// L D L^T = A in place of A: the unit lower triangle L, and on its diagonal 1 / D. Every ROWS rows have the same
// first column and are taken together. `u` is scratch, (ROWS + 1) n long. Returns whether A is positive definite, and
// stops where it is not.
template <int ROWS>
PALPATE bool factorize(const Envelope& A, double* u);

// A^-1 b in place of b, from the factors, whose rows come as they were taken together.
template <int ROWS>
CALLED void solve_factorized(const Envelope& L, double* b);

// The entries of A^-1 there, from the factors (Erisman and Tinney 1975, doi:10.1145/360680.360704). `below` and `u`
// are scratch, n and 2 n long.
PALPATE void invert_there(const Envelope& L, const Envelope& Z, int* below, double* u);

#if ON_CUDA

// Notes of every ROWS columns, node by node, which is the last node that has them.
template <int ROWS>
PALPATE void note_last(const Envelope& A) {
  const int count = A.n / ROWS;
  each_lane(0, count, [&](int p) { A.last[p] = p; });
  each_lane(0, count, [&](int p) { raise(A.last[A.first[ROWS * p] / ROWS], p); });
  int most = 0;
  for (int from = 0; from < count; from += TOGETHER) {
    const int p = from + own_lane(), own = p < count ? A.last[p] : 0, up_to = most_up_to(own > most ? own : most);
    if (p < count) A.last[p] = up_to;
    most = of_last_lane(up_to);
  }
  meet_lanes();
}

// Node by node from the first one on, and what is left of those after it by all lanes.
template <int ROWS>
PALPATE bool factorize(const Envelope& A, double* u) {
  double *whole = u, *left = u + A.n;  // of a row its diagonal as it was, and D times what it has in the pivot's columns
  int* node = A.last + A.n / ROWS;     // whose rows have the pivot's columns
  note_last<ROWS>(A);
  each_lane(0, A.n, [&](int i) { whole[i] = A.row(i)[i]; });
  for (int p = 0; p < A.n / ROWS; ++p) {
    const int i = ROWS * p;
    double l[ROWS][ROWS], d[ROWS], rest[ROWS];  // the pivot's factors, by all lanes alike
    for (int a = 0; a < ROWS; ++a) {
      const double* row = A.row(i + a) + i;
      for (int b = 0; b <= a; ++b) l[a][b] = row[b];
    }
    for (int a = 0; a < ROWS; ++a) {
      for (int b = 0; b < a; ++b)
        for (int c = 0; c < b; ++c) l[a][b] -= l[a][c] * l[b][c];
      d[a] = l[a][a];
      for (int b = 0; b < a; ++b) {
        const double own = l[a][b] * rest[b];
        d[a] -= own * l[a][b];
        l[a][b] = own;
      }
      if (!(d[a] > 1e-12 * whole[i + a])) return false;
      rest[a] = 1.0 / d[a];
    }
    const int count = note_those(p + 1, A.last[p] + 1, [&](int q) { return A.first[ROWS * q] <= i; }, node);
    each_lane(0, ROWS * count, [&](int k) {
      double own[ROWS], *row = A.row(ROWS * node[k / ROWS] + k % ROWS) + i;
      for (int b = 0; b < ROWS; ++b) own[b] = row[b];
      for (int b = 0; b < ROWS; ++b)
        for (int c = 0; c < b; ++c) own[b] -= own[c] * l[b][c];
      for (int b = 0; b < ROWS; ++b) row[b] = own[b] * rest[b], left[ROWS * k + b] = own[b];
    });
    // A row of one node at the columns of another, of which all is read before any is written.
    each_lane(0, ROWS * (count * (count + 1) / 2), [&](int k) {
      const Corner at = corner(k / ROWS);
      const int r = k % ROWS, most = at.row == at.column ? r + 1 : ROWS;
      double now[ROWS], *row = A.row(ROWS * node[at.row] + r), *to = row + ROWS * node[at.column];
      const double* other = left + ROWS * ROWS * at.column;
      for (int b = 0; b < ROWS; ++b) {
        double sum = 0.0;
        for (int c = 0; c < ROWS; ++c) sum += row[i + c] * other[ROWS * b + c];
        now[b] = to[b] - sum;
      }
      for (int b = 0; b < most; ++b) to[b] = now[b];
    });
    if (own_lane() < ROWS) {
      double* row = A.row(i + own_lane()) + i;
      for (int a = 0; a < ROWS; ++a) {
        if (own_lane() != a) continue;
        for (int b = 0; b < a; ++b) row[b] = l[a][b];
        row[a] = rest[a];
      }
    }
  }
  meet_lanes();
  return true;
}

template <int ROWS>
CALLED void solve_factorized(const Envelope& L, double* b) {
  for (int i = 0; i < L.n; i += ROWS) {
    double y[ROWS];
    for (int a = 0; a < ROWS; ++a) {
      y[a] = b[i + a];
      for (int c = 0; c < a; ++c) y[a] -= L.row(i + a)[i + c] * y[c];
    }
    each_lane(i + ROWS, ROWS * (L.last[i / ROWS] + 1), [&](int k) {
      if (L.first[k] > i) return;
      double sum = 0.0;
      for (int c = 0; c < ROWS; ++c) sum += L.row(k)[i + c] * y[c];
      b[k] -= sum;
    });
    if (own_lane() == 0)
      for (int a = 1; a < ROWS; ++a) b[i + a] = y[a];
  }
  meet_lanes();
  each_lane(0, L.n, [&](int i) { b[i] *= L.row(i)[i]; });
  for (int i = L.n - ROWS; i >= 0; i -= ROWS) {
    double x[ROWS];
    for (int a = ROWS - 1; a >= 0; --a) {
      x[a] = b[i + a];
      for (int c = a + 1; c < ROWS; ++c) x[a] -= L.row(i + c)[i + a] * x[c];
    }
    each_lane(L.first[i], i, [&](int k) {
      double sum = 0.0;
      for (int c = 0; c < ROWS; ++c) sum += L.row(i + c)[k] * x[c];
      b[k] -= sum;
    });
    if (own_lane() == 0)
      for (int a = 0; a + 1 < ROWS; ++a) b[i + a] = x[a];
  }
  meet_lanes();
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

template <int ROWS>
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
