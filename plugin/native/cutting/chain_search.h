// Where a chain of edges cannot get onto its path another one may: a vertex is left out where those
// beside it are neighbours, since three corners of a triangle do not fit on a line, or one is taken in where an
// edge cuts off a bend.
#pragma once
#include "cutting/snap.h"
#include "cutting/split.h"

namespace palpate {

// Edges of a chain that cut a crumb off, at most; the lip beside it has one more.
constexpr int CRUMB = 3;

// In edges: off the path from which another chain is looked for. Places that are looked at, at most; edges on
// both sides that tell whether it is better, by so much.
constexpr double ASTRAY = 0.1, BETTER = 0.7;
constexpr int PLACES = 16, AROUND = 3;

// The chains of a path's runs, one after the other.
struct Chains {
  int *vert, *start, nrun, most;  // that of run r begins at start[r]; `most` there is room for

  PALPATE int size(int r) const { return start[r + 1] - start[r]; }
  PALPATE const int* of(int r) const { return vert + start[r]; }
  PALPATE int first(int r) const { return vert[start[r]]; }
  PALPATE int last(int r) const { return vert[start[r + 1] - 1]; }
  PALPATE bool closes(int r) const { return size(r) > 3 && first(r) == last(r); }

  PALPATE void take_out(int r, int i) {
    for (int k = start[r] + i; k + 1 < start[nrun]; ++k) vert[k] = vert[k + 1];
    while (r < nrun) --start[++r];
  }
  PALPATE void put_in(int r, int i, int v) {
    for (int k = start[nrun]; k > start[r] + i; --k) vert[k] = vert[k - 1];
    vert[start[r] + i] = v;
    while (r < nrun) ++start[++r];
  }
  // Lets a closed chain begin half way.
  PALPATE void turn(int r, int* row) {
    const int n = size(r) - 1;
    for (int k = 0; k < n; ++k) row[k] = vert[start[r] + (k + n / 2) % n];
    row[n] = row[0];
    for (int k = 0; k <= n; ++k) vert[start[r] + k] = row[k];
  }
};

// What is to come apart, and how its vertices move first.
struct Plan {
  Seam seam;
  Few there, movers;  // vertices of the seam, and those that may move
  D3* goal;
  Move* move;
  Parts parts;  // around the former
  int *seen, stopped;

  template <class S>
  PALPATE D3 place(const S& m, int v) const {
    const int k = movers.place[v] - 1;
    return k < 0 ? m.place(v) : m.place(v) + move[k].share * move[k].way;
  }
};

// Room for a plan of chains.
template <class S>
PALPATE Plan new_plan(const S& m, const Chains& chains, Scratch& memory) {
  Plan out = {};
  out.seam = {memory.numbers(2 * chains.most), 0, memory.numbers(3 * m.nelem)};
  out.there = few(memory, m.nvert), out.movers = few(memory, m.nvert);
  out.seen = memory.numbers(m.nvert), out.parts = parts_of(memory, 3 * m.nelem);
  out.goal = (D3*)memory.values(3 * m.nvert);
  out.move = (Move*)memory.values(m.nvert * (int)(sizeof(Move) / sizeof(double)));
  return out;
}

// Whether a vertex on the lip of an older cut follows another one, by so many edges at most.
template <class S>
PALPATE bool follows(const S& m, int v, int other, int most) {
  for (int k = 0; k < most && v != other && m.on_rim(v); ++k) {
    const int h = m.half(v, 0);
    if (h < 0 || m.twin[h] >= 0 || m.whole_twin[h] < 0) return false;
    v = m.to(h);
  }
  return v == other;
}

// Whether edges of a chain, `n` from `first` on, would cut a crumb off the lip of an older cut.
template <class S>
PALPATE bool cuts_crumb(const S& m, const int* first, int n) {
  if (n > CRUMB || !m.on_rim(first[0]) || !m.on_rim(first[n])) return false;
  return follows(m, first[0], first[n], n + 1) || follows(m, first[n], first[0], n + 1);
}

// Finds the edges of the chains that have tissue on both sides. Where a chain goes along an older cut,
// single edges between are not a way into the tissue, nor are those that come back to it at once.
template <class S>
PALPATE void find_seam(const S& m, const Path& path, const Chains& chains, Seam& seam) {
  for (int r = 0; r < path.nrun; ++r) {
    const int *chain = chains.of(r), n = chains.size(r) - 1;
    const auto inside = [&](int k) { return k >= 0 && k < n && m.has_both_sides(chain[k], chain[k + 1]); };
    for (int first = 0, last; first < n; first = last) {  // from one rim to the next
      for (last = first + 1; inside(first) && inside(last) && !m.on_rim(chain[last]);) ++last;
      const bool single = n > 1 && last == first + 1 && !inside(first - 1) && !inside(last);
      if (!inside(first) || single || cuts_crumb(m, chain + first, last - first)) continue;
      for (int k = first; k < last; ++k)
        seam.pair[2 * seam.count] = chain[k], seam.pair[2 * seam.count++ + 1] = chain[k + 1];
    }
  }
}

// Finds the vertices of the seam that may move, ascending, and where each is to go.
template <class S, class P>
PALPATE void find_goals(const S& m, const Path& path, const Chains& chains, const Few& there,
                        const P* pinned, Few& movers, D3* goal, int* seen) {
  for (int r = 0; r < path.nrun; ++r) {
    const double* line = path.at + 3 * path.run[r].first;
    const int n = path.run[r].last - path.run[r].first, size = chains.size(r);
    for (int i = 0; i < size; ++i) {
      const int v = chains.of(r)[i];
      if (seen[v]) continue;
      seen[v] = 1;
      double far;
      D3 to = place_on(line, n, m.place(v), far);
      if (!chains.closes(r) && i == 0) to = load(line);
      if (!chains.closes(r) && i == size - 1) to = load(line + 3 * (n - 1));
      const bool slides = !m.on_rim(v) || slide(m, v, to);
      if (!slides || pinned[v] || !there.has(v)) continue;
      movers.put(v);
      goal[v] = to;
    }
  }
  for (int k = 0; k < chains.start[chains.nrun]; ++k) seen[chains.vert[k]] = 0;
  movers.sort(m.nvert);
  for (int i = 0; i < movers.count; ++i) goal[i] = goal[movers.list[i]];  // in place: list[i] >= i
}

// Finds chains that follow their path better, an edit at a time, and says what comes of them.
template <class S, class P>
struct Mender {
  const S& m;
  const Path& path;
  const Material& p;
  const P* pinned;
  int left;  // vertices that wait
  Chains& chains;
  Plan& plan;
  double* off;  // of an edge of a chain, as `off_path` has it
  int* tried;  // of a vertex where nothing was better

  // A vertex that leaves a run at a place, -1, or comes there.
  struct Edit { int at, vert; double cost; };

  // Plans along the chains as they are; returns whether there was memory.
  PALPATE bool make(Scratch memory) {
    mark(m, plan.seam, plan.seam.count, 0);
    plan.seam.count = 0;
    plan.there.clear(), plan.movers.clear();
    find_seam(m, path, chains, plan.seam);
    plan.stopped = find_room(m, plan.seam, left, plan.there, plan.parts);
    find_goals(m, path, chains, plan.there, pinned, plan.movers, plan.goal, plan.seen);
    return find_moves(m, p, plan.goal, plan.movers, plan.move, memory);
  }

  // How far a vertex of a run, and the middle of the edge after it, will be from the path.
  PALPATE double off_path(int r, int i) const {
    const double* line = path.at + 3 * path.run[r].first;
    const int n = path.run[r].last - path.run[r].first;
    const D3 a = plan.place(m, chains.of(r)[i]);
    double far, middle = 0.0;
    place_on(line, n, a, far);
    if (i + 1 < chains.size(r)) place_on(line, n, 0.5 * (a + plan.place(m, chains.of(r)[i + 1])), middle);
    return far > middle ? far : middle;
  }

  PALPATE void look() {
    for (int r = 0; r < path.nrun; ++r)
      for (int i = 0; i < chains.size(r); ++i) off[chains.start[r] + i] = off_path(r, i);
  }

  PALPATE bool may_leave(int r, int i) const {
    const int* vert = chains.of(r);
    if (i < 1 || i > chains.size(r) - 2 || chains.size(r) < (chains.closes(r) ? 5 : 4)) return false;
    return m.has_both_sides(vert[i - 1], vert[i + 1]) && !(m.on_rim(vert[i - 1]) && m.on_rim(vert[i + 1]));
  }

  PALPATE bool may_come(int v) const {
    if (m.on_rim(v) || pinned[v] || chains.start[chains.nrun] + 1 > chains.most) return false;
    for (int k = 0; k < chains.start[chains.nrun]; ++k)
      if (chains.vert[k] == v) return false;
    return true;
  }

  // What a stretch of a run costs: most of all where it is farthest off.
  PALPATE double cost(int r, int first, int last) const {
    double sum = 0.0;
    for (int i = first < 0 ? 0 : first; i <= last && i < chains.size(r); ++i) {
      const double far = off_path(r, i);
      sum += far * far * far * far;
    }
    return sum;
  }

  PALPATE void apply(int r, Edit e) {
    if (e.vert < 0) chains.take_out(r, e.at);
    else chains.put_in(r, e.at, e.vert);
  }

  // Tries an edit near a place of a run, and undoes it.
  PALPATE void weigh(int r, int i, Edit e, Edit& best, Scratch memory) {
    const int had = chains.of(r)[e.at];
    apply(r, e);
    if (make(memory)) e.cost = cost(r, i - AROUND, i + AROUND + (e.vert < 0 ? -1 : 1));
    apply(r, {e.at, e.vert < 0 ? had : -1, 0.0});
    if (e.cost < best.cost) best = e;
  }

  // The edit near a place of a run that is best, `at` -1 where none makes it better.
  PALPATE Edit find_edit(int r, int i, Scratch memory) {
    Edit best = {-1, -1, BETTER * cost(r, i - AROUND, i + AROUND)};
    for (int k = i - 1; k <= i + 1; ++k)
      if (may_leave(r, k)) weigh(r, i, {k, -1, 1e300}, best, memory);
    for (int k = i > 0 ? i - 1 : 0; k <= i && k + 1 < chains.size(r); ++k) {
      const int h = m.half_to(chains.of(r)[k], chains.of(r)[k + 1]);
      if (h < 0 || m.twin[h] < 0) continue;
      for (int side = 0; side < 2; ++side) {
        const int v = m.opposite(side ? (int)m.twin[h] : h);
        if (may_come(v)) weigh(r, i, {k + 1, v, 1e300}, best, memory);
      }
    }
    return best;
  }

  // Plans, and looks for an edit where a run is farthest off its path, again and again.
  PALPATE bool mend(Scratch memory) {
    if (!make(memory)) return false;
    if (plan.stopped) return true;
    look();
    for (int k = 0; k < PLACES; ++k) {
      int r = -1, at = 0;
      double most = ASTRAY * path.edge;
      for (int q = 0; q < path.nrun; ++q)
        for (int i = 0; i < chains.size(q); ++i)
          if (off[chains.start[q] + i] > most && !tried[chains.of(q)[i]])
            r = q, at = i, most = off[chains.start[q] + i];
      if (r < 0) return true;
      const int vert = chains.of(r)[at];
      if (chains.closes(r) && (at < AROUND || at > chains.size(r) - 1 - AROUND)) {
        Scratch spare = memory;
        int* row = spare.room(chains.size(r));
        if (!row) return false;
        chains.turn(r, row);
        for (at = 0; chains.of(r)[at] != vert;) ++at;
      }
      const Edit e = find_edit(r, at, memory);
      if (e.at < 0) tried[vert] = 1;
      else apply(r, e);
      if (!make(memory)) return false;
      look();
    }
    return true;
  }
};

// Plans what is to come apart, along chains that may be other ones then; returns whether there was memory.
template <class S, class P>
PALPATE bool mend(const S& m, const Path& path, const Material& p, const P* pinned, int left, Chains& chains,
                  Plan& plan, Scratch memory) {
  Mender<S, P> mender = {m, path, p, pinned, left, chains, plan,
                         memory.values(chains.most), memory.numbers(m.nvert)};
  return !memory.full && mender.mend(memory);
}

}  // namespace palpate
