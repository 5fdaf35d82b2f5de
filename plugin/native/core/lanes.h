// The lanes of a warp that share a world on CUDA; on the CPU a world has one thread, for which all here is a plain
// loop. All lanes run the same code: what one writes, others read after they have met.
#pragma once
#include "core/simd.h"

namespace palpate {

#if ON_CUDA
constexpr int TOGETHER = 32;
PALPATE int own_lane() { return threadIdx.x % TOGETHER; }
PALPATE void meet_lanes() { __syncwarp(); }
PALPATE double sum_together(double v) {
  for (int o = TOGETHER / 2; o > 0; o >>= 1) v += __shfl_xor_sync(0xffffffffu, v, o);
  return v;
}
PALPATE double most_together(double v) {
  for (int o = TOGETHER / 2; o > 0; o >>= 1) {
    const double other = __shfl_xor_sync(0xffffffffu, v, o);
    v = other > v ? other : v;
  }
  return v;
}
#else
constexpr int TOGETHER = 1;
PALPATE int own_lane() { return 0; }
PALPATE void meet_lanes() {}
PALPATE double sum_together(double v) { return v; }
PALPATE double most_together(double v) { return v; }
#endif
PALPATE double least_together(double v) { return -most_together(-v); }

// Runs body() in one lane.
template <class Body>
PALPATE void one_lane(Body body) {
  meet_lanes();
  if (own_lane() == 0) body();
  meet_lanes();
}

// Runs body(i) for each i from `from` to `to`, of which none writes what another reads or writes.
template <class Body>
PALPATE void each_lane(int from, int to, Body body) {
  for (int i = from + own_lane(); i < to; i += TOGETHER) body(i);
  meet_lanes();
}

// The same where those that are at least APART from each other may.
template <int APART, class Body>
PALPATE void each_apart(int from, int to, Body body) {
  constexpr int rounds = ON_CUDA ? APART : 1;
  for (int round = 0; round < rounds; ++round) each_lane(0, (to - from - round + rounds - 1) / rounds, [&](int k) {
    body(from + round + rounds * k);
  });
}

// Runs finds(i, own) for each i up to n, and in their order puts(own), `own` an empty Own, where that was true.
template <class Own, class Finds, class Puts>
PALPATE void each_in_turn(int n, Finds finds, Puts puts) {
  for (int from = 0; from < n; from += TOGETHER) {
    const int i = from + own_lane();
    Own own;
    const bool found = i < n && finds(i, own);
    for (int lane = 0; lane < TOGETHER; ++lane) {
      if (lane == own_lane() && found) puts(own);
      meet_lanes();
    }
  }
}

}  // namespace palpate
