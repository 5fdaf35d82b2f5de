// What a rod goes through: points that hold it, each tied across an edge by a spring, along which it slides against
// friction. The rod's step takes them to move on as they do; what holds it takes the force that comes of that.
#pragma once
#include "tissue/rod_contact.h"

AS_WRITTEN

namespace palpate {

// Numbers of a tie: its place on the edge, as a share; where the point will be; stiffness; what friction bears; how far
// ahead of the point its place is; which way the rod slides; and, of the step, the force on the rod.
constexpr int TIE = 13;

// The energy of the ties, in one lane; adds its gradient and second derivative where there are a gradient and a matrix,
// and notes the forces.
template <class Fields>
PALPATE double ties_energy(const Fields& f, const double* x, double h, double* g, const RodMatrix* H) {
  double sum = 0.0;
  const auto add = [&](int t) {
    const int i = f.tie_edge.data[t], node[2] = {i, i + 1};
    double* tie = f.tie_value.data + TIE * t;
    const double w[2] = {1.0 - tie[0], tie[0]}, k = tie[4], limit = tie[5];
    const D3 at = w[0] * load(x + 3 * i) + w[1] * load(x + 3 * i + 3), along = load(tie + 7);
    const D3 pull = at - load(tie + 1), off = pull - dot(pull, along) * along;
    const double slides = dot(pull, along) - tie[6], y = fabs(slides);
    const Slip s = slip(y, h * f.slow);
    sum += 0.5 * k * dot(off, off) + limit * s.energy;
    const D3 force = -k * off - (limit * s.per * slides) * along;
    store(tie + 10, force);
    if (!g) return;
    Terms<2> terms;
    terms.add_each(w, k);
    terms.add(w, along, 0.0, limit * (s.per + s.along * y * y) - k);
    for (int c = 0; c < 2; ++c) store(terms.g + 3 * c, -w[c] * force);
    terms.scatter(node, g, *H);
  };
  if (f.tie_count.data[0]) one_lane([&] { for (int t = 0; t < f.tie_count.data[0]; ++t) add(t); });
  return sum;
}

}  // namespace palpate
