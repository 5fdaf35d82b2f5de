// Windows: the slots' side, on the CPU beside MuJoCo: what it tells the nodes, and what of their
// answer it gives to MuJoCo.
#pragma once
#include "windows/assign_proxies.h"
#include "windows/window_mesh.h"
#include "windows/sleep.h"
#include "core/triangle.h"

namespace palpate {

// Square of a distance beyond all others [m^2].
constexpr double ENDLESS = 1e300;

// Writes the numbers of the step to the inbox and says whether gravity is not that of the organ's
// last step.
template <class Fields>
PALPATE bool tell_step(const Fields& f) {
  const double h = f.mj.timestep.data[0], still = f.rest_share * 9.81 * h;
  const D3 zero = {0.0, 0.0, 0.0};
  const bool falls = !(f.mj.disableflags.data[0] & DISABLE_GRAVITY);
  const D3 g = falls ? add_turned(zero, f.frame.data, load(f.mj.gravity.data)) : zero;
  double* in = head(f);
  in[HEAD_STEP] = h;
  in[HEAD_GAIN] = weight_of_stiffness(h, f.number.data[DAMPING], f.number.data[EASED]);
  in[HEAD_FLOOR] = f.weight * still * still;
  in[HEAD_MODE] = f.flags.data[FLAG_PENDING];
  store(in + HEAD_GRAVITY, g);
  in[HEAD_REACH] = f.reach;
  in[HEAD_ANSWERED] = 0.0;
  return g != load(tail(f) + TAIL_GRAVITY);
}

// Writes what acts on the slots to the inbox, and says whether anything does.
template <class Fields>
PALPATE bool tell_forces(const Fields& f) {
  const auto& mj = f.mj;
  const D3 g = load(head(f) + HEAD_GRAVITY), zero = {0.0, 0.0, 0.0};
  bool pushes = false;
  for (int k = 0; k < f.nslot; ++k) {
    const int i = node_of(f, k), adr = f.dofadr.data[k], body = f.bodyid.data[k];
    const bool skipped = mj.body_awake.data[body] == 0;  // by MuJoCo: its forces are old
    // What acts on the slot besides its own weight acts on the node.
    const D3 along = load(mj.qfrc_applied.data + adr) +
                     (skipped ? zero : load(mj.qfrc_passive.data + adr));
    const D3 other = external(along, f.frame.data, mj.xfrc_applied.data + 6 * body);
    const D3 push = i < 0 ? other : other + contact_force(f, k);
    pushed(f, k)[PUSHED_NODE] = i;
    store(pushed(f, k) + PUSHED_FORCE, push);
    store(f.other.data + 3 * k, other);
    store(f.lagged.data + 3 * k, push + mj.body_mass.data[body] * g);
    pushes = pushes || push != zero;
  }
  return pushes;
}

// Whether the model's window is not that of the plugin state.
template <class Fields>
PALPATE bool is_stale(const Fields& f) {
  for (int k = 0; k < f.nslot; ++k)
    if (node_of(f, k) != f.placed.data[k]) return true;
  const int spare = f.nslot - 1;
  const D3 gone = vabs(load(f.mj.qpos.data + f.qposadr.data[spare]) - parked(f, spare));
  return gone.x > 1.0 || gone.y > 1.0 || gone.z > 1.0;
}

// Whether the inbox is what `foresee` wrote.
template <class Fields>
PALPATE bool is_foreseen(const Fields& f) {
  const double* then = f.foreseen.head.data;
  for (int c = 0; c < HEAD_REACH; ++c)
    if (c != HEAD_MODE && head(f)[c] != then[c]) return false;
  for (int k = 0; k < PUSHED_LENGTH * f.nslot; ++k)
    if (f.inbox.pushed.data[k] != f.foreseen.pushed.data[k]) return false;
  return true;
}

// Writes a geom of mjData to the inbox, in the organ's frame.
template <class Fields>
PALPATE void tell_geom(const Fields& f, int g, double* geom) {
  const auto& mj = f.mj;
  const D3 zero = {0.0, 0.0, 0.0};
  const double* R = mj.geom_xmat.data + 9 * g;
  const D3 from_origin = load(mj.geom_xpos.data + 3 * g) - load(f.origin.data);
  store(geom + GEOM_POS, add_turned(zero, f.frame.data, from_origin));
  for (int a = 0; a < 3; ++a)
    store(geom + GEOM_AXIS + 3 * a, add_turned(zero, f.frame.data, {R[a], R[3 + a], R[6 + a]}));
  geom[GEOM_TYPE] = mj.geom_type.data[g];
  store(geom + GEOM_SIZE, load(mj.geom_size.data + 3 * g));
  store(geom + GEOM_BOX, load(mj.geom_aabb.data + 6 * g));
  store(geom + GEOM_HALF, load(mj.geom_aabb.data + 6 * g + 3));
  const double r = mj.geom_rbound.data[g];  // 0 for planes, which have no end
  geom[GEOM_BOUND2] = r > 0.0 ? (r + f.reach) * (r + f.reach) : ENDLESS;
}

// Writes the edge of a thread from vertex `v` on to the inbox, as a capsule.
template <class Fields>
PALPATE void tell_line(const Fields& f, int v, double radius, double* geom) {
  const D3 a = load(f.flexvert_xpos.data + 3 * v), b = load(f.flexvert_xpos.data + 3 * v + 3), none = {0.0, 0.0, 0.0};
  const D3 axis = unit(b - a), side = fabs(axis.x) < 0.6 ? D3{1.0, 0.0, 0.0} : D3{0.0, 1.0, 0.0};
  const D3 x = unit(cross(side, axis)), axes[3] = {x, cross(axis, x), axis};
  const double half = 0.5 * norm(b - a);
  store(geom + GEOM_POS, add_turned(none, f.frame.data, 0.5 * (a + b) - load(f.origin.data)));
  for (int k = 0; k < 3; ++k) store(geom + GEOM_AXIS + 3 * k, add_turned(none, f.frame.data, axes[k]));
  geom[GEOM_TYPE] = GEOM_IS_CAPSULE;
  store(geom + GEOM_SIZE, {radius, half, 0.0});
  store(geom + GEOM_BOX, none);
  store(geom + GEOM_HALF, {radius, radius, radius + half});
  geom[GEOM_BOUND2] = (radius + half + f.reach) * (radius + half + f.reach);
}

// Whether a geom's box and the organ's bounds are apart: boxes apart along an axis of one are.
template <class Fields>
PALPATE bool is_apart(const Fields& f, const double* geom) {
  const double* axes = geom + GEOM_AXIS;
  const D3 axis[3] = {load(axes), load(axes + 3), load(axes + 6)};
  const D3 low = load(tail(f) + TAIL_LOW), high = load(tail(f) + TAIL_HIGH);
  const D3 centre = 0.5 * (low + high), length = 0.5 * (high - low);
  const double* half = geom + GEOM_HALF;
  const double margin = 0.5 * f.reach;
  D3 middle = load(geom + GEOM_POS), extent = {margin, margin, margin};
  for (int a = 0; a < 3; ++a) {
    middle += geom[GEOM_BOX + a] * axis[a];
    extent += half[a] * vabs(axis[a]);
  }
  const D3 top = middle + extent, bottom = middle - extent;
  if (top.x < low.x || top.y < low.y || top.z < low.z) return true;
  if (bottom.x > high.x || bottom.y > high.y || bottom.z > high.z) return true;
  for (int a = 0; a < 3; ++a) {
    const D3 e = axis[a], off = middle - centre, shadow = vabs(e);
    if (fabs(dot(e, off)) > margin + half[a] + dot(length, shadow)) return true;
  }
  return false;
}

// How far a point of a geom's box is from where it was when the organ fell asleep, at most.
template <class Fields>
PALPATE double gone(const Fields& f, const double* geom, int q) {
  const double* pose = f.own.pose.data + POSE_LENGTH * q;
  double turned2 = 0.0;
  for (int a = 0; a < 9; a += 3) {
    const D3 turned = load(geom + GEOM_AXIS + a) - load(pose + POSE_AXIS + a);
    turned2 += dot(turned, turned);
  }
  return norm(load(geom + GEOM_POS) - load(pose + POSE_POS)) +
         sqrt(turned2) * (norm(load(geom + GEOM_BOX)) + norm(load(geom + GEOM_HALF)));
}

// Writes the followed geoms to the inbox, flags whether one is near the organ's bounds, and says
// whether one that is has moved too far since the organ fell asleep.
template <class Fields>
PALPATE bool tell_geoms(const Fields& f) {
  const double* last = tail(f);
  bool near = last[TAIL_HIGH] <= last[TAIL_LOW], stirs = near;  // they are not known yet
  for (int q = 0; q < f.ngeom; ++q) {
    double* geom = geom_at(f, q);
    const int g = f.geom.data[q];
    if (g < 0)
      tell_line(f, -1 - g, f.line_radius.data[q], geom);
    else
      tell_geom(f, g, geom);
    if (is_apart(f, geom)) continue;
    near = true;
    stirs = stirs || !(gone(f, geom, q) < last[TAIL_LEEWAY]);
  }
  f.flags.data[FLAG_NEAR] = near;
  return stirs;
}

// Reads what acts on the slots and where the tools are, and flags slots that the model lacks.
// Asleep it does what `scatter_slots` does otherwise.
template <class Fields>
PALPATE void gather_slots(const Fields& f, Thread, int) {
  const bool changed = tell_step(f), pushes = tell_forces(f), stale = is_stale(f);
  f.flags.data[FLAG_STALE] = stale;
  f.flags.data[FLAG_FORESEEN] = is_foreseen(f);
  const bool stirs = tell_geoms(f);
  const bool asleep = tail(f)[TAIL_QUIET] >= QUIET && !stirs && !pushes && !changed;
  f.flags.data[FLAG_ASLEEP] = asleep;
  if (!asleep || stale) return;
  // The slots stay where they are; nothing else is done in such a step.
  f.status.data[0] = f.status.data[1] = 0.0f;
  for (int k = 0; k < f.nslot; ++k) {
    double* out = f.mj.qfrc_passive.data + f.dofadr.data[k];
    if (f.mj.body_awake.data[f.bodyid.data[k]])
      store(out, load(out) + passive({0.0, 0.0, 0.0}, load(f.lagged.data + 3 * k)));
  }
}

// Writes what the next `gather_slots` will if the step and what acts on the slots besides contacts
// stay.
template <class Fields>
PALPATE void foresee(const Fields& f, Thread, int) {
  double* then = f.foreseen.head.data;
  for (int c = 0; c < HEAD_LENGTH; ++c) then[c] = head(f)[c];
  for (int k = 0; k < MOVED_LENGTH * f.nslot; ++k)
    f.foreseen.moved.data[k] = f.inbox.moved.data[k];
  then[HEAD_MODE] = f.flags.data[FLAG_PENDING];
  then[HEAD_ANSWERED] = 0.0;
  for (int k = 0; k < f.nslot; ++k) {
    double* push = f.foreseen.pushed.data + PUSHED_LENGTH * k;
    const int i = node_of(f, k);
    const D3 other = load(f.other.data + 3 * k);
    push[PUSHED_NODE] = i;
    store(push + PUSHED_FORCE, i < 0 ? other : other + contact_force(f, k));
  }
}

// Adds the passive force that carries v + dv to the window's dofs.
template <class Fields>
PALPATE void scatter_slots(const Fields& f, Thread, int) {
  const bool ok = f.outbox.summary.data[SUMMARY_STATUS + 3] == 0.0;
  const double heavy = tail(f)[TAIL_HEAVIER], h = head(f)[HEAD_STEP];
  const D3 zero = {0.0, 0.0, 0.0};
  f.flags.data[FLAG_PENDING] = MODE_STILL;
  for (int k = 0; k < f.nslot; ++k) {
    const int adr = f.dofadr.data[k];
    const double gain = heavy > 1.0 && touched(contact_force(f, k)) ? heavy : 1.0;
    const double m = f.mj.body_mass.data[f.bodyid.data[k]];
    const double Mhat = gain * (m + f.mj.dof_armature.data[adr]);
    if (gain > 1.0) set_inertia(f.mj, f.massadr.data + 3 * k, adr, {Mhat, Mhat, Mhat});
    const D3 p = Mhat * (ok ? load(f.outbox.dvel.data + 3 * k) : zero);
    double* out = f.mj.qfrc_passive.data + adr;
    store(out, load(out) + passive({p.x / h, p.y / h, p.z / h}, load(f.lagged.data + 3 * k)));
  }
}

}  // namespace palpate
