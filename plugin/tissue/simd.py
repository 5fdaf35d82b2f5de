"""One source for both devices: native element code over slices of eight nodes.

Nodes are stored in slices of `LANES`: an array of vectors is (nworld, nslice, 3, 8), so that one
slice is a SIMD register on the CPU and eight neighbouring threads on CUDA, and the three components
of a node lie within two cache lines. In native code `V` is a vector of eight floats on the CPU and
one float on CUDA; `LD`, `ST` and `GATHER` hide the difference, and `PUT_MOST` keeps the largest of
numbers >= 0. Irregular lists (the neighbours of a node) are sliced ELLPACK: row `k` of slice `s`
holds the k-th entry of its eight nodes (Kreutzer et al. 2014, SELL-C-sigma,
doi:10.1137/130930352). On the CPU gathering is most of an iteration, so what is gathered often is
kept in quads as well, see `GATHER_QUADS`; `group` says how the threads of a world work together.
"""

LANES = 8

_PRELUDE = """
#ifndef PALPATE_SIMD
#define PALPATE_SIMD
#if defined(__CUDA_ARCH__) || defined(__CUDACC_RTC__)
  #define SIMD_TYPES typedef float V; typedef float VU;
  #define LD(p, r) ((p)[8 * (r) + lane])
  #define ST(p, r, v) ((p)[8 * (r) + lane] = (v))
  #define GATHER(p, o, c) ((p)[(o)[lane] + 8 * (c)])
  #define SQRT(a) sqrtf(a)
  #define MAX(a, b) fmaxf(a, b)
  #define MIN(a, b) fminf(a, b)
  #define SPLAT(a) (a)
  #define HSUM(a) (a)
  #define PUT_MOST(p, v) \\
    if (__float_as_int(v) > *(volatile int*)(p)) atomicMax((int*)(p), __float_as_int(v));
  #define SELECT(c, a, b) ((c) ? (a) : (b))
  #define FOR_RANGE(s, from, to) for (int s = (from) + (tid >> 3); s < (to); s += nthread >> 3)
  #define FOR_OWN(k, s) _Pragma("unroll OWN_SIZE") \\
    for (int k = 0, s = OWN ? first_ + (thread >> 3) : tid >> 3; \\
         OWN ? k < OWN : s < nslice; ++k, s += (OWN ? blockDim.x : nthread) >> 3) \\
      if (!OWN || s < last_)
  #define OWN_VECTOR(name, p) float* name = p; float name##_[OWN_SIZE][3];
  #define GET(name, c) (OWN ? name##_[OWN ? k : 0][c] : LD(name + 24 * s, c))
  #define PUT(name, c, v) if (OWN) name##_[OWN ? k : 0][c] = v; else ST(name + 24 * s, c, v);
#else
  #define SIMD_TYPES \\
    typedef float V __attribute__((ext_vector_type(8))); \\
    typedef float VU __attribute__((ext_vector_type(8), aligned(4))); \\
    typedef float QUAD __attribute__((ext_vector_type(4)));
  #define LD(p, r) ((V) * (const VU*)((p) + 8 * (r)))
  #define ST(p, r, v) (*(VU*)((p) + 8 * (r)) = (VU)(v))
  #define AT(p, o, c, l) (p)[(o)[l] + 8 * (c)]
  #define GATHER(p, o, c) (V){AT(p, o, c, 0), AT(p, o, c, 1), AT(p, o, c, 2), AT(p, o, c, 3), \\
    AT(p, o, c, 4), AT(p, o, c, 5), AT(p, o, c, 6), AT(p, o, c, 7)}
  // Quads: x, y, z and 0 of a node side by side, at four times its offset in vectors of slices.
  // Eight of them are read in eight loads and seven shuffles, where GATHER takes 24 and 21.
  #define PICK __builtin_shufflevector
  #define LOWS(a, b) PICK(a, b, 0, 8, 1, 9, 4, 12, 5, 13)
  #define HIGHS(a, b) PICK(a, b, 2, 10, 3, 11, 6, 14, 7, 15)
  #define FRONTS(a, b) PICK(a, b, 0, 1, 8, 9, 4, 5, 12, 13)
  #define BACKS(a, b) PICK(a, b, 2, 3, 10, 11, 6, 7, 14, 15)
  #define QUAD_AT(q, o, l) (*(const QUAD*)((q) + 4 * (long long)(o)[l]))
  #define TWO_QUADS(q, o, l) \\
    PICK(QUAD_AT(q, o, l), QUAD_AT(q, o, (l) + 4), 0, 1, 2, 3, 4, 5, 6, 7)
  #define GATHER_QUADS(x, y, z, p, quads, o) \\
    V x, y, z; \\
    { \\
      const V a_ = TWO_QUADS(quads, o, 0), b_ = TWO_QUADS(quads, o, 1); \\
      const V c_ = TWO_QUADS(quads, o, 2), d_ = TWO_QUADS(quads, o, 3); \\
      const V e_ = LOWS(a_, b_), f_ = LOWS(c_, d_); \\
      x = FRONTS(e_, f_); y = BACKS(e_, f_); z = FRONTS(HIGHS(a_, b_), HIGHS(c_, d_)); \\
    }
  #define PUT_QUADS(q, x, y, z) \\
    { \\
      const V w_ = {}; \\
      const V a_ = LOWS(x, y), b_ = HIGHS(x, y), c_ = LOWS(z, w_), d_ = HIGHS(z, w_); \\
      const V e_ = FRONTS(a_, c_), f_ = BACKS(a_, c_), g_ = FRONTS(b_, d_), h_ = BACKS(b_, d_); \\
      ST(q, 0, PICK(e_, f_, 0, 1, 2, 3, 8, 9, 10, 11)); \\
      ST(q, 1, PICK(g_, h_, 0, 1, 2, 3, 8, 9, 10, 11)); \\
      ST(q, 2, PICK(e_, f_, 4, 5, 6, 7, 12, 13, 14, 15)); \\
      ST(q, 3, PICK(g_, h_, 4, 5, 6, 7, 12, 13, 14, 15)); \\
    }
  #define SQRT(a) __builtin_elementwise_sqrt(a)
  #define MAX(a, b) __builtin_elementwise_max(a, b)
  #define MIN(a, b) __builtin_elementwise_min(a, b)
  #define SPLAT(a) ((V)(a))
  #define HSUM(a) (((a)[0] + (a)[4]) + ((a)[1] + (a)[5]) + (((a)[2] + (a)[6]) + ((a)[3] + (a)[7])))
  #define PUT_MOST(p, v) \\
    { const float most_ = __builtin_reduce_max(v); if (most_ > *(p)) *(p) = most_; }
  #define SELECT(c, a, b) ((c) ? (a) : (b))
  #define FOR_RANGE(s, from, to) for (int s = from; s < (to); ++s)
  #define FOR_OWN(k, s) for (int s = 0; s < nslice; ++s)
  #define OWN_VECTOR(name, p) float* name = p;
  #define GET(name, c) LD(name + 24 * s, c)
  #define PUT(name, c, v) ST(name + 24 * s, c, v);
#endif
#define FOR_SLICES(s) FOR_RANGE(s, 0, nslice)
#endif
"""

# Sums over all nodes of a world, the same value in every thread, and barriers. On CUDA a world is a
# group of `nthread` threads in whole blocks that are all resident. What they tell each other goes
# through memory in words of 128 bits, three numbers and the number of the turn, which are written
# and read whole: whoever waits for a word needs neither counter nor fence. Turns go on from launch
# to launch; the last one is kept behind the words. In a meeting each block publishes its sums and
# reads those of all, in two sets that alternate: who meets again has read the set before. The order
# of summation is fixed, so that runs repeat to the bit. Other memory written before a meeting is
# seen after it where `SEEN`.
_GROUP = """
#if defined(__CUDA_ARCH__) || defined(__CUDACC_RTC__)
  __shared__ float red[2][6][32];
  const int lane = tid & 7, thread = threadIdx.x, nwarp = blockDim.x >> 5;
  const int nblock = nthread / blockDim.x, block_ = tid / blockDim.x;
  float* words_ = partial_.data + WORDS * (size_t)world;
  volatile unsigned* kept_ = (volatile unsigned*)(words_ + 8 * MAXBLOCK);
  unsigned turn_ = *kept_, flip_ = 0;
  __syncthreads();
  struct Keep_ {
    volatile unsigned* at;
    const unsigned& turn;
    const bool mine;
    __device__ ~Keep_() { if (mine) *at = turn; }
  } keep_{kept_, turn_, tid == 0};
  typedef unsigned long long Two_;
  auto pack = [](Two_& w, float a, unsigned b) { w = (Two_)b << 32 | __float_as_uint(a); };
  auto lower = [](Two_ w) -> float { return __uint_as_float((unsigned)w); };
  auto upper = [](Two_ w) -> float { return __uint_as_float((unsigned)(w >> 32)); };
  auto put_word = [&](float* p, float a, float b, float c, unsigned turn) {
    Two_ low, high;
    pack(low, a, __float_as_uint(b));
    pack(high, c, turn);
    asm volatile("{.reg .b128 w; mov.b128 w, {%1, %2}; st.relaxed.gpu.global.b128 [%0], w;}"
      :: "l"(p), "l"(low), "l"(high) : "memory");
  };
  auto get_word_if = [](bool wanted, const float* p, Two_& low, Two_& high) {
    asm volatile("{.reg .b128 w; .reg .pred q; setp.ne.b32 q, %3, 0; mov.b128 w, {%0, %1};"
      " @q ld.relaxed.gpu.global.b128 w, [%2]; mov.b128 {%0, %1}, w;}"
      : "+l"(low), "+l"(high) : "l"(p), "r"((int)wanted) : "memory");
  };
  auto put_half_word = [&](float* p, float a, unsigned turn) {
    Two_ w;
    pack(w, a, turn);
    asm volatile("st.relaxed.gpu.global.b64 [%0], %1;" :: "l"(p), "l"(w) : "memory");
  };
  auto get_half_word_if = [](bool wanted, const float* p, Two_& w) {
    asm volatile("{.reg .pred q; setp.ne.b32 q, %2, 0; @q ld.relaxed.gpu.global.b64 %0, [%1];}"
      : "+l"(w) : "l"(p), "r"((int)wanted) : "memory");
  };
  auto warp_sum = [](float v) -> float {
    for (int o = 16; o > 0; o >>= 1) v += __shfl_xor_sync(0xffffffffu, v, o);
    return v;
  };
  // Sums one to three numbers over the group.
  auto meet = [&](auto& v, bool seen) {
    constexpr int N = sizeof(v) / sizeof(float);
    const int warp = thread >> 5, at = thread & 31;
    auto* mine = red[flip_];
    float* set = words_ + 4 * MAXBLOCK * flip_;
    flip_ ^= 1;
    ++turn_;
    for (int c = 0; c < N; ++c) v[c] = warp_sum(v[c]);
    if (at == 0) for (int c = 0; c < N; ++c) mine[c][warp] = v[c];
    __syncthreads();
    int nsum = nwarp, from = 0;
    if (nblock > 1) {
      if (warp == 0) {
        float sum[3] = {0.0f, 0.0f, 0.0f};
        for (int c = 0; c < N; ++c) sum[c] = warp_sum(at < nwarp ? mine[c][at] : 0.0f);
        if (at == 0) {
          if (seen) __threadfence();
          put_word(set + 4 * block_, sum[0], sum[1], sum[2], turn_);
        }
      }
      for (int c = 0; c < N; ++c) v[c] = 0.0f;
      for (int b = thread; b < nblock; b += blockDim.x) {
        Two_ low, high;
        do get_word_if(true, set + 4 * b, low, high); while ((unsigned)(high >> 32) != turn_);
        const float w[3] = {lower(low), upper(low), lower(high)};
        for (int c = 0; c < N; ++c) v[c] += w[c];
      }
      if (warp * 32 < nblock) {
        if (seen) __threadfence();
        for (int c = 0; c < N; ++c) v[c] = warp_sum(v[c]);
        if (at == 0) for (int c = 0; c < N; ++c) mine[3 + c][warp] = v[c];
      }
      __syncthreads();
      nsum = nwarp < (nblock + 31) / 32 ? nwarp : (nblock + 31) / 32;
      from = 3;
    }
    for (int c = 0; c < N; ++c) {
      v[c] = 0.0f;
      for (int w = 0; w < nsum; ++w) v[c] += mine[from + c][w];
    }
  };
  auto group_sum = [&](float u) -> float {
    float v[1] = {u};
    meet(v, SEEN);
    return v[0];
  };
  #define GROUP_SUMS(u, v, a, b) float a, b; \\
    { float sums_[2] = {u, v}; meet(sums_, SEEN); a = sums_[0]; b = sums_[1]; }
  #define GROUP_SUMS3(u, v, w, a, b, c) float a, b, c; \\
    { float sums_[3] = {u, v, w}; meet(sums_, SEEN); a = sums_[0]; b = sums_[1]; c = sums_[2]; }
  #define GROUP_SYNC() group_sum(0.0f)
#else
  const int lane = 0, thread = 0;
  auto group_sum = [&](V v) -> float { return HSUM(v); };
  #define GROUP_SUMS(u, v, a, b) float a = HSUM(u), b = HSUM(v);
  #define GROUP_SUMS3(u, v, w, a, b, c) float a = HSUM(u), b = HSUM(v), c = HSUM(w);
  #define GROUP_SYNC()
#endif
"""
from .device import BLOCK, MAX_BLOCKS, WORDS


def group(body: str, seen: bool = True) -> str:
  """Returns native code in which all threads of a world work on `body` together.

  Arguments: `world`, `tid`, `nthread`, `nslice` and `partial_` (nworld, WORDS, 4), which is zero
  before the first launch. On the CPU there is one thread.

  Args:
    body: the code
    seen: whether what a thread writes to memory before a meeting is seen after it by the others
  """
  words = _GROUP.replace("MAXBLOCK", str(MAX_BLOCKS)).replace("WORDS", str(4 * WORDS))
  return function(words.replace("SEEN", str(seen).lower()) + body)


def owned(body: str, wanted: bool = True) -> str:
  """Returns code of a group in which each thread may keep up to four of its nodes in registers.

  `body` is compiled for one, four and any number of nodes a thread, `OWN`, 0 for any. In it an
  `OWN_VECTOR` is a vector that no other thread reads, and `GET` and `PUT` are for the node of
  `FOR_OWN(k, s)`. A block then has the slices from `first_` to `last_`, and four numbers of each of
  their nodes have room in `near_`.

  Args:
    body: the code
    wanted: whether to keep them there; otherwise `OWN` is 0
  """
  sizes = """
  if (own_ == 1) { run_((char(*)[2])nullptr); return; }
  if (own_ <= 4) { run_((char(*)[5])nullptr); return; }
"""
  return f"""
#if defined(__CUDA_ARCH__) || defined(__CUDACC_RTC__)
  const int chunk_ = (nslice + nblock - 1) / nblock, first_ = block_ * chunk_;
  const int last_ = first_ + chunk_ < nslice ? first_ + chunk_ : nslice;
  const int own_ = (8 * chunk_ + blockDim.x - 1) / blockDim.x;
  __shared__ float near_[4][{4 * BLOCK if wanted else 1}];
  auto run_ = [&](auto size_) {{
    constexpr int OWN = sizeof(*size_) - 1, OWN_SIZE = OWN > 0 ? OWN : 1;
#else
  constexpr int OWN = 0;
  {{
#endif
{body}
  }}
#if defined(__CUDA_ARCH__) || defined(__CUDACC_RTC__)
  ;
{sizes if wanted else ""}
  run_((char(*)[1])nullptr);
#endif
"""


def function(body: str) -> str:
  """Returns native code that starts with the SIMD types; contraction to FMA is allowed."""
  return f"""{_PRELUDE}
{{
#if !defined(__CUDA_ARCH__) && !defined(__CUDACC_RTC__)
#pragma clang fp contract(fast) reassociate(on)
#endif
SIMD_TYPES
{body}
}}"""


def slices(body: str) -> str:
  """Returns native code that runs `body` for each slice `s`; arguments: `tid`, `nslice`.

  On the CPU one thread does all slices; on CUDA thread `tid` does lane `tid % 8` of its slice.
  """
  return function(f"""
#if defined(__CUDA_ARCH__) || defined(__CUDACC_RTC__)
  const int s = tid >> 3, lane = tid & 7;
  if (s >= nslice) return;
  {{ {body} }}
#else
  for (int s = 0; s < nslice; ++s) {{ {body} }}
#endif
""")
