// Tools of an organ: how fast they are.
#pragma once
#include "d3.h"

namespace palpate {

// Flags whether a tool is faster than FAST, at an end of a long one: it may go through an organ and
// out again between two looks. A body's velocity is that at its tree's centre of mass.
template <class Fields>
PALPATE void find_fast(const Fields& f, Thread, int) {
  bool fast = false;
  for (int k = 0; k < f.ntool && !fast; ++k) {
    const int geom = f.tool.data[k], body = f.geom_bodyid.data[geom];
    const D3 w = load(f.cvel.data + 6 * body);
    const D3 r = load(f.geom_xpos.data + 3 * geom)
      - load(f.subtree_com.data + 3 * f.body_rootid.data[body]);
    const D3 turn = {w.y * r.z - w.z * r.y, w.z * r.x - w.x * r.z, w.x * r.y - w.y * r.x};
    fast = norm(load(f.cvel.data + 6 * body + 3) + turn) + f.half.data[k] * norm(w) > FAST;
  }
  f.flags.data[FLAG_FAST] = fast;
}

}  // namespace palpate
