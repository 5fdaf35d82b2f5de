"""One source for both devices: native element code over slices of eight nodes.

Nodes are stored in slices of `LANES`: an array of vectors is (nworld, nslice, 3, 8), so that one
slice is a SIMD register on the CPU and eight neighbouring threads on CUDA, and the three components
of a node lie within two cache lines. In native code `V` is a vector of eight floats on the CPU and
one float on CUDA; `LD`, `ST` and `GATHER` hide the difference, and `PUT_MOST` keeps the largest of
numbers >= 0. Irregular lists (the neighbours of a node) are sliced ELLPACK: row `k` of slice `s`
holds the k-th entry of its eight nodes (Kreutzer et al. 2014, SELL-C-sigma,
doi:10.1137/130930352). On the CPU gathering is most of an iteration, so what is gathered often is
kept in quads as well, see `GATHER_QUADS`; on CUDA that macro reads the vectors.
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
  #define GATHER_QUADS(x, y, z, p, quads, o) \\
    const V x = GATHER(p, o, 0), y = GATHER(p, o, 1), z = GATHER(p, o, 2);
  #define PUT_QUADS(q, x, y, z)
  #define SQRT(a) sqrtf(a)
  #define MAX(a, b) fmaxf(a, b)
  #define MIN(a, b) fminf(a, b)
  #define SPLAT(a) (a)
  #define HSUM(a) (a)
  #define PUT_MOST(p, v) \\
    if (__float_as_int(v) > *(volatile int*)(p)) atomicMax((int*)(p), __float_as_int(v));
  #define SELECT(c, a, b) ((c) ? (a) : (b))
  #define FOR_RANGE(s, from, to) for (int s = (from) + (tid >> 3); s < (to); s += nthread >> 3)
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
#endif
#define FOR_SLICES(s) FOR_RANGE(s, 0, nslice)
#endif
"""

# Sums over all nodes of a world, the same value in every thread, and barriers. On CUDA a world is a
# group of `nthread` threads in whole blocks that are all resident. Each block publishes its sums
# with the number of the meeting in one 64-bit word, and all blocks read the words of all: no
# counter, and one trip through memory. The words are zero before the launch and alternate between
# two sets: who meets again has read the set before. The order of summation is fixed, so that runs
# repeat to the bit.
_GROUP = """
#if defined(__CUDA_ARCH__) || defined(__CUDACC_RTC__)
  __shared__ float red[2][4][32];
  const int lane = tid & 7, thread = threadIdx.x, nwarp = blockDim.x >> 5;
  const int nblock = nthread / blockDim.x, block_ = tid / blockDim.x;
  volatile unsigned long long* word =
    (volatile unsigned long long*)partial_.data + 4 * MAXBLOCK * (size_t)world;
  unsigned phase = 0;
  auto warp_sum = [](float v) -> float {
    for (int o = 16; o > 0; o >>= 1) v += __shfl_xor_sync(0xffffffffu, v, o);
    return v;
  };
  // Sums u, and v where `two`, over the group; memory written before is seen after.
  auto meet = [&](float& u, float& v, bool two) {
    float* mine = red[phase & 1][0];
    const int warp = thread >> 5, at = thread & 31;
    u = warp_sum(u);
    if (two) v = warp_sum(v);
    if (at == 0) { mine[32 * 0 + warp] = u; mine[32 * 1 + warp] = v; }
    __syncthreads();
    int nsum = nwarp, from = 0;
    if (nblock > 1) {
      volatile unsigned long long* set = word + 2 * MAXBLOCK * (phase & 1);
      ++phase;
      if (warp == 0) {
        u = warp_sum(at < nwarp ? mine[32 * 0 + at] : 0.0f);
        v = warp_sum(two && at < nwarp ? mine[32 * 1 + at] : 0.0f);
        if (at < 2) {
          __threadfence();
          const unsigned bits = __float_as_uint(at == 0 ? u : v);
          set[2 * block_ + at] = (unsigned long long)phase << 32 | bits;
        }
      }
      u = v = 0.0f;
      for (int b = thread; b < nblock; b += blockDim.x) {
        unsigned long long w;
        do w = set[2 * b]; while ((unsigned)(w >> 32) != phase);
        u += __uint_as_float((unsigned)w);
        if (two) {
          do w = set[2 * b + 1]; while ((unsigned)(w >> 32) != phase);
          v += __uint_as_float((unsigned)w);
        }
      }
      if (warp * 32 < nblock) __threadfence();
      u = warp_sum(u);
      if (two) v = warp_sum(v);
      if (at == 0) { mine[32 * 2 + warp] = u; mine[32 * 3 + warp] = v; }
      __syncthreads();
      nsum = nwarp < (nblock + 31) / 32 ? nwarp : (nblock + 31) / 32;
      from = 64;
    } else {
      ++phase;
    }
    u = v = 0.0f;
    for (int w = 0; w < nsum; ++w) { u += mine[from + w]; v += mine[from + 32 + w]; }
  };
  auto group_sum = [&](float u) -> float {
    float v = 0.0f;
    meet(u, v, false);
    return u;
  };
  #define GROUP_SUMS(u, v, a, b) float a = u, b = v; meet(a, b, true);
  #define GROUP_SYNC() group_sum(0.0f)
#else
  const int lane = 0, thread = 0;
  auto group_sum = [&](V v) -> float { return HSUM(v); };
  #define GROUP_SUMS(u, v, a, b) float a = HSUM(u), b = HSUM(v);
  #define GROUP_SYNC()
#endif
"""
MAX_BLOCKS = 512
BLOCK = 512  # threads of a block, at most


def group(body: str) -> str:
  """Returns native code in which all threads of a world work on `body` together.

  Arguments: `world`, `tid`, `nthread`, `nslice` and `partial_` (nworld, 8, MAX_BLOCKS), which is
  zero before the launch. On the CPU there is one thread.
  """
  return function(_GROUP.replace("MAXBLOCK", str(MAX_BLOCKS)) + body)


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


def block(device, nslice: int) -> int:
  """Returns the threads of a block for code made by `group`.

  Small blocks spread few nodes over more multiprocessors: an iteration at 16,386 nodes takes 10.0
  us in blocks of 256 and 10.6 in blocks of 512, at 65,538 nodes 14.5 and 13.5 (one H200).
  """
  return BLOCK // 2 if device.is_cuda and nslice * LANES <= BLOCK // 2 * device.sm_count else BLOCK


def group_size(device, nslice: int, nworld: int, per_sm: int = 1) -> int:
  """Returns the threads of a world for code made by `group`, to launch in blocks of `block`.

  Args:
    device: where they run
    nslice: slices of nodes
    nworld: number of worlds
    per_sm: blocks on one multiprocessor that the kernel's bounds allow
  """
  if not device.is_cuda:
    return 1
  # Blocks of one world wait for each other, so all of them must be resident.
  most = max(1, min(per_sm * device.sm_count // nworld, MAX_BLOCKS))
  size = block(device, nslice)
  return size * max(1, min(most, -(-nslice * LANES // size)))


def threads(device, nslice: int) -> int:
  """Returns the launch dimension for `nslice` slices: one thread on the CPU, one a lane on CUDA."""
  return nslice * LANES if device.is_cuda else 1
