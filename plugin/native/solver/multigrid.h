// The multilevel preconditioner of conjugate gradients, for large or stiff organs.
//
// One V-cycle on coarser meshes of the organ takes the place of block Jacobi. The matrix of a
// coarse mesh is the organ's own, made by the same kernels at the present shape sampled at its
// nodes: no triple products, bending scales as it should, and a deformed shape is as good as the
// rest shape.
// Smoothing is Chebyshev iteration on D^-1 A (Adams et al. 2003,
// doi:10.1016/S0021-9991(03)00194-3) of two or three steps, before and after, which keeps the
// preconditioner symmetric; the coarsest mesh in use, whose matrix is mostly mass, has more steps.
// How many levels are in use, and whether any, follows from the condition number that A has in this
// step: g / mass times the stiffness of a node, g = h^2 + h damping.
//
// Below the condition number EASY a mesh is solved by a few steps of the smoother; above WORST
// float32 residuals are noise to the slowest modes, which only cycles would act on.
#pragma once
#include "solver/pcg.h"

namespace palpate {

// What a level's passes read and write: of the finest mesh, or of the coarser ones, whose nodes
// follow one another.
struct Level {
  Matrix a;
  float *b, *z, *zn, *e, *en, *t;
};

template <class Fields>
PALPATE Level level(const Fields& f, int world) {
  const size_t base = (size_t)world * f.shape.nslice;
  return {
    matrix(f, world), f.system.r.data + 24 * base, f.system.z.data + 24 * base,
    f.system.zn.data + 8 * base, f.system.e.data + 24 * base, f.system.en.data + 8 * base,
    f.system.t.data + 24 * base
  };
}

template <class Cycle, class Pcg>
class Multigrid {
 public:
  PALPATE Multigrid(const Cycle& f, const Level (&levels)[2], Pcg& s)
    : f(f), levels(levels), s(s), turned(0), depth(0) {
    V heavy = splat(0.0f);
    s.group.each(0, f.fine.shape.nused, [&](int i, Lane lane) {
      heavy += ld(s.a.diag, i, lane) * ld(f.fine.shape.free.data, i, lane);
    });
    per_mass = s.a.bend * (float)f.transfer.nodes / s.group.sum(heavy);
    if (condition(0) >= f.transfer.threshold && condition(0) <= WORST) {
      depth = 1;
      while (depth < f.transfer.nlevel && condition(depth) > EASY) ++depth;
    }
    damp = depth > 0 ? 2.0f / (high(0) + low(0)) : 1.0f;
  }

  PALPATE V3 scaled(V3 z) const { return damp * z; }

  PALPATE bool before(Pcg&, Part& part) {
    s.group.sum(part.rr, part.along, s.residual, s.along);
    s.rz = s.residual;
    if (!s.goes_on()) return false;
    if (depth > 0) {
      cycle();
      if (!(s.rz > 0.0f)) give_up();
    }
    return true;
  }

  PALPATE bool after(Pcg&, const Part&, V zw, float& curved) {
    curved = s.group.sum(zw);
    return true;
  }

 private:
  const Cycle& f;
  const Level (&levels)[2];  // in memory of their own: they are chosen by number
  Pcg& s;
  unsigned turned;  // bit l: z and e of level l have changed places
  int depth;        // coarser levels in use: down to the first one that is easy
  float per_mass, damp;

  PALPATE const Level& level(int l) const { return levels[l > 0]; }
  PALPATE int first_slice(int l) const { return l == 0 ? 0 : f.transfer.slice_adr.data[l - 1]; }
  PALPATE int last_slice(int l) const {
    return l == 0 ? f.fine.shape.nused : f.transfer.slice_adr.data[l];
  }

  // z of level l, or the other one of z and e.
  PALPATE Vectors z(int l, bool other = false) const {
    const Level& m = level(l);
    const bool e = ((turned >> l & 1) != 0) != other;
    return {e ? m.e : m.z, e ? m.en : m.zn};
  }

  // Condition number of level l; interval of its smoother and number of steps. The coarsest level
  // in use goes down to the mass.
  PALPATE float rate(int l, int k) const { return f.transfer.rate.data[5 * l + k]; }
  PALPATE float condition(int l) const { return per_mass * rate(l, 0) / rate(l, 4); }
  PALPATE float high(int l) const { return rate(l, 1); }
  PALPATE float low(int l) const {
    if (l < depth) return rate(l, 2);
    const float c = 2.0f * condition(l);
    return high(l) / (c < 8.0f ? 8.0f : c > 60.0f ? 60.0f : c);
  }
  PALPATE int steps(int l) const {
    return l < depth ? (int)rate(l, 3) : condition(l) > EASY ? 8 : 4;
  }

  // Writes z of a slice and its component along the normal.
  PALPATE void put(Vectors z, const Matrix& a, int i, V3 v, Lane lane) const {
    z.show(i, v, lane);
    if (a.bends) z.show_normal(i, dot(v, ld3(a.normal + 24 * i, lane)), lane);
  }

  // z = B r; sets rz and `along`.
  PALPATE void cycle() {
    for (int l = 0; l < depth; ++l) {
      smooth(l, 1, false);
      residual(l);
      restrict_to(l + 1);
    }
    smooth(depth, 1, false);
    for (int l = depth - 1; l >= 0; --l) {
      prolong_to(l);
      smooth(l, 0, l == 0);
    }
    s.z = z(0);
  }

  // Chebyshev steps from k = 0, or from 1 where step 0 was on zero: z = D^-1 b / theta.
  PALPATE void smooth(int l, int from, bool last) {
    const float theta = 0.5f * (high(l) + low(l)), delta = 0.5f * (high(l) - low(l));
    const float sigma = theta / delta;
    const int count = steps(l);
    float rho = 1.0f / sigma;
    for (int k = from; k < count; ++k) {
      const float next = k > 0 ? 1.0f / (2.0f * sigma - rho) : rho;
      const float add = k > 0 ? 2.0f * next / delta : 1.0f / theta;
      relax(l, k > 0 ? next * rho : 0.0f, add, k == 1 && from == 1, last && k + 1 == count);
      rho = next;
    }
  }

  // One step on level l: d = keep d + add D^-1 (b - A z), e = z + d; then z and e change places.
  // Where `same`, d is z. Sums b^T e and e with the area vectors where `last`.
  PALPATE void relax(int l, float keep, float add, bool same, bool last) {
    const Level& m = level(l);
    const Matrix& a = m.a;
    const Vectors from = z(l), to = z(l, true);
    const float* b = m.b;
    float* t = m.t;
    V sum = splat(0.0f), flux = splat(0.0f);
    s.group.each(first_slice(l), last_slice(l), [&](int i, Lane lane) {
      const V3 x = from.own(i, lane), bi = ld3(b + 24 * i, lane);
      const V3 r = bi - product(a, from, x, i, lane);
      V3 d = add * precondition(a, r, i, lane);
      if (same) d += keep * x;
      else if (keep != 0.0f) d += keep * ld3(t + 24 * i, lane);
      st3(t + 24 * i, d, lane);
      d += x;
      if (last) sum = add_dot(sum, bi, d);
      put(to, a, i, d, lane);
      if (last && s.bulk != 0.0f) flux += dot(d, ld3(s.areavec + 24 * i, lane));
    });
    if (last) s.group.sum(sum, flux, s.rz, s.along);
    else s.group.sync();
    turned ^= 1u << l;
  }

  // t = b - A z.
  PALPATE void residual(int l) {
    const Level& m = level(l);
    const Matrix& a = m.a;
    const Vectors from = z(l);
    const float* b = m.b;
    float* t = m.t;
    s.group.each(first_slice(l), last_slice(l), [&](int i, Lane lane) {
      const V3 ax = product(a, from, from.own(i, lane), i, lane);
      st3(t + 24 * i, ld3(b + 24 * i, lane) - ax, lane);
    });
    s.group.sync();
  }

  // b of level l from t of the one above it, and the first step of its smoother.
  PALPATE void restrict_to(int l) {
    const float* t = level(l - 1).t;
    const Vectors to = z(l);
    const int* row = f.transfer.down_adr.data;
    const float step = 2.0f / (high(l) + low(l));
    const Level& m = level(l);
    s.group.each(first_slice(l), last_slice(l), [&](int i, Lane lane) {
      V3 b = {splat(0.0f), splat(0.0f), splat(0.0f)};
      for (int k = row[i]; k < row[i + 1]; ++k)
        b += ld(f.transfer.down_weight.data, k, lane)
          * gather3(t, f.transfer.down_node.data + 8 * (size_t)k, lane);
      st3(m.b + 24 * i, b, lane);
      put(to, m.a, i, step * precondition(m.a, b, i, lane), lane);
    });
    s.group.sync();
  }

  // Adds z of the level below l.
  PALPATE void prolong_to(int l) {
    const Matrix& a = level(l).a;
    const float* from = z(l + 1).z;
    const Vectors to = z(l);
    const int* row = f.transfer.up_adr.data + (l == 0 ? 0 : f.fine.shape.nslice);
    s.group.each(first_slice(l), last_slice(l), [&](int i, Lane lane) {
      V3 sum = to.own(i, lane);
      for (int k = row[i]; k < row[i + 1]; ++k)
        sum += ld(f.transfer.up_weight.data, k, lane)
          * gather3(from, f.transfer.up_node.data + 8 * (size_t)k, lane);
      put(to, a, i, sum, lane);
    });
    s.group.sync();
  }

  // Far from the rest shape the interval may not hold: block Jacobi always works.
  PALPATE void give_up() {
    depth = 0;
    damp = 1.0f;
    s.restart(*this);
  }
};

// Solves A sol = rhs as `solve` does, with the matrices of the coarser meshes too.
template <class Cycle>
PALPATE void solve_cycles(const Cycle& f, Thread t, int stage) {
  using Fields = decltype(f.fine);
  Group<MEMORY> group(t, f.fine.system.partial.data);
  const size_t base = (size_t)t.world * f.fine.shape.nslice;
  const Slices<0> slices(group, f.fine.shape.nused);
  Vectors z{f.fine.system.z.data + 24 * base, f.fine.system.zn.data + 8 * base};
  using Solve = Pcg<Fields, Group<MEMORY>, Slices<0>, Vectors, Matrix>;
  const Matrix a = matrix(f.fine, t.world);
  Solve pcg{f.fine, t.world, stage, group, slices, z, a};
  const Level levels[2] = {level(f.fine, t.world), level(f.coarse, t.world)};
  Multigrid<Cycle, Solve> cycles(f, levels, pcg);
  pcg.solve(cycles);
}

// The present shape and the mass of the coarser meshes' nodes, each that of the node that it is
// times the nodes that it stands for.
template <class Cycle>
PALPATE void sample(const Cycle& f, Thread t, int) {
  const size_t fine = (size_t)t.world * f.fine.shape.nslice;
  const size_t coarse = (size_t)t.world * f.coarse.shape.nslice;
  const float* disp = f.fine.system.disp_trial.data + 24 * fine;
  const float* mass = f.fine.state.mass.data + 8 * fine;
  each_slice(t, f.coarse.shape.nslice, [&](int s, Lane lane) {
    const int* node = f.transfer.source.data + 8 * s;
    st3(f.coarse.system.disp_trial.data + 24 * (coarse + s), gather3(disp, node, lane), lane);
    const V m = ld(f.transfer.share.data, s, lane) * gather_number(mass, node, lane);
    st(f.coarse.state.mass.data, coarse + s, m, lane);
  });
}

}  // namespace palpate
