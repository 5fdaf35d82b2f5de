// Nodal coupling: each moving node of an organ has three degrees of freedom of MuJoCo, but for those
// inside of a solid, whose motion is in the plugin state.
#pragma once
#include "coupling/node.h"

namespace palpate {

// The mass of a node: of solids, and where there may be cuts, not MuJoCo's, which is even and the same
// in every mjData.
template <class Fields>
PALPATE double mass_of(const Fields& f, int i) {
  return f.weighs ? f.weight.data[i] : f.mj.body_mass.data[f.bodyid.data[i]];
}

// The inertia of dof `k`, less than three, of a node whose dofs start at `adr`.
template <class Fields>
PALPATE double inertia(const Fields& f, int i, int adr, int k) {
  if (f.weighs) return f.inertia.data[i];
  return f.mj.body_mass.data[f.bodyid.data[i]] + f.mj.dof_armature.data[adr + k];
}

// How many times its inertia a node that contacts touch has to MuJoCo.
template <class Fields>
PALPATE double heavier(const Fields& f, int own) {
  const double heavy = f.own.heavier.data[0];
  return heavy > 1.0 && touched(load(f.own.force.data + own)) ? heavy : 1.0;
}

// Displacement of a node from rest, whose place a cut may have moved.
template <class Fields>
PALPATE D3 displacement(const Fields& f, int i, int qadr) {
  const D3 u = load(f.mj.qpos.data + qadr) - load(f.mj.qpos0.data + qadr);
  return f.weighs ? u - load(f.shift.data + 3 * i) : u;
}

// Whether a node is inside of a solid, and where its displacement and velocity are then.
template <class Fields>
PALPATE bool is_inner(const Fields& f, int i) { return f.stateadr.data[i] >= f.nfree; }
template <class Fields>
PALPATE double* inner_disp(const Fields& f, int i) {
  return f.own.disp.data + f.stateadr.data[i] - f.nfree;
}
template <class Fields>
PALPATE double* inner_vel(const Fields& f, int i) {
  return f.own.vel.data + f.stateadr.data[i] - f.nfree;
}

// Gives a node that moves its mass, and to the solver where its changes of velocity lead.
template <class Fields>
PALPATE void begin_node(const Fields& f, int i, double mass) {
  const int own = f.stateadr.data[i];
  f.solve.mass.data[i] = (float)mass;
  const D3 next = forecast(load(f.own.last.data + own), load(f.own.before.data + own));
  store_lane(f.solve.dvel_warm.data + offset_of(i), next);
}

// Reads MuJoCo's arrays into the solver's state and keeps what acts on the nodes.
template <class Fields>
PALPATE void gather_nodes(const Fields& f, Thread, int) {
  const auto& mj = f.mj;
  const auto& solve = f.solve;
  const double h = mj.timestep.data[0], damping = (float)f.number.data[DAMPING];
  solve.step.data[0] = (float)h;
  solve.step.data[1] = (float)weight_of_stiffness(h, damping, f.number.data[EASED]);
  const double* R = f.frame.data;
  const bool falls = !(mj.disableflags.data[0] & DISABLE_GRAVITY);
  const D3 zero = {0.0, 0.0, 0.0}, g = falls ? add_turned(zero, R, load(mj.gravity.data)) : zero;
  double weight = 0.0;
  for (int i = 0; i < f.nnode; ++i) {
    const int at = offset_of(i), adr = f.dofadr.data[i];
    const int qadr = f.qposadr.data[i], body = f.bodyid.data[i], own = f.stateadr.data[i];
    if (own < 0) continue;
    const double m = mass_of(f, i);
    weight += m;
    begin_node(f, i, m);
    if (is_inner(f, i)) {
      store_lane(solve.force_ext.data + at, m * g);
      store_lane(solve.disp.data + at, load(inner_disp(f, i)));
      store_lane(solve.vel.data + at, load(inner_vel(f, i)));
      continue;
    }
    const double theirs = mj.body_mass.data[body];
    const D3 along = theirs * g + load(mj.qfrc_applied.data + adr) + load(mj.qfrc_passive.data + adr);
    const D3 f_ext = external(along, R, mj.xfrc_applied.data + 6 * body);
    const D3 lagged = f_ext + load(f.own.force.data + own);
    store(f.lagged.data + 3 * i, lagged);
    store_lane(solve.force_ext.data + at, f.weighs ? lagged + (m - theirs) * g : lagged);
    store_lane(solve.disp.data + at, displacement(f, i, qadr));
    store_lane(solve.vel.data + at, load(mj.qvel.data + adr));
  }
  // Residual floor: with D ~ mass, sqrt(r^T D^-1 r) of this share of the weight's impulse.
  const double rest = f.rest_share * 9.81 * h;
  solve.step.data[2] = (float)(weight * rest * rest);
}

// Adds the passive force.
template <class Fields>
PALPATE void scatter_nodes(const Fields& f, Thread, int) {
  const auto& mj = f.mj;
  // A solve that failed holds the organ still for this step instead of spreading the damage.
  const bool ok = f.solve.status.data[3] == 0.0f;
  const double per_h = 1.0 / mj.timestep.data[0];
  for (int i = 0; i < f.nnode; ++i) {
    const int adr = f.dofadr.data[i], own = f.stateadr.data[i];
    if (adr < 0) continue;  // pinned, inside or padding
    const double gain = heavier(f, own);
    const D3 Mhat = {gain * inertia(f, i, adr, 0), gain * inertia(f, i, adr, 1),
                     gain * inertia(f, i, adr, 2)};
    if (gain > 1.0 || f.weighs) set_inertia(mj, f.massadr.data + 3 * i, adr, Mhat);
    const D3 dv = load_lane(f.solve.dvel.data + offset_of(i));
    const D3 rate = {Mhat.x * dv.x * per_h, Mhat.y * dv.y * per_h, Mhat.z * dv.z * per_h};
    double* out = mj.qfrc_passive.data + adr;
    store(out, load(out) + passive(ok ? rate : D3{0.0, 0.0, 0.0}, load(f.lagged.data + 3 * i)));
  }
}

// Writes the impulses by which the contact forces changed to the solver's right-hand side.
template <class Fields>
PALPATE void push_nodes(const Fields& f, Thread, int) {
  const double h = f.mj.timestep.data[0];
  bool changed = false;
  Expected expected;
  for (int i = 0; i < f.nnode; ++i) {
    const int adr = f.dofadr.data[i], own = f.stateadr.data[i];
    store_lane(f.solve.rhs.data + offset_of(i), {0.0, 0.0, 0.0});
    if (adr < 0) continue;
    const D3 was = load(f.own.force.data + own), now = load(f.mj.qfrc_constraint.data + adr);
    if (!touched(was) && !touched(now)) continue;
    const D3 impulse = h * (now - was);
    store_lane(f.solve.rhs.data + offset_of(i), impulse);
    changed = changed || touched(impulse);
    expected.add(impulse, heavier(f, own) * inertia(f, i, adr, 0), was, now);
  }
  f.solve.expected.data[0] = expected.value();
  f.flags.data[FLAG_CHANGED] = changed;
}

// Steps the change of velocity that the plugin state keeps of a node, from what this one was.
template <class Fields>
PALPATE void shift_last(const Fields& f, int own, D3 dv) {
  store(f.own.before.data + own, load(f.own.last.data + own));
  store(f.own.last.data + own, dv);
}

// Moves a node inside of a solid.
template <class Fields>
PALPATE void move_inner(const Fields& f, int i, double h, D3 dv) {
  const D3 v = load(inner_vel(f, i)) + dv;
  store(inner_disp(f, i), load(inner_disp(f, i)) + h * v);
  store(inner_vel(f, i), v);
}

// Steps the plugin state, and ends the step with the organ's response where there was one: not by
// what MuJoCo made of the forces, whose solver may have stopped where those that it reports are not
// quite those that moved the dofs.
template <class Fields>
PALPATE void remember_nodes(const Fields& f, Thread, int) {
  const auto& mj = f.mj;
  const double h = mj.timestep.data[0], damping = (float)f.number.data[DAMPING];
  const bool ok = f.solve.status.data[3] == 0.0f, answered = ok && f.flags.data[FLAG_ANSWERED];
  const double heavy = f.own.heavier.data[0] > 1.0 ? f.own.heavier.data[0] : 1.0;
  const double ratio = answered ? f.solve.ratio.data[0] : 1.0;
  Secant secant;
  for (int i = 0; i < f.nnode; ++i) {
    const int at = offset_of(i), adr = f.dofadr.data[i], own = f.stateadr.data[i];
    if (own < 0) continue;
    D3 dv = {0.0, 0.0, 0.0};
    if (ok) dv = load_lane(f.solve.dvel.data + at);
    const D3 answer = answered ? load_lane(f.solve.sol.data + at) : D3{0.0, 0.0, 0.0};
    shift_last(f, own, dv + answer);
    if (is_inner(f, i)) {
      move_inner(f, i, h, dv + answer);
      continue;
    }
    double* force = f.own.force.data + own;
    const D3 was = load(force), now = load(mj.qfrc_constraint.data + adr);
    if (answered) {
      secant.add(now - was, norm(now));
      const D3 v = load_lane(f.solve.vel.data + at) + dv + answer;
      double* qpos = mj.qpos.data + f.qposadr.data[i];
      double* qvel = mj.qvel.data + adr;
      store(qpos, load(qpos) + h * (v - load(qvel)));
      store(qvel, v);
    }
    store(force, relaxed(was, now, ratio));
  }
  if (answered) f.own.heavier.data[0] = secant.heavier(heavy, f.heaviest.data[0], ratio);
}

}  // namespace palpate
