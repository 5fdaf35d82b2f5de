// Series compliance: under a round or flat-ended tool that is small for the mesh, contacts yield by what
// the mesh cannot.
//
// The law knows nothing of where contacts lie in memory. It is told of those of one tool with one organ
// by a struct with
//
//   int count() const;                     // contacts to look through
//   bool at(int c, Press& press) const;    // what one of them is, false where it is another tool's
//   D3 place(int node) const;              // where a node is [m]
//   D3 force(int node) const;              // contact force on it in the last step [N], in the same axes
#pragma once
#include "core/d3.h"

namespace palpate {

// How far a mesh yields at a node to a unit force there, times E* and its edges' mean length: that of
// pressed blocks (tests/benchmarks/accuracy/truth.py).
constexpr double SELF = 1.75;

// Most that a tool sinks in, in radii.
constexpr double DEEPEST = 0.5;

constexpr double PI = 3.14159265358979;

// A contact of a tool with a triangle.
struct Press {
  double gap;      // negative where the tool is in the skin [m]
  D3 pos, normal;  // in the world's axes
  double edge;     // mean length of the triangle's edges [m]
  int corner[3];   // its nodes, -1 where one has no contact force
};

// The mean length of the edges of a triangle.
PALPATE double mean_edge(D3 a, D3 b, D3 c) { return (norm(b - a) + norm(c - b) + norm(a - c)) / 3.0; }

// A tool, in the world's axes.
struct Tool {
  int type;     // mjtGeom
  D3 pos, axis; // its middle, and the axis of a cylinder
  double size;  // its radius [m]
  double skin;  // the organ's radius, around its triangles [m]

  PALPATE bool is_round() const { return type == GEOM_IS_SPHERE || type == GEOM_IS_CAPSULE; }
  PALPATE bool is_known() const { return is_round() || type == GEOM_IS_CYLINDER; }
};

// What a tool presses in: the corners of the triangles that it touches, and how it lies in them.
struct Dent {
  static constexpr int MOST = 64;
  int node[MOST], nnode = 0, ncon = 0;
  double edges = 0.0, deepest = 0.0, gaps = 0.0;
  double square = 0.0;  // of the way from the tool's middle to its contacts, weighed by their gaps
  D3 way = {0.0, 0.0, 0.0}, normal = {0.0, 0.0, 0.0};  // mean ones, weighed so

  PALPATE void sink(double gap, D3 r, D3 along) {
    if (gap > deepest) deepest = gap;
    if (!(gap > 0.0)) return;
    gaps += gap;
    square += gap * dot(r, r);
    way += gap * r;
    normal += gap * along;
  }

  PALPATE bool add(int vert) {
    for (int q = 0; q < nnode; ++q)
      if (node[q] == vert) return true;
    if (nnode == MOST) return false;
    node[nnode++] = vert;
    return true;
  }

  // The mean square of the contacts' distances from the middle of the dent.
  PALPATE double spread() const { return square / gaps - dot(way, way) / (gaps * gaps); }
};

// Looks at the dent of a tool; returns whether it is one of few nodes.
template <class Contacts>
PALPATE bool find_dent(const Contacts& contacts, const Tool& tool, Dent& dent) {
  Press press;
  for (int c = 0; c < contacts.count(); ++c) {
    if (!contacts.at(c, press)) continue;
    dent.sink(-press.gap, press.pos - tool.pos, press.normal);
    dent.edges += press.edge;
    ++dent.ncon;
    for (int k = 0; k < 3; ++k)
      if (press.corner[k] >= 0 && !dent.add(press.corner[k])) return false;
  }
  return dent.deepest > 0.0;
}

// The force in a dent, and the work of the forces on its nodes, those of the last step, as it is on a
// mesh of E* = 1: a node yields by SELF / edge to its own, by 1 / (pi r) to another at r (Boussinesq).
template <class Contacts>
PALPATE double work_of(const Contacts& contacts, const Dent& dent, double& total) {
  D3 sum = {0.0, 0.0, 0.0};
  double work = 0.0;
  for (int i = 0; i < dent.nnode; ++i) {
    const D3 x = contacts.place(dent.node[i]);
    const D3 force = contacts.force(dent.node[i]);
    D3 others = {0.0, 0.0, 0.0};
    for (int j = 0; j < i; ++j) {
      const double r = norm(contacts.place(dent.node[j]) - x);
      others += 2.0 / (PI * r) * contacts.force(dent.node[j]);
    }
    sum += force;
    work += dot(force, (SELF * dent.ncon / dent.edges) * force + others);
  }
  total = norm(sum);
  return work;
}

// How much less the mesh under a tool yields than a half space would, as a compliance of each of its
// contacts [m/N]; `tissue` is the organ's row of TISSUE. Under a round tool the half space yields by
// 3 / (4 E* a), a the radius of the contact (Hertz), less what the tool rises off its axis; under a flat
// end by 1 / (2 E* radius).
template <class Contacts>
PALPATE double unresolved(const Contacts& contacts, const Tool& tool, const Dent& dent, const double* tissue) {
  const double modulus = tissue[TISSUE_MODULUS], radius = tool.size + tool.skin;
  if (!(modulus > 0.0)) return 0.0;
  double total;
  const double work = work_of(contacts, dent, total);
  if (!(total > 0.0)) return 0.0;
  double yields = 0.5 / (modulus * tool.size);
  if (tool.is_round()) {
    const double a = cbrt(0.75 * total * radius / modulus);
    yields = 0.75 / (modulus * a) - dent.spread() / (2.0 * radius * total);
  } else if (fabs(dot(tool.axis, dent.normal)) < 0.95 * norm(dent.normal)) {
    return 0.0;
  }
  double lacks = yields - work / (modulus * total * total);
  if (lacks * total > DEEPEST * radius) lacks = DEEPEST * radius / total;  // or a needle falls through
  return lacks > 0.0 ? lacks * dent.gaps / dent.deepest : 0.0;  // contacts in parallel
}

}  // namespace palpate
