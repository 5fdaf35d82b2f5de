// A rod among MuJoCo's own dofs, in MuJoCo's memory.
#pragma once
#include "contact/contact_weights.h"
#include "coupling/rod.h"

AS_WRITTEN

namespace palpate {

template <class Fields>
struct MujocoRod {
  const Fields& f;
  const decltype(Fields::rod)& rod;

  PALPATE int own_dof(int dof) const { return f.own_dof.data[dof]; }
  PALPATE const double* M() const { return f.mj.M.data; }

  PALPATE Row row(int r) const { return row_of(f, r); }
  PALPATE double reference(int r) const {
    const double* kbip = datum<double*>(f, DATA_EFC_KBIP) + 4 * r;
    const double gap = datum<double*>(f, DATA_EFC_POS)[r] - datum<double*>(f, DATA_EFC_MARGIN)[r];
    return -(kbip[1] * velocity(f, r) + kbip[0] * kbip[2] * gap);
  }
  PALPATE double stiffness(int r) const { return datum<double*>(f, DATA_EFC_D)[r]; }
  PALPATE double force(int r) const { return datum<double*>(f, DATA_EFC_FORCE)[r]; }
  // Lets row `r` have another reference, and give way so many times as much.
  PALPATE void soften(int r, double softer, double reference) const {
    double* kbip = datum<double*>(f, DATA_EFC_KBIP) + 4 * r;
    kbip[1] = 0.0, kbip[0] = kbip[2] = 1.0;
    datum<double*>(f, DATA_EFC_POS)[r] = datum<double*>(f, DATA_EFC_MARGIN)[r] - reference;
    scale_impedance(f, {r, 1, false}, softer);
  }
  PALPATE double speed(int dof) const { return f.mj.qvel.data[dof]; }
  // The force on a dof besides bias and constraints.
  PALPATE double known(int dof) const {
    return f.mj.qfrc_applied.data[dof] + f.mj.qfrc_passive.data[dof] + f.qfrc_actuator.data[dof];
  }
  PALPATE double damping(int dof) const { return f.dof_damping.data[dof]; }
  PALPATE double invweight(int body) const { return f.body_invweight0.data[2 * body]; }
  PALPATE double last_acceleration(int dof) const { return f.qacc_warmstart.data[dof]; }

  PALPATE bool moves(int i) const { return f.dofadr.data[i] >= 0; }
  PALPATE D3 inertia(int i) const {
    const int* at = f.massadr.data + 3 * i;
    return {f.mj.M.data[at[0]], f.mj.M.data[at[1]], f.mj.M.data[at[2]]};
  }
  PALPATE void set_inertia(int i, D3 Mhat) const {
    palpate::set_inertia(f.mj, f.massadr.data + 3 * i, f.dofadr.data[i], Mhat);
  }
  // The solver starts where the rod's step leads.
  PALPATE void push(int i, D3 force, D3 acceleration) const {
    const int adr = f.dofadr.data[i];
    store(f.mj.qfrc_passive.data + adr, load(f.mj.qfrc_passive.data + adr) + force);
    store(f.qacc_warmstart.data + adr, acceleration);
  }
  // The force of constraints by the node's acceleration: that is what MuJoCo's solver finds, to more digits than
  // the large forces that cancel on a node between jaws.
  PALPATE D3 found(int i) const {
    const int adr = f.dofadr.data[i];
    const D3 Mhat = inertia(i), a = load(f.qacc.data + adr);
    return D3{Mhat.x * a.x, Mhat.y * a.y, Mhat.z * a.z} - load(f.qfrc_smooth.data + adr);
  }
  PALPATE void move(int i, D3 moved, D3 velocity) const {
    const int q = f.qposadr.data[i];
    const D3 at = load(rod.start.data + 3 * i) - load(f.rest.data + 3 * i) + load(f.mj.qpos0.data + q);
    store(f.mj.qpos.data + q, at + moved);
    store(f.mj.qvel.data + f.dofadr.data[i], velocity);
  }

  PALPATE bool is_own(const char* contact) const {
    return side_of(contact, CONTACT_FLEX, 0) == f.flex || side_of(contact, CONTACT_FLEX, 1) == f.flex;
  }

  // Makes rows do nothing.
  PALPATE void empty(Rows rows) const {
    double* kbip = datum<double*>(f, DATA_EFC_KBIP);
    for (int r = rows.first; r < rows.first + rows.count; ++r) {
      const Row row = row_of(f, r);
      for (int k = 0; k < row.count; ++k) ((double*)row.value)[k] = 0.0;
      for (int k = 0; k < 4; ++k) kbip[4 * r + k] = 0.0;
    }
  }

  // Notes the rows of constraints that act on the rod. Contacts are there before they touch, by the flex's
  // margin, which is taken off again: one that came a step late would find light nodes far inside. Those that
  // slide on geoms are not kept closed: a thread follows by itself, and between jaws the velocity of the last step
  // would take away the force that holds it.
  PALPATE void note_rows(double h) const {
    const int nefc = datum<int>(f, DATA_NEFC), ncon = nefc > 0 ? datum<int>(f, DATA_NCON) : 0;
    char* const contacts = datum<char*>(f, DATA_CONTACT);
    note_grips(*this, nefc, datum<int*>(f, DATA_EFC_TYPE));
    note_each(rod, ncon, [&](int c, int at) {
      const char* contact = contacts + (size_t)CONTACT_LENGTH * c;
      const Rows rows = is_own(contact) ? rows_of(f, contact) : Rows{0, 0, false};
      if (!rows.count) return 0;
      if (is_open(*this, (const int*)(contact + CONTACT_FLEX), (const int*)(contact + CONTACT_ELEM),
                  (const int*)(contact + CONTACT_GEOM))) {  // MuJoCo still has it
        empty(rows);
        return 0;
      }
      const double margin = f.flex_margin.data[f.flex];
      if (*(const double*)(contact + CONTACT_DIST) >= OPEN) return 0;  // with the tissue that it is in
      const Other other = other_of(f, (const int*)(contact + CONTACT_FLEX));
      if (other != A_BODY)
        keep_closed(f, contact, rows, margin);
      else
        set_gap(f, rows, *(const double*)(contact + CONTACT_DIST) + margin);
      return note_contact(*this, at, rows.first, rows.count, !rows.paired && rows.count > 1,
                          *(const double*)(contact + CONTACT_MU), (const double*)(contact + CONTACT_FRICTION), other);
    });
    const int* type = datum<int*>(f, DATA_EFC_TYPE);
    note_joints(*this, nefc, type);
    yield_vertices(*this);
    yield_trees(*this, h, nefc, type, datum<int*>(f, DATA_EFC_ID));
  }

  // Reads MuJoCo's arrays: where the step begins, and where it leads with no stiffness.
  PALPATE void gather(double h) const {
    const auto& mj = f.mj;
    const double* R = f.frame.data;
    const bool falls = !(mj.disableflags.data[0] & DISABLE_GRAVITY);
    const D3 zero = {0.0, 0.0, 0.0}, gravity = falls ? add_turned(zero, R, load(mj.gravity.data)) : zero;
    each_lane(0, rod.nnode, [&](int i) {
      const int adr = f.dofadr.data[i], q = f.qposadr.data[i], body = f.bodyid.data[i];
      rod.turn.data[i] = 0.0;
      D3 x = load(f.rest.data + 3 * i), v = zero, force = zero;
      if (adr >= 0) {
        const double weighs = mj.body_mass.data[body], m = rod.mass.data[i] = mass_of(rod, i, weighs);
        x += load(mj.qpos.data + q) - load(mj.qpos0.data + q);
        v = load(mj.qvel.data + adr);
        const D3 along = weighs * gravity + load(mj.qfrc_applied.data + adr) + load(mj.qfrc_passive.data + adr);
        force = external(along, R, mj.xfrc_applied.data + 6 * body);
        store(rod.aim.data + 3 * i, x + h * v + (h * h / m) * (force + (m - weighs) * gravity));
      } else {
        store(rod.aim.data + 3 * i, x);
      }
      store(rod.start.data + 3 * i, x);
      store(rod.vel.data + 3 * i, v);
      store(rod.external.data + 3 * i, force);
    });
  }
};

template <class Fields>
PALPATE void begin_rod(const Fields& f, Thread, int) {
  begin(MujocoRod<Fields>{f, f.rod}, f.mj.timestep.data[0]);
}

template <class Fields>
PALPATE void end_rod(const Fields& f, Thread, int) {
  end(MujocoRod<Fields>{f, f.rod}, f.mj.timestep.data[0]);
}

}  // namespace palpate
