// Windows: a slot is a vertex body of the window. It stands on a node of the organ; the last one
// waits far away.
#pragma once
#include "coupling/node.h"
#include "core/geom.h"

namespace palpate {

// Height at which the spare slot waits [m].
constexpr double AWAY = 1e3;

template <class Fields>
PALPATE double* head(const Fields& f) { return f.inbox.head.data; }
template <class Fields>
PALPATE double* tail(const Fields& f) { return f.own.tail.data; }
template <class Fields>
PALPATE double* pushed(const Fields& f, int slot) {
  return f.inbox.pushed.data + PUSHED_LENGTH * slot;
}
template <class Fields>
PALPATE double* moved(const Fields& f, int slot) {
  return f.inbox.moved.data + MOVED_LENGTH * slot;
}
template <class Fields>
PALPATE double* geom_at(const Fields& f, int q) { return f.inbox.geom.data + GEOM_LENGTH * q; }
template <class Fields>
PALPATE D3 contact_force(const Fields& f, int slot) { return load(f.own.force.data + 3 * slot); }

// Candidates of the last search by their place in the outbox.
template <class Fields>
PALPATE const double* record(const Fields& f, int q) {
  return f.outbox.record.data + (size_t)RECORD_LENGTH * q;
}
template <class Fields>
PALPATE int candidate(const Fields& f, int q) { return (int)record(f, q)[RECORD_NODE]; }
template <class Fields>
PALPATE double far_at(const Fields& f, int q) { return record(f, q)[RECORD_DISTANCE]; }
// Number of candidates that there was room for.
template <class Fields>
PALPATE int found(const Fields& f) {
  const double all = f.outbox.found.data[0];
  return all < f.most ? (int)all : f.most;
}

// Node of a slot by the plugin state, -1 for none.
template <class Fields>
PALPATE int node_of(const Fields& f, int slot) {
  const double n = f.own.slot.data[slot];
  return n == 0.0 ? f.home.data[slot] : n >= 1.0 && n <= f.nvert ? (int)n - 1 : -1;
}

// Where the spare slot waits, in qpos.
template <class Fields>
PALPATE D3 parked(const Fields& f, int slot) {
  return load(f.qhome.data + 3 * slot) + AWAY * load(f.frame.data + 6);
}

// Puts a slot on node i, with its motion and effective inertia.
template <class Fields>
PALPATE void stand(const Fields& f, int slot, int i, D3 disp, D3 vel) {
  const auto& mj = f.mj;
  const int adr = f.dofadr.data[slot], body = f.bodyid.data[slot];
  const double own = mj.body_mass.data[body];
  const double total = f.inertia.data[i] > own ? f.inertia.data[i] : own;
  const D3 home = load(f.qhome.data + 3 * slot) + load(f.rest.data + 3 * i);
  store(mj.qpos.data + f.qposadr.data[slot], home + disp);
  store(mj.qvel.data + adr, vel);
  for (int c = 0; c < 3; ++c) {
    mj.dof_armature.data[adr + c] = total - own;
    mj.dof_M0.data[adr + c] = total;
    mj.dof_invweight0.data[adr + c] = 1.0 / f.node_mass.data[i];
  }
  mj.body_invweight0.data[2 * body] = 1.0 / f.node_mass.data[i];
}

// Lists the window's triangles: those of the organ whose corners have slots.
template <class Fields>
PALPATE void list_triangles(const Fields& f) {
  f.flags.data[FLAG_MISSED_ELEMENTS] = 0;
  int* list = f.mj.flex_elem.data + f.elem_adr;
  int count = 0;
  for (int k = 0; k < f.nslot; ++k) {
    const int i = f.placed.data[k];
    if (i < 0) continue;
    for (int t = f.begin.data[i]; t >= 0; t = f.following.data[t]) {
      const int* e = f.elem.data + 3 * t;
      const int b = f.taken.data[e[1]], c = f.taken.data[e[2]];
      if (b < 0 || c < 0) continue;
      if (count == f.elem_num) {
        f.flags.data[FLAG_MISSED_ELEMENTS] += 1;
        continue;
      }
      list[3 * count] = k;
      list[3 * count + 1] = b;
      list[3 * count + 2] = c;
      ++count;
    }
  }
  // Triangles to spare are points of the last slot, out of everybody's way: repeating one of the
  // others would multiply its contacts.
  const int spare = f.nslot - 1;
  store(f.mj.qpos.data + f.qposadr.data[spare], parked(f, spare));
  for (int q = 3 * count; q < 3 * f.elem_num; ++q) list[q] = spare;
}

// Puts the window's bodies on the nodes of their slots and rewrites their triangles.
template <class Fields>
PALPATE void place(const Fields& f, Thread, int) {
  for (int i = 0; i < f.nvert; ++i) f.taken.data[i] = -1;
  for (int k = 0; k < f.nslot; ++k) {
    const int i = f.placed.data[k] = node_of(f, k);
    if (i < 0) {
      store(f.mj.qvel.data + f.dofadr.data[k], {0.0, 0.0, 0.0});
      continue;
    }
    f.taken.data[i] = k;
    stand(f, k, i, load(f.own.motion.disp.data + 3 * i), load(f.own.motion.vel.data + 3 * i));
  }
  list_triangles(f);
}

}  // namespace palpate
