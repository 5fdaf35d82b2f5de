// Windows: which nodes the slots stand on in the next step.
#pragma once
#include "coupling/proxy.h"

namespace palpate {

// Candidates of all windows by their place in the outbox: the q-th of window w is w most + q.
template <class Fields>
PALPATE const double* record(const Fields& f, int q) {
  return f.outbox.record.data + (size_t)RECORD_LENGTH * q;
}
template <class Fields>
PALPATE int candidate(const Fields& f, int q) { return (int)record(f, q)[RECORD_NODE]; }
template <class Fields>
PALPATE double far_at(const Fields& f, int q) { return record(f, q)[RECORD_DISTANCE]; }
// Number of a window's candidates that there was room for.
template <class Fields>
PALPATE int found(const Fields& f, int w) {
  const double all = f.outbox.found.data[w];
  return all < f.most ? (int)all : f.most;
}

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

// Puts the slots where their nodes went, and keeps their contact forces for those that get them.
template <class Fields>
PALPATE void follow_nodes(const Fields& f) {
  for (int k = 0; k < f.nslot; ++k) {
    f.left.data[k] = -1;
    store(f.kept.data + 3 * k, contact_force(f, k));
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
  f.left.data[k] = f.placed.data[k];
  f.own.slot.data[k] = -1.0;
  f.placed.data[k] = -1;
  store(f.own.force.data + 3 * k, {0.0, 0.0, 0.0});
  store(f.mj.qvel.data + f.dofadr.data[k], {0.0, 0.0, 0.0});
}

// Gives each node to the window whose tool is nearest. Windows whose tools touch the same nodes
// pick as one, the first of them first: a triangle between two windows would touch nothing.
template <class Fields>
PALPATE void claim_nodes(const Fields& f, int* group) {
  for (int w = 0; w < f.nwindow; ++w) {
    group[w] = w;
    for (int q = w * f.most; q < w * f.most + found(f, w); ++q) {
      const int i = candidate(f, q), other = f.claim.data[i];
      if (other < 0 || far_at(f, q) < far_at(f, other)) f.claim.data[i] = q;
      const double touch = f.touch.data[i];
      if (other < 0 || far_at(f, q) >= touch || far_at(f, other) >= touch) continue;
      const int a = group[other / f.most], b = group[w], joint = a < b ? a : b;
      for (int v = 0; v <= w; ++v)
        if (group[v] == a || group[v] == b) group[v] = joint;
    }
  }
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

// Lists what the group of a window has claimed, into `candidate` and `distance`; returns how many.
template <class Fields>
PALPATE int list_claims(const Fields& f, int w, const int* group) {
  int count = 0;
  for (int v = 0; v < f.nwindow; ++v) {
    if (group[v] != group[w]) continue;
    for (int q = v * f.most; q < v * f.most + found(f, v); ++q) {
      if (f.claim.data[candidate(f, q)] != q) continue;
      f.candidate.data[count] = q;
      f.distance.data[count++] = far_at(f, q);
    }
  }
  return count;
}

// Keeps the slots of the nodes that stay; returns how many others there are, those first in
// `candidate` and in the order of the mesh.
template <class Fields>
PALPATE int keep_slots(const Fields& f, int first, int many, int count, bool* renewed) {
  int* which = f.candidate.data;
  for (int q = 0; q < count; ++q) {
    f.chosen.data[candidate(f, which[q])] = 1;
    f.claim.data[candidate(f, which[q])] = -1;
  }
  for (int k = first; k < first + many; ++k) {
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

// Gives the free slots of a window to the nodes that have none.
template <class Fields>
PALPATE void fill_slots(const Fields& f, int first, int fresh) {
  int k = first;
  for (int q = 0; q < fresh; ++q) {
    const double* r = record(f, f.candidate.data[q]);
    while (f.own.slot.data[k] >= 0.0) ++k;
    const int i = (int)r[RECORD_NODE], other = f.taken.data[i];
    const double* disp = f.resident ? r + RECORD_DISP : f.own.motion.disp.data + 3 * i;
    const double* vel = f.resident ? r + RECORD_VEL : f.own.motion.vel.data + 3 * i;
    if (other >= 0) {
      // Another window had it: its motion and contact force come along.
      if (f.placed.data[other] == i) give_up(f, other);
      disp = moved_to(f, other);
      vel = disp + 3;
      store(f.own.force.data + 3 * k, load(f.kept.data + 3 * other));
    }
    f.own.slot.data[k] = i + 1.0;
    f.placed.data[k] = i;
    f.taken.data[i] = k;
    stand(f, k, i, load(disp), load(vel));
  }
}

// Gives each window the nodes nearest to its geoms. Nodes that stay keep their slot; the others
// fill the free ones in the order of the mesh.
template <class Fields>
PALPATE void choose(const Fields& f, Thread, int) {
  if (f.flags.data[FLAG_ASLEEP]) return;
  f.flags.data[FLAG_MISSED_NODES] = 0;
  if (f.flags.data[FLAG_ANSWERED]) follow_answer(f);
  follow_nodes(f);
  int group[MAX_WINDOWS];
  claim_nodes(f, group);
  bool renewed = false;
  for (int w = 0; w < f.nwindow; ++w) {
    // The last slot stays free, see `list_triangles`. A patch of n nodes has up to 2 n - 4
    // triangles.
    const int first = f.window_adr.data[w], room = f.elem_num.data[w] / 2 + 2;
    int many = f.window_adr.data[w + 1] - first - 1;
    if (many > room) many = room;
    int count = list_claims(f, w, group);
    if (count < 3) continue;
    if (count > many) {
      select_nearest(f, count, many);
      for (int q = many; q < count; ++q)
        f.flags.data[FLAG_MISSED_NODES] +=
          f.distance.data[q] < f.touch.data[candidate(f, f.candidate.data[q])];
      count = many;
    }
    const int fresh = keep_slots(f, first, many, count, &renewed);
    fill_slots(f, first, fresh);
    renewed = renewed || fresh > 0;
  }
  for (int w = 0; w < f.nwindow; ++w)
    for (int q = w * f.most; q < w * f.most + found(f, w); ++q) f.claim.data[candidate(f, q)] = -1;
  for (int k = 0; k < f.nslot; ++k) {
    const int i = f.left.data[k];
    if (i >= 0 && f.taken.data[i] == k && f.placed.data[k] != i) f.taken.data[i] = -1;
  }
  if (renewed) list_triangles(f);
}

}  // namespace palpate
