// Needles through an organ. A needle is an arc of a circle, rigid and free or held by MuJoCo's bodies; what it goes
// through are points of the tissue, its holes, tied to the nearest points of the arc. Doubles; on the CPU beside
// MuJoCo, on CUDA a warp a world, whose threads do all the same but for looking at triangles and tetrahedra.
//
// With G the energy that it takes to open an area and b the width of the slit that the tip opens, tissue bears the
// tip up to G b along the needle, and there its seat goes on through the tissue as far as brings its spring back to
// that: a return mapping, which takes G b of energy a length whatever the step and the speed (tearing; Barnett et al.
// 2015, doi:10.1115/1.4030374). The surface of a solid may bear more: the force rises to a peak where the tip comes
// in, and to a second where it leaves (Frick et al. 2001, doi:10.1016/S0021-9290(01)00099-9). A sheet is pierced over
// its thickness. Holes are held across the needle; along it each is dragged by friction, a force by length of the
// needle in tissue (Okamura et al. 2004, doi:10.1109/TBME.2004.831542), that sticks or slips.
//
// Across it, tissue bears G of a needle or thread by its length there, as it does of a thin wire that cuts it (Goda et
// al. 2024, arXiv:2412.02021), and of a short one what its tip took. Beyond that the hole tears through the tissue, by
// a return mapping too, until it is out of its edge.
//
// Where the swage has gone through, a hole holds the thread by a spring to a place on it, which slips where it bears more
// along the thread than friction: T (exp(mu theta) - 1), T the smaller one of the tensions on both sides and theta the
// angle between them (the capstan's law), and that by length.
//
// Both ends are implicit. The tissue has the springs in its matrix and takes the needle to move on as it does, the
// needle their part of its inertia in MuJoCo's: each end alone, which is stable whatever either weighs (for two
// points, stiffness and masses over five decades, no mode of the pair grows).
//
// Places are in the organ's frame, places along a needle from its swage.
#pragma once
#include "core/geom.h"
#include "cutting/blade_anchor.h"

namespace palpate {

enum { AWAY, TOUCHING, INSIDE };      // stages of a tip
enum { INTO, WITHIN, OUT, THROUGH };  // holes: into a solid, in it, out of it; through a sheet

constexpr int POINTS = HOLES + 1;  // that hold a needle; the last is its tip
// Shares of a needle's length: of its end that looks for tissue, and from a hole that it has just made.
constexpr double POINT = 0.1, CLEAR = 0.04;
constexpr double SKIDS = 2.0;   // times its way along a needle that a tip is off its seat before it lets go
constexpr double BELOW = 0.02;  // edges under the surface where a tip is in a solid
constexpr int BESIDE = 2;  // edges from the one that is in a hole to those that tell how a thread turns there
constexpr double HAIRPIN = 0.2;  // least share of a thread's friction along the mean of its directions, where it turns back
constexpr double ENDS = 1e-9;   // share of a thread, or of its last edge, that is its end
constexpr double BACK = 2e-3;   // of a needle's length that a hole goes back onto it, lest it goes to and fro
constexpr double STOPS = 1e6;   // what a bead there, or a knot, bears at a hole [N]
// In thicknesses of a thread: how far before a hole a knot stops, how near in it strands are to each other, and how far
// along the thread at least, as one that just bends is.
constexpr double BEFORE = 2.0, TOUCHES = 1.2, TURNS = 3.0;
constexpr double STRETCHED = 1.2;  // more than an edge ever is
constexpr double MISSES = 0.7;  // of its way, that a hole does not follow where it is torn out
constexpr double TIGHT = 1e-9;  // of what tissue bears, to which a return mapping brings it
constexpr double APART = 0.5;   // edges between holes in a solid, at least

// A needle where it is now.
struct Arc {
  D3 at, x, y;
  double circle, half, length;

  PALPATE double angle(double s) const { return (2.0 * s / length - 1.0) * half; }
  PALPATE D3 place(double s) const { return at + circle * (cos(angle(s)) * x + sin(angle(s)) * y); }
  PALPATE D3 along(double s) const { return cos(angle(s)) * y - sin(angle(s)) * x; }
  PALPATE double nearest(D3 p) const {
    return 0.5 * length * (1.0 + atan2(dot(p - at, y), dot(p - at, x)) / half);
  }
};

template <class Fields>
PALPATE Arc arc_of(const Fields& f, int i) {
  const int b = f.body.data[i];
  const auto* R = f.mj.xmat.data + 9 * b;
  const D3 zero = {0.0, 0.0, 0.0};
  const double* frame = f.own.frame.data;
  const double circle = f.circle.data[i], half = f.half.data[i];
  D3 x = add_turned(zero, frame, {R[0], R[3], R[6]}), y = add_turned(zero, frame, {R[1], R[4], R[7]});
  if constexpr (sizeof(*R) != sizeof(double)) x = unit_of(x), y = unit_of(across(y, x));  // to what TIGHT asks for
  return {add_turned(zero, frame, load(f.mj.xpos.data + 3 * b) - load(f.own.origin.data)), x, y, circle, half,
          2.0 * half * circle};
}

PALPATE D3 in_world(const double* frame, const double* origin, D3 p) { return load(origin) + turned(frame, p); }

template <class Fields>
PALPATE D3 velocity_of(const Fields& f, int b, const Twist& moving, D3 p) {
  const D3 arm = arm_of(f.mj, b, in_world(f.own.frame.data, f.own.origin.data, p));
  return add_turned({0.0, 0.0, 0.0}, f.own.frame.data, velocity_at(moving, arm));
}

// A point of the tissue: corners of a triangle or a tetrahedron, their shares, place and velocity.
struct Seat { int count, vert[4]; double share[4]; D3 at, vel; };

template <class Fields>
PALPATE Seat seat_of(const Fields& f, const double* elem, bool inside) {
  Seat out = {inside ? 4 : 3, {}, {}, {0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
  const int* corner = inside ? f.tet.data + 4 * (int)elem[0] : f.elem.data + 3 * (int)elem[0];
  out.share[0] = 1.0;
  for (int c = 1; c < out.count; ++c) out.share[0] -= out.share[c] = elem[c];
  for (int c = 0; c < out.count; ++c) {
    const int v = out.vert[c] = corner[c];
    out.at += out.share[c] * (load(f.own.rest.data + 3 * v) + moved_by(f.mj, f.own, v));
    out.vel += out.share[c] * load_lane(f.solve.vel.data + offset_of(f.solve.node.data[v]));
  }
  return out;
}

PALPATE void put_seat(double* elem, int which, D3 shares) {
  elem[0] = which;
  store(elem + 1, shares);
}

PALPATE double* hole(double* s, int h) { return s + NEEDLE_HOLE + HOLE_LENGTH * h; }
PALPATE bool on_thread(double* s, int h) { return hole(s, h)[HOLE_THREAD] > 0.0; }
PALPATE int kind_of(double* s, int h) { return (int)hole(s, h)[HOLE_KIND]; }
PALPATE bool in_solid(int kind) { return kind == INTO || kind == WITHIN; }

// Whether the needle is in the tissue from its last hole on.
PALPATE bool goes_in(double* s) {
  const int count = (int)s[NEEDLE_COUNT];
  return count > 0 && in_solid(kind_of(s, count - 1));
}

template <class Fields>
PALPATE Seat seat_of_hole(const Fields& f, double* s, int h) {
  return seat_of(f, hole(s, h) + HOLE_ELEM, kind_of(s, h) == WITHIN);
}

template <class Fields>
CALLED double place_of_hole(const Fields& f, const Arc& arc, double* s, int h) {
  return on_thread(s, h) ? 0.0 : arc.nearest(seat_of_hole(f, s, h).at);
}

// The thread of a needle, from the swage on: its nodes are bodies.
template <class Fields>
struct Strand {
  const Fields& f;
  int first, count;

  PALPATE double edge(int e) const { return f.edges.data[2 * (first + e)]; }
  PALPATE double length() const {
    double sum = 0.0;
    for (int e = 0; e + 1 < count; ++e) sum += edge(e);
    return sum;
  }
  PALPATE D3 at(int n) const {
    const int b = f.node.data[first + n];
    const D3 p = load(f.mj.xpos.data + 3 * b) + turned(f.mj.xmat.data + 9 * b, load(f.local.data + 3 * (first + n)));
    return add_turned({0.0, 0.0, 0.0}, f.own.frame.data, p - load(f.own.origin.data));
  }
  PALPATE double tension(int e) const {
    const double T = f.edges.data[2 * (first + e) + 1] * (norm(at(e + 1) - at(e)) - edge(e));
    return T > 0.0 ? T : 0.0;
  }
  // The edge that has a place, and its share there.
  PALPATE int find(double place, double& part) const {
    int e = 0;
    for (; e + 2 < count && place > edge(e); ++e) place -= edge(e);
    part = place < edge(e) ? place / edge(e) : 1.0;
    return e;
  }
};

// Makes a hole at the tip's seat.
PALPATE void make_hole(double* s, int kind, double place) {
  const int count = (int)s[NEEDLE_COUNT];
  double* made = hole(s, count);
  made[HOLE_KIND] = kind;
  made[HOLE_SLIP] = place;
  made[HOLE_THREAD] = made[HOLE_TORN] = 0.0;
  for (int c = 0; c < 4; ++c) made[HOLE_ELEM + c] = s[NEEDLE_ELEM + c];
  s[NEEDLE_COUNT] = count + 1;
}

template <class Fields>
PALPATE Strand<Fields> strand_of(const Fields& f, int i) {
  return {f, f.strand.data[2 * i], f.strand.data[2 * i + 1]};
}

// Finds the triangle that a line goes through, nearest to its end; one whose normal is along the line by `facing`
// (1 along, -1 against, 0 either).
template <class Fields>
CALLED bool find_triangle(const Fields& f, Thread me, const Line& s, int facing, int& elem, D3& weight) {
  return find_crossing(f, me, s, elem, weight, [&](const D3* x, double at) {
    return facing * dot(cross(x[1] - x[0], x[2] - x[0]), s.along) < 0.0 ? NOWHERE : s.length - at;
  }) >= 0.0;
}

// Puts the tip of a needle that goes through the surface on its seat there.
template <class Fields>
PALPATE void touch(const Fields& f, Thread t, int i, const Arc& arc, D3 fast, double* s) {
  const D3 along = arc.along(arc.length);
  const int count = (int)s[NEEDLE_COUNT];
  double back = POINT * arc.length + f.mj.timestep.data[0] * norm(fast);
  if (count) {
    const double clear = arc.length - place_of_hole(f, arc, s, count - 1) - CLEAR * arc.length;
    back = clear < back ? clear : back;
  }
  int elem = 0;
  D3 w;
  if (back <= 0.0 || !find_triangle(f, t, {arc.place(arc.length) - back * along, along, back}, f.ntet ? -1 : 0, elem, w))
    return;
  s[NEEDLE_STAGE] = TOUCHING;
  s[NEEDLE_DEPTH] = 0.0;
  put_seat(s + NEEDLE_ELEM, elem, {w.y, w.z, 0.0});
}

// Puts the seat of a tip in a solid on a place; returns whether that is in it.
template <class Fields>
CALLED bool sit_inside(const Fields& f, Thread t, D3 place, double* s) {
  int tet = s[NEEDLE_STAGE] == INSIDE ? (int)s[NEEDLE_ELEM] : 0;
  D3 w;
  if (!find_tet(f, t, place, tet, w)) return false;
  put_seat(s + NEEDLE_ELEM, tet, w);
  s[NEEDLE_STAGE] = INSIDE;
  return true;
}

// What the tissue bears of a tip.
template <class Fields>
PALPATE double borne(const Fields& f, const double* law, const double* s) {
  return s[NEEDLE_STAGE] == TOUCHING && f.ntet ? law[PIERCE_SURFACE] : law[PIERCE_FORCE];
}

// Moves the newest hole of a sheet to where the needle goes through it, if it would be pulled off the sheet where its tip
// first touched: while a thick wall gives way the tip turns aside.
template <class Fields>
PALPATE void meet_needle(const Fields& f, Thread t, int i, const Arc& arc, D3 normal, double* s) {
  const int n = (int)s[NEEDLE_COUNT] - 1;
  const D3 p = seat_of_hole(f, s, n).at;
  const double place = arc.nearest(p), reach = POINT * arc.length;
  const double clear = n ? place - place_of_hole(f, arc, s, n - 1) - CLEAR * arc.length : reach;
  const double back = clear < reach ? clear : reach;
  const D3 along = arc.along(place), at = arc.place(place), off = at - p;
  const double far = norm(off), bears = bears_across(f, i, arc, s, n) / f.law.data[PIERCE_LENGTH * i + PIERCE_STIFFNESS];
  int elem = 0;
  D3 w;
  if (far > bears && fabs(dot(off, normal)) > MISSES * far &&
      find_triangle(f, t, {at - back * along, along, back + reach}, 0, elem, w))
    put_seat(hole(s, n) + HOLE_ELEM, elem, {w.y, w.z, 0.0});
}

// A tip at a surface: it goes, or pierces it.
template <class Fields>
PALPATE void press(const Fields& f, Thread t, int i, const Arc& arc, double* s) {
  const double* law = f.law.data + PIERCE_LENGTH * i;
  D3 x[3];
  corners_now(f, (int)s[NEEDLE_ELEM], x);
  const Seat seat = seat_of(f, s + NEEDLE_ELEM, false);
  const D3 along = arc.along(arc.length), pull = arc.place(arc.length) - seat.at;
  const bool leaves = f.ntet && dot(cross(x[1] - x[0], x[2] - x[0]), along) > 0.0;
  const double ahead = dot(pull, along), aside = norm(across(pull, along)), bears = borne(f, law, s);
  if (leaves ? ahead < 0.0 || !goes_in(s) : ahead < 0.0 || aside > SKIDS * (ahead + law[PIERCE_CLEAR])) {
    s[NEEDLE_STAGE] = AWAY;
    if (leaves && goes_in(s)) sit_inside(f, t, arc.place(arc.length), s);
    return;
  }
  const double over = ahead - s[NEEDLE_DEPTH] - bears / law[PIERCE_STIFFNESS];
  if (!(over > 0.0) || s[NEEDLE_COUNT] >= HOLES) return;
  if (!f.ntet) {
    const double left = law[PIERCE_WALL] - s[NEEDLE_DEPTH], goes = over < left ? over : left;
    s[NEEDLE_DEPTH] += goes;
    s[NEEDLE_WORK] += bears * goes;
    if (goes < left) return;
  }
  const double place = arc.nearest(seat.at);
  make_hole(s, !f.ntet ? THROUGH : leaves ? OUT : INTO, place);
  if (!f.ntet) meet_needle(f, t, i, arc, unit_of(cross(x[1] - x[0], x[2] - x[0])), s);
  s[NEEDLE_STAGE] = AWAY;
  if (f.ntet && !leaves && !sit_inside(f, t, seat.at + (BELOW * f.edge) * along, s)) {
    s[NEEDLE_COUNT] -= 1.0;  // along a face: later
    s[NEEDLE_STAGE] = TOUCHING;
  }
}

// A tip in a solid cuts its way, and leaves holes behind.
template <class Fields>
PALPATE void cut_way(const Fields& f, Thread t, int i, const Arc& arc, double* s) {
  const double* law = f.law.data + PIERCE_LENGTH * i;
  const D3 along = arc.along(arc.length);
  const Seat seat = seat_of(f, s + NEEDLE_ELEM, true);
  const double ahead = dot(arc.place(arc.length) - seat.at, along), slack = law[PIERCE_FORCE] / law[PIERCE_STIFFNESS];
  const double goes = ahead < 0.0 ? ahead : ahead > slack ? ahead - slack : 0.0;
  const int count = (int)s[NEEDLE_COUNT];
  const bool room = count + 2 < HOLES;  // for where it leaves
  if (room && arc.nearest(seat.at) - place_of_hole(f, arc, s, count - 1) > APART * f.edge)
    make_hole(s, WITHIN, arc.nearest(seat.at));
  if (goes == 0.0) return;
  if (sit_inside(f, t, seat.at + goes * along, s)) {
    if (goes > 0.0) s[NEEDLE_WORK] += law[PIERCE_FORCE] * goes;
    return;
  }
  int elem = 0;
  D3 w;
  const double far = ahead + BELOW * f.edge;  // past what is crushed
  if (goes < 0.0 || !find_triangle(f, t, {seat.at, along, far}, 1, elem, w)) return;
  s[NEEDLE_STAGE] = TOUCHING;
  s[NEEDLE_DEPTH] = 0.0;
  put_seat(s + NEEDLE_ELEM, elem, {w.y, w.z, 0.0});
}

// Adds a force on a point of tissue, at a place of the needle, that falls by `hold` dv / h in the step; it is the needle
// that feels it, or the thread by itself.
template <class Fields>
CALLED void tie(const Fields& f, Thread t, int at, const Seat& seat, D3 place, D3 force, const Sym& hold, bool feels) {
  if (t.tid > 0) return;
  f.feels.data[at] = feels;
  store(f.force.data + 3 * at, force);
  store(f.point.data + 3 * at, place);
  const double entries[6] = {hold.xx, hold.xy, hold.xz, hold.yy, hold.yz, hold.zz};
  for (int c = 0; c < 6; ++c) f.hold.data[6 * at + c] = entries[c];
  for (int c = 0; c < seat.count; ++c) {
    f.held.data[4 * at + c] = seat.vert[c];
    f.share.data[4 * at + c] = seat.share[c];
    push_node(f.solve, f.solve.node.data[seat.vert[c]], seat.share[c] * force, seat.share[c] * hold);
  }
}

// The matrix a (1 - n n^T) + b n n^T.
PALPATE Sym across_and_along(double a, double b, D3 n) {
  const double c = b - a;
  return {a + c * n.x * n.x, c * n.x * n.y, c * n.x * n.z, a + c * n.y * n.y, c * n.y * n.z, a + c * n.z * n.z};
}

PALPATE int within(int a, int low, int high) { return a < low ? low : a > high ? high : a; }

// Where the next hole towards the needle, or with -1 the one before, is on the thread; 0 if on none.
PALPATE double next_on_thread(double* s, int n, int way) {
  const int other = n + way;
  return other >= 0 && other < (int)s[NEEDLE_COUNT] ? hole(s, other)[HOLE_THREAD] : 0.0;
}

// A hole's thread: the edge that is in it, the share of that, how it is there, and how far it is ahead of its seat. It
// turns by `angle` between edges beside that, far enough for a thread that resists bending but not past the next hole; the
// needle itself is what is before the first one. It slides along the mean of both, so that equal tensions do not make it
// slide wherever on the edge it is.
struct Passing { int edge; double part, angle, off; D3 at, along; Seat seat; };

template <class Fields>
CALLED Passing passing(const Fields& f, int i, const Arc& arc, double* s, int n) {
  const auto thread = strand_of(f, i);
  Passing out;
  const int e = out.edge = thread.find(hole(s, n)[HOLE_THREAD], out.part);
  const D3 from = thread.at(e), to = thread.at(e + 1), zero = {0.0, 0.0, 0.0};
  out.at = (1.0 - out.part) * from + out.part * to;
  int first = e > BESIDE ? e - BESIDE : 0, last = e + BESIDE + 2 < thread.count ? e + BESIDE : thread.count - 2;
  const double next = next_on_thread(s, n, 1), previous = next_on_thread(s, n, -1);
  double part;
  if (next > 0.0) first = within(thread.find(next, part) + 1, first, e);
  if (previous > 0.0) last = within(thread.find(previous, part) - 1, e, last);
  const D3 before = e || next > 0.0 ? unit_of(thread.at(first + 1) - thread.at(first)) : zero - arc.along(0.0);
  const D3 after = unit_of(thread.at(last + 1) - thread.at(last));
  const D3 both = before + after;
  out.angle = atan2(norm(cross(before, after)), dot(before, after));
  out.along = norm(both) > 1e-6 ? unit_of(both) : unit_of(to - from);
  out.seat = seat_of_hole(f, s, n);
  out.off = dot(out.at - out.seat.at, out.along);
  return out;
}

// How far a hole can slide along a thread, to the next one, or with -1 to the one before: between two there is an edge, which
// tells how the thread turns in them and what it bears.
template <class Fields>
PALPATE double room_on_thread(const Fields& f, int i, double* s, int n, int way, int edge) {
  const auto thread = strand_of(f, i);
  const double other = next_on_thread(s, n, way), apart = BESIDE * thread.edge(edge);
  const double room = way * (hole(s, n)[HOLE_THREAD] - other) - apart;
  return other == 0.0 ? 2.0 * thread.length() : room > ENDS * apart ? room : 0.0;
}

// Length in tissue at a hole: a sheet's thickness; in a solid half the way to each hole next to it, from the last one to
// the tip all of it.
template <class Fields>
CALLED double length_in(const Fields& f, int i, const Arc& arc, double* s, int n) {
  const int count = (int)s[NEEDLE_COUNT], kind = kind_of(s, n);
  const double wall = f.law.data[PIERCE_LENGTH * i + PIERCE_WALL];
  if (on_thread(s, n)) {
    const bool in = kind == INTO && n + 1 < count, out = kind == OUT && n > 0;
    return in || out ? 0.5 * norm(seat_of_hole(f, s, n).at - seat_of_hole(f, s, in ? n + 1 : n - 1).at) : wall;
  }
  const double place = place_of_hole(f, arc, s, n);
  const bool from = n > 0 && in_solid(kind_of(s, n - 1)), on = in_solid(kind);
  const double before = from ? place_of_hole(f, arc, s, n - 1) : 0.0;
  const double next = n + 1 < count ? place_of_hole(f, arc, s, n + 1) : 2.0 * arc.length - place;
  const double sides = (from ? 0.5 * fabs(place - before) : 0.0) + (on ? 0.5 * fabs(next - place) : 0.0);
  return (kind == THROUGH ? wall : 0.0) + sides;
}

// What the tissue bears across a needle or a thread at a hole.
template <class Fields>
CALLED double bears_across(const Fields& f, int i, const Arc& arc, double* s, int n) {
  const double* law = f.law.data + PIERCE_LENGTH * i;
  const double made = law[f.ntet && kind_of(s, n) != WITHIN ? PIERCE_SURFACE : PIERCE_FORCE];
  const double cut = law[PIERCE_TEAR] * length_in(f, i, arc, s, n);
  return cut > made ? cut : made;
}

// Lets a hole tear through the tissue by a way against what that bears; returns whether it is one still, rather than torn
// out of the tissue's edge. One in a surface tears along that: a thread that turns back in it pulls it off its own plane,
// where there is nothing to tear.
template <class Fields>
CALLED bool tear_by(const Fields& f, Thread t, double* s, int n, D3 way, double bears) {
  double* my = hole(s, n);
  const D3 from = seat_of_hole(f, s, n).at;
  int elem = (int)my[HOLE_ELEM];
  D3 w;
  if (kind_of(s, n) == WITHIN) {
    if (!find_tet(f, t, from + way, elem, w)) return false;
    put_seat(my + HOLE_ELEM, elem, w);
  } else {
    D3 x[3];
    corners_now(f, elem, x);
    way = across(way, unit_of(cross(x[1] - x[0], x[2] - x[0])));
    const double misses =
      find_nearest(f, t, from + way, elem, w, [](const Fields& g, int e, D3* x) { corners_now(g, e, x); });
    put_seat(my + HOLE_ELEM, elem, {w.y, w.z, 0.0});
    if (misses > MISSES * norm(way) + ENDS * f.edge) return false;
  }
  const double went = norm(seat_of_hole(f, s, n).at - from);
  my[HOLE_TORN] += went;
  s[NEEDLE_WORK] += bears * went;
  return true;
}

PALPATE void drop_hole(double* s, int n) {
  s[NEEDLE_COUNT] -= 1.0;
  for (; n < (int)s[NEEDLE_COUNT]; ++n)
    for (int c = 0; c < HOLE_LENGTH; ++c) hole(s, n)[c] = hole(s, n + 1)[c];
}

// Lets holes that a needle pulls across by more than the tissue bears tear as far as that.
template <class Fields>
PALPATE void tear_holes(const Fields& f, Thread t, int i, const Arc& arc, double* s) {
  for (int n = (int)s[NEEDLE_COUNT] - 1; n >= 0; --n) {
    if (on_thread(s, n)) continue;
    const D3 p = seat_of_hole(f, s, n).at;
    const double place = arc.nearest(p), bears = bears_across(f, i, arc, s, n);
    const D3 off = across(arc.place(place) - p, arc.along(place));
    const double far = norm(off), goes = far - bears / f.law.data[PIERCE_LENGTH * i + PIERCE_STIFFNESS];
    if (goes > 0.0 && !tear_by(f, t, s, n, (goes / far) * off, bears)) drop_hole(s, n);
  }
}

// Lets those tear that a thread has torn in its step.
template <class Fields>
PALPATE void tear_by_thread(const Fields& f, Thread t, int i, const Arc& arc, double* s) {
  for (int n = (int)s[NEEDLE_COUNT] - 1; n >= 0; --n) {
    const D3 way = load(f.torn.data + 3 * (POINTS * i + n));
    const double far = norm(way), most = f.edge < far ? f.edge / far : 1.0;
    if (!on_thread(s, n) || !(far > 0.0)) continue;
    if (!tear_by(f, t, s, n, most * way, bears_across(f, i, arc, s, n))) drop_hole(s, n);
  }
}

// What friction of a thread in a hole bears along it, of the difference of the tensions on both sides of the edge that is
// in it.
template <class Fields>
CALLED double rubs(const Fields& f, int i, const Arc& arc, const Passing& by, double* s, int n) {
  const double* law = f.law.data + PIERCE_LENGTH * i;
  const auto thread = strand_of(f, i);
  const int e = by.edge;
  const double back = e + 2 == thread.count ? 0.0 : thread.tension(e + 1), pull = thread.tension(e ? e - 1 : 0);
  const double most = (pull < back ? pull : back) * (exp(law[PIERCE_CAPSTAN] * by.angle) - 1.0);
  const double share = cos(0.5 * by.angle);
  return (share > HAIRPIN ? share : HAIRPIN) * (most + law[PIERCE_FRICTION] * length_in(f, i, arc, s, n));
}

// Calls each(edge, off, span) for the edges of a thread that touch it at a hole, on the side from which it would slide in
// by a way. `span` is the part of it that they touch, from the hole on, and `off` the shortest way between them. It ends
// where a call returns true, and returns whether one did.
template <class Fields, class Each>
CALLED bool touching_at(const Fields& f, int i, const Passing& by, double* s, int n, int way, const Each& each) {
  const double* law = f.law.data + PIERCE_LENGTH * i;
  const double thick = law[PIERCE_KNOT], place = hole(s, n)[HOLE_THREAD];
  const double reach = 0.5 * law[PIERCE_WALL] + BEFORE * thick, end = place - way * reach;
  if (!(thick > 0.0) || end < 0.0) return false;
  const auto thread = strand_of(f, i);
  double part, start = 0.0;
  const int e = thread.find(end, part);
  const D3 span = thread.at(e) + part * (thread.at(e + 1) - thread.at(e)) - by.at;
  for (int j = 0; j + 1 < thread.count;) {
    const D3 p = thread.at(j);
    const double length = thread.edge(j), middle = start + 0.5 * length;
    double room = norm(p - by.at) - reach - TOUCHES * thick;
    if (room < STRETCHED * length && fabs(middle - 0.5 * (place + end)) > 0.5 * (length + reach) + TURNS * thick) {
      const D3 off = shortest(p, thread.at(j + 1) - p, by.at, span);
      if (norm(off) < TOUCHES * thick && each(j, off, span)) return true;
    }
    do {  // on to where the thread may be near again
      room -= STRETCHED * thread.edge(j);
      start += thread.edge(j);
    } while (++j + 1 < thread.count && room > STRETCHED * thread.edge(j));
  }
  return false;
}

// Whether a knot is at a hole, on the side from which the thread would slide in by a way: other parts of it are around
// it there, which touch it from sides that face each other. A strand that lies beside it would give way.
template <class Fields>
CALLED bool is_knotted(const Fields& f, int i, const Passing& by, double* s, int n, int way) {
  D3 first = {0.0, 0.0, 0.0};
  return touching_at(f, i, by, s, n, way, [&](int, const D3& off, const D3& span) {
    const D3 aside = across(off, unit_of(span));
    if (dot(first, aside) < 0.0) return true;
    if (dot(first, first) == 0.0) first = aside;
    return false;
  });
}

// What a hole bears along a thread. One that has met the next presses on that, and slides on with it alone: all that have
// met bear together what all of them rub.
template <class Fields>
CALLED double thread_friction(const Fields& f, int i, const Arc& arc, const Passing& by, double* s, int n) {
  const double* law = f.law.data + PIERCE_LENGTH * i;
  const int way = by.off > 0.0 ? 1 : -1;
  const bool last = by.edge + 2 == strand_of(f, i).count;
  if (law[PIERCE_STOP] > 0.0 && last && by.part > 1.0 - ENDS && way < 0) return STOPS;
  if (is_knotted(f, i, by, s, n, way)) return STOPS;
  double sum = rubs(f, i, arc, by, s, n);
  for (int edge = by.edge; room_on_thread(f, i, s, n, way, edge) == 0.0;) {
    const Passing other = passing(f, i, arc, s, n += way);
    const double left = rubs(f, i, arc, other, s, n) - law[PIERCE_STIFFNESS] * way * other.off;
    sum += left > 0.0 ? left : 0.0;
    edge = other.edge;
  }
  return sum;
}

// Follows a thread that has slid through a hole: the place that holds it goes on along the thread by as much as its spring
// is longer than friction bears, until it meets the next hole.
template <class Fields>
PALPATE void follow_thread(const Fields& f, int i, const Arc& arc, double* s, int n) {
  const auto thread = strand_of(f, i);
  double& place = hole(s, n)[HOLE_THREAD];
  const Passing by = passing(f, i, arc, s, n);
  const D3 p = by.seat.at;
  const double slack = thread_friction(f, i, arc, by, s, n) / f.law.data[PIERCE_LENGTH * i + PIERCE_STIFFNESS];
  if (fabs(by.off) <= slack) return;
  const int way = by.off > 0.0 ? 1 : -1;
  const double goes = fabs(by.off) - slack, room = room_on_thread(f, i, s, n, way, by.edge);
  place -= way * (goes < room ? goes : room);
  const double whole = thread.length();
  place = place < whole ? place : whole;
  if (place > 0.0) return;
  // It is at the swage, or on the needle again; or out, where the needle is no longer at the thread's end.
  if (norm(arc.place(0.0) - thread.at(0)) > thread.edge(0)) place = 2.0 * whole;
  else if (arc.nearest(p) > BACK * arc.length) place = hole(s, n)[HOLE_SLIP] = 0.0;
  else place = ENDS * thread.edge(0);
}

// Holds a thread in a hole: by the force that its step has found, and less as the tissue then follows it.
template <class Fields>
PALPATE void tie_thread(const Fields& f, Thread t, int i, int n, const Arc& arc, double weight, double* s) {
  const Passing by = passing(f, i, arc, s, n);
  const double most = thread_friction(f, i, arc, by, s, n);
  const bool sticks = f.law.data[PIERCE_LENGTH * i + PIERCE_STIFFNESS] * fabs(by.off) < most;
  const D3 force = load(f.pull.data + 3 * (POINTS * i + n));
  tie(f, t, POINTS * i + n, by.seat, by.at, force, across_and_along(weight, sticks ? weight : 0.0, by.along), false);
}

// Closes holes that the tip has been drawn out of, and lets go of those that the swage has left, or hands them to the
// thread, those in the surface. It may come back, or end.
template <class Fields>
CALLED void close_holes(const Fields& f, Thread t, int i, const Arc& arc, double* s) {
  const auto thread = strand_of(f, i);
  const bool stops = f.law.data[PIERCE_LENGTH * i + PIERCE_STOP] > 0.0;
  int count = (int)s[NEEDLE_COUNT], kept = 0;
  while (count > 0 && place_of_hole(f, arc, s, count - 1) > arc.length) --count;
  s[NEEDLE_COUNT] = count;
  for (int h = 0; h < count; ++h) {
    double* from = hole(s, h);
    const double place = place_of_hole(f, arc, s, h);
    if (on_thread(s, h) ? from[HOLE_THREAD] > (stops ? 1.0 + ENDS : 1.0 - ENDS) * thread.length()
                        : place < 0.0 && (!thread.count || kind_of(s, h) == WITHIN))
      continue;
    if (!on_thread(s, h) && place < 0.0) from[HOLE_THREAD] = -place;
    for (int c = 0; c < HOLE_LENGTH; ++c) hole(s, kept)[c] = from[c];
    ++kept;
  }
  s[NEEDLE_COUNT] = kept;
  for (int h = 0; h < kept; ++h)
    if (on_thread(s, h)) follow_thread(f, i, arc, s, h);
  tear_holes(f, t, i, arc, s);
}

// Ties a needle to its holes and its tip to its seat. What has slipped, as the step begins, bears a constant force,
// so that it does not hang on speed.
template <class Fields>
PALPATE void tie_needle(const Fields& f, Thread t, int i, const Arc& arc, const Twist& moving, double* s) {
  const double* law = f.law.data + PIERCE_LENGTH * i;
  // Without the tissue's damping, by which the stretch that a step leaves would not tell its force.
  const double h = f.mj.timestep.data[0], reach = f.ahead * h;
  const double k = law[PIERCE_STIFFNESS], weight = k * f.gain * h * h;
  const int count = (int)s[NEEDLE_COUNT], b = f.body.data[i];
  int ties = 0;
  for (int n = 0; n < count; ++n) {
    if (on_thread(s, n)) {
      tie_thread(f, t, i, n, arc, weight, s);
      continue;
    }
    ++ties;
    const Seat seat = seat_of_hole(f, s, n);
    const double place = arc.nearest(seat.at);
    const D3 along = arc.along(place), at = arc.place(place);
    const D3 rel = velocity_of(f, b, moving, at) - seat.vel;
    const double most = law[PIERCE_FRICTION] * length_in(f, i, arc, s, n);
    double& slip = hole(s, n)[HOLE_SLIP];
    const double slack = most / k, off = slip - place;
    const bool slips = fabs(off) > slack;
    if (slips) slip = place + (off > 0.0 ? slack : -slack);
    const double drags = k * (slip - place + (slips ? 0.0 : reach * dot(rel, along)));
    const D3 force = k * across(at - seat.at + reach * rel, along) + drags * along;
    tie(f, t, POINTS * i + n, seat, at, force, across_and_along(weight, slips ? 0.0 : weight, along), true);
  }
  if (s[NEEDLE_STAGE] != AWAY) {
    const bool inside = s[NEEDLE_STAGE] == INSIDE;
    const Seat seat = seat_of(f, s + NEEDLE_ELEM, inside);
    const D3 along = arc.along(arc.length), at = arc.place(arc.length);
    const D3 rel = velocity_of(f, b, moving, at) - seat.vel;
    const double bears = borne(f, law, s), press = k * (dot(at - seat.at, along) - (inside ? 0.0 : s[NEEDLE_DEPTH]));
    const bool sticks = press > 0.0 && press < bears - TIGHT * bears;
    const double axial = sticks ? press + k * reach * dot(rel, along) : press > 0.0 ? bears : 0.0;
    const D3 force = k * across(at - seat.at + reach * rel, along) + axial * along;
    tie(f, t, POINTS * i + HOLES, seat, at, force, across_and_along(weight, sticks ? weight : 0.0, along), true);
    ++ties;
  }
  if (t.tid > 0) return;
  f.weight.data[i] = ties * weight;
  if (ties || count) f.solve.quiet.data[0] = 0.0;
}

// Says which of a needle's geoms do not touch the organ: those from a little before its first hole on, or its point.
template <class Fields>
PALPATE void lift_geoms(const Fields& f, int i, const Arc& arc, double* s) {
  double low = arc.length;
  for (int n = 0; n < (int)s[NEEDLE_COUNT]; ++n) {
    const double place = place_of_hole(f, arc, s, n);
    low = place < low ? place : low;
  }
  low -= f.law.data[PIERCE_LENGTH * i + PIERCE_MARGIN];
  for (int g = 0; g < f.nlisted; ++g)
    if (f.whose.data[g] == i) f.lifted.data[f.geom.data[g]] = f.end.data[g] > low;
}

// Where the organ says which edges of a needle's thread do not touch it: the first one, and that after the last.
template <class Fields>
PALPATE int* lifted_edges(const Fields& f, int i) {
  return f.lifted.data + f.ngeom + 2 * f.strand_flex.data[i];
}

// Says which these are, once all organs have told where they hold it: those between its first hole and its last one,
// whichever organ has these. Between layers that lie on each other both would press on it.
template <class Fields>
PALPATE void lift_thread(const Fields& all, Thread t, int i) {
  const auto& f = all.pierced;
  int* edges = lifted_edges(f, i);
  if (t.tid > 0 || !edges[1]) return;
  const auto thread = strand_of(f, i);
  const double margin = f.law.data[PIERCE_LENGTH * i + PIERCE_CLOSE], near = all.span.data[0] - margin;
  double part;
  edges[0] = near > 0.0 ? thread.find(near, part) : 0;
  edges[1] = thread.find(all.span.data[1] + margin, part) + 1;
}

// Takes the lengths of the edges of a thread whose nodes move along it.
template <class Fields>
PALPATE void measure_thread(const Fields& all, Thread t, int i) {
  const auto thread = strand_of(all.pierced, i);
  each_item(t, thread.count - 1, [&](int e) {
    double* edge = all.pierced.edges.data + 2 * (thread.first + e);
    const double* drawn = all.drawn.data + 2 * e;
    edge[0] = drawn[0] + (all.moved.data[e + 1] - all.moved.data[e]);
    edge[1] = drawn[1] * (drawn[0] / edge[0]);
  });
}

// Ties strands that touch a thread beside a hole, on the side from which it would slide in by a way, so that they do not
// slide along it into the wall. They aim where the hole's own tie does, `held`. Between two holes nothing is stopped.
template <class Fields>
CALLED void stop_strands(const Fields& all, int i, const Passing& by, double* s, int n, int way, const double* held) {
  const auto& f = all.pierced;
  const double* law = f.law.data + PIERCE_LENGTH * i;
  const auto thread = strand_of(f, i);
  if (next_on_thread(s, n, way) > 0.0) return;
  int last = -1;
  touching_at(f, i, by, s, n, way, [&](int edge, const D3&, const D3& span) {
    const D3 out = unit_of(span);
    for (int j = edge > last ? edge : last + 1; j < edge + 2; ++j) {
      const int at = all.tie_count.data[0];
      if (at == MOST_TIES || j + 1 == thread.count) return true;
      last = j;
      if (dot(thread.at(j) - by.seat.at, out) < 0.0) continue;
      double* tie = all.tie_value.data + TIE_LENGTH * at;
      for (int c = 0; c < TIE_LENGTH; ++c) tie[c] = held[c];
      store(tie + TIE_ALONG, add_turned({0.0, 0.0, 0.0}, all.frame.data, turned(f.own.frame.data, out)));
      tie[TIE_PART] = 0.0;
      tie[TIE_STOP] = 0.5 * (law[PIERCE_WALL] + law[PIERCE_KNOT]);
      all.tie_edge.data[at] = j;
      all.tie_count.data[0] = at + 1;
    }
    return false;
  });
}

// Says what holds a needle's thread, as the step begins: the points of the tissue where they will be.
template <class Fields>
PALPATE void aim_thread(const Fields& all, Thread t, int i) {
  const auto& f = all.pierced;
  double s[NEEDLE_LENGTH];
  for (int c = 0; c < NEEDLE_LENGTH; ++c) s[c] = f.state.data[NEEDLE_LENGTH * i + c];
  const Arc arc = arc_of(f, i);
  close_holes(f, t, i, arc, s);
  if (t.tid > 0) return;
  lift_geoms(f, i, arc, s);
  int* edges = lifted_edges(f, i);
  edges[0] = 0;
  edges[1] = s[NEEDLE_COUNT] > 0.0;
  all.first.data[0] = all.tie_count.data[0];
  for (int n = 0; n < (int)s[NEEDLE_COUNT]; ++n) {
    const double place = hole(s, n)[HOLE_THREAD];  // 0 on the needle: its end may touch
    double* span = all.span.data;
    span[0] = place < span[0] ? place : span[0];
    span[1] = place > span[1] ? place : span[1];
    const int at = all.tie_count.data[0];
    if (!on_thread(s, n) || at == MOST_TIES) continue;
    double* tie = all.tie_value.data + TIE_LENGTH * at;
    const Passing by = passing(f, i, arc, s, n);
    const Seat& seat = by.seat;
    D3 vel = {0.0, 0.0, 0.0};
    for (int c = 0; c < seat.count; ++c) vel += seat.share[c] * goes_by(f.mj, f.own, seat.vert[c]);
    const D3 goes = in_world(f.own.frame.data, f.own.origin.data, seat.at + f.mj.timestep.data[0] * vel);
    store(tie + TIE_AIM, add_turned({0.0, 0.0, 0.0}, all.frame.data, goes - load(all.origin.data)));
    tie[TIE_PART] = by.part;
    tie[TIE_STIFFNESS] = f.law.data[PIERCE_LENGTH * i + PIERCE_STIFFNESS];
    tie[TIE_FRICTION] = thread_friction(f, i, arc, by, s, n);
    tie[TIE_BEARS] = bears_across(f, i, arc, s, n);
    store(tie + TIE_ALONG, add_turned({0.0, 0.0, 0.0}, all.frame.data, turned(f.own.frame.data, by.along)));
    tie[TIE_STOP] = 0.0;
    all.tie_edge.data[at] = by.edge;
    all.tie_count.data[0] = at + 1;
    for (int way = -1; way <= 1; way += 2) stop_strands(all, i, by, s, n, way, tie);
  }
}

// Takes the forces that the thread's step has found, in the order in which it was told what holds it.
template <class Fields>
PALPATE void feel_thread(const Fields& all, Thread t, int i) {
  const auto& f = all.pierced;
  double s[NEEDLE_LENGTH];
  for (int c = 0; c < NEEDLE_LENGTH; ++c) s[c] = f.state.data[NEEDLE_LENGTH * i + c];
  close_holes(f, t, i, arc_of(f, i), s);
  if (t.tid > 0) return;
  int at = all.first.data[0];
  for (int n = 0; n < (int)s[NEEDLE_COUNT]; ++n) {
    if (!on_thread(s, n)) continue;
    const D3 zero = {0.0, 0.0, 0.0};
    const double* tie = all.tie_value.data + TIE_LENGTH * at;
    const bool felt = at < MOST_TIES;
    int stops = 0;
    D3 force = zero - load(tie + TIE_FORCE);
    for (int k = at + 1; k < all.tie_count.data[0] && all.tie_value.data[TIE_LENGTH * k + TIE_STOP] > 0.0; ++k)
      force = force - load(all.tie_value.data + TIE_LENGTH * k + TIE_FORCE), ++stops;
    const auto put = [&](double* into, D3 a) {
      store(into + 3 * (POINTS * i + n), felt ? add_turned(zero, f.own.frame.data, turned(all.frame.data, a)) : zero);
    };
    put(f.pull.data, force);
    put(f.torn.data, load(tie + TIE_TORN));
    at += felt + stops;
  }
}

template <class Fields>
PALPATE void enter_needles(const Fields& f, Thread t, int) {
  for (int i = 0; i < f.nneedle; ++i) {
    double s[NEEDLE_LENGTH];
    for (int c = 0; c < NEEDLE_LENGTH; ++c) s[c] = f.state.data[NEEDLE_LENGTH * i + c];
    for (int c = 4 * POINTS * i; t.tid == 0 && c < 4 * POINTS * (i + 1); ++c) f.share.data[c] = 0.0;
    const Arc arc = arc_of(f, i);
    const int b = f.body.data[i];
    const Twist moving = twist(f.mj, b, false);
    close_holes(f, t, i, arc, s);
    if (s[NEEDLE_STAGE] == INSIDE && !goes_in(s)) s[NEEDLE_STAGE] = AWAY;
    if (s[NEEDLE_STAGE] == INSIDE) cut_way(f, t, i, arc, s);
    if (s[NEEDLE_STAGE] == AWAY) touch(f, t, i, arc, velocity_of(f, b, moving, arc.place(arc.length)), s);
    if (s[NEEDLE_STAGE] == TOUCHING) press(f, t, i, arc, s);
    tie_needle(f, t, i, arc, moving, s);
    tear_by_thread(f, t, i, arc, s);
    if (t.tid > 0) continue;
    lift_geoms(f, i, arc, s);
    for (int c = 0; c < NEEDLE_LENGTH; ++c) f.next.data[NEEDLE_LENGTH * i + c] = s[c];
  }
}

// Lets MuJoCo's solver meet more inertia at the dofs of a free body: of moving, and of turning about its origin. In
// mujoco_warp M is factored afterwards.
template <class Arrays>
PALPATE void add_inertia(const Arrays& mj, int b, double along, double about) {
  const int first = mj.body_dofadr.data[b];
  const auto row = [&](int c) { return mj.M_rowadr.data[first + c]; };
  const auto last = [&](int c) { return mj.M_rownnz.data[first + c] - 1; };
  for (int c = 0; c < 6; ++c) mj.M.data[row(c) + last(c)] += c < 3 ? along : about;
  if constexpr (sizeof(*mj.M.data) == sizeof(double)) {
    for (int c = 0; c < 6; ++c)
      for (int k = 0; k <= last(c); ++k) mj.qLD.data[row(c) + k] = mj.M.data[row(c) + k];
    for (int c = 5; c >= 0; --c) {  // M = L^T D L, as MuJoCo has it
      double* L = mj.qLD.data + row(c);
      const double inverse = mj.qLDiagInv.data[first + c] = 1.0 / L[last(c)];
      for (int j = last(c) - 1; j >= 0; --j) {
        const int above = c - last(c) + j;
        for (int k = 0; k <= last(above); ++k) mj.qLD.data[row(above) + k] -= L[j] * inverse * L[k];
      }
      for (int j = 0; j < last(c); ++j) L[j] *= inverse;
    }
  }
}

// Ends the forces with what the step made of the tissue's velocities, and lets the needles feel them.
template <class Fields>
PALPATE void act_needles(const Fields& f, Thread t, int) {
  if (t.tid > 0) return;
  const bool ok = f.solve.status.data[3] == 0.0f;
  const D3 zero = {0.0, 0.0, 0.0};
  const double h = f.mj.timestep.data[0];
  for (int i = 0; i < f.nneedle; ++i) {
    const int b = f.body.data[i];
    D3 sum = zero, torque = zero;
    for (int at = POINTS * i; at < POINTS * (i + 1); ++at) {
      D3 dv = zero;
      double shares = 0.0;
      for (int c = 4 * at; c < 4 * (at + 1); ++c) {
        if (f.share.data[c] == 0.0) continue;
        dv += f.share.data[c] * load_lane(f.solve.dvel.data + offset_of(f.solve.node.data[f.held.data[c]]));
        shares += f.share.data[c];
      }
      const double* p = f.hold.data + 6 * at;
      const Sym hold = {p[0], p[1], p[2], p[3], p[4], p[5]};
      const D3 force = ok && shares > 0.0 ? load(f.force.data + 3 * at) - (1.0 / h) * (hold * dv) : zero;
      store(f.force.data + 3 * at, force);
      if (shares == 0.0 || !f.feels.data[at]) continue;
      const D3 push = zero - turned(f.own.frame.data, force);
      sum += push;
      torque += cross(arm_of(f.mj, b, in_world(f.own.frame.data, f.own.origin.data, load(f.point.data + 3 * at))), push);
    }
    push_body(f.mj, b, sum, torque);
    // |v + w x r|^2 is no more than 2 |v|^2 + 2 r^2 |w|^2.
    const double weight = 2.0 * f.weight.data[i], r = f.circle.data[i];
    if (weight > 0.0 && f.floats.data[i]) add_inertia(f.mj, b, weight, weight * r * r);
  }
}

// Keeps the needles' state.
template <class Fields>
PALPATE void keep_needles(const Fields& f, Thread t, int) {
  each_item(t, NEEDLE_LENGTH * f.nneedle, [&](int i) { f.state.data[i] = f.next.data[i]; });
}

// Tells what the needles of a batch do, a thread a world.
template <class Fields>
PALPATE void tell_needles(const Fields& all, Thread, int) {
  const auto& f = all.pierced;
  const auto& told = all.told;
  const double *R = f.own.frame.data, *origin = f.own.origin.data;
  for (int i = 0; i < f.nneedle; ++i) {
    double* s = f.state.data + NEEDLE_LENGTH * i;
    const double* force = f.force.data + 3 * POINTS * i;
    const Arc arc = arc_of(f, i);
    D3 sum = load(force + 3 * HOLES);
    store(told.tip_force.data + 3 * i, turned(R, sum));
    told.touches.data[i] = s[NEEDLE_STAGE] == TOUCHING;
    told.inside.data[i] = s[NEEDLE_STAGE] == INSIDE;
    told.energy.data[i] = (float)s[NEEDLE_WORK];
    told.count.data[i] = (int)s[NEEDLE_COUNT];
    for (int n = 0; n < (int)s[NEEDLE_COUNT]; ++n) {
      const int at = HOLES * i + n;
      const Seat seat = seat_of_hole(f, s, n);
      D3 rest = {0.0, 0.0, 0.0};
      for (int c = 0; c < seat.count; ++c) rest += seat.share[c] * load(f.flat.data + 3 * seat.vert[c]);
      told.hole_inside.data[at] = kind_of(s, n) == WITHIN;
      told.hole_thread.data[at] = on_thread(s, n);
      told.hole_along.data[at] = (float)(on_thread(s, n) ? -hole(s, n)[HOLE_THREAD] : arc.nearest(seat.at));
      told.hole_torn.data[at] = (float)hole(s, n)[HOLE_TORN];
      store(told.hole_at.data + 3 * at, in_world(R, origin, seat.at));
      store(told.hole_rest.data + 3 * at, in_world(R, origin, rest));
      store(told.hole_force.data + 3 * at, turned(R, load(force + 3 * n)));
      sum += load(force + 3 * n);
    }
    store(told.force.data + 3 * i, turned(R, sum));
  }
}

}  // namespace palpate
