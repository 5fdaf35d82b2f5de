// Where tissue tears: the triangle that is stretched most.
#pragma once
#include "cutting/blade_anchor.h"

namespace palpate {

// The square of the greatest principal stretch of a triangle.
PALPATE double stretch2_of(const D3* rest, const D3* x) {
  const D3 a = rest[1] - rest[0], b = rest[2] - rest[0], c = x[1] - x[0], d = x[2] - x[0];
  const double aa = dot(a, a), ab = dot(a, b), bb = dot(b, b), cc = dot(c, c), cd = dot(c, d), dd = dot(d, d);
  const double det = aa * bb - ab * ab, half = 0.5 * (bb * cc - 2.0 * ab * cd + aa * dd) / det;
  const double rest2 = half * half - (cc * dd - cd * cd) / det;
  return half + sqrt(rest2 > 0.0 ? rest2 : 0.0);
}

// Finds the triangle of a world that is stretched most, and the square of its stretch; a warp has a world.
template <class Fields>
PALPATE void find_stretched(const Fields& f, Thread me, int) {
  double least = NOWHERE;
  int worst = 0;
  D3 none = {0.0, 0.0, 0.0};
  for (int t = me.tid; t < f.nelem; t += me.nthread) {
    D3 rest[3], x[3];
    corners_at_rest(f, t, rest);
    corners_now(f, t, x);
    const double under = -stretch2_of(rest, x);
    if (under < least) least = under, worst = t;
  }
  agree(least, worst, none);
  if (me.tid == 0) f.worst.data[0] = worst, f.square.data[0] = -least;
}

}  // namespace palpate
