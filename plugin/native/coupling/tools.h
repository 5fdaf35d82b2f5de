// Tools of an organ: how fast they are.
#pragma once
#include "forces/bodies.h"

namespace palpate {

// Flags whether a tool is faster than FAST, at its farthest point: it may go through an organ and
// out again between two looks.
template <class Fields>
PALPATE void find_fast(const Fields& f, Thread, int) {
  bool fast = false;
  for (int k = 0; k < f.ntool && !fast; ++k) {
    const int geom = f.tool.data[k], body = f.geom_bodyid.data[geom];
    const Twist moving = {load(f.cvel.data + 6 * body), load(f.cvel.data + 6 * body + 3)};
    const D3 vel = velocity_at(moving, arm_of(f, body, load(f.geom_xpos.data + 3 * geom)));
    fast = norm(vel) + f.reach.data[k] * norm(moving.spin) > FAST;
  }
  f.flags.data[FLAG_FAST] = fast;
}

}  // namespace palpate
