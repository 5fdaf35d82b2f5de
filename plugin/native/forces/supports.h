// What an organ rests on: geoms and other organs, by springs of the surface instead of MuJoCo's
// contacts, of which an organ that lies on something has hundreds. Doubles, a thread a node.
//
// A node at depth d in what is below has k d as its force along the normal, k a stiffness times its
// area, and along the surface k times the way that it has slipped (Cundall and Strack 1979,
// doi:10.1680/geot.1979.29.1.47), at most friction times the normal force. Both are taken where the
// present velocity leads; on what the step changes of it the springs act through `hold`.
#pragma once
#include "forces/bodies.h"
#include "core/geom.h"
#include "core/triangle.h"

namespace palpate {

constexpr int ON_NOTHING = -1, ON_GEOM = -2;  // and below, by geoms; others are organs
constexpr int CELLS = 1024;

// n n^T times a, and the rest of the identity times b.
PALPATE Sym along_and_across(D3 n, double a, double b) {
  const double c = a - b;
  return {c * n.x * n.x + b, c * n.x * n.y, c * n.x * n.z,
          c * n.y * n.y + b, c * n.y * n.z, c * n.z * n.z + b};
}

// Writes the force on a node that rests on something, if it does: `depth` in it, its normal and
// velocity. The spring is damped with the time of a step; where it slips it gives way along.
template <class Fields>
PALPATE bool support(const Fields& f, int i, const Place& x, double depth, D3 n, D3 vel, double mu) {
  const double h = f.mj.timestep.data[0], reach = 2.0 * h, k = f.stiffness.data[i];
  const D3 v = x.vel - vel;
  const double fast = dot(v, n), spring = k * (depth - reach * fast);
  const double normal = spring > 0.0 ? spring : 0.0;
  const D3 along = v - fast * n, had = load(f.slip.data + 3 * i);
  const D3 now = had - dot(had, n) * n + h * along, ahead = now + reach * along;
  const double pull = k * norm(ahead), most = mu * normal;
  const double share = pull > most ? most / pull : 1.0;  // 0 where it leaves
  const D3 held = share * ahead;
  store(f.force.data + 3 * i, normal * n - k * held);
  store(f.slipped.data + 3 * i, share < 1.0 ? held - reach * along : now);
  const Sym weight = along_and_across(n, k * h * reach, share * k * h * reach);
  const double all[6] = {weight.xx, weight.xy, weight.xz, weight.yy, weight.yz, weight.zz};
  for (int c = 0; c < 6; ++c) f.hardness.data[6 * i + c] = all[c];
  return true;
}

// What the spring under a node weighs on the change of its velocity, in the world [kg].
template <class Fields>
PALPATE Sym hardness(const Fields& f, int i) {
  const double* p = f.hardness.data + 6 * i;
  return {p[0], p[1], p[2], p[3], p[4], p[5]};
}

// The direction in which the height over a geom grows.
PALPATE D3 up(const double* geom, D3 d, double step) {
  const D3 x = {step, 0, 0}, y = {0, step, 0}, z = {0, 0, step};
  const D3 g = {distance(geom, d + x) - distance(geom, d - x),
                distance(geom, d + y) - distance(geom, d - y),
                distance(geom, d + z) - distance(geom, d - z)};
  const double length = norm(g);
  return length > 0.0 ? (1.0 / length) * g : D3{0, 0, 1};
}

// A geom of mjData as GEOM, in the world's axes.
template <class Fields>
PALPATE void read_geom(const Fields& f, int g, double* geom) {
  const auto* R = f.mj.geom_xmat.data + 9 * g;
  store(geom + GEOM_POS, load(f.mj.geom_xpos.data + 3 * g));
  for (int a = 0; a < 3; ++a) store(geom + GEOM_AXIS + 3 * a, {R[a], R[3 + a], R[6 + a]});
  geom[GEOM_TYPE] = f.mj.geom_type.data[g];
  store(geom + GEOM_SIZE, load(f.mj.geom_size.data + 3 * g));
  store(geom + GEOM_BOX, load(f.mj.geom_aabb.data + 6 * g));
  store(geom + GEOM_HALF, load(f.mj.geom_aabb.data + 6 * g + 3));
}

// Finds what of the geoms each node rests on.
template <class Fields>
PALPATE void find_geoms(const Fields& f, Thread t, int) {
  each_item(t, f.nouter.data[0], [&](int i) { f.on.data[i] = ON_NOTHING; });
  for (int q = 0; q < f.ngeom; ++q) {
    const int g = f.geom.data[q], b = f.mj.geom_bodyid.data[g];
    double geom[GEOM_LENGTH];
    read_geom(f, g, geom);
    const Twist moving = twist(f.mj, b, false);
    each_item(t, f.nouter.data[0], [&](int i) {
      if (f.on.data[i] != ON_NOTHING || !f.free.data[i]) return;
      const Place x = place_of(f.mj, f.own, i);
      const D3 d = x.at - load(geom + GEOM_POS);
      const double depth = f.skin - distance(geom, d);
      if (!(depth > 0.0)) return;
      const D3 n = up(geom, d, 0.1 * f.skin), arm = arm_of(f.mj, b, x.at);
      const D3 vel = velocity_at(moving, arm);
      if (support(f, i, x, depth, n, vel, f.friction.data[q])) f.on.data[i] = ON_GEOM - q;
    });
  }
}

PALPATE int cell(const int* c) {
  return (int)(((unsigned)c[0] * 73856093u ^ (unsigned)c[1] * 19349663u ^ (unsigned)c[2] * 83492791u)
               % CELLS);
}
PALPATE void cell_of(D3 x, double size, int* c) {
  c[0] = (int)floor(x.x / size), c[1] = (int)floor(x.y / size), c[2] = (int)floor(x.z / size);
}

// The node of another organ that is nearest to x, of those in the cells around it; -1 for none.
template <class Fields>
PALPATE int nearest_node(const Fields& f, D3 x) {
  int at[3], best = -1;
  cell_of(x, f.cell.data[0], at);
  double least = f.cell.data[0] * f.cell.data[0];
  for (int k = 0; k < 27; ++k) {
    const int c[3] = {at[0] + k % 3 - 1, at[1] + k / 3 % 3 - 1, at[2] + k / 9 - 1};
    for (int j = f.first.data[cell(c)]; j >= 0; j = f.next.data[j]) {
      const D3 away = load(f.where.data + 3 * j) - x;
      if (dot(away, away) < least) least = dot(away, away), best = j;
    }
  }
  return best;
}

// The point of the triangles around node j that is nearest to x: its triangle, weights, and place.
template <class Fields>
PALPATE int nearest_triangle(const Fields& f, int j, D3 x, D3& weight, D3& point) {
  int best = -1;
  double least = 1e300;
  for (int t = f.near_adr.data[j]; t < f.near_adr.data[j + 1]; ++t) {
    const int* e = f.elem.data + 3 * f.near.data[t];
    const D3 corner[3] = {load(f.where.data + 3 * e[0]), load(f.where.data + 3 * e[1]),
                          load(f.where.data + 3 * e[2])};
    const D3 w = barycentric(x, corner);
    const D3 p = w.x * corner[0] + w.y * corner[1] + w.z * corner[2], away = p - x;
    if (dot(away, away) < least) least = dot(away, away), best = f.near.data[t], weight = w, point = p;
  }
  return best;
}

// Area vector of a node, from where its triangles are.
template <class Fields>
PALPATE D3 normal_at(const Fields& f, int j) {
  D3 sum = {0, 0, 0};
  for (int t = f.near_adr.data[j]; t < f.near_adr.data[j + 1]; ++t) {
    const int* e = f.elem.data + 3 * f.near.data[t];
    const D3 a = load(f.where.data + 3 * e[0]);
    sum += cross(load(f.where.data + 3 * e[1]) - a, load(f.where.data + 3 * e[2]) - a);
  }
  return sum;
}

struct Bounds {
  D3 low = {1e300, 1e300, 1e300}, high = {-1e300, -1e300, -1e300};

  PALPATE void add(D3 x) {
    const D3 zero = {0, 0, 0};
    high = vmax(high, x);
    low = zero - vmax(zero - low, zero - x);
  }
  PALPATE bool has(D3 x, double room) const {
    return x.x > low.x - room && x.y > low.y - room && x.z > low.z - room && x.x < high.x + room
      && x.y < high.y + room && x.z < high.z + room;
  }
};

// Puts the nodes of the other organ that are near this one into cells; returns their bounds.
template <class Fields>
PALPATE Bounds sort_nodes(const Fields& f) {
  Bounds mine, near;
  for (int i = 0; i < f.nouter.data[0]; ++i) mine.add(place_of(f.mj, f.own, i).at);
  for (int c = 0; c < CELLS; ++c) f.first.data[c] = -1;
  for (int j = 0; j < f.nother.data[0]; ++j) {
    const D3 x = place_of(f.mj, f.other, j).at;
    store(f.where.data + 3 * j, x);
    if (!mine.has(x, f.cell.data[0])) continue;
    int c[3];
    cell_of(x, f.cell.data[0], c);
    f.next.data[j] = f.first.data[cell(c)];
    f.first.data[cell(c)] = j;
    near.add(x);
  }
  return near;
}

// Finds where nodes that rest on no geom rest on organ number `which`. Neither organ's step knows
// what the other's changes: each has the spring twice in its matrix, which is stable for both.
template <class Fields>
PALPATE void find_organ(const Fields& f, Thread t, int which) {
  if (t.tid > 0) return;
  const Bounds near = sort_nodes(f);
  for (int i = 0; i < f.nouter.data[0]; ++i) {
    if (f.on.data[i] != ON_NOTHING || !f.free.data[i]) continue;
    const Place x = place_of(f.mj, f.own, i);
    const int j = near.has(x.at, f.cell.data[0]) ? nearest_node(f, x.at) : -1;
    if (j < 0) continue;
    D3 w, point;
    const int best = nearest_triangle(f, j, x.at, w, point);
    if (best < 0) continue;
    const int* e = f.elem.data + 3 * best;
    D3 n = w.x * normal_at(f, e[0]) + w.y * normal_at(f, e[1]) + w.z * normal_at(f, e[2]);
    const double length = norm(n);
    if (!(length > 0.0)) continue;
    n = (1.0 / length) * n;
    const D3 vel = w.x * place_of(f.mj, f.other, e[0]).vel + w.y * place_of(f.mj, f.other, e[1]).vel
      + w.z * place_of(f.mj, f.other, e[2]).vel;
    const double depth = f.skin - dot(x.at - point, n);
    if (!(depth > 0.0) || !support(f, i, x, depth, n, vel, f.mu)) continue;
    f.on.data[i] = which;
    for (int c = 0; c < 6; ++c) f.hardness.data[6 * i + c] *= 2.0;
    store(f.weight.data + 3 * i, w);
    for (int c = 0; c < 3; ++c) f.corner.data[3 * i + c] = e[c];
  }
}

// A symmetric matrix R^T m R.
PALPATE Sym turned_back(const double* R, const Sym& m) {
  const D3 zero = {0, 0, 0};
  const D3 x = add_turned(zero, R, m * D3{R[0], R[3], R[6]});
  const D3 y = add_turned(zero, R, m * D3{R[1], R[4], R[7]});
  const D3 z = add_turned(zero, R, m * D3{R[2], R[5], R[8]});
  return {x.x, x.y, x.z, y.y, y.z, z.z};
}

// Adds what an organ's nodes rest on to its solver's input.
template <class Fields>
PALPATE void press(const Fields& f, Thread t, int) {
  const D3 zero = {0, 0, 0};
  const double* R = f.own.frame.data;
  if (f.restless && t.tid == 0) f.solve.quiet.data[0] = 0.0;
  each_item(t, f.nouter.data[0], [&](int i) {
    if (f.on.data[i] == ON_NOTHING) return;
    push_node(f.solve, f.solve.node.data[i], add_turned(zero, R, load(f.force.data + 3 * i)),
              turned_back(R, hardness(f, i)));
  });
}

// Ends the forces of geoms with what the step made of the nodes' velocities.
template <class Fields>
PALPATE void act_supports(const Fields& f, Thread t, int) {
  const double per_h = 1.0 / f.mj.timestep.data[0];
  each_item(t, f.nouter.data[0], [&](int i) {
    if (f.on.data[i] > ON_GEOM) return;
    const D3 dv = turned(f.own.frame.data,
                         load_lane(f.solve.dvel.data + offset_of(f.solve.node.data[i])));
    store(f.force.data + 3 * i, load(f.force.data + 3 * i) - per_h * (hardness(f, i) * dv));
  });
}

// Lets the geoms' bodies feel them.
template <class Fields>
PALPATE void feel_supports(const Fields& f, Thread t, int) {
  if (t.tid > 0) return;
  const D3 zero = {0, 0, 0};
  for (int q = 0; q < f.ngeom; ++q) {
    const int b = f.mj.geom_bodyid.data[f.geom.data[q]];
    D3 force = zero, torque = zero;
    for (int i = 0; i < f.nouter.data[0]; ++i) {
      if (f.on.data[i] != ON_GEOM - q) continue;
      const D3 push = load(f.force.data + 3 * i);
      force = force - push;
      torque = torque - cross(arm_of(f.mj, b, place_of(f.mj, f.own, i).at), push);
    }
    push_body(f.mj, b, force, torque);
  }
}

// Adds what rests on an organ, which is number `which` of the one above, to its solver's input.
template <class Fields>
PALPATE void bear(const Fields& f, Thread t, int which) {
  if (t.tid > 0) return;
  const double* R = f.other.frame.data;
  f.below.quiet.data[0] = 0.0;
  for (int i = 0; i < f.nouter.data[0]; ++i) {
    if (f.on.data[i] != which) continue;
    const D3 push = add_turned({0, 0, 0}, R, D3{0, 0, 0} - load(f.force.data + 3 * i));
    const Sym weight = turned_back(R, hardness(f, i));
    for (int c = 0; c < 3; ++c) {
      const double share = f.weight.data[3 * i + c];
      push_node(f.below, f.below.node.data[f.corner.data[3 * i + c]], share * push, share * weight);
    }
  }
}

// Keeps how far the nodes have slipped.
template <class Fields>
PALPATE void keep(const Fields& f, Thread t, int) {
  const D3 zero = {0, 0, 0};
  each_item(t, f.nouter.data[0], [&](int i) {
    store(f.slip.data + 3 * i, f.on.data[i] == ON_NOTHING ? zero : load(f.slipped.data + 3 * i));
  });
}

}  // namespace palpate
