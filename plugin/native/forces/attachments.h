// Attachments: springs from nodes of an organ to points of MuJoCo's bodies, of other organs, or of
// the organ's own rigid motion. Doubles, a thread a world: several may share a node.
//
// The force on a node at the end of the step, where the node will be and where the point will be:
//
//   F = k (p + (h + damping) p' - x - (h + damping) (v + dv))
//
// `force_ext` has what of it does not hang on dv, `hold` the rest. What the step made of F acts on the
// body the other way, so that momentum is kept.
#pragma once
#include "forces/bodies.h"

namespace palpate {

// What an attachment leads to besides bodies.
constexpr int TO_POINT = -1, TO_OWN_MOTION = -2;

struct Rigid { double R[9]; D3 middle, rest, vel, spin; };

// Cofactors of a matrix row by row; returns its determinant.
PALPATE double cofactors(const double* a, double* c) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const int k = (i + 1) % 3, l = (i + 2) % 3, m = (j + 1) % 3, n = (j + 2) % 3;
      c[3 * i + j] = a[3 * k + m] * a[3 * l + n] - a[3 * k + n] * a[3 * l + m];
    }
  return a[0] * c[0] + a[1] * c[1] + a[2] * c[2];
}

// Makes a matrix the rotation nearest to it, by Newton's iteration (Higham 1986).
PALPATE void make_rotation(double* a) {
  double c[9];
  for (int round = 0; round < 30; ++round) {
    const double det = cofactors(a, c);
    double size2 = 0.0, cof2 = 0.0, change = 0.0;
    for (int k = 0; k < 9; ++k) size2 += a[k] * a[k], cof2 += c[k] * c[k];
    if (!(det > 1e-12 * size2 * sqrt(size2))) break;
    const double scale = sqrt(sqrt(cof2 / (det * det * size2)));
    for (int k = 0; k < 9; ++k) {
      const double next = 0.5 * scale * a[k] + 0.5 / (scale * det) * c[k];
      change += (next - a[k]) * (next - a[k]);
      a[k] = next;
    }
    if (change < 1e-28) return;
  }
  const double det = cofactors(a, c);  // flat or inside out: as it was
  if (!(fabs(det - 1.0) < 1e-6))
    for (int k = 0; k < 9; ++k) a[k] = k % 4 == 0;
}

// The rigid motion that is nearest to that of the nodes which are attached to it (shape matching,
// Mueller et al. 2005, doi:10.1145/1073204.1073216), weighted by the springs' stiffness: their forces
// then have neither sum nor moment. Its velocity is that which the last steps lead to.
template <class Fields>
PALPATE Rigid own_motion(const Fields& f) {
  double total = 0.0, A[9] = {}, I[9] = {};
  const D3 zero = {0.0, 0.0, 0.0};
  Rigid out = {{1, 0, 0, 0, 1, 0, 0, 0, 1}, zero, zero, zero, zero};
  double ahead = 0.0;
  auto velocity = [&](int n) {
    const int at = offset_of(f.solve.node.data[f.vert.data[n]]);
    return load_lane(f.solve.vel.data + at) + ahead * load_lane(f.dvel_warm.data + at);
  };
  for (int n = 0; n < f.count.data[0]; ++n) {
    if (f.body.data[n] != TO_OWN_MOTION) continue;
    const int i = f.vert.data[n];
    const double k = f.stiffness.data[n];
    const D3 X = rest_of(f.own, i);
    total += k;
    ahead = f.leads.data[n] ? 1.0 : 0.0;
    out.rest += k * X;
    out.middle += k * (X + moved_by(f.mj, f.own, i));
    out.vel += k * velocity(n);
  }
  if (!(total > 0.0)) return out;
  out.rest = (1.0 / total) * out.rest;
  out.middle = (1.0 / total) * out.middle;
  out.vel = (1.0 / total) * out.vel;
  D3 turning = zero;
  for (int n = 0; n < f.count.data[0]; ++n) {
    if (f.body.data[n] != TO_OWN_MOTION) continue;
    const int i = f.vert.data[n];
    const double k = f.stiffness.data[n];
    const D3 X = rest_of(f.own, i) - out.rest;
    const D3 x = rest_of(f.own, i) + moved_by(f.mj, f.own, i) - out.middle;
    const double a[3] = {x.x, x.y, x.z}, b[3] = {X.x, X.y, X.z};
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) {
        A[3 * r + c] += k * a[r] * b[c];
        I[3 * r + c] += k * ((r == c ? dot(x, x) : 0.0) - a[r] * a[c]);
      }
    turning += k * cross(x, velocity(n) - out.vel);
  }
  for (int k = 0; k < 9; ++k) out.R[k] = A[k];
  make_rotation(out.R);
  double cof[9];
  const double det = cofactors(I, cof), size = I[0] + I[4] + I[8];
  if (det > 1e-9 * size * size * size) out.spin = (1.0 / det) * turned(cof, turning);
  return out;
}

// What an attachment's spring weighs on the change of its node's velocity [kg]; twice where another organ
// is at the other end, whose step does not know of this one's.
template <class Fields>
PALPATE double weight_of(const Fields& f, int n) {
  const double h = f.mj.timestep.data[0], twice = f.body.data[n] == TO_POINT ? 2.0 : 1.0;
  return twice * f.stiffness.data[n] * f.gain * h * (h + f.number.data[DAMPING]);
}

// Where the point of an attachment to a body is in the world.
template <class Fields>
PALPATE D3 point_of_body(const Fields& f, int n) {
  const int b = f.body.data[n];
  return load(f.mj.xpos.data + 3 * b)
    + turned(f.mj.xmat.data + 9 * b, load(f.anchor.data + 3 * n));
}

// Finds where the points on another organ are, which has number `which`.
template <class Fields>
PALPATE void aim_attachments(const Fields& all, Thread t, int which) {
  const auto& f = all.held;
  each_item(t, f.count.data[0], [&](int n) {
    if (f.whom.data[n] != which) return;
    const Place p = place_of(f.mj, all.other, f.pair.data[n]);
    store(f.point.data + 6 * n, p.at + load(f.anchor.data + 3 * n));
    store(f.point.data + 6 * n + 3, p.vel);
  });
}

// Adds to the solver's input what pulls at the attached nodes.
template <class Fields>
PALPATE void enter_attachments(const Fields& f, Thread t, int) {
  const int count = f.count.data[0];
  const double h = f.mj.timestep.data[0], reach = f.ahead * h + f.number.data[DAMPING];
  const D3 zero = {0.0, 0.0, 0.0};
  const Rigid own = f.owned ? own_motion(f) : Rigid{};
  if (f.restless) f.solve.quiet.data[0] = 0.0;
  Twist moving = {zero, zero};
  for (int n = 0; n < count; ++n) {
    const int i = f.vert.data[n], node = f.solve.node.data[i];
    const double k = f.stiffness.data[n];
    const D3 rest = rest_of(f.own, i);
    D3 to = load(f.point.data + 6 * n), vel = load(f.point.data + 6 * n + 3);
    const int b = f.body.data[n];
    if (b >= 0) {
      if (n == 0 || b != f.body.data[n - 1]) moving = twist(f.mj, b, f.leads.data[n]);
      to = point_of_body(f, n);
      vel = velocity_at(moving, arm_of(f.mj, b, to));
    }
    if (b == TO_OWN_MOTION) {
      const D3 arm = turned(own.R, rest - own.rest);
      to = own.middle + arm;
      vel = velocity_at(own, arm);
    } else {
      to = add_turned(zero, f.own.frame.data, to - load(f.own.origin.data));
      vel = add_turned(zero, f.own.frame.data, vel);
    }
    vel = vel - load_lane(f.solve.vel.data + offset_of(node));
    const D3 F = k * (to - rest - moved_by(f.mj, f.own, i) + reach * vel);
    const double weight = weight_of(f, n);
    store(f.force.data + 3 * n, F);
    push_node(f.solve, node, F, {weight, 0.0, 0.0, weight, 0.0, weight});
  }
}

// Ends the forces with what the step makes of the nodes' velocities, and lets the bodies feel them.
template <class Fields>
PALPATE void act_attachments(const Fields& f, Thread t, int) {
  const auto& mj = f.mj;
  const bool ok = f.solve.status.data[3] == 0.0f;
  const double h = mj.timestep.data[0];
  const D3 zero = {0.0, 0.0, 0.0};
  D3 force = zero, torque = zero;
  for (int n = 0; n < f.count.data[0]; ++n) {
    const int at = offset_of(f.solve.node.data[f.vert.data[n]]), b = f.body.data[n];
    const D3 back = (weight_of(f, n) / h) * load_lane(f.solve.dvel.data + at);
    const D3 F = ok ? load(f.force.data + 3 * n) - back : zero;
    store(f.force.data + 3 * n, F);
    if (b < 0) continue;
    const D3 push = zero - turned(f.own.frame.data, F);
    force += push;
    torque += cross(arm_of(mj, b, point_of_body(f, n)), push);
    if (n + 1 < f.count.data[0] && f.body.data[n + 1] == b) continue;
    push_body(mj, b, force, torque);
    force = torque = zero;
  }
}

}  // namespace palpate
