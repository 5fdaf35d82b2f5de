// The small passes of the time stepping schemes.
#pragma once
#include "tissue/volume.h"

namespace palpate {

// How fast the edges of a slice's nodes change: the largest (rate of an edge's ends over its
// length)^2, 0 where none of the nodes is so fast that an edge could change by more than AHEAD in a
// step h, the node at its other end being slower.
template <class Fields>
PALPATE V fastest(
  const Fields& f, int world, const float* vel, float h, int s, Lane lane
) {
  const V3 v = ld3(vel + 24 * s, lane);
  const float slow = AHEAD * f.shape.shortest / (2.0f * h);
  V most = splat(0.0f);
  if (!any_above(dot(v, v), slow * slow)) return most;
  const size_t mesh = mesh_of(f, world);
  const int first = f.shape.slot_adr.data[s], width = f.shape.fan_width.data[mesh + s];
  const int* node = f.shape.fan_node.data + mesh + 8 * (first + 2 * s + 1);
  const float* rest = f.shape.fan_rest.data + mesh + 24 * (first + 2 * s + 1);
  for (int k = 0; k < width; ++k, node += 8, rest += 24) {
    const V3 d = gather3(vel, node, lane) - v, r = ld3(rest, lane);
    most = vmax(most, dot(d, d) / vmax(dot(r, r), splat(1e-30f)));
  }
  return most;
}

template <class Fields>
PALPATE void edge_change(const Fields& f, Thread t, int) {
  const float* vel = f.state.vel.data + 24 * (size_t)t.world * f.shape.nslice;
  const float h = f.state.step.data[4 * t.world];
  each_slice(t, f.shape.nused, [&](int s, Lane lane) {
    put_most(f.system.change.data + t.world, fastest(f, t.world, vel, h, s, lane));
  });
}

// The share of h v that the first Newton iteration looks ahead: as much as the edges allow.
PALPATE float share_ahead(float h, float change) {
  const float most = h * sqrtf(change);
  return most > AHEAD ? AHEAD / most : 1.0f;
}

// Puts the trial state of a slice, also where tetrahedra gather it.
template <class Fields>
PALPATE void stand(const Fields& f, size_t at, V3 u, V3 v, Lane lane) {
  st3(f.system.disp_trial.data + 24 * at, u, lane);
  st3(f.system.vel_trial.data + 24 * at, v, lane);
  if (!f.shape.ntetslice) return;
  share(f.system.node_motion.data + 96 * at, u, lane);
  share(f.system.node_motion.data + 96 * at + 32, v, lane);
}

// The trial state is the present one.
template <class Fields>
PALPATE void stay(const Fields& f, Thread t, int) {
  each_slice(t, f.shape.nused, [&](int s, Lane lane) {
    const size_t at = (size_t)t.world * f.shape.nslice + s;
    const V3 u = ld3(f.state.disp.data + 24 * at, lane);
    stand(f, at, u, ld3(f.state.vel.data + 24 * at, lane), lane);
  });
}

// Where the first Newton iteration stands.
template <class Fields>
PALPATE void predict(const Fields& f, Thread t, int) {
  float* step = f.state.step.data + 4 * t.world;
  const float h = step[0], share = share_ahead(h, f.system.change.data[t.world]);
  each_slice(t, f.shape.nused, [&](int s, Lane lane) {
    const size_t at = (size_t)t.world * f.shape.nslice + s;
    const V3 v = ld3(f.state.vel.data + 24 * at, lane);
    stand(f, at, ld3(f.state.disp.data + 24 * at, lane) + share * h * v, v, lane);
  });
  if (t.tid == 0) step[3] = share;
}

// Takes the solution of a Newton iteration over, IS_FIRST or not; IS_MORE: more are to come, at the
// end of the step, or IS_CENTRED where `midpoint` has forces and damping.
template <class Fields>
PALPATE void newton_update(const Fields& f, Thread t, int flags) {
  float* step = f.state.step.data + 4 * t.world;
  const float h = step[0];
  const bool centred = flags & IS_CENTRED;
  const float way = centred ? 0.5f * (step[1] / h + step[3] * h) : h, part = centred ? 0.5f : 1.0f;
  each_slice(t, f.shape.nused, [&](int s, Lane lane) {
    const size_t own = (size_t)t.world * f.shape.nslice + s, at = 24 * own;
    V3 dv = ld3(f.system.sol.data + at, lane);
    if (!(flags & IS_FIRST)) dv += ld3(f.state.dvel.data + at, lane);
    st3(f.state.dvel.data + at, dv, lane);
    if (flags & IS_MORE) {
      const V3 v = ld3(f.state.vel.data + at, lane);
      const V3 moved = centred ? dv : v + dv;
      stand(f, own, ld3(f.state.disp.data + at, lane) + way * moved, v + part * dv, lane);
    }
  });
  if (t.tid == 0 && !centred) step[3] = 1.0f;
}

// Makes the step that of `midpoint` in place of `implicit`'s, or puts it back: half its stiffness,
// and half of the step where the velocity is that of the time of x, as the last step changed none.
template <class Fields>
PALPATE void centre(const Fields& f, Thread t, int undo) {
  Group<SUMS> group(t, f.system.partial.data);
  const float* warm = f.state.dvel_warm.data + 24 * (size_t)t.world * f.shape.nslice;
  V sum = splat(0.0f);
  group.each(0, f.shape.nused, [&](int s, Lane lane) {
    const V3 d = ld3(warm + 24 * s, lane);
    sum = add_dot(sum, d, d);
  });
  const float part = group.sum(sum) > 0.0f ? 1.0f : 0.5f;
  if (!group.is_first()) return;
  float* step = f.state.step.data + 4 * t.world;
  if (undo) {
    step[0] /= part;
    step[1] *= 2.0f / part;
    return;
  }
  // Such that the weight of K v on the right-hand side is h damping; see `Stage`.
  step[3] = (1.0f - 0.5f * step[1] / (step[0] * step[0])) / part;
  step[0] *= part;
  step[1] *= 0.5f * part;
}

// The springs that stand for a slice's edges, for `neumann`: W = I + g (sum - N) / m with
// sum = foundation area + all springs of a node, N those to its neighbours.
struct Springs {
  int width;
  const int* node;
  const float* k;
  V area, sum;

  // Adds g times the springs' pull towards x, as seen from `own`.
  PALPATE V3 pulled(V3 b, float g, const float* x, V3 own, Lane lane) const {
    for (int i = 0; i < width; ++i)
      b += (g * ld(k, i, lane)) * (gather3(x, node + 8 * i, lane) - own);
    return b;
  }
};

template <class Fields>
PALPATE Springs springs(const Fields& f, int world, int s, Lane lane) {
  const size_t mesh = mesh_of(f, world);
  const int row = f.shape.slot_adr.data[s], width = f.shape.fan_width.data[mesh + s];
  const float* k = f.tissue.fan_spring.data + mesh + 8 * row;
  const V area = ld(f.shape.area.data + mesh, s, lane);
  V sum = numbers(f, world)[FOUNDATION] * area;
  for (int i = 0; i < width; ++i) sum += ld(k, i, lane);
  return {width, f.shape.fan_node.data + mesh + 8 * (row + 2 * s + 1), k, area, sum};
}

// One over the mass of a slice's nodes, 0 for those that do not move: they may have no mass.
template <class Fields>
PALPATE V lightness(const Fields& f, int world, int s, Lane lane) {
  const V free = ld(f.shape.free.data + mesh_of(f, world), s, lane), zero = splat(0.0f);
  const V mass = ld(f.state.mass.data + 8 * (size_t)world * f.shape.nslice, s, lane);
  return select(free > zero, 1.0f / mass, zero);
}

// The schemes that solve nothing, from the right-hand side: `explicit`, dv = M^-1 b, and `neumann`,
// dv = (2 D^-1 - D^-1 W D^-1) (b - g H v) / m.
template <class Fields>
PALPATE void direct(const Fields& f, Thread t, int stage) {
  Group<> group(t, f.system.partial.data);
  const float* step = f.state.step.data + 4 * t.world;
  const float g = step[1], gv = g - step[0] * step[0];
  const float foundation = g * numbers(f, t.world)[FOUNDATION];
  const size_t base = 24 * (size_t)t.world * f.shape.nslice;
  const float* vel = f.state.vel.data + base;
  const float* areavec = f.system.areavec.data + base;
  float* sol = f.system.sol.data + base;
  float* first = f.system.q.data + base;
  const float impulse = volume_impulse(f, t.world, group, f.state.disp.data + base, vel, gv);
  V norm = splat(0.0f);
  group.each(0, f.shape.nused, [&](int s, Lane lane) {
    const V inverse = lightness(f, t.world, s, lane);
    V3 b = ld3(f.system.rhs.data + base + 24 * s, lane);
    if (impulse != 0.0f) b += impulse * ld3(areavec + 24 * s, lane);
    V d = splat(1.0f);
    if (stage == NEUMANN) {
      const Springs k = springs(f, t.world, s, lane);
      const V3 v = ld3(vel + 24 * s, lane);
      b = k.pulled(b - (foundation * k.area) * v, g, vel, v, lane);
      d += g * k.sum * inverse;
    }
    norm = add_dot(norm, inverse * b, b);
    const V3 y = (inverse * b) / d;
    st3(sol + 24 * s, y, lane);
    st3(first + 24 * s, y, lane);
  });
  const float whole = group.sum(norm);
  if (stage == NEUMANN)
    group.each(0, f.shape.nused, [&](int s, Lane lane) {
      // With y = D^-1 (...) and W = D - N: y + D^-1 N y.
      const V inverse = lightness(f, t.world, s, lane);
      const Springs k = springs(f, t.world, s, lane);
      const V3 none = {splat(0.0f), splat(0.0f), splat(0.0f)};
      const V3 pull = k.pulled(none, 1.0f, first, none, lane);
      const V3 more = ((g * inverse) * pull) / (1.0f + g * k.sum * inverse);
      st3(sol + 24 * s, ld3(first + 24 * s, lane) + more, lane);
    });
  if (!group.is_first()) return;
  float* status = f.system.status.data + 4 * t.world;
  status[0] = stage == NEUMANN ? 1.0f : 0.0f;
  status[1] = 0.0f;
  status[2] = whole;
  status[3] = whole < 1e30f && whole >= 0.0f ? 0.0f : 1.0f;
}

}  // namespace palpate
