// Lips of a cut, which do not pass through each other. Each vertex of a lip has a twin, the vertex of the other lip that
// was one with it. With g how far the twins are apart along the normal of the cut, r how far in all, and s a slack, a
// pair is pushed apart along the normal by
//
//   F = k (1 - (r / reach)^2) (-s - g)   where that is positive
//
// It ends where twins have left each other by `reach`: a flap that is folded back touches nothing. The normal turns
// with a triangle of each lip. F is that at the end of the step, and there is none where the lips are apart now and
// where they go. What it weighs couples both nodes in the matrix of the step, so lips that touch move on together
// freely. Doubles, a thread a pair; no two pairs have a node in common.
#pragma once
#include "core/triangle.h"
#include "forces/bodies.h"

namespace palpate {

constexpr double SLACK = 1e-3;  // of `reach`, that lips overlap and do not touch yet: those of a cut just made

struct Axes { D3 x, y, z; };

// From the first lip to the second, where a triangle of each of them has it now.
template <class Fields>
PALPATE D3 normal_of(const Fields& f, int n) {
  D3 sum = {0.0, 0.0, 0.0};
  for (int side = 2 * n; side < 2 * n + 2; ++side) {
    D3 x[3];
    for (int c = 0; c < 3; ++c) {
      const int v = f.corner.data[3 * side + c];
      x[c] = rest_of(f.own, v) + moved_by(f.mj, f.own, v);
    }
    Axes axes;
    set_axes(axes, x[1] - x[0], x[2] - x[0]);
    sum += in_axes(axes, load(f.normal.data + 3 * side));
  }
  return unit(sum);
}

// Adds the forces of what touches to the solver's input.
template <class Fields>
PALPATE void enter_lips(const Fields& f, Thread t, int) {
  const double h = f.mj.timestep.data[0];
  each_item(t, f.count.data[0], [&](int n) {
    const int *vert = f.vert.data + 2 * n, a = vert[0], b = vert[1];
    const int node[2] = {f.solve.node.data[a], f.solve.node.data[b]};
    const D3 normal = normal_of(f, n);
    const D3 off = rest_of(f.own, b) + moved_by(f.mj, f.own, b) - rest_of(f.own, a) - moved_by(f.mj, f.own, a);
    const double goes = dot(goes_by(f.mj, f.own, b) - goes_by(f.mj, f.own, a), normal);
    const double now = -dot(off, normal) - SLACK * f.reach, over = now - f.ahead * h * goes;
    const double near = 1.0 - dot(off, off) / (f.reach * f.reach);
    const bool touches = near > 0.0 && (now > 0.0 || over > 0.0);
    const double k = touches ? near * f.stiffness.data[n] : 0.0, weight = k * f.gain * h * h;
    const D3 m = weight * normal;
    const double entries[6] = {m.x * normal.x, m.x * normal.y, m.x * normal.z, m.y * normal.y, m.y * normal.z, m.z * normal.z};
    for (int side = 0; side < 2; ++side) {
      float* hold = hold_at(f.pair_hold.data, node[side]);
      for (int c = 0; c < 6; ++c) hold[LANES * c] = (float)entries[c];
      f.pair_node.data[node[side]] = offset_of(node[1 - side]);
      if (!touches) continue;
      float* ext = f.solve.force_ext.data + offset_of(node[side]);
      store_lane(ext, load_lane(ext) + ((side ? k : -k) * over) * normal);
    }
    if (touches) f.paired.data[0] = 1;
  });
}

}  // namespace palpate
