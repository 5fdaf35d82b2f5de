// Blades that cut: a segment goes through the wall of an organ without contact, and a spring holds it
// to a point of the tissue, its seat. Doubles; on the CPU beside MuJoCo, on CUDA a warp a world, whose
// threads do all the same but for looking at triangles, of which each has its part.
//
// With G the energy that it takes to open an area and t the thickness of the wall, a length dl takes
// G t dl. So the tissue bears a blade up to the force G t along the surface, and there the seat goes on
// through the tissue as far as brings the spring back to it: a return mapping, as of a slider that is
// ideally plastic, which takes G t of energy a length whatever the step and the speed. What the seat goes
// through is the path of the cut. A blade that comes from above pierces the wall first, with up to G
// times its width along itself, over the wall's thickness. On its way back it meets nothing.
//
// Where a blade enters at a free edge, the mesh has a vertex or two to bear it. Where they give way before they
// bear G t, the blade notches the edge: the force grows to G t until the mesh comes apart there.
//
// In a solid t is how deep the blade is, the force is across it, and is spread along it: at one place of
// the skin it would drag soft tissue along.
//
// Places are in the organ's frame; a blade slides freely along itself.
#pragma once
#include "cutting/blade_anchor.h"

namespace palpate {

// Shares of an edge of the mesh: between points of a path, and the most that a seat goes in a step.
constexpr double SPACING = 0.4, LEAP = 1.0;
constexpr double BATCH = 1.8;  // edges that come apart at once, at least
constexpr double LEVEL = 0.05;  // least share of a way along the surface that is across the blade
constexpr double AFRESH = 2.0;  // edges from its last seat from which a blade enters anew
// Share of its length to which the tissue ahead of a blade is pressed together where it gives way: below
// 1 / sqrt(3) a St. Venant-Kirchhoff membrane bears less and less.
constexpr double CRUSHED = 0.6;
// Of BLADE_WAIT: the blade has entered at an edge, and notches it.
constexpr double ENTERED = -1.0, NOTCHES = -2.0;
constexpr double BLOCKED = 0.3;  // share of its way that a seat goes where it is not at a boundary
constexpr int ALONG = 4, HELD = 4 * ALONG + 3;  // places along a blade that bear it, and their vertices
constexpr double LEAVES = 0.8;  // cosine of a pull to the normal of a face by which a blade leaves
enum { AWAY, PIERCING, THROUGH };  // stages
enum { NOTHING, LONG, ENDED };  // what is due

// What stretches a blade's spring: across the blade, and along the surface; not what is behind the end
// of the cut, along `back`, where the blade came from.
struct Stretch { D3 pull, flat, back; bool behind; double far; };

PALPATE Stretch stretch_of(D3 pull, D3 blade, const Seated& at, D3 toward) {
  const D3 goes = unit_of(carried(toward, at.rest, at.x));
  Stretch s = {pull, across(pull, at.normal), unit_of(across(goes, blade)), false, 0.0};
  s.far = -dot(s.flat, goes);
  s.behind = s.far > 0.0;
  if (s.behind) {
    s.pull = across(s.pull, s.back);
    s.flat = across(s.pull, at.normal);
  }
  return s;
}

// The force that tissue bears of a blade: in a solid by how deep it is, in a wall by how far it is in.
template <class Fields>
PALPATE double borne(const Fields& f, const double* law, double deep, const double* s) {
  if (law[LAW_SOLID] != 0.0) return deep > 0.0 ? law[LAW_FORCE] * deep : 0.0;
  if (s[BLADE_WAIT] != NOTCHES) return law[LAW_FORCE];
  const double in = norm(load(s + BLADE_AT) - load(s + BLADE_TRAIL)) / (BATCH * f.edge);
  return (in < 1.0 ? in : 1.0) * law[LAW_FORCE];
}

// How far what counts of a spring is stretched: of a solid all that is across the blade, since that is what
// moves its edge through the tissue, of a wall what is along it.
PALPATE double pull_of(const double* law, const Stretch& s) {
  return norm(law[LAW_SOLID] != 0.0 ? s.pull : s.flat);
}

// Adds the seat to the path, where it is far enough from the last point.
PALPATE void note_path(double* s, double spacing) {
  const int count = (int)s[BLADE_COUNT];
  const D3 at = load(s + BLADE_AT);
  const double deep = s[BLADE_DEPTH];
  double* last = s + BLADE_BELOW + (count ? count - 1 : 0);
  const bool near = count && norm(at - load(s + BLADE_TRAIL + 3 * (count - 1))) < spacing;
  if (count == TRAIL || near) {
    if (deep > *last) *last = deep;
    return;
  }
  store(s + BLADE_TRAIL + 3 * count, at);
  s[BLADE_BELOW + count] = deep;
  s[BLADE_COUNT] += 1.0;
}

// Puts a blade that goes through the surface on its seat there.
template <class Fields>
PALPATE void sit_down(const Fields& f, Thread t, int i, const Line& line, double* s) {
  const D3 zero = {0.0, 0.0, 0.0}, toward = cuts_toward(f, i);
  const bool shears = f.geom.data[2 * i + 1] >= 0;
  if (shears && toward == zero) return;
  int elem = 0;
  D3 weight, rest[3], x[3];
  const double deep = enters(f, t, line, elem, weight);
  if (deep < 0.0) return;
  corners_at_rest(f, elem, rest);
  corners_now(f, elem, x);
  const Line later = line_of(f, i, f.mj.timestep.data[0]);
  const double fast = 2.0 * norm(later.from - line.from);
  const D3 seat = blend(rest, weight);
  const bool afresh = s[BLADE_OPENED] == 0.0 || norm(seat - load(s + BLADE_AT)) > AFRESH * f.edge;
  const double* law = f.law.data + LAW_LENGTH * i;
  const bool sideways = deep > law[LAW_WALL] + fast || shears;
  s[BLADE_STAGE] = sideways ? THROUGH : PIERCING;
  s[BLADE_ELEM] = elem;
  s[BLADE_COUNT] = 0.0;
  s[BLADE_DEPTH] = law[LAW_SOLID] != 0.0 && sideways ? deep : 0.0;
  if (sideways && afresh && !shears) s[BLADE_WAIT] = ENTERED;
  store(s + BLADE_AT, seat);
  store(s + BLADE_TOWARD, unit_of(carried(toward, x, rest)));
  if (sideways) note_path(s, 0.0);
}

// Moves the seat of a blade along the surface, against what tissue bears along it; returns whether it could.
template <class Fields>
PALPATE bool advance(const Fields& f, Thread t, int i, D3 way, const Seated& from, double bears, double* s) {
  const D3 was = load(s + BLADE_AT), goes = carried(way, from.x, from.rest);
  int elem = (int)s[BLADE_ELEM];
  D3 weight, rest[3];
  find_seat(f, t, was + goes, elem, weight);
  corners_at_rest(f, elem, rest);
  const D3 now = blend(rest, weight);
  const double gone = norm(now - was);
  if (!(gone > BLOCKED * norm(goes))) return false;
  s[BLADE_ELEM] = elem;
  store(s + BLADE_AT, now);
  if (s[BLADE_STAGE] == PIERCING) return true;
  store(s + BLADE_TOWARD, unit_of(now - was));
  s[BLADE_WORK] += bears * norm(way);
  s[BLADE_OPENED] += gone;
  note_path(s, SPACING * f.edge);
  return true;
}

// Whether the tissue of a wall ahead of a blade, over an edge of the mesh, gives way.
template <class Fields>
PALPATE bool gives_way(const Fields& f, Thread t, D3 way, const Seated& at, const double* s) {
  const D3 here = load(s + BLADE_AT), goes = f.edge * unit_of(carried(way, at.x, at.rest));
  int elem = 0;
  D3 weight, rest[3], x[3];
  find_seat(f, t, here + goes, elem, weight);
  corners_at_rest(f, elem, rest);
  corners_now(f, elem, x);
  return dot(blend(x, weight) - at.at, way) < CRUSHED * norm(blend(rest, weight) - here);
}

// Brings the spring of a blade that sits to what the tissue bears; ends the cut where the blade is out
// of the tissue, or cuts another way.
template <class Fields>
PALPATE void give_way(const Fields& f, Thread t, int i, const Line& line, double* s) {
  const double* law = f.law.data + LAW_LENGTH * i;
  Seated at = seated(f, s);
  const double place = dot(at.at - line.from, line.along);
  const Depth reach = depth_of(f, t, i, line, place, at);
  const double deep = reach.deep, most = borne(f, law, deep, s), slack = most / law[LAW_STIFFNESS];
  // An edge more where it goes through, so that nothing is left below.
  if (law[LAW_SOLID] != 0.0 && s[BLADE_STAGE] == THROUGH)
    s[BLADE_DEPTH] = deep > 0.0 ? deep + (reach.through ? f.edge : 0.0) : 0.0;
  const double before = s[BLADE_STAGE] == PIERCING ? slack : 0.0;
  bool out = place < -before || place > line.length + before || line.length == 0.0;
  if (!out) {
    const D3 pull = line.from + place * line.along - at.at;
    const Stretch now = stretch_of(pull, line.along, at, load(s + BLADE_TOWARD));
    const double size = pull_of(law, now);
    out = now.far > LEAP * f.edge;  // it has been drawn back, or goes out where the solid ends
    out = out || (law[LAW_SOLID] != 0.0 && dot(now.pull, at.normal) > LEAVES * norm(now.pull));
    const D3 unit = unit_of(now.flat);
    if (!out && size > 0.0 && s[BLADE_WAIT] == ENTERED && gives_way(f, t, unit, at, s))
      s[BLADE_WAIT] = NOTCHES;  // from the next step on
    if (!out && size > slack) {
      const double tilt = dot(unit, line.along), across = 1.0 - tilt * tilt;
      const double level = law[LAW_SOLID] != 0.0 ? sqrt(across) : across;
      const double far = (size - slack) / (level > LEVEL ? level : LEVEL), leap = LEAP * f.edge;
      const double bears = law[LAW_SOLID] != 0.0 ? level * most : most;
      out = now.behind || !advance(f, t, i, (far < leap ? far : leap) * unit, at, bears, s);
    }
  }
  if (out) {
    s[BLADE_STAGE] = AWAY;
  } else if (s[BLADE_STAGE] == PIERCING) {
    const double depth = deep - law[LAW_PIERCE] / law[LAW_STIFFNESS];
    if (depth > s[BLADE_DEPTH]) {
      const double goes = depth < law[LAW_WALL] ? depth : law[LAW_WALL];
      s[BLADE_WORK] += law[LAW_PIERCE] * (goes - s[BLADE_DEPTH]);
      s[BLADE_DEPTH] = goes;
    }
    if (s[BLADE_DEPTH] >= law[LAW_WALL]) {
      s[BLADE_STAGE] = THROUGH;
      note_path(s, 0.0);
    }
  }
}

// Says which vertices bear a blade, by which shares, and returns where they do and their velocity. In a
// solid it is those around its edge, evenly along it, else and where there are none those at its seat.
struct Borne { D3 at, vel; };

template <class Fields>
PALPATE Borne take_hold(const Fields& f, Thread t, int i, const double* s, const Seated& at,
                        const Depth& depth) {
  const bool spread = s[BLADE_STAGE] == THROUGH && depth.deep > 0.0 && dot(depth.in, depth.in) > 0.0;
  Borne out = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
  const auto hold = [&](int c, int v, double share) {
    out.vel += share * load_lane(f.solve.vel.data + offset_of(f.solve.node.data[v]));
    if (t.tid == 0) f.share.data[HELD * i + c] = share, f.held.data[HELD * i + c] = v;
  };
  double left = 1.0;
  int tet = 0;
  for (int k = 0; k < ALONG; ++k) {
    const D3 place = at.at + ((k + 0.5) / ALONG * depth.deep) * depth.in;
    D3 w = {0.0, 0.0, 0.0};
    const double part = spread && find_tet(f, t, place, tet, w) ? 1.0 / ALONG : 0.0;
    const double share[4] = {part * (1.0 - w.x - w.y - w.z), part * w.x, part * w.y, part * w.z};
    for (int c = 0; c < 4; ++c) hold(4 * k + c, part > 0.0 ? f.tet.data[4 * tet + c] : 0, share[c]);
    out.at += part * place;
    left -= part;
  }
  const double share[3] = {left * at.weight.x, left * at.weight.y, left * at.weight.z};
  for (int c = 0; c < 3; ++c) hold(4 * ALONG + c, f.elem.data[3 * (int)s[BLADE_ELEM] + c], share[c]);
  out.at += left * at.at;
  return out;
}

// What is left of a spring's matrix across some directions.
PALPATE Sym without(const Sym& m, double k, D3 a) {
  return {m.xx - k * a.x * a.x, m.xy - k * a.x * a.y, m.xz - k * a.x * a.z,
          m.yy - k * a.y * a.y, m.yz - k * a.y * a.z, m.zz - k * a.z * a.z};
}

// The force of a blade on its seat at the end of the step, and what of its spring weighs on the change
// of the seat's velocity. Where it would be more than the tissue bears it is that, and less by as
// much of the way to the blade as the tissue goes: light tissue must not be thrown ahead of the blade.
template <class Fields>
PALPATE void bear(const Fields& f, Thread t, int i, const Line& line, const double* s) {
  const double* law = f.law.data + LAW_LENGTH * i;
  const double h = f.mj.timestep.data[0], damping = f.number.data[DAMPING];
  const double reach = f.ahead * h + damping, k = law[LAW_STIFFNESS], weight = k * f.gain * h * (h + damping);
  const Seated at = seated(f, s);
  Line later = line_of(f, i, reach);
  if (later.length == 0.0) later = line;
  // Whether the seat will give way is told by the blade alone: where it does, tissue is at rest.
  const D3 off = at.at - later.from;
  const double place = dot(off, later.along);
  const Depth depth = depth_of(f, t, i, later, place, at);
  const Borne by = take_hold(f, t, i, s, at, depth);
  const D3 lag = reach * by.vel;
  const Stretch then = stretch_of(place * later.along - off, later.along, at, load(s + BLADE_TOWARD));
  D3 force = k * (then.pull - across(lag, later.along));
  Sym hold = without({weight, 0.0, 0.0, weight, 0.0, weight}, weight, later.along);
  if (then.behind) {
    hold = without(hold, weight, then.back);
    force = across(force, then.back);
  }
  const double size = k * pull_of(law, then), most = borne(f, law, depth.deep, s);
  if (size > most) {
    const double share = most / size;
    hold = share * hold;
    force = (share * k) * then.pull;
  }
  if (s[BLADE_STAGE] == PIERCING) {
    const bool low = place < later.length - place;
    const D3 tip = (low ? -1.0 : 1.0) * later.along;
    const double press = k * ((low ? place : later.length - place) - s[BLADE_DEPTH]);
    if (press > 0.0 && press < law[LAW_PIERCE]) {
      force += (press - k * dot(lag, tip)) * tip;
      hold = without(hold, -weight, tip);
    } else if (press > 0.0) {
      force += law[LAW_PIERCE] * tip;
    }
  }
  if (t.tid > 0) return;
  store(f.force.data + 3 * i, force);
  store(f.point.data + 3 * i, by.at + then.pull);
  const double entries[6] = {hold.xx, hold.xy, hold.xz, hold.yy, hold.yz, hold.zz};
  for (int c = 0; c < 6; ++c) f.hold.data[6 * i + c] = entries[c];
  for (int c = HELD * i; c < HELD * (i + 1); ++c) {
    const double share = f.share.data[c];
    if (share > 0.0) push_node(f.solve, f.solve.node.data[f.held.data[c]], share * force, share * hold);
  }
}

// What is due of the path of a blade.
template <class Fields>
PALPATE int due_of(const Fields& f, const double* s) {
  if (!(s[BLADE_COUNT] > 0.0)) return NOTHING;
  if (s[BLADE_STAGE] == AWAY) return ENDED;
  const double far = norm(load(s + BLADE_AT) - load(s + BLADE_TRAIL));
  const double wait = s[BLADE_WAIT] > 0.0 ? s[BLADE_WAIT] : BATCH * f.edge;
  return far > wait || s[BLADE_COUNT] == TRAIL ? LONG : NOTHING;
}

// Adds the blades' forces to the solver's input, and finds what state they will be in. What is due is
// kept until it is done where `keeps` says so, as long as there is a path.
template <class Fields>
PALPATE void enter_blades(const Fields& f, Thread t, int keeps) {
  const D3 zero = {0.0, 0.0, 0.0};
  if (t.tid == 0) f.solve.quiet.data[0] = 0.0;
  for (int i = 0; i < f.nblade; ++i) {
    double s[BLADE_LENGTH];
    for (int c = 0; c < BLADE_LENGTH; ++c) s[c] = f.state.data[BLADE_LENGTH * i + c];
    if (t.tid == 0) store(f.force.data + 3 * i, zero);
    int due = NOTHING;
    const bool cuts = f.law.data[LAW_LENGTH * i + LAW_STIFFNESS] != 0.0;  // else by its current
    const Line line = line_of(f, i, 0.0);
    if (cuts && s[BLADE_STAGE] == AWAY && line.length > 0.0) sit_down(f, t, i, line, s);
    if (cuts && s[BLADE_STAGE] != AWAY) {
      give_way(f, t, i, line, s);
      due = due_of(f, s);
      if (s[BLADE_STAGE] != AWAY) bear(f, t, i, line, s);
    }
    if (t.tid > 0) continue;
    for (int c = 0; c < BLADE_LENGTH; ++c) f.next.data[BLADE_LENGTH * i + c] = s[c];
    if (!keeps || due > f.due.data[i] || !(s[BLADE_COUNT] > 0.0)) f.due.data[i] = due;
  }
}

// Ends the forces with what the step made of the seats' velocities, and lets the blades feel them.
template <class Fields>
PALPATE void act_blades(const Fields& f, Thread t, int) {
  if (t.tid > 0) return;
  const bool ok = f.solve.status.data[3] == 0.0f;
  const D3 zero = {0.0, 0.0, 0.0};
  for (int i = 0; i < f.nblade; ++i) {
    const double* s = f.next.data + BLADE_LENGTH * i;
    if (s[BLADE_STAGE] == AWAY || f.law.data[LAW_LENGTH * i + LAW_STIFFNESS] == 0.0) continue;
    D3 dv = zero;
    for (int c = HELD * i; c < HELD * (i + 1); ++c) {
      const int node = f.solve.node.data[f.held.data[c]];
      dv += f.share.data[c] * load_lane(f.solve.dvel.data + offset_of(node));
    }
    const double* p = f.hold.data + 6 * i;
    const Sym hold = {p[0], p[1], p[2], p[3], p[4], p[5]};
    const D3 pull = (1.0 / f.mj.timestep.data[0]) * (hold * dv);
    const D3 force = ok ? load(f.force.data + 3 * i) - pull : zero;
    store(f.force.data + 3 * i, force);
    const D3 point = load(f.own.origin.data) + turned(f.own.frame.data, load(f.point.data + 3 * i));
    push_blade(f, i, point, zero - turned(f.own.frame.data, force));
  }
}

// Keeps the blades' state.
template <class Fields>
PALPATE void keep_blades(const Fields& f, Thread t, int) {
  each_item(t, BLADE_LENGTH * f.nblade, [&](int i) { f.state.data[i] = f.next.data[i]; });
}

}  // namespace palpate
