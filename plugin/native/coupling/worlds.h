// Batches: one organ in many worlds beside mujoco_warp, whose dofs of it are its slots: bodies that
// stand on the nodes nearest to the tools, chosen anew in each step. A thread has a node or a slot.
//
// The coupling is that of `node.h`. Slots move along the world's axes and their bodies have no
// place of their own, so qpos is where they are; vectors of nodes are in the organ's frame. Kernels get
// what their world has of its own.
//
// An organ that has been at rest for QUIET, with no tool so near that a node may get a slot, sleeps:
// its step has no length until one comes, or something of the world changes.
#pragma once
#include "coupling/node.h"
#include "core/geom.h"

namespace palpate {

// The distance of nodes that a tool touches and that it had a slot for: they keep it, since slots that
// take turns under a tool over more nodes than there are slots shake it.
constexpr float HELD = -1e3f;

// Where a slot waits that no node has [m], and its inertia then [kg].
constexpr float WAITING = 1e3f, IDLE = 1.0f;

// R^T x.
PALPATE D3 turned_back(const double* R, D3 x) { return add_turned({0.0, 0.0, 0.0}, R, x); }

template <class Fields>
PALPATE double mass_of(const Fields& f, int i) {
  return f.share.data[i] * f.mass.data[f.source.data[i]];
}
template <class Fields>
PALPATE D3 gravity(const Fields& f) {
  return load((const float*)f.gravity.data);
}
template <class Fields>
PALPATE bool succeeded(const Fields& f) {
  return f.solve.status.data[3] == 0.0f;
}

// Whether a world's organ would sleep if no tool were near, and whether it does, known once `rank` has
// run.
template <class Fields>
PALPATE bool is_calm(const Fields& f) {
  return f.sleeps && f.calm.data[0] >= QUIET;
}
template <class Fields>
PALPATE bool sleeps(const Fields& f) {
  return f.solve.step.data[0] == 0.0f;
}

// The inertia that a tool meets at a node, which follows the scales of Young's modulus and of mass.
template <class Fields>
PALPATE double inertia_of(const Fields& f, int i) {
  float grade = f.grade.data[0];
  const int source = f.source.data[i];
  if (f.lump.shape[0]) grade += log2f(f.lump.data[source]);
  const float last = (float)(f.ngrade - 1);
  grade = grade < 0.0f ? 0.0f : grade > last ? last : grade;
  const int k = (int)grade < f.ngrade - 1 ? (int)grade : f.ngrade - 2;
  const double t = grade - k, low = f.inertia.data[k * f.nnode + source];
  const double more = t * (f.inertia.data[(k + 1) * f.nnode + source] - low);
  const double total = f.mass_scale.data[0] * f.share.data[i] * (low + more);
  const D3 force = load(f.force.data + 3 * i);
  return touched(force) && f.heavier.data[0] > 1.0 ? f.heavier.data[0] * total : total;
}

// Writes where the tools are, in the organ's frame, and how long the organ has been at rest.
template <class Fields>
PALPATE void tell_tools(const Fields& f, Thread t, int) {
  if (t.tid == 0) {
    f.count.data[0] = f.missed.data[0] = 0;
    f.calm.data[0] = f.stirred.data[0] ? 0.0 : f.calm.data[0] + f.h;
    f.stirred.data[0] = 0;
  }
  each_item(t, f.ntool, [&](int q) {
    const int g = f.tool_geom.data[q];
    if (g < 0) return;  // an edge of a thread
    const float* R = (const float*)f.geom_xmat.data + 9 * g;
    const D3 from = load((const float*)f.geom_xpos.data + 3 * g) - load(f.origin.data);
    double* tool = f.tool.data + GEOM_LENGTH * q;
    store(tool + GEOM_POS, turned_back(f.frame.data, from));
    for (int a = 0; a < 3; ++a)
      store(tool + GEOM_AXIS + 3 * a, turned_back(f.frame.data, {R[a], R[3 + a], R[6 + a]}));
  });
}

// Fills the solver's input, and lists the nodes that a tool may touch.
template <class Fields>
PALPATE void enter_worlds(const Fields& f, Thread t, int) {
  const double h = f.h, masses = f.mass_scale.data[0];
  if (t.tid == 0) {
    float* step = f.solve.step.data;
    const double still = f.rest_share * 9.81 * h;
    step[0] = (float)h;
    step[1] = (float)weight_of_stiffness(h, numbers(f, 0)[DAMPING], numbers(f, 0)[EASED]);
    step[2] = (float)(masses * f.weight * still * still);
  }
  const D3 g = turned_back(f.frame.data, gravity(f));
  each_item(t, f.nnode, [&](int i) {
    const size_t at = offset_of(i);
    const D3 last = load_lane(f.last.data + at), before = load_lane(f.before.data + at);
    const D3 contact = load(f.force.data + 3 * i);
    store_lane(f.solve.dvel_warm.data + at, forecast(last, before));
    store_lane(f.solve.force_ext.data + at, (masses * mass_of(f, i)) * g + contact);
    f.node_slot.data[i] = -1;
    const D3 x = load(f.rest.data + 3 * i) + load_lane(f.solve.disp.data + at);
    const double far = nearest(f.tool.data, f.ntool, x);
    if (far > f.touch.data[i]) return;
    const int q = append(f.count.data);
    f.candidate.data[q] = i;
    f.distance.data[q] = touched(contact) && far < f.skin ? HELD : (float)far;
  });
}

// Chooses the candidates nearest to the tools; the order of nodes decides between equals. Those that
// touch and get no slot are counted. An organ without candidates may sleep.
template <class Fields>
PALPATE void rank(const Fields& f, Thread t, int) {
  const int n = f.count.data[0], *node = f.candidate.data;
  if (t.tid == 0 && n > 0) f.calm.data[0] = 0.0;
  if (t.tid == 0 && is_calm(f)) f.solve.step.data[0] = 0.0f;
  const float* far = f.distance.data;
  each_item(t, n, [&](int q) {
    int nearer = 0;
    for (int p = 0; p < n; ++p)
      nearer += far[p] < far[q] || (far[p] == far[q] && node[p] < node[q]);
    f.chosen.data[q] = nearer < f.nslot;
    if (nearer >= f.nslot && far[q] < f.skin) append(f.missed.data);
  });
}

// Lets a slot wait where no tool is.
template <class Fields>
PALPATE void wait(const Fields& f, int slot) {
  const int adr = f.dofadr + 3 * slot;
  f.slot_node.data[slot] = -1;
  store(f.qpos.data + f.qposadr + 3 * slot, {0.0, 0.0, WAITING});
  store(f.qvel.data + adr, {0.0, 0.0, 0.0});
  store(f.dof_armature.data + adr, {IDLE, IDLE, IDLE});
}

// Puts a slot on a node, with its motion and effective inertia.
template <class Fields>
PALPATE void stand_on(const Fields& f, int slot, int i) {
  const int adr = f.dofadr + 3 * slot;
  const size_t at = offset_of(i);
  f.slot_node.data[slot] = i;
  f.node_slot.data[i] = slot;
  const D3 x = load(f.rest.data + 3 * i) + load_lane(f.solve.disp.data + at);
  const D3 v = load_lane(f.solve.vel.data + at);
  store(f.qpos.data + f.qposadr + 3 * slot,
               load(f.origin.data) + turned(f.frame.data, x));
  store(f.qvel.data + adr, turned(f.frame.data, v));
  const double more = inertia_of(f, i) - f.slot_mass;
  store(f.dof_armature.data + adr, {more, more, more});
  float* inverse = (float*)f.body_invweight0.data + 2 * (f.bodyid + slot);
  inverse[0] = (float)(1.0 / (f.mass_scale.data[0] * f.held.data[i]));
}

// Gives the slots to the chosen nodes, in their order.
template <class Fields>
PALPATE void stand(const Fields& f, Thread t, int) {
  const int n = f.count.data[0], used = n < f.nslot ? n : f.nslot;
  const int *node = f.candidate.data, *chosen = f.chosen.data;
  each_item(t, n, [&](int q) {
    if (!chosen[q]) return;
    int slot = 0;
    for (int p = 0; p < n; ++p) slot += chosen[p] && node[p] < node[q];
    stand_on(f, slot, node[q]);
  });
  each_item(t, f.nslot, [&](int k) {
    if (k >= used) wait(f, k);
  });
}

// Adds the passive force that carries v + dv to the slots' dofs.
template <class Fields>
PALPATE void push_worlds(const Fields& f, Thread t, int) {
  const D3 weight = f.slot_mass * gravity(f);
  each_item(t, f.nslot, [&](int k) {
    const int adr = f.dofadr + 3 * k, i = f.slot_node.data[k];
    D3 rate = {0.0, 0.0, 0.0}, contact = rate;
    if (i >= 0) {
      const double Mhat = f.slot_mass + f.dof_armature.data[adr];
      const D3 dv = load_lane(f.solve.dvel.data + offset_of(i));
      if (succeeded(f)) rate = (Mhat / f.h) * turned(f.frame.data, dv);
      contact = turned(f.frame.data, load(f.force.data + 3 * i));
    }
    store(f.qfrc_passive.data + adr, passive(rate, contact + weight));
  });
}

// The contact force on a slot's node that MuJoCo found.
template <class Fields>
PALPATE D3 contact_now(const Fields& f, int slot, int i) {
  const D3 found = load(f.qfrc_constraint.data + f.dofadr + 3 * slot);
  return f.free.data[i] ? turned_back(f.frame.data, found) : D3{0.0, 0.0, 0.0};
}

// Takes the contact forces that MuJoCo found; where the organ answers, the impulses by which they
// changed go to the solver's right-hand side, which is zero.
template <class Fields>
PALPATE void take(const Fields& f, Thread t, int) {
  each_item(t, f.nslot, [&](int k) {
    const int i = f.slot_node.data[k];
    if (i < 0) return;
    const D3 now = contact_now(f, k, i);
    store(f.found.data + 3 * k, now);
    if (!f.stiff) return;
    const D3 change = now - load(f.force.data + 3 * i);
    store_lane(f.solve.rhs.data + offset_of(i), (double)f.h * change);
  });
  if (t.tid > 0 || !f.stiff) return;
  Expected expected;
  for (int k = 0; k < f.nslot; ++k) {
    const int i = f.slot_node.data[k];
    if (i < 0) continue;
    const D3 now = contact_now(f, k, i);
    const D3 was = load(f.force.data + 3 * i);
    const double Mhat = f.slot_mass + f.dof_armature.data[f.dofadr + 3 * k];
    expected.add((double)f.h * (now - was), Mhat, was, now);
  }
  f.solve.expected.data[0] = expected.value();
}

// Follows the organ's answer with the contact forces, and with the inertia that tools meet.
template <class Fields>
PALPATE void follow(const Fields& f, Thread t, int) {
  if (t.tid > 0) return;
  Secant secant;
  const double ratio = f.solve.ratio.data[0];
  for (int k = 0; k < f.nslot; ++k) {
    const int i = f.slot_node.data[k];
    if (i < 0) continue;
    float* found = f.found.data + 3 * k;
    const D3 now = load(found), was = load(f.force.data + 3 * i);
    secant.add(now - was, norm(now));
    store(found, relaxed(was, now, ratio));
  }
  double& heavier = f.heavier.data[0];
  heavier = secant.heavier(heavier > 1.0 ? heavier : 1.0, f.heaviest, ratio);
}

// Ends the step.
template <class Fields>
PALPATE void commit_worlds(const Fields& f, Thread t, int) {
  const double ok = succeeded(f) ? 1.0 : 0.0, h = f.h;
  if (t.tid == 0 && f.missed.data[0] > f.overflow.data[0]) f.overflow.data[0] = f.missed.data[0];
  const bool asleep = sleeps(f);
  if (asleep && f.calm.data[0] > QUIET + h) return;  // it stands still already
  each_item(t, f.nnode, [&](int i) {
    if (!f.free.data[i]) return;
    const size_t at = offset_of(i);
    const int slot = f.node_slot.data[i];
    D3 dv = load_lane(f.solve.dvel.data + at), now = {0.0, 0.0, 0.0};
    if (f.stiff) dv += load_lane(f.solve.sol.data + at);
    dv = ok * dv;
    D3 v = load_lane(f.solve.vel.data + at) + dv;
    if (asleep) v = dv = now;
    if (slot >= 0) {
      now = load(f.found.data + 3 * slot);
      if (!f.stiff)
        v = turned_back(f.frame.data, load(f.qvel.data + f.dofadr + 3 * slot));
    }
    store_lane(f.solve.disp.data + at, load_lane(f.solve.disp.data + at) + h * v);
    store_lane(f.solve.vel.data + at, v);
    store_lane(f.before.data + at, asleep ? now : load_lane(f.last.data + at));
    store_lane(f.last.data + at, dv);
    store(f.force.data + 3 * i, now);
    if (touched(now) || dot(v, v) > f.slow * f.slow) f.stirred.data[0] = 1;
  });
}

// Flags the worlds with numbers that are not finite, or huge.
template <class Fields>
PALPATE void find_bad(const Fields& f, Thread t, int) {
  const float most = 1e6f;
  bool bad = false;
  each_item(t, f.nnode, [&](int i) {
    const size_t at = offset_of(i);
    const D3 u = vabs(load_lane(f.solve.disp.data + at));
    const D3 v = vabs(load_lane(f.solve.vel.data + at));
    bad = bad || !(u.x < most && u.y < most && u.z < most && v.x < most && v.y < most && v.z < most);
  });
  each_item(t, f.nq, [&](int k) { bad = bad || !(fabs(f.qpos.data[k]) < 1e10f); });
  each_item(t, f.nv, [&](int k) { bad = bad || !(fabs(f.qvel.data[k]) < 1e10f); });
  if (bad) f.bad.data[0] = 1;
}

// The mass that the solve has of a node: nodes that wait for a cut have none.
PALPATE float solved(double mass) { return mass > 0.0 ? (float)mass : 1.0f; }

// Gives the organ of the worlds of a mask the masses of the mesh that it starts with, which it has
// again, and lets its slots wait.
template <class Fields>
PALPATE void rest_organ(const Fields& f, Thread t, int) {
  if (!f.mask.data[0]) return;
  const bool heals = f.mesh.data[0] != 0;
  each_item(t, f.nnode, [&](int i) {
    if (heals) f.solve.mass.data[i] = solved(f.mass_scale.data[0] * f.mass.data[i]);
  });
  each_item(t, f.nslot, [&](int k) { wait(f, k); });
}

}  // namespace palpate
