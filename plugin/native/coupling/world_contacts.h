// Batches: how much an organ's contacts yield under each of its tools. A thread has a tool of a world.
#pragma once
#include "contact/series_compliance.h"
#include "coupling/worlds.h"

namespace palpate {

// A tool's contacts with an organ in one world, in mujoco_warp's memory.
template <class Fields>
struct WorldContacts {
  const Fields& f;
  int geom;

  PALPATE int count() const { return f.count.data[0]; }

  PALPATE size_t contact(int k) const { return f.start.data[0] + f.before.data[0] + k; }

  // Whether a contact is this tool's, or another's, with the organ, and where.
  PALPATE bool find(int k, bool own, Press& press) const {
    const size_t c = contact(k);
    const int met = ((const int*)f.contact_geom.data)[2 * c], elem = ((const int*)f.elem.data)[2 * c + 1];
    if (met < 0 || (met == geom) != own || elem < 0) return false;
    press.pos = load((const float*)f.pos.data + 3 * c);
    press.normal = load((const float*)f.frame.data + 9 * c);
    return true;
  }

  PALPATE bool other(int k, Press& press) const { return find(k, false, press); }

  PALPATE bool at(int k, Press& press) const {
    if (!find(k, true, press)) return false;
    const size_t c = contact(k);
    const int* slot = f.flex_elem.data + f.elemadr + 3 * ((const int*)f.elem.data)[2 * c + 1];
    for (int q = 0; q < 3; ++q) press.corner[q] = f.slot_node.data[slot[q]];
    press.gap = f.dist.data[c];
    press.measure(place(press.corner[0]), place(press.corner[1]), place(press.corner[2]));
    return true;
  }

  PALPATE D3 place(int node) const {
    return load(f.rest.data + 3 * node) + load_lane(f.disp.data + offset_of(node));
  }
  PALPATE D3 force(int node) const { return load(f.force.data + 3 * node); }
};

// Finds how the contacts of each tool yield.
template <class Fields>
PALPATE void find_series(const Fields& f, Thread t, int) {
  each_item(t, f.ntool, [&](int q) {
    const int geom = f.tool_geom.data[q];
    if (geom < 0) return;  // an edge of a thread
    const double* of = f.tool.data + GEOM_LENGTH * q;
    const float* R = (const float*)f.geom_xmat.data + 9 * geom;
    const Tool tool = {(int)of[GEOM_TYPE], load((const float*)f.geom_xpos.data + 3 * geom), {R[2], R[5], R[8]},
                       of[GEOM_SIZE], f.radius};
    const WorldContacts<Fields> all = {f, geom};
    Dent dent;
    Series series = {0.0, 0.0};
    if (tool.is_known() && find_dent(all, tool, dent))
      series = unresolved(all, tool, dent, f.tissue.data);
    Press press;
    for (int k = 0; k < all.count(); ++k) {
      if (!all.at(k, press)) continue;
      const D3 x[3] = {all.place(press.corner[0]), all.place(press.corner[1]), all.place(press.corner[2])};
      const double radius = tool.size + tool.skin;
      const double off = series.rounds > 0.0 ? series.rounds * rise(x, press.pos, radius) : 0.0;
      const Stiff stiff = stiffened(press.gap + off, radius, series.compliance);
      float* out = (float*)f.yields_by.data + 3 * all.contact(k);
      out[0] = (float)stiff.secant, out[1] = (float)stiff.tangent, out[2] = (float)off;
    }
  });
}

}  // namespace palpate
