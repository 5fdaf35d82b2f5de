// A block of threads on CUDA: its memory, its warps' sums, and the words in which blocks tell each
// other. On the CPU a world has one thread, for which there is nothing to do.
#pragma once
#include "core/simd.h"

namespace palpate {

// Whether threads come in blocks.
constexpr bool BLOCKS = ON_CUDA;

#if ON_CUDA

// Memory of a block: two sets of what its warps and shares of blocks sum up to, and x, y, z and the
// normal component of a vector at its nodes.
using WarpSums = float[6][32];
PALPATE WarpSums* warp_sums() {
  __shared__ WarpSums sums[2];
  return sums;
}
using BlockNodes = float[4 * BLOCK];
PALPATE BlockNodes* block_nodes() {
  __shared__ BlockNodes nodes[4];
  return nodes;
}

// That of a block that has a world to itself, as many floats as the launch gives it; none on the CPU.
PALPATE float* block_memory() {
  extern __shared__ float palpate_memory[];
  return palpate_memory;
}
PALPATE int block_room() {
  unsigned bytes;
  asm("mov.u32 %0, %%dynamic_smem_size;" : "=r"(bytes));
  return bytes / 4;
}
PALPATE void meet_block() { __syncthreads(); }
// Fetches what is read after the next meetings.
PALPATE void soon(const float* p, Lane lane) {
  asm volatile("prefetch.global.L2 [%0];" :: "l"(p + lane));
}

// Three numbers and a turn in 128 bits.
class Word {
 public:
  static constexpr int SIZE = 4;  // floats

  PALPATE Word() : low(0), high(0) {}
  PALPATE Word(V3 a, unsigned turn)
    : low(pair(a.x, __float_as_uint(a.y))), high(pair(a.z, turn)) {}
  // That of a node of this block.
  PALPATE static Word near(int at, unsigned turn) {
    const BlockNodes* p = block_nodes();
    return Word({p[0][at], p[1][at], p[2][at]}, turn);
  }
  PALPATE V3 value() const {
    return {__uint_as_float((unsigned)low), __uint_as_float((unsigned)(low >> 32)),
            __uint_as_float((unsigned)high)};
  }
  PALPATE unsigned turn() const { return (unsigned)(high >> 32); }
  PALPATE void put(float* p) const {
    asm volatile("{.reg .b128 w; mov.b128 w, {%1, %2}; st.relaxed.gpu.global.b128 [%0], w;}"
      :: "l"(p), "l"(low), "l"(high) : "memory");
  }
  PALPATE void get(const float* p, bool wanted = true) {
    asm volatile("{.reg .b128 w; .reg .pred q; setp.ne.b32 q, %3, 0; mov.b128 w, {%0, %1};"
      " @q ld.relaxed.gpu.global.b128 w, [%2]; mov.b128 {%0, %1}, w;}"
      : "+l"(low), "+l"(high) : "l"(p), "r"((int)wanted) : "memory");
  }
  PALPATE static unsigned long long pair(float a, unsigned b) {
    return (unsigned long long)b << 32 | __float_as_uint(a);
  }

 private:
  unsigned long long low, high;
};

// One number and a turn in 64 bits.
class HalfWord {
 public:
  static constexpr int SIZE = 2;

  PALPATE HalfWord() : bits(0) {}
  PALPATE HalfWord(float a, unsigned turn) : bits(Word::pair(a, turn)) {}
  PALPATE static HalfWord near(int at, unsigned turn) {
    return HalfWord(block_nodes()[3][at], turn);
  }
  PALPATE float value() const { return __uint_as_float((unsigned)bits); }
  PALPATE unsigned turn() const { return (unsigned)(bits >> 32); }
  PALPATE void put(float* p) const {
    asm volatile("st.relaxed.gpu.global.b64 [%0], %1;" :: "l"(p), "l"(bits) : "memory");
  }
  PALPATE void get(const float* p, bool wanted = true) {
    asm volatile("{.reg .pred q; setp.ne.b32 q, %2, 0; @q ld.relaxed.gpu.global.b64 %0, [%1];}"
      : "+l"(bits) : "l"(p), "r"((int)wanted) : "memory");
  }

 private:
  unsigned long long bits;
};

PALPATE float warp_sum(float v) {
  for (int o = 16; o > 0; o >>= 1) v += __shfl_xor_sync(0xffffffffu, v, o);
  return v;
}

PALPATE float warp_most(float v) {
  for (int o = 16; o > 0; o >>= 1) v = fmaxf(v, __shfl_xor_sync(0xffffffffu, v, o));
  return v;
}

// The least number of a warp, of equal ones that with the least key, and what is with it.
template <int N>
PALPATE void warp_least(double& least, int& key, double (&with)[N]) {
  const unsigned all = 0xffffffffu;
  for (int o = 16; o > 0; o >>= 1) {
    const double value = __shfl_xor_sync(all, least, o);
    const int k = __shfl_xor_sync(all, key, o);
    const bool less = value < least || (value == least && k < key);
    for (int c = 0; c < N; ++c) {
      const double other = __shfl_xor_sync(all, with[c], o);
      with[c] = less ? other : with[c];
    }
    least = less ? value : least;
    key = less ? k : key;
  }
}

#else

template <int N>
PALPATE void warp_least(double&, int&, double (&)[N]) {}
PALPATE float* block_memory() { return nullptr; }
PALPATE int block_room() { return 0; }
PALPATE void meet_block() {}
PALPATE void soon(const float*, Lane) {}

#endif

}  // namespace palpate
