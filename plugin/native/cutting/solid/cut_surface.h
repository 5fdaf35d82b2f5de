// The surface along which a solid is cut: lines from a path on its skin inward, side by side.
#pragma once
#include "cutting/surface.h"

namespace palpate {

struct Sheet {
  const double *path, *begin, *end;  // samples of the path on the skin; ends of the lines
  int npath, nline;
  bool closes;  // whether the last line is the first one
  double before, after;  // how far it goes on beyond the path's ends
  double step, reach;  // of lines side by side, and the longest one

  PALPATE D3 top(int k) const { return load(begin + 3 * k); }
  PALPATE D3 way(int k) const { return load(end + 3 * k) - top(k); }
  PALPATE D3 level(int k, double share) const { return top(k) + share * way(k); }
  PALPATE int count() const { return nline - closes; }  // different ones
  PALPATE int beside(int k) const {
    const int n = count();
    return closes ? (k + n) % n : k < 0 ? 0 : k < n ? k : n - 1;
  }
};

// Where a point is beside a sheet: how far, and how far beyond the path's ends and below the lower end,
// both below 0 over it; the nearest point of it, and how far along the path that is.
struct Where { double off, past, deep, along; D3 at; };

PALPATE double clamp01(double x) { return x < 0.0 ? 0.0 : x > 1.0 ? 1.0 : x; }

// How far neighbouring lines are apart at most, and how long the longest is.
PALPATE void span(Sheet& s) {
  s.step = s.reach = 0.0;
  for (int k = 0; k < s.nline; ++k) {
    const double size = norm(s.way(k));
    s.reach = size > s.reach ? size : s.reach;
    if (k + 1 == s.nline) return;
    const double above = norm(s.top(k + 1) - s.top(k)), below = norm(s.level(k + 1, 1.0) - s.level(k, 1.0));
    s.step = above > s.step ? above : s.step;
    s.step = below > s.step ? below : s.step;
  }
}

// The line that is nearest to a point; `share` gets how far down it is. The distance to the next line
// differs by `step` at most, so that far ones are passed over.
PALPATE int nearest_line(const Sheet& s, D3 p, double& share) {
  int best = 0;
  double least = 1e300;
  for (int k = 0; k < s.nline;) {
    const D3 way = s.way(k), arm = p - s.top(k);
    const double t = dot(arm, way) / dot(way, way), far = norm(arm - clamp01(t) * way);
    if (far < least) least = far, best = k, share = t;
    const double over = s.step > 0.0 ? (far - least) / s.step * (1.0 - 1e-9) : 0.0;
    k += 1 + (over < s.nline ? (int)over : s.nline);
  }
  return best;
}

// The direction along the sheet at a line, so far down it.
PALPATE D3 tangent(const Sheet& s, double share, int k) {
  return unit(s.level(s.beside(k + 1), share) - s.level(s.beside(k - 1), share));
}

PALPATE Where measure(const Sheet& s, D3 p) {
  double share = 0.0, least = 1e300, on = 0.0, over = 0.0;
  const int line = nearest_line(s, p, share);
  const double size = norm(s.way(line));
  int start = line, stop = line;
  // The polyline through all lines at that share of their length, beside the nearest of them.
  for (int side = -1; side < 1; ++side) {
    const int a = s.beside(line + side), b = s.beside(line + side + 1);
    const D3 arm = s.level(b, share) - s.level(a, share), gap = p - s.level(a, share);
    const double length2 = dot(arm, arm);
    if (length2 == 0.0) continue;
    const double free = dot(gap, arm) / length2, within = clamp01(free), miss = norm(gap - within * arm);
    if (miss >= least) continue;
    least = miss, on = within, over = (free - within) * sqrt(length2), start = a, stop = b;
  }
  const D3 along = unit((1.0 - on) * tangent(s, share, start) + on * tangent(s, share, stop));
  const D3 normal = unit(cross(along, (1.0 / size) * s.way(line)));
  const double inside = clamp01(share);
  const D3 there = s.level(start, share) + on * (s.level(stop, share) - s.level(start, share));
  Where out = {dot(p - there, normal), -1e300, (share - 1.0) * size, 0.0, s.level(start, inside)};
  out.at += on * (s.level(stop, inside) - s.level(start, inside));
  if (!s.closes && start == 0) out.past = -over - s.before;
  if (!s.closes && stop == s.count() - 1 && over - s.after > out.past) out.past = over - s.after;
  for (int k = 0; k < start; ++k) out.along += norm(s.top(k + 1) - s.top(k));
  out.along += on * (start + 1 < s.nline ? norm(s.top(start + 1) - s.top(start)) : 0.0);
  return out;
}

}  // namespace palpate
