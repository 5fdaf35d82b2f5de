// The coupling of a rod to MuJoCo.
//
// The rod's step is taken with the constraints that MuJoCo has found for this step, on bodies that move on as
// they did; those that an equality joins to it yield to its force, as far as other constraints do not hold them. So it
// reaches MuJoCo as a force on its nodes,
//
//   qfrc_passive = Mhat (v1 - v) / h - f_ext - f_c,
//
// with f_c the force of the constraints in the rod's step and Mhat the inertia that one node alone has in it.
// MuJoCo's solver, for which Mhat is the nodes' inertia, finds f_c again unless other bodies move otherwise; by
// what it differs the rod then moves on by its own response A. An error of a body of mass M becomes
// (A - Mhat) / (M + Mhat) of it, and one of the rod Mhat M / ((M + Mhat) A): so Mhat is that of the direction in
// which the rod gives way most.
//
// A `Host` is the rod, `rod`, and the dofs and rows of constraints of its world: those in MuJoCo's memory
// (`mujoco_rod.h`).
#pragma once
#include "coupling/node.h"
#include "solver/rod_step.h"

AS_WRITTEN

namespace palpate {

// A row's numbers and their dofs; null where these are all.
template <class Number>
struct RowOf { Number* value; const int* dof; int count; };

// The first node of the rod that a row reaches, or NOWHERE, or APART: more than two that are neighbours.
constexpr int NOWHERE = -1, APART = -2;
template <class Host, class Row>
PALPATE int first_node(const Host& host, Row row) {
  int first = -1, last = -1;
  for (int k = 0; k < row.count; ++k) {
    const int own = host.own_dof(row.dof ? row.dof[k] : k);
    if (own < 0 || row.value[k] == 0.0) continue;
    if (first < 0 || own / 3 < first) first = own / 3;
    if (own / 3 > last) last = own / 3;
  }
  return last - first > 1 ? APART : first;
}

// Most dofs of what an equality joins to a rod; others stand still in its step.
constexpr int MOST_DOFS = 16;

// What an equality joins to the rod, by its dofs: how it gives way to a force. It does so against its inertia and against
// the constraints that held it in the last step: a needle weighs little beside the jaws that hold it. Their other side
// gives way by each of its dofs alone.
template <class Host>
struct Joined {
  const Host& host;
  int count = 0, dof[MOST_DOFS];
  double L[MOST_DOFS][MOST_DOFS];  // lower triangle: inertia, then its factor by Cholesky

  PALPATE int find(int d) const {
    for (int k = 0; k < count; ++k)
      if (dof[k] == d) return k;
    return -1;
  }
  PALPATE double inertia(int d) const { return host.M()[host.f.M_rowadr.data[d] + host.f.M_rownnz.data[d] - 1]; }

  // Takes the dofs of a row that are not the rod's.
  template <class Row>
  PALPATE void take(Row row) {
    for (int k = 0; k < row.count; ++k) {
      const int d = row.dof ? row.dof[k] : k;
      if (row.value[k] == 0.0 || host.own_dof(d) >= 0 || find(d) >= 0 || count == MOST_DOFS) continue;
      dof[count] = d;
      for (int b = 0; b <= count; ++b) L[count][b] = 0.0;
      ++count;
    }
  }
  PALPATE void weigh() {
    for (int a = 0; a < count; ++a)
      for (int k = 0; k < host.f.M_rownnz.data[dof[a]]; ++k) {
        const int at = host.f.M_rowadr.data[dof[a]] + k, b = find(host.f.M_colind.data[at]);
        if (b >= 0) L[a > b ? a : b][a > b ? b : a] = host.M()[at];
      }
  }
  // Adds what row `r` holds it by, where that bore in the last step or does always; returns whether it did.
  PALPATE bool hold(int r, bool always) {
    const auto row = host.row(r);
    double J[MOST_DOFS] = {}, gives = 0.0, goes = 0.0;
    bool here = false;
    for (int k = 0; k < row.count; ++k) {
      const int d = row.dof ? row.dof[k] : k, own = find(d);
      if (row.value[k] == 0.0) continue;
      if (host.own_dof(d) >= 0) return false;
      goes += row.value[k] * host.last_acceleration(d);
      if (own >= 0) J[own] = row.value[k], here = true;
      else gives += row.value[k] * row.value[k] / inertia(d);
    }
    if (!here || !(always || goes < host.reference(r))) return false;
    gives += 1.0 / host.stiffness(r);
    for (int a = 0; a < count; ++a)
      for (int b = 0; b <= a; ++b) L[a][b] += J[a] * J[b] / gives;
    return true;
  }
  PALPATE void factorize() {
    for (int a = 0; a < count; ++a)
      for (int b = 0; b <= a; ++b) {
        double sum = L[a][b];
        for (int k = 0; k < b; ++k) sum -= L[a][k] * L[b][k];
        L[a][b] = a == b ? sqrt(sum) : sum / L[b][b];
      }
  }
  // J M^-1 J^T of a row [1/kg].
  template <class Row>
  PALPATE double yields(Row row) const {
    double x[MOST_DOFS] = {}, sum = 0.0;
    for (int k = 0; k < row.count; ++k) {
      const int a = find(row.dof ? row.dof[k] : k);
      if (a >= 0) x[a] = row.value[k];
    }
    for (int a = 0; a < count; ++a) {
      for (int b = 0; b < a; ++b) x[a] -= L[a][b] * x[b];
      x[a] /= L[a][a];
      sum += x[a] * x[a];
    }
    return sum;
  }
};

// Notes MuJoCo's row `r` where it acts on the rod; returns whether it does. A row of a cone that turns others
// about the contact does not reach nodes, and is one of the node `cone`.
template <class Host>
PALPATE bool note_row(const Host& host, int r, int kind, double friction, int cone = NOWHERE) {
  const auto& rod = host.rod;
  const int at = rod.count.data[0];
  const auto row = host.row(r);
  const int reached = first_node(host, row), node = reached == NOWHERE ? cone : reached;
  if (node < 0 || at >= rod.most_rows) return false;
  double* J = rod.row_value.data + (DOFS + 3) * at;
  double sum = -host.reference(r);
  for (int k = 0; k < DOFS; ++k) J[k] = 0.0;
  for (int k = 0; k < row.count; ++k) {
    if (row.value[k] == 0.0) continue;
    const int dof = row.dof ? row.dof[k] : k, own = host.own_dof(dof);
    if (own >= 0)
      J[own - 3 * node] = row.value[k];
    else
      sum += row.value[k] * host.last_acceleration(dof);
  }
  J[DOFS] = sum;
  J[DOFS + 1] = host.stiffness(r);
  J[DOFS + 2] = friction;
  rod.row_node.data[at] = node;
  rod.row_kind.data[at] = kind;
  rod.count.data[0] = at + 1;
  return true;
}

// Notes by which tree of bodies an equality holds each node, or one near it along the thread; NOWHERE if by none.
template <class Host>
PALPATE void note_grips(const Host& host, int nefc, const int* type) {
  const auto& rod = host.rod;
  for (int i = 0; i < rod.nnode; ++i) rod.grip.data[i] = NOWHERE;
  for (int r = 0; r < nefc; ++r) {
    if (type[r] != IS_EQUALITY) continue;
    const auto row = host.row(r);
    const int node = first_node(host, row);
    if (node < 0) continue;
    int tree = NOWHERE;
    for (int k = 0; k < row.count; ++k) {
      const int dof = row.dof ? row.dof[k] : k;
      if (row.value[k] != 0.0 && host.own_dof(dof) < 0) tree = host.f.dof_tree.data[dof];
    }
    for (int i = 0; i < rod.nnode && tree >= 0; ++i)
      if (fabs(rod.along.data[i] - rod.along.data[node]) <= GRIP * rod.radius) rod.grip.data[i] = tree;
  }
}

// Notes the rows of a contact, of a cone where `mu` says so: whole or not at all.
template <class Host, class Number>
PALPATE void note_contact(const Host& host, int first, int count, bool cone, double mu, const Number* friction) {
  const int before = host.rod.count.data[0];
  for (int k = 0; k < count; ++k) {
    const double slope = !cone ? 0.0 : k ? (double)friction[k - 1] : mu;
    const int node = cone && k ? host.rod.row_node.data[before] : NOWHERE;
    const bool noted = note_row(host, first + k, !cone ? ONE : k ? FRICTION : CONE, slope, node);
    if (noted || !cone) continue;
    host.rod.count.data[0] = before;
    break;
  }
}

// Notes the rows of an equality, from `r` on. What it joins to the rod does not go on as it did: from its last
// acceleration the row's last force is taken off, and it gives way to the new one. It does so by as much as in all
// rows together, no less than in any direction: too little would overshoot.
template <class Host>
PALPATE void note_equality(const Host& host, int r, int count, int nefc, const int* type, const int* id) {
  const auto& rod = host.rod;
  const int from = rod.count.data[0];
  for (int k = 0; k < count; ++k) note_row(host, r + k, BOTH, 0.0);
  if (rod.count.data[0] == from) return;
  Joined<Host> other{host};
  for (int k = 0; k < count; ++k) other.take(host.row(r + k));
  other.weigh();
  bool held = false;
  for (int k = 0; k < nefc; ++k) {
    if (type[k] != IS_EQUALITY && type[k] < IS_LIMIT) continue;  // friction of joints
    const bool tangent = k > 0 && type[k] == CONTACT_ELLIPTIC && type[k - 1] == type[k] && id[k - 1] == id[k];
    if (tangent && held) other.hold(k, true);
    if (!tangent) held = other.hold(k, type[k] == IS_EQUALITY);
  }
  other.factorize();
  double way = 0.0;
  for (int k = 0; k < count; ++k) way += other.yields(host.row(r + k));
  for (int at = from; at < rod.count.data[0]; ++at) {
    double* J = rod.row_value.data + (DOFS + 3) * at;
    const double* last = rod.own.force.data + 3 * rod.row_node.data[at];
    double before = 0.0, length2 = 0.0;
    for (int k = 0; k < DOFS; ++k) {
      if (J[k] == 0.0) continue;
      before += J[k] * last[k];
      length2 += J[k] * J[k];
    }
    J[DOFS] -= way * before / length2;
    J[DOFS + 1] /= 1.0 + J[DOFS + 1] * way;
  }
}

// Notes the rows of equalities, and of limits.
template <class Host>
PALPATE void note_joints(const Host& host, int nefc, const int* type, const int* id) {
  for (int r = 0, count = 1; r < nefc; r += count) {
    for (count = 1; type[r] == IS_EQUALITY && r + count < nefc && type[r + count] == IS_EQUALITY && id[r + count] == id[r];)
      ++count;
    if (type[r] == IS_EQUALITY) note_equality(host, r, count, nefc, type, id);
    if (type[r] == IS_LIMIT) note_row(host, r, ONE, 0.0);
  }
}

template <class Rod>
PALPATE Envelope inverse_of(const Rod& rod) {
  return {rod.inverse.data, rod.first.data, rod.start_of_row.data, matrix_of(rod).n};
}

// An inertia of a node alone in the rod's step that is no more than in any direction, and no less than a third of
// the least, from the inverse of the rod's matrix; no less than its mass.
template <class Rod>
PALPATE double alone(const Rod& rod, int i, double h) {
  double trace = 0.0;
  for (int c = 0; c < 3; ++c) {
    const int a = matrix_of(rod).of(i, c);
    trace += inverse_of(rod).at(a, a);
  }
  const double found = h * h / trace, mass = rod.mass.data[i];
  return found > mass ? found : mass;
}

// Takes the rod's step, and adds the passive force that brings it through MuJoCo's.
template <class Host>
PALPATE void begin(const Host& host, double h) {
  const auto& rod = host.rod;
  const int n = 4 * rod.nnode;
  host.gather(h);
  one_lane([&] {
    rod.count.data[0] = 0;
    host.note_rows();
  });
  const int status = step_rod(rod, h);
  ties_energy(rod, rod.place.data, nullptr, nullptr);
  const bool ok = status >= 0, touched = ok && rod.count.data[0] > 0;
  one_lane([&] { rod.status.data[0] = status; });
  if (!ok)  // holds still for this step instead of spreading the damage
    each_lane(0, 3 * rod.nnode, [&](int a) { rod.place.data[a] = rod.start.data[a]; });
  if (touched) {
    const RodMatrix H = matrix_of(rod);
    one_lane([&] { lay_out(rod, rod.place.data); });
    each_lane(0, n, [&](int a) { rod.force.data[a] = 0.0; });
    rows_cost(rod, rod.place.data, h, rod.force.data, &H);
    // What is not positive is left out: a thread about to buckle gives way at once, and tools would meet nothing.
    assemble(rod, rod.place.data, rod.turn.data, h, rod.gradient.data, false);
    hold(rod, rod.gradient.data, H);
    factorize_nodes(rod);
    invert_there(H, inverse_of(rod), rod.below.data, rod.ranked.data);
  }
  each_lane(0, rod.nnode, [&](int i) {
    if (!host.moves(i)) return;
    D3 Mhat = host.inertia(i);
    if (touched) {
      const double inertia = alone(rod, i, h);
      host.set_inertia(i, Mhat = {inertia, inertia, inertia});
    }
    const D3 dv = (1.0 / h) * (load(rod.place.data + 3 * i) - load(rod.start.data + 3 * i)) - load(rod.vel.data + 3 * i);
    const D3 acceleration = (1.0 / h) * dv, rate = {Mhat.x * acceleration.x, Mhat.y * acceleration.y, Mhat.z * acceleration.z};
    const D3 lagged = load(rod.external.data + 3 * i) - (touched ? load(rod.force.data + 4 * i) : D3{0.0, 0.0, 0.0});
    host.push(i, passive(rate, lagged), acceleration);
  });
}

// Whether a contact, whose two sides are told, is not to be: of an edge of the rod that has broken, or of one that
// is in what holds it.
template <class Host>
PALPATE bool is_open(const Host& host, const int* flex, const int* elem, const int* geom) {
  const auto& rod = host.rod;
  for (int side = 0; side < 2; ++side) {
    const int edge = elem[side], other = geom[1 - side];
    if (flex[side] != host.f.flex || edge < 0) continue;
    if (!is_whole(rod, edge)) return true;
    const int tree = other < 0 ? NOWHERE : host.f.geom_tree.data[other];
    if (tree >= 0 && (rod.grip.data[edge] == tree || rod.grip.data[edge + 1] == tree)) return true;
  }
  return false;
}

// Breaks the edge with the highest tension at the end of a step, if that is more than it bears.
template <class Rod>
PALPATE void break_edge(const Rod& rod) {
  int weakest = -1;
  double most = rod.strength;
  for (int i = 0; i + 1 < rod.nnode && rod.strength > 0.0; ++i) {
    const double tension = tension_of(rod, rod.place.data, i);
    if (tension > most) most = tension, weakest = i;
  }
  if (weakest < 0) return;
  rod.own.broken.data[weakest] = 1.0;
  rod.own.twist.data[weakest] = 0.0;  // of its two nodes
  rod.own.twist.data[weakest + 1] = 0.0;
}

// Ends the step: by the rod's own response to what MuJoCo found otherwise.
template <class Host>
PALPATE void end(const Host& host, double h) {
  const auto& rod = host.rod;
  if (rod.count.data[0] > 0 && rod.status.data[0] >= 0) {
    each_lane(0, rod.nnode, [&](int i) {
      const D3 found = host.moves(i) ? host.found(i) : D3{0.0, 0.0, 0.0};
      store(rod.move.data + 4 * i, host.moves(i) ? found + load(rod.force.data + 4 * i) : found);
      rod.move.data[4 * i + 3] = 0.0;
    });
    solve_nodes(rod, rod.move.data);
    const double part = safe_part(rod, rod.place.data, rod.move.data, 4);
    each_lane(0, rod.nnode, [&](int i) {
      store(rod.place.data + 3 * i, load(rod.place.data + 3 * i) + part * load(rod.move.data + 4 * i));
      rod.turn.data[i] += part * rod.move.data[4 * i + 3];
    });
  }
  const int inner = rod.twists ? rod.nnode - 1 : 0;
  each_lane(1, inner, [&](int i) { rod.trial.data[i] = twist_at(rod, rod.place.data, rod.turn.data, i); });
  each_lane(1, inner, [&](int i) { rod.own.twist.data[i] = is_joint(rod, i) ? rod.trial.data[i] : 0.0; });
  one_lane([&] { break_edge(rod); });
  each_lane(0, rod.nnode, [&](int i) {
    if (!host.moves(i)) return;
    store(rod.own.force.data + 3 * i, host.found(i));
    host.move(i, load(rod.place.data + 3 * i) - load(rod.start.data + 3 * i), h);
  });
}

}  // namespace palpate
