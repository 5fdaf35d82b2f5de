"""Native code of a product with the matrix of the step, and how its threads exchange the vector.

On the CPU the vector is read from memory. On CUDA a block of threads has a patch of the surface
(see `mesh.node_order`): the vector's values there are in the block's own memory, and those of the
few neighbours beyond are words with the number of their turn, for which a thread waits: no meeting.
"""

# What PRODUCT and PRECONDITION read, in world `world`.
WORLD = """
  const size_t base = (size_t)world * nslice;
  const float h = step.data[4 * world], g = step.data[4 * world + 1];
  const float* K = block.data + 72 * (size_t)world * nslot;
  const float* M = diag.data + 8 * base;
  const float* I_ = inverse.data + 48 * base;
  const float* O = areavec.data + 24 * base;
  const float* N = normal.data + 24 * base;
  const int* slot = slot_adr.data;
  const int* fan = fan_node.data;
  const int* bend_row = bend_adr.data;
  const int* bend_at = bend_node.data;
  const float* Q = bend_gain.data;
"""

# Product of A, less the volume term, with the vector P of slice s, in ax, ay, az; x, y, z is P
# there and PN is P along the normals.
_PRODUCT = """
#define PRODUCT(P, PN) \\
  SELF(x, y, z, P) \\
  const V md = LD(M, s); \\
  V ax = md * x, ay = md * y, az = md * z; \\
  { \\
    const int row0 = slot[s], width = slot[s + 1] - row0; \\
    const int* node = fan + 8 * (row0 + 2 * s + 1); \\
    const float* k = K + 72 * (size_t)row0; \\
    EACH_NEAR(P) \\
  } \\
  if (bending) { \\
    const int row0 = bend_row[s], width = bend_row[s + 1] - row0; \\
    const int* node = bend_at + 8 * row0; \\
    const float* k = Q + 8 * row0; \\
    V sum = SPLAT(0.0f); \\
    EACH_BENT(PN) \\
    sum *= g; \\
    ax += sum * LD(N + 24 * s, 0); ay += sum * LD(N + 24 * s, 1); az += sum * LD(N + 24 * s, 2); \\
  }
#define BLOCK_OF(k, jx, jy, jz) \\
  { \\
    const V dx = jx - x, dy = jy - y, dz = jz - z; \\
    ax += LD(k, 0) * dx + LD(k, 1) * dy + LD(k, 2) * dz; \\
    ay += LD(k, 3) * dx + LD(k, 4) * dy + LD(k, 5) * dz; \\
    az += LD(k, 6) * dx + LD(k, 7) * dy + LD(k, 8) * dz; \\
  }
#define PRECONDITION(zx, zy, zz, x, y, z) \\
  { \\
    const float* I = I_ + 48 * s; \\
    const V xx = LD(I, 0), xy = LD(I, 1), xz = LD(I, 2), yy = LD(I, 3), yz = LD(I, 4); \\
    zx = xx * x + xy * y + xz * z; \\
    zy = xy * x + yy * y + yz * z; \\
    zz = xz * x + yz * y + LD(I, 5) * z; \\
  }
#define LOAD(x, y, z, P) \\
  V x = LD((P) + 24 * s, 0), y = LD((P) + 24 * s, 1), z = LD((P) + 24 * s, 2);
#define STORE(P, x, y, z) ST((P) + 24 * s, 0, x); ST((P) + 24 * s, 1, y); ST((P) + 24 * s, 2, z);
#define PUT3(name, x, y, z) PUT(name, 0, x) PUT(name, 1, y) PUT(name, 2, z)
#define WITH(P, x, y, z) \\
  (x * LD((P) + 24 * s, 0) + y * LD((P) + 24 * s, 1) + z * LD((P) + 24 * s, 2))
"""

# How PRODUCT reads a vector, and what makes it seen by the others before that: `_VECTORS` after a
# meeting, `_QUADS` on CUDA from the block's own memory, or word by word from that of others, where
# each thread waits for the words of its neighbours.
_VECTORS = """
#define SELF(x, y, z, P) LOAD(x, y, z, P)
#define EACH_NEAR(P) \\
  for (int i = 0; i < width; ++i, node += 8, k += 72) { \\
    const V jx = GATHER(P, node, 0), jy = GATHER(P, node, 1), jz = GATHER(P, node, 2); \\
    BLOCK_OF(k, jx, jy, jz) \\
  }
#define EACH_BENT(PN) \\
  for (int i = 0; i < width; ++i, node += 8, k += 8) sum += LD(k, 0) * GATHER(PN, node, 0);
#define NEXT_TURN
#define SHOWN
#define SHOW(x, y, z)
#define SHOW_NORMAL(v) ST(ZN, s, v);
"""
_QUADS = """
#if defined(__CUDA_ARCH__) || defined(__CUDACC_RTC__)
  #define QUAD_OF(o) (quad_.data + 96 * base + 4 * (o))
  #define WORD_OF(o) (zn_.data + 16 * base + 2 * (o))
  #define SELF(x, y, z, P) \\
    V x, y, z; \\
    if (OWN) { \\
      const int at = 8 * (s - first_) + lane; \\
      x = near_[0][at]; y = near_[1][at]; z = near_[2][at]; \\
    } else { \\
      Two_ low_ = 0, high_ = 0; \\
      get_word_if(true, QUAD_OF(24 * s + lane), low_, high_); \\
      x = lower(low_); y = upper(low_); z = lower(high_); \\
    }
  // The words of several neighbours are under way at once, hence no branches before they are used.
  #define EACH_NEAR(P) \\
    for (int i = 0; i < width; i += 3, node += 24, k += 216) { \\
      Two_ low_[3], high_[3]; \\
      int o_[3]; \\
      for (int b = 0; b < 3; ++b) o_[b] = i + b < width ? node[8 * b + lane] : -1; \\
      for (int b = 0; b < 3; ++b) { \\
        const int from = o_[b] / 24; \\
        const bool has = o_[b] >= 0, mine = OWN && has && from >= first_ && from < last_; \\
        const int at = mine ? 8 * (from - first_) + o_[b] % 24 : 0; \\
        pack(low_[b], near_[0][at], __float_as_uint(near_[1][at])); \\
        pack(high_[b], near_[2][at], shown); \\
        get_word_if(has && !mine, QUAD_OF(o_[b]), low_[b], high_[b]); \\
      } \\
      for (int b = 0; b < 3; ++b) { \\
        if (o_[b] < 0) continue; \\
        while ((unsigned)(high_[b] >> 32) != shown) \\
          get_word_if(true, QUAD_OF(o_[b]), low_[b], high_[b]); \\
        BLOCK_OF(k + 72 * b, lower(low_[b]), upper(low_[b]), lower(high_[b])) \\
      } \\
    }
  #define EACH_BENT(PN) \\
    for (int i = 0; i < width; i += 6, node += 48, k += 48) { \\
      Two_ j_[6]; \\
      int o_[6]; \\
      for (int b = 0; b < 6; ++b) o_[b] = i + b < width ? node[8 * b + lane] : -1; \\
      for (int b = 0; b < 6; ++b) { \\
        const int from = o_[b] >> 3; \\
        const bool has = o_[b] >= 0, mine = OWN && has && from >= first_ && from < last_; \\
        pack(j_[b], near_[3][mine ? o_[b] - 8 * first_ : 0], shown); \\
        get_half_word_if(has && !mine, WORD_OF(o_[b]), j_[b]); \\
      } \\
      for (int b = 0; b < 6; ++b) { \\
        if (o_[b] < 0) continue; \\
        while ((unsigned)(j_[b] >> 32) != shown) \\
          get_half_word_if(true, WORD_OF(o_[b]), j_[b]); \\
        sum += LD(k, b) * lower(j_[b]); \\
      } \\
    }
  #define NEXT_TURN shown = ++turn_;
  #define SHOW(x, y, z) \\
    put_word(QUAD_OF(24 * s + lane), x, y, z, shown); \\
    if (OWN) { \\
      const int at = 8 * (s - first_) + lane; \\
      near_[0][at] = x; near_[1][at] = y; near_[2][at] = z; \\
    }
  #define SHOW_NORMAL(v) \\
    { \\
      const float n_ = v; \\
      put_half_word(WORD_OF(8 * s + lane), n_, shown); \\
      if (OWN) near_[3][8 * (s - first_) + lane] = n_; \\
    }
  #define SHOWN __syncthreads();
  #define SUMS_COST true
#else
  #define SELF(x, y, z, P) LOAD(x, y, z, P)
  #define EACH_NEAR(P) \\
    for (int i = 0; i < width; ++i, node += 8, k += 72) { \\
      GATHER_QUADS(jx, jy, jz, P, quad_.data + 96 * base, node) \\
      BLOCK_OF(k, jx, jy, jz) \\
    }
  #define EACH_BENT(PN) \\
    for (int i = 0; i < width; ++i, node += 8, k += 8) sum += LD(k, 0) * GATHER(PN, node, 0);
  #define NEXT_TURN
  #define SHOWN
  #define SHOW(x, y, z) PUT_QUADS(quad_.data + 96 * (base + s), x, y, z)
  #define SHOW_NORMAL(v) ST(ZN, s, v);
  #define SUMS_COST false
#endif
"""


def code(quads: bool) -> str:
  """Returns `PRODUCT`, which reads the vector after a meeting, or in quads without one."""
  return (_QUADS if quads else _VECTORS) + _PRODUCT
