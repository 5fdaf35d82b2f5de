"""Kernels of window coupling, on the CPU: gather, scatter, advance and place; see `window`."""

from __future__ import annotations

import warp as wp

_SLOT = """
  auto node_of = [&](int k) -> int {
    const int n = (int)slots[k];
    return n == 0 ? home.data[k] : n < 0 || n > nvert ? -1 : n - 1;
  };
"""

_STATE = """
  double* U = plugin_state.data;
  double* W = U + 3 * nvert;
  double* D = W + 3 * nvert;
  double* fc = D + 3 * nvert;
  double* slots = fc + 3 * nslot;
"""


@wp.func_native(
  _STATE
  + _SLOT
  + """
  const double h = timestep.data[0];
  step.data[0] = (float)h;
  step.data[1] = (float)(h * h + h * (double)damping);
  const bool falls = !(disableflags.data[0] & disable_gravity);
  double g[3] = {0.0, 0.0, 0.0};
  for (int c = 0; c < 3 && falls; ++c)
    for (int k = 0; k < 3; ++k) g[c] += frame.data[3 * k + c] * gravity.data[k];
  double weight = 0.0;
  for (int i = 0; i < nvert; ++i) {
    const int at = node.data[i];
    const double m = node_mass.data[i];
    weight += m;
    for (int c = 0; c < 3; ++c) {
      pos.data[at + 8 * c] = (float)U[3 * i + c];
      vel.data[at + 8 * c] = (float)W[3 * i + c];
      dvel_warm.data[at + 8 * c] = (float)D[3 * i + c];
      force_ext.data[at + 8 * c] = (float)(m * g[c]);
    }
  }
  int stale = 0;
  for (int k = 0; k < nslot; ++k) {
    const int i = node_of(k), adr = dofadr.data[k], body = bodyid.data[k];
    if (i != placed.data[k]) stale = 1;
    const double* x = xfrc_applied.data + 6 * body;
    for (int c = 0; c < 3; ++c) {
      // What acts on the slot besides its own weight acts on the node.
      const double f = qfrc_applied.data[adr + c] + qfrc_passive.data[adr + c]
        + frame.data[c] * x[0] + frame.data[3 + c] * x[1] + frame.data[6 + c] * x[2];
      const double lagged = i < 0 ? 0.0 : fc[3 * k + c];
      ext.data[3 * k + c] = f + lagged + body_mass.data[body] * g[c];
      if (i >= 0) force_ext.data[node.data[i] + 8 * c] += (float)(f + lagged);
    }
  }
  flags.data[0] = stale;
  const double rest = (double)rest_share * 9.81 * h;
  step.data[2] = (float)(weight * rest * rest);
"""
)
def _gather_native(
  nvert: int,
  nslot: int,
  disable_gravity: int,
  damping: float,
  rest_share: float,
  node: wp.array[int],
  node_mass: wp.array[wp.float64],
  home: wp.array[int],
  placed: wp.array[int],
  dofadr: wp.array[int],
  bodyid: wp.array[int],
  frame: wp.array[wp.float64],
  timestep: wp.array[wp.float64],
  gravity: wp.array[wp.float64],
  disableflags: wp.array[int],
  body_mass: wp.array[wp.float64],
  qfrc_applied: wp.array[wp.float64],
  qfrc_passive: wp.array[wp.float64],
  xfrc_applied: wp.array[wp.float64],
  plugin_state: wp.array[wp.float64],
  step: wp.array2d[float],
  pos: wp.array4d[float],
  vel: wp.array4d[float],
  force_ext: wp.array4d[float],
  dvel_warm: wp.array4d[float],
  ext: wp.array[wp.float64],
  flags: wp.array[int],
): ...


@wp.kernel(enable_backward=False)
def gather(
  nvert: int,
  nslot: int,
  disable_gravity: int,
  damping: float,
  rest_share: float,
  # Organ:
  node: wp.array[int],
  node_mass: wp.array[wp.float64],
  home: wp.array[int],
  placed: wp.array[int],
  dofadr: wp.array[int],
  bodyid: wp.array[int],
  frame: wp.array[wp.float64],
  # Model:
  timestep: wp.array[wp.float64],
  gravity: wp.array[wp.float64],
  disableflags: wp.array[int],
  body_mass: wp.array[wp.float64],
  # Data in:
  qfrc_applied_in: wp.array[wp.float64],
  qfrc_passive_in: wp.array[wp.float64],
  xfrc_applied_in: wp.array[wp.float64],
  plugin_state_in: wp.array[wp.float64],
  # State out:
  step_out: wp.array2d[float],
  pos_out: wp.array4d[float],
  vel_out: wp.array4d[float],
  force_ext_out: wp.array4d[float],
  dvel_warm_out: wp.array4d[float],
  ext_out: wp.array[wp.float64],
  flags_out: wp.array[int],
):
  """Reads the organ's state and what acts on the windows; flags slots that the model lacks."""
  _gather_native(
    nvert,
    nslot,
    disable_gravity,
    damping,
    rest_share,
    node,
    node_mass,
    home,
    placed,
    dofadr,
    bodyid,
    frame,
    timestep,
    gravity,
    disableflags,
    body_mass,
    qfrc_applied_in,
    qfrc_passive_in,
    xfrc_applied_in,
    plugin_state_in,
    step_out,
    pos_out,
    vel_out,
    force_ext_out,
    dvel_warm_out,
    ext_out,
    flags_out,
  )


@wp.func_native("""
  const double ok = status.data[3] == 0.0f ? 1.0 : 0.0;
  for (int k = 0; k < nslot; ++k) {
    const int i = placed.data[k], adr = dofadr.data[k];
    for (int c = 0; c < 3; ++c) {
      const double inertia = M.data[massadr.data[3 * k + c]];
      const double dv = i < 0 ? 0.0 : (double)dvel.data[node.data[i] + 8 * c];
      const double f = (ok != 0.0 ? inertia * dv / timestep.data[0] : 0.0) - ext.data[3 * k + c];
      if (f == f) qfrc_passive.data[adr + c] += f;
    }
  }
""")
def _scatter_native(
  nslot: int,
  node: wp.array[int],
  placed: wp.array[int],
  dofadr: wp.array[int],
  massadr: wp.array[int],
  timestep: wp.array[wp.float64],
  M: wp.array[wp.float64],
  ext: wp.array[wp.float64],
  dvel: wp.array4d[float],
  status: wp.array2d[float],
  qfrc_passive: wp.array[wp.float64],
): ...


@wp.kernel(enable_backward=False)
def scatter(
  nslot: int,
  # Organ:
  node: wp.array[int],
  placed: wp.array[int],
  dofadr: wp.array[int],
  massadr: wp.array[int],
  # Model:
  timestep: wp.array[wp.float64],
  # State in:
  M_in: wp.array[wp.float64],
  ext_in: wp.array[wp.float64],
  dvel_in: wp.array4d[float],
  status_in: wp.array2d[float],
  # Data out:
  qfrc_passive_out: wp.array[wp.float64],
):
  """Adds the passive force that carries v + dv to the windows' dofs."""
  _scatter_native(
    nslot,
    node,
    placed,
    dofadr,
    massadr,
    timestep,
    M_in,
    ext_in,
    dvel_in,
    status_in,
    qfrc_passive_out,
  )


# Moves the organ, then picks each window's nodes by the distance to its geoms.
@wp.func_native(
  _STATE
  + _SLOT
  + """
  const double h = timestep.data[0];
  const double ok = status.data[3] == 0.0f ? 1.0 : 0.0;
  double low[3] = {1e300, 1e300, 1e300}, high[3] = {-1e300, -1e300, -1e300};
  for (int i = 0; i < nvert; ++i) {
    const int at = node.data[i];
    for (int c = 0; c < 3; ++c) {
      const int j = 3 * i + c;
      const double dv = ok * (double)dvel.data[at + 8 * c];
      D[j] = dv;
      W[j] += dv;
      U[j] += h * W[j];
      const double x = rest.data[j] + U[j];
      low[c] = x < low[c] ? x : low[c];
      high[c] = x > high[c] ? x : high[c];
    }
  }
  for (int k = 0; k < nslot; ++k) {
    const int i = placed.data[k], adr = dofadr.data[k], qadr = qposadr.data[k];
    for (int c = 0; c < 3; ++c) {
      fc[3 * k + c] = i < 0 ? 0.0 : qfrc_constraint.data[adr + c];
      if (i < 0) continue;
      W[3 * i + c] = qvel.data[adr + c];
      U[3 * i + c] = qpos.data[qadr + c] - qhome.data[3 * k + c] - rest.data[3 * i + c];
    }
  }
  flags.data[2] = 0;
  for (int w = 0; w < nwindow; ++w) {
    const int first = window_adr.data[w], many = window_adr.data[w + 1] - first;
    // Geoms of this window that are near enough, in the organ's frame.
    double reach = reach_.data[0];
    int ngeom = 0;
    double cx[16], cy[16], cz[16], rb[16];
    int id[16];
    for (int q = geom_adr.data[w]; q < geom_adr.data[w + 1] && ngeom < 16; ++q) {
      const int g = geom.data[q];
      double p[3], away = 0.0;
      for (int c = 0; c < 3; ++c) {
        p[c] = 0.0;
        for (int k = 0; k < 3; ++k)
          p[c] += frame.data[3 * k + c] * (geom_xpos.data[3 * g + k] - origin.data[k]);
        const double out = p[c] < low[c] ? low[c] - p[c] : p[c] > high[c] ? p[c] - high[c] : 0.0;
        away += out * out;
      }
      const double r = geom_rbound.data[g] + reach;
      if (!(away < r * r)) continue;
      id[ngeom] = g; cx[ngeom] = p[0]; cy[ngeom] = p[1]; cz[ngeom] = p[2]; rb[ngeom] = r * r;
      ++ngeom;
    }
    if (ngeom == 0) continue;
    int count = 0;
    for (int i = 0; i < nvert; ++i) {
      if (taken.data[i] >= 0 && (taken.data[i] < first || taken.data[i] >= first + many)) continue;
      const double x = rest.data[3 * i] + U[3 * i], y = rest.data[3 * i + 1] + U[3 * i + 1];
      const double z = rest.data[3 * i + 2] + U[3 * i + 2];
      double best = 1e300;
      for (int q = 0; q < ngeom; ++q) {
        const double dx = x - cx[q], dy = y - cy[q], dz = z - cz[q];
        if (dx * dx + dy * dy + dz * dz > rb[q]) continue;
        // In the geom's frame: local = (R_organ^T R_geom)^T d.
        const double* G = geom_xmat.data + 9 * id[q];
        double l[3];
        double wd[3];
        for (int c = 0; c < 3; ++c)
          wd[c] = frame.data[3 * c] * dx + frame.data[3 * c + 1] * dy + frame.data[3 * c + 2] * dz;
        for (int c = 0; c < 3; ++c) l[c] = G[c] * wd[0] + G[3 + c] * wd[1] + G[6 + c] * wd[2];
        const double* s = geom_size.data + 3 * id[q];
        const int type = geom_type.data[id[q]];
        double dist;
        if (type == 2) {
          dist = sqrt(l[0] * l[0] + l[1] * l[1] + l[2] * l[2]) - s[0];
        } else if (type == 3) {
          const double t = l[2] < -s[1] ? l[2] + s[1] : l[2] > s[1] ? l[2] - s[1] : 0.0;
          dist = sqrt(l[0] * l[0] + l[1] * l[1] + t * t) - s[0];
        } else if (type == 4) {
          const double a = l[0] / s[0], b = l[1] / s[1], c = l[2] / s[2];
          const double n = sqrt(a * a + b * b + c * c);
          const double e = sqrt(a * a / (s[0] * s[0]) + b * b / (s[1] * s[1])
                                + c * c / (s[2] * s[2]));
          dist = e > 1e-12 ? n * (n - 1.0) / e : -s[0];
        } else if (type == 5) {
          const double r = sqrt(l[0] * l[0] + l[1] * l[1]) - s[0];
          const double t = (l[2] < 0.0 ? -l[2] : l[2]) - s[1];
          const double rp = r > 0.0 ? r : 0.0, tp = t > 0.0 ? t : 0.0;
          dist = sqrt(rp * rp + tp * tp) + (r > t ? (r < 0.0 ? r : 0.0) : (t < 0.0 ? t : 0.0));
        } else {
          // Boxes, and the bounding box of a mesh.
          const double* box = geom_aabb.data + 6 * id[q];
          double out = 0.0, in = -1e300;
          for (int c = 0; c < 3; ++c) {
            const double at = l[c] - box[c];
            const double e = (at < 0.0 ? -at : at) - box[3 + c];
            if (e > 0.0) out += e * e;
            in = e > in ? e : in;
          }
          dist = out > 0.0 ? sqrt(out) : in;
        }
        best = dist < best ? dist : best;
      }
      if (best > reach) continue;
      candidate.data[count] = i;
      distance.data[count] = best;
      ++count;
    }
    if (count < 3) continue;
    // The `many` nearest, by quickselect.
    if (count > many) {
      int a = 0, b = count - 1;
      while (a < b) {
        const double pivot = distance.data[(a + b) / 2];
        int i = a, j = b;
        while (i <= j) {
          while (distance.data[i] < pivot) ++i;
          while (distance.data[j] > pivot) --j;
          if (i <= j) {
            const double t = distance.data[i]; distance.data[i] = distance.data[j];
            distance.data[j] = t;
            const int n = candidate.data[i]; candidate.data[i] = candidate.data[j];
            candidate.data[j] = n;
            ++i; --j;
          }
        }
        if (many - 1 <= j) b = j;
        else if (many - 1 >= i) a = i;
        else break;
      }
      for (int q = many; q < count; ++q) flags.data[2] += distance.data[q] < touch_.data[0];
      count = many;
    }
    // Nodes that stay keep their slot; the others fill the free ones in the order of the mesh.
    for (int k = first; k < first + many; ++k) {
      const int i = placed.data[k];
      if (i >= 0) taken.data[i] = -1;
    }
    for (int q = 0; q < count; ++q) chosen.data[candidate.data[q]] = 1;
    for (int k = first; k < first + many; ++k) {
      const int i = placed.data[k];
      if (i >= 0 && chosen.data[i]) { taken.data[i] = k; chosen.data[i] = 0; }
      else {
        slots[k] = -1.0;
        for (int c = 0; c < 3; ++c) fc[3 * k + c] = 0.0;
      }
      if (i >= 0 && taken.data[i] == k) slots[k] = i + 1.0;
    }
    int k = first;
    for (int q = 0; q < count; ++q) {
      const int i = candidate.data[q];
      if (!chosen.data[i]) continue;
      chosen.data[i] = 0;
      while (slots[k] >= 0.0) ++k;
      slots[k] = i + 1.0;
      taken.data[i] = k;
    }
  }
"""
)
def _advance_native(
  nvert: int,
  nslot: int,
  nwindow: int,
  node: wp.array[int],
  rest: wp.array[wp.float64],
  home: wp.array[int],
  qhome: wp.array[wp.float64],
  placed: wp.array[int],
  dofadr: wp.array[int],
  qposadr: wp.array[int],
  window_adr: wp.array[int],
  geom_adr: wp.array[int],
  geom: wp.array[int],
  frame: wp.array[wp.float64],
  origin: wp.array[wp.float64],
  reach_: wp.array[wp.float64],
  touch_: wp.array[wp.float64],
  timestep: wp.array[wp.float64],
  geom_type: wp.array[int],
  geom_size: wp.array[wp.float64],
  geom_aabb: wp.array[wp.float64],
  geom_rbound: wp.array[wp.float64],
  geom_xpos: wp.array[wp.float64],
  geom_xmat: wp.array[wp.float64],
  qpos: wp.array[wp.float64],
  qvel: wp.array[wp.float64],
  qfrc_constraint: wp.array[wp.float64],
  dvel: wp.array4d[float],
  status: wp.array2d[float],
  plugin_state: wp.array[wp.float64],
  taken: wp.array[int],
  chosen: wp.array[int],
  candidate: wp.array[int],
  distance: wp.array[wp.float64],
  flags: wp.array[int],
): ...


@wp.kernel(enable_backward=False)
def advance(
  nvert: int,
  nslot: int,
  nwindow: int,
  # Organ:
  node: wp.array[int],
  rest: wp.array[wp.float64],
  home: wp.array[int],
  qhome: wp.array[wp.float64],
  placed: wp.array[int],
  dofadr: wp.array[int],
  qposadr: wp.array[int],
  window_adr: wp.array[int],
  geom_adr: wp.array[int],
  geom: wp.array[int],
  frame: wp.array[wp.float64],
  origin: wp.array[wp.float64],
  reach: wp.array[wp.float64],
  touch: wp.array[wp.float64],
  # Model:
  timestep: wp.array[wp.float64],
  geom_type: wp.array[int],
  geom_size: wp.array[wp.float64],
  geom_aabb: wp.array[wp.float64],
  geom_rbound: wp.array[wp.float64],
  # Data in:
  geom_xpos_in: wp.array[wp.float64],
  geom_xmat_in: wp.array[wp.float64],
  qpos_in: wp.array[wp.float64],
  qvel_in: wp.array[wp.float64],
  qfrc_constraint_in: wp.array[wp.float64],
  # State in:
  dvel_in: wp.array4d[float],
  status_in: wp.array2d[float],
  # Data out:
  plugin_state_out: wp.array[wp.float64],
  # Scratch:
  taken_out: wp.array[int],
  chosen_out: wp.array[int],
  candidate_out: wp.array[int],
  distance_out: wp.array[wp.float64],
  flags_out: wp.array[int],
):
  """Integrates the organ and chooses the nodes of each window."""
  _advance_native(
    nvert,
    nslot,
    nwindow,
    node,
    rest,
    home,
    qhome,
    placed,
    dofadr,
    qposadr,
    window_adr,
    geom_adr,
    geom,
    frame,
    origin,
    reach,
    touch,
    timestep,
    geom_type,
    geom_size,
    geom_aabb,
    geom_rbound,
    geom_xpos_in,
    geom_xmat_in,
    qpos_in,
    qvel_in,
    qfrc_constraint_in,
    dvel_in,
    status_in,
    plugin_state_out,
    taken_out,
    chosen_out,
    candidate_out,
    distance_out,
    flags_out,
  )


# Makes the model's windows and their dofs those of the slots.
@wp.func_native(
  _STATE
  + _SLOT
  + """
  for (int i = 0; i < nvert; ++i) taken.data[i] = -1;
  int changed = 0;
  for (int k = 0; k < nslot; ++k) {
    const int i = node_of(k), adr = dofadr.data[k], qadr = qposadr.data[k], body = bodyid.data[k];
    if (i != placed.data[k]) changed = 1;
    placed.data[k] = i;
    if (i >= 0) taken.data[i] = k;
    for (int c = 0; c < 3; ++c) {
      if (i < 0) { qvel.data[adr + c] = 0.0; continue; }
      qpos.data[qadr + c] = qhome.data[3 * k + c] + rest.data[3 * i + c] + U[3 * i + c];
      qvel.data[adr + c] = W[3 * i + c];
      const double own = body_mass.data[body];
      const double total = inertia.data[i] > own ? inertia.data[i] : own;
      dof_armature.data[adr + c] = total - own;
      dof_M0.data[adr + c] = total;
      dof_invweight0.data[adr + c] = 1.0 / node_mass.data[i];
    }
    if (i >= 0) body_invweight0.data[2 * body] = 1.0 / node_mass.data[i];
  }
  if (changed || force) {
    flags.data[3] = 0;
    for (int w = 0; w < nwindow; ++w) {
      const int first = window_adr.data[w], last = window_adr.data[w + 1];
      int* out = flex_elem.data + elem_adr.data[w];
      const int most = elem_num.data[w];
      int count = 0;
      for (int k = first; k < last; ++k) {
        const int i = placed.data[k];
        if (i < 0) continue;
        for (int q = near_adr.data[i]; q < near_adr.data[i + 1]; ++q) {
          const int* e = elem.data + 3 * near.data[q];
          if (e[0] != i) continue;
          const int b = taken.data[e[1]], c = taken.data[e[2]];
          if (b < first || b >= last || c < first || c >= last) continue;
          if (count == most) { flags.data[3] += 1; continue; }
          out[3 * count] = k - first;
          out[3 * count + 1] = b - first;
          out[3 * count + 2] = c - first;
          ++count;
        }
      }
      for (int q = count; q < most && count > 0; ++q)
        for (int c = 0; c < 3; ++c) out[3 * q + c] = out[c];
    }
  }
"""
)
def _place_native(
  nvert: int,
  nslot: int,
  nwindow: int,
  force: int,
  rest: wp.array[wp.float64],
  node_mass: wp.array[wp.float64],
  inertia: wp.array[wp.float64],
  elem: wp.array[int],
  near_adr: wp.array[int],
  near: wp.array[int],
  home: wp.array[int],
  qhome: wp.array[wp.float64],
  dofadr: wp.array[int],
  qposadr: wp.array[int],
  bodyid: wp.array[int],
  window_adr: wp.array[int],
  elem_adr: wp.array[int],
  elem_num: wp.array[int],
  body_mass: wp.array[wp.float64],
  plugin_state: wp.array[wp.float64],
  placed: wp.array[int],
  taken: wp.array[int],
  flex_elem: wp.array[int],
  dof_armature: wp.array[wp.float64],
  dof_M0: wp.array[wp.float64],
  dof_invweight0: wp.array[wp.float64],
  body_invweight0: wp.array[wp.float64],
  qpos: wp.array[wp.float64],
  qvel: wp.array[wp.float64],
  flags: wp.array[int],
): ...


@wp.kernel(enable_backward=False)
def place(
  nvert: int,
  nslot: int,
  nwindow: int,
  force: int,
  # Organ:
  rest: wp.array[wp.float64],
  node_mass: wp.array[wp.float64],
  inertia: wp.array[wp.float64],
  elem: wp.array[int],
  near_adr: wp.array[int],
  near: wp.array[int],
  home: wp.array[int],
  qhome: wp.array[wp.float64],
  dofadr: wp.array[int],
  qposadr: wp.array[int],
  bodyid: wp.array[int],
  window_adr: wp.array[int],
  elem_adr: wp.array[int],
  elem_num: wp.array[int],
  # Model:
  body_mass: wp.array[wp.float64],
  # Data in:
  plugin_state_in: wp.array[wp.float64],
  # Scratch:
  placed_out: wp.array[int],
  taken_out: wp.array[int],
  # Model out:
  flex_elem_out: wp.array[int],
  dof_armature_out: wp.array[wp.float64],
  dof_M0_out: wp.array[wp.float64],
  dof_invweight0_out: wp.array[wp.float64],
  body_invweight0_out: wp.array[wp.float64],
  # Data out:
  qpos_out: wp.array[wp.float64],
  qvel_out: wp.array[wp.float64],
  flags_out: wp.array[int],
):
  """Puts the windows' bodies on the nodes of their slots and rewrites their triangles."""
  _place_native(
    nvert,
    nslot,
    nwindow,
    force,
    rest,
    node_mass,
    inertia,
    elem,
    near_adr,
    near,
    home,
    qhome,
    dofadr,
    qposadr,
    bodyid,
    window_adr,
    elem_adr,
    elem_num,
    body_mass,
    plugin_state_in,
    placed_out,
    taken_out,
    flex_elem_out,
    dof_armature_out,
    dof_M0_out,
    dof_invweight0_out,
    body_invweight0_out,
    qpos_out,
    qvel_out,
    flags_out,
  )
