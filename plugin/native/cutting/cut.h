// Cuts a surface along a path, by one thread: a chain of edges near the path is found, its
// vertices are moved onto it in the rest shape ("snap"), and vertices on it are doubled ("split";
// Nienhuys and van der Stappen 2001).
//
// What is written is the surface itself, and in what it is another one; nothing where it raises.
#pragma once
#include "cutting/transfer_state.h"
#include "cutting/chain_search.h"

namespace palpate {

template <class S>
PALPATE int find_chains(const S& m, const Path& path, Scratch& memory, Chains& chains) {
  const int most = 2 * (m.nvert + path.count);
  chains.vert = memory.numbers(most), chains.start = memory.numbers(path.nrun + 1);
  chains.nrun = path.nrun, chains.most = most;
  Band band = {few(memory, m.nvert), memory.values(m.nvert)};
  Search search = {memory.values(m.nvert), memory.numbers(m.nvert), memory.numbers(m.nvert)};
  int* way = memory.numbers(path.count + 4);
  if (memory.full) return NO_ROOM;
  for (int r = 0; r < path.nrun; ++r) {
    const int begin = chains.start[r];
    int n = 0;
    if (!path.run[r].open)
      n = find_chain(m, path, path.run[r], band, search, way, chains.vert + begin, most - begin - 1);
    if (n < 0) return NO_ROOM;
    chains.start[r + 1] = begin + n;
  }
  return DONE;
}

// One edge is enough where it ends on a boundary, or at the end of an older cut.
template <class S>
PALPATE bool is_long(const S& m, const Path& path, const Chains& chains, int r) {
  const int n = chains.size(r);
  if (path.run[r].open || n > 2) return true;
  if (n != 2) return false;
  const int a = chains.first(r), b = chains.last(r);
  return (m.on_rim(a) || m.on_rim(b)) && m.has_both_sides(a, b);
}

// Whether there is something to cut; `bad` gets a pinned vertex in the way.
template <class S, class P>
PALPATE int check_chains(const S& m, const Path& path, const Chains& chains, const P* pinned, double* bad) {
  bool any = false;
  for (int r = 0; r < path.nrun; ++r) any = any || is_long(m, path, chains, r);
  if (!any) return TOO_SHORT;
  for (int r = 0; r < path.nrun; ++r)
    for (int i = 0; i < chains.size(r); ++i) {
      const int v = chains.of(r)[i];
      const bool end = i == 0 || i == chains.size(r) - 1;
      if (!pinned[v] || (end && !chains.closes(r) && !m.on_rim(v))) continue;
      bad[0] = v;
      return PINNED;
    }
  return DONE;
}

// The greatest distance of vertices that came apart from the path.
template <class S>
PALPATE double deviation_of(const S& m, const Path& path, const Chains& chains, const Few& there) {
  double most = 0.0, far;
  for (int r = 0; r < path.nrun; ++r)
    for (int i = 0; i < chains.size(r); ++i) {
      const int v = chains.of(r)[i], first = path.run[r].first;
      if (!there.has(v)) continue;
      place_on(path.at + 3 * first, path.run[r].last - first, m.place(v), far);
      most = far > most ? far : most;
    }
  return most;
}

// Whether a cut along a run may make two pieces: not where an end of it is inside.
PALPATE bool may_separate(const Chains& chains, int r, const Split& split) {
  if (chains.closes(r)) return true;
  bool first = false, last = false;
  for (int i = 0; i < split.count && chains.size(r); ++i) {
    first = first || split.group[i] == chains.first(r);
    last = last || split.group[i] == chains.last(r);
  }
  return first && last;
}

// What a cut makes of a surface: triangles that are not as they were, with the corners that they had;
// which vertices were one; what was near.
struct Changes {
  Few elem, vert;
  int* before;
  Split split;
  double* share;
};

// Moves and doubles the vertices of a seam, and renews what is around them.
template <class S, class P>
PALPATE bool apply(const S& m, const Moving& x, int nmove, Plan& plan, const P* pinned, Changes& out,
                   Scratch& memory) {
  const Move* move = plan.move;
  const Few& there = plan.there;
  Few moved = few(memory, m.nvert), &near = out.elem;
  int *row = memory.numbers(m.most), *source = memory.numbers(m.nvert);
  D3 *to = (D3*)memory.values(3 * nmove), *from = (D3*)memory.values(3 * nmove);
  if (memory.full) return false;
  for (int i = 0; i < nmove; ++i) {
    from[i] = m.place(move[i].vert), to[i] = from[i] + move[i].share * move[i].way;
    if (to[i] != from[i]) moved.put(move[i].vert);
  }
  for (int pass = 0; pass < 2; ++pass)
    for (int i = 0; i < (pass ? nmove : there.count); ++i) {
      const int v = pass ? move[i].vert : there.list[i];
      for (int k = 0; k < m.degree[v]; ++k)
        if (m.half(v, k) >= 0) near.put(m.half(v, k) / 3);
    }
  near.sort(m.nelem);
  out.before = memory.numbers(3 * near.count), out.share = memory.values(m.nvert);
  if (memory.full) return false;
  for (int i = 0; i < 3 * near.count; ++i) out.before[i] = (int)m.elem[3 * near.list[i / 3] + i % 3];
  for (int i = 0; i < nmove; ++i) store(m.rest + 3 * move[i].vert, to[i]);
  double_vertices(m, plan.parts, out.split);
  for (int i = 0; i < out.split.count; ++i)
    store(m.rest + 3 * out.split.member[i], m.place(out.split.group[i]));
  rejoin(m, near, out.before, moved, out.split, out.vert, row, source);
  out.vert.clear();
  for (int i = 0; i < 3 * near.count; ++i)
    if (!pinned[out.before[i]]) out.vert.put(out.before[i]);
  carry_motion(m, x, move, nmove, from, out.vert, pinned);
  const Split& s = out.split;
  const unsigned char* all = nullptr;
  for (int first = 0, last; first < s.count; first = last) {
    for (last = first; last < s.count && s.group[last] == s.group[first]; ++last)
      out.share[last] = area_around(m, s.member[last], all);
    share_mass(x, s.group[first], s.member + first, out.share + first, last - first);
  }
  return true;
}

// Writes what a cut has done.
template <class F>
PALPATE void answer(const F& f, const Changes& c, const Seam& seam, int nmove) {
  for (int i = 0; i < c.vert.count; ++i) f.near.data[i] = c.vert.list[i];
  for (int i = 0; i < c.split.count; ++i) {
    f.group.data[i] = c.split.group[i], f.member.data[i] = c.split.member[i];
    f.share.data[i] = c.share[i];
  }
  for (int i = 0; i < c.elem.count; ++i) f.changed.data[i] = c.elem.list[i];
  for (int i = 0; i < 2 * seam.count; ++i) f.seam.data[i] = seam.pair[i];
  int* found = f.found.data;
  found[FOUND_NEAR] = c.vert.count, found[FOUND_SPLIT] = c.split.count;
  found[FOUND_CHANGED] = c.elem.count, found[FOUND_EDGES] = seam.count;
  found[FOUND_NOUTER] = c.split.following, found[FOUND_MOVED] = nmove;
}

// Cuts along a path that was traced; returns how it went.
template <class F, class S>
PALPATE int cut_along(const F& f, const S& m, const Material& p, const Path& path, const Moving& x,
                      Scratch& memory) {
  int* found = f.found.data;
  Chains chains;
  Changes made = {few(memory, m.nelem), few(memory, m.nvert), nullptr};
  made.split = {memory.numbers(m.nvert), memory.numbers(m.nvert), 0, found[FOUND_NOUTER]};
  const auto* pinned = f.pinned.data;
  if (memory.full) return NO_ROOM;
  int status = find_chains(m, path, memory, chains);
  if (status == DONE) status = check_chains(m, path, chains, pinned, f.size.data + SIZE_BAD);
  if (status != DONE) return status;
  Plan plan = new_plan(m, chains, memory);
  if (memory.full || !mend(m, path, p, pinned, m.nvert - made.split.following, chains, plan, memory) ||
      plan.seam.count > m.nvert)
    return NO_ROOM;
  found[FOUND_STOPPED] = plan.stopped;
  const int nmove = those_that_move(plan.move, plan.movers.count);
  if (!apply(m, x, nmove, plan, pinned, made, memory)) return NO_ROOM;
  answer(f, made, plan.seam, nmove);
  f.size.data[SIZE_DEVIATION] = deviation_of(m, path, chains, plan.there);
  bool apart = false;
  for (int r = 0; r < path.nrun && made.elem.count; ++r)
    apart = apart || may_separate(chains, r, made.split);
  if (!apart) return DONE;
  const Pieces pieces = all_apart(memory, m.nvert);
  if (memory.full) return NO_ROOM;
  for (int h = 0; h < 3 * m.nelem; ++h) pieces.join(m.from(h), m.to(h));
  found[FOUND_APART] = 1;
  return let_go(m, pieces, f.home.data, f.surface.loose.data, memory) ? DONE : NO_ROOM;
}

// Finds the places of a surface that are nearest to points.
template <class Fields>
PALPATE void find_nearest(const Fields& f, Thread t, int) {
  if (t.tid) return;
  using I = decltype(f.elem.data[0] + 0);
  const Triangles<I> all = {f.elem.data, f.x.data, f.rest.data, nullptr, nullptr, f.nelem};
  const auto put = [&](int i, Spot s, const Triangles<I>& near) {
    double* out = f.spot.data + 8 * i;
    out[0] = s.elem, out[4] = s.far;
    store(out + 1, s.weight);
    if (f.normals) store(out + 5, near.normal(s));
  };
  nearest_spots(all, f.point.data, f.npoint, f.edge, f.box.data, f.middle.data, put);
}

template <class Fields>
PALPATE void cut_surface(const Fields& f, Thread t, int) {
  if (t.tid) return;
  const auto m = surface_of(f.surface);
  Scratch memory = {f.ints.data, f.reals.data, f.nint, f.nreal, false};
  const Material p = {f.kind, f.held, f.thickness, f.tension, f.stiffness, f.given, f.lame.data, f.shear.data,
                      f.whole.data, f.pull.data, f.hard.data, f.disp.data, f.kind != NO_ENERGY};
  Path path = {f.edge, f.path.data, f.spot.data, f.npath, nullptr, 0};
  const bool found = find_runs(m, path, memory);
  const Moving moving = {f.mass.data, f.disp.data, f.vel.data};
  f.found.data[FOUND_STATUS] = found ? cut_along(f, m, p, path, moving, memory) : NO_ROOM;
}

}  // namespace palpate
