// What the coarser meshes of the multilevel preconditioner have of the finest one.
#pragma once
#include "simd.h"

namespace palpate {

// The trial shape at the coarse nodes, and their masses: a node's own for all it stands for.
template <class Cycle>
PALPATE void sample(const Cycle& c, Thread t, int) {
  const size_t fine = (size_t)t.world * c.fine.shape.nslice;
  const size_t coarse = (size_t)t.world * c.coarse.shape.nslice;
  const float* disp = c.fine.system.disp_trial.data + 24 * fine;
  const float* mass = c.fine.state.mass.data + 8 * fine;
  float* to = c.coarse.system.disp_trial.data + 24 * coarse;
  float* mass_to = c.coarse.state.mass.data + 8 * coarse;
  each_slice(t, c.coarse.shape.nslice, [&](int s, Lane lane) {
    const int* node = c.transfer.source.data + 8 * s;
    st3(to + 24 * s, gather3(disp, node, lane), lane);
    st(mass_to, s, gather_scalar(mass, node, lane) * ld(c.transfer.share.data, s, lane), lane);
  });
}

}  // namespace palpate
