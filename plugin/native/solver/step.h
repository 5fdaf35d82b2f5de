// The implicit step of a world in one kernel, by one block: what nodes tell each other and as many
// rows of the matrix as there is room for stay in the block's memory.
//
// OWN is how many nodes a thread has, 0 on the CPU. There the world has one thread, and all is in the
// body's own arrays.
#pragma once
#include "tissue/elastic.h"
#include "solver/pcg.h"
#include "solver/schemes.h"

namespace palpate {

// A matrix whose rows are where they were made.
struct Split : Matrix {
  Rows rows;

  template <class Body>
  PALPATE void with_blocks(int s, int row, Body body) const {
    if (rows.holds(s))
      INLINED body(rows.held + rows.held_adr[s]);
    else
      INLINED body(rows.block + 72 * (size_t)row);
  }
};

// A vector in memory which neighbours read after the block has met.
struct Shown : Vectors {
  PALPATE void shown() { meet_block(); }
};

// Where the block has its world.
struct Home {
  Rows rows;
  float *disp, *vel;  // those of `rows`
  Shown z;  // in place of `disp` and `vel`, when rows are made

  PALPATE Split matrix(const Matrix& a) const {
    Split out{a, rows};
    out.diag = rows.diag;
    out.inverse = rows.inverse;
    out.normal = rows.normal;
    return out;
  }
};

template <class Fields>
PALPATE Home home(const Fields& f, int world) {
  Rows at = rows(f, world);
  const size_t n = f.shape.nslice, base = world * n;
  if constexpr (!BLOCKS)
    return {at, f.system.disp_trial.data + 24 * base, f.system.vel_trial.data + 24 * base,
            {{f.system.z.data + 24 * base, f.system.zn.data + 8 * base}}};
  float* memory = block_memory();
  float *disp = memory, *vel = memory + 24 * n;
  at.disp = disp;
  at.vel = vel;
  at.diag = memory + 48 * n;
  at.inverse = memory + 56 * n;
  at.held = memory + 104 * n;
  if (BENDING && f.shape.nhingeslice > 0) {
    at.normal = at.held;
    at.held += 24 * n;
  }
  at.room = block_room() - (int)(at.held - memory);
  return {at, disp, vel, {{disp, vel}}};
}

// The trial state, see `predict`; in the body's arrays too, where others than `Assembly` need it.
template <class Fields, class Team, class Mine>
PALPATE void stand_ahead(const Fields& f, int world, Team& group, const Mine& slices, const Home& at) {
  const size_t base = 24 * (size_t)world * f.shape.nslice;
  float* step = f.state.step.data + 4 * world;
  const float h = step[0];
  slices.each([&](int s, Lane lane, int) {
    st3(at.vel + 24 * s, ld3(f.state.vel.data + base + 24 * s, lane), lane);
    st3(at.disp + 24 * s, ld3(f.state.disp.data + base + 24 * s, lane), lane);
    soon(f.state.force_ext.data + base + 24 * s, lane);
    soon(f.state.dvel_warm.data + base + 24 * s, lane);
    soon(f.state.mass.data + base / 3 + 8 * s, lane);
  });
  meet_block();
  V fast = splat(0.0f);
  slices.each([&](int s, Lane lane, int) {
    fast = vmax(fast, fastest(f, world, at.vel, h, s, lane));
  });
  const float share = share_ahead(h, group.most(fast)), *number = numbers(f, world);
  const bool told = (BENDING && f.shape.nhingeslice > 0)
    || (VOLUMES && (number[BULK] != 0.0f || number[PRESSURE] != 0.0f));
  slices.each([&](int s, Lane lane, int) {
    const V3 v = ld3(at.vel + 24 * s, lane);
    const V3 x = ld3(at.disp + 24 * s, lane) + share * h * v;
    st3(at.disp + 24 * s, x, lane);
    if (!told) return;
    st3(f.system.disp_trial.data + base + 24 * s, x, lane);
    st3(f.system.vel_trial.data + base + 24 * s, v, lane);
  });
  if (group.is_first()) step[3] = share;
  meet_block();
}

// Whether a world has impulses in `rhs`.
template <class Fields, class Team, class Mine>
PALPATE bool is_pushed(const Fields& f, size_t base, Team& group, const Mine& slices) {
  V any = splat(0.0f);
  slices.each([&](int s, Lane lane, int) {
    const V3 b = ld3(f.system.rhs.data + base + 24 * s, lane);
    any = select((b.x != 0.0f) | (b.y != 0.0f) | (b.z != 0.0f), splat(1.0f), any);
  });
  return group.most(any) > 0.0f;
}

// The step, or with RESPONSE the answer to the impulses in `rhs`, for which the matrix is made anew
// where there are any; nothing of a world whose step has no length.
template <class Fields>
PALPATE void step_world(const Fields& f, Thread t, int stage) {
  using Mine = Slices<OWN>;
  if (f.state.step.data[4 * t.world] == 0.0f) {
    float* status = f.system.status.data + 4 * t.world;
    if (t.tid == 0) status[0] = status[1] = status[3] = 0.0f;
    return;
  }
  const size_t base = 24 * (size_t)t.world * f.shape.nslice;
  Group<SUMS> group(t, f.system.partial.data);
  const Mine slices(group, f.shape.nslice);
  if (stage == RESPONSE && !is_pushed(f, base, group, slices)) {
    const V3 none = {splat(0.0f), splat(0.0f), splat(0.0f)};
    slices.each([&](int s, Lane lane, int) { st3(f.system.sol.data + base + 24 * s, none, lane); });
    if (group.is_first()) f.system.ratio.data[t.world] = 1.0f;
    return;
  }
  Home at = home(f, t.world);
  if (stage == RESPONSE) at.rows.rhs = f.system.r.data + base;
  stand_ahead(f, t.world, group, slices, at);
  if (BENDING && f.shape.nhingeslice > 0) {
    each_pass(t, f.shape.nelemslice, [&](Thread pass) { elem_normal(f, pass, 0); });
    each_pass(t, f.shape.nhingeslice, [&](Thread pass) { hinge_angle(f, pass, FIRST); });
    each_pass(t, f.shape.nhingeslice, [&](Thread pass) { hinge_moment(f, pass, 0); });
    each_pass(t, f.shape.nelemslice, [&](Thread pass) { elem_corner(f, pass, 0); });
  }
  const Assembly<Fields> assembly{f, t.world, FIRST, at.rows};
  slices.each([&](int s, Lane lane, int) { assembly.row(s, lane); });
  meet_block();
  const Split a = at.matrix(matrix(f, t.world));
  Jacobi<false> jacobi;
  Pcg<Fields, Group<SUMS>, Mine, Shown, Split>{f, t.world, stage, group, slices, at.z, a}.solve(
    jacobi);
  if (stage == RESPONSE) return;
  slices.each([&](int s, Lane lane, int) {
    st3(f.state.dvel.data + base + 24 * s, ld3(f.system.sol.data + base + 24 * s, lane), lane);
  });
}

}  // namespace palpate
