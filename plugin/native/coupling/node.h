// The coupling of an organ to MuJoCo, for one of its nodes (docs/physics.md, coupling).
//
// The organ's step gives a node the velocity v + dv. It reaches MuJoCo as the force
//
//   qfrc_passive = Mhat dv / h - f_ext - f_c
//
// on the node's degrees of freedom, with Mhat their inertia (mass + armature), f_ext what MuJoCo
// adds to them by itself in this step and f_c their constraint force of the last step. Both are on
// the right-hand side of the organ's step too, as its lagged force f_ext + f_c. MuJoCo's own step
// then ends at v + dv + h (f_c_new - f_c) / Mhat: at rest the contact force is exact whatever h is.
#pragma once
#include "core/d3.h"

namespace palpate {

// Of contact forces, the change that says something about the inertia which they meet: its share of
// them, and the share of it that does not cancel; and the most that it may make more in a step.
constexpr double CHANGE = 0.005, COHERENT = 0.7, FASTER = 2.0;

// Time without motion and force after which an organ sleeps [s].
constexpr double QUIET = 0.2;

// h^2 + h damping, `eased` times h taken off the damping where that is no more than MOST of it. Where
// `eased` is negative, the damping is no less than so many h.
PALPATE double weight_of_stiffness(double h, double damping, double eased) {
  constexpr double MOST = 0.5;
  if (eased < 0.0) return h * h + h * (damping > -eased * h ? damping : -eased * h);
  const double taken = eased * h < MOST * damping ? eased * h : MOST * damping;
  return h * h + h * (damping - taken);
}

// How much of a change df of the contact forces an organ takes. MuJoCo has solved the contacts with
// the inertia Mhat. The change is a descent direction of their dual problem, whose curvature along it
// is df^T A^-1 df; `ratio` is what MuJoCo took it for, df^T Mhat^-1 df, over that. The minimum along df
// is at `ratio` (exact line search, Nocedal and Wright 2006, eq. 3.55), and below 1/2 the whole change
// goes past it and up again: contacts chatter. So the organ takes `ratio` there, and the whole of df
// from 3/4 on. At rest df is 0, and the contact force is exact.
PALPATE float relaxation(float ratio) {
  if (ratio < 0.5f) return ratio;
  return ratio < 0.75f ? 2.0f * ratio - 0.5f : 1.0f;
}
PALPATE bool touched(D3 contact) { return contact != D3{0.0, 0.0, 0.0}; }
PALPATE D3 relaxed(D3 before, D3 now, double ratio) {
  const double part = relaxation((float)ratio);
  return part < 1.0 && touched(now) ? before + part * (now - before) : now;
}

// df^T Mhat^-1 df of the impulses by which contact forces changed. Where an organ is let go, the force
// of contacts that part ends at 0 and not at the minimum, which lies farther off: by the share of the
// force that is gone. Not where another contact takes over, as under an organ that another has hit.
struct Expected {
  double sum = 0.0, before = 0.0, kept = 0.0, after = 0.0;

  PALPATE void add(D3 impulse, double Mhat, D3 was, D3 now) {
    sum += dot(impulse, impulse) / Mhat;
    before += norm(was);
    after += norm(now);
    if (touched(now)) kept += norm(was);
  }
  PALPATE float value() const {
    if (after >= before) return (float)sum;
    return kept > 0.0 ? (float)(sum * before / kept) : 0.0f;  // none where all is gone
  }
};

// What MuJoCo adds to a node's dofs by itself, in the organ's frame: forces along them, and one on
// their body, `wrench`, in the world's.
PALPATE D3 external(D3 along, const double* frame, const double* wrench) {
  return add_turned(along, frame, load(wrench));
}

// The force that brings v + dv through MuJoCo's step, from Mhat dv / h and what acts besides; none
// where that is not a number.
PALPATE D3 passive(D3 rate, D3 lagged) {
  const D3 f = rate - lagged;
  return {f.x == f.x ? f.x : 0.0, f.y == f.y ? f.y : 0.0, f.z == f.z ? f.z : 0.0};
}

// Lets MuJoCo's solver meet the inertia Mhat at the dofs of a node, which start at `adr`; their
// diagonals in M are at the three addresses.
template <class Arrays>
PALPATE void set_inertia(const Arrays& mj, const int* massadr, int adr, D3 Mhat) {
  const double diagonal[3] = {Mhat.x, Mhat.y, Mhat.z};
  for (int c = 0; c < 3; ++c) {
    mj.M.data[massadr[c]] = mj.qLD.data[massadr[c]] = diagonal[c];
    mj.qLDiagInv.data[adr + c] = 1.0 / diagonal[c];
  }
}

// Where the solve for dv starts: the line through the last two.
PALPATE D3 forecast(D3 last, D3 before) { return 2.0 * last - before; }

// How many times their inertia at rest the nodes in contact have: a secant through the last change
// of the contact forces, as in the coupling of fluids and structures (Kuettler and Wall 2008,
// doi:10.1007/s00466-008-0255-5). Impulses that cancel say nothing about what a tool meets, and it
// meets no more than one node alone has, `heaviest` times.
struct Secant {
  double gross = 0.0;  // sizes of the changes of the forces
  double whole = 0.0;  // sizes of the forces
  D3 sum = {0.0, 0.0, 0.0};  // of the changes

  PALPATE void add(D3 change, double force) {
    sum += change;
    gross += norm(change);
    whole += force;
  }

  // `ratio`: what MuJoCo expected the impulses to do over what they did, see `System`.
  PALPATE double heavier(double now, double heaviest, double ratio) const {
    if (whole == 0.0) return 1.0;
    if (gross < CHANGE * whole || norm(sum) < COHERENT * gross) return now;
    const double seen = now * ratio;
    const double most = FASTER * now < heaviest ? FASTER * now : heaviest;
    return seen < 1.0 ? 1.0 : seen > most ? most : seen;
  }
};

}  // namespace palpate
