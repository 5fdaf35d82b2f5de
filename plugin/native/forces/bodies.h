// Bodies of MuJoCo that an organ holds, or that hold it, by forces of its own.
//
// Kernels get what their world has of its own: MuJoCo's doubles, of which there is one world, or
// mujoco_warp's floats.
#pragma once
#include "coupling/node.h"

namespace palpate {

// A symmetric matrix, by its upper half.
struct Sym { double xx, xy, xz, yy, yz, zz; };
PALPATE D3 operator*(const Sym& m, D3 a) {
  return {m.xx * a.x + m.xy * a.y + m.xz * a.z, m.xy * a.x + m.yy * a.y + m.yz * a.z,
          m.xz * a.x + m.yz * a.y + m.zz * a.z};
}
PALPATE Sym operator*(double s, const Sym& m) {
  return {s * m.xx, s * m.xy, s * m.xz, s * m.yy, s * m.yz, s * m.zz};
}

// A node's matrix in `State.hold`.
PALPATE float* hold_at(float* hold, int node) {
  return hold + node / LANES * 6 * LANES + node % LANES;
}
PALPATE Sym load_hold(const float* p) {
  return {p[0], p[LANES], p[2 * LANES], p[3 * LANES], p[4 * LANES], p[5 * LANES]};
}

struct Place { D3 at, vel; };

// Displacement of a vertex from rest, its velocity and its rest place, in the organ's frame: of an organ that is in
// MuJoCo's memory or, with windows, in the plugin state.
template <class Arrays, class Nodes>
PALPATE auto moved_by(const Arrays& mj, const Nodes& o, int i) -> decltype(*o.qposadr.data, D3{}) {
  if (o.windowed) return load(o.disp.data + 3 * i);
  if (i >= o.inner) return load(o.disp.data + 3 * (i - o.inner));
  const int adr = o.qposadr.data[i];
  return adr < 0 ? D3{0.0, 0.0, 0.0} : load(mj.qpos.data + adr) - load(mj.qpos0.data + adr);
}
template <class Arrays, class Nodes>
PALPATE auto goes_by(const Arrays& mj, const Nodes& o, int i) -> decltype(*o.qposadr.data, D3{}) {
  if (o.windowed) return load(o.vel.data + 3 * i);
  if (i >= o.inner) return load(o.vel.data + 3 * (i - o.inner));
  const int dof = o.dofadr.data[i];
  return dof < 0 ? D3{0.0, 0.0, 0.0} : load(mj.qvel.data + dof);
}

template <class Nodes>
PALPATE auto rest_of(const Nodes& o, int i) -> decltype(*o.qposadr.data, D3{}) {
  return load(o.rest.data + 3 * i);
}

// Of one in the solver's own vectors.
template <class Nodes>
PALPATE auto rest_of(const Nodes& o, int i) -> decltype(*o.node.data, D3{}) {
  return load(o.rest.data + 3 * o.node.data[i]);
}
template <class Arrays, class Nodes>
PALPATE auto moved_by(const Arrays&, const Nodes& o, int i) -> decltype(*o.node.data, D3{}) {
  return load_lane(o.disp.data + offset_of(o.node.data[i]));
}
template <class Arrays, class Nodes>
PALPATE auto goes_by(const Arrays&, const Nodes& o, int i) -> decltype(*o.node.data, D3{}) {
  return load_lane(o.vel.data + offset_of(o.node.data[i]));
}

// Where a vertex is in the world, and its velocity.
template <class Arrays, class Nodes>
PALPATE Place place_of(const Arrays& mj, const Nodes& o, int i) {
  const double* R = o.frame.data;
  return {load(o.origin.data) + turned(R, rest_of(o, i) + moved_by(mj, o, i)),
          turned(R, goes_by(mj, o, i))};
}

// Adds to the solver's input a force on a node that falls by `weight` dv / h in the step.
template <class Solve>
PALPATE void push_node(const Solve& s, int node, D3 force, const Sym& weight) {
  float* hold = hold_at(s.hold.data, node);
  const double add[6] = {weight.xx, weight.xy, weight.xz, weight.yy, weight.yz, weight.zz};
  for (int k = 0; k < 6; ++k) hold[LANES * k] += (float)add[k];
  float* ext = s.force_ext.data + offset_of(node);
  store_lane(ext, load_lane(ext) + force);
}

// A velocity about the centre of mass of a body's tree: of turning, and of the centre.
struct Twist { D3 spin, vel; };

// The velocity of a point that is `arm` from where a motion has its velocity.
template <class Motion>
PALPATE D3 velocity_at(const Motion& m, D3 arm) { return m.vel + cross(m.spin, arm); }

// The velocity of a body, and where `leads` says so what its last acceleration adds in the step.
template <class Arrays>
PALPATE Twist twist(const Arrays& mj, int b, bool leads) {
  Twist out = {load(mj.cvel.data + 6 * b), load(mj.cvel.data + 6 * b + 3)};
  for (; leads && b > 0; b = mj.body_parentid.data[b])
    for (int d = 0; d < mj.body_dofnum.data[b]; ++d) {
      const int dof = mj.body_dofadr.data[b] + d;
      const double dv = mj.timestep.data[0] * mj.qacc_warmstart.data[dof];
      out.spin += dv * load(mj.cdof.data + 6 * dof);
      out.vel += dv * load(mj.cdof.data + 6 * dof + 3);
    }
  return out;
}

// Where a point is from the centre of mass of a body's tree.
template <class Arrays>
PALPATE D3 arm_of(const Arrays& mj, int b, D3 point) {
  return point - load(mj.subtree_com.data + 3 * mj.body_rootid.data[b]);
}

// Adds to the passive forces a force on a body, in the world, and its torque about the centre of
// mass of the body's tree.
template <class Arrays>
PALPATE void push_body(const Arrays& mj, int b, D3 force, D3 torque) {
  for (; b > 0; b = mj.body_parentid.data[b])
    for (int d = 0; d < mj.body_dofnum.data[b]; ++d) {
      const int dof = mj.body_dofadr.data[b] + d;
      const auto* axis = mj.cdof.data + 6 * dof;
      mj.qfrc_passive.data[dof] += dot(load(axis), torque) + dot(load(axis + 3), force);
    }
}

}  // namespace palpate
