"""The implicit step's solve with a multilevel preconditioner, for large or stiff organs.

One V-cycle on coarser meshes of the organ (`hierarchy`) takes the place of block Jacobi. The matrix
of a coarse mesh is the organ's own, made by the same kernels at the present shape sampled at its
nodes: no triple products, bending scales as it should, and a deformed shape is as good as the rest
shape. Smoothing is Chebyshev iteration on D^-1 A (Adams et al. 2003,
doi:10.1016/S0021-9991(03)00194-3) of two or three steps, before and after, which keeps the
preconditioner symmetric; the coarsest mesh in use, whose matrix is mostly mass, has more steps.
How many levels are in use, and whether any, follows from the condition number that A has in this
step: g / mass times the stiffness of a node.
"""

from __future__ import annotations

import warp as wp

from . import device as simd_threads
from . import solver
from .types import Stage

# Below this condition number a mesh is solved by a few steps of the smoother.
_EASY = 8.0
# Above this one float32 residuals are noise to the slowest modes, which only cycles would act on.
_WORST = 2e5

_SETUP = """
  // What one level's passes read and write.
  struct Mesh_ {
    const float* K; const float* M; const float* I_; const float* N;
    const int* slot; const int* fan; const int* bend_row; const int* bend_at; const float* Q;
    float* b; float* z; float* zn; float* e; float* en; float* t;
  };
  const size_t cbase = (size_t)world * ncslice;
  const Mesh_ finest = {
    K, M, I_, N, slot, fan, bend_row, bend_at, Q,
    R, Z, ZN, e_.data + 24 * base, en_.data + 8 * base, t_.data + 24 * base
  };
  const Mesh_ coarse = {
    cblock.data + 72 * (size_t)world * ncslot, cdiag.data + 8 * cbase, cinverse.data + 48 * cbase,
    cnormal.data + 24 * cbase, cslot_adr.data, cfan_node.data, cbend_adr.data, cbend_node.data,
    cbend_gain.data, cr_.data + 24 * cbase, cz_.data + 24 * cbase, czn_.data + 8 * cbase,
    ce_.data + 24 * cbase, cen_.data + 8 * cbase, ct_.data + 24 * cbase
  };
  auto mesh_of = [&](int l) -> const Mesh_& { return l == 0 ? finest : coarse; };
  // Bit l: z and e of level l have changed places.
  unsigned turned = 0;
  auto z_of = [&](int l, bool other) -> float* {
    return ((turned >> l & 1) != 0) != other ? mesh_of(l).e : mesh_of(l).z;
  };
  auto zn_of = [&](int l, bool other) -> float* {
    return ((turned >> l & 1) != 0) != other ? mesh_of(l).en : mesh_of(l).zn;
  };
  auto first_slice = [&](int l) -> int { return l == 0 ? 0 : slice_adr.data[l - 1]; };
  auto last_slice = [&](int l) -> int { return l == 0 ? nslice : slice_adr.data[l]; };
  // Levels in use: down to the first one that is easy.
  V heavy = zero;
  FOR_SLICES(s) heavy += LD(M, s) * LD(free_.data, s);
  const float per_mass = g * (float)nodes / group_sum(heavy);
  auto condition = [&](int l) -> float {
    return per_mass * rate.data[5 * l] / rate.data[5 * l + 4];
  };
  int depth = 0;
  if (condition(0) >= threshold && condition(0) <= WORST) {
    depth = 1;
    while (depth < nlevel && condition(depth) > EASY) ++depth;
  }
  // Interval and steps of the smoother; the coarsest level goes down to the mass.
  auto high = [&](int l) -> float { return rate.data[5 * l + 1]; };
  auto low = [&](int l) -> float {
    if (l < depth) return rate.data[5 * l + 2];
    const float c = 2.0f * condition(l);
    return high(l) / (c < 8.0f ? 8.0f : c > 60.0f ? 60.0f : c);
  };
  auto steps = [&](int l) -> int {
    return l < depth ? (int)rate.data[5 * l + 3] : condition(l) > EASY ? 8 : 4;
  };
  float damp = depth > 0 ? 2.0f / (high(0) + low(0)) : 1.0f;
  // One step on level l: d = keep d + add D^-1 (b - A z), e = z + d; then z and e change places.
  // Where `same`, d is z. Returns the sums of b^T e and of e with the area vectors where `last`.
  auto relax = [&](int l, float keep, float add, bool same, bool last, float& be, float& oe) {
    const Mesh_& m = mesh_of(l);
    const float* from = z_of(l, false);
    const float* fromn = zn_of(l, false);
    float* to = z_of(l, true);
    float* ton = zn_of(l, true);
    const float* K = m.K; const float* M = m.M; const float* I_ = m.I_; const float* N = m.N;
    const int* slot = m.slot; const int* fan = m.fan;
    const int* bend_row = m.bend_row; const int* bend_at = m.bend_at;
    const float* Q = m.Q;
    const float* b = m.b;
    float* t = m.t;
    V sum = zero, flux = zero;
    FOR_RANGE(s, first_slice(l), last_slice(l)) {
      V rx, ry, rz_, qx, qy, qz;
      {
        PRODUCT(from, fromn)
        LOAD(bx, by, bz, b)
        rx = bx - ax; ry = by - ay; rz_ = bz - az;
        PRECONDITION(qx, qy, qz, rx, ry, rz_)
        qx *= add; qy *= add; qz *= add;
        if (keep != 0.0f) {
          if (same) {
            qx += keep * x; qy += keep * y; qz += keep * z;
          } else {
            LOAD(dx, dy, dz, t)
            qx += keep * dx; qy += keep * dy; qz += keep * dz;
          }
        }
        STORE(t, qx, qy, qz)
        qx += x; qy += y; qz += z;
        if (last) sum += bx * qx + by * qy + bz * qz;
      }
      STORE(to, qx, qy, qz)
      if (bending) ST(ton, s, WITH(N, qx, qy, qz));
      if (last && bulk != 0.0f) flux += WITH(O, qx, qy, qz);
    }
    if (last) {
      GROUP_SUMS(sum, flux, total_, along_)
      be = total_;
      oe = along_;
    } else {
      GROUP_SYNC();
    }
    turned ^= 1u << l;
  };
"""

_CYCLE = """
    {
      GROUP_SUMS(rr, zo, fresh, flux)
      rz = residual = fresh;
      along = flux;
    }
    if (!(residual > target) || it >= iterations) break;
    if (depth > 0) {
      // Chebyshev steps from k = 0, or from 1 where step 0 was on zero: z = D^-1 b / theta.
      auto smooth = [&](int l, int from, bool last) {
        const float theta = 0.5f * (high(l) + low(l)), delta = 0.5f * (high(l) - low(l));
        const float sigma = theta / delta;
        const int count = steps(l);
        float rho = 1.0f / sigma;
        for (int k = from; k < count; ++k) {
          const float next = k > 0 ? 1.0f / (2.0f * sigma - rho) : rho;
          const float add = k > 0 ? 2.0f * next / delta : 1.0f / theta;
          const bool final_ = last && k + 1 == count;
          relax(l, k > 0 ? next * rho : 0.0f, add, k == 1 && from == 1, final_, rz, along);
          rho = next;
        }
      };
      for (int l = 0; l < depth; ++l) {
        smooth(l, 1, false);
        {
          const Mesh_& m = mesh_of(l);
          const float* K = m.K; const float* M = m.M; const float* N = m.N;
          const int* slot = m.slot; const int* fan = m.fan;
          const int* bend_row = m.bend_row; const int* bend_at = m.bend_at;
          const float* Q = m.Q;
          const float* b = m.b;
          const float* from = z_of(l, false);
          const float* fromn = zn_of(l, false);
          float* t = m.t;
          FOR_RANGE(s, first_slice(l), last_slice(l)) {
            PRODUCT(from, fromn)
            LOAD(bx, by, bz, b)
            STORE(t, bx - ax, by - ay, bz - az)
          }
          GROUP_SYNC();
        }
        const float* t = mesh_of(l).t;
        const float* I_ = coarse.I_;
        const float* N = coarse.N;
        float* to = z_of(l + 1, false);
        float* ton = zn_of(l + 1, false);
        const float step0 = 2.0f / (high(l + 1) + low(l + 1));
        FOR_RANGE(s, first_slice(l + 1), last_slice(l + 1)) {
          V bx = zero, by = zero, bz = zero;
          for (int i = down_adr.data[s]; i < down_adr.data[s + 1]; ++i) {
            const int* node = down_node.data + 8 * (size_t)i;
            const V w = LD(down_weight.data, i);
            bx += w * GATHER(t, node, 0); by += w * GATHER(t, node, 1);
            bz += w * GATHER(t, node, 2);
          }
          STORE(coarse.b, bx, by, bz)
          V zx, zy, zz;
          PRECONDITION(zx, zy, zz, bx, by, bz)
          zx *= step0; zy *= step0; zz *= step0;
          STORE(to, zx, zy, zz)
          if (bending) ST(ton, s, WITH(N, zx, zy, zz));
        }
        GROUP_SYNC();
      }
      smooth(depth, 1, false);
      for (int l = depth - 1; l >= 0; --l) {
        const float* N = mesh_of(l).N;
        const float* from = z_of(l + 1, false);
        float* to = z_of(l, false);
        float* ton = zn_of(l, false);
        const int lists = l == 0 ? 0 : nslice;
        FOR_RANGE(s, first_slice(l), last_slice(l)) {
          LOAD(zx, zy, zz, to)
          for (int i = up_adr.data[lists + s]; i < up_adr.data[lists + s + 1]; ++i) {
            const int* node = up_node.data + 8 * (size_t)i;
            const V w = LD(up_weight.data, i);
            zx += w * GATHER(from, node, 0); zy += w * GATHER(from, node, 1);
            zz += w * GATHER(from, node, 2);
          }
          STORE(to, zx, zy, zz)
          if (bending) ST(ton, s, WITH(N, zx, zy, zz));
        }
        GROUP_SYNC();
        smooth(l, 0, l == 0);
      }
      Z = z_of(0, false);
      ZN = zn_of(0, false);
      // Far from the rest shape the interval may not hold: block Jacobi always works.
      if (!(rz > 0.0f)) {
        depth = 0;
        damp = 1.0f;
        before = 0.0f;
        rr = zo = zero;
        FOR_SLICES(s) {
          LOAD(rx, ry, rz_, R)
          V zx, zy, zz;
          PRECONDITION(zx, zy, zz, rx, ry, rz_)
          rr += rx * zx + ry * zy + rz_ * zz;
          STORE(Z, zx, zy, zz)
          if (bending) ST(ZN, s, WITH(N, zx, zy, zz));
          if (bulk != 0.0f) zo += WITH(O, zx, zy, zz);
        }
        GROUP_SUMS(rr, zo, fresh, flux)
        rz = fresh;
        along = flux;
      }
    }
"""
_SOLVE = solver.body(
  _SETUP.replace("EASY", f"{_EASY}f").replace("WORST", f"{_WORST}f"),
  _CYCLE,
  "zx *= damp; zy *= damp; zz *= damp;",
)


@wp.func_native(_SOLVE)
def _solve_world(
  world: int,
  tid: int,
  nthread: int,
  nslice: int,
  nslot: int,
  stage: int,
  bending: int,
  bulk: float,
  pressure: float,
  volume0: float,
  tolerance: float,
  iterations: int,
  nodes: int,
  nlevel: int,
  ncslice: int,
  ncslot: int,
  threshold: float,
  slot_adr: wp.array[int],
  fan_node: wp.array2d[int],
  bend_adr: wp.array[int],
  bend_node: wp.array2d[int],
  bend_gain: wp.array2d[float],
  rest: wp.array3d[float],
  free_: wp.array2d[float],
  slice_adr: wp.array[int],
  rate: wp.array2d[float],
  down_adr: wp.array[int],
  down_node: wp.array2d[int],
  down_weight: wp.array2d[float],
  up_adr: wp.array[int],
  up_node: wp.array2d[int],
  up_weight: wp.array2d[float],
  cslot_adr: wp.array[int],
  cfan_node: wp.array2d[int],
  cbend_adr: wp.array[int],
  cbend_node: wp.array2d[int],
  cbend_gain: wp.array2d[float],
  step: wp.array2d[float],
  pos: wp.array4d[float],
  vel: wp.array4d[float],
  warm: wp.array4d[float],
  block: wp.array4d[float],
  diag: wp.array3d[float],
  inverse: wp.array4d[float],
  rhs: wp.array4d[float],
  areavec: wp.array4d[float],
  normal: wp.array4d[float],
  cblock: wp.array4d[float],
  cdiag: wp.array3d[float],
  cinverse: wp.array4d[float],
  cnormal: wp.array4d[float],
  total: wp.array2d[float],
  x_: wp.array4d[float],
  r_: wp.array4d[float],
  p_: wp.array4d[float],
  q_: wp.array4d[float],
  z_: wp.array4d[float],
  zn_: wp.array3d[float],
  partial_: wp.array3d[float],
  e_: wp.array4d[float],
  en_: wp.array3d[float],
  t_: wp.array4d[float],
  cr_: wp.array4d[float],
  cz_: wp.array4d[float],
  czn_: wp.array3d[float],
  ce_: wp.array4d[float],
  cen_: wp.array3d[float],
  ct_: wp.array4d[float],
  status: wp.array2d[float],
): ...


@wp.kernel(enable_backward=False, launch_bounds=(512, 2))
def _solve(
  nthread: int,
  nslice: int,
  nslot: int,
  stage: int,
  bending: int,
  bulk: float,
  pressure: float,
  volume0: float,
  tolerance: float,
  iterations: int,
  nodes: int,
  nlevel: int,
  ncslice: int,
  ncslot: int,
  threshold: float,
  # Surface:
  slot_adr: wp.array[int],
  fan_node: wp.array2d[int],
  bend_adr: wp.array[int],
  bend_node: wp.array2d[int],
  bend_gain: wp.array2d[float],
  rest: wp.array3d[float],
  # Levels:
  free: wp.array2d[float],
  slice_adr: wp.array[int],
  rate: wp.array2d[float],
  down_adr: wp.array[int],
  down_node: wp.array2d[int],
  down_weight: wp.array2d[float],
  up_adr: wp.array[int],
  up_node: wp.array2d[int],
  up_weight: wp.array2d[float],
  cslot_adr: wp.array[int],
  cfan_node: wp.array2d[int],
  cbend_adr: wp.array[int],
  cbend_node: wp.array2d[int],
  cbend_gain: wp.array2d[float],
  # State in:
  step_in: wp.array2d[float],
  pos_in: wp.array4d[float],
  vel_in: wp.array4d[float],
  dvel_warm_in: wp.array4d[float],
  block_in: wp.array4d[float],
  diag_in: wp.array3d[float],
  inverse_in: wp.array4d[float],
  rhs_in: wp.array4d[float],
  areavec_in: wp.array4d[float],
  normal_in: wp.array4d[float],
  cblock_in: wp.array4d[float],
  cdiag_in: wp.array3d[float],
  cinverse_in: wp.array4d[float],
  cnormal_in: wp.array4d[float],
  # State out:
  total_out: wp.array2d[float],
  x_out: wp.array4d[float],
  r_out: wp.array4d[float],
  p_out: wp.array4d[float],
  q_out: wp.array4d[float],
  z_out: wp.array4d[float],
  zn_out: wp.array3d[float],
  partial_out: wp.array3d[float],
  e_out: wp.array4d[float],
  en_out: wp.array3d[float],
  t_out: wp.array4d[float],
  cr_out: wp.array4d[float],
  cz_out: wp.array4d[float],
  czn_out: wp.array3d[float],
  ce_out: wp.array4d[float],
  cen_out: wp.array3d[float],
  ct_out: wp.array4d[float],
  status_out: wp.array2d[float],
):
  world, tid = wp.tid()
  _solve_world(
    world,
    tid,
    nthread,
    nslice,
    nslot,
    stage,
    bending,
    bulk,
    pressure,
    volume0,
    tolerance,
    iterations,
    nodes,
    nlevel,
    ncslice,
    ncslot,
    threshold,
    slot_adr,
    fan_node,
    bend_adr,
    bend_node,
    bend_gain,
    rest,
    free,
    slice_adr,
    rate,
    down_adr,
    down_node,
    down_weight,
    up_adr,
    up_node,
    up_weight,
    cslot_adr,
    cfan_node,
    cbend_adr,
    cbend_node,
    cbend_gain,
    step_in,
    pos_in,
    vel_in,
    dvel_warm_in,
    block_in,
    diag_in,
    inverse_in,
    rhs_in,
    areavec_in,
    normal_in,
    cblock_in,
    cdiag_in,
    cinverse_in,
    cnormal_in,
    total_out,
    x_out,
    r_out,
    p_out,
    q_out,
    z_out,
    zn_out,
    partial_out,
    e_out,
    en_out,
    t_out,
    cr_out,
    cz_out,
    czn_out,
    ce_out,
    cen_out,
    ct_out,
    status_out,
  )


def solve(body, stage: Stage):
  """Solves A x = rhs as `solver.solve` does, with the matrices that `assemble` wrote."""
  s, d = solver.old(body)
  c, e = solver.old(body.levels.body)
  levels = body.levels.transfer
  nthread = simd_threads.group_size(s.device, s.nslice, d.nworld, per_sm=2)
  wp.launch(
    _solve,
    dim=(d.nworld, nthread),
    block_dim=simd_threads.block(s.device, s.nslice),
    inputs=[
      nthread,
      s.nslice,
      s.nslot,
      int(stage),
      int(s.has_bending),
      s.bulk,
      s.pressure,
      s.volume0,
      s.tolerance,
      s.iterations,
      levels.nodes,
      levels.nlevel,
      c.nslice,
      c.nslot,
      levels.threshold,
      s.slot_adr,
      s.fan_node,
      s.bend_adr,
      s.bend_node,
      s.bend_gain,
      s.rest,
      s.free,
      levels.slice_adr,
      levels.rate,
      levels.down_adr,
      levels.down_node,
      levels.down_weight,
      levels.up_adr,
      levels.up_node,
      levels.up_weight,
      c.slot_adr,
      c.fan_node,
      c.bend_adr,
      c.bend_node,
      c.bend_gain,
      d.step,
      d.pos_trial,
      d.vel_trial,
      d.dvel_warm,
      d.block,
      d.diag,
      d.inverse,
      d.rhs,
      d.areavec,
      d.normal,
      e.block,
      e.diag,
      e.inverse,
      e.normal,
    ],
    outputs=[
      d.total,
      d.x,
      d.r,
      d.p,
      d.q,
      d.z,
      d.zn,
      d.partial,
      d.e,
      d.en,
      d.t,
      e.r,
      e.z,
      e.zn,
      e.e,
      e.en,
      e.t,
      d.status,
    ],
    device=s.device,
  )
