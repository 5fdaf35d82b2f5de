// How firm contacts are: as firm as their tissue asks for and a step can bear; MuJoCo's grow softer as
// nodes grow lighter.
#pragma once
#include "contact/contact_rows.h"
#include "contact/series_compliance.h"

namespace palpate {

// Edges that a tool's radius has at least, else it is told that the mesh is too coarse.
constexpr double COARSE = 0.05;

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

// A geom's contacts with an organ, in MuJoCo's memory.
template <class Fields>
struct ToolContacts {
  const Fields& f;
  const char* contacts;
  int ncon;
  Touch touch;

  PALPATE int count() const { return ncon; }

  PALPATE bool at(int c, Press& press) const {
    const char* contact = contacts + (size_t)CONTACT_LENGTH * c;
    const int elem = side_of(contact, CONTACT_ELEM, touch.side);
    if (!(touch_of(f, contact) == touch) || elem < 0) return false;
    const int* e = f.flex_elem.data + f.flex_elemdataadr.data[touch.flex] + 3 * elem;
    const int start = f.flex_vertadr.data[touch.flex];
    press.gap = *(const double*)(contact + CONTACT_DIST);
    press.pos = load((const double*)(contact + CONTACT_POS));
    press.normal = load((const double*)(contact + CONTACT_FRAME));
    press.measure(place(start + e[0]), place(start + e[1]), place(start + e[2]));
    for (int k = 0; k < 3; ++k) press.corner[k] = f.force_adr.data[start + e[k]] < 0 ? -1 : start + e[k];
    return true;
  }

  PALPATE bool other(int c, Press& press) const {
    const char* contact = contacts + (size_t)CONTACT_LENGTH * c;
    const Touch found = touch_of(f, contact);
    if (found.flex != touch.flex || found.geom == touch.geom) return false;
    press.pos = load((const double*)(contact + CONTACT_POS));
    press.normal = (found.side == touch.side ? 1.0 : -1.0) * load((const double*)(contact + CONTACT_FRAME));
    return true;
  }

  PALPATE D3 place(int vert) const { return load(f.flexvert_xpos.data + 3 * vert); }
  PALPATE D3 force(int vert) const { return load(f.plugin_state.data + f.force_adr.data[vert]); }
};

template <class Fields>
PALPATE Tool tool_of(const Fields& f, Touch touch) {
  const double* R = f.geom_xmat.data + 9 * touch.geom;
  return {f.geom_type.data[touch.geom], load(f.geom_xpos.data + 3 * touch.geom), {R[2], R[5], R[8]},
          f.geom_size.data[3 * touch.geom], f.flex_radius.data[touch.flex]};
}

// What the contacts of a tool make up for; flags a mesh that is too coarse for the tool.
template <class Fields>
PALPATE Series series_of(const Fields& f, const char* contacts, int ncon, Touch touch) {
  const Tool tool = tool_of(f, touch);
  const ToolContacts<Fields> all = {f, contacts, ncon, touch};
  Dent dent;
  if (!tool.is_known() || !find_dent(all, tool, dent)) return {0.0, 0.0};
  if (tool.size + tool.skin < COARSE * dent.edges / dent.ncon) {
    if (f.mine.data[touch.flex] > 1 && !f.flags.data[FLAG_COARSE])
      f.flags.data[FLAG_COARSE] = (int)(2e6 * (tool.size + tool.skin)) + 1;
    return {0.0, 0.0};
  }
  return unresolved(all, tool, dent, f.tissue.data + TISSUE_LENGTH * touch.flex);
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
// step can bear; unless the organ says itself how firm it is. It yields by the series too.
// Returns where it has no force, off its gap [m].
//
// At rest its force is gap / compliance with R = compliance * stiffness; the rows of a pyramid have a
// part each. Friction is firmer the shorter the step, since what sticks creeps at a speed in proportion
// to its R; in a pyramid it has no R of its own (MuJoCo, Computation, Constraint model). Done twice it
// does nothing.
template <class Fields>
PALPATE double firm_up(const Fields& f, char* contact, Rows rows, Touch touch, int count, Series series) {
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
  const double radius = f.geom_size.data[3 * touch.geom] + f.flex_radius.data[touch.flex];
  double gap = *(const double*)(contact + CONTACT_DIST), off = 0.0;
  if (series.rounds > 0.0) {
    const int* e = f.flex_elem.data + f.flex_elemdataadr.data[touch.flex] +
                   3 * side_of(contact, CONTACT_ELEM, touch.side);
    D3 x[3];
    for (int k = 0; k < 3; ++k) x[k] = load(f.flexvert_xpos.data + 3 * (f.flex_vertadr.data[touch.flex] + e[k]));
    off = series.rounds * rise(x, load(pos_of(contact)), radius);
  }
  gap += off;
  const double per = normals.count * row[0] * row[2];
  const Stiff stiff = stiffened(gap, radius, per * series.compliance);
  if (R[0] < stiff.tangent) scale_impedance(f, normals, stiff.tangent / R[0]);
  if (R[0] < stiff.secant) off -= gap * (1.0 - R[0] / stiff.secant);
  if (sticks) *(double*)(contact + CONTACT_MU) = friction[0] * sqrt(R[1] / R[0]);
  return off;
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
