// How firm contacts are: as firm as their tissue asks for and a step can bear; MuJoCo's grow softer as
// nodes grow lighter. Under a round or flat-ended tool that is small for the mesh they yield by what
// the mesh cannot.
#pragma once
#include "coupling/contact_rows.h"

namespace palpate {

// How far a mesh yields at a node to a unit force there, times E* and its edges' mean length: that of
// pressed blocks (tests/benchmarks/accuracy/truth.py).
constexpr double SELF = 1.75;

// Edges that a tool's radius has at least, else it is told that the mesh is too coarse.
constexpr double COARSE = 0.05;

// Most that a tool sinks in, in radii.
constexpr double DEEPEST = 0.5;

constexpr double PI = 3.14159265358979;

// Mean length of the edges of the triangle on a side of a contact [m].
template <class Fields>
PALPATE double edge_of(const Fields& f, const char* contact, int side) {
  const int flex = side_of(contact, CONTACT_FLEX, side), elem = side_of(contact, CONTACT_ELEM, side);
  const int* e = f.flex_elem.data + f.flex_elemdataadr.data[flex] + 3 * elem;
  const double* x = f.flexvert_xpos.data + 3 * f.flex_vertadr.data[flex];
  const D3 a = load(x + 3 * e[0]), b = load(x + 3 * e[1]), c = load(x + 3 * e[2]);
  return (norm(b - a) + norm(c - b) + norm(a - c)) / 3.0;
}

// A geom's contacts with an organ's flex, which is on one side of them.
struct Touch { int geom, flex, side; };

PALPATE bool operator==(Touch a, Touch b) { return a.geom == b.geom && a.flex == b.flex; }

template <class Fields>
PALPATE Touch touch_of(const Fields& f, const char* contact) {
  for (int side = 0; side < 2; ++side) {
    const int flex = side_of(contact, CONTACT_FLEX, side);
    const int geom = side_of(contact, CONTACT_GEOM, 1 - side);
    if (geom >= 0 && flex >= 0 && f.mine.data[flex] && f.tissue.data[TISSUE_LENGTH * flex + TISSUE_SHARE] > 0.0)
      return {geom, flex, side};
  }
  return {-1, -1, 0};
}

// How many contacts a flex has, with geoms or with flexes.
PALPATE int count_of(const char* contact, int ncon, int flex, bool geoms) {
  int count = 0;
  for (int c = 0; c < ncon; ++c, contact += CONTACT_LENGTH)
    for (int side = 0; side < 2; ++side)
      if (side_of(contact, CONTACT_FLEX, side) == flex)
        count += (side_of(contact, CONTACT_GEOM, 1 - side) >= 0) == geoms;
  return count;
}

// Whether two triangles of organs touch, neither of which says itself how firm contacts are.
template <class Fields>
PALPATE bool are_organs(const Fields& f, const char* contact) {
  for (int side = 0; side < 2; ++side) {
    const int flex = side_of(contact, CONTACT_FLEX, side);
    if (flex < 0 || side_of(contact, CONTACT_ELEM, side) < 0 || !f.mine.data[flex]) return false;
    if (!(f.tissue.data[TISSUE_LENGTH * flex + TISSUE_FIRM] > 0.0)) return false;
  }
  return true;
}

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
template <class Fields>
PALPATE bool find_dent(const Fields& f, const char* contact, int ncon, Touch touch, Dent& dent) {
  const D3 middle = load(f.geom_xpos.data + 3 * touch.geom);
  const int start = f.flex_vertadr.data[touch.flex];
  for (int c = 0; c < ncon; ++c, contact += CONTACT_LENGTH) {
    if (!(touch_of(f, contact) == touch)) continue;
    const D3 r = load((const double*)(contact + CONTACT_POS)) - middle;
    dent.sink(-*(const double*)(contact + CONTACT_DIST), r,
              load((const double*)(contact + CONTACT_FRAME)));
    dent.edges += edge_of(f, contact, touch.side);
    ++dent.ncon;
    const int* e = f.flex_elem.data + f.flex_elemdataadr.data[touch.flex] +
                   3 * side_of(contact, CONTACT_ELEM, touch.side);
    for (int k = 0; k < 3; ++k)
      if (f.force_adr.data[start + e[k]] >= 0 && !dent.add(start + e[k])) return false;
  }
  return dent.deepest > 0.0;
}

// The force in a dent, and the work of the forces on its nodes, those of the last step, as it is on a
// mesh of E* = 1: a node yields by SELF / edge to its own, by 1 / (pi r) to another at r (Boussinesq).
template <class Fields>
PALPATE double work_of(const Fields& f, const Dent& dent, double& total) {
  D3 sum = {0.0, 0.0, 0.0};
  double work = 0.0;
  for (int i = 0; i < dent.nnode; ++i) {
    const D3 x = load(f.flexvert_xpos.data + 3 * dent.node[i]);
    const D3 force = load(f.plugin_state.data + f.force_adr.data[dent.node[i]]);
    D3 others = {0.0, 0.0, 0.0};
    for (int j = 0; j < i; ++j) {
      const double r = norm(load(f.flexvert_xpos.data + 3 * dent.node[j]) - x);
      others += 2.0 / (PI * r) * load(f.plugin_state.data + f.force_adr.data[dent.node[j]]);
    }
    sum += force;
    work += dot(force, (SELF * dent.ncon / dent.edges) * force + others);
  }
  total = norm(sum);
  return work;
}

// How much less the mesh under a tool yields than a half space would, as a compliance of each of its
// contacts [m/N]. Under a round tool the half space yields by 3 / (4 E* a), a the radius of the contact
// (Hertz), less what the tool rises off its axis; under a flat end by 1 / (2 E* radius).
template <class Fields>
PALPATE double unresolved(const Fields& f, const char* contacts, int ncon, Touch touch) {
  const double* tissue = f.tissue.data + TISSUE_LENGTH * touch.flex;
  const double modulus = tissue[TISSUE_MODULUS];
  const int type = f.geom_type.data[touch.geom];
  const bool round = type == GEOM_IS_SPHERE || type == GEOM_IS_CAPSULE;
  if (!round && type != GEOM_IS_CYLINDER) return 0.0;
  Dent dent;
  if (!find_dent(f, contacts, ncon, touch, dent)) return 0.0;
  const double size = f.geom_size.data[3 * touch.geom], radius = size + f.flex_radius.data[touch.flex];
  if (f.mine.data[touch.flex] > 1 && !f.flags.data[FLAG_COARSE] && radius < COARSE * dent.edges / dent.ncon)
    f.flags.data[FLAG_COARSE] = (int)(2e6 * radius) + 1;
  if (!(modulus > 0.0)) return 0.0;
  double total;
  const double work = work_of(f, dent, total);
  if (!(total > 0.0)) return 0.0;
  double yields = 0.5 / (modulus * size);
  if (round) {
    const double a = cbrt(0.75 * total * radius / modulus);
    yields = 0.75 / (modulus * a) - dent.spread() / (2.0 * radius * total);
  } else {
    const double* R = f.geom_xmat.data + 9 * touch.geom;
    if (fabs(dot(D3{R[2], R[5], R[8]}, dent.normal)) < 0.95 * norm(dent.normal)) return 0.0;
  }
  double lacks = yields - work / (modulus * total * total);
  if (lacks * total > DEEPEST * radius) lacks = DEEPEST * radius / total;  // or a needle falls through
  return lacks > 0.0 ? lacks * dent.gaps / dent.deepest : 0.0;  // contacts in parallel
}

// What the discrete integrator divides R by: what a spring and damper do within the step. It makes rows
// again, from the contact's solref and solimp.
template <class Fields>
PALPATE double within_step(const Fields& f, double stiffness, double damping) {
  const double h = f.timestep.data[0];
  return f.integrator.data[0] == INTEGRATOR_DISCRETE ? 1.0 + h * damping + h * h * stiffness : 1.0;
}

// Gives the rows of a contact a critically damped spring and its R, less what the step takes of it.
template <class Fields>
PALPATE void put_spring(const Fields& f, char* contact, Rows rows, double damping, double R) {
  const double stiffness = 0.25 * damping * damping;
  double* row = datum<double*>(f, DATA_EFC_KBIP) + 4 * rows.first;
  const double now = datum<double*>(f, DATA_EFC_R)[rows.first];
  const double whole = now * within_step(f, row[0] * row[2], row[1]) * row[2] / (1.0 - row[2]);
  double* solref = (double*)(contact + CONTACT_SOLREF);
  double* solimp = (double*)(contact + CONTACT_SOLIMP);
  solref[0] = 2.0 / damping;
  solref[1] = 1.0;
  solimp[0] = solimp[1] = whole / (whole + R);
  scale_impedance(f, rows, R / (within_step(f, stiffness, damping) * now));
  for (int r = 0; r < rows.count; ++r) {
    if (row[4 * r] > 0.0) row[4 * r] = stiffness;
    row[4 * r + 1] = damping;
    row[4 * r + 2] = 1.0;
  }
}

// Makes a contact as firm as its tissue asks for, whatever its nodes weigh, but no firmer than the time
// step can bear; unless the organ says itself how firm it is. It is at least `least` soft [m/N].
//
// At rest its force is gap / compliance with R = compliance * stiffness; the rows of a pyramid have a
// part each. Friction is firmer the shorter the step, since what sticks creeps at a speed in proportion
// to its R; in a pyramid it has no R of its own (MuJoCo, Computation, Constraint model). Done twice it
// does nothing.
template <class Fields>
PALPATE void firm_up(const Fields& f, char* contact, Rows rows, Touch touch, int count, double least) {
  const double* row = datum<double*>(f, DATA_EFC_KBIP) + 4 * rows.first;
  const double* R = datum<double*>(f, DATA_EFC_R) + rows.first;
  const double* friction = (const double*)(contact + CONTACT_FRICTION);
  const double* tissue = f.tissue.data + TISSUE_LENGTH * touch.flex;
  const bool sticks = !rows.paired && rows.count > 1;
  if (tissue[TISSUE_FIRM] > 0.0 && row[2] < 1.0) {
    const double asked = tissue[TISSUE_ASKED];
    // A triangle's corners are of several contacts.
    const double each = side_of(contact, CONTACT_ELEM, touch.side) < 0 ? 1.0 : 1.0 / 3.0;
    const double borne = each * count * tissue[TISSUE_SHARE] +
                         LIGHT * f.body_invweight0.data[2 * f.geom_bodyid.data[touch.geom]];
    const double square = friction[0] * friction[0];
    const double pair = rows.paired ? 2.0 * square * (1.0 + square) / f.impratio.data[0] : 1.0;
    put_spring(f, contact, rows, 2.0 / (SLOW * f.timestep.data[0]), pair * (borne > asked ? borne : asked));
    const double most = tissue[TISSUE_STUCK] * borne;
    if (sticks && R[1] > most) scale_impedance(f, {rows.first + 1, rows.count - 1, false}, most / R[1]);
  }
  const Rows normals = rows.normals();
  const double more = normals.count * row[0] * row[2] * least;
  if (R[0] < more) scale_impedance(f, normals, more / R[0]);
  if (sticks) *(double*)(contact + CONTACT_MU) = friction[0] * sqrt(R[1] / R[0]);
}

// How much of the R that a step can bear organs have which lie on each other: MuJoCo has a contact a
// pair of triangles, and each organ shares its own among them. They are no firmer than MuJoCo's are
// for what they touch, since they jump about.
struct Shared { int flex[2]; double borne; };

template <class Fields>
PALPATE void share_out(const Fields& f, const char* contacts, int ncon, const char* contact, Shared& shared) {
  const int a = side_of(contact, CONTACT_FLEX, 0), b = side_of(contact, CONTACT_FLEX, 1);
  if (shared.flex[0] == a && shared.flex[1] == b) return;
  shared = {{a, b}, 0.0};
  for (int side = 0; side < 2; ++side)
    shared.borne += f.tissue.data[TISSUE_LENGTH * shared.flex[side] + TISSUE_SHARE] *
                    count_of(contacts, ncon, shared.flex[side], false) / 3.0;
}

template <class Fields>
PALPATE void firm_organs(const Fields& f, char* contact, Rows rows, double borne) {
  const double friction = ((const double*)(contact + CONTACT_FRICTION))[0], square = friction * friction;
  const double pair = rows.paired ? 2.0 * square * (1.0 + square) / f.impratio.data[0] : 1.0;
  double least = 0.0;
  for (int side = 0; side < 2; ++side) least += LOOSE * inverse_inertia(f, contact, rows, side);
  put_spring(f, contact, rows, 2.0 / (SLOW * f.timestep.data[0]), pair * (borne > least ? borne : least));
}

}  // namespace palpate
