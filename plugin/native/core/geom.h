// Distance of a point to the geoms that windows follow, and of two segments.
#pragma once
#include "core/d3.h"

namespace palpate {

// Height of p over a plane's surface, or over a solid's; negative inside. `size` as geom_size.

PALPATE double to_sphere(D3 p, const double* size) { return norm(p) - size[0]; }

PALPATE double to_capsule(D3 p, const double* size) {
  const double t = p.z < -size[1] ? p.z + size[1] : p.z > size[1] ? p.z - size[1] : 0.0;
  return to_sphere({p.x, p.y, t}, size);
}

// To first order: k0 (k0 - 1) / k1 with k0 the length of p in units of the half axes and k1 that of
// its gradient.
PALPATE double to_ellipsoid(D3 p, const double* size) {
  const double a = p.x / size[0], b = p.y / size[1], c = p.z / size[2];
  const double r = sqrt(a * a + b * b + c * c);
  const double e = sqrt(a * a / (size[0] * size[0]) + b * b / (size[1] * size[1]) +
                        c * c / (size[2] * size[2]));
  return e > 1e-12 ? r * (r - 1.0) / e : -size[0];
}

PALPATE double to_cylinder(D3 p, const double* size) {
  const double r = sqrt(p.x * p.x + p.y * p.y) - size[0];
  const double t = (p.z < 0.0 ? -p.z : p.z) - size[1];
  const double rp = r > 0.0 ? r : 0.0, tp = t > 0.0 ? t : 0.0;
  return sqrt(rp * rp + tp * tp) + (r > t ? (r < 0.0 ? r : 0.0) : (t < 0.0 ? t : 0.0));
}

PALPATE double to_box(D3 p, D3 half) {
  const D3 e = vabs(p) - half;
  const D3 beyond = vmax(e, {0.0, 0.0, 0.0});
  const double far2 = dot(beyond, beyond), most = e.y > e.x ? e.y : e.x;
  return far2 > 0.0 ? sqrt(far2) : e.z > most ? e.z : most;
}

// Distance to a geom, see GEOM in `engine/layout.py`, of the point d from its centre: negative
// inside. Meshes and the rest are their bounding boxes.
PALPATE double distance(const double* geom, D3 d) {
  const double* axis = geom + GEOM_AXIS;
  const double* size = geom + GEOM_SIZE;
  const D3 p = {dot(load(axis), d), dot(load(axis + 3), d), dot(load(axis + 6), d)};
  const int type = (int)geom[GEOM_TYPE];
  if (type == GEOM_IS_PLANE) return p.z;
  if (type == GEOM_IS_SPHERE) return to_sphere(p, size);
  if (type == GEOM_IS_CAPSULE) return to_capsule(p, size);
  if (type == GEOM_IS_ELLIPSOID) return to_ellipsoid(p, size);
  if (type == GEOM_IS_CYLINDER) return to_cylinder(p, size);
  return to_box(p - load(geom + GEOM_BOX), load(geom + GEOM_HALF));
}

// The least distance of x to `ngeom` geoms, without those whose bounding sphere is too far.
PALPATE double nearest(const double* geom, int ngeom, D3 x) {
  double best = 1e300;
  for (int q = 0; q < ngeom; ++q, geom += GEOM_LENGTH) {
    const D3 d = x - load(geom + GEOM_POS);
    if (dot(d, d) > geom[GEOM_BOUND2]) continue;
    const double at = distance(geom, d);
    best = at < best ? at : best;
  }
  return best;
}

PALPATE double to_share(double x) { return x < 0.0 ? 0.0 : x > 1.0 ? 1.0 : x; }

// From the segment that goes from q along e to the one from p along d, either of which may be a point, where they are
// nearest to each other (Ericson 2005, Real-Time Collision Detection, 5.1.9).
PALPATE D3 shortest(D3 p, D3 d, D3 q, D3 e) {
  const D3 r = p - q;
  const double dd = dot(d, d), ee = dot(e, e), de = dot(d, e), dr = dot(d, r), er = dot(e, r);
  const double apart = dd * ee - de * de;  // 0 where they are parallel
  double s = apart > 1e-6 * dd * ee ? to_share((de * er - dr * ee) / apart) : 0.0;
  const double t = ee > 0.0 ? to_share((de * s + er) / ee) : 0.0;
  s = dd > 0.0 ? to_share((de * t - dr) / dd) : 0.0;
  return r + s * d - t * e;
}

PALPATE double between(D3 p, D3 d, D3 q, D3 e) { return norm(shortest(p, d, q, e)); }

// Whether a geom comes within `reach` of a box: its bounding sphere, or a plane itself.
PALPATE bool comes_near(const double* geom, D3 low, D3 high, double reach) {
  const D3 at = load(geom + GEOM_POS);
  if ((int)geom[GEOM_TYPE] == GEOM_IS_PLANE) {
    const D3 normal = load(geom + GEOM_AXIS + 6), half = 0.5 * (high - low);
    return dot(normal, low + half - at) - dot(vabs(normal), half) <= reach;
  }
  const D3 margin = {reach, reach, reach}, zero = {0.0, 0.0, 0.0};
  const D3 away = vmax(vmax(low - margin - at, at - high - margin), zero);
  return dot(away, away) <= geom[GEOM_BOUND2];
}

}  // namespace palpate
