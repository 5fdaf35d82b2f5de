// Where a blade sits in an organ: where it goes through the surface, and how deep it is from there.
#pragma once
#include "core/block.h"
#include "cutting/lines.h"
#include "core/triangle.h"

namespace palpate {

constexpr double NOWHERE = 1e300;  // farther than any

constexpr double GRAZES = 0.1;  // cosine to the normal under which it is not told which end is below

// The least that the threads of a warp have found: all of them have it then.
PALPATE void agree(double& least, int& elem, D3& weight) {
  double w[3] = {weight.x, weight.y, weight.z};
  warp_least(least, elem, w);
  weight = {w[0], w[1], w[2]};
}

template <class Fields>
PALPATE void corners_at_rest(const Fields& f, int t, D3* x) {
  for (int c = 0; c < 3; ++c) x[c] = load(f.flat.data + 3 * f.elem.data[3 * t + c]);
}

template <class Fields>
PALPATE void corners_now(const Fields& f, int t, D3* x) {
  for (int c = 0; c < 3; ++c) {
    const int v = f.elem.data[3 * t + c];
    x[c] = load(f.own.rest.data + 3 * v) + moved_by(f.mj, f.own, v);
  }
}

// Where a line goes through a triangle: how far from its end, or -1 where it does not.
PALPATE double crossing(const Line& s, const D3* x, D3& weight) {
  const D3 e = x[1] - x[0], g = x[2] - x[0], p = cross(s.along, g);
  const double det = dot(e, p);
  if (!(fabs(det) > 0.0)) return -1.0;
  const D3 r = s.from - x[0], q = cross(r, e);
  const double v = dot(r, p) / det, w = dot(s.along, q) / det, t = dot(g, q) / det;
  weight = {1.0 - v - w, v, w};
  return v < 0.0 || w < 0.0 || v + w > 1.0 || t > s.length ? -1.0 : t;
}

// Finds the triangle that a line goes through with the least `beyond` of its corners and of how far from the line's
// end that is, NOWHERE for one that does not count; returns the least, or -1.
template <class Fields, class Beyond>
PALPATE double find_crossing(const Fields& f, Thread me, const Line& s, int& elem, D3& weight, Beyond beyond) {
  const D3 half = (0.5 * s.length) * s.along, middle = s.from + half, reach = vabs(half);
  const D3 zero = {0.0, 0.0, 0.0};
  double least = NOWHERE;
  for (int t = me.tid; t < f.nelem; t += me.nthread) {
    D3 x[3], w;
    corners_now(f, t, x);
    const D3 low = zero - vmax(vmax(zero - x[0], zero - x[1]), zero - x[2]);
    const D3 high = vmax(vmax(x[0], x[1]), x[2]), off = vmax(low - middle, middle - high) - reach;
    if (off.x > 0.0 || off.y > 0.0 || off.z > 0.0) continue;
    const double at = crossing(s, x, w);
    if (at < 0.0) continue;
    const double far = beyond(x, at);
    if (far >= least) continue;
    least = far, elem = t, weight = w;
  }
  agree(least, elem, weight);
  return least < NOWHERE ? least : -1.0;
}

// Finds where a blade goes through the surface, nearest to one of its ends; returns how far that end is
// beyond it, or -1.
template <class Fields>
PALPATE double enters(const Fields& f, Thread me, const Line& s, int& elem, D3& weight) {
  return find_crossing(f, me, s, elem, weight,
                       [&](const D3*, double at) { return at < s.length - at ? at : s.length - at; });
}

// Finds the point of the surface that is nearest to a place, with the triangles' corners as given: its triangle and
// weights; returns how far it is.
template <class Fields, class Corners>
PALPATE double find_nearest(const Fields& f, Thread me, D3 place, int& elem, D3& weight, Corners corners) {
  double least = NOWHERE;
  for (int t = me.tid; t < f.nelem; t += me.nthread) {
    D3 x[3];
    corners(f, t, x);
    const double far = norm(x[0] - place) - norm(x[1] - x[0]) - norm(x[2] - x[0]);
    if (far > 0.0 && far * far > least) continue;
    const D3 w = barycentric(place, x), off = blend(x, w) - place;
    if (!(dot(off, off) < least)) continue;
    least = dot(off, off), elem = t, weight = w;
  }
  agree(least, elem, weight);
  return sqrt(least);
}
template <class Fields>
PALPATE void find_seat(const Fields& f, Thread me, D3 place, int& elem, D3& weight) {
  find_nearest(f, me, place, elem, weight, [](const Fields& g, int t, D3* x) { corners_at_rest(g, t, x); });
}

// Where the seat of a blade is: triangle, weights, place now, and normal.
struct Seated { D3 x[3], rest[3], weight, at, normal; };

template <class Fields>
PALPATE Seated seated(const Fields& f, const double* s) {
  Seated out;
  const int elem = (int)s[BLADE_ELEM];
  corners_now(f, elem, out.x);
  corners_at_rest(f, elem, out.rest);
  out.weight = barycentric(load(s + BLADE_AT), out.rest);
  out.at = blend(out.x, out.weight);
  out.normal = unit_of(cross(out.x[1] - out.x[0], out.x[2] - out.x[0]));
  return out;
}

// A way along a triangle, as it is in another shape of the triangle.
PALPATE D3 carried(D3 way, const D3* x, const D3* to) {
  const D3 e = x[1] - x[0], g = x[2] - x[0];
  const double ee = dot(e, e), eg = dot(e, g), gg = dot(g, g), ew = dot(e, way), gw = dot(g, way);
  const double det = ee * gg - eg * eg;
  if (!(det > 0.0)) return {0.0, 0.0, 0.0};
  return ((gg * ew - eg * gw) / det) * (to[1] - to[0]) + ((ee * gw - eg * ew) / det) * (to[2] - to[0]);
}

// How far a blade is beyond a place on it: its end that is nearer to that is inside.
PALPATE double beyond(const Line& line, double place) {
  return place < line.length - place ? place : line.length - place;
}

// How deep a seat's blade is in a solid, and which way: as far as its end that is below the skin. Scissors
// close over what lies between them: from the seat along the way they close to where the solid ends, or as
// far as they reach, and then not `through`.
struct Depth { double deep; bool through; D3 in; };

template <class Fields>
PALPATE Depth depth_of(const Fields& f, Thread me, int i, const Line& line, double place, const Seated& at) {
  const D3 zero = {0.0, 0.0, 0.0};
  const double level = dot(line.along, at.normal);
  const bool back = level > 0.0, shears = f.geom.data[2 * i + 1] >= 0;
  const Line in = {at.at, back ? zero - line.along : line.along, back ? place : line.length - place};
  if (f.law.data[LAW_LENGTH * i + LAW_SOLID] == 0.0 || (!shears && fabs(level) < GRAZES))
    return {beyond(line, place), false, zero};
  if (!shears) return {in.length, false, in.along};
  double least = NOWHERE;
  for (int t = me.tid; t < f.nelem; t += me.nthread) {
    D3 x[3], w;
    corners_now(f, t, x);
    if (!(dot(cross(x[1] - x[0], x[2] - x[0]), in.along) > 0.0)) continue;
    const double far = crossing(in, x, w);
    if (far >= 0.0 && far < least) least = far;
  }
  int elem = 0;
  D3 weight = zero;
  agree(least, elem, weight);
  const bool through = least < NOWHERE;
  return {through ? least : in.length, through, in.along};
}

// The least of a place's shares of the corners of a tetrahedron, negative where it is not in there.
template <class Fields>
PALPATE double depth_in_tet(const Fields& f, int t, D3 place, D3& w) {
  D3 x[4];
  for (int c = 0; c < 4; ++c) {
    const int v = f.tet.data[4 * t + c];
    x[c] = load(f.own.rest.data + 3 * v) + moved_by(f.mj, f.own, v) - place;
  }
  const D3 high = vmax(vmax(x[0], x[1]), vmax(x[2], x[3]));
  if (high.x < 0.0 || high.y < 0.0 || high.z < 0.0) return -1.0;
  const D3 a = x[1] - x[0], b = x[2] - x[0], c = x[3] - x[0], p = -1.0 * x[0];
  const double det = dot(a, cross(b, c));
  if (!(det > 0.0)) return -1.0;
  w = (1.0 / det) * D3{dot(p, cross(b, c)), dot(a, cross(p, c)), dot(a, cross(b, p))};
  double low = 1.0 - w.x - w.y - w.z;
  const double shares[3] = {w.x, w.y, w.z};
  for (int k = 0; k < 3; ++k) low = shares[k] < low ? shares[k] : low;
  return low;
}

// Finds the tetrahedron that a place is in, which `tet` is likely to be; returns whether there is one.
template <class Fields>
PALPATE bool find_tet(const Fields& f, Thread me, D3 place, int& tet, D3& weight) {
  if (depth_in_tet(f, tet, place, weight) > 0.0) return true;
  double least = NOWHERE;
  for (int t = me.tid; t < f.ntet; t += me.nthread) {
    D3 w;
    const double low = depth_in_tet(f, t, place, w);
    if (low >= 0.0 && -low < least) least = -low, tet = t, weight = w;
  }
  agree(least, tet, weight);
  return least < NOWHERE;
}

}  // namespace palpate
