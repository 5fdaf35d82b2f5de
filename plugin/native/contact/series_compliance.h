// Series compliance: under a round or flat-ended tool that is small for the mesh, contacts yield by what
// the mesh cannot.
//
// The law knows nothing of where contacts lie in memory. It is told of those of one tool with one organ
// by a struct with
//
//   int count() const;                     // contacts to look through
//   bool at(int c, Press& press) const;    // what one of them is, false where it is another tool's
//   bool other(int c, Press& press) const; // place and normal of one of another tool, as if of this one's
//   D3 place(int node) const;              // where a node is [m]
//   D3 force(int node) const;              // contact force on it in the last step [N], in the same axes
#pragma once
#include "core/triangle.h"

namespace palpate {

// Most that a tool sinks in by this, in radii, or a needle would fall through.
constexpr double DEEPEST = 0.75;

// The mean square of a contact's radius, in the area of a node, from which on and up to which the shape of
// a tool takes over.
constexpr double WIDE = 0.08, WIDER = 0.25;

constexpr double PI = 3.14159265358979;

// A contact of a tool with a triangle.
struct Press {
  double gap;         // negative where the tool is in the skin [m]
  D3 pos, normal;     // in the world's axes
  double edge, area;  // mean length of the triangle's edges [m], and its area [m^2]
  int corner[3];      // its nodes, -1 where one has no contact force

  PALPATE void measure(D3 a, D3 b, D3 c) {
    edge = (norm(b - a) + norm(c - b) + norm(a - c)) / 3.0;
    area = 0.5 * norm(cross(b - a, c - a));
  }
};

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
  double edges = 0.0, areas = 0.0, gaps = 0.0, squares = 0.0;  // sums
  double square = 0.0;  // of the way from the tool's middle to its contacts, weighed by their gaps
  D3 way = {0.0, 0.0, 0.0}, normal = {0.0, 0.0, 0.0};  // mean ones, weighed so

  PALPATE void sink(double gap, D3 r, D3 along) {
    if (!(gap > 0.0)) return;
    gaps += gap;
    squares += gap * gap;
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
    dent.areas += press.area;
    ++dent.ncon;
    for (int k = 0; k < 3; ++k)
      if (press.corner[k] >= 0 && !dent.add(press.corner[k])) return false;
  }
  return dent.gaps > 0.0;
}

// How deep a force goes, and what that is less than in proportion to a small change of the force.
struct Sink { double depth, bend; };

// The depth of a force that is the root of (linear d)^2 + (square d^2)^2.
PALPATE Sink sink_of(double force, double linear, double square) {
  const double line = linear * linear, curve = 4.0 * square * square * force * force;
  const double root = sqrt(line * line + curve), depth = force * sqrt(2.0 / (line + root));
  return {depth, 0.5 * depth * curve / (root * (line + root))};
}

// What lies under a tool, and its mesh: a half space, or where E* is 0 a plate on a foundation.
struct Ground {
  double modulus;     // E* [Pa]
  double bearing;     // k [Pa/m]
  double plate;       // s = sqrt(k D) [N/m]
  double taut;        // force over the square of the depth, of a membrane on k alone [N/m^2]
  double edge, area;  // mean length of an edge [m], and a node's area [m^2]

  // How far the mesh yields at a node to a unit force there [m/N]. A solid's as pressed blocks do
  // (tests/benchmarks/accuracy/truth.py). A plate's node bears k times its area and what bending hands to
  // others: fitted to even lattices whose edges are 1/4 to 8 of sqrt(s / k) long, within 6 %.
  PALPATE double at_node() const {
    if (modulus > 0.0) return 1.8 / (modulus * edge);
    const double own = bearing * area;
    return 1.0 / (own + 8.0 * plate * plate / (plate + 0.55 * own));
  }

  // How far it yields to a unit force on a node at a distance [m/N]: of a solid 1 / (pi E* r)
  // (Boussinesq), more beside it; of a plate about -kei(x) / (2 pi s), x the distance in sqrt(s / k).
  PALPATE double beside(double r) const {
    if (modulus > 0.0) return (1.0 + 0.3 * edge * edge / (r * r)) / (PI * modulus * r);
    if (!(plate > 0.0)) return 0.0;
    const double x = r * sqrt(bearing / plate);
    return exp(-0.457 * x * x / sqrt(sqrt(x))) / (8.0 * plate);
  }

  // How far it yields to a tool's force [m]. A half space by 3 F / (4 E* a) to a round one, a the radius
  // of the contact (Hertz), by F / (2 E* radius) to a flat one. A plate's force at depth d is 8 s d for a
  // point (Hertz 1884), pi k radius d^2 for a ball where nothing bends, taut d^2 where it only
  // stretches; the root of their squares' sum is within 4 % of a ball's on a plate (Kelvin functions).
  PALPATE Sink under(const Tool& tool, double force) const {
    const double radius = tool.size + tool.skin, point = 8.0 * plate;
    if (modulus > 0.0 && !tool.is_round()) return {0.5 * force / (modulus * tool.size), 0.0};
    if (modulus > 0.0) return {0.75 * force / (modulus * cbrt(0.75 * force * radius / modulus)), 0.0};
    Sink found = {0.0, 0.0};
    for (int k = 0; k < 2; ++k) {  // a ball pushes less than the paraboloid of its curvature
      const double ball = 1.06 * PI * bearing * radius / (1.0 + found.depth / (1.5 * radius));
      found = sink_of(force, point, sqrt(ball * ball + taut * taut));
    }
    return found;
  }
};

// Whether another tool presses on an organ against this one: what both pinch does not give way by the
// sum of their forces.
template <class Contacts>
PALPATE bool is_pinched(const Contacts& contacts, const Tool& tool, const Dent& dent) {
  const D3 middle = tool.pos + (1.0 / dent.gaps) * dent.way;
  const double reach = tool.size + tool.skin + dent.edges / dent.ncon;
  Press press;
  for (int c = 0; c < contacts.count(); ++c)
    if (contacts.other(c, press) && dot(press.normal, dent.normal) < 0.0 && norm(press.pos - middle) < reach)
      return true;
  return false;
}

// The force in a dent, and the work of the forces on its nodes, those of the last step.
template <class Contacts>
PALPATE double work_of(const Contacts& contacts, const Ground& ground, const Dent& dent, double& total) {
  const double itself = ground.at_node();
  D3 sum = {0.0, 0.0, 0.0};
  double work = 0.0;
  for (int i = 0; i < dent.nnode; ++i) {
    const D3 x = contacts.place(dent.node[i]);
    const D3 force = contacts.force(dent.node[i]);
    D3 others = {0.0, 0.0, 0.0};
    for (int j = 0; j < i; ++j) {
      const double r = norm(contacts.place(dent.node[j]) - x);
      others += 2.0 * ground.beside(r) * contacts.force(dent.node[j]);
    }
    sum += force;
    work += dot(force, itself * force + others);
  }
  total = norm(sum);
  return work;
}

// What a tool's contacts make up for: the compliance of each [m/N], and how much of it they leave to its
// shape, `rounds` of 1.
struct Series { double compliance, rounds; };

// How much less the mesh under a tool yields than its tissue would; `tissue` is the organ's row of
// TISSUE. Under a round tool what the mesh yields by includes that contacts rise off its axis.
//
// Where a skin's nodes are too heavy to move within a step, a compliance that falls faster than the
// force grows would run away from it: it is no less than what makes both alike. Where the contact is
// wider than an edge that is more than the mesh lacks, which then follows from the tool's shape.
template <class Contacts>
PALPATE Series unresolved(const Contacts& contacts, const Tool& tool, const Dent& dent, const double* tissue) {
  const Ground ground = {tissue[TISSUE_MODULUS], tissue[TISSUE_BEARING], tissue[TISSUE_PLATE],
                         tissue[TISSUE_TAUT], dent.edges / dent.ncon, 2.0 * dent.areas / dent.ncon};
  if (!(ground.modulus > 0.0 || (ground.bearing > 0.0 && tool.is_round()))) return {0.0, 0.0};
  // With its end: level, or the round one of a capsule.
  const double upright = tool.type == GEOM_IS_SPHERE ? 0.0 : tool.is_round() ? 0.3 : 0.95;
  if (fabs(dot(tool.axis, dent.normal)) < upright * norm(dent.normal)) return {0.0, 0.0};
  if (is_pinched(contacts, tool, dent)) return {0.0, 0.0};
  double total;
  const double work = work_of(contacts, ground, dent, total), radius = tool.size + tool.skin;
  if (!(total > 0.0 && work > 0.0)) return {0.0, 0.0};
  const double spread = tool.is_round() ? dent.spread() : 0.0;
  const Sink tissues = ground.under(tool, total), meshes = sink_of(total, total * total / work, ground.taut);
  double lacks = tissues.depth - spread / (2.0 * radius) - meshes.depth;
  double rounds = 0.0;
  if (ground.bearing > 0.0) {
    const double least = tissues.bend - meshes.bend, wide = (spread / ground.area - WIDE) / (WIDER - WIDE);
    rounds = wide < 0.0 ? 0.0 : wide < 1.0 ? wide : 1.0;
    if (lacks < least) lacks = least;
    lacks *= 1.0 - rounds;
  }
  const double shared = dent.gaps * dent.gaps / (dent.squares * total);  // contacts in parallel
  return {lacks > 0.0 ? lacks * shared : 0.0, rounds};
}

// How far the touched point of a triangle lies inside of a round tool on whose surface its corners are [m].
PALPATE double rise(const D3* x, D3 touched, double radius) {
  const D3 w = barycentric(touched, x), middle = blend(x, w);
  const D3 a = x[0] - middle, b = x[1] - middle, c = x[2] - middle;
  return (w.x * dot(a, a) + w.y * dot(b, b) + w.z * dot(c, c)) / (2.0 * radius);
}

// A contact's force at depth g is g / `secant`, and grows by 1 / `tangent` [m/N].
struct Stiff { double secant, tangent; };

// A contact of a compliance is ever firmer as a tool sinks in: its force is g / (soft (1 - x^4)) at depth
// g, x = g / (DEEPEST radius).
PALPATE Stiff stiffened(double gap, double radius, double soft) {
  const double x = gap < 0.0 ? -gap / (DEEPEST * radius) : 0.0, y = x < 0.995 ? x * x * x * x : 0.98;
  return {(1.0 - y) * soft, (1.0 - y) * (1.0 - y) * soft / (1.0 + 3.0 * y)};
}

}  // namespace palpate
