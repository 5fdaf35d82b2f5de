// The small passes of the time stepping schemes.
#pragma once
#include "simd.h"

namespace palpate {

// How fast edges change: the largest (rate of an edge's ends over its length)^2.
template <class Fields>
PALPATE void edge_change(const Fields& f, Thread t, int) {
  const float* vel = f.state.vel.data + 24 * (size_t)t.world * f.shape.nslice;
  each_slice(t, f.shape.nslice, [&](int s, Lane lane) {
    const int first = f.shape.slot_adr.data[s], width = f.shape.slot_adr.data[s + 1] - first;
    const int* node = f.shape.fan_node.data + 8 * (first + 2 * s + 1);
    const float* rest = f.shape.fan_rest.data + 24 * (first + 2 * s + 1);
    const V3 v = ld3(vel + 24 * s, lane);
    V most = splat(0.0f);
    for (int k = 0; k < width; ++k, node += 8, rest += 24) {
      const V3 d = gather3(vel, node, lane) - v, r = ld3(rest, lane);
      most = vmax(most, dot(d, d) / vmax(dot(r, r), splat(1e-30f)));
    }
    put_most(f.system.change.data + t.world, most);
  });
}

// Where the first Newton iteration stands: as much of h v ahead as the edges allow.
template <class Fields>
PALPATE void predict(const Fields& f, Thread t, int) {
  float* step = f.state.step.data + 4 * t.world;
  const float h = step[0], most = h * sqrtf(f.system.change.data[t.world]);
  const float share = most > AHEAD ? AHEAD / most : 1.0f;
  each_slice(t, f.shape.nslice, [&](int s, Lane lane) {
    const size_t at = 24 * ((size_t)t.world * f.shape.nslice + s);
    const V3 v = ld3(f.state.vel.data + at, lane);
    st3(f.system.vel_trial.data + at, v, lane);
    st3(f.system.disp_trial.data + at, ld3(f.state.disp.data + at, lane) + share * h * v, lane);
  });
  if (t.tid == 0) step[3] = share;
}

// Takes the solution of a Newton iteration over, IS_FIRST or not; IS_MORE: more are to come.
template <class Fields>
PALPATE void newton_update(const Fields& f, Thread t, int flags) {
  const float h = f.state.step.data[4 * t.world];
  each_slice(t, f.shape.nslice, [&](int s, Lane lane) {
    const size_t at = 24 * ((size_t)t.world * f.shape.nslice + s);
    V3 dv = ld3(f.system.sol.data + at, lane);
    if (!(flags & IS_FIRST)) dv += ld3(f.state.dvel.data + at, lane);
    st3(f.state.dvel.data + at, dv, lane);
    if (flags & IS_MORE) {
      const V3 v = ld3(f.state.vel.data + at, lane) + dv;
      st3(f.system.vel_trial.data + at, v, lane);
      st3(f.system.disp_trial.data + at, ld3(f.state.disp.data + at, lane) + h * v, lane);
    }
  });
}

}  // namespace palpate
