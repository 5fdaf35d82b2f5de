"""The implicit step: preconditioned conjugate gradients on A dv = b, Newton iterations around it.

A has sliced 3x3 blocks, the bending matrix along the node normals and the rank-one volume term; the
preconditioner is the inverse of the diagonal blocks, or for an organ that has them a cycle on
coarser meshes (`multilevel`). With either PCG stops when sqrt(r^T D^-1 r), D the diagonal blocks,
is `tolerance` times that of b. It starts where a line through the last two steps' solutions leads,
scaled to the least error in the energy norm: from 2562 nodes on that takes 4 to 6 iterations less
than the last solution alone in smooth motion, which takes 4 to 6 less than zero.
"""

from __future__ import annotations

from . import product, simd
from .types import Stage

RESPONSE = 0.03


# Impulse of volume and pressure along the area vectors, (push - pull) O: push is the force's, pull
# that of K v with weight gv.
VOLUME = """
  const V zero = SPLAT(0.0f);
  float push = 0.0f, pull = 0.0f;
  if (!response && (bulk != 0.0f || pressure != 0.0f)) {
    V vol = zero, rate = zero;
    FOR_SLICES(s) {
      for (int c = 0; c < 3; ++c) {
        const V o = LD(O + 24 * s, c);
        vol += (LD(rest.data + 24 * s, c) + LD(U + 24 * s, c)) * o;
        rate += LD(W + 24 * s, c) * o;
      }
    }
    GROUP_SUMS(vol, rate, volume, flux)
    volume /= 18.0f;
    if (tid == 0) total.data[2 * world] = volume;
    push = h * (pressure - bulk * (volume - volume0) / volume0) / 6.0f;
    pull = gv * bulk / volume0 / 36.0f * flux;
  }
"""

_STAGES = f"""
#define FIRST_ {int(Stage.FIRST)}
#define RESPONSE_ {int(Stage.RESPONSE)}
#define ENOUGH_ {RESPONSE}f
"""


def body(
  setup: str, precondition: str, scale: str, curvature: str = "", quads: bool = False
) -> str:
  """Returns the native code of the whole solve of one world: launches cost more than iterations.

  The iteration is conjugate gradients with all sums of an iteration in one (Chronopoulos and Gear
  1989, doi:10.1016/0377-0427(89)90045-9): q = A p is carried as A z + beta q, and p^T q as
  z^T A z - beta^2 p^T q, which loses no more than a digit as the second is seldom twice the first.

  Args:
    setup: declarations before the first iteration
    precondition: writes Z, the preconditioned R, and makes it seen by all; sets rz = r^T z and
      `along`, the sum of z with the area vectors, from V rr (r^T D^-1 r) and V zo
    scale: scales zx, zy, zz, which are D^-1 R, before they become Z
    curvature: sums V zw, z^T A z less the volume term, to `curvature`; may do what `precondition`
      leaves to it
    quads: neighbours read Z in `quad_`, and on CUDA what no other thread reads stays in registers
      where there is room for it
  """
  return (
    _STAGES
    + product.code(quads)
    + simd.group(
      simd.owned(
        product.WORLD
        + """
  const float* U = pos.data + 24 * base;
  const float* W = vel.data + 24 * base;
  const float* R0 = rhs.data + 24 * base;
  const float* D0 = warm.data + 24 * base;
  OWN_VECTOR(X, x_.data + 24 * base)
  OWN_VECTOR(R, r_.data + 24 * base)
  OWN_VECTOR(P, p_.data + 24 * base)
  OWN_VECTOR(AP, q_.data + 24 * base)
  OWN_VECTOR(AZ, t_.data + 24 * base)
  float* Z = z_.data + 24 * base;
  float* ZN = zn_.data + 8 * base;
  unsigned shown = 0;
  const bool first = stage == FIRST_, response = stage == RESPONSE_;
  const float gv = g - (first ? step.data[4 * world + 3] : 1.0f) * h * h;
"""
        + VOLUME
        + setup
        + """
  // What the volume term adds to a product is this times `along` along the area vectors.
  const float gain_ = bulk != 0.0f ? g * bulk / volume0 / 36.0f : 0.0f;
  // Right-hand side, its norm, and the start.
  V bb = zero, zo = zero;
  NEXT_TURN
  FOR_OWN(k, s) {
    LOAD(bx, by, bz, R0)
    if (push != 0.0f || pull != 0.0f) {
      bx += (push - pull) * LD(O + 24 * s, 0);
      by += (push - pull) * LD(O + 24 * s, 1);
      bz += (push - pull) * LD(O + 24 * s, 2);
    }
    PUT3(R, bx, by, bz)
    V zx, zy, zz;
    PRECONDITION(zx, zy, zz, bx, by, bz)
    bb += bx * zx + by * zy + bz * zz;
    LOAD(x, y, z, D0)
    SHOW(x, y, z)
    if (bending) { SHOW_NORMAL(WITH(N, x, y, z)) }
    if (bulk != 0.0f) zo += WITH(O, x, y, z);
  }
  GROUP_SUMS(bb, zo, norm, along)
  const float floor_ = step.data[4 * world + 2];
  const float whole = response ? status.data[4 * world + 2] : norm;
  float target = tolerance * tolerance * (whole > floor_ ? whole : floor_);
  if (response && target < ENOUGH_ * ENOUGH_ * norm) target = ENOUGH_ * ENOUGH_ * norm;
  float start = 0.0f;
  if (first && norm > target) {
    V db = zero, dq = zero;
    const float c = gain_ * along;
    FOR_OWN(k, s) {
      PRODUCT(D0, ZN)
      if (c != 0.0f) {
        ax += c * LD(O + 24 * s, 0); ay += c * LD(O + 24 * s, 1); az += c * LD(O + 24 * s, 2);
      }
      PUT3(AP, ax, ay, az)
      dq += x * ax + y * ay + z * az;
      db += x * GET(R, 0) + y * GET(R, 1) + z * GET(R, 2);
    }
    GROUP_SUMS(dq, db, curvature, gain)
    if (curvature > 0.0f) start = gain / curvature;
  }
  V rr = zero;
  zo = zero;
  NEXT_TURN
  FOR_OWN(k, s) {
    V x = zero, y = zero, z = zero;
    V rx = GET(R, 0), ry = GET(R, 1), rz_ = GET(R, 2);
    if (start != 0.0f) {
      x = start * LD(D0 + 24 * s, 0); y = start * LD(D0 + 24 * s, 1);
      z = start * LD(D0 + 24 * s, 2);
      rx -= start * GET(AP, 0); ry -= start * GET(AP, 1); rz_ -= start * GET(AP, 2);
      PUT3(R, rx, ry, rz_)
    }
    PUT3(X, x, y, z)
    PUT3(P, zero, zero, zero)
    PUT3(AP, zero, zero, zero)
    V zx, zy, zz;
    PRECONDITION(zx, zy, zz, rx, ry, rz_)
    rr += rx * zx + ry * zy + rz_ * zz;
"""
        + scale
        + """
    if (!OWN) { STORE(Z, zx, zy, zz) }
    SHOW(zx, zy, zz)
    if (bending) { SHOW_NORMAL(WITH(N, zx, zy, zz)) }
    if (bulk != 0.0f) zo += WITH(O, zx, zy, zz);
  }
  int it = 0;
  float rz = 0.0f, before = 0.0f, bent = 0.0f, residual = 0.0f;  // bent: p^T A p
  while (true) {
"""
        + precondition
        + """
    V zw = zero;
    SHOWN
    FOR_OWN(k, s) {
      PRODUCT(Z, ZN)
      PUT3(AZ, ax, ay, az)
      zw += x * ax + y * ay + z * az;
    }
    float curvature;
"""
        + (curvature or "curvature = group_sum(zw);")
        + """
    const float volume_ = gain_ * along;
    curvature += volume_ * along;
    float beta = before != 0.0f ? rz / before : 0.0f;
    bent = curvature - beta * beta * bent;
    if (!(bent > 0.0f)) {  // rounding has eaten it
      beta = 0.0f;
      bent = curvature;
    }
    const float alpha = rz / bent;
    before = rz;
    rr = zo = zero;
    NEXT_TURN
    FOR_OWN(k, s) {
      V ax = GET(AZ, 0), ay = GET(AZ, 1), az = GET(AZ, 2);
      if (volume_ != 0.0f) {
        ax += volume_ * LD(O + 24 * s, 0); ay += volume_ * LD(O + 24 * s, 1);
        az += volume_ * LD(O + 24 * s, 2);
      }
      SELF(x, y, z, Z)
      ax += beta * GET(AP, 0); ay += beta * GET(AP, 1); az += beta * GET(AP, 2);
      x += beta * GET(P, 0); y += beta * GET(P, 1); z += beta * GET(P, 2);
      PUT3(AP, ax, ay, az)
      PUT3(P, x, y, z)
      PUT3(X, GET(X, 0) + alpha * x, GET(X, 1) + alpha * y, GET(X, 2) + alpha * z)
      const V rx = GET(R, 0) - alpha * ax, ry = GET(R, 1) - alpha * ay;
      const V rz_ = GET(R, 2) - alpha * az;
      PUT3(R, rx, ry, rz_)
      V zx, zy, zz;
      PRECONDITION(zx, zy, zz, rx, ry, rz_)
      rr += rx * zx + ry * zy + rz_ * zz;
"""
        + scale
        + """
      if (!OWN) { STORE(Z, zx, zy, zz) }
      SHOW(zx, zy, zz)
      if (bending) { SHOW_NORMAL(WITH(N, zx, zy, zz)) }
      if (bulk != 0.0f) zo += WITH(O, zx, zy, zz);
    }
    ++it;
  }
  FOR_OWN(k, s) {
    for (int c = 0; c < 3; ++c) ST(X + 24 * s, c, GET(X, c));
  }
  if (tid != 0) return;
  float* out = status.data + 4 * world;
  out[0] = (first ? 0.0f : out[0]) + (float)it;
  if (first) out[2] = norm;
  if (!response)
    out[1] = out[2] > 0.0f ? sqrtf((residual > 0.0f ? residual : 0.0f) / out[2]) : 0.0f;
  out[3] = (norm < 1e30f && residual < 1e30f && norm >= 0.0f) ? 0.0f : 1.0f;
""",
        quads,
      ),
      not quads,
    )
  )


class Old:
  """Fields of the structs and numbers of a body by the names of old."""

  def __init__(self, *parts, **more):
    self.parts, self.more = parts, more

  def __getattr__(self, name):
    name = {"pos_trial": "disp_trial", "pos": "disp", "x": "sol"}.get(name, name)
    if name in self.more:
      return self.more[name]
    for part in self.parts:
      if name in part._cls.vars:
        return getattr(part, name)
    raise AttributeError(name)


def old(body):
  numbers = {k: body.number(k) for k in ("foundation", "bulk", "pressure", "tolerance")}
  s = Old(body.shape, body.tissue, has_bending=body.has_bending, device=body.device,
          iterations=int(body.number("iterations")), **numbers)
  return s, Old(body.state, body.system, nworld=body.nworld)
