// The solve of a solid: as that of a surface, but for the matrix.
#pragma once
#include "solver/pcg.h"

namespace palpate {

// A node inside has up to forty neighbours, one of a surface six, and the longest row is what all wait
// for: on CUDA SPLIT threads share a row where there is one world, which has threads enough.
template <class Fields>
PALPATE void solve_solid(const Fields& f, Thread t, int stage) {
  solve<SPLIT>(f, t, stage, solid_matrix(f, t.world));
}

template <class Fields>
PALPATE void solve_solids(const Fields& f, Thread t, int stage) {
  solve<1>(f, t, stage, solid_matrix(f, t.world));
}

}  // namespace palpate
