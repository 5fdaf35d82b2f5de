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
PALPATE int least_together(int v) { return __reduce_min_sync(0xffffffffu, v); }
// The sum of v over the lanes up to this one, or the most.
PALPATE int sum_up_to(int v) {
  for (int o = 1; o < TOGETHER; o <<= 1) {
    const int before = __shfl_up_sync(0xffffffffu, v, o);
    if (own_lane() >= o) v += before;
  }
  return v;
}
PALPATE int most_up_to(int v) {
  for (int o = 1; o < TOGETHER; o <<= 1) {
    const int before = __shfl_up_sync(0xffffffffu, v, o);
    if (own_lane() >= o && before > v) v = before;
  }
  return v;
}
// Notes each i from `from` up to `to` where is(i), in their order; returns how many there are.
template <class Is>
PALPATE int note_those(int from, int to, Is is, int* into) {
  int count = 0;
  for (; from < to; from += TOGETHER) {
    const int i = from + own_lane();
    const bool own = i < to && is(i);
    const unsigned all = __ballot_sync(0xffffffffu, own);
    if (own) into[count + __popc(all & ((1u << own_lane()) - 1))] = i;
    count += __popc(all);
  }
  meet_lanes();
  return count;
}
PALPATE int of_last_lane(int v) { return __shfl_sync(0xffffffffu, v, TOGETHER - 1); }
// What several lanes may do to one number.
PALPATE void lower(int& at, int v) { atomicMin(&at, v); }
PALPATE void raise(int& at, int v) { atomicMax(&at, v); }
PALPATE void set_bits(unsigned& at, unsigned bits) { atomicOr(&at, bits); }
#else
constexpr int TOGETHER = 1;
PALPATE int own_lane() { return 0; }
PALPATE void meet_lanes() {}
PALPATE double sum_together(double v) { return v; }
PALPATE double most_together(double v) { return v; }
PALPATE int least_together(int v) { return v; }
PALPATE void lower(int& at, int v) { at = v < at ? v : at; }
PALPATE void set_bits(unsigned& at, unsigned bits) { at |= bits; }
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

// Runs finds(i, own) for each i up to n, and in their order, by all lanes together, puts(own), `own` an empty Own, where
// that was true.
template <class Own, class Finds, class Puts>
PALPATE void each_in_turn(int n, Finds finds, Puts puts) {
#if ON_CUDA
  __shared__ double memory[(sizeof(Own) + 7) / 8];
  Own& shared = *(Own*)memory;
  for (int from = 0; from < n; from += TOGETHER) {
    const int i = from + own_lane();
    Own own;
    const bool found = i < n && finds(i, own);
    for (unsigned all = __ballot_sync(0xffffffffu, found); all; all &= all - 1) {
      if (own_lane() == __ffs(all) - 1) shared = own;
      meet_lanes();
      puts(shared);
      meet_lanes();
    }
  }
  meet_lanes();
#else
  for (int i = 0; i < n; ++i) {
    Own own;
    if (finds(i, own)) puts(own);
  }
#endif
}

// Runs puts(i, at) for each i up to n, where those before it have put `at` in all, and returns how many all have put.
// puts(i, at) returns how many it puts; below 0 that is all it does.
template <class Puts>
PALPATE int each_after(int n, Puts puts) {
  int all = 0;
#if ON_CUDA
  for (int from = 0; from < n; from += TOGETHER) {
    const int i = from + own_lane(), own = i < n ? puts(i, -1) : 0, up_to = sum_up_to(own);
    if (own) puts(i, all + up_to - own);
    all += of_last_lane(up_to);
  }
  meet_lanes();
#else
  for (int i = 0; i < n; ++i) all += puts(i, all);
#endif
  return all;
}

}  // namespace palpate
