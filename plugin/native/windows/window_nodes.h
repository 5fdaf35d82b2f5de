// Windows: the nodes' side, on the device that holds the organ's motion, a thread a node or a slot.
//
// What they are told is the inbox, what they answer the outbox; see `engine/layout.py`.
#pragma once
#include "coupling/node.h"
#include "core/geom.h"

namespace palpate {

template <class Fields>
PALPATE double head(const Fields& n, int number) { return n.inbox.head.data[number]; }

// Node of a slot now, -1 for none, and what acts on it.
template <class Fields>
PALPATE const double* pushed(const Fields& n, int slot) {
  return n.inbox.pushed.data + PUSHED_LENGTH * slot;
}

// A node's velocity at the end of the step that begins, without what contacts change.
template <class Fields>
PALPATE D3 next_velocity(const Fields& n, int i, double share) {
  const D3 dv = load_lane(n.solve.dvel.data + n.node.data[i]);
  return load(n.motion.vel.data + 3 * i) + share * dv;
}

// Ends the last step: disp, vel, last, before.
template <class Fields>
PALPATE void commit(const Fields& n, Thread t, int) {
  const int mode = (int)head(n, HEAD_MODE);
  if (mode == MODE_STILL) return;
  const double h = head(n, HEAD_STEP_ENDED), ok = n.solve.status.data[3] == 0.0f ? 1.0 : 0.0;
  const double keep = mode == MODE_COMMIT ? 1.0 : 0.0;
  const bool answered = head(n, HEAD_ANSWERED) != 0.0;
  each_item(t, n.nvert, [&](int i) {
    const int at = n.node.data[i];
    D3 whole = load_lane(n.solve.dvel.data + at);
    if (answered) whole += load_lane(n.solve.sol.data + at);
    double* disp = n.motion.disp.data + 3 * i;
    double* vel = n.motion.vel.data + 3 * i;
    double* last = n.motion.last.data + 3 * i;
    const D3 dv = ok * whole, v = load(vel) + dv;
    store(disp, load(disp) + h * v);
    store(vel, keep * v);
    store(n.motion.before.data + 3 * i, keep * load(last));
    store(last, keep * dv);
  });
}

// Gives the nodes of the slots what contacts made of them in the last step.
template <class Fields>
PALPATE void move_slots(const Fields& n, Thread t, int) {
  if ((int)head(n, HEAD_MODE) == MODE_STILL || head(n, HEAD_ANSWERED) != 0.0) return;
  each_item(t, n.nslot, [&](int k) {
    const double* moved = n.inbox.moved.data + MOVED_LENGTH * k;
    const int i = (int)moved[MOVED_NODE];
    if (i < 0) return;
    store(n.motion.disp.data + 3 * i, load(moved + MOVED_DISP));
    store(n.motion.vel.data + 3 * i, load(moved + MOVED_VEL));
  });
}

// Fills the solver's input from the motion, without forces on slots, and finds the organ's extent.
template <class Fields>
PALPATE void enter(const Fields& n, Thread t, int) {
  if (t.tid == 0) {
    n.solve.step.data[0] = (float)head(n, HEAD_STEP);
    n.solve.step.data[1] = (float)head(n, HEAD_GAIN);
    n.solve.step.data[2] = (float)head(n, HEAD_FLOOR);
  }
  const D3 g = load(n.inbox.head.data + HEAD_GRAVITY);
  float low[3] = {1e30f, 1e30f, 1e30f}, high[3] = {-1e30f, -1e30f, -1e30f}, fastest = 0.0f;
  each_item(t, n.nvert, [&](int i) {
    const int at = n.node.data[i];
    const D3 next = forecast(load(n.motion.last.data + 3 * i), load(n.motion.before.data + 3 * i));
    store_lane(n.solve.dvel_warm.data + at, next);
    store_lane(n.solve.force_ext.data + at, n.mass.data[i] * g);
    float speed = 0.0f;
    for (int c = 0; c < 3; ++c) {
      const float u = (float)n.motion.disp.data[3 * i + c], v = (float)n.motion.vel.data[3 * i + c];
      const float x = (float)n.rest.data[3 * i + c] + u;
      n.solve.disp.data[at + LANES * c] = u;
      n.solve.vel.data[at + LANES * c] = v;
      speed += v * v;
      low[c] = x < low[c] ? x : low[c];
      high[c] = x > high[c] ? x : high[c];
    }
    fastest = speed > fastest ? speed : fastest;
  });
  int* extent = n.extent.data;
  put_most(extent++, fastest);
  for (int c = 0; c < 3; ++c) put_most(extent++, -low[c]);
  for (int c = 0; c < 3; ++c) put_most(extent++, high[c]);
}

// Adds the forces on the slots to the solver's input, and tells the organ's extent.
template <class Fields>
PALPATE void push_slots(const Fields& n, Thread t, int) {
  each_item(t, n.nslot, [&](int k) {
    const int i = (int)pushed(n, k)[PUSHED_NODE];
    if (i < 0) return;
    float* f = n.solve.force_ext.data + n.node.data[i];
    for (int c = 0; c < 3; ++c) f[LANES * c] += (float)pushed(n, k)[PUSHED_FORCE + c];
  });
  if (t.tid != 0) return;
  double* out = n.outbox.summary.data;
  int* extent = n.extent.data;
  out[SUMMARY_SPEED2] = (double)most(extent[0]);
  for (int c = 0; c < 3; ++c) {
    out[SUMMARY_LOW + c] = -(double)most(extent[1 + c]);
    out[SUMMARY_HIGH + c] = (double)most(extent[4 + c]);
  }
  for (int k = 0; k < 7; ++k) extent[k] = NOTHING_PUT;
}

// Writes the impulses on the slots to the solver's right-hand side, which is zero.
template <class Fields>
PALPATE void push_impulses(const Fields& n, Thread t, int) {
  each_item(t, n.nslot, [&](int k) {
    const int i = (int)pushed(n, k)[PUSHED_NODE];
    if (i >= 0) store_lane(n.solve.rhs.data + n.node.data[i], load(pushed(n, k) + PUSHED_FORCE));
  });
  if (t.tid == 0) n.solve.expected.data[0] = (float)head(n, HEAD_EXPECTED);
}

// Whether a followed geom comes near the organ's bounds.
template <class Fields>
PALPATE bool any_near(const Fields& n) {
  const double* geom = n.inbox.geom.data;
  const D3 low = load(n.outbox.summary.data + SUMMARY_LOW);
  const D3 high = load(n.outbox.summary.data + SUMMARY_HIGH);
  for (int q = 0; q < n.ngeom; ++q, geom += GEOM_LENGTH)
    if (comes_near(geom, low, high, head(n, HEAD_REACH))) return true;
  return false;
}

// Lists the nodes that will be near the followed geoms, by their distance to the surface. Before
// the step has ended: where it will, without what contacts change.
template <class Fields>
PALPATE void search(const Fields& n, Thread t, int) {
  const bool answered = head(n, HEAD_ANSWERED) != 0.0;
  const double reach = head(n, HEAD_REACH), h = answered ? 0.0 : head(n, HEAD_STEP);
  const double ok = n.solve.status.data[3] == 0.0f && !answered ? 1.0 : 0.0;
  if (!any_near(n)) return;
  each_item(t, n.nouter, [&](int i) {
    if (n.mass.data[i] == 0.0) return;  // it waits for a cut
    const D3 v = next_velocity(n, i, ok), u = load(n.motion.disp.data + 3 * i) + h * v;
    const double far = nearest(n.inbox.geom.data, n.ngeom, load(n.rest.data + 3 * i) + u);
    if (far > reach) return;
    const int at = append(n.count.data);
    if (at >= n.most) return;
    double* r = n.outbox.record.data + (size_t)RECORD_LENGTH * at;
    r[RECORD_NODE] = i;
    r[RECORD_DISTANCE] = far;
    store(r + RECORD_DISP, u);
    store(r + RECORD_VEL, v);
  });
}

// Tells status, dv of the slots and the number of candidates.
template <class Fields>
PALPATE void report(const Fields& n, Thread t, int) {
  const bool answered = head(n, HEAD_ANSWERED) != 0.0;
  each_item(t, n.nslot, [&](int k) {
    const int i = (int)pushed(n, k)[PUSHED_NODE], at = i < 0 ? 0 : n.node.data[i];
    const D3 zero = {0.0, 0.0, 0.0};
    store(n.outbox.dvel.data + 3 * k, i < 0 ? zero : load_lane(n.solve.dvel.data + at));
    if (i < 0 || !answered) return;
    double* answer = n.outbox.answer.data + ANSWER_LENGTH * k;
    store(answer + ANSWER_DISP, load(n.motion.disp.data + 3 * i));
    store(answer + ANSWER_VEL, load(n.motion.vel.data + 3 * i));
  });
  if (t.tid > 0) return;
  for (int k = 0; k < 4; ++k) n.outbox.summary.data[SUMMARY_STATUS + k] = n.solve.status.data[k];
  n.outbox.summary.data[SUMMARY_RATIO] = n.solve.ratio.data[0];
  if (answered) n.inbox.head.data[HEAD_MODE] = MODE_STILL;  // the answer has ended the step
  n.outbox.found.data[0] = n.count.data[0];
  n.count.data[0] = 0;
}

}  // namespace palpate
