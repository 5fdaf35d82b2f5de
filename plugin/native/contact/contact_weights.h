// Contacts with triangles: a contact acts on the corners of a triangle by the barycentric weights of
// where it is. MuJoCo 3.17 weighs them by inverse distance, as if the contact were at another point.
// Its rows are made when this runs, their reference accelerations are not.
//
// Contacts that slide stay closed. MuJoCo's friction is convex: a sliding contact parts, by its
// friction times how fast it is braked. On light nodes that lifts a tool off within a step, and the
// force flickers.
#pragma once
#include "contact/contact_stiffness.h"

namespace palpate {

constexpr double OPEN = 1.0;  // gap of contacts that are none [m]

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
  const D3 across = cross(r[1] - r[0], r[2] - r[0]);
  if (fabs(dot(across, out)) < LEVEL * norm(across)) return false;
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
  double* efc_pos = datum<double*>(f, DATA_EFC_POS) + rows.first;
  for (int r = 0; r < rows.normals().count; ++r) efc_pos[r] = gap;
  impede(f, contact, rows, gap - datum<double*>(f, DATA_EFC_MARGIN)[rows.first]);
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

// Whether a contact is between a thread and another thing: the thread's step, which may be over by now, sees to its rows.
template <class Fields>
PALPATE bool is_threads(const Fields& f, const char* contact) {
  const auto is_thread = [&](int side) {
    const int flex = side_of(contact, CONTACT_FLEX, side);
    return flex >= 0 && f.flex_dim.data[flex] == 1;
  };
  return is_thread(0) != is_thread(1);
}

// Gives the corners of the triangle on one side of a contact their weights.
template <class Fields>
PALPATE void weigh_side(const Fields& f, char* contact, Rows rows, int side) {
  const int flex = side_of(contact, CONTACT_FLEX, side), elem = side_of(contact, CONTACT_ELEM, side);
  if (flex < 0 || elem < 0 || !f.mine.data[flex] || f.flex_dim.data[flex] != 2) return;
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
  else if (!f.wrong)
    return;
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
  // A thread's step has found the force of its contacts.
  if (from > 0.0 && to > 0.0 && !is_threads(f, contact)) scale_impedance(f, rows, to / from);
}

// The normal of the triangle on a side of a contact, outward.
template <class Fields>
PALPATE D3 outward(const Fields& f, const char* contact, int side) {
  const int flex = side_of(contact, CONTACT_FLEX, side);
  const int* e = f.flex_elem.data + f.flex_elemdataadr.data[flex] + 3 * side_of(contact, CONTACT_ELEM, side);
  const double* x = f.flexvert_xpos.data + 3 * f.flex_vertadr.data[flex];
  const D3 at = load(x + 3 * e[0]), normal = cross(load(x + 3 * e[1]) - at, load(x + 3 * e[2]) - at);
  return (1.0 / norm(normal)) * normal;
}

// Turns a contact of two triangles that are more than half way through each other, which MuJoCo would
// push out on the far side: its normal goes into both.
template <class Fields>
PALPATE void turn_back(const Fields& f, char* contact, Rows rows) {
  double* frame = (double*)(contact + CONTACT_FRAME);
  double& gap = *(double*)(contact + CONTACT_DIST);
  const double apart = f.flex_radius.data[side_of(contact, CONTACT_FLEX, 0)] +
                       f.flex_radius.data[side_of(contact, CONTACT_FLEX, 1)];
  if (gap > -SUNK * apart || dot(load(frame), outward(f, contact, 0)) > -FACING ||
      dot(load(frame), outward(f, contact, 1)) < FACING)
    return;
  gap = -gap - 2.0 * apart;
  for (int k = 0; k < 3; ++k) store(frame + 3 * k, -1.0 * load(frame + 3 * k));
  for (int r = rows.first; r < rows.first + rows.count; ++r) {
    const Row row = row_of(f, r);
    for (int k = 0; k < row.count; ++k) row.value[k] *= -1.0;
  }
  for (int r = 0; r < rows.normals().count; ++r) datum<double*>(f, DATA_EFC_POS)[rows.first + r] = gap;
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

// Opens the contacts of needles, and of their threads, with the tissue that they are in. Done twice it does nothing.
template <class Fields>
PALPATE void lift(const Fields& f, Thread, int) {
  char* const contacts = datum<char*>(f, DATA_CONTACT);
  const int ncon = datum<int>(f, DATA_NEFC) > 0 ? datum<int>(f, DATA_NCON) : 0;
  for (int c = 0; c < ncon; ++c) {
    char* contact = contacts + (size_t)CONTACT_LENGTH * c;
    for (int side = 0; side < 2; ++side) {
      const int flex = side_of(contact, CONTACT_FLEX, side), geom = side_of(contact, CONTACT_GEOM, 1 - side);
      const int other = side_of(contact, CONTACT_FLEX, 1 - side);
      if (flex < 0) continue;
      const int* lifted = f.lifted.data + (f.ngeom + 2 * f.nflex) * flex;
      if (geom >= 0 && !lifted[geom]) continue;
      if (geom < 0) {
        const int elem = side_of(contact, CONTACT_ELEM, 1 - side), vert = side_of(contact, CONTACT_VERT, 1 - side);
        const int edge = elem >= 0 ? elem : vert, *part = lifted + f.ngeom + 2 * other;
        if (other < 0 || edge < part[0] || edge >= part[1]) continue;
      }
      const Rows rows = rows_of(f, contact);
      *(double*)(contact + CONTACT_DIST) = OPEN;  // which others make rows of again
      for (int r = 0; r < rows.normals().count; ++r) datum<double*>(f, DATA_EFC_POS)[rows.first + r] = OPEN;
    }
  }
}

// By how much a thread's contacts are there before they touch, see `mujoco_rod.h`; 0 of others.
template <class Fields>
PALPATE double ahead(const Fields& f, const char* contact) {
  for (int side = 0; side < 2; ++side) {
    const int flex = side_of(contact, CONTACT_FLEX, side);
    if (flex >= 0 && f.mine.data[flex] && f.flex_dim.data[flex] == 1) return f.flex_margin.data[flex];
  }
  return 0.0;
}

// Gives contacts with an organ their rows, and flags that what MuJoCo has computed of them for its dual
// solvers has to be computed again. Done twice it does nothing.
template <class Fields>
PALPATE void weigh(const Fields& f, Thread, int) {
  bool touched = false;
  Touch last = {-1, -1, 0};
  Series series = {0.0, 0.0};
  int count = 0;
  Shared shared = {{-1, -1}, 0.0};
  char* const contacts = datum<char*>(f, DATA_CONTACT);
  const int ncon = datum<int>(f, DATA_NEFC) > 0 ? datum<int>(f, DATA_NCON) : 0;
  for (int c = 0; c < ncon; ++c) {  // places before what follows from all of a tool's
    char* contact = contacts + (size_t)CONTACT_LENGTH * c;
    const Rows rows = is_mine(f, contact) ? rows_of(f, contact) : Rows{0, 0, false};
    for (int side = 0; side < 2 && rows.count; ++side) weigh_side(f, contact, rows, side);
  }
  for (int c = 0; c < ncon; ++c) {
    char* contact = contacts + (size_t)CONTACT_LENGTH * c;
    const Rows rows = is_mine(f, contact) ? rows_of(f, contact) : Rows{0, 0, false};
    if (!rows.count) continue;
    touched = true;
    if (is_threads(f, contact)) continue;
    double off = ahead(f, contact);
    const Touch touch = touch_of(f, contact);
    if (touch.geom >= 0) {
      if (!(touch == last)) series = series_of(f, contacts, ncon, touch);
      if (touch.flex != last.flex) count = count_of(contacts, ncon, touch.flex, true);
      off = firm_up(f, contact, rows, touch, count, series);
      last = touch;
    } else if (are_organs(f, contact)) {
      turn_back(f, contact, rows);
      share_out(f, contacts, ncon, contact, shared);
      firm_organs(f, contact, rows, shared.borne);
    }
    keep_closed(f, contact, rows, off);
  }
  lift(f, {}, 0);
  const bool projects = f.solver.data[0] == SOLVER_PGS || f.noslip_iterations.data[0] > 0 ||
                        (f.enableflags.data[0] & ENABLE_DIAGEXACT);
  f.flags.data[FLAG_WEIGHED] = touched && projects;
}

}  // namespace palpate
