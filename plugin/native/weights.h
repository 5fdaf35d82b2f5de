// Contacts with triangles: a contact acts on the corners of a triangle by the barycentric weights of
// where it is. MuJoCo 3.17 weighs them by inverse distance, as if the contact were at another point.
// Its rows are made when this runs, their reference accelerations are not.
//
// Contacts are as firm as their tissue asks for: MuJoCo's grow softer as nodes grow lighter. Under a
// round or flat-ended tool that is small for the mesh they yield by what the mesh cannot.
//
// And contacts that slide stay closed. MuJoCo's friction is convex: a sliding contact parts, by its
// friction times how fast it is braked. On light nodes that lifts a tool off within a step, and the
// force flickers.
#pragma once
#include "triangle.h"

namespace palpate {

// How far a mesh yields at a node to a unit force there, times E* and its edges' mean length: that of
// pressed blocks (tests/benchmarks/truth.py).
constexpr double SELF = 1.75;

// Edges that a tool's radius has at least, else it is told that the mesh is too coarse.
constexpr double COARSE = 0.25;

// Most that a tool sinks in, in radii.
constexpr double DEEPEST = 0.5;

constexpr double PI = 3.14159265358979;

// A field of mjData: those in its arena are elsewhere in each step.
template <class T, class Fields>
PALPATE T& datum(const Fields& f, int offset) {
  return *(T*)((char*)f.memory.data + offset);
}
PALPATE double* pos_of(char* contact) { return (double*)(contact + CONTACT_POS); }
PALPATE int side_of(const char* contact, int field, int side) {
  return ((const int*)(contact + field))[side];
}

// The rows of a contact in efc_J: how many, and which.
struct Rows { int first, count; bool paired; };

// The rows of a contact; none where MuJoCo left it out.
template <class Fields>
PALPATE Rows rows_of(const Fields& f, const char* contact) {
  const int first = side_of(contact, CONTACT_EFC_ADDRESS, 0), dim = side_of(contact, CONTACT_DIM, 0);
  if (first < 0 || side_of(contact, CONTACT_EXCLUDE, 0)) return {0, 0, false};
  const int type = datum<int*>(f, DATA_EFC_TYPE)[first];
  const bool paired = type == CONTACT_PYRAMIDAL;
  const int count = paired ? 2 * (dim - 1) : type == CONTACT_ELLIPTIC ? dim : 1;
  if (first + count > datum<int>(f, DATA_NEFC)) return {0, 0, false};
  return {first, count, paired};
}

// Whether MuJoCo's rows have all columns.
template <class Fields>
PALPATE bool is_dense(const Fields& f) {
  const int jacobian = f.jacobian.data[0];
  return jacobian == JACOBIAN_DENSE || (jacobian == JACOBIAN_AUTO && f.nv < SPARSE_FROM);
}

// Where a row has the column of a dof, or null.
template <class Fields>
PALPATE double* column(const Fields& f, int row, int dof) {
  double* J = datum<double*>(f, DATA_EFC_J);
  if (is_dense(f)) return J + (long long)f.nv * row + dof;
  const int start = datum<int*>(f, DATA_EFC_J_ROWADR)[row];
  const int count = datum<int*>(f, DATA_EFC_J_ROWNNZ)[row];
  const int* colind = datum<int*>(f, DATA_EFC_J_COLIND) + start;
  for (int k = 0; k < count; ++k)
    if (colind[k] == dof) return J + start + k;
  return nullptr;
}

// Where a row has the three columns of a vertex' body, or null.
template <class Fields>
PALPATE double* columns(const Fields& f, int row, int body) {
  return f.body_dofnum.data[body] == 3 ? column(f, row, f.body_dofadr.data[body]) : nullptr;
}

// The weight that the rows give to a body: the length of its part of the normal's row, which is the
// mean of a pair where the cone is a pyramid.
template <class Fields>
PALPATE double weight_of(const Fields& f, Rows rows, int body, double otherwise) {
  const double* a = columns(f, rows.first, body);
  if (!a) return otherwise;
  return rows.paired ? 0.5 * norm(load(a) + load(columns(f, rows.first + 1, body))) : norm(load(a));
}

// The approximate inverse inertia that a side adds to a contact's, by its weights in the rows.
template <class Fields>
PALPATE double inverse_inertia(const Fields& f, const char* contact, Rows rows, int side) {
  const int geom = side_of(contact, CONTACT_GEOM, side), flex = side_of(contact, CONTACT_FLEX, side);
  if (geom >= 0) return f.body_invweight0.data[2 * f.geom_bodyid.data[geom]];
  const int* body = f.flex_vertbodyid.data + f.flex_vertadr.data[flex];
  const int vert = side_of(contact, CONTACT_VERT, side), n = f.flex_dim.data[flex] + 1;
  if (vert >= 0) return f.body_invweight0.data[2 * body[vert]];
  const int* e = f.flex_elem.data + f.flex_elemdataadr.data[flex] +
                 n * side_of(contact, CONTACT_ELEM, side);
  double sum = 0.0;  // corners that are no dofs of their own are one rigid body, or pinned
  for (int k = 0; k < n; ++k)
    sum += weight_of(f, rows, body[e[k]], 1.0 / n) * f.body_invweight0.data[2 * body[e[k]]];
  return sum;
}

// The least R of a contact that a side can bear: in the inverse inertia of a geom, or of an organ's
// vertex; more where a step is long, or moves a vertex of stiff tissue by much less than a free one.
template <class Fields>
PALPATE double borne_by(const Fields& f, const char* contact, int side) {
  const int geom = side_of(contact, CONTACT_GEOM, side), flex = side_of(contact, CONTACT_FLEX, side);
  if (geom >= 0) return SOFT * f.body_invweight0.data[2 * f.geom_bodyid.data[geom]];
  const double* tissue = f.tissue.data + TISSUE_LENGTH * flex;
  if (!(tissue[TISSUE_MASS] > 0.0)) return 0.0;
  const double h = f.timestep.data[0], late = h * h / (LONG * LONG);
  const double stiff = h * h / (STIFF * tissue[TISSUE_YIELDS] * tissue[TISSUE_MASS]);
  return SOFT / tissue[TISSUE_MASS] * (late > 1.0 ? late : 1.0) * (stiff > 1.0 ? stiff : 1.0);
}

// Multiplies the inertia that constraints are regularized by: R is a contact's inverse inertia times
// what does not know of weights (MuJoCo, Computation, Constraint model). Islands have copies.
template <class Fields>
PALPATE void scale_impedance(const Fields& f, Rows rows, double gain) {
  const bool islands = datum<int>(f, DATA_NISLAND) > 0;
  for (int r = rows.first; r < rows.first + rows.count; ++r) {
    datum<double*>(f, DATA_EFC_DIAGA)[r] *= gain;
    datum<double*>(f, DATA_EFC_R)[r] *= gain;
    datum<double*>(f, DATA_EFC_D)[r] /= gain;
    if (!islands) continue;
    const int at = datum<int*>(f, DATA_MAP_EFC2IEFC)[r];
    datum<double*>(f, DATA_IEFC_R)[at] *= gain;
    datum<double*>(f, DATA_IEFC_D)[at] /= gain;
  }
}

// Mean length of the edges of the triangle on a side of a contact [m].
template <class Fields>
PALPATE double edge_of(const Fields& f, const char* contact, int side) {
  const int flex = side_of(contact, CONTACT_FLEX, side), elem = side_of(contact, CONTACT_ELEM, side);
  const int* e = f.flex_elem.data + f.flex_elemdataadr.data[flex] + 3 * elem;
  const double* x = f.flexvert_xpos.data + 3 * f.flex_vertadr.data[flex];
  const D3 a = load(x + 3 * e[0]), b = load(x + 3 * e[1]), c = load(x + 3 * e[2]);
  return (norm(b - a) + norm(c - b) + norm(a - c)) / 3.0;
}

// How far the tissue of one side of a contact yields to a unit force [m/N].
template <class Fields>
PALPATE double yielding(const Fields& f, const char* contact, int side) {
  const int flex = side_of(contact, CONTACT_FLEX, side);
  return flex >= 0 && f.mine.data[flex] ? f.tissue.data[TISSUE_LENGTH * flex + TISSUE_YIELDS] : 0.0;
}

// A geom's contacts with an organ's flex, which is on one side of them.
struct Touch { int geom, flex, side; };

PALPATE bool operator==(Touch a, Touch b) { return a.geom == b.geom && a.flex == b.flex; }

template <class Fields>
PALPATE Touch touch_of(const Fields& f, const char* contact) {
  for (int side = 0; side < 2; ++side) {
    const int flex = side_of(contact, CONTACT_FLEX, side);
    const int geom = side_of(contact, CONTACT_GEOM, 1 - side);
    const bool whole = side_of(contact, CONTACT_ELEM, side) >= 0;
    if (geom >= 0 && flex >= 0 && f.mine.data[flex] && whole) return {geom, flex, side};
  }
  return {-1, -1, 0};
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
  double total;
  const double work = work_of(f, dent, total);
  if (!(modulus > 0.0 && total > 0.0)) return 0.0;
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

// Makes a contact as firm as its tissue asks for and the time step can bear, whatever its nodes weigh
// and its solref and solimp say; and at least `least` [m/N] soft. At rest its force is gap / compliance
// with R = compliance * stiffness, of which the rows of a pyramid have a part each. Friction is firmer
// the shorter the step, since what sticks creeps at a speed in proportion to its R; in a pyramid it has
// no R of its own (MuJoCo, Computation, Constraint model). Done twice it does nothing.
template <class Fields>
PALPATE void firm_up(const Fields& f, char* contact, Rows rows, double least) {
  double* row = datum<double*>(f, DATA_EFC_KBIP) + 4 * rows.first;
  const double* R = datum<double*>(f, DATA_EFC_R) + rows.first;
  if (!(row[0] > 0.0) || !(row[2] < 1.0)) return;
  const double* friction = (const double*)(contact + CONTACT_FRICTION);
  const double h = f.timestep.data[0], damping = 2.0 / (SLOW * h), stiffness = 0.25 * damping * damping;
  const double borne = borne_by(f, contact, 0) + borne_by(f, contact, 1);
  const double yields = yielding(f, contact, 0) + yielding(f, contact, 1);
  const double asked = FIRM * stiffness * yields;
  const double square = friction[0] * friction[0];
  const double pair = rows.paired ? 2.0 * square * (1.0 + square) / f.impratio.data[0] : 1.0;
  const double soft = pair * (borne > asked ? borne : asked);
  const double more = (rows.paired ? rows.count : 1) * stiffness * least;
  const double wanted = more > soft ? more : soft, now = within_step(f, stiffness, damping);
  const double whole = R[0] * within_step(f, row[0] * row[2], row[1]) * row[2] / (1.0 - row[2]);
  double* solref = (double*)(contact + CONTACT_SOLREF);
  double* solimp = (double*)(contact + CONTACT_SOLIMP);
  solref[0] = SLOW * h;
  solref[1] = 1.0;
  solimp[0] = solimp[1] = whole / (whole + wanted);
  if (!rows.paired && rows.count > 1) {
    const double stuck = h > LONG ? 1.0 : h > STUCK * LONG ? h / LONG : STUCK;
    const double ratio = R[1] / R[0] < stuck ? R[1] / R[0] : stuck;
    scale_impedance(f, {rows.first + 1, rows.count - 1, false}, ratio * borne / (now * R[1]));
    *(double*)(contact + CONTACT_MU) = friction[0] * sqrt(ratio * borne / wanted);
  }
  scale_impedance(f, {rows.first, rows.paired ? rows.count : 1, false}, wanted / (now * R[0]));
  for (int r = 0; r < rows.count; ++r) {
    double* each = row + 4 * r;
    if (each[0] > 0.0) each[0] = stiffness;
    each[1] = damping;
    each[2] = 1.0;
  }
}

// How a row of a contact sees velocities: along the normal, a tangent, or in a pyramid along the normal
// and part of a tangent; and about them, where it rolls and twists.
struct Axis { D3 along, about; };

PALPATE Axis axis_of(const char* contact, Rows rows, int row) {
  const double* frame = (const double*)(contact + CONTACT_FRAME);
  const D3 none = {0.0, 0.0, 0.0};
  if (!rows.paired) return row < 3 ? Axis{load(frame + 3 * row), none} : Axis{none, load(frame + 3 * row - 9)};
  const int k = row / 2;
  const double slope = (row % 2 ? -1.0 : 1.0) * ((const double*)(contact + CONTACT_FRICTION))[k];
  if (k < 2) return {load(frame) + slope * load(frame + 3 + 3 * k), none};
  return {load(frame), slope * load(frame + 3 * k - 6)};
}

// Where a triangle lies under the flat end of a cylinder: the middle of that part, weighed by how deep
// it is, as barycentric weights; its gap; and the axis out of that end. MuJoCo names the deepest point,
// which jumps from corner to corner where a tool lies flat, and at times a way out that is longer.
template <class Fields>
PALPATE bool under_end(const Fields& f, int geom, double radius, const D3* x, D3& w, double& gap, D3& out) {
  if (geom < 0 || f.geom_type.data[geom] != GEOM_IS_CYLINDER) return false;
  const double* R = f.geom_xmat.data + 9 * geom;
  const double* size = f.geom_size.data + 3 * geom;
  D3 r[3], sum = {0.0, 0.0, 0.0};
  for (int k = 0; k < 3; ++k) r[k] = x[k] - load(f.geom_xpos.data + 3 * geom);
  out = {R[2], R[5], R[8]};
  if (dot(r[0] + r[1] + r[2], out) < 0.0) out = -1.0 * out;
  const double slack = SLACK * size[0];
  double total = 0.0, covered = 0.0;
  for (int i = 0; i < POINTS; ++i) {
    for (int j = 0; i + j < POINTS; ++j) {
      const double u = (i + 1.0 / 3.0) / POINTS, v = (j + 1.0 / 3.0) / POINTS;
      const D3 at = blend(r, {1.0 - u - v, u, v});
      const double high = dot(at, out), depth = size[1] + radius - high;
      const double inside = (size[0] + radius - norm(at - high * out) - depth) / (RIM * size[0]);
      if (!(depth > -slack && inside > 0.0)) continue;
      const double part = inside < 1.0 ? inside : 1.0, counts = (depth + slack) * part;
      covered += part;
      sum += counts * D3{1.0 - u - v, u, v};
      total += counts;
    }
  }
  if (!(total > 0.0)) return false;
  w = (1.0 / total) * sum;
  gap = dot(blend(r, w), out) - size[1] - radius;
  covered /= 0.5 * POINTS * (POINTS + 1) * COVER;
  if (covered < 1.0) gap *= covered;
  return true;
}

// Gives a contact another place, normal and gap, and the side of it that is a geom its columns.
template <class Fields>
PALPATE void put(const Fields& f, char* contact, Rows rows, int side, D3 pos, D3 normal, double gap) {
  double* frame = (double*)(contact + CONTACT_FRAME);
  const D3 other = fabs(normal.x) < 0.5 ? D3{1.0, 0.0, 0.0} : D3{0.0, 1.0, 0.0};
  D3 tangent = cross(normal, other);
  tangent = (1.0 / norm(tangent)) * tangent;
  store(frame, normal);
  store(frame + 3, tangent);
  store(frame + 6, cross(normal, tangent));
  store(pos_of(contact), pos);
  *(double*)(contact + CONTACT_DIST) = gap;
  for (int r = 0; r < (rows.paired ? rows.count : 1); ++r) datum<double*>(f, DATA_EFC_POS)[rows.first + r] = gap;
  int body = f.geom_bodyid.data[side_of(contact, CONTACT_GEOM, side)];
  pos = pos - load(f.subtree_com.data + 3 * f.body_rootid.data[body]);
  while (body > 0 && !f.body_dofnum.data[body]) body = f.body_parentid.data[body];
  int dof = body ? f.body_dofadr.data[body] + f.body_dofnum.data[body] - 1 : -1;
  for (; dof >= 0; dof = f.dof_parentid.data[dof]) {
    const D3 turns = load(f.cdof.data + 6 * dof), moves = load(f.cdof.data + 6 * dof + 3) + cross(turns, pos);
    for (int r = 0; r < rows.count; ++r) {
      const Axis axis = axis_of(contact, rows, r);
      double* a = column(f, rows.first + r, dof);
      if (a) *a = (side ? 1.0 : -1.0) * (dot(axis.along, moves) + dot(axis.about, turns));
    }
  }
}

// Gives the corners of the triangle on one side of a contact their weights.
template <class Fields>
PALPATE void weigh_side(const Fields& f, char* contact, Rows rows, int side) {
  const int flex = side_of(contact, CONTACT_FLEX, side), elem = side_of(contact, CONTACT_ELEM, side);
  if (flex < 0 || elem < 0 || !f.mine.data[flex]) return;
  const int start = f.flex_vertadr.data[flex], other = side_of(contact, CONTACT_VERT, 1 - side);
  const int* e = f.flex_elem.data + f.flex_elemdataadr.data[flex] + 3 * elem;
  D3 x[3];
  for (int k = 0; k < 3; ++k) {
    if (e[k] == other) return;  // MuJoCo leaves that corner out
    x[k] = load(f.flexvert_xpos.data + 3 * (start + e[k]));
  }
  D3 w, out;
  double gap;
  if (under_end(f, side_of(contact, CONTACT_GEOM, 1 - side), f.flex_radius.data[flex], x, w, gap, out))
    put(f, contact, rows, 1 - side, blend(x, w) - (f.flex_radius.data[flex] + 0.5 * gap) * out,
        side ? out : -1.0 * out, gap);
  else
    w = barycentric(load(pos_of(contact)), x);
  const double before = inverse_inertia(f, contact, rows, 1 - side);
  double from = before, to = before;
  const double right[3] = {w.x, w.y, w.z};
  for (int k = 0; k < 3; ++k) {
    const int body = f.flex_vertbodyid.data[start + e[k]];
    if (!columns(f, rows.first, body)) continue;
    from += weight_of(f, rows, body, 0.0) * f.body_invweight0.data[2 * body];
    to += right[k] * f.body_invweight0.data[2 * body];
    const double* slides = f.cdof.data + 6 * f.body_dofadr.data[body] + 3;
    for (int r = 0; r < rows.count; ++r) {
      const D3 along = (side ? right[k] : -right[k]) * axis_of(contact, rows, r).along;
      store(columns(f, rows.first + r, body),
            {dot(along, load(slides)), dot(along, load(slides + 6)), dot(along, load(slides + 12))});
    }
  }
  if (from > 0.0 && to > 0.0) scale_impedance(f, rows, to / from);
}

// The velocity of a row.
template <class Fields>
PALPATE double velocity(const Fields& f, int row) {
  const double *J = datum<double*>(f, DATA_EFC_J), *qvel = f.qvel.data;
  double sum = 0.0;
  if (is_dense(f)) {
    for (int k = 0; k < f.nv; ++k) sum += J[(long long)f.nv * row + k] * qvel[k];
    return sum;
  }
  const int start = datum<int*>(f, DATA_EFC_J_ROWADR)[row];
  const int count = datum<int*>(f, DATA_EFC_J_ROWNNZ)[row];
  const int* colind = datum<int*>(f, DATA_EFC_J_COLIND) + start;
  for (int k = 0; k < count; ++k) sum += J[start + k] * qvel[colind[k]];
  return sum;
}

// How fast MuJoCo brakes what slides at a contact, times friction [m/s^2]: with D the damping of a
// row, |D mu v| over the directions in the contact's plane. The rows of a pyramid, n + mu t and
// n - mu t, part by less where they share it.
template <class Fields>
PALPATE double parting(const Fields& f, const char* contact, Rows rows) {
  const double* friction = (const double*)(contact + CONTACT_FRICTION);
  double sum = 0.0;
  for (int r = rows.first + !rows.paired; r < rows.first + rows.count; r += 1 + rows.paired) {
    const double damping = datum<double*>(f, DATA_EFC_KBIP)[4 * r + 1];
    const double v = rows.paired ? 0.5 * (velocity(f, r) - velocity(f, r + 1))
                                 : friction[r - rows.first - 1] * velocity(f, r);
    sum += damping * v * damping * v;
  }
  return sqrt(sum);
}

// Moves the contact's gap by as much as takes that parting away: sliding then has the gap, and the
// force, of standing (de Saxce and Feng 1998, doi:10.1016/S0895-7177(98)00119-8, with the velocity
// that the step begins with). Done twice it does nothing.
template <class Fields>
PALPATE void keep_closed(const Fields& f, const char* contact, Rows rows) {
  if (rows.count < 2) return;
  const double* row = datum<double*>(f, DATA_EFC_KBIP) + 4 * rows.first;
  const double stiffness = row[0] * row[2];
  if (!(stiffness > 0.0)) return;
  const double gap = *(const double*)(contact + CONTACT_DIST) + parting(f, contact, rows) / stiffness;
  for (int r = rows.first; r < rows.first + (rows.paired ? rows.count : 1); ++r)
    datum<double*>(f, DATA_EFC_POS)[r] = gap;
}

// Whether one of the two sides of a contact is an organ's.
template <class Fields>
PALPATE bool is_mine(const Fields& f, const char* contact) {
  for (int side = 0; side < 2; ++side) {
    const int flex = side_of(contact, CONTACT_FLEX, side);
    if (flex >= 0 && f.mine.data[flex]) return true;
  }
  return false;
}

// Whether a side of a contact is a geom. Where two organs lie flat on each other MuJoCo has one contact a
// pair of triangles, which jumps about: firm ones would shake them.
PALPATE bool has_geom(const char* contact) {
  return side_of(contact, CONTACT_GEOM, 0) >= 0 || side_of(contact, CONTACT_GEOM, 1) >= 0;
}

// Gives contacts with an organ their rows, and flags that what MuJoCo has computed of them for its dual
// solvers has to be computed again. Done twice it does nothing.
template <class Fields>
PALPATE void weigh(const Fields& f, Thread, int) {
  bool touched = false;
  Touch last = {-1, -1, 0};
  double least = 0.0;
  char* const contacts = datum<char*>(f, DATA_CONTACT);
  const int ncon = datum<int>(f, DATA_NEFC) > 0 ? datum<int>(f, DATA_NCON) : 0;
  for (int c = 0; c < ncon; ++c) {
    char* contact = contacts + (size_t)CONTACT_LENGTH * c;
    const Rows rows = is_mine(f, contact) ? rows_of(f, contact) : Rows{0, 0, false};
    if (!rows.count) continue;
    touched = true;
    for (int side = 0; side < 2; ++side)
      weigh_side(f, contact, rows, side);
    const Touch touch = touch_of(f, contact);
    if (touch.geom < 0) {
      least = 0.0;
    } else if (!(touch == last)) {
      least = unresolved(f, contacts, ncon, touch);
    }
    last = touch;
    if (has_geom(contact)) firm_up(f, contact, rows, least);
    keep_closed(f, contact, rows);
  }
  const bool projects = f.solver.data[0] == SOLVER_PGS || f.noslip_iterations.data[0] > 0 ||
                        (f.enableflags.data[0] & ENABLE_DIAGEXACT);
  f.flags.data[FLAG_WEIGHED] = touched && projects;
}

}  // namespace palpate
