// The skin of a solid (a capsule, a serosa): membrane and bending of the surface's triangles, as those
// of a shell, on nodes that have tetrahedra too. Its blocks are beside those of the tetrahedra.
#pragma once
#include "tissue/elastic.h"

namespace palpate {

template <class Fields>
PALPATE Fan capsule_fan(const Fields& f, int world, int s, Lane lane) {
  const int row = f.shape.capsule_adr.data[s], width = f.shape.capsule_adr.data[s + 1] - row;
  return {
    width,
    ld(f.shape.capsule_degree.data, s, lane),
    f.shape.capsule_node.data + 8 * (row + 2 * s),
    f.shape.capsule_rest.data + 24 * (row + 2 * s),
    f.tissue.capsule_metric.data + 40 * (row + s),
    f.shape.capsule_corner.data + 8 * (row + s),
    f.shape.capsule_side.data + 8 * (row + s),
    nullptr,
    f.system.capsule_block.data + 72 * ((size_t)world * f.shape.ncapsule + row),
  };
}

// What the skin gives to its nodes: an impulse in `rhs`, and for an implicit stage what it has on the
// diagonal in `inverse`; `solid_row` adds both to the tetrahedra's.
template <class Fields>
PALPATE void capsule_row(const Fields& f, Thread t, int stage) {
  const Rows at = rows(f, t.world);
  const Assembly<Fields> skin{f, t.world, stage, at};
  Wanted want = skin.want;
  want.shear = want.lame = 1.0f;  // worlds differ in the tetrahedra's
  each_slice(t, f.shape.nslice, [&](int s, Lane lane) {
    const Fan fan = capsule_fan(f, t.world, s, lane);
    const Motion m = {at.disp, at.vel, ld3(at.disp + 24 * s, lane), ld3(at.vel + 24 * s, lane)};
    const Sum sum = around<false>(fan, m, want, lane);
    V3 b = skin.h * sum.force + skin.gv * sum.rate;
    S3 self = splat(skin.g) * sum.stiffness;
    if (skin.bends) self = self + skin.bent(fan, sum, s, b, lane);
    st3(at.rhs + 24 * s, b, lane);
    st3(at.inverse + 48 * s, 0, {self.xx, self.xy, self.xz}, lane);
    st3(at.inverse + 48 * s, 3, {self.yy, self.yz, self.zz}, lane);
  });
}

}  // namespace palpate
