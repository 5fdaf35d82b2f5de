// Volume stiffness and pressure: energy bulk (V - V0)^2 / (2 V0) - pressure V.
#pragma once
#include "core/group.h"

namespace palpate {

// Impulse of volume and pressure along the area vectors, 6 dV/dx: push is the force's, pull that of
// K v with weight gv,
//   push = h (pressure - bulk (V - V0) / V0) / 6,  pull = gv bulk / V0 (areavec . vel) / 36.
// `disp` and `vel` are the world's displacement and velocity; the volume goes to `total`.
template <class Fields, class Team>
PALPATE float volume_impulse(
  const Fields& f, int world, Team& group, const float* disp, const float* vel, float gv
) {
  const float* number = numbers(f, world);
  const float bulk = number[BULK], pressure = number[PRESSURE];
  if (!VOLUMES || (bulk == 0.0f && pressure == 0.0f)) return 0.0f;
  const float* areavec = f.system.areavec.data + 24 * (size_t)world * f.shape.nslice;
  const float* rest = f.shape.rest.data + mesh_of(f, world);
  V vol = splat(0.0f), rate = splat(0.0f);
  group.each(0, f.shape.nused, [&](int s, Lane lane) {
    const V3 o = ld3(areavec + 24 * s, lane);
    const V3 x = ld3(rest + 24 * s, lane) + ld3(disp + 24 * s, lane);
    vol = add_dot(vol, x, o);
    rate = add_dot(rate, ld3(vel + 24 * s, lane), o);
  });
  float volume, flux;
  group.sum(vol, rate, volume, flux);
  volume /= 18.0f;
  if (group.is_first()) f.system.total.data[2 * world] = volume;
  const float volume0 = f.shape.volume0, h = f.state.step.data[4 * world];
  const float push = h * (pressure - bulk * (volume - volume0) / volume0) / 6.0f;
  const float pull = gv * bulk / volume0 / 36.0f * flux;
  return push - pull;
}

}  // namespace palpate
