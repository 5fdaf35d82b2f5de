// Keeps the angular momentum of an organ that nothing holds.
//
// A step takes nodes from x to x + h (v + dv). Their angular momentum there is the sum of m x ^ (v + dv), so
// that it changes by the sum of m x ^ dv. The forces f on the organ account for h x ^ f, and those of the tissue
// must add nothing. In an implicit step they do, because they belong to another place than x: Euler's loses the
// share (h omega)^2 of a rotation. A rigid rotation about the centre of mass gives back what is missing.
#pragma once
#include "core/group.h"
#include "core/rotation.h"

namespace palpate {

// The sum of a vector over a group.
template <class Team>
PALPATE D3 sum3(Team& group, V3 v) {
  float x, y, z;
  group.sum(v.x, v.y, v.z, x, y, z);
  return {x, y, z};
}

// Corrects `dvel`; nothing where springs hold nodes, or a foundation that may change while running.
template <class Fields>
PALPATE void keep_spin(const Fields& f, Thread t, int) {
  const float h = f.state.step.data[4 * t.world];
  if (h == 0.0f || f.state.hold.data || numbers(f, t.world)[FOUNDATION] != 0.0f) return;
  Group<SUMS> group(t, f.system.partial.data);
  const size_t base = (size_t)t.world * f.shape.nslice;
  const size_t mesh = mesh_of(f, t.world);
  const float *rest = f.shape.rest.data + mesh, *free = f.shape.free.data + mesh;
  const float* disp = f.state.disp.data + 24 * base;
  float* dvel = f.state.dvel.data + 24 * base;
  const auto place = [&](int s, Lane lane) { return ld3(rest + 24 * s, lane) + ld3(disp + 24 * s, lane); };
  const auto mass_of = [&](int s, Lane lane) {
    return ld(free, s, lane) * ld(f.state.mass.data + 8 * base, s, lane);
  };
  const V zero = splat(0.0f);
  const V3 none = {zero, zero, zero};
  V mass = zero;
  V3 first = none;
  group.each(0, f.shape.nused, [&](int s, Lane lane) {
    const V m = mass_of(s, lane);
    mass += m;
    first += m * place(s, lane);
  });
  const float whole = group.sum(mass);
  const D3 sum = sum3(group, first);
  const V3 centre = {splat((float)(sum.x / whole)), splat((float)(sum.y / whole)), splat((float)(sum.z / whole))};
  V3 lost = none, square = none, mixed = none;
  group.each(0, f.shape.nused, [&](int s, Lane lane) {
    const V m = mass_of(s, lane);
    const V3 r = place(s, lane) - centre;
    const V3 impulse = h * ld3(f.state.force_ext.data + 24 * base + 24 * s, lane);
    lost += cross(r, ld(free, s, lane) * impulse - m * ld3(dvel + 24 * s, lane));
    square += m * V3{r.x * r.x, r.y * r.y, r.z * r.z};
    mixed += m * V3{r.y * r.z, r.z * r.x, r.x * r.y};
  });
  const D3 spin = sum3(group, lost), q = sum3(group, square), p = sum3(group, mixed);
  double inertia[3][3] = {{q.y + q.z, -p.z, -p.y}, {-p.z, q.z + q.x, -p.x}, {-p.y, -p.x, q.x + q.y}};
  const D3 turn = rotation_of(inertia, spin);
  if (turn.x != turn.x || turn.y != turn.y || turn.z != turn.z) return;  // the solve has failed, which its status says
  const V3 omega = {splat((float)turn.x), splat((float)turn.y), splat((float)turn.z)};
  group.each(0, f.shape.nused, [&](int s, Lane lane) {
    const V3 back = cross(omega, place(s, lane) - centre);
    st3(dvel + 24 * s, ld3(dvel + 24 * s, lane) + ld(free, s, lane) * back, lane);
  });
}

}  // namespace palpate
