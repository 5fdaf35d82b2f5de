// Products with the matrix A of the step, and with the inverse of its diagonal blocks.
#pragma once
#include "core/group.h"

namespace palpate {

// The matrix of one world, less its volume term: blocks of neighbours, inertia and foundation on
// the diagonal, and the bending matrix along the normals.
struct Matrix {
  static constexpr bool SOLID = false;
  const float* block;
  const float* diag;
  const float* inverse;
  const float* normal;
  const int *slot, *width;  // first row of a slice, and how many it uses
  const int* fan;
  const int *bend_row, *bend_width;
  const int* bend_node;
  const float* bend_gain;
  const float* hold;  // of nodes that springs hold, or null
  const float* pair;  // of springs between two nodes, and which the other one is; or null
  const int* pair_node;
  const float* capsule;  // blocks of the skin of a solid, and where they are; or null
  const int *capsule_adr, *capsule_node;
  float bend;  // (h^2 + h damping) times the scale of the plate, for the bending matrix
  bool bends;  // whether there is one

  // Runs body(blocks) for the blocks of slice s, whose first row is `row`.
  template <class Body>
  PALPATE void with_blocks(int, int row, Body body) const { INLINED body(block + 72 * (size_t)row); }
};

template <class Fields>
PALPATE Matrix matrix(const Fields& f, int world) {
  const size_t base = (size_t)world * f.shape.nslice, nbend = f.shape.bend_adr.data[f.shape.nslice];
  const size_t mesh = mesh_of(f, world);
  return {
    f.system.block.data + 72 * (size_t)world * f.shape.nslot,
    f.system.diag.data + 8 * base,
    f.system.inverse.data + 48 * base, f.system.normal.data + 24 * base, f.shape.slot_adr.data,
    f.shape.fan_width.data + mesh, f.shape.fan_node.data + mesh, f.shape.bend_adr.data,
    f.shape.bend_width.data + mesh, f.shape.bend_node.data + mesh,
    f.lump.bend_gain.data ? f.lump.bend_gain.data + 8 * nbend * world
                          : f.tissue.bend_gain.data + mesh,
    f.state.hold.data ? f.state.hold.data + 48 * base : nullptr,
    pair_hold(f, world), f.state.pair_node.data + 8 * base,
    f.shape.ncapsule ? f.system.capsule_block.data + 72 * (size_t)world * f.shape.ncapsule : nullptr,
    f.shape.capsule_adr.data, f.shape.capsule_node.data,
    f.state.step.data[4 * world + 1] * numbers(f, world)[PLATE], BENDING && f.shape.nhingeslice > 0
  };
}

// That of a solid: its blocks are of 16 bits, in place of `block`.
struct Solid : Matrix {
  static constexpr bool SOLID = true;
  const Half* half;
  float unit;  // of them [kg]

  template <class Body>
  PALPATE void with_blocks(int, int row, Body body) const { INLINED body(half + 72 * (size_t)row); }
};

template <class Fields>
PALPATE float unit(const Fields& f, int world) {
  return f.state.step.data[4 * world + 1] * numbers(f, world)[SHEAR] * f.tissue.stiffness.data[mesh_of(f, world)];
}

template <class Fields>
PALPATE Solid solid_matrix(const Fields& f, int world) {
  return {matrix(f, world), f.system.half.data + 72 * (size_t)world * f.shape.nslot, unit(f, world)};
}

// Row s of A z, where z is `own`:
//   diag own + sum_j block_j (z_j - own) + bend normal sum_j gain_j (normal_j . z_j),
// the last term with bending only. `z` says how a vector is read: `Vectors` or `Quads`.
template <class Any, class Vector>
PALPATE V3 product(const Any& a, const Vector& z, V3 own, int s, Lane lane) {
  const V3 zero = {splat(0.0f), splat(0.0f), splat(0.0f)};
  Carried out = Any::SOLID ? zero : ld(a.diag, s, lane) * own;
  {
    const int row = a.slot[s], width = a.width[s];
    a.with_blocks(s, row, [&](auto* block) {
      z.each_near(
        a.fan + 8 * (row + 2 * s + 1), width, lane,
        [&](int k) { return ld9(block + 72 * k, lane); },
        [&](const M3& m, V3 near) { out = out + m * (near - own); });
    });
  }
  if constexpr (Any::SOLID) out = a.unit * z.joined(out) + ld(a.diag, s, lane) * own;
  if (a.hold) out = out + ld6(a.hold + 48 * s, lane) * own;
  if (a.pair) {
    V3 between = zero;
    z.each_near(
      a.pair_node + 8 * s, 1, lane, [&](int) { return ld6(a.pair + 48 * s, lane); },
      [&](const S3& m, V3 near) { between += m * (own - near); });
    out = out + z.joined(between);
  }
  if (Any::SOLID && a.capsule) {
    const int row = a.capsule_adr[s], width = a.capsule_adr[s + 1] - row;
    const float* block = a.capsule + 72 * (size_t)row;
    V3 skin = zero;
    z.each_near(
      a.capsule_node + 8 * (row + 2 * s + 1), width, lane,
      [&](int k) { return ld9(block + 72 * k, lane); },
      [&](const M3& m, V3 near) { skin += m * (near - own); });
    out = out + z.joined(skin);
  }
  if (a.bends) {
    const int row = a.bend_row[s], width = a.bend_width[s];
    const float* gain = a.bend_gain + 8 * row;
    V sum = splat(0.0f);
    z.each_bent(
      a.bend_node + 8 * row, width, lane, [&](int k) { return ld(gain, k, lane); },
      [&](V g, V near) { sum += g * near; });
    out = out + (a.bend * z.joined(sum)) * ld3(a.normal + 24 * s, lane);
  }
  return out;
}

// D^-1 r, D the diagonal blocks.
PALPATE V3 precondition(const Matrix& a, V3 r, int s, Lane lane) {
  return ld6(a.inverse + 48 * s, lane) * r;
}

// A vector in memory and its components along the normals, which neighbours read after a meeting.
struct Vectors {
  template <class Team>
  PALPATE void next(Team&) {}
  PALPATE void shown() {}
  PALPATE void show(int s, V3 a, Lane lane) { st3(z + 24 * s, a, lane); }
  PALPATE void show_normal(int s, V a, Lane lane) { st(zn, s, a, lane); }
  PALPATE V3 own(int s, Lane lane) const { return ld3(z + 24 * s, lane); }
  template <class Weight, class Body>
  PALPATE void each_near(const int* node, int width, Lane lane, Weight weight, Body body) const {
    for (int i = 0; i < width; ++i, node += 8) INLINED body(weight(i), gather3(z, node, lane));
  }
  template <class Weight, class Body>
  PALPATE void each_bent(const int* node, int width, Lane lane, Weight weight, Body body) const {
    for (int i = 0; i < width; ++i, node += 8) INLINED body(weight(i), gather(zn, node, 0, lane));
  }
  template <class Any>
  PALPATE static Any joined(Any a) { return a; }

  float* z;
  float* zn;
};

}  // namespace palpate
