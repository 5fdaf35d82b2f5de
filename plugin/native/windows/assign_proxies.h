// Windows: which nodes the slots stand on in the next step.
#pragma once
#include "windows/proxy.h"

namespace palpate {

// Where a slot's node is after the step that ends: displacement, then velocity.
template <class Fields>
PALPATE const double* moved_to(const Fields& f, int k) {
  return f.flags.data[FLAG_ANSWERED] ? f.outbox.answer.data + ANSWER_LENGTH * k + ANSWER_DISP
                                     : moved(f, k) + MOVED_DISP;
}

// Follows the organ's answer with the contact forces, and with the inertia that tools meet.
template <class Fields>
PALPATE void follow_answer(const Fields& f) {
  const double ratio = f.outbox.summary.data[SUMMARY_RATIO], per_h = 1.0 / head(f)[HEAD_STEP];
  Secant secant;
  for (int k = 0; k < f.nslot; ++k) {
    if (f.placed.data[k] < 0) continue;
    const D3 change = per_h * load(pushed(f, k) + PUSHED_FORCE), now = contact_force(f, k);
    secant.add(change, norm(now));
    store(f.own.force.data + 3 * k, relaxed(now - change, now, ratio));
  }
  double* heavier = tail(f) + TAIL_HEAVIER;
  *heavier = secant.heavier(*heavier > 1.0 ? *heavier : 1.0, f.heaviest.data[0], ratio);
}

// Puts the slots where their nodes went.
template <class Fields>
PALPATE void follow_nodes(const Fields& f) {
  for (int k = 0; k < f.nslot; ++k) {
    const double* to = moved_to(f, k);
    if (f.placed.data[k] >= 0)
      stand(f, k, f.placed.data[k], load(to), load(to + 3));
    else
      store(f.mj.qvel.data + f.dofadr.data[k], {0.0, 0.0, 0.0});
  }
}

// Takes a slot from its node.
template <class Fields>
PALPATE void give_up(const Fields& f, int k) {
  f.taken.data[f.placed.data[k]] = -1;
  f.own.slot.data[k] = -1.0;
  f.placed.data[k] = -1;
  store(f.own.force.data + 3 * k, {0.0, 0.0, 0.0});
  store(f.mj.qvel.data + f.dofadr.data[k], {0.0, 0.0, 0.0});
}

// Moves the `many` nearest of `count` candidates to the front (quickselect, Hoare 1961); vertex
// numbers decide between equals.
template <class Fields>
PALPATE void select_nearest(const Fields& f, int count, int many) {
  double* far = f.distance.data;
  int* which = f.candidate.data;
  auto before = [&](double d, int p, double e, int q) {
    return d < e || (d == e && candidate(f, p) < candidate(f, q));
  };
  int a = 0, b = count - 1;
  while (a < b) {
    const double pivot = far[(a + b) / 2];
    const int middle = which[(a + b) / 2];
    int i = a, j = b;
    while (i <= j) {
      while (before(far[i], which[i], pivot, middle)) ++i;
      while (before(pivot, middle, far[j], which[j])) --j;
      if (i > j) break;
      const double d = far[i];
      const int n = which[i];
      far[i] = far[j];
      which[i++] = which[j];
      far[j] = d;
      which[j--] = n;
    }
    if (many - 1 <= j) b = j;
    else if (many - 1 >= i) a = i;
    else break;
  }
}

// Keeps the slots of the nodes that stay; returns how many others there are, those first in
// `candidate` and in the order of the mesh.
template <class Fields>
PALPATE int keep_slots(const Fields& f, int many, int count, bool* renewed) {
  int* which = f.candidate.data;
  for (int q = 0; q < count; ++q) f.chosen.data[candidate(f, which[q])] = 1;
  for (int k = 0; k < many; ++k) {
    const int i = f.placed.data[k];
    if (i >= 0 && !f.chosen.data[i]) {
      give_up(f, k);
      *renewed = true;
    } else if (i >= 0) {
      f.chosen.data[i] = 0;
      f.own.slot.data[k] = i + 1.0;
    } else {
      f.own.slot.data[k] = -1.0;
    }
  }
  int fresh = 0;
  for (int q = 0; q < count; ++q) {
    const int r = which[q], i = candidate(f, r);
    if (!f.chosen.data[i]) continue;
    f.chosen.data[i] = 0;
    int p = fresh++;
    for (; p > 0 && candidate(f, which[p - 1]) > i; --p) which[p] = which[p - 1];
    which[p] = r;
  }
  return fresh;
}

// Gives the free slots to the nodes that have none.
template <class Fields>
PALPATE void fill_slots(const Fields& f, int fresh) {
  int k = 0;
  for (int q = 0; q < fresh; ++q) {
    const double* r = record(f, f.candidate.data[q]);
    while (f.own.slot.data[k] >= 0.0) ++k;
    const int i = (int)r[RECORD_NODE];
    const double* disp = f.resident ? r + RECORD_DISP : f.own.motion.disp.data + 3 * i;
    const double* vel = f.resident ? r + RECORD_VEL : f.own.motion.vel.data + 3 * i;
    f.own.slot.data[k] = i + 1.0;
    f.placed.data[k] = i;
    f.taken.data[i] = k;
    stand(f, k, i, load(disp), load(vel));
  }
}

// Gives the window the nodes nearest to the tools' geoms. Nodes that stay keep their slot; the
// others fill the free ones in the order of the mesh.
template <class Fields>
PALPATE void choose(const Fields& f, Thread, int) {
  if (f.flags.data[FLAG_ASLEEP]) return;
  f.flags.data[FLAG_MISSED_NODES] = 0;
  if (f.flags.data[FLAG_ANSWERED]) follow_answer(f);
  follow_nodes(f);
  // The last slot stays free, see `list_triangles`. A patch of n nodes has up to 2 n - 4 triangles.
  const int room = f.elem_num / 2 + 2, many = room < f.nslot - 1 ? room : f.nslot - 1;
  int count = found(f);
  if (count < 3) return;
  for (int q = 0; q < count; ++q) {
    f.candidate.data[q] = q;
    f.distance.data[q] = far_at(f, q);
  }
  if (count > many) {
    select_nearest(f, count, many);
    for (int q = many; q < count; ++q)
      f.flags.data[FLAG_MISSED_NODES] +=
        f.distance.data[q] < f.touch.data[candidate(f, f.candidate.data[q])];
    count = many;
  }
  bool renewed = false;
  const int fresh = keep_slots(f, many, count, &renewed);
  fill_slots(f, fresh);
  if (renewed || fresh > 0) list_triangles(f);
}

}  // namespace palpate
