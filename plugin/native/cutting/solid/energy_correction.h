// What is around a cut in a solid goes on with no more energy than it had.
//
// Means over nodes are finer where a node has become two, and by convexity have no less energy at the same
// positions. So where a cut has raised the energy, what came apart gives way along its forces until that is put
// right: by some hundredths of an edge. Its two sides do not pass through each other for that: as lips they would
// give the energy back in the next steps. Masses go with the tissue, from which what was moved at rest
// has another part then. Velocities keep momentum and angular momentum, and as much of what they have besides
// as the energy allows.
#pragma once
#include "tissue/neohookean.h"
#include "cutting/solid/solid_mesh.h"
#include "cutting/transfer_state.h"

namespace palpate {

constexpr int GIVES_WAY = 40;  // at most
constexpr int TURNS = 8, ALONE = 4;  // the first of them
constexpr double EVEN = 1e-9;  // of the kinetic energy, that counts as none
constexpr double STEP_ALONE = 0.3;  // share of the way of a vertex that gives way alone

// The part of a solid whose energy a cut changes: tetrahedra that are not the same after it, their vertices, and
// the tetrahedra around these. By place in `vert`: volume, moduli of the means, foundation, stress, force.
struct Patch {
  Few own, vert, around;
  double *size, *mu, *lam, *held, *hard;
  Rows *slope, *mean;  // of `around`, of `vert`
  D3* force;
};

PALPATE Patch patch_of(Scratch& memory, int nvert, int ntet) {
  Patch p = {few(memory, ntet), few(memory, nvert), few(memory, ntet)};
  double** lists[] = {&p.size, &p.mu, &p.lam, &p.held, &p.hard};
  for (int i = 0; i < 5; ++i) *lists[i] = memory.values(nvert);
  p.slope = (Rows*)memory.values(9 * ntet), p.mean = (Rows*)memory.values(9 * nvert);
  p.force = (D3*)memory.values(3 * nvert);
  return p;
}

// Finds what is around its own tetrahedra in the mesh as it is.
template <class S, class L>
PALPATE void find_patch(const S& m, const Neohookean& e, const L* loose, double foundation, int ntriangle,
                        Patch& p) {
  p.vert.clear(), p.around.clear();
  for (int i = 0; i < 4 * p.own.count; ++i) p.vert.put(m.vert(4 * p.own.list[i / 4] + i % 4));
  p.vert.sort(m.nvert);
  for (int i = 0; i < p.vert.count; ++i) {
    p.size[i] = p.mu[i] = p.lam[i] = p.held[i] = 0.0;
    m.each_corner(p.vert.list[i], [&](int corner) {
      const int t = corner / 4;
      D3 x[4];
      m.corners(t, x);
      const double volume = volume_of(x) / 4.0;
      p.around.put(t);
      p.size[i] += volume, p.mu[i] += volume * (1.0 - OWN_SHARE) * e.mu[t], p.lam[i] += volume * e.lam[t];
    });
    p.mu[i] /= p.size[i], p.lam[i] /= p.size[i];
  }
  for (int t = 0; t < ntriangle && foundation > 0.0; ++t) {
    if (loose[t]) continue;
    D3 x[3];
    for (int c = 0; c < 3; ++c) x[c] = m.place((int)m.elem[3 * t + c]);
    const double third = norm(cross(x[1] - x[0], x[2] - x[0])) / 6.0;
    for (int c = 0; c < 3; ++c) {
      const int k = p.vert.place[m.elem[3 * t + c]] - 1;
      if (k >= 0) p.held[k] += foundation * third;
    }
  }
}

// The energy of a patch with a displacement of all vertices; leaves the gradients of it and their means.
template <class S>
PALPATE double strain_patch(const S& m, const Neohookean& e, const double* disp, Patch& p) {
  double out = 0.0;
  for (int i = 0; i < p.vert.count; ++i) p.mean[i] = {};
  for (int i = 0; i < p.around.count; ++i) {
    const int t = p.around.list[i];
    D3 x[4], u[4], g[4];
    m.corners(t, x);
    for (int c = 0; c < 4; ++c) u[c] = load(disp + 3 * m.vert(4 * t + c));
    const double volume = slopes_of(x, g);
    p.slope[i] = gradient_of(u, g);
    if (p.own.has(t)) out += volume * density_of(p.slope[i], OWN_SHARE * e.mu[t], 0.0);
    for (int c = 0; c < 4; ++c) {
      const int k = p.vert.place[m.vert(4 * t + c)] - 1;
      if (k >= 0) add(p.mean[k], volume / (4.0 * p.size[k]), p.slope[i]);
    }
  }
  for (int i = 0; i < p.vert.count; ++i) {
    const D3 u = load(disp + 3 * p.vert.list[i]);
    out += p.size[i] * density_of(p.mean[i], p.mu[i], p.lam[i]) + 0.5 * p.held[i] * dot(u, u);
  }
  return out;
}

// The forces on vertices and their stiffness if they moved alone, after `strain_patch`, whose means it changes;
// those on vertices that also have other tetrahedra than the patch's are not whole.
template <class S>
PALPATE void pull_patch(const S& m, const Neohookean& e, const double* disp, Patch& p) {
  for (int i = 0; i < p.vert.count; ++i) {
    p.force[i] = -p.held[i] * load(disp + 3 * p.vert.list[i]), p.hard[i] = p.held[i];
    p.mean[i] = stress_of(p.mean[i], p.mu[i], p.lam[i]);
  }
  for (int i = 0; i < p.around.count; ++i) {
    const int t = p.around.list[i];
    if (!p.own.has(t)) continue;
    D3 x[4], g[4];
    m.corners(t, x);
    const double volume = slopes_of(x, g);
    Rows stress = stress_of(p.slope[i], OWN_SHARE * e.mu[t], 0.0);
    for (int c = 0; c < 4; ++c) add(stress, 0.25, p.mean[p.vert.place[m.vert(4 * t + c)] - 1]);
    for (int c = 0; c < 4; ++c) {
      const int k = p.vert.place[m.vert(4 * t + c)] - 1;
      for (int r = 0; r < 3; ++r) (&p.force[k].x)[r] -= volume * dot(stress.row[r], g[c]);
      p.hard[k] += volume * (e.mu[t] + e.lam[t]) * dot(g[c], g[c]);
    }
  }
}

// Two vertices of walls that were one before a cut, the unit normal from the first to the second, and how far apart
// they are along it, at most 0: they come no closer.
struct Lips { int a, b; D3 normal; double gap; };

// The vertex on the other side of a wall that was one with a corner of its triangle.
template <class S>
PALPATE int across(const S& m, int triangle, int v) {
  int from = 0;
  for (int k = 0; k < 3; ++k)
    if (m.elem[3 * triangle + k] == v) from = (int)m.of_tet[3 * triangle + k];
  const int mate = (int)m.mate[m.face_of(triangle)];
  for (int k = 0; k < 3; ++k)
    if (m.whole_tet[corner_of(mate, k)] == m.whole_tet[from]) return m.face_vert(mate, k);
  return v;
}

// Finds the lips that have one of some vertices; returns how many.
template <class S>
PALPATE int find_lips(const S& m, const double* disp, const Few& apart, Lips* out) {
  const auto at = [&](int v) { return m.place(v) + load(disp + 3 * v); };
  int count = 0;
  for (int i = 0; i < apart.count; ++i) {
    const int v = apart.list[i], first = count;
    m.each_triangle(v, [&](int t) {
      if (t < m.nelem) return;
      const int w = across(m, t, v);
      if (w == v || (w < v && apart.has(w))) return;
      int k = first;
      for (; k < count && out[k].b != w;) ++k;
      if (k == count) out[count++] = {v, w, {0.0, 0.0, 0.0}, 0.0};
      const auto* vert = m.elem + 3 * t;
      out[k].normal += cross(at((int)vert[1]) - at((int)vert[0]), at((int)vert[2]) - at((int)vert[0]));
    });
    for (int k = first; k < count; ++k) {
      out[k].normal = unit(out[k].normal);
      const double gap = dot(at(out[k].b) - at(v), out[k].normal);
      out[k].gap = gap < 0.0 ? gap : 0.0;
    }
  }
  return count;
}

// Moves those of the lips that may back to where these are no closer than they were.
template <class S>
PALPATE void part_lips(const S& m, const Lips* lips, int count, const Few& apart, double* disp) {
  for (int k = 0; k < count; ++k) {
    double *a = disp + 3 * lips[k].a, *b = disp + 3 * lips[k].b;
    const D3 off = m.place(lips[k].b) + load(b) - m.place(lips[k].a) - load(a);
    const double over = lips[k].gap - dot(off, lips[k].normal), half = apart.has(lips[k].b) ? 0.5 : 0.0;
    if (over <= 0.0) continue;
    store(a, load(a) - ((1.0 - half) * over) * lips[k].normal);
    store(b, load(b) + (half * over) * lips[k].normal);
  }
}

// Lets vertices give way along their forces, all at once and each as if it moved alone (damped Jacobi), until the
// energy is not above `most`; returns by how much it is, or below.
template <class S>
PALPATE double give_way(const S& m, const Neohookean& e, Patch& p, const Few& apart, const Lips* lips, int nlip,
                        double most, double* disp) {
  double more = strain_patch(m, e, disp, p) - most;
  for (int round = 0; round < GIVES_WAY && more > 0.0; ++round) {
    pull_patch(m, e, disp, p);
    for (int i = 0; i < apart.count; ++i) {
      const int v = apart.list[i], k = p.vert.place[v] - 1;
      store(disp + 3 * v, load(disp + 3 * v) + (STEP_ALONE / p.hard[k]) * p.force[k]);
    }
    part_lips(m, lips, nlip, apart, disp);
    more = strain_patch(m, e, disp, p) - most;
  }
  return more;
}

// Adds the vertices of a patch that have no other tetrahedra, on which its forces are whole.
template <class S, class L>
PALPATE void widen(const S& m, const Patch& p, const L* pinned, Few& apart) {
  for (int i = 0; i < p.vert.count; ++i) {
    const int v = p.vert.list[i];
    bool whole = !pinned[v];
    m.each_corner(v, [&](int corner) { whole = whole && p.own.has(corner / 4); });
    if (whole) apart.put(v);
  }
}

// A motion without strain.
struct Rigid {
  D3 mean, omega;
  PALPATE D3 at(D3 arm) const { return mean + cross(omega, arm); }
};

// That with a momentum and an angular momentum about the origin.
PALPATE Rigid rigid_of(const Sums& sums, D3 momentum, D3 spin) {
  double inertia[3][3];
  for (int k = 0; k < 9; ++k) inertia[k / 3][k % 3] = sums.inertia[k / 3][k % 3];
  return {(1.0 / sums.mass) * momentum, rotation_of(inertia, spin - cross(sums.centre, momentum))};
}

// Gives vertices the momentum and angular momentum that they had: they turn slowly together for it. Where they
// have more than their kinetic energy less `less`, they move less beside what they have in common. Returns by how
// much they have more all the same; where `slows`, they turn by that more slowly instead.
template <class S, class L>
PALPATE double keep_motion(const S& m, const Moving& x, const Few& vert, const L* pinned, const Sums& was,
                           double less, bool slows) {
  const Sums now = sums_of(m, x, vert, pinned);
  if (!(now.mass > 0.0)) return 0.0;
  const Rigid own = rigid_of(now, now.momentum, now.spin);
  Rigid goal = rigid_of(now, was.momentum, was.spin);
  double common = 0.0, besides = 0.0;
  const auto arm_of = [&](int v) { return m.place(v) + load(x.disp + 3 * v) - now.centre; };
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    if (pinned[v]) continue;
    const D3 a = goal.at(arm_of(v)), b = load(x.vel + 3 * v) - own.at(arm_of(v));
    common += 0.5 * x.mass[v] * dot(a, a), besides += 0.5 * x.mass[v] * dot(b, b);
  }
  const double left = was.energy - less - common;
  if (slows && left < 0.0) {
    const double turning = common - 0.5 * now.mass * dot(goal.mean, goal.mean);
    goal.omega = (turning > -left ? sqrt(1.0 + left / turning) : 0.0) * goal.omega;
  }
  const double share = left >= besides ? 1.0 : left > 0.0 ? sqrt(left / besides) : 0.0;
  for (int i = 0; i < vert.count; ++i) {
    const int v = vert.list[i];
    if (pinned[v]) continue;
    const D3 rest = load(x.vel + 3 * v) - own.at(arm_of(v));
    store(x.vel + 3 * v, goal.at(arm_of(v)) + share * rest);
  }
  return -left;
}

// What is around a cut before it is made: the patch, its energy, what its vertices have together, and the volume
// around each.
struct Before { Patch patch; double energy; Sums sums; double* size; };

// Lets what is around a cut go on with no more energy than it had.
template <class S, class F>
PALPATE bool correct_energy(const S& m, const Neohookean& e, const Moving& x, const F& f, Before& was, Scratch& memory) {
  Patch& p = was.patch;
  Few apart = few(memory, m.nvert);
  const int nsplit = f.found.data[FOUND_SPLIT];
  double* part = memory.values(nsplit);
  Lips* lips = (Lips*)memory.values(3 * (f.found.data[FOUND_TRIANGLES] - m.nelem) * (int)(sizeof(Lips) / sizeof(double)));
  if (memory.full) return false;
  for (int i = 0; i < nsplit; ++i) part[i] = f.share.data[i] * was.size[f.group.data[i]];
  for (int i = 0; i < nsplit; ++i) was.size[f.member.data[i]] = part[i], apart.put(f.member.data[i]);
  find_patch(m, e, f.loose.data, f.foundation, f.found.data[FOUND_TRIANGLES], p);
  double had = 0.0, has = 0.0;
  for (int i = 0; i < p.vert.count; ++i) {
    const int v = p.vert.list[i];
    had += x.mass[v], has += x.mass[v] *= p.size[i] / was.size[v];
  }
  for (int i = 0; i < p.vert.count; ++i) x.mass[p.vert.list[i]] *= had / has;
  int nlip = find_lips(m, x.disp, apart, lips);
  double ask = 0.0;  // by how much less strain energy than before is to be left for the motion
  for (int turn = 1; turn <= TURNS; ++turn) {
    if (turn == ALONE + 1) widen(m, p, f.pinned.data, apart), nlip = find_lips(m, x.disp, apart, lips);
    const double more = e.has ? give_way(m, e, p, apart, lips, nlip, was.energy - ask, x.disp) - ask : 0.0;
    const bool rigid = turn == TURNS || !e.has || was.energy + more <= 0.0;
    const double over = keep_motion(m, x, p.vert, f.pinned.data, was.sums, more, rigid);
    if (rigid || !(over > EVEN * was.sums.energy)) break;
    ask = over - more;
  }
  int count = 0;
  for (int i = 0; i < p.vert.count; ++i)
    if (!f.pinned.data[p.vert.list[i]]) f.near.data[count++] = p.vert.list[i];
  f.found.data[FOUND_NEAR] = count;
  return true;
}

}  // namespace palpate
