// What vertices, triangles and hinges of a surface have in `Shape` and `Tissue`: rows of fans, of elements,
// of hinges and of the bending matrix. Each is a function of the surface alone, and so are its bits.
#pragma once
#include "tissue/plate.h"

namespace palpate {

// An offset of `size` components of a slice's lane, as order.py has it.
PALPATE int offset_in(int index, int size) { return index / LANES * size * LANES + index % LANES; }

// The fan of a vertex: entry 0 is the last neighbour again where it closes, and the first one follows the
// last.
template <class S>
struct Fan {
  const S& m;
  int v, degree;
  bool wraps;

  PALPATE Fan(const S& m, int v) : m(m), v(v), degree((int)m.degree[v]) {
    wraps = degree > 0 && m.half(v, degree - 1) >= 0;
  }
  PALPATE int vert(int k) const {
    if (k >= 1 && k <= degree) return m.neighbour(v, k - 1);
    return !wraps ? -1 : k == 0 ? m.neighbour(v, degree - 1) : k == degree + 1 ? m.neighbour(v, 0) : -1;
  }
  PALPATE int half(int k) const {
    if (k >= 1 && k <= degree) return m.half(v, k - 1);
    return wraps && k == 0 ? m.half(v, degree - 1) : -1;
  }
};

// The triangle of an entry of a fan: its metric, its volume, and the strength of a spring of it.
template <class F>
PALPATE double put_metric(const F& f, int row, int lane, int half, D3 e1, D3 e2) {
  float* metric = f.fan_metric.data + 5 * LANES * row + lane;
  for (int c = 0; c < 5; ++c) metric[LANES * c] = 0.0f;
  if (half < 0) return 0.0;
  const double g11 = dot(e1, e1), g12 = dot(e1, e2), g22 = dot(e2, e2), det = g11 * g22 - g12 * g12;
  const double volume = 0.5 * sqrt(det) * f.thickness;
  const double has[5] = {g22 / det, -g12 / det, g11 / det, f.shear.data[half / 3] * volume,
                         f.lame.data[half / 3] * volume};
  for (int c = 0; c < 5; ++c) metric[LANES * c] = (float)has[c];
  return f.young.data[half / 3] * volume;
}

// Whether the edge between two entries of a fan was cut.
template <class S>
PALPATE bool is_cut(const S& m, int before, int after) {
  if ((before < 0) == (after < 0)) return false;
  return m.whole_twin[after >= 0 ? after : last_half(before)] >= 0;
}

// The rows of stiffness blocks of a slice that one of its nodes has a neighbour in.
template <class F>
PALPATE int used_rows(const F& f, int s) {
  float most = 0.0f;
  for (int lane = 0; lane < LANES; ++lane) {
    const float degree = f.degree.data[LANES * s + lane];
    most = degree > most ? degree : most;
  }
  return (int)most;
}

// The neighbours of a vertex, and where it is.
template <class F, class S>
PALPATE void put_neighbours(const F& f, const S& m, int v) {
  const Fan<S> fan(m, v);
  const int own = f.node.data[v], s = own / LANES, lane = own % LANES, begin = f.slot_adr.data[s];
  const int width = f.slot_adr.data[s + 1] - begin;
  const D3 centre = load(f.centre.data), here = m.place(v) - centre, zero = {0.0, 0.0, 0.0};
  for (int k = 0; k < width + 2; ++k) {
    const int other = fan.vert(k), row = begin + 2 * s + k;
    f.fan_node.data[LANES * row + lane] = offset_in(other < 0 ? own : f.node.data[other], 3);
    store_lane(f.fan_rest.data + 3 * LANES * row + lane, other < 0 ? zero : m.place(other) - centre - here);
  }
  f.degree.data[own] = (float)fan.degree;
  f.fan_width.data[s] = used_rows(f, s);
  store_lane(f.rest.data + offset_in(own, 3), here);
  f.free.data[own] = f.pinned.data[v] || fan.degree == 0 ? 0.0f : 1.0f;
}

template <class F, class S>
PALPATE void put_fan(const F& f, const S& m, int v) {
  const Fan<S> fan(m, v);
  const int own = f.node.data[v], s = own / LANES, lane = own % LANES, begin = f.slot_adr.data[s];
  const int width = f.slot_adr.data[s + 1] - begin;
  const D3 centre = load(f.centre.data), here = m.place(v) - centre, zero = {0.0, 0.0, 0.0};
  D3 last = zero, toward = zero;
  double strength = 0.0;
  put_neighbours(f, m, v);
  for (int k = 0; k < width + 2; ++k) {
    const int other = fan.vert(k);
    last = toward, toward = other < 0 ? zero : m.place(other) - centre - here;
    if (k == 0) continue;
    // The triangle between the last entry and this one, and where it is the second the edge between.
    const int half = fan.half(k - 1), corner = half < 0 ? 0 : half, tri = begin + s + k - 1;
    f.fan_corner.data[LANES * tri + lane] = offset_in(corner / 3, 4);
    f.fan_side.data[LANES * tri + lane] = offset_in(corner / 3, 3) + corner % 3 * LANES;
    const double before = strength, length2 = dot(last, last);
    strength = put_metric(f, tri, lane, half, last, toward);
    if (k == 1) continue;
    double spring = (before + strength) / (length2 > 0.0 ? length2 : 1.0);
    if (f.springs) spring = f.stiffness * (is_cut(m, fan.half(k - 2), half) ? 0.5 : 1.0);
    f.fan_spring.data[LANES * (begin + k - 2) + lane] = k - 2 < fan.degree ? (float)spring : 0.0f;
  }
}

// The area that the foundation holds around a vertex.
template <class F, class S>
PALPATE void put_area(const F& f, const S& m, int v) {
  f.area.data[f.node.data[v]] = (float)area_around(m, v, f.surface.loose.data);
}

// The number of the hinge of a half-edge: that which it had before the first cut.
template <class F, class S>
PALPATE int hinge_at(const F& f, const S& m, int half, int none) {
  return m.twin[half] >= 0 ? f.hinge_of.data[half] : none;
}

template <class F, class S>
PALPATE void put_element(const F& f, const S& m, int t) {
  const int at = 3 * LANES * (t / LANES) + t % LANES;
  const D3 centre = load(f.centre.data), first = m.place((int)m.elem[3 * t]) - centre;
  for (int c = 0; c < 3; ++c) {
    f.elem_node.data[at + LANES * c] = offset_in(f.node.data[m.elem[3 * t + c]], 3);
    f.elem_hinge.data[at + LANES * c] = hinge_at(f, m, 3 * t + (c + 1) % 3, f.nhinge);
  }
  float* arm = f.elem_rest.data + 6 * LANES * (t / LANES) + t % LANES;
  store_lane(arm, m.place((int)m.elem[3 * t + 1]) - centre - first);
  store_lane(arm + 3 * LANES, m.place((int)m.elem[3 * t + 2]) - centre - first);
}

// Plates of triangles, as they are asked for; those that there is no room for are made again.
template <class F, class S>
struct Plates {
  const F& f;
  const S& m;
  Few known;
  Plate *plate, more;
  int room;

  PALPATE const Plate& of(int t) {
    const bool keeps = known.count < room;
    if (known.has(t)) return plate[known.place[t] - 1];
    if (keeps) known.put(t);
    Plate& out = keeps ? plate[known.count - 1] : more;
    return out = plate_of(m, t, f.rigidity.data[t], f.poisson, f.coarse);
  }
};

// A hinge of the whole surface by a half-edge of it: nothing where it was cut.
template <class F, class S, class P>
PALPATE void put_hinge(const F& f, const S& m, int half, P& plates) {
  const int n = f.hinge_of.data[half], row = n / LANES, lane = n % LANES, other = (int)m.twin[half];
  const int left = half < other ? half : other, right = half < other ? other : half;
  int* vert = f.hinge_node.data + 4 * LANES * row + lane;
  int* elem = f.hinge_elem.data + 2 * LANES * row + lane;
  int* near = f.hinge_near.data + 4 * LANES * row + lane;
  float* arm = f.hinge_rest.data + 9 * LANES * row + lane;
  double gain[5] = {0.0, 0.0, 0.0, 0.0, 0.0};
  if (other < 0) {
    for (int c = 0; c < 9; ++c) arm[LANES * c] = 0.0f;
    for (int c = 0; c < 4; ++c) vert[LANES * c] = near[LANES * c] = 0;
    elem[0] = elem[LANES] = 0;
  } else {
    const int at[4] = {m.from(left), m.to(left), m.opposite(left), m.opposite(right)};
    const D3 centre = load(f.centre.data), start = m.place(at[0]) - centre;
    for (int c = 0; c < 4; ++c) vert[LANES * c] = offset_in(f.node.data[at[c]], 3);
    for (int c = 1; c < 4; ++c) store_lane(arm + 3 * LANES * (c - 1), m.place(at[c]) - centre - start);
    for (int side = 0; side < 2; ++side) {
      const int h = side ? right : left, c = h % 3;
      const Plate& p = plates.of(h / 3);
      elem[LANES * side] = offset_in(h / 3, 4);
      gain[0] += p.gain[c][c];
      for (int k = 0; k < 2; ++k) {
        const int d = (c + 1 + k) % 3, beside = hinge_at(f, m, h - c + d, n);
        near[LANES * (2 * side + k)] = beside;
        gain[1 + 2 * side + k] = beside == n ? 0.0 : p.gain[c][d];
      }
    }
  }
  float* out = f.hinge_gain.data + 5 * LANES * row + lane;
  for (int c = 0; c < 5; ++c) out[LANES * c] = (float)gain[c];
}

// The vertices of a triangle's plate: its corners and the apexes beside it, -1 for none.
template <class S>
PALPATE void patch_of(const S& m, int t, int* vert) {
  const bool any = m.twin[3 * t] >= 0 || m.twin[3 * t + 1] >= 0 || m.twin[3 * t + 2] >= 0;
  for (int c = 0; c < 3; ++c) {
    const int other = (int)m.twin[3 * t + c];
    vert[c] = any ? (int)m.elem[3 * t + c] : -1;
    vert[3 + c] = other < 0 ? -1 : m.opposite(other);
  }
}

// A row of the bending matrix: its plates, ascending, and its columns in the order of their nodes. Scratch
// has room for all of them; `place` says where a vertex is among the columns, from 1.
struct BendRow {
  int *elem, nelem, *vert, count;
  double* value;
  int* place;

  PALPATE void clear() {
    for (int k = 0; k < count; ++k) place[vert[k]] = 0;
    count = 0;
  }
};

template <class S>
PALPATE BendRow bend_row(const S& m, Scratch& memory) {
  const int most = 8 * m.most;
  int *elem = memory.numbers(most), *vert = memory.numbers(most);
  double* value = memory.values(most);
  return {elem, 0, vert, 0, value, memory.numbers(m.nvert)};
}

// Finds the triangles whose plates a vertex is in, ascending; returns how many.
template <class S>
PALPATE int plates_of(const S& m, int v, int* elem) {
  int count = 0;
  for (int k = 0; k < m.degree[v]; ++k) {
    const int h = m.half(v, k), beyond = h < 0 ? -1 : (int)m.twin[next_half(h)];
    const int found[2] = {h < 0 ? -1 : h / 3, beyond < 0 ? -1 : beyond / 3};
    for (int i = 0; i < 2; ++i) {
      int at = count;
      bool is_there = found[i] < 0;
      for (int j = 0; j < count; ++j) is_there = is_there || elem[j] == found[i];
      if (is_there) continue;
      for (++count; at > 0 && elem[at - 1] > found[i]; --at) elem[at] = elem[at - 1];
      elem[at] = found[i];
    }
  }
  return count;
}

template <class F, class S>
PALPATE void find_columns(const F& f, const S& m, int v, BendRow& row) {
  row.clear();
  row.nelem = plates_of(m, v, row.elem);
  for (int i = 0; i < row.nelem; ++i) {
    int patch[6];
    patch_of(m, row.elem[i], patch);
    bool mine = false;
    for (int c = 0; c < 6; ++c) mine = mine || patch[c] == v;
    for (int c = 0; c < 6 && mine; ++c)
      if (patch[c] >= 0 && !row.place[patch[c]]) row.vert[row.count++] = patch[c], row.place[patch[c]] = 1;
  }
  for (int k = 1; k < row.count; ++k) {
    const int vert = row.vert[k], node = f.node.data[vert];
    int at = k;
    for (; at > 0 && f.node.data[row.vert[at - 1]] > node; --at) row.vert[at] = row.vert[at - 1];
    row.vert[at] = vert;
  }
  for (int k = 0; k < row.count; ++k) row.place[row.vert[k]] = k + 1;
}

// Adds up a row: the angles' stiffness of each plate, on the displacements of its patch.
template <class S, class P>
PALPATE void sum_row(const S& m, int v, BendRow& row, P& plates) {
  for (int k = 0; k < row.count; ++k) row.value[k] = 0.0;
  for (int n = 0; n < row.nelem; ++n) {
    int patch[6];
    patch_of(m, row.elem[n], patch);
    const Plate& p = plates.of(row.elem[n]);
    double angle[3][6] = {};
    for (int c = 0; c < 3; ++c)
      for (int k = 0; k < 4; ++k) angle[c][k < 3 ? (c + k) % 3 : 3 + c] = p.weight[c][k];
    for (int i = 0; i < 6; ++i) {
      if (patch[i] != v) continue;
      double force[3] = {0.0, 0.0, 0.0};
      for (int d = 0; d < 3; ++d)
        for (int c = 0; c < 3; ++c) force[d] += angle[c][i] * p.gain[c][d];
      for (int j = 0; j < 6; ++j) {
        if (patch[j] < 0) continue;
        const int k = row.place[patch[j]] - 1;
        row.value[k] += force[0] * angle[0][j] + force[1] * angle[1][j] + force[2] * angle[2][j];
      }
    }
  }
}

// The rows of a slice of the bending matrix that one of its nodes has an entry in: others lead to itself.
template <class F>
PALPATE int used_bends(const F& f, int s) {
  const int begin = f.bend_adr.data[s];
  for (int row = f.bend_adr.data[s + 1]; row > begin; --row)
    for (int lane = 0; lane < LANES; ++lane) {
      const int at = LANES * (row - 1) + lane;
      if (f.bend_gain.data[at] != 0.0f || f.bend_node.data[at] != LANES * s + lane) return row - begin;
    }
  return 0;
}

template <class F, class S, class P>
PALPATE void put_bending(const F& f, const S& m, int v, BendRow& row, P& plates) {
  const int own = f.node.data[v], s = own / LANES, lane = own % LANES, begin = f.bend_adr.data[s];
  find_columns(f, m, v, row);
  sum_row(m, v, row, plates);
  f.bend_diag.data[own] = 0.0f;
  for (int k = 0; k < f.bend_adr.data[s + 1] - begin; ++k) {
    const bool has = k < row.count;
    f.bend_node.data[LANES * (begin + k) + lane] = has ? f.node.data[row.vert[k]] : own;
    f.bend_gain.data[LANES * (begin + k) + lane] = has ? (float)row.value[k] : 0.0f;
    if (has && row.vert[k] == v) f.bend_diag.data[own] = (float)row.value[k];
  }
  f.bend_width.data[s] = used_bends(f, s);
}

// Writes the rows of what has a triangle near those that changed.
template <class F, class S>
PALPATE bool write_rows(const F& f, const S& m, Scratch& memory) {
  Few touched = few(memory, m.nvert), vert = few(memory, m.nvert), near = few(memory, m.nelem);
  Few known = few(memory, m.nelem);
  BendRow row = bend_row(m, memory);
  for (int v = 0; v < m.nvert && f.every; ++v) touched.put(v);
  for (int i = 0; i < f.nchanged; ++i) {
    const int t = f.changed.data[i];
    for (int c = 0; c < 3; ++c) {
      touched.put((int)m.elem[3 * t + c]);
      touched.put((int)f.before.data[3 * i + c]);
    }
  }
  // A triangle's plate is that of the patch of it and its neighbours.
  int own = 0;
  for (int ring = 0; ring < 2 && f.bends; ++ring) {
    const int n = ring ? near.count : f.nchanged;
    for (int i = 0; i < n; ++i) {
      const int t = ring ? near.list[i] : f.changed.data[i];
      near.put(t);
      for (int h = 3 * t; h < 3 * t + 3; ++h)
        if (m.whole_twin[h] >= 0) near.put((int)m.whole_twin[h] / 3);
    }
    own = ring ? own : near.count;
  }
  for (int i = 0; i < 3 * near.count; ++i) vert.put((int)m.elem[3 * near.list[i / 3] + i % 3]);
  for (int i = 0; i < 3 * f.nchanged && f.bends; ++i) vert.put(f.before.data[i]);
  for (int i = 0; i < vert.count; ++i) {
    const int s = f.node.data[vert.list[i]] / LANES;
    find_columns(f, m, vert.list[i], row);
    if (row.count > f.bend_adr.data[s + 1] - f.bend_adr.data[s]) return false;
  }
  for (int i = 0; i < touched.count; ++i) put_fan(f, m, touched.list[i]);
  for (int i = 0; i < touched.count && !f.loosened; ++i) put_area(f, m, touched.list[i]);
  for (int v = 0; v < m.nvert && f.loosened; ++v) put_area(f, m, v);
  const int each = sizeof(Plate) / sizeof(double), room = memory.nreal / each;
  Plates<F, S> plates = {f, m, known, (Plate*)memory.values(room * each), {}, room};
  for (int i = 0; i < own; ++i) {
    put_element(f, m, near.list[i]);
    for (int h = 3 * near.list[i]; h < 3 * near.list[i] + 3; ++h)
      if (m.whole_twin[h] >= 0) put_hinge(f, m, h, plates);
  }
  for (int i = 0; i < vert.count; ++i) put_bending(f, m, vert.list[i], row, plates);
  return true;
}

// Counts the entries of each vertex's row of the bending matrix.
template <class Fields>
PALPATE void count_bends(const Fields& f, Thread t, int) {
  if (t.tid) return;
  const auto m = surface_of(f.surface);
  Scratch memory = {f.ints.data, f.reals.data, f.nint, f.nreal, false};
  BendRow row = bend_row(m, memory);
  for (int v = 0; v < m.nvert; ++v) {
    find_columns(f, m, v, row);
    f.count.data[v] = row.count;
  }
}

// The same with the arrays that are written to some words on, all of which are of 32 bits.
template <class F>
PALPATE F skipped(F f) {
  const auto n = f.skip;
  f.fan_node.data += n, f.fan_rest.data += n, f.fan_corner.data += n, f.fan_side.data += n;
  f.degree.data += n, f.rest.data += n, f.area.data += n, f.free.data += n;
  f.elem_node.data += n, f.elem_rest.data += n, f.elem_hinge.data += n;
  f.hinge_node.data += n, f.hinge_rest.data += n, f.hinge_elem.data += n, f.hinge_near.data += n;
  f.bend_node.data += n, f.fan_metric.data += n, f.fan_spring.data += n;
  f.fan_width.data += n, f.bend_width.data += n;
  f.hinge_gain.data += n, f.bend_gain.data += n, f.bend_diag.data += n;
  return f;
}

// Writes the rows; `found` says whether the bending matrix had room, nothing was written otherwise.
template <class Fields>
PALPATE void fill_rows(const Fields& fields, Thread t, int) {
  if (t.tid) return;
  const Fields f = skipped(fields);
  const auto m = surface_of(f.surface);
  Scratch memory = {f.ints.data, f.reals.data, f.nint, f.nreal, false};
  f.found.data[0] = write_rows(f, m, memory);
}

}  // namespace palpate
