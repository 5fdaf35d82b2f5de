// What a rod goes through: points that hold it, each tied to a place on an edge by a spring, which along the rod bears no
// more than friction does, and across it no more than the point, which tears. The rod's step takes them to move on as they
// do; what holds it takes the force that comes of that. Where a tie stops the rod it pushes only, along one way.
#pragma once
#include "tissue/rod_contact.h"

AS_WRITTEN

namespace palpate {

// Stiffness of a tie that slips, over that of one that holds: a drag of 1.5e-4 N at 1 mm/s on the sheets of the tests, and
// without one whole strands slide too far in an iteration.
constexpr double DRAG = 0.02;

// The energy of the ties, in one lane; adds its gradient and second derivative where there are a gradient and a matrix,
// and notes the forces.
template <class Fields>
CALLED double ties_energy(const Fields& f, const double* x, double* g, const RodMatrix* H) {
  double sum = 0.0;
  const auto add = [&](int t) {
    const int i = f.tie_edge.data[t], node[2] = {i, i + 1};
    double* tie = f.tie_value.data + TIE_LENGTH * t;
    const double w[2] = {1.0 - tie[TIE_PART], tie[TIE_PART]};
    const double firm = tie[TIE_STIFFNESS], slack = tie[TIE_FRICTION] / firm, bears = tie[TIE_BEARS];
    const D3 at = w[0] * load(x + 3 * i) + w[1] * load(x + 3 * i + 3), along = load(tie + TIE_ALONG);
    const D3 pull = at - load(tie + TIE_AIM);
    const double ahead = dot(pull, along), far = fabs(ahead);
    if (tie[TIE_STOP] > 0.0) {  // pushes only, along that way
      const double in = ahead < tie[TIE_STOP] ? tie[TIE_STOP] - ahead : 0.0;
      sum += 0.5 * firm * in * in;
      store(tie + TIE_FORCE, firm * in * along);
      if (!g || in == 0.0) return;
      Terms<2> terms;
      terms.add(w, along, -firm * in, firm);
      terms.scatter(node, g, *H);
      return;
    }
    const double over = far > slack ? far - slack : 0.0;
    const double per = over > 0.0 ? (firm * slack + DRAG * firm * over) / far : firm;
    const D3 off = pull - ahead * along;
    const double within = far - over, aside = norm(off);
    const bool tears = firm * aside > bears;
    const double k = tears ? bears / aside : firm;
    const double aside2 = tears ? (2.0 * aside - bears / firm) * bears / firm : dot(off, off);
    sum += 0.5 * firm * (aside2 + within * within) + (firm * slack + 0.5 * DRAG * firm * over) * over;
    const D3 force = -k * off - (per * ahead) * along;
    store(tie + TIE_FORCE, force);
    store(tie + TIE_TORN, tears ? (1.0 - k / firm) * off : D3{0.0, 0.0, 0.0});
    if (!g) return;
    Terms<2> terms;
    terms.add_each(w, k);
    if (over > 0.0 || tears) terms.add(w, along, 0.0, (over > 0.0 ? DRAG - 1.0 : 0.0) * firm + (firm - k));
    if (tears) terms.add(w, (1.0 / aside) * off, 0.0, -k);
    for (int c = 0; c < 2; ++c) store(terms.g + 3 * c, -w[c] * force);
    terms.scatter(node, g, *H);
  };
  if (f.tie_count.data[0]) one_lane([&] { for (int t = 0; t < f.tie_count.data[0]; ++t) add(t); });
  return sum;
}

}  // namespace palpate
