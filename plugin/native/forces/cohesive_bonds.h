// Bonds: springs between an organ and what it has grown on to, by area, which soften and break. To a
// body, or to points of another organ's triangles. Doubles, a thread a bond.
//
// The traction of a bond with separation s and damage d is (1 - d) K s. Its damage follows its opening
// e, the length of s without what presses it on to its bed, by the bilinear law (Camanho and Davila
// 2002, NASA/TM-2002-211737, eq. 14):
//
//   d = ef (e - e0) / (e (ef - e0)),   e0 = strength / K,   ef = 2 energy / strength
//
// and never falls. A step has the damage of where it begins, and so a linear spring, which is
// implicit; what damage then takes of a bond's energy is gone. A bond gains none by softening.
#pragma once
#include "forces/bodies.h"
#include "core/geom.h"
#include "core/triangle.h"

namespace palpate {

constexpr int ON_ORGAN = -1;  // in place of a body

// Where a bond is held: a place, its velocity, and the axes of what it is in, column by column.
struct Seat { D3 at, vel, x, y, z; };

template <class Fields>
PALPATE Seat seat_on_body(const Fields& f, const Twist& moving) {
  const auto* R = f.mj.xmat.data + 9 * f.body;
  Seat s = {load(f.mj.xpos.data + 3 * f.body), {0.0, 0.0, 0.0}, {R[0], R[3], R[6]},
            {R[1], R[4], R[7]}, {R[2], R[5], R[8]}};
  s.vel = velocity_at(moving, arm_of(f.mj, f.body, s.at));
  return s;
}

template <class Fields>
PALPATE Seat seat_on_organ(const Fields& f, int n) {
  const D3 zero = {0.0, 0.0, 0.0};
  Seat s = {zero, zero, zero, zero, zero};
  D3 x[3];
  for (int c = 0; c < 3; ++c) {
    const Place p = place_of(f.mj, f.other, f.corner.data[3 * n + c]);
    const double share = f.weight.data[3 * n + c];
    x[c] = p.at;
    s.at += share * p.at;
    s.vel += share * p.vel;
  }
  set_axes(s, x[1] - x[0], x[2] - x[0]);
  return s;
}

// The damage that an opening brings.
template <class Fields>
PALPATE double damage_of(const Fields& f, double opening) {
  const double e0 = f.strength / f.stiffness, ef = 2.0 * f.energy / f.strength;
  if (opening <= e0) return 0.0;
  return opening < ef ? ef * (opening - e0) / (opening * (ef - e0)) : 1.0;
}

// Finds the force of each bond on its vertex, what its spring weighs, and what damage it will have.
template <class Fields>
PALPATE void stretch_bonds(const Fields& f, Thread t, int) {
  if (!f.live.data[0]) return;
  const double h = f.mj.timestep.data[0], damping = f.number.data[DAMPING];
  const double reach = f.ahead * h + damping, twice = f.body == ON_ORGAN ? 2.0 : 1.0;
  const D3 zero = {0.0, 0.0, 0.0};
  const Twist moving = f.body >= 0 ? twist(f.mj, f.body, true) : Twist{zero, zero};
  const Seat fixed = f.body >= 0 ? seat_on_body(f, moving) : Seat{zero, zero, zero, zero, zero};
  each_item(t, f.count.data[0], [&](int n) {
    const double* had = f.state.data + 2 * f.slot.data[n];
    const double d = had[0] > 0.0 ? had[0] < 1.0 ? had[0] : 1.0 : 0.0;
    double* next = f.next.data + 2 * n;
    next[0] = d, next[1] = had[1];
    store(f.stretch.data + 3 * n, zero);
    store(f.force.data + 3 * n, zero);
    f.hardness.data[n] = 0.0;
    if (d >= 1.0) return;
    const Seat s = f.body >= 0 ? fixed : seat_on_organ(f, n);
    const D3 arm = in_axes(s, load(f.anchor.data + 3 * n));
    const D3 n0 = in_axes(s, load(f.normal.data + 3 * n));
    const D3 vel = f.body >= 0 ? s.vel + cross(moving.spin, arm) : s.vel;
    const Place x = place_of(f.mj, f.own, f.vert.data[n]);
    const D3 apart = x.at - s.at - arm;
    const double along = dot(apart, n0), K = f.stiffness * f.area.data[n];
    const double worse = damage_of(f, norm(along < 0.0 ? apart - along * n0 : apart));
    if (worse > d) {
      next[0] = worse;
      next[1] += 0.5 * K * dot(apart, apart) * (worse - d);
    }
    const double k = (1.0 - next[0]) * K;
    store(f.stretch.data + 3 * n, apart);
    store(f.force.data + 3 * n, (-k) * (apart + reach * (x.vel - vel)));
    f.hardness.data[n] = twice * k * f.gain * h * (h + damping);
  });
}

PALPATE Sym evenly(double weight) { return {weight, 0.0, 0.0, weight, 0.0, weight}; }

// Adds the bonds' forces to the solver's input of their organ; it stays awake while one may pull.
template <class Fields>
PALPATE void enter_bonds(const Fields& f, Thread t, int) {
  if (!f.live.data[0]) return;
  const D3 zero = {0.0, 0.0, 0.0};
  each_item(t, f.count.data[0], [&](int n) {
    const double weight = f.hardness.data[n];
    if (weight == 0.0) return;
    if (f.restless) f.solve.quiet.data[0] = 0.0;
    push_node(f.solve, f.solve.node.data[f.vert.data[n]],
              add_turned(zero, f.own.frame.data, load(f.force.data + 3 * n)), evenly(weight));
  });
}

// Adds them to the input of the organ that it is bonded to, one after the other: several may share a
// vertex there.
template <class Fields>
PALPATE void bear_bonds(const Fields& f, Thread t, int) {
  if (!f.live.data[0] || t.tid > 0) return;
  const D3 zero = {0.0, 0.0, 0.0};
  for (int n = 0; n < f.count.data[0]; ++n) {
    const double weight = f.hardness.data[n];
    if (weight == 0.0) continue;
    f.below.quiet.data[0] = 0.0;
    const D3 push = add_turned(zero, f.other.frame.data, zero - load(f.force.data + 3 * n));
    for (int c = 0; c < 3; ++c) {
      const double share = f.weight.data[3 * n + c];
      push_node(f.below, f.below.node.data[f.corner.data[3 * n + c]], share * push,
                evenly(share * weight));
    }
  }
}

// Finds what the forces are with what the step made of the vertices' velocities.
template <class Fields>
PALPATE void act_bonds(const Fields& f, Thread t, int) {
  if (!f.live.data[0]) return;
  const bool ok = f.solve.status.data[3] == 0.0f;
  const double per_h = 1.0 / f.mj.timestep.data[0];
  each_item(t, f.count.data[0], [&](int n) {
    const double weight = f.hardness.data[n];
    store(f.pull.data + 3 * n, {0.0, 0.0, 0.0});
    if (weight == 0.0 || !ok) return;
    const int at = offset_of(f.solve.node.data[f.vert.data[n]]);
    const D3 dv = turned(f.own.frame.data, load_lane(f.solve.dvel.data + at));
    store(f.pull.data + 3 * n, load(f.force.data + 3 * n) - (weight * per_h) * dv);
  });
}

// Lets the body feel them.
template <class Fields>
PALPATE void feel_bonds(const Fields& f, Thread t, int) {
  if (!f.live.data[0] || t.tid > 0) return;
  const D3 zero = {0.0, 0.0, 0.0};
  const Seat s = seat_on_body(f, Twist{zero, zero});
  D3 force = zero, torque = zero;
  for (int n = 0; n < f.count.data[0]; ++n) {
    const D3 pull = load(f.pull.data + 3 * n);
    const D3 point = s.at + in_axes(s, load(f.anchor.data + 3 * n));
    force = force - pull;
    torque = torque - cross(arm_of(f.mj, f.body, point), pull);
  }
  push_body(f.mj, f.body, force, torque);
}

// Keeps the bonds' damage.
template <class Fields>
PALPATE void keep_bonds(const Fields& f, Thread t, int) {
  if (!f.live.data[0]) return;
  each_item(t, f.count.data[0], [&](int n) {
    double* state = f.state.data + 2 * f.slot.data[n];
    const double* next = f.next.data + 2 * n;
    // A current may have weakened it between the step's two halves.
    state[0] = next[0] > state[0] ? next[0] : state[0];
    state[1] = next[1];
  });
}

// Weakens the bonds whose strands, from bed to vertex, come within reach of the axis of a geom with a
// current, by what it gives in a step.
template <class Fields>
PALPATE void burn_bonds(const Fields& all, Thread t, int) {
  const auto& f = all.bonds;
  if (!f.live.data[0] || t.tid > 0) return;
  const double given = fabs((double)f.mj.ctrl.data[all.actuator]) * f.mj.timestep.data[0];
  if (given == 0.0) return;
  const auto* R = f.mj.geom_xmat.data + 9 * all.geom;
  const D3 axis = {R[all.axis], R[3 + all.axis], R[6 + all.axis]};
  const D3 end = load(f.mj.geom_xpos.data + 3 * all.geom) - all.half * axis;
  auto near = [&](int n) {
    const D3 strand = load(f.stretch.data + 3 * n);
    const D3 bed = place_of(f.mj, f.own, f.vert.data[n]).at - strand;
    return f.state.data[2 * f.slot.data[n]] < 1.0 &&
           between(end, 2.0 * all.half * axis, bed, strand) < all.reach;
  };
  double area = 0.0;
  for (int n = 0; n < f.count.data[0]; ++n)
    if (near(n)) area += f.area.data[n];
  if (area == 0.0) return;
  for (int n = 0; n < f.count.data[0]; ++n) {
    double& damage = f.state.data[2 * f.slot.data[n]];
    const double more = damage + given / (all.energy * area);
    if (near(n)) damage = more < 1.0 ? more : 1.0;
  }
}

// How far points are from some geoms.
template <class Fields>
PALPATE void measure_geoms(const Fields& f, Thread, int) {
  for (int i = 0; i < f.npoint; ++i)
    f.far.data[i] = nearest(f.geom.data, f.ngeom, load(f.point.data + 3 * i));
}

// How far points are from some triangles, and where the nearest point of these is.
template <class Fields>
PALPATE void measure_triangles(const Fields& f, Thread, int) {
  for (int i = 0; i < f.npoint; ++i) {
    const D3 x = load(f.point.data + 3 * i);
    double least = 1e300;
    for (int t = 0; t < f.nelem; ++t) {
      const double* p = f.corner.data + 9 * t;
      const D3 corner[3] = {load(p), load(p + 3), load(p + 6)};
      const D3 w = barycentric(x, corner);
      const D3 away = w.x * corner[0] + w.y * corner[1] + w.z * corner[2] - x;
      if (!(dot(away, away) < least)) continue;
      least = dot(away, away);
      f.elem.data[i] = t;
      store(f.weight.data + 3 * i, w);
    }
    f.far.data[i] = sqrt(least);
  }
}

}  // namespace palpate
