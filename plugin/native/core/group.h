// The threads of a world as a group: sums over its nodes, the same value in every thread, and
// vectors of which each reads what others wrote.
//
// On the CPU a world has one thread. On CUDA it has `nthread` in whole blocks, all resident. What
// they tell each other goes through memory in words of 128 bits, three numbers and the number of
// the turn, which are written and read whole: a thread that waits for a word needs neither counter nor
// fence. Turns go on from launch to launch; the last one is kept behind the words. In a meeting
// each block publishes its sums and reads those of all, in two sets that alternate: who meets again
// has read the set before. The order of summation is fixed, so that runs repeat to the bit.
//
// BLOCK is the most threads of a block, MAX_BLOCKS the most blocks of a world, WORDS what a world
// has of words. Otherwise everything here has the same name and meaning for both devices.
#pragma once
#include "core/block.h"
#include "core/packed.h"

namespace palpate {

// What a meeting is for: sums alone, or that all memory written before is seen after.
enum Meeting { SUMS, MEMORY };

// How many of its nodes a thread may keep in registers; 0: none, and it has any number.
template <int N>
struct Own {
  static constexpr int COUNT = N, SIZE = N > 0 ? N : 1;
};

// A vector that no other thread reads, in registers where there is room for it.
template <int OWN>
class OwnVector {
 public:
  PALPATE OwnVector(float* memory) : memory(memory) {}
  PALPATE V3 get(int s, Lane lane, int k) const {
    return OWN ? own[OWN ? k : 0] : ld3(memory + 24 * s, lane);
  }
  PALPATE void put(int s, V3 a, Lane lane, int k) {
    if (OWN) own[OWN ? k : 0] = a; else st3(memory + 24 * s, a, lane);
  }
  PALPATE void store(int s, Lane lane, int k) const {
    if (OWN) st3(memory + 24 * s, own[OWN ? k : 0], lane);
  }

 private:
  float* const memory;
  V3 own[Own<OWN>::SIZE];
};

#if ON_CUDA

// Which of the SPLIT threads of a node this is.
template <int SPLIT>
PALPATE int part_of() { return SPLIT > 1 ? threadIdx.x / LANES % SPLIT : 0; }

template <Meeting FOR = MEMORY, int SPLIT = 1>
class Group {
 public:
  static constexpr bool SUMS_COST = true;
  const int tid, nthread;
  unsigned turn;

  PALPATE Group(Thread t, float* partial)
    : tid(t.tid), nthread(t.nthread), words(partial + 4 * WORDS * (size_t)t.world),
      nblock(t.nthread / blockDim.x), block(t.tid / blockDim.x), flip(0) {
    turn = *kept();
    __syncthreads();
  }
  PALPATE ~Group() {
    if (is_first()) *kept() = turn;
  }

  PALPATE bool is_first() const { return tid == 0; }

  // Runs body(s, lane) for the slices of this thread from `from` to `to`.
  template <class Body>
  PALPATE void each(int from, int to, Body body) const {
    const Lane lane = lane_of(tid);
    for (int s = from + tid / (LANES * SPLIT); s < to; s += nthread / (LANES * SPLIT))
      body(s, lane);
  }

  PALPATE float sum(V u) {
    float v[1] = {u};
    meet(v);
    return v[0];
  }
  PALPATE void sum(V u, V v, float& a, float& b) {
    float sums[2] = {u, v};
    meet(sums);
    a = sums[0]; b = sums[1];
  }
  PALPATE void sum(V u, V v, V w, float& a, float& b, float& c) {
    float sums[3] = {u, v, w};
    meet(sums);
    a = sums[0]; b = sums[1]; c = sums[2];
  }
  PALPATE void sync() { sum(0.0f); }
  // The greatest number >= 0 of the threads of one block.
  PALPATE float most(V v) {
    const int at = threadIdx.x & 31;
    WarpSums& mine = warp_sums()[flip];
    flip ^= 1;
    v = warp_most(v);
    if (at == 0) mine[0][threadIdx.x >> 5] = v;
    __syncthreads();
    return warp_most(at < blockDim.x >> 5 ? mine[0][at] : 0.0f);
  }

  // Slices of each block where each has its own, and where they begin.
  PALPATE int share(int nslice) const { return (nslice + nblock - 1) / nblock; }
  PALPATE int first_slice(int nslice) const { return block * share(nslice); }

 private:
  float* const words;
  const int nblock, block;
  unsigned flip;

  PALPATE volatile unsigned* kept() const {
    return (volatile unsigned*)(words + 8 * MAX_BLOCKS);
  }

  // Replaces v by the sums over the group.
  template <int N>
  PALPATE void meet(float (&v)[N]) {
    const int warp = threadIdx.x >> 5, at = threadIdx.x & 31, nwarp = blockDim.x >> 5;
    WarpSums& mine = warp_sums()[flip];
    float* set = words + 4 * MAX_BLOCKS * flip;
    flip ^= 1;
    ++turn;
    for (int c = 0; c < N; ++c) v[c] = warp_sum(part_of<SPLIT>() == 0 ? v[c] : 0.0f);
    if (at == 0) for (int c = 0; c < N; ++c) mine[c][warp] = v[c];
    __syncthreads();
    int nsum = nwarp, from = 0;
    if (nblock > 1) {
      if (warp == 0) publish<N>(mine, set);
      collect(v, mine, set);
      nsum = nwarp < (nblock + 31) / 32 ? nwarp : (nblock + 31) / 32;
      from = 3;
    }
    for (int c = 0; c < N; ++c) v[c] = warp_sum(at < nsum ? mine[from + c][at] : 0.0f);
  }

  // The first warp sums over its block and tells the others.
  template <int N>
  PALPATE void publish(WarpSums& mine, float* set) {
    const int at = threadIdx.x & 31, nwarp = blockDim.x >> 5;
    float sum[3] = {0.0f, 0.0f, 0.0f};
    for (int c = 0; c < N; ++c) sum[c] = warp_sum(at < nwarp ? mine[c][at] : 0.0f);
    if (at == 0) {
      if (FOR == MEMORY) __threadfence();
      Word({sum[0], sum[1], sum[2]}, turn).put(set + 4 * block);
    }
  }

  // Sums over all blocks, warp by warp.
  template <int N>
  PALPATE void collect(float (&v)[N], WarpSums& mine, const float* set) {
    const int warp = threadIdx.x >> 5, at = threadIdx.x & 31;
    for (int c = 0; c < N; ++c) v[c] = 0.0f;
    for (int b = threadIdx.x; b < nblock; b += blockDim.x) {
      Word word;
      do word.get(set + 4 * b); while (word.turn() != turn);
      const V3 found = word.value();
      const float w[3] = {found.x, found.y, found.z};
      for (int c = 0; c < N; ++c) v[c] += w[c];
    }
    if (warp * 32 < nblock) {
      if (FOR == MEMORY) __threadfence();
      for (int c = 0; c < N; ++c) v[c] = warp_sum(v[c]);
      if (at == 0) for (int c = 0; c < N; ++c) mine[3 + c][warp] = v[c];
    }
    __syncthreads();
  }
};

// The slices of a thread: OWN of its block's, or with 0 any of all.
template <int OWN, int SPLIT = 1>
class Slices {
 public:
  using Vector = OwnVector<OWN>;

  template <Meeting FOR>
  PALPATE Slices(const Group<FOR, SPLIT>& group, int nslice)
    : nslice(nslice), first(group.first_slice(nslice)), tid(group.tid), nthread(group.nthread) {
    const int end = first + group.share(nslice);
    last = end < nslice ? end : nslice;
  }

  // Runs body(s, lane, k) for the k-th of them.
  template <class Body>
  PALPATE void each(Body body) const {
    constexpr int SIZE = Own<OWN>::SIZE;
    const Lane lane = lane_of(tid);
#pragma unroll SIZE
    for (int k = 0, s = OWN ? first + threadIdx.x / (LANES * SPLIT) : tid / (LANES * SPLIT);
         OWN ? k < OWN : s < nslice; ++k, s += (OWN ? blockDim.x : nthread) / (LANES * SPLIT))
      if (OWN ? s < last : part_of<SPLIT>() == 0) body(s, lane, k);
  }

  // Where a node of slice `s` is in its block's memory; below 0 it is of another block.
  PALPATE int place(int s, int lane) const {
    return OWN && s >= first && s < last ? LANES * (s - first) + lane : -1;
  }

  const int nslice, first;
  int last;

 private:
  const int tid, nthread;
};

// Runs work(Own<N>()) for one, four or any number of nodes a thread, whichever suits.
template <Meeting FOR, int SPLIT, class Work>
PALPATE void choose_own(const Group<FOR, SPLIT>& group, int nslice, Work work) {
  const int own = (LANES * SPLIT * group.share(nslice) + blockDim.x - 1) / blockDim.x;
  if (own == 1) return work(Own<1>());
  if (own <= 4) return work(Own<4>());
  work(Own<0>());
}

// A vector of which each thread reads what others wrote in the present turn, without a meeting: a
// block's from its own memory, those of others word by word, for which it waits.
template <int OWN, int SPLIT = 1>
class Quads {
 public:
  static constexpr int PARTS = OWN ? SPLIT : 1;  // threads that share the neighbours of a node

  template <class Fields>
  PALPATE Quads(const Fields& f, int world, const Slices<OWN, SPLIT>& slices)
    : slices(slices), quad(f.system.quad.data + 96 * (size_t)world * f.shape.nslice),
      word(f.system.zn.data + 16 * (size_t)world * f.shape.nslice), turn(0) {}

  // What is shown after `next` is of a new turn, and read after `shown`.
  template <Meeting FOR>
  PALPATE void next(Group<FOR, SPLIT>& group) { turn = ++group.turn; }
  PALPATE void shown() { __syncthreads(); }

  PALPATE void show(int s, V3 a, Lane lane) {
    if (part_of<PARTS>() > 0) return;
    Word(a, turn).put(quad + 4 * (24 * s + lane));
    if (OWN) {
      const int at = LANES * (s - slices.first) + lane;
      block_nodes()[0][at] = a.x; block_nodes()[1][at] = a.y; block_nodes()[2][at] = a.z;
    }
  }
  PALPATE void show_normal(int s, V a, Lane lane) {
    if (part_of<PARTS>() > 0) return;
    HalfWord(a, turn).put(word + 2 * (LANES * s + lane));
    if (OWN) block_nodes()[3][LANES * (s - slices.first) + lane] = a;
  }

  PALPATE V3 own(int s, Lane lane) const {
    if (OWN) {
      const int at = LANES * (s - slices.first) + lane;
      return {block_nodes()[0][at], block_nodes()[1][at], block_nodes()[2][at]};
    }
    Word found;
    found.get(quad + 4 * (24 * s + lane));
    return found.value();
  }

  // Runs body(weight(k), value) for this thread's neighbours, one after the other.
  template <class Weight, class Body>
  PALPATE void each_near(const int* node, int width, Lane lane, Weight weight, Body body) const {
    const auto place = [&](int at) { return slices.place(at / 24, at % 24); };
    each<3, Word>(quad, node, width, lane, place, weight, body);
  }
  // The same for normal components and nodes numbered one by one.
  template <class Weight, class Body>
  PALPATE void each_bent(const int* node, int width, Lane lane, Weight weight, Body body) const {
    const auto place = [&](int at) { return slices.place(at >> 3, at & 7); };
    each<6, HalfWord>(word, node, width, lane, place, weight, body);
  }
  // Sum of what the threads of a node have of one.
  PALPATE static V joined(V a) {
    constexpr unsigned ALL = LANES * PARTS;  // threads of a slice
    const unsigned mask = 0xffffffffu >> (32 - ALL) << (threadIdx.x % 32 / ALL * ALL);
    for (int o = LANES; o < ALL; o *= 2) a += __shfl_xor_sync(mask, a, o);
    return a;
  }
  PALPATE static V3 joined(V3 a) { return {joined(a.x), joined(a.y), joined(a.z)}; }

 private:
  const Slices<OWN, SPLIT>& slices;
  float* const quad;
  float* const word;
  unsigned turn;

  // The words of AHEAD neighbours are under way at once, hence no branches before they are used, and
  // weights are read while they are.
  template <int AHEAD, class Any, class Place, class Weight, class Body>
  PALPATE void each(
    const float* words, const int* node, int width, Lane lane, Place place, Weight weight, Body body
  ) const {
    using Weighs = decltype(weight(0));
    for (int i = part_of<PARTS>(); i < width; i += AHEAD * PARTS) {
      Any found[AHEAD];
      Weighs weighs[AHEAD];
      int at[AHEAD];
      for (int b = 0; b < AHEAD; ++b) {
        const int k = i + b * PARTS;
        at[b] = k < width ? node[LANES * k + lane] : -1;
      }
      for (int b = 0; b < AHEAD; ++b) {
        const bool has = at[b] >= 0;
        const int here = has ? place(at[b]) : -1;
        found[b] = Any::near(here < 0 ? 0 : here, turn);
        found[b].get(words + Any::SIZE * at[b], has && here < 0);
      }
      for (int b = 0; b < AHEAD; ++b) weighs[b] = weight(at[b] < 0 ? i : i + b * PARTS);
      for (int b = 0; b < AHEAD; ++b) {
        if (at[b] < 0) continue;
        while (found[b].turn() != turn) found[b].get(words + Any::SIZE * at[b]);
        body(weighs[b], found[b].value());
      }
    }
  }
};

#else

PALPATE float sum_of(V a) {
  return ((a[0] + a[4]) + (a[1] + a[5])) + ((a[2] + a[6]) + (a[3] + a[7]));
}

template <Meeting FOR = MEMORY, int = 1>
class Group {
 public:
  static constexpr bool SUMS_COST = false;

  PALPATE Group(Thread, float*) {}
  PALPATE bool is_first() const { return true; }
  template <class Body>
  PALPATE void each(int from, int to, Body body) const {
    for (int s = from; s < to; ++s) INLINED body(s, Lane());
  }
  PALPATE float sum(V u) { return sum_of(u); }
  PALPATE void sum(V u, V v, float& a, float& b) { a = sum_of(u); b = sum_of(v); }
  PALPATE void sum(V u, V v, V w, float& a, float& b, float& c) { sum(u, v, a, b); c = sum_of(w); }
  PALPATE void sync() {}
  PALPATE float most(V v) { return __builtin_reduce_max(v); }
};

template <int OWN, int SPLIT = 1>
class Slices {
 public:
  using Vector = OwnVector<OWN>;

  template <Meeting FOR>
  PALPATE Slices(const Group<FOR, SPLIT>&, int nslice) : nslice(nslice) {}
  template <class Body>
  PALPATE void each(Body body) const {
    for (int s = 0; s < nslice; ++s) INLINED body(s, Lane(), 0);
  }

  const int nslice;
};

template <Meeting FOR, int SPLIT, class Work>
PALPATE void choose_own(const Group<FOR, SPLIT>&, int, Work work) {
  INLINED work(Own<0>());
}

// A vector in quads.
template <int OWN, int SPLIT = 1>
class Quads {
 public:
  template <class Fields>
  PALPATE Quads(const Fields& f, int world, const Slices<OWN, SPLIT>&)
    : zn(f.system.zn.data + 8 * (size_t)world * f.shape.nslice),
      quad(f.system.quad.data + 96 * (size_t)world * f.shape.nslice) {}
  template <Meeting FOR>
  PALPATE void next(Group<FOR, SPLIT>&) {}
  PALPATE void shown() {}
  PALPATE void show(int s, V3 a, Lane) { put_quads(quad + 96 * s, a); }
  PALPATE void show_normal(int s, V a, Lane lane) { st(zn, s, a, lane); }
  PALPATE V3 own(int s, Lane) const { return ld_quads(quad + 96 * s); }
  template <class Weight, class Body>
  PALPATE void each_near(const int* node, int width, Lane, Weight weight, Body body) const {
    for (int i = 0; i < width; ++i, node += LANES)
      INLINED body(weight(i), gather_quads(quad, node));
  }
  template <class Weight, class Body>
  PALPATE void each_bent(const int* node, int width, Lane lane, Weight weight, Body body) const {
    for (int i = 0; i < width; ++i, node += LANES)
      INLINED body(weight(i), gather(zn, node, 0, lane));
  }
  template <class Any>
  PALPATE static Any joined(Any a) { return a; }

 private:
  float* const zn;
  float* const quad;
};

#endif

}  // namespace palpate
