// Stress relaxation: one Prony term on the elastic forces of the nodes, by Simo's convolution (1987,
// doi:10.1016/0045-7825(87)90107-1), as in quasi-linear viscoelasticity (Fung 1993, section 7.6).
// In doubles.
//
// With f the elastic force at once, the force is (1 - g) f + q, and q follows f and fades:
//
//   q_new = exp(-h / tau) q + g (f_new - f)
//
// so that the step has f_new, which is its own, and exp(-h / tau) q - g f as a force besides. What
// f_new was is known from the momentum that it gave, without another evaluation.
#pragma once
#include "forces/bodies.h"

namespace palpate {

// What a step has besides f_new.
template <class Fields>
PALPATE D3 faded(const Fields& f, int i) {
  const double fade = exp(-f.mj.timestep.data[0] / f.law.data[1]);
  const double* memory = f.memory.data + 6 * i;
  return fade * load(memory + 3) - f.law.data[0] * load(memory);
}

// Adds it to the solver's input.
template <class Fields>
PALPATE void enter_relaxation(const Fields& f, Thread t, int) {
  f.quiet.data[0] = 0.0;
  each_item(t, f.nrelax, [&](int i) {
    float* ext = f.force_ext.data + offset_of(f.node.data[i]);
    store_lane(ext, load_lane(ext) + faded(f, i));
  });
}

// Takes f_new from what the step, and its answer to the contacts, made of the velocities.
template <class Fields>
PALPATE void end_relaxation(const Fields& f, Thread t, int) {
  if (f.status.data[3] != 0.0f) return;
  const double per_h = 1.0 / f.mj.timestep.data[0];
  each_item(t, f.nrelax, [&](int i) {
    const int node = f.node.data[i], at = offset_of(node);
    const bool answered = f.flags.data[FLAG_ANSWERED];
    const auto change = [&](int at) {
      const D3 dv = load_lane(f.dvel.data + at);
      return answered ? dv + load_lane(f.sol.data + at) : dv;
    };
    const D3 dv = change(at);
    D3 besides = load_lane(f.force_ext.data + at);
    if (answered) besides += per_h * load_lane(f.rhs.data + at);
    if (f.held) besides = besides - per_h * (load_hold(hold_at(f.hold.data, node)) * dv);
    if (f.paired.data && f.paired.data[0])
      besides = besides - per_h * (load_hold(hold_at(f.pair_hold.data, node)) * (dv - change(f.pair_node.data[node])));
    const D3 force = (per_h * f.mass.data[node]) * dv - besides, left = faded(f, i);
    double* memory = f.memory.data + 6 * i;
    store(memory, force);
    store(memory + 3, left + f.law.data[0] * force);
  });
}

}  // namespace palpate
