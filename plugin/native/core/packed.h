// Numbers and vectors packed for code that reads them often: of 16 bits, side by side, two in one.
#pragma once
#include "core/simd.h"

namespace palpate {

// Numbers of 16 bits with eleven digits, for what is read often and need not be exact.
typedef unsigned short Half;
#if ON_CUDA
PALPATE V ld(const Half* p, int row, Lane lane) {
  V v;
  asm("cvt.f32.f16 %0, %1;" : "=f"(v) : "h"(p[LANES * row + lane]));
  return v;
}
PALPATE void put9(Half* p, const int* at, M3 a, Lane lane) {
  if (at[lane] < 0) return;
  const V rows[9] = {a.xx, a.xy, a.xz, a.yx, a.yy, a.yz, a.zx, a.zy, a.zz};
  for (int c = 0; c < 9; ++c) {
    Half half;
    asm("cvt.rn.f16.f32 %0, %1;" : "=h"(half) : "f"(rows[c]));
    p[at[lane] + LANES * c] = half;
  }
}
#else
typedef Half Halves __attribute__((ext_vector_type(8), aligned(2)));
typedef unsigned Bits __attribute__((ext_vector_type(8)));
#if defined(__F16C__) || defined(__aarch64__)
typedef _Float16 Floats16 __attribute__((ext_vector_type(8)));
PALPATE V widened(Halves a) {
  return __builtin_convertvector(__builtin_bit_cast(Floats16, a), V);
}
PALPATE Halves narrowed(V a) {
  return __builtin_bit_cast(Halves, __builtin_convertvector(a, Floats16));
}
#else
PALPATE V widened(Halves a) {
  const Bits x = __builtin_convertvector(a, Bits);
  const V size = __builtin_bit_cast(V, (x & 0x7fffu) << 13) * 0x1p112f;
  return __builtin_bit_cast(V, __builtin_bit_cast(Bits, size) | (x & 0x8000u) << 16);
}
PALPATE Halves narrowed(V a) {
  const Bits x = __builtin_bit_cast(Bits, a);
  const Bits size = __builtin_bit_cast(Bits, __builtin_bit_cast(V, x & 0x7fffffffu) * 0x1p-112f);
  const Bits out = (size + 0xfffu + (size >> 13 & 1u)) >> 13 | (x >> 16 & 0x8000u);
  return __builtin_convertvector(out, Halves);
}
#endif
PALPATE V ld(const Half* p, int row, Lane) { return widened(*(const Halves*)(p + LANES * row)); }
PALPATE void put9(Half* p, const int* at, M3 a, Lane) {
  const V rows[9] = {a.xx, a.xy, a.xz, a.yx, a.yy, a.yz, a.zx, a.zy, a.zz};
  Halves half[9];
  for (int c = 0; c < 9; ++c) half[c] = narrowed(rows[c]);
  for (int l = 0; l < LANES; ++l)
    if (at[l] >= 0)
      for (int c = 0; c < 9; ++c) p[at[l] + LANES * c] = half[c][l];
}
#endif
PALPATE M3 ld9(const Half* p, Lane lane) {
  return {ld(p, 0, lane), ld(p, 1, lane), ld(p, 2, lane), ld(p, 3, lane), ld(p, 4, lane),
          ld(p, 5, lane), ld(p, 6, lane), ld(p, 7, lane), ld(p, 8, lane)};
}

#if !ON_CUDA
// Quads: x, y, z and w, or 0, of a node side by side, at four times its offset in vectors of slices. Eight
// of them are read in eight loads and seven shuffles, where gather3 takes 24 and 21; on the CPU
// gathering is most of an iteration.
#define PICK __builtin_shufflevector
typedef float Quad __attribute__((ext_vector_type(4)));
PALPATE V two_quads(const float* quads, const int* at, int l) {
  const Quad a = *(const Quad*)(quads + 4 * (long long)at[l]);
  const Quad b = *(const Quad*)(quads + 4 * (long long)at[l + 4]);
  return PICK(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
}
PALPATE V lows(V a, V b) { return PICK(a, b, 0, 8, 1, 9, 4, 12, 5, 13); }
PALPATE V highs(V a, V b) { return PICK(a, b, 2, 10, 3, 11, 6, 14, 7, 15); }
PALPATE V fronts(V a, V b) { return PICK(a, b, 0, 1, 8, 9, 4, 5, 12, 13); }
PALPATE V backs(V a, V b) { return PICK(a, b, 2, 3, 10, 11, 6, 7, 14, 15); }
PALPATE V3 of_quads(V a, V b, V c, V d, V& w) {
  const V ab = lows(a, b), cd = lows(c, d), ab2 = highs(a, b), cd2 = highs(c, d);
  w = backs(ab2, cd2);
  return {fronts(ab, cd), backs(ab, cd), fronts(ab2, cd2)};
}
PALPATE V3 gather_quads(const float* quads, const int* at, V& w) {
  const V a = two_quads(quads, at, 0), b = two_quads(quads, at, 1);
  return of_quads(a, b, two_quads(quads, at, 2), two_quads(quads, at, 3), w);
}
PALPATE V3 ld_quads(const float* quads) {
  const V a = ld(quads, 0, Lane()), b = ld(quads, 1, Lane());
  const V c = ld(quads, 2, Lane()), d = ld(quads, 3, Lane());
  V w;
  return of_quads(PICK(a, c, 0, 1, 2, 3, 8, 9, 10, 11), PICK(a, c, 4, 5, 6, 7, 12, 13, 14, 15),
                  PICK(b, d, 0, 1, 2, 3, 8, 9, 10, 11), PICK(b, d, 4, 5, 6, 7, 12, 13, 14, 15), w);
}
PALPATE V3 gather_quads(const float* quads, const int* at) {
  V w;
  return gather_quads(quads, at, w);
}
PALPATE void put_quads(float* quads, V3 v, V w = V{}) {
  const V xy = lows(v.x, v.y), zw = lows(v.z, w), xy2 = highs(v.x, v.y), zw2 = highs(v.z, w);
  const V a = fronts(xy, zw), b = backs(xy, zw), c = fronts(xy2, zw2), d = backs(xy2, zw2);
  st(quads, 0, PICK(a, b, 0, 1, 2, 3, 8, 9, 10, 11), Lane());
  st(quads, 1, PICK(c, d, 0, 1, 2, 3, 8, 9, 10, 11), Lane());
  st(quads, 2, PICK(a, b, 4, 5, 6, 7, 12, 13, 14, 15), Lane());
  st(quads, 3, PICK(c, d, 4, 5, 6, 7, 12, 13, 14, 15), Lane());
}
#undef PICK
#endif

// Vectors that others gather: numbered, each with room for a fourth number. Vector i of eight that begin
// at 8 n starts at 4 i on the CPU, as quads, and at 32 n + i on CUDA, as rows.
#if ON_CUDA
PALPATE V3 gather_shared(const float* p, const int* at, V& w, Lane lane) {
  p += 4 * LANES * (at[lane] / LANES) + at[lane] % LANES;
  w = p[3 * LANES];
  return {p[0], p[LANES], p[2 * LANES]};
}
PALPATE V3 gather_four(const float* p, const int* at, V& w, Lane lane) {
  V3 sum = gather_shared(p, at, w, lane);
  for (int k = 1; k < 4; ++k) {
    V more;
    const V3 next = gather_shared(p, at + k * LANES, more, lane);
    sum = {sum.x + next.x, sum.y + next.y, sum.z + next.z};
    w += more;
  }
  return sum;
}
PALPATE void share(float* p, V3 a, Lane lane) { st3(p, a, lane); }
PALPATE void share(float* p, V3 a, V w, Lane lane) { share(p, a, lane); st(p, 3, w, lane); }
#else
PALPATE V3 gather_shared(const float* p, const int* at, V& w, Lane) {
  return gather_quads(p, at, w);
}
PALPATE V3 gather_four(const float* p, const int* at, V& w, Lane) {
  V sum[4];
  for (int l = 0; l < 4; ++l)
    sum[l] = (two_quads(p, at, l) + two_quads(p, at + LANES, l))
      + (two_quads(p, at + 2 * LANES, l) + two_quads(p, at + 3 * LANES, l));
  return of_quads(sum[0], sum[1], sum[2], sum[3], w);
}
PALPATE void share(float* p, V3 a, Lane) { put_quads(p, a); }
PALPATE void share(float* p, V3 a, V w, Lane) { put_quads(p, a, w); }
#endif
PALPATE V3 gather_shared(const float* p, const int* at, Lane lane) {
  V w;
  return gather_shared(p, at, w, lane);
}

// Two numbers in one, of eight bits each, and these again.
#if ON_CUDA
PALPATE V two(V a, V b) {
  return __uint_as_float((__float_as_uint(a) + 0x8000u & 0xffff0000u)
                         | (__float_as_uint(b) + 0x8000u >> 16));
}
PALPATE V first_of(V pair) { return __uint_as_float(__float_as_uint(pair) & 0xffff0000u); }
PALPATE V second_of(V pair) { return __uint_as_float(__float_as_uint(pair) << 16); }
#else
PALPATE V two(V a, V b) {
  const Bits x = __builtin_bit_cast(Bits, a) + 0x8000u, y = __builtin_bit_cast(Bits, b) + 0x8000u;
  return __builtin_bit_cast(V, (x & 0xffff0000u) | (y >> 16));
}
PALPATE V first_of(V pair) {
  return __builtin_bit_cast(V, __builtin_bit_cast(Bits, pair) & 0xffff0000u);
}
PALPATE V second_of(V pair) { return __builtin_bit_cast(V, __builtin_bit_cast(Bits, pair) << 16); }
#endif

}  // namespace palpate
