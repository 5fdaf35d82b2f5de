// Contacts in MuJoCo's memory, and their rows of constraints.
#pragma once
#include "core/triangle.h"

namespace palpate {

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
struct Rows {
  int first, count;
  bool paired;

  // Those along the normal: all of a pyramid.
  PALPATE Rows normals() const { return {first, paired ? count : 1, paired}; }
};

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

// The numbers of a row, and their dofs; null where they are all.
struct Row { double* value; const int* dof; int count; };

template <class Fields>
PALPATE Row row_of(const Fields& f, int row) {
  double* J = datum<double*>(f, DATA_EFC_J);
  if (is_dense(f)) return {J + (long long)f.nv * row, nullptr, f.nv};
  const int start = datum<int*>(f, DATA_EFC_J_ROWADR)[row];
  return {J + start, datum<int*>(f, DATA_EFC_J_COLIND) + start, datum<int*>(f, DATA_EFC_J_ROWNNZ)[row]};
}

// Where a row has the column of a dof, or null.
template <class Fields>
PALPATE double* column(const Fields& f, int row, int dof) {
  const Row all = row_of(f, row);
  if (!all.dof) return all.value + dof;
  for (int k = 0; k < all.count; ++k)
    if (all.dof[k] == dof) return all.value + k;
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

// What the discrete integrator divides R by: what a spring and damper do within the step. It makes rows
// again, from the contact's solref and solimp.
template <class Fields>
PALPATE double within_step(const Fields& f, double stiffness, double damping) {
  const double h = f.timestep.data[0];
  return f.integrator.data[0] == INTEGRATOR_DISCRETE ? 1.0 + h * damping + h * h * stiffness : 1.0;
}

// The impedance of a contact at a gap, by its solimp (MuJoCo, Modeling, Solver parameters).
PALPATE double impedance(const double* solimp, double gap) {
  const double low = solimp[0], high = solimp[1], width = solimp[2], middle = solimp[3], power = solimp[4];
  if (low == high || !(width > 0.0)) return 0.5 * (low + high);
  const double x = fabs(gap) / width;
  if (x >= 1.0) return high;
  if (!(power > 1.0)) return low + x * (high - low);
  const double y = x <= middle ? pow(x, power) / pow(middle, power - 1.0)
                               : 1.0 - pow(1.0 - x, power) / pow(1.0 - middle, power - 1.0);
  return low + y * (high - low);
}

// Gives the rows of a contact that MuJoCo made for another gap their impedance, and R with it.
template <class Fields>
PALPATE void impede(const Fields& f, const char* contact, Rows rows, double gap) {
  double* row = datum<double*>(f, DATA_EFC_KBIP) + 4 * rows.first;
  const double now = row[2], next = impedance((const double*)(contact + CONTACT_SOLIMP), gap);
  if (!(now > 0.0 && now < 1.0 && next > 0.0 && next < 1.0)) return;
  const double before = within_step(f, row[0] * now, row[1]), after = within_step(f, row[0] * next, row[1]);
  scale_impedance(f, rows, (1.0 - next) / next * now / (1.0 - now) * before / after);
  for (int r = 0; r < rows.count; ++r) row[4 * r + 2] = next;
}

// How a row of a contact sees velocities: along the normal, a tangent, or in a pyramid along the normal
// and part of a tangent; and about them, where it rolls and twists.
struct Axis { D3 along, about; };

PALPATE Axis axis_of(const char* contact, Rows rows, int row) {
  const double* frame = (const double*)(contact + CONTACT_FRAME);
  const D3 none = {0.0, 0.0, 0.0};
  if (!rows.paired && row < 3) return {load(frame + 3 * row), none};
  if (!rows.paired) return {none, load(frame + 3 * row - 9)};
  const int k = row / 2;
  const double slope = (row % 2 ? -1.0 : 1.0) * ((const double*)(contact + CONTACT_FRICTION))[k];
  if (k < 2) return {load(frame) + slope * load(frame + 3 + 3 * k), none};
  return {load(frame), slope * load(frame + 3 * k - 6)};
}

// The velocity of a row.
template <class Fields>
PALPATE double velocity(const Fields& f, int row) {
  const Row all = row_of(f, row);
  double sum = 0.0;
  for (int k = 0; k < all.count; ++k) sum += all.value[k] * f.qvel.data[all.dof ? all.dof[k] : k];
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

// Gives a contact another gap than MuJoCo found.
template <class Fields>
PALPATE void set_gap(const Fields& f, Rows rows, double gap) {
  for (int r = 0; r < rows.normals().count; ++r) datum<double*>(f, DATA_EFC_POS)[rows.first + r] = gap;
}

// Moves the contact's gap by what lies off it, and by as much as takes that parting away: sliding then
// has the gap, and the force, of standing (de Saxce and Feng 1998, doi:10.1016/S0895-7177(98)00119-8,
// with the velocity that the step begins with). Done twice it does nothing.
template <class Fields>
PALPATE void keep_closed(const Fields& f, const char* contact, Rows rows, double off) {
  const double* row = datum<double*>(f, DATA_EFC_KBIP) + 4 * rows.first;
  const double stiffness = row[0] * row[2];
  if (!(stiffness > 0.0)) return;
  double gap = *(const double*)(contact + CONTACT_DIST) + off;
  if (rows.count > 1) gap += parting(f, contact, rows) / stiffness;
  set_gap(f, rows, gap);
}

}  // namespace palpate
