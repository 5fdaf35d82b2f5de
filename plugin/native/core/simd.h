// Eight nodes at once: a SIMD register on the CPU, eight neighbouring threads on CUDA.
//
// Nodes, triangles and hinges are stored in slices of eight: row r of slice s of an array with n
// rows starts at 8 (n s + r). `V` is such a row on the CPU and this thread's number of it, at its
// `Lane`, on CUDA. Code over slices is written once:
//
//   each_slice(t, nslice, [&](int s, Lane lane) {
//     const V3 v = ld3(vel + 24 * s, lane);
//     st(energy, s, 0.5f * ld(mass, s, lane) * dot(v, v), lane);
//   });
// LANES is eight; `tissue/kernels.py` prints it and the other constants before the headers. Code in
// doubles, whose sums are taken in the order in which they stand, begins with AS_WRITTEN. Large functions
// with several callers are CALLED: inlined, they would take minutes to compile for CUDA, and seconds for the CPU.
#pragma once

#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
#define ON_CUDA 1
#else
#define ON_CUDA 0
#endif

#if ON_CUDA
#define PALPATE __device__ __forceinline__
#define CALLED __device__ __noinline__
#define INLINED
#define AS_WRITTEN
#else
#define PALPATE __attribute__((always_inline)) inline
#define CALLED __attribute__((noinline)) inline
#define INLINED [[clang::always_inline]]  // before a call of a lambda
#define AS_WRITTEN _Pragma("clang fp contract(off) reassociate(off)")
// Sums of eight are not of one order anyway; products are fused with them.
#pragma clang fp contract(fast) reassociate(on)
#endif

namespace palpate {

// Within a kernel on the CPU numbers under 1e-38 are 0: they cost a hundred times as much as others, and
// what decays far from a tool goes through them.
struct Flush {
#if !ON_CUDA && defined(__x86_64__)
  unsigned kept;
  Flush() : kept(__builtin_ia32_stmxcsr()) { __builtin_ia32_ldmxcsr(kept | 0x8040); }
  ~Flush() { __builtin_ia32_ldmxcsr(kept); }
#endif
};

#if ON_CUDA
using V = float;
using Lane = int;
#else
typedef float V __attribute__((ext_vector_type(8)));
typedef float Unaligned __attribute__((ext_vector_type(8), aligned(4)));
struct Lane {};
#endif

struct V3 { V x, y, z; };

// A vector or matrix that is carried around a loop has its members last one first: the compiler
// ranks the parts of a struct so, and the terms of sums over them stay in their written order.
struct Carried {
  V z, y, x;
  PALPATE Carried(V3 a) : z(a.z), y(a.y), x(a.x) {}
  PALPATE operator V3() const { return {x, y, z}; }
};
struct M3 {
  V zz, zy, zx, yz, yy, yx, xz, xy, xx;
  M3() = default;
  PALPATE M3(V xx, V xy, V xz, V yx, V yy, V yz, V zx, V zy, V zz)
    : zz(zz), zy(zy), zx(zx), yz(yz), yy(yy), yx(yx), xz(xz), xy(xy), xx(xx) {}
};
struct S3 {  // symmetric
  V zz, yz, yy, xz, xy, xx;
  S3() = default;
  PALPATE S3(V xx, V xy, V xz, V yy, V yz, V zz)
    : zz(zz), yz(yz), yy(yy), xz(xz), xy(xy), xx(xx) {}
};

// Reading and writing rows; `gather` takes component c from eight places, `at` in floats, and
// `gather_number` numbers of one row a slice from the places of vectors.

#if ON_CUDA
PALPATE V ld(const float* p, int row, Lane lane) { return p[LANES * row + lane]; }
PALPATE void st(float* p, int row, V v, Lane lane) { p[LANES * row + lane] = v; }
PALPATE V gather(const float* p, const int* at, int c, Lane lane) {
  return p[at[lane] + LANES * c];
}
PALPATE V gather_number(const float* p, const int* at, Lane lane) {
  return p[at[lane] / (3 * LANES) * LANES + at[lane] % (3 * LANES)];
}
#else
PALPATE V ld(const float* p, int row, Lane) { return (V) * (const Unaligned*)(p + LANES * row); }
PALPATE void st(float* p, int row, V v, Lane) { *(Unaligned*)(p + LANES * row) = (Unaligned)v; }
PALPATE V gather(const float* p, const int* at, int c, Lane) {
  const float* q = p + LANES * c;
  return (V){q[at[0]], q[at[1]], q[at[2]], q[at[3]], q[at[4]], q[at[5]], q[at[6]], q[at[7]]};
}
PALPATE V gather_number(const float* p, const int* at, Lane) {
  V out;
  for (int l = 0; l < LANES; ++l) out[l] = p[at[l] / (3 * LANES) * LANES + at[l] % (3 * LANES)];
  return out;
}
#endif

PALPATE V3 ld3(const float* p, int row, Lane lane) {
  return {ld(p, row, lane), ld(p, row + 1, lane), ld(p, row + 2, lane)};
}
PALPATE V3 ld3(const float* p, Lane lane) { return ld3(p, 0, lane); }
PALPATE void st3(float* p, int row, V3 a, Lane lane) {
  st(p, row, a.x, lane);
  st(p, row + 1, a.y, lane);
  st(p, row + 2, a.z, lane);
}
PALPATE void st3(float* p, V3 a, Lane lane) { st3(p, 0, a, lane); }
PALPATE void st9(float* p, M3 a, Lane lane) {
  st3(p, 0, {a.xx, a.xy, a.xz}, lane);
  st3(p, 3, {a.yx, a.yy, a.yz}, lane);
  st3(p, 6, {a.zx, a.zy, a.zz}, lane);
}
// Writes a matrix to eight places, in floats; a negative one is none.
#if ON_CUDA
PALPATE void put9(float* p, const int* at, M3 a, Lane lane) {
  if (at[lane] >= 0) st9(p + at[lane] - lane, a, lane);
}
#else
PALPATE void put9(float* p, const int* at, M3 a, Lane) {
  const V rows[9] = {a.xx, a.xy, a.xz, a.yx, a.yy, a.yz, a.zx, a.zy, a.zz};
  for (int l = 0; l < LANES; ++l)
    if (at[l] >= 0)
      for (int c = 0; c < 9; ++c) p[at[l] + LANES * c] = rows[c][l];
}
#endif
PALPATE V3 gather3(const float* p, const int* at, Lane lane) {
  return {gather(p, at, 0, lane), gather(p, at, 1, lane), gather(p, at, 2, lane)};
}
PALPATE S3 ld6(const float* p, Lane lane) {
  return {ld(p, 0, lane), ld(p, 1, lane), ld(p, 2, lane),
          ld(p, 3, lane), ld(p, 4, lane), ld(p, 5, lane)};
}
PALPATE M3 ld9(const float* p, Lane lane) {
  return {ld(p, 0, lane), ld(p, 1, lane), ld(p, 2, lane), ld(p, 3, lane), ld(p, 4, lane),
          ld(p, 5, lane), ld(p, 6, lane), ld(p, 7, lane), ld(p, 8, lane)};
}

// Numbers.

PALPATE V splat(float a) { return (V)a; }
#if ON_CUDA
PALPATE V vsqrt(V a) { return sqrtf(a); }
PALPATE V vmax(V a, V b) { return fmaxf(a, b); }
PALPATE V vmin(V a, V b) { return fminf(a, b); }
#else
PALPATE V vsqrt(V a) { return __builtin_elementwise_sqrt(a); }
PALPATE V vmax(V a, V b) { return __builtin_elementwise_max(a, b); }
PALPATE V vmin(V a, V b) { return __builtin_elementwise_min(a, b); }
#endif
// Whether any of eight numbers on the CPU, or this one, is above another.
#if ON_CUDA
PALPATE bool any_above(V a, float least) { return a > least; }
#else
PALPATE bool any_above(V a, float least) { return __builtin_reduce_max(a) > least; }
#endif
template <class C>
PALPATE V select(C condition, V a, V b) { return condition ? a : b; }

// Keeps the largest of numbers >= 0 that any thread gives.
#if ON_CUDA
PALPATE void put_most(float* p, V v) {
  if (__float_as_int(v) > *(volatile int*)p) atomicMax((int*)p, __float_as_int(v));
}
#else
PALPATE void put_most(float* p, V v) {
  const float most = __builtin_reduce_max(v);
  if (most > *p) *p = most;
}
#endif

// Vectors.

PALPATE V3 operator+(V3 a, V3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
PALPATE V3 operator-(V3 a, V3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
PALPATE V3 operator*(V s, V3 a) { return {s * a.x, s * a.y, s * a.z}; }
PALPATE V3 operator/(V3 a, V d) { return {a.x / d, a.y / d, a.z / d}; }
#if !ON_CUDA
PALPATE V3 operator*(float s, V3 a) { return {s * a.x, s * a.y, s * a.z}; }
#endif
PALPATE V3& operator+=(V3& a, V3 b) { a.x += b.x; a.y += b.y; a.z += b.z; return a; }
PALPATE V3& operator-=(V3& a, V3 b) { a.x -= b.x; a.y -= b.y; a.z -= b.z; return a; }
PALPATE V dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
// sum + a . b, term after term.
PALPATE V add_dot(V sum, V3 a, V3 b) { return sum + a.x * b.x + a.y * b.y + a.z * b.z; }
PALPATE V3 cross(V3 a, V3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
PALPATE V3 operator*(const M3& m, V3 a) {
  return {m.xx * a.x + m.xy * a.y + m.xz * a.z, m.yx * a.x + m.yy * a.y + m.yz * a.z,
          m.zx * a.x + m.zy * a.y + m.zz * a.z};
}
PALPATE V3 operator*(const S3& m, V3 a) {
  return {m.xx * a.x + m.xy * a.y + m.xz * a.z, m.xy * a.x + m.yy * a.y + m.yz * a.z,
          m.xz * a.x + m.yz * a.y + m.zz * a.z};
}

// Matrices; the sum with a number is that with a multiple of the identity.

PALPATE M3 outer(V3 a, V3 b) {
  return {a.x * b.x, a.x * b.y, a.x * b.z, a.y * b.x, a.y * b.y, a.y * b.z,
          a.z * b.x, a.z * b.y, a.z * b.z};
}
PALPATE M3 operator+(M3 a, M3 b) {
  return {a.xx + b.xx, a.xy + b.xy, a.xz + b.xz, a.yx + b.yx, a.yy + b.yy, a.yz + b.yz,
          a.zx + b.zx, a.zy + b.zy, a.zz + b.zz};
}
PALPATE M3 operator+(M3 a, V d) {
  return {a.xx + d, a.xy, a.xz, a.yx, a.yy + d, a.yz, a.zx, a.zy, a.zz + d};
}
PALPATE M3 operator*(V s, M3 a) {
  return {s * a.xx, s * a.xy, s * a.xz, s * a.yx, s * a.yy, s * a.yz,
          s * a.zx, s * a.zy, s * a.zz};
}
PALPATE S3 operator+(S3 a, S3 b) {
  return {a.xx + b.xx, a.xy + b.xy, a.xz + b.xz, a.yy + b.yy, a.yz + b.yz, a.zz + b.zz};
}
PALPATE S3 operator+(S3 a, V d) { return {a.xx + d, a.xy, a.xz, a.yy + d, a.yz, a.zz + d}; }
PALPATE S3 operator*(V s, S3 a) {
  return {s * a.xx, s * a.xy, s * a.xz, s * a.yy, s * a.yz, s * a.zz};
}
PALPATE S3 symmetric(M3 a) {
  return {a.xx, 0.5f * (a.xy + a.yx), 0.5f * (a.xz + a.zx), a.yy, 0.5f * (a.yz + a.zy), a.zz};
}
PALPATE M3 full(S3 a) { return {a.xx, a.xy, a.xz, a.xy, a.yy, a.yz, a.xz, a.yz, a.zz}; }
// s a a^T.
PALPATE S3 square(V s, V3 a) {
  return {s * a.x * a.x, s * a.x * a.y, s * a.x * a.z, s * a.y * a.y, s * a.y * a.z,
          s * a.z * a.z};
}

// Work.

// One of the `nthread` threads that work on a world; on the CPU there is one.
struct Thread { int world, tid, nthread; };

// Leads arrays to a row, or to the only one of all worlds: a kernel's to what its world has of its own. A
// world's row is the first where all have the same.
template <class... Arrays>
PALPATE void move_each(int row, Arrays&... arrays) {
  const auto at = [&](int count) { return (size_t)(count > 1 ? row : 0); };
  ((arrays.data += at(arrays.shape[0]) * ((size_t)arrays.strides[0] / sizeof(*arrays.data))), ...);
}
template <class Array>
PALPATE int own_row(const Array& rows, int world) { return rows.data ? rows.data[world] : 0; }

// The numbers of a world that may change while running, see `Tissue.number`.
template <class Fields>
PALPATE const float* numbers(const Fields& f, int world) {
  return f.tissue.number.data + NUMBERS * world;
}

// How far what worlds have of their own, of `Shape` and `Tissue`, lies behind that of the first mesh.
template <class Fields>
PALPATE size_t mesh_of(const Fields& f, int world) {
  return MESHES && f.shape.mesh.data ? (size_t)f.shape.stride * f.shape.mesh.data[world] : 0;
}

// What springs between nodes weigh in a world, or null where there are none.
template <class Fields>
PALPATE const float* pair_hold(const Fields& f, int world) {
  return f.state.pair_hold.data && f.state.paired.data[world]
    ? f.state.pair_hold.data + 48 * (size_t)world * f.shape.nslice : nullptr;
}

#if ON_CUDA
// Lane of a thread. That it is below eight is hidden from the compiler, which otherwise takes rows
// for bits of one number and computes the address of each anew.
PALPATE Lane lane_of(int tid) {
  int lane = tid & (LANES - 1);
  asm("" : "+r"(lane));
  return lane;
}
#endif

// Runs body(s, lane) for each slice: one thread does all on the CPU, eight threads one on CUDA.
template <class Body>
PALPATE void each_slice(Thread t, int nslice, Body body) {
#if ON_CUDA
  if (t.tid >> 3 < nslice) body(t.tid >> 3, lane_of(t.tid));
#else
  for (int s = 0; s < nslice; ++s) INLINED body(s, Lane());
#endif
}

// Runs body(thread) as often as the threads of one block take for n slices, then lets them meet.
template <class Body>
PALPATE void each_pass(Thread t, int nslice, Body body) {
#if ON_CUDA
  for (int from = 0; from < LANES * nslice; from += t.nthread)
    body(Thread{t.world, t.tid + from, t.nthread});
  __syncthreads();
#else
  INLINED body(t);
#endif
}

// Runs body(i) for n items, whichever of the threads has them.
template <class Body>
PALPATE void each_item(Thread t, int n, Body body) {
  for (int i = t.tid; i < n; i += t.nthread) body(i);
}

// The greatest number that threads bring, as an int that is ordered alike: it does not depend on
// who comes first. `NOTHING_PUT` where nobody has come; on CUDA whole warps call `put_most`.
constexpr int NOTHING_PUT = -2147483647 - 1;

PALPATE int ordered(int bits) { return bits ^ ((bits >> 31) & 0x7fffffff); }
#if ON_CUDA
PALPATE void put_most(int* at, float value) {
  for (int o = 16; o > 0; o >>= 1) {
    const float other = __shfl_xor_sync(0xffffffffu, value, o);
    value = other > value ? other : value;
  }
  if ((threadIdx.x & 31) == 0) atomicMax(at, ordered(__float_as_int(value)));
}
PALPATE float most(int at) { return __int_as_float(ordered(at)); }
#else
PALPATE void put_most(int* at, float value) {
  const int mine = ordered(__builtin_bit_cast(int, value));
  if (mine > *at) *at = mine;
}
PALPATE float most(int at) { return __builtin_bit_cast(float, ordered(at)); }
#endif

// Returns the place of one more entry of a list whose length is `count`.
PALPATE int append(int* count) {
#if ON_CUDA
  return atomicAdd(count, 1);
#else
  return (*count)++;
#endif
}

}  // namespace palpate
