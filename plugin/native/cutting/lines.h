// The segments that cut: blades, and of scissors what goes through the wall where their edges cross.
#pragma once
#include "forces/bodies.h"

namespace palpate {

// A segment: an end, the unit vector to its other end, and their distance.
struct Line { D3 from, along; double length; };

PALPATE D3 across(D3 a, D3 unit) { return a - dot(a, unit) * unit; }
PALPATE D3 unit_of(D3 a) {
  const double size = norm(a);
  return size > 0.0 ? (1.0 / size) * a : a;
}

// The segment of a geom in the world, `ahead` seconds on; `which` of a blade's two geoms.
template <class Fields>
PALPATE Line line_of_geom(const Fields& f, int i, int which, double ahead) {
  const int g = f.geom.data[2 * i + which], b = f.mj.geom_bodyid.data[g];
  const int k = f.axis.data[2 * i + which];
  const auto* R = f.mj.geom_xmat.data + 9 * g;
  const D3 half = f.half.data[2 * i + which] * D3{R[k], R[3 + k], R[6 + k]};
  D3 from = load(f.mj.geom_xpos.data + 3 * g) - half, to = from + 2.0 * half;
  if (ahead > 0.0) {
    const Twist moving = twist(f.mj, b, true);
    from += ahead * velocity_at(moving, arm_of(f.mj, b, from));
    to += ahead * velocity_at(moving, arm_of(f.mj, b, to));
  }
  return {from, unit_of(to - from), norm(to - from)};
}

// The same from the end that is nearer to where its body turns.
template <class Fields>
PALPATE Line line_outward(const Fields& f, int i, int which, double ahead) {
  const Line s = line_of_geom(f, i, which, ahead);
  const D3 to = s.from + s.length * s.along, zero = {0.0, 0.0, 0.0};
  const int b = f.mj.geom_bodyid.data[f.geom.data[2 * i + which]];
  const D3 pivot = load(f.mj.xpos.data + 3 * b);
  return norm(s.from - pivot) <= norm(to - pivot) ? s : Line{to, zero - s.along, s.length};
}

// Where the edges of scissors cross, in the world, seen along what they turn about.
struct Shear { D3 at, about, one, two; bool meets; };

template <class Fields>
PALPATE Shear shear_of(const Fields& f, int i, double ahead) {
  const Line p = line_outward(f, i, 0, ahead), q = line_outward(f, i, 1, ahead);
  const double c = dot(p.along, q.along), det = 1.0 - c * c;
  Shear s = {p.from, unit_of(cross(p.along, q.along)), p.along, q.along, false};
  if (det < 1e-6) return s;
  const D3 gap = q.from - p.from;
  const double x = (dot(gap, p.along) - c * dot(gap, q.along)) / det;
  const double y = (c * dot(gap, p.along) - dot(gap, q.along)) / det;
  s.at = 0.5 * (p.from + x * p.along + q.from + y * q.along);
  s.meets = x > 0.0 && x < p.length && y > 0.0 && y < q.length;
  return s;
}

// The segment that cuts, in the organ's frame; its length is 0 where the edges of scissors do not cross.
template <class Fields>
PALPATE Line line_of(const Fields& f, int i, double ahead) {
  Line line = line_of_geom(f, i, 0, ahead);
  if (f.geom.data[2 * i + 1] >= 0) {
    const Shear s = shear_of(f, i, ahead);
    const double half = 0.5 * f.half.data[2 * i];
    line.along = unit_of(s.one - s.two);
    line.from = s.at - half * line.along;
    line.length = s.meets ? 2.0 * half : 0.0;
  }
  const D3 zero = {0.0, 0.0, 0.0};
  line.from = add_turned(zero, f.own.frame.data, line.from - load(f.own.origin.data));
  line.along = add_turned(zero, f.own.frame.data, line.along);
  return line;
}

// Which way scissors cut, in the organ's frame: 0 while they open. Of blades 0 too, which cut any way.
template <class Fields>
PALPATE D3 cuts_toward(const Fields& f, int i) {
  const D3 zero = {0.0, 0.0, 0.0};
  if (f.geom.data[2 * i + 1] < 0) return zero;
  const Shear now = shear_of(f, i, 0.0), then = shear_of(f, i, f.mj.timestep.data[0]);
  const D3 out = unit_of(now.one + now.two);
  return dot(then.at - now.at, out) > 0.0 ? add_turned(zero, f.own.frame.data, out) : zero;
}

template <class Fields>
PALPATE void push_at(const Fields& f, int geom, D3 point, D3 force) {
  const int b = f.mj.geom_bodyid.data[geom];
  push_body(f.mj, b, force, cross(arm_of(f.mj, b, point), force));
}

// Lets the bodies of a blade feel a force at a point, in the world. Each of two edges that cross feels
// what is across to it, so that their work is the force's on the way of the crossing.
template <class Fields>
PALPATE void push_blade(const Fields& f, int i, D3 point, D3 force) {
  const int* geom = f.geom.data + 2 * i;
  if (geom[1] < 0) return push_at(f, geom[0], point, force);
  const Shear s = shear_of(f, i, 0.0);
  const D3 p = cross(s.about, s.one), q = cross(s.about, s.two);
  const double c = dot(p, q), det = 1.0 - c * c, fp = dot(force, p), fq = dot(force, q);
  if (det < 1e-6) return;
  const D3 rest = 0.5 * dot(force, s.about) * s.about;
  push_at(f, geom[0], s.at, ((fp - c * fq) / det) * p + rest);
  push_at(f, geom[1], s.at, ((fq - c * fp) / det) * q + rest);
}

}  // namespace palpate
