// Conjugate gradients on A dv = b: the whole solve of a world in one kernel, for launches cost more
// than iterations.
//
// All sums of an iteration are one meeting (Chronopoulos and Gear 1989,
// doi:10.1016/0377-0427(89)90045-9): q = A p is carried as A z + beta q, and p^T q as
// z^T A z - beta^2 p^T q, which loses no more than a digit as the second is seldom twice the first.
// It stops when sqrt(r^T D^-1 r), D the diagonal blocks, is `tolerance` times that of b, and starts
// where `dvel_warm` leads, scaled to the least error in the energy norm.
//
// FIRST and RESPONSE are stages of a step, ENOUGH is the relative residual at which a response is
// good enough, and BULK and so on are places in `Tissue.number`.
#pragma once
#include "coupling/node.h"
#include "solver/product.h"
#include "tissue/volume.h"

namespace palpate {

// A thread's part of r^T D^-1 r and of the sum of z with the area vectors.
struct Part { V rr, along; };

// The solve. A preconditioner writes z, the preconditioned r, in three places:
//   scaled(z)                      what it makes of D^-1 r when r is new
//   before(pcg, part)              before the product: says whether to go on
//   after(pcg, part, zw, curved)   after it: sums zw to `curved`, z^T A z; says whether to go on
// One of both sets rz = r^T z, the residual and `along` from the part.
template <class Fields, class Team, class Slices, class Vector, class Any>
struct Pcg {
  const Fields& f;
  const int world, stage;
  Team& group;
  const Slices& slices;
  Vector& z;
  const Any& a;  // the matrix

  const size_t at = 24 * (size_t)world * f.shape.nslice;
  const float* const areavec = f.system.areavec.data + at;
  const float* const warm = f.state.dvel_warm.data + at;
  const float* const step = f.state.step.data + 4 * world;
  const float* const number = numbers(f, world);
  const float bulk = VOLUMES ? number[BULK] : 0.0f;
  // What the volume term adds to a product is this times `along` along the area vectors.
  const float gain = bulk != 0.0f ? step[1] * bulk / f.shape.volume0 / 36.0f : 0.0f;
  typename Slices::Vector x{f.system.sol.data + at}, r{f.system.r.data + at};
  typename Slices::Vector p{f.system.p.data + at}, ap{f.system.q.data + at};
  typename Slices::Vector az{f.system.t.data + at};
  float norm = 0.0f, target = 0.0f, along = 0.0f, residual = 0.0f;
  float rz = 0.0f, before = 0.0f;  // r^T z, and that of the last iteration
  float work = 0.0f;  // b^T x, of a solve that starts at 0
  int it = 0;

  template <class Preconditioner>
  PALPATE void solve(Preconditioner& m) {
    right_hand_side();
    Part part = first_residual(m, start());
    float bent = 0.0f;  // p^T A p
    while (m.before(*this, part)) {
      const V zw = multiply();
      float curved;
      if (!m.after(*this, part, zw, curved)) break;
      const float volume = gain * along;
      curved += volume * along;
      float beta = before != 0.0f ? rz / before : 0.0f;
      bent = curved - beta * beta * bent;
      if (!(bent > 0.0f)) {  // rounding has eaten it
        beta = 0.0f;
        bent = curved;
      }
      before = rz;
      const float alpha = rz / bent;
      work += alpha * rz;
      part = update(m, alpha, beta, volume);
      ++it;
    }
    finish();
  }

  PALPATE bool goes_on() const {
    return residual > target && it < (int)number[ITERATIONS];
  }

  // r = b, its norm and the residual to reach; neighbours are shown where to start.
  PALPATE void right_hand_side() {
    const float gv = step[1] - step[3] * step[0] * step[0];
    const float impulse = stage == RESPONSE ? 0.0f : volume_impulse(
      f, world, group, f.system.disp_trial.data + at, f.system.vel_trial.data + at, gv);
    V bb = splat(0.0f), flux = splat(0.0f);
    z.next(group);
    slices.each([&](int s, Lane lane, int k) {
      V3 b = ld3(f.system.rhs.data + at + 24 * s, lane);
      if (impulse != 0.0f) b += impulse * ld3(areavec + 24 * s, lane);
      r.put(s, b, lane, k);
      bb += dot(b, precondition(a, b, s, lane));
      show(s, ld3(warm + 24 * s, lane), lane, flux);
    });
    group.sum(bb, flux, norm, along);
    const float whole = stage == RESPONSE ? f.system.status.data[4 * world + 2] : norm;
    const float floor = step[2], tolerance = number[TOLERANCE];
    target = tolerance * tolerance * (whole > floor ? whole : floor);
    if (stage == RESPONSE && target < ENOUGH * ENOUGH * norm) target = ENOUGH * ENOUGH * norm;
  }

  // Returns what of `dvel_warm` to start with; q is A times that.
  PALPATE float start() {
    if (stage != FIRST || !(norm > target)) return 0.0f;
    V db = splat(0.0f), dq = splat(0.0f);
    const float volume = gain * along;
    slices.each([&](int s, Lane lane, int k) {
      const V3 d = z.own(s, lane);
      V3 ad = product(a, z, d, s, lane);
      if (volume != 0.0f) ad += volume * ld3(areavec + 24 * s, lane);
      ap.put(s, ad, lane, k);
      dq = add_dot(dq, d, ad);
      db += dot(d, r.get(s, lane, k));
    });
    float curved, gained;
    group.sum(dq, db, curved, gained);
    return curved > 0.0f ? gained / curved : 0.0f;
  }

  // x and r at the start, z.
  template <class Preconditioner>
  PALPATE Part first_residual(const Preconditioner& m, float start) {
    Part part = {splat(0.0f), splat(0.0f)};
    const V3 zero = {splat(0.0f), splat(0.0f), splat(0.0f)};
    z.next(group);
    slices.each([&](int s, Lane lane, int k) {
      V3 from = zero, b = r.get(s, lane, k);
      if (start != 0.0f) {
        from = start * ld3(warm + 24 * s, lane);
        b -= start * ap.get(s, lane, k);
        r.put(s, b, lane, k);
      }
      x.put(s, from, lane, k);
      p.put(s, zero, lane, k);
      ap.put(s, zero, lane, k);
      renew(m, s, b, lane, part);
    });
    return part;
  }

  // A z less the volume term; returns this thread's part of z^T A z.
  PALPATE V multiply() {
    V zw = splat(0.0f);
    z.shown();
    slices.each([&](int s, Lane lane, int k) {
      const V3 own = z.own(s, lane), w = product(a, z, own, s, lane);
      az.put(s, w, lane, k);
      zw += dot(own, w);
    });
    return zw;
  }

  // q, p, x and r of the next iteration, z.
  template <class Preconditioner>
  PALPATE Part update(const Preconditioner& m, float alpha, float beta, float volume) {
    Part part = {splat(0.0f), splat(0.0f)};
    z.next(group);
    slices.each([&](int s, Lane lane, int k) {
      V3 q = az.get(s, lane, k);
      if (volume != 0.0f) q += volume * ld3(areavec + 24 * s, lane);
      V3 d = z.own(s, lane);
      q += beta * ap.get(s, lane, k);
      d += beta * p.get(s, lane, k);
      ap.put(s, q, lane, k);
      p.put(s, d, lane, k);
      x.put(s, x.get(s, lane, k) + alpha * d, lane, k);
      const V3 rest = r.get(s, lane, k) - alpha * q;
      r.put(s, rest, lane, k);
      renew(m, s, rest, lane, part);
    });
    return part;
  }

  // z from here on by another preconditioner; sets rz and `along`.
  template <class Preconditioner>
  PALPATE void restart(const Preconditioner& m) {
    Part part = {splat(0.0f), splat(0.0f)};
    slices.each([&](int s, Lane lane, int k) { renew(m, s, r.get(s, lane, k), lane, part); });
    group.sum(part.rr, part.along, rz, along);
    before = 0.0f;
  }

  // z where r is new, and its part of the sums.
  template <class Preconditioner>
  PALPATE void renew(const Preconditioner& m, int s, V3 r, Lane lane, Part& part) {
    const V3 z = precondition(a, r, s, lane);
    part.rr += dot(r, z);
    show(s, m.scaled(z), lane, part.along);
  }

  // Lets neighbours read a vector at s; adds its sum with the area vectors.
  PALPATE void show(int s, V3 v, Lane lane, V& flux) {
    z.show(s, v, lane);
    if (a.bends) z.show_normal(s, dot(v, ld3(a.normal + 24 * s, lane)), lane);
    if (bulk != 0.0f) flux += dot(v, ld3(areavec + 24 * s, lane));
  }

  // Notes what a response made of the impulses, and returns how much of it is taken.
  PALPATE float relax() {
    const float expected = f.state.expected.data[world];
    const float ratio = expected > 0.0f && work > 0.0f ? expected / work : 1.0f;
    if (group.is_first()) f.system.ratio.data[world] = ratio;
    return relaxation(ratio);
  }

  // Writes the solution and the world's status.
  PALPATE void finish() {
    const float part = stage == RESPONSE ? relax() : 1.0f;
    slices.each([&](int s, Lane lane, int k) {
      if (part < 1.0f) x.put(s, part * x.get(s, lane, k), lane, k);
      x.store(s, lane, k);
    });
    if (!group.is_first()) return;
    float* out = f.system.status.data + 4 * world;
    out[0] = (stage == FIRST ? 0.0f : out[0]) + (float)it;
    if (stage == FIRST) out[2] = norm;
    if (stage != RESPONSE)
      out[1] = out[2] > 0.0f ? sqrtf((residual > 0.0f ? residual : 0.0f) / out[2]) : 0.0f;
    out[3] = norm < 1e30f && residual < 1e30f && norm >= 0.0f ? 0.0f : 1.0f;
  }
};

// The inverse of the diagonal blocks alone. The norm of the residual is then all there is to sum: by
// itself, or where SUMS_COST together with z^T A z, after one product more than it takes.
template <bool SUMS_COST>
struct Jacobi {
  PALPATE V3 scaled(V3 z) const { return z; }

  template <class Pcg>
  PALPATE bool before(Pcg& s, const Part& part) const {
    if (SUMS_COST) return true;
    s.group.sum(part.rr, part.along, s.residual, s.along);
    s.rz = s.residual;
    return s.goes_on();
  }

  template <class Pcg>
  PALPATE bool after(Pcg& s, const Part& part, V zw, float& curved) const {
    if (!SUMS_COST) {
      curved = s.group.sum(zw);
      return true;
    }
    s.group.sum(part.rr, part.along, zw, s.residual, s.along, curved);
    s.rz = s.residual;
    return s.goes_on();
  }
};

// Solves A sol = rhs, A as `assemble` wrote it; writes `sol` and `status`. On CUDA a node has SPLIT
// threads.
template <int SPLIT, class Fields, class Any>
PALPATE void solve(const Fields& f, Thread t, int stage, const Any& a) {
  using Team = Group<SUMS, SPLIT>;
  Team group(t, f.system.partial.data);
  choose_own(group, f.shape.nused, [&](auto own) {
    using Mine = Slices<decltype(own)::COUNT, SPLIT>;
    using Vector = Quads<decltype(own)::COUNT, SPLIT>;
    const Mine slices(group, f.shape.nused);
    Vector z(f, t.world, slices);
    Jacobi<Team::SUMS_COST> jacobi;
    Pcg<Fields, Team, Mine, Vector, Any>{f, t.world, stage, group, slices, z, a}.solve(jacobi);
  });
}
template <class Fields>
PALPATE void solve(const Fields& f, Thread t, int stage) {
  solve<1>(f, t, stage, matrix(f, t.world));
}

}  // namespace palpate
