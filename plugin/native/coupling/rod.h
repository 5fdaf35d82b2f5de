// The coupling of a rod to MuJoCo.
//
// The rod's step is taken with the constraints that MuJoCo has found for this step, and with the bodies that these
// reach: they yield to it by their inertia, as far as other constraints do not hold them. Jaws of 20 g that met the
// 0.8 kg of a taut thread, its stiffness times h^2, would be thrown off by a force that they never pressed with.
// So the step leads to v1 and to the force f_c of the constraints. Both reach MuJoCo: the rows give way so much that
// they press with f_c whatever else its solver finds, and the nodes have
//
//   qfrc_passive = M (v1 - v) / h - f_ext - f_c.
//
// Vertices of an organ yield too. Rows that reach what the rod's step cannot move, such as another rod, are FREE: MuJoCo
// finds their force anew. Then the nodes have in it the inertia Mhat that one node alone has in the rod's step, in place of M, and by
// what the force differs the rod moves on by its own response A. An error of a body of mass M becomes
// (A - Mhat) / (M + Mhat) of it, and one of the rod Mhat M / ((M + Mhat) A): so Mhat is that of the direction in
// which the rod gives way most.
//
// A `Host` is the rod, `rod`, and the dofs and rows of constraints of its world: those in MuJoCo's memory
// (`mujoco_rod.h`).
#pragma once
#include "coupling/node.h"
#include "solver/rod_refine.h"

AS_WRITTEN

namespace palpate {

// A row's numbers and their dofs; null where these are all.
template <class Number>
struct RowOf { Number* value; const int* dof; int count; };

// In place of a node of the rod: of a row that reaches none, and of one that reaches more than two that are neighbours.
constexpr int NOWHERE = -1, APART = -2;
// In place of a tree: of a row whose force MuJoCo finds, and of one that reaches vertices of an organ.
constexpr int FREE = -3, VERTICES = -4;
enum Other { A_BODY, AN_ORGAN, A_ROD };  // what a contact is with

// What it is, by the flexes of both sides, -1 for a geom.
template <class Fields>
PALPATE Other other_of(const Fields& f, const int* flex) {
  const int other = flex[flex[0] == f.flex];
  return other < 0 ? A_BODY : f.flex_dim.data[other] == 1 ? A_ROD : AN_ORGAN;
}

// The first node of the rod that a row reaches, or what is in place of it.
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

// A tree of bodies that yields to the rod in its step, by those of its dofs that the rod's constraints reach, up to
// REACH; others stand still. It does so against its inertia, with damping as MuJoCo's integrators have it, and against
// the other constraints that held it in the last step: a needle weighs little beside the jaws that hold it. Their other
// side yields by each of its dofs alone.
template <class Host>
struct Tree {
  const Host& host;
  int count = 0, dof[REACH];
  double L[REACH][REACH];  // lower triangle: inertia, then its factor by Cholesky
  double change[REACH];  // L^-1 of the force that is known now, less that and the rod's in the last step

  PALPATE int find(int d) const {
    for (int k = 0; k < count; ++k)
      if (dof[k] == d) return k;
    return -1;
  }
  PALPATE double inertia(int d) const { return host.M()[host.f.M_rowadr.data[d] + host.f.M_rownnz.data[d] - 1]; }

  // Whether a row reaches dofs that are not the rod's nor taken.
  template <class Row>
  PALPATE bool lacks(Row row) const {
    for (int k = 0; k < row.count; ++k) {
      const int d = row.dof ? row.dof[k] : k;
      if (row.value[k] != 0.0 && host.own_dof(d) < 0 && find(d) < 0) return count < REACH;
    }
    return false;
  }
  // Takes the dofs of a row that are not the rod's.
  template <class Row>
  PALPATE void take(Row row) {
    for (int k = 0; k < row.count; ++k) {
      const int d = row.dof ? row.dof[k] : k;
      if (row.value[k] == 0.0 || host.own_dof(d) >= 0 || find(d) >= 0 || count == REACH) continue;
      dof[count] = d;
      for (int b = 0; b <= count; ++b) L[count][b] = 0.0;
      ++count;
    }
  }
  PALPATE void weigh(double h) {
    for (int a = 0; a < count; ++a) {
      for (int k = 0; k < host.f.M_rownnz.data[dof[a]]; ++k) {
        const int at = host.f.M_rowadr.data[dof[a]] + k, b = find(host.f.M_colind.data[at]);
        if (b >= 0) L[a > b ? a : b][a > b ? b : a] = host.M()[at];
      }
      L[a][a] += h * host.damping(dof[a]);
    }
  }
  // What a row holds it by.
  struct Hold {
    double J[REACH], gives;
    int row;
  };
  // Finds what row `r` holds it by, where that bore in the last step or does always; returns whether it did.
  PALPATE bool holds(int r, bool always, Hold& own) const {
    const auto row = host.row(r);
    double goes = 0.0;
    bool here = false;
    own.gives = 0.0;
    own.row = r;
    for (int a = 0; a < REACH; ++a) own.J[a] = 0.0;
    for (int k = 0; k < row.count; ++k) {
      const int d = row.dof ? row.dof[k] : k, at = find(d);
      if (row.value[k] == 0.0) continue;
      if (host.own_dof(d) >= 0) return false;
      goes += row.value[k] * host.last_acceleration(d);
      if (at >= 0) own.J[at] = row.value[k], here = true;
      else own.gives += row.value[k] * row.value[k] / inertia(d);
    }
    if (!here || !(always || goes < host.reference(r))) return false;
    own.gives += 1.0 / host.stiffness(r);
    return true;
  }
  PALPATE void hold_by(const Hold& own) {
    for (int a = 0; a < count; ++a)
      for (int b = 0; b <= a; ++b) L[a][b] += own.J[a] * own.J[b] / own.gives;
  }
  // Adds all that holds it.
  PALPATE void hold(int nefc, const int* type, const int* id) {
    const auto is_tangent = [&](int k) {
      return k > 0 && k < nefc && type[k] == CONTACT_ELLIPTIC && type[k - 1] == type[k] && id[k - 1] == id[k];
    };
    const auto finds = [&](int k, Hold& own) {
      if (type[k] != IS_EQUALITY && type[k] < IS_LIMIT) return false;  // friction of joints
      return !is_tangent(k) && holds(k, type[k] == IS_EQUALITY, own);
    };
    each_in_turn<Hold>(nefc, finds, [&](const Hold& own) {
      hold_by(own);
      Hold tangent;
      for (int k = own.row + 1; is_tangent(k); ++k)
        if (holds(k, true, tangent)) hold_by(tangent);
    });
  }
  // Factorizes its inertia, and finds by what the force on it has changed.
  PALPATE void factorize() {
    for (int a = 0; a < count; ++a)
      for (int b = 0; b <= a; ++b) {
        double sum = L[a][b];
        for (int k = 0; k < b; ++k) sum -= L[a][k] * L[b][k];
        L[a][b] = a == b ? sqrt(sum) : sum / L[b][b];
      }
    const auto& rod = host.rod;
    for (int a = 0; a < count; ++a) change[a] = rod.known.data[dof[a]] - rod.own.pushed.data[dof[a]];
    solve(change);
  }
  PALPATE void solve(double* x) const {  // by the lower factor
    for (int a = 0; a < count; ++a) {
      for (int b = 0; b < a; ++b) x[a] -= L[a][b] * x[b];
      x[a] /= L[a][a];
    }
  }
  // Writes L^-1 J^T of a row to x, REACH long.
  template <class Row>
  PALPATE void reach(Row row, double* x) const {
    for (int a = 0; a < REACH; ++a) x[a] = 0.0;
    for (int k = 0; k < row.count; ++k) {
      const int a = row.value[k] == 0.0 ? -1 : find(row.dof ? row.dof[k] : k);
      if (a >= 0) x[a] = row.value[k];
    }
    solve(x);
  }
};

// Notes MuJoCo's row `r` as the rod's row `at`, see `each_after`, where it acts on the rod; returns the node, or less than
// 0 where it does not. A row of a cone that turns others about the contact does not reach nodes, and is one of the node
// `cone`.
template <class Host>
PALPATE int note_row(const Host& host, int at, int r, int kind, double friction, int cone = NOWHERE) {
  const auto& rod = host.rod;
  const auto row = host.row(r);
  const int reached = first_node(host, row), node = reached == NOWHERE ? cone : reached;
  if (node < 0 || at < 0 || at >= rod.most_rows) return node;
  double* J = rod.row_value.data + (DOFS + 3) * at;
  double sum = -host.reference(r);
  int tree = NOWHERE;
  for (int k = 0; k < DOFS; ++k) J[k] = 0.0;
  for (int k = 0; k < row.count; ++k) {
    if (row.value[k] == 0.0) continue;
    const int dof = row.dof ? row.dof[k] : k, own = host.own_dof(dof);
    if (own >= 0)
      J[own - 3 * node] = row.value[k];
    else
      sum += row.value[k] * host.last_acceleration(dof), tree = host.f.dof_tree.data[dof];
  }
  J[DOFS] = sum;
  J[DOFS + 1] = host.stiffness(r);
  J[DOFS + 2] = friction;
  rod.row_node.data[at] = node;
  rod.row_kind.data[at] = kind;
  rod.row_efc.data[at] = r;
  rod.row_tree.data[at] = tree;
  for (int k = 0; k < STANDINS; ++k) rod.row_yields.data[STANDINS * at + k] = NOWHERE;
  return node;
}

// Notes rows by puts(k, at) for each k up to n, see `each_after`, as far as there is room.
template <class Rod, class Puts>
PALPATE void note_each(const Rod& rod, int n, Puts puts) {
  const int before = rod.count.data[0];
  const int all = before + each_after(n, [&](int k, int at) { return puts(k, at < 0 ? at : before + at); });
  one_lane([&] { rod.count.data[0] = all < rod.most_rows ? all : rod.most_rows; });
}

// Notes by which tree of bodies an equality holds each node, or one near it along the thread; NOWHERE if by none.
template <class Host>
PALPATE void note_grips(const Host& host, int nefc, const int* type) {
  const auto& rod = host.rod;
  struct Grip { int node, tree; };
  each_lane(0, rod.nnode, [&](int i) { rod.grip.data[i] = NOWHERE; });
  const auto grips = [&](int r, Grip& own) {
    if (type[r] != IS_EQUALITY) return false;
    const auto row = host.row(r);
    own = {first_node(host, row), NOWHERE};
    for (int k = 0; k < row.count && own.node >= 0; ++k) {
      const int dof = row.dof ? row.dof[k] : k;
      if (row.value[k] != 0.0 && host.own_dof(dof) < 0) own.tree = host.f.dof_tree.data[dof];
    }
    return own.tree >= 0;
  };
  each_in_turn<Grip>(nefc, grips, [&](const Grip& own) {
    each_lane(0, rod.nnode, [&](int i) {
      if (fabs(rod.along.data[i] - rod.along.data[own.node]) <= GRIP * rod.radius) rod.grip.data[i] = own.tree;
    });
  });
}

// Notes the rows of a contact from the rod's row `before` on, of a cone where `mu` says so, whole or not at all; returns
// how many there are.
template <class Host, class Number>
PALPATE int note_contact(
    const Host& host, int before, int first, int count, bool cone, double mu, const Number* friction, Other other) {
  int noted = 0, node = NOWHERE;
  for (int k = 0; k < count; ++k) {
    const double slope = !cone ? 0.0 : k ? (double)friction[k - 1] : mu;
    const int at = before < 0 ? before : before + noted;
    const int found = note_row(host, at, first + k, !cone ? ONE : k ? FRICTION : CONE, slope, node);
    if (found < 0 && cone) return 0;
    if (found < 0) continue;
    if (cone && !k) node = found;
    ++noted;
  }
  int* tree = host.rod.row_tree.data;  // of all rows alike: a slide's normal may reach what its tangents do not
  int reached = NOWHERE;
  const int end = before < 0 ? before : before + noted < host.rod.most_rows ? before + noted : host.rod.most_rows;
  for (int at = before; at < end; ++at) reached = tree[at] > reached ? tree[at] : reached;
  for (int at = before; at < end; ++at) tree[at] = other == A_BODY ? reached : other == AN_ORGAN ? VERTICES : FREE;
  return noted;
}

// Notes the rows of equalities, and of limits.
template <class Host>
PALPATE void note_joints(const Host& host, int nefc, const int* type) {
  note_each(host.rod, nefc, [&](int r, int at) {
    if (type[r] != IS_EQUALITY && type[r] != IS_LIMIT) return 0;
    return note_row(host, at, r, type[r] == IS_EQUALITY ? BOTH : ONE, 0.0) < 0 ? 0 : 1;
  });
}

// Lets the tree of bodies that row `first` reaches yield in the rod's step, by coordinates in which its inertia is
// 1 kg, three to a node. Without the rod it accelerates as in the last step, but for what the force that is known has
// changed and for what the rod did. The rows of a tree for which there is no room are free.
template <class Host>
PALPATE void yield_tree(const Host& host, int first, double h, int nefc, const int* type, const int* id) {
  const auto& rod = host.rod;
  const int n = rod.count.data[0], tree = rod.row_tree.data[first], node = nodes_of(rod);
  if (node + REACH / 3 > rod.most_nodes) {
    each_lane(first, n, [&](int at) {
      if (rod.row_tree.data[at] == tree) rod.row_tree.data[at] = FREE;
    });
    return;
  }
  Tree<Host> other{host};  // of all lanes alike
  const auto adds = [&](int k, int& own) {
    own = rod.row_efc.data[first + k];
    return rod.row_tree.data[first + k] == tree && other.lacks(host.row(own));
  };
  each_in_turn<int>(n - first, adds, [&](int r) { other.take(host.row(r)); });
  const int stands = (other.count + 2) / 3;
  one_lane([&] {
    for (int k = 0; k < stands; ++k) rod.stands.data[node + k] = NOWHERE;
    rod.count.data[3] += stands;
  });
  other.weigh(h);
  other.hold(nefc, type, id);
  other.factorize();
  each_lane(first, n, [&](int at) {
    if (rod.row_tree.data[at] != tree) return;
    double* J = rod.row_body.data + REACH * at;
    const auto row = host.row(rod.row_efc.data[at]);
    other.reach(row, J);
    double& rest = rod.row_value.data[(DOFS + 3) * at + DOFS];
    for (int k = 0; k < row.count; ++k) {
      const int d = row.dof ? row.dof[k] : k;
      if (row.value[k] != 0.0 && host.own_dof(d) < 0)
        rest += row.value[k] * (rod.own.accelerated.data[d] - host.last_acceleration(d));
    }
    for (int a = 0; a < other.count; ++a) rest += J[a] * other.change[a];
    for (int k = 0; k < stands; ++k) rod.row_yields.data[STANDINS * at + k] = node + k;
  });
}

// The node that stands for a vertex of an organ whose first dof is told, or NOWHERE if there is no room for one.
template <class Rod>
PALPATE int stand_in(const Rod& rod, int dof) {
  const int n = nodes_of(rod);
  for (int node = rod.nnode; node < n; ++node)
    if (rod.stands.data[node] == dof) return node;
  if (n - rod.nnode >= rod.most_vertices) return NOWHERE;
  rod.stands.data[n] = dof;
  rod.count.data[3] += 1;
  return n;
}

// Lets the vertices of an organ that the rod's rows `first` up to `end` of a contact reach yield; returns whether there
// was room. Each yields as if its mass were alone. The tissue around it makes it heavier, in some directions a thousand
// times: it then gives way less than expected, and forces grow within a few steps to what they are. With more inertia
// than it has they would alternate and grow. What else acts on it does so as in the last step.
template <class Host>
PALPATE bool yield_contact(const Host& host, int first, int end) {
  const auto& rod = host.rod;
  int node[STANDINS], count = 0;
  const auto each_dof = [&](int at, auto&& act) {
    const auto row = host.row(rod.row_efc.data[at]);
    for (int k = 0; k < row.count; ++k) {
      const int d = row.dof ? row.dof[k] : k;
      if (row.value[k] != 0.0 && host.own_dof(d) < 0) act(d, (double)row.value[k]);
    }
  };
  bool room = true;
  for (int at = first; at < end; ++at)
    each_dof(at, [&](int d, double) {
      if (!host.f.dof_vertex.data[d] || !room) return;
      const int stands = stand_in(rod, host.f.dof_first.data[d]);
      for (int c = 0; c < count; ++c)
        if (node[c] == stands) return;
      if (stands < 0 || count == STANDINS) room = false;
      else node[count++] = stands;
    });
  for (int at = first; at < end && room; ++at) {
    double* B = rod.row_body.data + REACH * at;
    double& rest = rod.row_value.data[(DOFS + 3) * at + DOFS];
    for (int k = 0; k < REACH; ++k) B[k] = 0.0;
    for (int c = 0; c < count; ++c) rod.row_yields.data[STANDINS * at + c] = node[c];
    each_dof(at, [&](int d, double value) {
      rest += value * (rod.own.accelerated.data[d] - host.last_acceleration(d));
      for (int c = 0; c < count; ++c) {
        const int axis = d - rod.stands.data[node[c]];
        if (axis < 0 || axis > 2) continue;
        const double per_mass = host.invweight(host.f.dof_vertex.data[d]);
        B[3 * c + axis] = sqrt(per_mass) * value;
        rest -= per_mass * value * rod.own.pushed.data[d];
      }
    });
  }
  return room;
}

// Lets all do that the noted rows reach. Rows for which there is no room are free.
template <class Host>
PALPATE void yield_vertices(const Host& host) {
  const auto& rod = host.rod;
  one_lane([&] {
    const int n = rod.count.data[0];
    int end;
    for (int first = 0; first < n; first = end) {
      end = first + 1;
      while (end < n && rod.row_kind.data[end] == FRICTION) ++end;
      if (rod.row_tree.data[first] != VERTICES || yield_contact(host, first, end)) continue;
      for (int at = first; at < end; ++at) rod.row_tree.data[at] = FREE;
    }
  });
}

// Lets the bodies that the noted rows reach yield.
template <class Host>
PALPATE void yield_trees(const Host& host, double h, int nefc, const int* type, const int* id) {
  const auto& rod = host.rod;
  for (int r = 0; r < rod.count.data[0]; ++r)
    if (rod.row_tree.data[r] >= 0 && rod.row_yields.data[STANDINS * r] < 0) yield_tree(host, r, h, nefc, type, id);
}

template <class Rod>
PALPATE Envelope inverse_of(const Rod& rod) {
  return {rod.inverse.data, rod.first.data, rod.start_of_row.data, rod.last.data, matrix_of(rod).n};
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

// J a - aref of a row as the rod's step ends.
template <class Rod>
PALPATE double residual_of(const Rod& rod, int at, double h) {
  return RodRow<Rod>{rod, at}.residual(rod.place.data, h);
}

// Lets MuJoCo's rows press as in the rod's step: each gives way so many times as much, about what it ends with.
template <class Host>
PALPATE void freeze(const Host& host, double h) {
  constexpr double SOFTER = 1e6;
  const auto& rod = host.rod;
  each_lane(0, rod.count.data[0], [&](int at) {
    if (rod.row_tree.data[at] == FREE) return;
    const int r = rod.row_efc.data[at];
    host.soften(r, SOFTER, host.reference(r) + (1.0 - SOFTER) * residual_of(rod, at, h));
  });
}

// Whether there is a row that is free.
template <class Rod>
PALPATE bool is_free(const Rod& rod) {
  for (int at = 0; at < rod.count.data[0]; ++at)
    if (rod.row_tree.data[at] == FREE) return true;
  return false;
}

// Takes the rod's step, and brings it and its forces through MuJoCo's.
template <class Host>
PALPATE void begin(const Host& host, double h) {
  const auto& rod = host.rod;
  if (rod.refine > 0.0) measure(rod);
  host.gather(h);
  each_lane(0, host.f.nv, [&](int d) {
    rod.known.data[d] = host.known(d);
    rod.speed.data[d] = host.speed(d);
  });
  one_lane([&] { rod.count.data[0] = rod.count.data[3] = 0; });
  host.note_rows(h);
  const int status = step_rod(rod, h);
  ties_energy(rod, rod.place.data, nullptr, nullptr);
  const bool ok = status >= 0, touched = ok && rod.count.data[0] > 0;
  one_lane([&] { rod.status.data[0] = status; });
  if (!ok)  // holds still for this step instead of spreading the damage
    each_lane(0, 3 * rod.nnode, [&](int a) { rod.place.data[a] = rod.start.data[a]; });
  bool free = false;
  if (touched) {
    const RodMatrix H = matrix_of(rod);
    lay_out(rod, rod.place.data);
    each_lane(0, 4 * nodes_of(rod), [&](int a) { rod.force.data[a] = 0.0; });
    rows_cost(rod, rod.place.data, h, rod.force.data, &H);
    freeze(host, h);
    free = is_free(rod);
  }
  if (free) {
    const RodMatrix H = matrix_of(rod);
    // What is not positive is left out: a thread about to buckle gives way at once, and tools would meet nothing.
    assemble(rod, rod.place.data, rod.turn.data, h, rod.gradient.data, false);
    hold(rod, rod.gradient.data, H);
    factorize_nodes(rod);
    invert_there(H, inverse_of(rod), rod.below.data, rod.ranked.data);
  }
  each_lane(0, rod.nnode, [&](int i) {
    if (!host.moves(i)) return;
    D3 Mhat = host.inertia(i);
    if (free) {
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

// Breaks the edge with the highest tension, if that is more than it bears as a step begins and as it ends: in a single step
// one that is as stiff as thread has peaks, where a strand that slips strikes another one.
template <class Rod>
PALPATE void break_edge(const Rod& rod) {
  const auto tension = [&](int i) {
    const double first = tension_of(rod, rod.start.data, i), last = tension_of(rod, rod.place.data, i);
    return first < last ? first : last;
  };
  double most = rod.strength;
  each_lane(0, rod.strength > 0.0 ? rod.nnode - 1 : 0, [&](int i) { most = tension(i) > most ? tension(i) : most; });
  most = most_together(most);
  if (!(most > rod.strength)) return;
  one_lane([&] {
    int weakest = 0;
    while (tension(weakest) != most) ++weakest;
    rod.own.broken.data[weakest] = 1.0;
    rod.own.twist.data[weakest] = 0.0;  // of its two nodes
    rod.own.twist.data[weakest + 1] = 0.0;
  });
}

// Keeps what pushed other bodies, of an organ's vertices what the rod did, and how they accelerated.
template <class Host>
PALPATE void note_pushed(const Host& host, double h) {
  const auto& rod = host.rod;
  each_lane(0, host.f.nv, [&](int d) {
    rod.own.pushed.data[d] = host.f.dof_vertex.data[d] ? 0.0 : rod.known.data[d];
    rod.own.accelerated.data[d] = (host.speed(d) - rod.speed.data[d]) / h;
  });
  const auto pushes = [&](int at, int& r) {
    r = rod.row_efc.data[at];
    const int tree = rod.row_tree.data[at];
    return (tree >= 0 || tree == VERTICES) && host.force(r) != 0.0;
  };
  each_in_turn<int>(rod.count.data[0], pushes, [&](int r) {
    const auto row = host.row(r);
    const double force = host.force(r);
    each_lane(0, row.count, [&](int k) {
      const int d = row.dof ? row.dof[k] : k;
      if (host.own_dof(d) < 0) rod.own.pushed.data[d] += row.value[k] * force;
    });
  });
}

// Ends the step: by the rod's own response to what MuJoCo found otherwise, where it could.
template <class Host>
PALPATE void end(const Host& host, double h) {
  const auto& rod = host.rod;
  note_pushed(host, h);
  if (rod.status.data[0] >= 0 && is_free(rod)) {
    each_lane(0, rod.nnode, [&](int i) {
      const D3 found = host.moves(i) ? host.found(i) : D3{0.0, 0.0, 0.0};
      store(rod.move.data + 4 * i, host.moves(i) ? found + load(rod.force.data + 4 * i) : found);
      rod.move.data[4 * i + 3] = 0.0;
    });
    each_lane(4 * rod.nnode, 4 * nodes_of(rod), [&](int a) { rod.move.data[a] = 0.0; });
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
  if (rod.yields && rod.status.data[0] >= 0) {
    each_lane(1, rod.nnode - 1, [&](int i) {
      if (is_joint(rod, i)) yield_at(rod, rod.place.data, rod.turn.data, i);
    });
  }
  break_edge(rod);
  each_lane(0, 3 * rod.nnode, [&](int a) { rod.vel.data[a] = (1.0 / h) * (rod.place.data[a] - rod.start.data[a]); });
  if (rod.refine > 0.0 && rod.status.data[0] >= 0) refine(rod);
  each_lane(0, rod.nnode, [&](int i) {
    if (!host.moves(i)) return;
    host.move(i, load(rod.place.data + 3 * i) - load(rod.start.data + 3 * i), load(rod.vel.data + 3 * i));
  });
}

}  // namespace palpate
