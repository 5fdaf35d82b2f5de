// An implicit Euler step of a rod: the least of
//
//   sum m / (2 h^2) |x - x0 - h v - h^2 f / m|^2 + c / (2 h) |x - x0|^2 + E(x) + h^2 sum s(J a + B b - aref)
//   + h^2 / 2 |b|^2,   a = (x - x0 - h v) / h^2,
//
// c the drag of a node and b how bodies yield, in coordinates in which their inertia is 1 kg, by Newton's method with a
// line search. The sum of s is MuJoCo's cost of the constraints that the rod takes part in (Todorov 2014,
// doi:10.1109/ICRA.2014.6907751), with the rod's own stiffness in place of MuJoCo's inertia. A row's dofs are those of two
// neighbouring nodes and of bodies that yield, so the matrix stays sparse.
#pragma once
#include "tissue/rod_contact.h"
#include "tissue/rod_ties.h"

AS_WRITTEN

namespace palpate {

constexpr int DOFS = 6;  // of the two nodes that a row reaches
// Newton's method ends when no node moves by more than this share of the radius: by CLOSE where the cost fell as was
// expected, up to a share FORESEEN, since much less is then left to go, or else by STALLED.
constexpr double CLOSE = 1e-4, STALLED = 1e-5, FORESEEN = 0.1;
constexpr double SLOPE = 1e-4;  // of a step's decrease, the least (Armijo)
constexpr double ROUNDED = 1e-15;  // of the cost, what is less than its last digits
constexpr int HALVINGS = 30;
constexpr double ENDLESS = 1e300;

// What MuJoCo's rows are to their cost: both signs, one, or a cone, whose further rows follow.
enum RowKind { BOTH, ONE, CONE, FRICTION };

// A row of constraints, in the solver's memory.
template <class Fields>
struct RodRow {
  const Fields& f;
  int r;
  PALPATE int kind() const { return f.row_kind.data[r]; }
  PALPATE int node() const { return f.row_node.data[r]; }
  PALPATE const double* J() const { return f.row_value.data + (DOFS + 3) * r; }
  PALPATE double rest() const { return J()[DOFS]; }      // what other bodies add, less aref
  PALPATE double D() const { return J()[DOFS + 1]; }
  PALPATE double friction() const { return J()[DOFS + 2]; }  // of a cone's first row, its mu
  // What yields to it: the nodes that stand for that, then less than 0, and the row of these.
  PALPATE int body(int k) const { return f.row_yields.data[STANDINS * r + k]; }
  PALPATE int dofs() const {
    int count = 0;
    while (count < STANDINS && body(count) >= 0) ++count;
    return DOFS + 3 * count;
  }
  PALPATE const double* B() const { return f.row_body.data + REACH * r; }
  PALPATE double at(int c) const { return c < DOFS ? J()[c] : B()[c - DOFS]; }

  // J a - aref where the rod's nodes accelerate by (x - x_free) / h^2.
  PALPATE double residual(const double* x, double h) const {
    const Divisor square(h * h);
    double sum = rest();
    for (int k = 0; k < DOFS; ++k) {
      if (J()[k] == 0.0) continue;
      const int at = 3 * node() + k;
      sum += J()[k] * (x[at] - f.start.data[at] - h * f.vel.data[at]) / square;
    }
    for (int k = 0; k < REACH && body(k / 3) >= 0; ++k)
      if (B()[k] != 0.0) sum += B()[k] * x[3 * body(k / 3) + k % 3] / square;
    return sum;
  }
};

// Adds force J to a gradient by place, and stiffness J J^T to the matrix; B is J of what yields to row `at`. All lanes do
// so together.
template <class Fields>
PALPATE void add_row(
    const Fields& f, const RodRow<Fields>& at, const double* J, const double* B, double force, double stiffness, double* g,
    const RodMatrix* H) {
  const int node = at.node();
#if ON_CUDA
  const auto value = [&](int a) { return a < DOFS ? J[a] : B[a - DOFS]; };
  const auto which = [&](int a) { return a < DOFS ? node + a / 3 : at.body((a - DOFS) / 3); };
  const int count = at.dofs();
  each_lane(0, count, [&](int a) {
    if (value(a) != 0.0) g[4 * which(a) + a % 3] += force * value(a);
  });
  add_together(*H, count, [&](int a) { return H->of(which(a), a % 3); },
               [&](int a, int b) { return stiffness * value(a) * value(b); });
#else
  Terms<2> terms;
  terms.add(J, force, stiffness);
  const int last = node + 1 < f.nnode ? node + 1 : node - 1;  // at the end, of which there is nothing
  const int nodes[2] = {node, last};
  terms.scatter(nodes, g, *H);
  for (int i = 0; i < STANDINS && at.body(i) >= 0; ++i) {
    const int body = at.body(i);
    const double* b = B + 3 * i;
    if (b[0] == 0.0 && b[1] == 0.0 && b[2] == 0.0) continue;
    for (int c = 0; c < 3; ++c) g[4 * body + c] += force * b[c];
    for (int k = 0; k < (node + 1 < f.nnode ? 2 : 1); ++k)
      H->add(body, 3, nodes[k], 3, [&](int c, int d) { return stiffness * b[c] * J[3 * k + d]; });
    for (int k = 0; k <= i; ++k)
      H->add(body, 3, at.body(k), 3, [&](int c, int d) { return stiffness * b[c] * B[3 * k + d]; });
  }
#endif
}

// The cost of a cone (MuJoCo, Computation, elliptic cones) whose first row is r; adds its gradient and
// second derivative where there are a gradient and a matrix.
template <class Fields>
CALLED double cone(const Fields& f, int r, int dim, const double* x, double h, double* g, const RodMatrix* H) {
  const RodRow<Fields> first{f, r};
  const double mu = first.friction(), per = 1.0 / (h * h);
  double u[6], slope[6], T2 = 0.0, cost = 0.0;
  for (int k = 0; k < dim; ++k) {
    const RodRow<Fields> row{f, r + k};
    slope[k] = row.friction();
    u[k] = row.residual(x, h) * slope[k];
    if (k) T2 += u[k] * u[k];
  }
  const double N = u[0], T = sqrt(T2);
  if (N >= mu * T || (T < 1e-300 && N >= 0.0)) return 0.0;
  if (mu * N + T <= 0.0 || T < 1e-300) {
    for (int k = 0; k < dim; ++k) {
      const RodRow<Fields> row{f, r + k};
      const double residual = u[k] / slope[k];
      cost += 0.5 * row.D() * residual * residual;
      if (g) add_row(f, row, row.J(), row.B(), row.D() * residual, row.D() * per, g, H);
    }
    return cost;
  }
  const double Dm = first.D() / (mu * mu * (1.0 + mu * mu)), off = N - mu * T;
  cost = 0.5 * Dm * off * off;
  if (!g) return cost;
  double v[DOFS + REACH] = {}, w[DOFS + REACH], tangent[DOFS + REACH] = {};
  const int all = first.dofs();
  for (int k = 0; k < dim; ++k) {
    const RodRow<Fields> row{f, r + k};
    for (int c = 0; c < all; ++c) {
      const double J = slope[k] * row.at(c);
      v[c] += J * (k ? -mu * u[k] / T : 1.0);
      if (k) tangent[c] += J * u[k] / T;
    }
  }
  const double bends = -Dm * off * mu / T;  // of the length of the tangential part
  add_row(f, first, v, v + DOFS, Dm * off, Dm * per, g, H);
  for (int k = 1; k < dim; ++k) {
    const RodRow<Fields> row{f, r + k};
    for (int c = 0; c < all; ++c) w[c] = slope[k] * row.at(c) - u[k] / T * tangent[c];
    add_row(f, first, w, w + DOFS, 0.0, bends * per, g, H);
  }
  return cost;
}

// The cost of this lane's rows; adds gradient and second derivative of all where there are a gradient and a matrix.
template <class Fields>
CALLED double rows_cost(const Fields& f, const double* x, double h, double* g, const RodMatrix* H) {
  double cost = 0.0;
  const int n = f.count.data[0];
  const auto cost_of = [&](int r, double* into) {
    const RodRow<Fields> row{f, r};
    if (row.kind() == FRICTION) return 0.0;  // of the cone before
    if (row.kind() == CONE) {
      int dim = 1;
      while (r + dim < n && f.row_kind.data[r + dim] == FRICTION) ++dim;
      return cone(f, r, dim, x, h, into, H);
    }
    const double residual = row.residual(x, h);
    if (row.kind() == ONE && residual >= 0.0) return 0.0;
    if (into) add_row(f, row, row.J(), row.B(), row.D() * residual, row.D() / (h * h), into, H);
    return 0.5 * row.D() * residual * residual;
  };
  if (!g || TOGETHER == 1) {
    each_lane(0, n, [&](int r) { cost += cost_of(r, g); });
  } else {
    each_in_turn<int>(n, [&](int r, int& own) { return own = r, cost_of(r, nullptr) > 0.0; }, [&](int r) {
      const double own = cost_of(r, g);
      if (own_lane() == 0) cost += own;
    });
  }
  return cost;
}

// The cost at a state; where constraints alone cost more than `most`, only that: no other part is negative.
template <class Fields>
CALLED double step_cost(const Fields& f, const double* x, const double* turn, double h, double most = ENDLESS) {
  const double rows = h * h * rows_cost(f, x, h, nullptr, nullptr), least = sum_together(rows);
  if (least > most) return least;
  double sum = 0.0;
  each_lane(0, f.nnode, [&](int i) {
    const D3 off = load(x + 3 * i) - load(f.aim.data + 3 * i), moved = load(x + 3 * i) - load(f.start.data + 3 * i);
    sum += 0.5 * f.drag.data[i] / h * dot(moved, moved);
    sum += 0.5 * f.mass.data[i] / (h * h) * dot(off, off) + 0.5 * f.spin.data[i] / (h * h) * turn[i] * turn[i];
  });
  each_lane(3 * f.nnode, 3 * nodes_of(f), [&](int a) { sum += 0.5 / (h * h) * x[a] * x[a]; });
  const double own = sum + rod_energy(f, x, turn) + contacts_energy(f, x, h, nullptr, nullptr, false) +
                     ties_energy(f, x, nullptr, nullptr) + rows;
  return sum_together(own);
}

// The gradient at a trial state, and the matrix, see `add_rod`; both without what other bodies do.
template <class Fields>
PALPATE void assemble(const Fields& f, const double* x, const double* turn, double h, double* g, bool exact) {
  lay_out(f, x);
  const RodMatrix H = matrix_of(f);
  each_lane(0, f.count.data[2], [&](int a) { H.value[a] = 0.0; });
  each_lane(0, f.nnode, [&](int i) {
    const double m = f.mass.data[i] / (h * h), spin = f.spin.data[i] / (h * h), c = f.drag.data[i] / h;
    const D3 at = load(x + 3 * i);
    store(g + 4 * i, m * (at - load(f.aim.data + 3 * i)) + c * (at - load(f.start.data + 3 * i)));
    g[4 * i + 3] = spin * turn[i];
    for (int k = 0; k < H.per; ++k) H.at(H.of(i, k), H.of(i, k)) = k < 3 ? m + c : spin;
  });
  each_lane(f.nnode, nodes_of(f), [&](int i) {
    store(g + 4 * i, 1.0 / (h * h) * load(x + 3 * i));
    g[4 * i + 3] = 0.0;
    for (int k = 0; k < H.per; ++k) H.at(H.of(i, k), H.of(i, k)) = 1.0 / (h * h);
  });
  add_rod(f, x, turn, g, H, exact);
  contacts_energy(f, x, h, g, &H, exact);
  ties_energy(f, x, g, &H);
}

// Takes unknowns out that do not change.
template <class Fields>
PALPATE void hold(const Fields& f, double* g, const RodMatrix& H) {
  int* held = f.below.data;
  const int count = each_after(4 * f.nnode, [&](int a, int at) {
    if (!f.held.data[a]) return 0;
    g[a] = 0.0;
    if (a % 4 >= H.per) return 0;
    if (at >= 0) held[at] = H.of(a / 4, a % 4);
    return 1;
  });
  if (!count) return;
  each_lane(0, H.n, [&](int a) {
    for (int k = 0; k < count; ++k)
      if (held[k] <= a && held[k] >= H.first[a]) H.row(a)[held[k]] = 0.0;
  });
  each_lane(0, count, [&](int k) {
    for (int b = H.first[held[k]]; b < held[k]; ++b) H.row(held[k])[b] = 0.0;
    H.at(held[k], held[k]) = 1.0;
  });
}

template <class Fields>
PALPATE bool factorize_nodes(const Fields& f) {
  const RodMatrix H = matrix_of(f);
  return f.twists ? factorize<4>(H, f.ranked.data) : factorize<3>(H, f.ranked.data);
}

// A^-1 b in place of b, four numbers a node, from the factors.
template <class Fields>
PALPATE void solve_nodes(const Fields& f, double* b) {
  const RodMatrix H = matrix_of(f);
  double* y = f.ranked.data;
  each_lane(0, nodes_of(f), [&](int i) {
    for (int c = 0; c < H.per; ++c) y[H.of(i, c)] = b[4 * i + c];
  });
  if (f.twists) solve_factorized<4>(H, y);
  else solve_factorized<3>(H, y);
  each_lane(0, nodes_of(f), [&](int i) {
    for (int c = 0; c < 4; ++c) b[4 * i + c] = c < H.per ? y[H.of(i, c)] : 0.0;
  });
}

// Starts from where the nodes go with their velocity, as far as they do not meet.
template <class Fields>
PALPATE void predict(const Fields& f, double h) {
  each_lane(0, f.nnode, [&](int i) { store(f.trial.data + 3 * i, h * load(f.vel.data + 3 * i)); });
  const double part = safe_part(f, f.start.data, f.trial.data, 3);
  each_lane(0, 3 * f.nnode, [&](int a) { f.place.data[a] = f.start.data[a] + part * f.trial.data[a]; });
  each_lane(3 * f.nnode, 3 * nodes_of(f), [&](int a) { f.place.data[a] = 0.0; });
}

// Takes the step from f.start and f.vel: f.place and f.turn are where it ends, f.predicted the force of
// the constraints there. Returns how many iterations it took, more than `newton` if it is not solved, or -1 where
// nothing finite was found.
template <class Fields>
PALPATE int step_rod(const Fields& f, double h) {
  const int n = nodes_of(f);
  double* x = f.place.data;
  double* turn = f.turn.data;
  double* g = f.gradient.data;
  double* trial = f.trial.data;
  double* trial_turn = f.trial.data + 3 * n;
  const double reach = reach_of(f, h);
  one_lane([&] { f.reach.data[0] = reach; });
  list_pairs(f, f.start.data);
  note_pressure(f);
  predict(f, h);
  double cost = step_cost(f, x, turn, h);
  each_lane(0, f.nnode - 1, [&](int i) { f.pull.data[i] = tension_of(f, f.start.data, i); });
  int iteration = 0;
  for (; iteration < f.newton; ++iteration) {
    if (is_stale(f, x)) {
      list_pairs(f, x);
      note_pressure(f);
      cost = step_cost(f, x, turn, h);
    }
    const RodMatrix H = matrix_of(f);
    bool exact = true;
    for (;; exact = false) {
      assemble(f, x, turn, h, g, exact);
      rows_cost(f, x, h, g, &H);
      hold(f, g, H);
      each_lane(0, 4 * n, [&](int a) { f.move.data[a] = -g[a]; });
      if (factorize_nodes(f)) break;
      if (!exact) return -1;
    }
    solve_nodes(f, f.move.data);
    double falls = 0.0, most = 0.0;
    each_lane(0, 4 * n, [&](int a) { falls += g[a] * f.move.data[a]; });
    each_lane(0, f.nnode, [&](int i) {
      const double far = norm(load(f.move.data + 4 * i));
      most = far > most ? far : most;
    });
    falls = sum_together(falls), most = most_together(most);
    if (!(falls == falls) || !(most < 1e6)) return -1;
    const double whole = safe_part(f, x, f.move.data, 4);
    const double before = cost;
    double part = whole;
    for (int k = 0; k < HALVINGS; ++k, part *= 0.5) {
      each_lane(0, n, [&](int i) {
        store(trial + 3 * i, load(x + 3 * i) + part * load(f.move.data + 4 * i));
        if (i < f.nnode) trial_turn[i] = turn[i] + part * f.move.data[4 * i + 3];
      });
      const double most = cost + SLOPE * part * falls;
      const bool flat = -part * falls < 1e-13 * cost;
      const double next = step_cost(f, trial, trial_turn, h, flat ? ENDLESS : most);
      if (next <= most || flat) {
        cost = next;
        break;
      }
    }
    each_lane(0, f.nnode - 1, [&](int i) {
      f.pull.data[i] = part == 1.0 ? expected_tension(f, x, f.move.data, i) : tension_of(f, trial, i);
    });
    each_lane(0, 3 * n, [&](int a) { x[a] = trial[a]; });
    each_lane(0, f.nnode, [&](int i) { turn[i] = trial_turn[i]; });
    // A move that was cut short by contacts is not the last one.
    const bool foreseen = part == 1.0 && fabs(before - cost + 0.5 * falls) < FORESEEN * -falls;
    const bool ends = whole == 1.0 && part * most < (foreseen ? CLOSE : STALLED) * f.radius;
    if (ends || -falls < ROUNDED * cost) return iteration + 1;
  }
  return f.newton + 1;
}

}  // namespace palpate
