// Cuts a solid: tetrahedra on the two sides of a sheet come apart, by one thread.
//
// What lies across the sheet goes to one side or the other such that the faces between the sides are few and
// near the sheet: a minimal cut of the graph of tetrahedra (Boykov and Jolly 2001,
// doi:10.1109/ICCV.2001.937505). The vertices of these faces are moved onto the sheet in the rest shape, as
// far as no tetrahedron gets thin ("snap"), and the faces are opened ("split"; Nienhuys and van der Stappen
// 2001).
#pragma once
#include "cutting/solid/energy_correction.h"
#include "cutting/solid/min_cut.h"
#include "cutting/solid/open_faces.h"
#include "cutting/solid/snap_to_surface.h"

namespace palpate {

constexpr double WIDE = 1.5;  // edges inside from the sheet within which tetrahedra are looked at
constexpr double ON = 0.02;  // edges within which a vertex is on it
constexpr double FLAT = 0.05;  // cost of a face on the sheet, by area; one an edge away costs 1
constexpr double LIP = 16.0;  // cost of an edge of the skin at the mouth that is an edge away, by length
constexpr double LEAST = 0.3;  // edges that a path is deep at least for one to come apart all through
constexpr double BESIDE = 0.75;  // edges of the skin from the sheet within which its vertices are at the mouth
constexpr double MOUTH = 0.6;  // edges below the path down to which an edge of the skin is at the mouth
// Edges of the skin beyond an end of the path up to which a face reaches, and a short path's.
constexpr double PAST = 0.2, OVER = 0.8;
constexpr double FINE = 1e4;  // of costs as whole numbers
constexpr double MUCH = 1e9;
constexpr double AROUND = 3.0;  // edges of the skin around the sheet in which vertices are looked at

enum { APART, NOTHING, HELD, FULL };  // how it went

// Where vertices are beside a sheet, as far as they are near it, and the mean edge there.
struct Measured { Where* where; int* near; double edge; };

template <class S>
PALPATE bool measure_all(const S& m, const Sheet& sheet, double skin, Measured& out, Scratch& memory) {
  out.where = (Where*)memory.values(m.nvert * (int)(sizeof(Where) / sizeof(double)));
  out.near = memory.numbers(m.nvert);
  if (memory.full) return false;
  const D3 zero = {0.0, 0.0, 0.0}, more = {AROUND * skin, AROUND * skin, AROUND * skin};
  D3 low = sheet.top(0), high = low;
  for (int i = 0; i < 2 * sheet.nline; ++i) {
    const D3 a = i % 2 ? sheet.level(i / 2, 1.0) : sheet.top(i / 2);
    high = vmax(high, a), low = zero - vmax(zero - low, zero - a);
  }
  low = low - more, high = high + more;
  double sum = 0.0;
  int count = 0;
  for (int v = 0; v < m.nvert; ++v) {
    const D3 x = m.place(v), off = vmax(low - x, x - high);
    if (!m.degree[v] || off.x > 0.0 || off.y > 0.0 || off.z > 0.0) continue;
    out.near[v] = 1;
    for (int k = 0; k < m.degree[v]; ++k) sum += norm(m.place((int)m.ring[m.most * v + k]) - x);
    count += (int)m.degree[v];
  }
  out.edge = sum / (count ? count : 1);
  for (int v = 0; v < m.nvert; ++v) {
    if (!out.near[v]) continue;
    out.where[v] = measure(sheet, m.place(v));
    out.near[v] = fabs(out.where[v].off) < 2.0 * WIDE * out.edge;
  }
  return true;
}

// Which side of the sheet a tetrahedron is on: 1 or 2; 3 where it is across, 0 where it does not come apart.
template <class S>
PALPATE int side_of(const S& m, const Measured& at, const Sheet& sheet, double skin, int t) {
  double low = 1e300, high = -1e300, deep = 0.0, past = 0.0;
  bool mouth = false;
  for (int c = 0; c < 4; ++c) {
    const int v = m.vert(4 * t + c);
    if (!at.near[v]) return 0;
    const Where& w = at.where[v];
    low = w.off < low ? w.off : low, high = w.off > high ? w.off : high;
    deep += 0.25 * w.deep, past += 0.25 * w.past;
    mouth = mouth || (v < m.nskin && fabs(w.off) < BESIDE * skin && w.deep + sheet.reach < MOUTH * skin);
  }
  // All around the mouth, so that it opens.
  const bool within = deep <= 0.0 || (mouth && sheet.reach > LEAST * at.edge);
  if (!within || past > 0.0) return 0;
  const bool left = high <= ON * at.edge, right = low >= -ON * at.edge;
  return left == right ? 3 : left ? 1 : 2;
}

// Whether an edge is one of the skin's.
template <class S>
PALPATE bool on_skin(const S& m, int a, int b) {
  bool found = false;
  m.each_triangle(a, [&](int t) {
    for (int c = 0; c < 3 && t < m.nelem; ++c) found = found || m.elem[3 * t + c] == b;
  });
  return found;
}

// How much of the cut a face costs: more where its edges at the mouth are off the path.
template <class S>
PALPATE int cost_of(const S& m, const Measured& at, int face, double most) {
  double far = 0.0;
  D3 x[3];
  for (int k = 0; k < 3; ++k) {
    const int v = m.face_vert(face, k);
    const double off = fabs(at.where[v].off) / at.edge;
    x[k] = m.place(v), far = off > far ? off : far;
  }
  double cost = norm(0.5 * cross(x[1] - x[0], x[2] - x[0])) / (at.edge * at.edge) * (FLAT + far * far);
  for (int k = 0; k < 3; ++k) {
    const int a = m.face_vert(face, k), b = m.face_vert(face, (k + 1) % 3);
    if (a >= m.nskin || b >= m.nskin || !on_skin(m, a, b)) continue;
    const double one = fabs(at.where[a].off) / at.edge, two = fabs(at.where[b].off) / at.edge;
    cost += LIP * norm(x[(k + 1) % 3] - x[k]) / at.edge * (one > two ? one * one : two * two);
  }
  cost = floor(cost * FINE);
  return (int)(cost < 1.0 ? 1.0 : cost < most ? cost : most);
}

// Finds the faces that part both sides, by a minimal cut, ascending.
template <class S>
PALPATE bool part_sides(const S& m, const Measured& at, const Sheet& sheet, double skin, double over,
                        Opening& o, Scratch& memory) {
  int *side = memory.room(m.ntet), *node = memory.room(m.ntet), *near = memory.room(m.ntet);
  if (memory.full) return false;
  int count = 0, nface = 0, nnear = 0;
  for (int t = 0; t < m.ntet; ++t) {
    side[t] = side_of(m, at, sheet, skin, t);
    if (side[t] == 3) node[t] = count++;
    if (side[t]) near[nnear++] = t;
  }
  const auto between = [&](int face) {
    const int mate = m.beside(face);
    if (mate < 0) return -1;
    const int a = side[face / 4], b = side[mate / 4];
    return a && b && (a != b || a == 3) ? mate : -1;
  };
  const auto each_face = [&](auto act) {  // of these, ascending
    for (int i = 0; i < 4 * nnear; ++i) act(4 * near[i / 4] + i % 4);
  };
  each_face([&](int f) { nface += between(f) > f; });
  Flow flow = flow_of(memory, count);
  if (memory.full) return false;
  const double most = floor(MUCH / (nface ? nface : 1));
  each_face([&](int f) {
    if (side[f / 4] != 3) return;
    const int a = 4 * node[f / 4] + f % 4, mate = between(f);
    flow.to[a] = -1;
    if (mate < 0) return;
    const int cost = cost_of(m, at, f < mate ? f : mate, most);
    if (side[mate / 4] == 1) flow.source[node[f / 4]] += cost;
    if (side[mate / 4] == 2) flow.sink[node[f / 4]] += cost;
    if (side[mate / 4] != 3) return;
    flow.to[a] = node[mate / 4], flow.back[a] = 4 * node[mate / 4] + mate % 4, flow.room[a] = cost;
  });
  flow.part();
  const auto first = [&](int t) { return side[t] == 1 || (side[t] == 3 && flow.level[node[t]] > 0); };
  o.count = 0;
  each_face([&](int f) {
    const int mate = between(f);
    if (mate <= f || first(f / 4) == first(mate / 4)) return;
    double past = -1e300;
    for (int k = 0; k < 3; ++k) {
      const double far = at.where[m.face_vert(f, k)].past;
      past = far > past ? far : past;
    }
    if (past < over * skin) o.face[o.count++] = f;
  });
  return true;
}

// Puts faces in their order along the path.
template <class S>
PALPATE bool order_faces(const S& m, const Measured& at, Opening& o, Scratch& memory) {
  double* along = memory.values(4 * m.ntet);
  int* more = memory.numbers(o.count);
  if (memory.full) return false;
  for (int i = 0; i < o.count; ++i) {
    double& most = along[o.face[i]] = 0.0;
    for (int k = 0; k < 3; ++k) {
      const double far = at.where[m.face_vert(o.face[i], k)].along;
      most = far > most ? far : most;
    }
  }
  sort_by(o.face, o.count, along, more);
  return true;
}

// Vertices that were one share its mass by the volume around them.
template <class S, class F>
PALPATE int share_masses(const S& m, const Opening& o, const Moving& x, const F& f, Scratch& memory) {
  const Parts& p = o.parts;
  double* volume = memory.values(p.count);
  if (memory.full) return 0;
  for (int k = 0; k < p.count; ++k) volume[k] = 0.0;
  for (int i = 0; i < p.ncorner; ++i) {
    D3 corner[4];
    m.corners(p.corner[i] / 4, corner);
    volume[p.part[p.corner[i]] - 1] += volume_of(corner);
  }
  int count = 0;
  each_divided(p, [&](int first, int last) {
    const int v = p.vert[first];
    for (int k = first; k < last; ++k) {
      const int i = count + k - first;
      f.group.data[i] = v, f.member.data[i] = p.name[k], f.sat.data[i] = p.first[k], f.share.data[i] = volume[k];
    }
    share_mass(x, v, f.member.data + count, f.share.data + count, last - first);
    count += last - first;
  });
  return count;
}

// Vertices that have moved get what is carried where they are now; lists the tetrahedra that are not as they
// were, and their vertices.
template <class S, class F>
PALPATE bool carry(const S& m, const Opening& o, const Few& movers, const Move* shift, const double* rest,
                   const Moving& x, const F& f, Scratch& memory) {
  Few tets = few(memory, m.ntet);
  D3* now = (D3*)memory.values(6 * movers.count);
  if (memory.full) return false;
  each_apart(o.parts, [&](int corner) { tets.put(corner / 4); });
  for (int i = 0; i < movers.count; ++i) {
    const int v = movers.list[i];
    const double* of[2] = {x.disp, x.vel};
    for (int k = 0; k < 2; ++k) {
      const D3 was = load(of[k] + 3 * v);
      now[2 * i + k] = was + shift[i].share * (at_corners(m, of[k], shift[i]) - was);
    }
    if (load(rest + 3 * v) != m.place(v)) m.each_corner(v, [&](int corner) { tets.put(corner / 4); });
  }
  tets.sort(m.ntet);
  for (int i = 0; i < tets.count; ++i) f.changed.data[i] = tets.list[i];
  for (int i = 0; i < movers.count; ++i) {
    const int v = movers.list[i];
    store(x.disp + 3 * v, now[2 * i]), store(x.vel + 3 * v, now[2 * i + 1]);
    store(m.rest + 3 * v, load(rest + 3 * v));
  }
  f.found.data[FOUND_CHANGED] = tets.count, f.found.data[FOUND_MOVED] = movers.count;
  return true;
}

// Measures what has opened: its area, how deep it is, and the edges at its mouth, where a wall meets the skin
// near the path and not where the sheet comes out elsewhere.
template <class S, class F>
PALPATE void measure_walls(const S& m, const Sheet& sheet, double skin, int first, int last, const F& f) {
  double area = 0.0, depth = -1e300, deviation = 0.0;
  int count = 0;
  for (int t = first; t < last; t += 2) {
    D3 x[3];
    bool top[3];
    double off[3];
    const auto* vert = m.elem + 3 * t;
    for (int c = 0; c < 3; ++c) {
      x[c] = m.place((int)vert[c]);
      const double below = measure(sheet, x[c]).deep + sheet.reach;
      place_on(sheet.path, sheet.npath, x[c], off[c]);
      depth = below > depth ? below : depth;
      top[c] = off[c] < WIDE * skin && below < MOUTH * skin;
    }
    area += norm(0.5 * cross(x[1] - x[0], x[2] - x[0]));
    for (int c = 0; c < 3; ++c) {
      const int d = (c + 1) % 3, a = (int)vert[c], b = (int)vert[d];
      if (!top[c] || !top[d] || !on_skin(m, a, b)) continue;
      deviation = off[c] > deviation ? off[c] : deviation;
      deviation = off[d] > deviation ? off[d] : deviation;
      f.mouth.data[2 * count] = a < b ? a : b, f.mouth.data[2 * count++ + 1] = a < b ? b : a;
    }
  }
  f.found.data[FOUND_MOUTH] = count;
  f.size.data[SIZE_AREA] = area, f.size.data[SIZE_DEVIATION] = deviation;
  f.size.data[SIZE_DEPTH] = depth < sheet.reach ? depth : sheet.reach;
}

// Marks triangles that a cut has freed from the foundation, see `let_go`. Where vertices that were one hang
// together still by the tetrahedra around them, nothing has come free.
template <class S, class I>
PALPATE bool come_loose(const S& m, const Parts& parts, const Few& near, const I* home, unsigned char* loose,
                        Scratch& memory) {
  const Pieces p = all_apart(memory, m.nvert);
  if (memory.full) return false;
  const auto join = [&](int t) {
    for (int c = 1; c < 4; ++c) p.join(m.vert(4 * t), m.vert(4 * t + c));
  };
  for (int i = 0; i < near.count; ++i) join(near.list[i]);
  bool free = false;
  for (int k = 1; k < parts.count; ++k)
    free = free || (parts.vert[k] == parts.vert[k - 1] && p.find(parts.name[k]) != p.find(parts.name[k - 1]));
  if (!free) return true;
  for (int t = 0; t < m.ntet; ++t) join(t);
  return let_go(m, p, home, loose, memory);
}

template <class F>
PALPATE Sheet sheet_of(const F& f) {
  Sheet out = {f.path.data, f.begin_line.data, f.end_line.data, f.npath, f.nline, f.closes != 0,
               f.before, f.after, 0.0, 0.0};
  span(out);
  return out;
}

PALPATE Opening opening_of(Scratch& memory, int nvert, int ntet, int nouter) {
  Opening o = {};
  o.face = memory.room(2 * ntet), o.parting = memory.room(2 * ntet), o.cut = memory.numbers(4 * ntet);
  o.parts = parts_of(memory, 4 * ntet);
  o.vert = few(memory, nvert), o.renew = few(memory, nvert);
  o.ring = memory.numbers(nvert), o.seen = memory.numbers(nvert);
  o.nouter = nouter;
  return o;
}

// Finds what is around a cut before it is made.
template <class S, class F>
PALPATE bool look_before(const S& m, const Opening& o, const Few& movers, const Neohookean& e, const Moving& x,
                         const F& f, Before& out, Scratch& memory) {
  out.patch = patch_of(memory, m.nvert, m.ntet), out.size = memory.values(m.nvert);
  if (memory.full) return false;
  Patch& p = out.patch;
  const auto put = [&](int v) { m.each_corner(v, [&](int corner) { p.own.put(corner / 4); }); };
  for (int i = 0; i < movers.count; ++i) put(movers.list[i]);
  for (int k = 0; k < o.parts.count; ++k) put(o.parts.vert[k]);
  find_patch(m, e, f.loose.data, f.foundation, f.ntriangle, p);
  out.energy = e.has ? strain_patch(m, e, x.disp, p) : 0.0;
  out.sums = sums_of(m, x, p.vert, f.pinned.data);
  for (int i = 0; i < p.vert.count; ++i) out.size[p.vert.list[i]] = p.size[i];
  return true;
}

// Cuts under a sheet; returns how it went.
template <class F, class S>
PALPATE int cleave(const F& f, const S& m, const Sheet& sheet, const Neohookean& p, Scratch& memory) {
  Opening o = opening_of(memory, m.nvert, m.ntet, f.nouter);
  Measured at = {};
  Few movers = few(memory, m.nvert), near = few(memory, m.nvert);
  double* rest = memory.values(3 * m.nvert);
  int* found = f.found.data;
  if (memory.full || !measure_all(m, sheet, f.edge, at, memory)) return FULL;
  bool fits = false;
  for (int k = 0; k < 2 && !o.nparting; ++k) {
    const double over = k ? OVER : PAST;
    if (!part_sides(m, at, sheet, f.edge, over, o, memory) || !order_faces(m, at, o, memory)) return FULL;
    fits = fit(m, o, f.ntriangle, memory);
  }
  found[FOUND_STOPPED] = o.stopped || !fits;
  if (memory.full) return FULL;
  if (!fits || !o.nparting) return NOTHING;
  for (int i = 0; i < 3 * o.count; ++i) {
    const int v = m.face_vert(o.face[i / 3], i % 3);
    movers.put(v);
    if (!f.pinned.data[v]) continue;
    f.size.data[SIZE_BAD] = v;
    return HELD;
  }
  movers.sort(m.nvert);
  Move* shift = nullptr;
  for (int i = 0; i < 3 * m.nvert; ++i) rest[i] = m.rest[i];
  if (!settle(m, sheet, f.edge, at.where, f.pinned.data, p, movers, shift, rest, memory)) return FULL;
  const Moving x = {f.mass.data, f.disp.data, f.vel.data};
  Before was = {};
  if (!look_before(m, o, movers, p, x, f, was, memory)) return FULL;
  if (!carry(m, o, movers, shift, rest, x, f, memory)) return FULL;
  const int count = 3 * (f.ntriangle + 2 * o.nparting);
  open_faces(m, o, f.ntriangle, near);
  found[FOUND_TRIANGLES] = count / 3, found[FOUND_NOUTER] = o.following;
  found[FOUND_SPLIT] = share_masses(m, o, x, f, memory);
  for (int t = f.ntriangle; t < count / 3; ++t) f.loose.data[t] = 1;
  measure_walls(m, sheet, f.edge, f.ntriangle, count / 3, f);
  if (!come_loose(m, o.parts, was.patch.own, f.home.data, f.loose.data, memory)) return FULL;
  return correct_energy(m, p, x, f, was, memory) && !memory.full ? APART : FULL;
}

template <class Fields>
PALPATE void cleave_solid(const Fields& f, Thread t, int) {
  if (t.tid) return;
  const auto m = solid_of(f);
  Scratch memory = {f.ints.data, f.reals.data, f.nint, f.nreal, false};
  bool strained = false;
  for (int i = 0; i < 3 * m.nvert && !strained; ++i) strained = f.disp.data[i] != 0.0;
  const Neohookean p = {f.energy && strained, f.given, f.mu.data, f.lam.data, f.disp.data};
  f.found.data[FOUND_STATUS] = cleave(f, m, sheet_of(f), p, memory);
}

}  // namespace palpate
