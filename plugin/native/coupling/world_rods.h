// A rod in many worlds, whose nodes are mujoco_warp's dofs. Its place and velocity are doubles; mujoco_warp has
// them as floats, and where these are others, as after a reset, they count.
#pragma once
#include "coupling/rod.h"

AS_WRITTEN

namespace palpate {

template <class Fields>
struct WorldRod {
  const Fields& f;  // what its world has of its own
  decltype(*Fields().rods.data) rod;

  PALPATE int own_dof(int dof) const { return f.own_dof.data[dof]; }
  PALPATE const float* M() const { return f.M.data; }

  PALPATE RowOf<float> row(int r) const {
    if (!f.sparse) return {f.J.data + (size_t)r * f.J.shape[2], nullptr, f.nv};
    const int start = f.J_rowadr.data[r];
    return {f.J.data + start, f.J_colind.data + start, f.J_rownnz.data[r]};
  }
  PALPATE double reference(int r) const { return f.aref.data[r]; }
  PALPATE double stiffness(int r) const { return f.D.data[r]; }
  PALPATE double force(int r) const { return f.force.data[r]; }
  PALPATE void soften(int r, double softer, double reference) const {
    f.D.data[r] /= softer;
    f.aref.data[r] = reference;
  }
  PALPATE double speed(int dof) const { return f.qvel.data[dof]; }
  // The force on a dof besides bias and constraints.
  PALPATE double known(int dof) const {
    return f.qfrc_applied.data[dof] + f.qfrc_passive.data[dof] + f.qfrc_actuator.data[dof];
  }
  PALPATE double damping(int dof) const { return f.dof_damping.data[dof]; }
  PALPATE double invweight(int body) const { return ((const float*)f.body_invweight0.data)[2 * body]; }
  PALPATE double last_acceleration(int dof) const { return f.qacc_warmstart.data[dof]; }

  PALPATE bool moves(int i) const { return f.dofadr.data[i] >= 0; }
  PALPATE D3 inertia(int i) const {
    const int* at = f.massadr.data + 3 * i;
    return {f.M.data[at[0]], f.M.data[at[1]], f.M.data[at[2]]};
  }
  PALPATE void set_inertia(int i, D3 Mhat) const {
    const int* at = f.massadr.data + 3 * i;
    f.M.data[at[0]] = (float)Mhat.x, f.M.data[at[1]] = (float)Mhat.y, f.M.data[at[2]] = (float)Mhat.z;
  }
  // The solver starts where the rod's step leads.
  PALPATE void push(int i, D3 force, D3 acceleration) const {
    const int adr = f.dofadr.data[i];
    float* out = f.qfrc_passive.data + adr;
    store(out, load(out) + force);
    store(f.qacc_warmstart.data + adr, acceleration);
  }
  PALPATE D3 found(int i) const {  // see `MujocoRod`
    const D3 Mhat = inertia(i), a = load(f.qacc.data + f.dofadr.data[i]);
    return D3{Mhat.x * a.x, Mhat.y * a.y, Mhat.z * a.z} - load(f.qfrc_smooth.data + f.dofadr.data[i]);
  }

  // Where qpos has a place, from rest.
  PALPATE D3 zero(int i) const { return load(f.qpos0.data + f.qposadr.data[i]) - load(f.rest.data + 3 * i); }
  PALPATE void move(int i, D3 moved, D3 velocity) const {
    const D3 x = load(rod.start.data + 3 * i) + moved;
    store(f.now.data + 3 * i, x);
    store(f.speed.data + 3 * i, velocity);
    store(f.qpos.data + f.qposadr.data[i], x + zero(i));
    store(f.qvel.data + f.dofadr.data[i], velocity);
  }
  // What floats have, by the doubles that they are of.
  PALPATE static D3 exact(const float* told, D3 exact) {
    const D3 t = load(told);
    return {(float)exact.x == t.x ? exact.x : t.x, (float)exact.y == t.y ? exact.y : t.y,
            (float)exact.z == t.z ? exact.z : t.z};
  }

  // Notes the rows of constraints that act on the rod, those of contacts first.
  PALPATE void note_rows(double h) const {
    const int most = (int)f.aref.shape[1], nefc = f.nefc.data[0] < most ? f.nefc.data[0] : most;
    const int* type = f.type.data;
    note_grips(*this, nefc, type);
    note_each(rod, nefc, [&](int r, int at) {
      const int c = f.id.data[r];
      if (type[r] < IS_CONTACT || (r && type[r - 1] >= IS_CONTACT && f.id.data[r - 1] == c)) return 0;
      const bool paired = type[r] == CONTACT_PYRAMIDAL;
      const int dim = f.contact_dim.data[c], count = paired ? 2 * (dim - 1) : dim;
      const int *flex = (const int*)f.contact_flex.data + 2 * c, *geom = (const int*)f.contact_geom.data + 2 * c;
      if ((flex[0] != f.flex && flex[1] != f.flex) || r + count > nefc) return 0;
      if (is_open(*this, flex, (const int*)f.contact_elem.data + 2 * c, geom)) {
        // mujoco_warp still has it
        for (int k = r; k < r + count; ++k) {
          const auto own = row(k);
          for (int a = 0; a < own.count; ++a) own.value[a] = 0.0f;
          f.aref.data[k] = 0.0f;
        }
        return 0;
      }
      const float* friction = (const float*)f.contact_friction.data + 5 * c;
      return note_contact(*this, at, r, count, !paired && count > 1, friction[0] / sqrt(f.impratio), friction,
                          other_of(f, flex));
    });
    note_joints(*this, nefc, type);
    yield_vertices(*this);
    yield_trees(*this, h, nefc, type, f.id.data);
  }

  PALPATE void gather(double h) const {
    const double* R = f.frame.data;
    const D3 none = {0.0, 0.0, 0.0}, gravity = f.falls ? add_turned(none, R, load((const float*)f.gravity.data)) : none;
    each_lane(0, rod.nnode, [&](int i) {
      const int adr = f.dofadr.data[i];
      rod.turn.data[i] = 0.0;
      D3 x = load(f.rest.data + 3 * i), v = none, force = none, aim = x;
      if (adr >= 0) {
        const double m = rod.mass.data[i], weighs = rod.body.data[i];
        x = exact(f.qpos.data + f.qposadr.data[i], load(f.now.data + 3 * i) + zero(i)) - zero(i);
        v = exact(f.qvel.data + adr, load(f.speed.data + 3 * i));
        const D3 along = weighs * gravity + load(f.qfrc_applied.data + adr) + load(f.qfrc_passive.data + adr);
        force = add_turned(along, R, load((const float*)f.xfrc_applied.data + 6 * f.bodyid.data[i]));
        aim = x + h * v + (h * h / m) * (force + (m - weighs) * gravity);
      }
      store(rod.start.data + 3 * i, x);
      store(rod.vel.data + 3 * i, v);
      store(rod.external.data + 3 * i, force);
      store(rod.aim.data + 3 * i, aim);
    });
  }
};

template <class Fields>
PALPATE void begin_rods(const Fields& f, Thread, int) {
  begin(WorldRod<Fields>{f, f.rods.data[0]}, f.timestep);
}

template <class Fields>
PALPATE void end_rods(const Fields& f, Thread, int) {
  end(WorldRod<Fields>{f, f.rods.data[0]}, f.timestep);
  if (f.rods.data[0].status.data[0] < 0) f.bad.data[0] = 1;
}

// Flags the worlds with numbers that are not finite, or huge.
template <class Fields>
PALPATE void find_bad_rods(const Fields& f, Thread t, int) {
  bool bad = false;
  each_item(t, 3 * f.rods.data[0].nnode, [&](int a) {
    bad = bad || !(fabs(f.now.data[a]) < 1e6 && fabs(f.speed.data[a]) < 1e6);
  });
  if (bad) f.bad.data[0] = 1;
}

}  // namespace palpate
