// The coupling of a rod to MuJoCo.
//
// The rod's step is taken with the constraints that MuJoCo has found for this step, on bodies that move on as
// they did; those that an equality joins to it yield to its force. So it reaches MuJoCo as a force on its nodes,
//
//   qfrc_passive = Mhat (v1 - v) / h - f_ext - f_c,
//
// with f_c the force of the constraints in the rod's step and Mhat the inertia that one node alone has in it.
// MuJoCo's solver, for which Mhat is the nodes' inertia, finds f_c again unless other bodies move otherwise; by
// what it differs the rod then moves on by its own response A. An error of a body of mass M becomes
// (A - Mhat) / (M + Mhat) of it, and one of the rod Mhat M / ((M + Mhat) A): so Mhat is that of the direction in
// which the rod gives way most.
#pragma once
#include "coupling/contact_rows.h"
#include "coupling/node.h"
#include "solver/rod_step.h"

AS_WRITTEN

namespace palpate {

// The first node of the rod that a row reaches, or -1: none, or more than two that are neighbours.
template <class Fields>
PALPATE int first_node(const Fields& f, Row row) {
  int first = -1, last = -1;
  for (int k = 0; k < row.count; ++k) {
    const int own = f.own_dof.data[row.dof ? row.dof[k] : k];
    if (own < 0 || row.value[k] == 0.0) continue;
    if (first < 0 || own / 3 < first) first = own / 3;
    if (own / 3 > last) last = own / 3;
  }
  return last - first > 1 ? -1 : first;
}

// How other bodies give way to a row's force, J M^-1 J^T of their dofs [1/kg], by MuJoCo's factors of M. A row
// that has a dof has those above it, on which alone its part of the solution depends.
template <class Fields>
PALPATE double yields(const Fields& f, Row row) {
  double* x = f.solution.data;
  const auto own = [&](int k) { return f.own_dof.data[row.dof ? row.dof[k] : k] >= 0; };
  for (int k = 0; k < row.count; ++k) x[row.dof ? row.dof[k] : k] = own(k) ? 0.0 : row.value[k];
  for (int k = row.count - 1; k >= 0; --k) {
    const int i = row.dof ? row.dof[k] : k, start = f.M_rowadr.data[i], last = f.M_rownnz.data[i] - 1;
    if (x[i] == 0.0) continue;
    for (int c = 0; c < last; ++c) x[f.M_colind.data[start + c]] -= f.mj.qLD.data[start + c] * x[i];
  }
  // M = L^T D L: with y = L^-T J, J M^-1 J^T is y^T D^-1 y.
  double sum = 0.0;
  for (int k = 0; k < row.count; ++k) {
    const int i = row.dof ? row.dof[k] : k;
    sum += x[i] * x[i] * f.mj.qLDiagInv.data[i];
  }
  return sum;
}

// Notes MuJoCo's row `r` where it acts on the rod; returns whether it does.
template <class Fields>
PALPATE bool note_row(const Fields& f, int r, int kind, double friction) {
  const int at = f.count.data[0];
  const Row row = row_of(f, r);
  const int node = first_node(f, row);
  if (node < 0 || at >= f.most_rows) return false;
  double* J = f.row_value.data + (DOFS + 3) * at;
  const double* kbip = datum<double*>(f, DATA_EFC_KBIP) + 4 * r;
  const double gap = datum<double*>(f, DATA_EFC_POS)[r] - datum<double*>(f, DATA_EFC_MARGIN)[r];
  double sum = kbip[1] * velocity(f, r) + kbip[0] * kbip[2] * gap;  // -aref
  for (int k = 0; k < DOFS; ++k) J[k] = 0.0;
  for (int k = 0; k < row.count; ++k) {
    if (row.value[k] == 0.0) continue;
    const int dof = row.dof ? row.dof[k] : k, own = f.own_dof.data[dof];
    if (own >= 0)
      J[own - 3 * node] = row.value[k];
    else
      sum += row.value[k] * f.qacc_warmstart.data[dof];
  }
  J[DOFS] = sum;
  J[DOFS + 1] = datum<double*>(f, DATA_EFC_D)[r];
  J[DOFS + 2] = friction;
  f.row_node.data[at] = node;
  f.row_kind.data[at] = kind;
  f.count.data[0] = at + 1;
  return true;
}

// Notes the rows of an equality, from `r` on. What it joins to the rod does not go on as it did: from its last
// acceleration the row's last force is taken off, and it gives way to the new one. It does so by as much as in all
// rows together, no less than in any direction: too little would overshoot.
template <class Fields>
PALPATE void note_equality(const Fields& f, int r, int count) {
  const int from = f.count.data[0];
  double way = 0.0;
  for (int k = 0; k < count; ++k)
    if (note_row(f, r + k, BOTH, 0.0)) way += yields(f, row_of(f, r + k));
  for (int at = from; at < f.count.data[0]; ++at) {
    double* J = f.row_value.data + (DOFS + 3) * at;
    const double* last = f.own.force.data + 3 * f.row_node.data[at];
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

template <class Fields>
PALPATE bool is_own(const Fields& f, const char* contact) {
  return side_of(contact, CONTACT_FLEX, 0) == f.flex || side_of(contact, CONTACT_FLEX, 1) == f.flex;
}

// Notes the rows of constraints that act on the rod. Contacts are there before they touch, by the flex's
// margin, which is taken off again: one that came a step late would find light nodes far inside.
template <class Fields>
PALPATE void note_rows(const Fields& f) {
  f.count.data[0] = 0;
  const int nefc = datum<int>(f, DATA_NEFC), ncon = nefc > 0 ? datum<int>(f, DATA_NCON) : 0;
  char* const contacts = datum<char*>(f, DATA_CONTACT);
  for (int c = 0; c < ncon; ++c) {
    const char* contact = contacts + (size_t)CONTACT_LENGTH * c;
    const Rows rows = is_own(f, contact) ? rows_of(f, contact) : Rows{0, 0, false};
    if (!rows.count) continue;
    keep_closed(f, contact, rows, f.flex_margin.data[f.flex]);
    const bool cone = !rows.paired && rows.count > 1;
    const double* friction = (const double*)(contact + CONTACT_FRICTION);
    const int before = f.count.data[0];
    for (int k = 0; k < rows.count; ++k) {
      const double slope = !cone ? 0.0 : k ? friction[k - 1] : *(const double*)(contact + CONTACT_MU);
      const bool noted = note_row(f, rows.first + k, !cone ? ONE : k ? FRICTION : CONE, slope);
      if (noted || !cone) continue;
      f.count.data[0] = before;  // a cone is whole or not there
      break;
    }
  }
  const int* type = datum<int*>(f, DATA_EFC_TYPE);
  const int* id = datum<int*>(f, DATA_EFC_ID);
  for (int r = 0, count = 1; r < nefc; r += count) {
    for (count = 1; type[r] == IS_EQUALITY && r + count < nefc && type[r + count] == IS_EQUALITY && id[r + count] == id[r];)
      ++count;
    if (type[r] == IS_EQUALITY) note_equality(f, r, count);
    if (type[r] == IS_LIMIT) note_row(f, r, ONE, 0.0);
  }
}

// Reads MuJoCo's arrays: where the step begins, and where it leads with no stiffness.
template <class Fields>
PALPATE void gather_rod(const Fields& f, double h) {
  const auto& mj = f.mj;
  const double* R = f.frame.data;
  const bool falls = !(mj.disableflags.data[0] & DISABLE_GRAVITY);
  const D3 zero = {0.0, 0.0, 0.0}, gravity = falls ? add_turned(zero, R, load(mj.gravity.data)) : zero;
  for (int i = 0; i < f.nnode; ++i) {
    const int adr = f.dofadr.data[i], q = f.qposadr.data[i], body = f.bodyid.data[i];
    f.turn.data[i] = 0.0;
    D3 x = load(f.rest.data + 3 * i), v = zero, force = zero;
    if (adr >= 0) {
      const double m = f.mass.data[i] = mj.body_mass.data[body];
      x += load(mj.qpos.data + q) - load(mj.qpos0.data + q);
      v = load(mj.qvel.data + adr);
      const D3 along = m * gravity + load(mj.qfrc_applied.data + adr) + load(mj.qfrc_passive.data + adr);
      force = external(along, R, mj.xfrc_applied.data + 6 * body);
      store(f.aim.data + 3 * i, x + h * v + (h * h / m) * force);
    } else {
      store(f.aim.data + 3 * i, x);
    }
    store(f.start.data + 3 * i, x);
    store(f.vel.data + 3 * i, v);
    store(f.external.data + 3 * i, force);
  }
}

template <class Fields>
PALPATE Envelope inverse_of(const Fields& f) {
  return {f.inverse.data, f.first.data, f.start_of_row.data, 4 * f.nnode};
}

// An inertia of a node alone in the rod's step that is no more than in any direction, and no less than a third of
// the least, from the inverse of the rod's matrix; no less than its mass.
template <class Fields>
PALPATE double alone(const Fields& f, int i, double h) {
  double trace = 0.0;
  for (int c = 0; c < 3; ++c) trace += inverse_of(f).at(4 * i + c, 4 * i + c);
  const double found = h * h / trace, mass = f.mass.data[i];
  return found > mass ? found : mass;
}

// Takes the rod's step, and adds the passive force that brings it through MuJoCo's.
template <class Fields>
PALPATE void begin_rod(const Fields& f, Thread, int) {
  const auto& mj = f.mj;
  const double h = mj.timestep.data[0];
  const int n = 4 * f.nnode;
  gather_rod(f, h);
  note_rows(f);
  f.status.data[0] = step_rod(f, h);
  const bool ok = f.status.data[0] >= 0, touched = ok && f.count.data[0] > 0;
  if (!ok)  // holds still for this step instead of spreading the damage
    for (int a = 0; a < 3 * f.nnode; ++a) f.place.data[a] = f.start.data[a];
  if (touched) {
    lay_out(f, f.place.data);
    const Envelope H = matrix_of(f);
    for (int a = 0; a < n; ++a) f.force.data[a] = 0.0;
    rows_cost(f, f.place.data, h, f.force.data, &H);
    assemble(f, f.place.data, f.turn.data, h, f.gradient.data);
    hold(f, f.gradient.data, H);
    factorize(H, f.trial.data);
    invert_there(H, inverse_of(f), f.below.data);
  }
  for (int i = 0; i < f.nnode; ++i) {
    const int adr = f.dofadr.data[i];
    if (adr < 0) continue;
    const int* at = f.massadr.data + 3 * i;
    D3 Mhat = {mj.M.data[at[0]], mj.M.data[at[1]], mj.M.data[at[2]]};
    if (touched) {
      const double inertia = alone(f, i, h);
      set_inertia(mj, at, adr, Mhat = {inertia, inertia, inertia});
    }
    const D3 dv = (1.0 / h) * (load(f.place.data + 3 * i) - load(f.start.data + 3 * i)) - load(f.vel.data + 3 * i);
    const D3 rate = (1.0 / h) * D3{Mhat.x * dv.x, Mhat.y * dv.y, Mhat.z * dv.z};
    double* out = mj.qfrc_passive.data + adr;
    const D3 lagged = load(f.external.data + 3 * i) - (touched ? load(f.force.data + 4 * i) : D3{0.0, 0.0, 0.0});
    store(out, load(out) + passive(rate, lagged));
  }
}

// Ends the step: by the rod's own response to what MuJoCo found otherwise.
template <class Fields>
PALPATE void end_rod(const Fields& f, Thread, int) {
  const auto& mj = f.mj;
  const double h = mj.timestep.data[0];
  if (f.count.data[0] > 0 && f.status.data[0] >= 0) {
    for (int i = 0; i < f.nnode; ++i) {
      const int adr = f.dofadr.data[i];
      const D3 found = adr < 0 ? D3{0.0, 0.0, 0.0} : load(mj.qfrc_constraint.data + adr);
      store(f.move.data + 4 * i, adr < 0 ? found : found + load(f.force.data + 4 * i));
      f.move.data[4 * i + 3] = 0.0;
    }
    solve_factorized(matrix_of(f), f.move.data);
    const double part = safe_part(f, f.place.data, f.move.data, 4);
    for (int i = 0; i < f.nnode; ++i) {
      store(f.place.data + 3 * i, load(f.place.data + 3 * i) + part * load(f.move.data + 4 * i));
      f.turn.data[i] += part * f.move.data[4 * i + 3];
    }
  }
  for (int i = 1; i + 1 < f.nnode && f.twists; ++i) f.trial.data[i] = twist_at(f, f.place.data, f.turn.data, i);
  for (int i = 1; i + 1 < f.nnode && f.twists; ++i) f.own.twist.data[i] = f.trial.data[i];
  for (int i = 0; i < f.nnode; ++i) {
    const int adr = f.dofadr.data[i];
    if (adr < 0) continue;
    store(f.own.force.data + 3 * i, load(mj.qfrc_constraint.data + adr));
    const D3 moved = load(f.place.data + 3 * i) - load(f.start.data + 3 * i);
    const D3 q = load(f.start.data + 3 * i) - load(f.rest.data + 3 * i) + load(mj.qpos0.data + f.qposadr.data[i]);
    store(mj.qpos.data + f.qposadr.data[i], q + moved);
    store(mj.qvel.data + adr, (1.0 / h) * moved);
  }
}

}  // namespace palpate
