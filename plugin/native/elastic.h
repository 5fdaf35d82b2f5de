// Internal forces of the surface and the matrix of the implicit step.
#pragma once
#include "simd.h"

namespace palpate {

// Unit normal of each triangle; below a tenth of its rest area it fades, and the hinge forces with it.
template <class Fields>
PALPATE void elem_normal(const Fields& f, Thread t, int) {
  const float* disp = f.system.disp_trial.data + 24 * (size_t)t.world * f.shape.nslice;
  each_slice(t, f.shape.nelemslice, [&](int s, Lane lane) {
    const int* node = f.shape.elem_node.data + 24 * s;
    const float* rest = f.shape.elem_rest.data + 48 * s;
    const V3 ra = ld3(rest, 0, lane), rb = ld3(rest, 3, lane), rn = cross(ra, rb);
    const V3 u = gather3(disp, node, lane);
    const V3 a = ra + gather3(disp, node + 8, lane) - u;
    const V3 b = rb + gather3(disp, node + 16, lane) - u;
    const V3 n = cross(a, b);
    const V3 unit = (1.0f / vsqrt(vmax(dot(n, n), 0.01f * dot(rn, rn) + 1e-30f))) * n;
    float* out = f.system.elem_normal.data + 32 * ((size_t)t.world * f.shape.nelemslice + s);
    st3(out, unit, lane);
  });
}

}  // namespace palpate
