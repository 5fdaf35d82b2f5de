// Windows: what is taken from MuJoCo's step, and whether the organ falls asleep after it.
#pragma once
#include "windows/proxy.h"

namespace palpate {

// A triangle that may be the nearest to a tool is sampled at this many points along an edge. No
// point of a triangle is farther from a corner than its longest edge over the root of 3.
constexpr int FINE = 16;
constexpr double CORNER = 0.578;

// The distance of the followed geoms from a triangle of candidates of the last search, from below;
// `enough` where it is more.
template <class Fields>
PALPATE double clearance(const Fields& f, const double* const* corner, double enough) {
  D3 x[3];
  double lowest = 1e300, longest = 0.0;
  for (int k = 0; k < 3; ++k) {
    const int i = (int)corner[k][RECORD_NODE];
    x[k] = load(f.rest.data + 3 * i) + load(corner[k] + RECORD_DISP);
    const double far = corner[k][RECORD_DISTANCE];
    lowest = far < lowest ? far : lowest;
  }
  for (int k = 0; k < 3; ++k) {
    const double edge = norm(x[k] - x[(k + 1) % 3]);
    longest = edge > longest ? edge : longest;
  }
  if (lowest - CORNER * longest >= enough) return enough;
  const D3 s = x[1] - x[0], t = x[2] - x[0];
  for (int a = 0; a <= FINE; ++a) {
    for (int b = 0; a + b <= FINE; ++b) {
      const D3 p = {a * s.x + b * t.x, a * s.y + b * t.y, a * s.z + b * t.z};
      const D3 at = x[0] + D3{p.x / FINE, p.y / FINE, p.z / FINE};
      for (int q = 0; q < f.ngeom; ++q) {
        const double* geom = geom_at(f, q);
        const double far = distance(geom, at - load(geom + GEOM_POS));
        lowest = far < lowest ? far : lowest;
      }
    }
  }
  return lowest - CORNER * longest / FINE;
}

// How far the tools are from the surface at least, of what the last search found: triangles with a
// corner that it did not are beyond its reach. Distance to convex geoms has slope 1.
template <class Fields>
PALPATE double clearance(const Fields& f) {
  double least = head(f)[HEAD_REACH] - f.longest;
  const int count = found(f);
  for (int q = 0; q < count; ++q) f.at.data[candidate(f, q)] = q;
  for (int q = 0; q < count; ++q) {
    for (int t = f.begin.data[candidate(f, q)]; t >= 0; t = f.following.data[t]) {
      const int* e = f.elem.data + 3 * t;
      const int b = f.at.data[e[1]], c = f.at.data[e[2]];
      if (b < 0 || c < 0) continue;
      const double* corner[3] = {record(f, q), record(f, b), record(f, c)};
      const double far = clearance(f, corner, least);
      least = far < least ? far : least;
    }
  }
  for (int q = 0; q < count; ++q) f.at.data[candidate(f, q)] = -1;
  return least - f.skin;
}

// Takes the contact forces and the motion of the slots' nodes from MuJoCo's step, with the impulses
// by which the forces changed; says whether nothing touched, pushed or moved. Pinned nodes stay and
// have no contact force, as where they are part of MuJoCo's world.
template <class Fields>
PALPATE bool take_contacts(const Fields& f) {
  const double h = head(f)[HEAD_STEP];
  const D3 zero = {0.0, 0.0, 0.0};
  bool any = false, pushes = false;
  Expected expected;
  for (int k = 0; k < f.nslot; ++k) {
    const int i = f.placed.data[k], adr = f.dofadr.data[k];
    const bool moves = i >= 0 && f.free.data[i];
    const D3 before = contact_force(f, k);
    const D3 now = moves ? load(f.mj.qfrc_constraint.data + adr) : zero;
    any = any || touched(now);
    pushes = pushes || load(pushed(f, k) + PUSHED_FORCE) != zero;
    store(f.own.force.data + 3 * k, now);
    const D3 impulse = h * (now - before);
    store(pushed(f, k) + PUSHED_FORCE, impulse);
    expected.add(impulse, f.mj.M.data[f.massadr.data[3 * k]], before, now);
    if (now != before) f.flags.data[FLAG_CHANGED] = 1;
    moved(f, k)[MOVED_NODE] = i;
    if (i < 0) continue;
    const D3 off = load(f.mj.qpos.data + f.qposadr.data[k]) - load(f.qhome.data + 3 * k);
    store(moved(f, k) + MOVED_DISP, moves ? off - load(f.rest.data + 3 * i) : zero);
    store(moved(f, k) + MOVED_VEL, moves ? load(f.mj.qvel.data + adr) : zero);
  }
  head(f)[HEAD_EXPECTED] = expected.value();
  if (!any) tail(f)[TAIL_HEAVIER] = 1.0;
  return !any && !pushes && f.outbox.summary.data[SUMMARY_SPEED2] < f.slow * f.slow;
}

// Notes where the tools are and what pulls when the organ falls asleep.
template <class Fields>
PALPATE void fall_asleep(const Fields& f) {
  for (int q = 0; q < f.ngeom; ++q) {
    const double* geom = geom_at(f, q);
    double* pose = f.own.pose.data + POSE_LENGTH * q;
    store(pose + POSE_POS, load(geom + GEOM_POS));
    for (int c = 0; c < 9; ++c) pose[POSE_AXIS + c] = geom[GEOM_AXIS + c];
  }
  store(tail(f) + TAIL_GRAVITY, load(head(f) + HEAD_GRAVITY));
  for (int k = 0; k < f.nslot; ++k) store(moved(f, k) + MOVED_VEL, {0.0, 0.0, 0.0});
}

// Takes the motion of the slots' nodes and their contact force, and says if all is at rest.
template <class Fields>
PALPATE void leave_slots(const Fields& f, Thread, int) {
  double* in = head(f);
  double* last = tail(f);
  in[HEAD_MODE] = MODE_STILL;
  in[HEAD_ANSWERED] = 0.0;
  f.flags.data[FLAG_CHANGED] = 0;
  if (f.flags.data[FLAG_ASLEEP]) {
    // Contacts of a window that was left behind wake the organ.
    for (int k = 0; k < f.nslot; ++k)
      if (f.placed.data[k] >= 0)
        store(f.own.force.data + 3 * k, load(f.mj.qfrc_constraint.data + f.dofadr.data[k]));
    return;
  }
  store(last + TAIL_LOW, load(f.outbox.summary.data + SUMMARY_LOW));
  store(last + TAIL_HIGH, load(f.outbox.summary.data + SUMMARY_HIGH));
  // Roused by a tool that moved far, and by nothing else, it is at rest still.
  const bool slept = last[TAIL_QUIET] >= QUIET;
  const bool falls_anew = load(in + HEAD_GRAVITY) != load(last + TAIL_GRAVITY);
  const bool calm = take_contacts(f) && !(slept && falls_anew);
  double quiet = calm ? last[TAIL_QUIET] + in[HEAD_STEP] : 0.0;
  last[TAIL_LEEWAY] = 0.0;
  if (quiet >= QUIET && f.flags.data[FLAG_NEAR]) {
    last[TAIL_LEEWAY] = 0.5 * clearance(f);
    if (!(last[TAIL_LEEWAY] > 0.0)) quiet = 0.0;
  }
  last[TAIL_QUIET] = quiet;
  if (quiet >= QUIET) fall_asleep(f);
  const int mode = quiet >= QUIET ? MODE_HALT : MODE_COMMIT;
  in[HEAD_MODE] = mode;
  in[HEAD_STEP_ENDED] = in[HEAD_STEP];
  f.flags.data[FLAG_PENDING] = f.resident ? mode : MODE_STILL;
}

}  // namespace palpate
