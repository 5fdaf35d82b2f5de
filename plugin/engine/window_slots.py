"""Kernels of window coupling over the windows' slots, on the CPU beside MuJoCo.

A slot is a vertex body of a window; see `window`. The last numbers of the plugin state (`TAIL`):
stamp of a motion kept on a device, time without motion [s], gravity [m/s^2] of the step in which
the organ fell asleep, the organ's bounds, how many times its inertia at rest a tool meets, and how
far a tool may go from where it was when the organ fell asleep [m].
"""

from __future__ import annotations

import warp as wp

from .coupling import (
  ANSWERED,
  ASLEEP,
  CHANGED,
  FORESEEN,
  HEAVIER,
  MISSED_ELEMENTS,
  MISSED_NODES,
  NEAR,
  PENDING,
  STALE,
)
from .window_nodes import DISTANCE, GEOM, HEAD, MAX_GEOMS, MAX_WINDOWS, RECORD, SUMMARY, struct

TAIL = 13
POSE = 12  # of a geom: centre and axes in the organ's frame
# Height at which the spare slot of a window waits [m].
AWAY = 1e3
# Time without motion and force after which an organ sleeps [s].
QUIET = 0.2
# A triangle that may be the nearest to a tool is sampled at this many points along an edge. No
# point of a triangle is farther from a corner than its longest edge over the root of 3.
_FINE, _CORNER = 16, 0.578


@struct
class Slots:
  """What MuJoCo and a windowed organ share; see `declare.Windows` for the organ's own arrays.

  Attributes:
    nvert, nslot, nwindow, most: counts, see `Nodes`
    no_gravity: bit of mjDSBL_GRAVITY
    resident: 1 if the motion stays on a device and the plugin state may be old
    number: see `types.NUMBERS`
    rest_share: see `step.REST`
    reach: distance from a geom within which nodes may be in a window [m]
    slow: speed below which the organ counts as at rest [m/s]
    longest: longest edge [m]
    skin: distance between surface and geom at which MuJoCo finds a contact, at most [m]
    weight: mass of the organ [kg]
    placed: node of each slot in the model, -1 for none     (nslot,)
    taken: slot of each node, -1 for none                   (nvert,)
    chosen, candidate, distance: scratch                    (nvert,)
    inertia: effective inertia of each node [kg]            (nvert,)
    touch: distance from a geom within which a node's triangles may touch it [m]  (nvert,)
    claim: scratch; -1 between steps                        (nvert,)
    left: node that a slot has given up in this step, -1    (nslot,)
    lagged: contact forces before the slots are given anew [N]  (3 nslot,)
    ext: external and lagged contact force [N]              (3 nslot,)
    other: what acted on the slots besides contacts [N]     (3 nslot,)
    foreseen: the inbox that the next step is expected to have, see `foresee`
    flags, heaviest: see `Workspace`                        (8,), (1,)
  """

  nvert: int
  nslot: int
  nwindow: int
  most: int
  no_gravity: int
  resident: int
  number: wp.array[wp.float64]
  rest_share: wp.float64
  reach: wp.float64
  slow: wp.float64
  longest: wp.float64
  skin: wp.float64
  weight: wp.float64
  # Organ:
  node_mass: wp.array[wp.float64]
  rest: wp.array[wp.float64]
  inertia: wp.array[wp.float64]
  touch: wp.array[wp.float64]
  elem: wp.array[int]
  near_adr: wp.array[int]
  near: wp.array[int]
  home: wp.array[int]
  qhome: wp.array[wp.float64]
  dofadr: wp.array[int]
  massadr: wp.array[int]
  qposadr: wp.array[int]
  bodyid: wp.array[int]
  window_adr: wp.array[int]
  elem_adr: wp.array[int]
  elem_num: wp.array[int]
  geom_adr: wp.array[int]
  geom: wp.array[int]
  frame: wp.array[wp.float64]
  origin: wp.array[wp.float64]
  # Scratch:
  placed: wp.array[int]
  taken: wp.array[int]
  chosen: wp.array[int]
  candidate: wp.array[int]
  distance: wp.array[wp.float64]
  claim: wp.array[int]
  left: wp.array[int]
  lagged: wp.array[wp.float64]
  ext: wp.array[wp.float64]
  other: wp.array[wp.float64]
  foreseen: wp.array[wp.float64]
  flags: wp.array[int]
  heaviest: wp.array[wp.float64]
  inbox: wp.array[wp.float64]
  outbox: wp.array[wp.float64]
  status: wp.array2d[float]
  # Model:
  timestep: wp.array[wp.float64]
  gravity: wp.array[wp.float64]
  disableflags: wp.array[int]
  geom_type: wp.array[int]
  geom_size: wp.array[wp.float64]
  geom_aabb: wp.array[wp.float64]
  geom_rbound: wp.array[wp.float64]
  body_mass: wp.array[wp.float64]
  flex_elem: wp.array[int]
  dof_armature: wp.array[wp.float64]
  dof_M0: wp.array[wp.float64]
  dof_invweight0: wp.array[wp.float64]
  body_invweight0: wp.array[wp.float64]
  # Data:
  body_awake: wp.array[int]
  geom_xpos: wp.array[wp.float64]
  geom_xmat: wp.array[wp.float64]
  qpos: wp.array[wp.float64]
  qvel: wp.array[wp.float64]
  M: wp.array[wp.float64]
  qLD: wp.array[wp.float64]
  qLDiagInv: wp.array[wp.float64]
  qfrc_applied: wp.array[wp.float64]
  qfrc_passive: wp.array[wp.float64]
  qfrc_constraint: wp.array[wp.float64]
  xfrc_applied: wp.array[wp.float64]
  plugin_state: wp.array[wp.float64]


_STATE = f"""
  double* U = s.plugin_state.data;
  double* W = U + 3 * s.nvert;
  double* fc = U + 12 * s.nvert;
  double* slots = fc + 3 * s.nslot;
  double* poses = slots + s.nslot;
  double* tail = poses + {POSE} * s.geom_adr.data[s.nwindow];
  double* in = s.inbox.data;
  double* moved = in + {HEAD};
  double* pushed = moved + 7 * s.nslot;
  double* tools = pushed + 4 * s.nslot;
  const double* out = s.outbox.data;
  const double* motion = out + {SUMMARY} + 3 * s.nslot;
  const double* number = motion + 9 * s.nslot;
  double* quiet = tail + 1;
  double* bounds = tail + 5;
  double* times = tail + 11;
  double* leeway = tail + 12;
  auto node_of = [&](int k) -> int {{
    const double n = slots[k];
    return n == 0.0 ? s.home.data[k] : n >= 1.0 && n <= s.nvert ? (int)n - 1 : -1;
  }};
  auto parked = [&](int k, int c) -> double {{
    return s.qhome.data[3 * k + c] + {AWAY} * s.frame.data[6 + c];
  }};
  auto stand = [&](int k, int i, const double* u, const double* v) {{
    const int adr = s.dofadr.data[k], qadr = s.qposadr.data[k], body = s.bodyid.data[k];
    const double own = s.body_mass.data[body];
    const double total = s.inertia.data[i] > own ? s.inertia.data[i] : own;
    for (int c = 0; c < 3; ++c) {{
      s.qpos.data[qadr + c] = s.qhome.data[3 * k + c] + s.rest.data[3 * i + c] + u[c];
      s.qvel.data[adr + c] = v[c];
      s.dof_armature.data[adr + c] = total - own;
      s.dof_M0.data[adr + c] = total;
      s.dof_invweight0.data[adr + c] = 1.0 / s.node_mass.data[i];
    }}
    s.body_invweight0.data[2 * body] = 1.0 / s.node_mass.data[i];
  }};
"""

# The windows' triangles: those of the organ whose corners are in one window.
_TRIANGLES = f"""
  auto triangles = [&]() {{
    s.flags.data[{MISSED_ELEMENTS}] = 0;
    for (int w = 0; w < s.nwindow; ++w) {{
      const int first = s.window_adr.data[w], last = s.window_adr.data[w + 1];
      int* list = s.flex_elem.data + s.elem_adr.data[w];
      const int most = s.elem_num.data[w];
      int count = 0;
      for (int k = first; k < last; ++k) {{
        const int i = s.placed.data[k];
        if (i < 0) continue;
        for (int q = s.near_adr.data[i]; q < s.near_adr.data[i + 1]; ++q) {{
          const int* e = s.elem.data + 3 * s.near.data[q];
          if (e[0] != i) continue;
          const int b = s.taken.data[e[1]], c = s.taken.data[e[2]];
          if (b < first || b >= last || c < first || c >= last) continue;
          if (count == most) {{ s.flags.data[{MISSED_ELEMENTS}] += 1; continue; }}
          list[3 * count] = k - first;
          list[3 * count + 1] = b - first;
          list[3 * count + 2] = c - first;
          ++count;
        }}
      }}
      // Triangles to spare are points of the last slot, out of everybody's way: repeating one of
      // the others would multiply its contacts.
      const int spare = last - 1;
      for (int c = 0; c < 3; ++c) s.qpos.data[s.qposadr.data[spare] + c] = parked(spare, c);
      for (int q = 3 * count; q < 3 * most; ++q) list[q] = spare - first;
    }}
  }};
"""


@wp.func_native(
  _STATE
  + f"""
  const double h = s.timestep.data[0];
  in[0] = h;
  in[1] = h * h + h * s.number.data[3];
  const double still = s.rest_share * 9.81 * h;
  in[2] = s.weight * still * still;
  in[3] = s.flags.data[{PENDING}];
  in[9] = 0.0;
  const bool falls = !(s.disableflags.data[0] & s.no_gravity);
  bool changed = false;
  for (int c = 0; c < 3; ++c) {{
    double g = 0.0;
    for (int k = 0; k < 3 && falls; ++k) g += s.frame.data[3 * k + c] * s.gravity.data[k];
    in[4 + c] = g;
    changed = changed || g != tail[2 + c];
  }}
  in[7] = s.reach;
  int stale = 0;
  bool pushes = false;
  for (int k = 0; k < s.nslot; ++k) {{
    const int i = node_of(k), adr = s.dofadr.data[k], body = s.bodyid.data[k];
    const bool still = s.body_awake.data[body] == 0;  // MuJoCo skips it: its forces are old
    if (i != s.placed.data[k]) stale = 1;
    const double* x = s.xfrc_applied.data + 6 * body;
    double* push = pushed + 4 * k;
    push[0] = i;
    for (int c = 0; c < 3; ++c) {{
      // What acts on the slot besides its own weight acts on the node.
      const double f = s.qfrc_applied.data[adr + c] + (still ? 0.0 : s.qfrc_passive.data[adr + c])
        + s.frame.data[c] * x[0] + s.frame.data[3 + c] * x[1] + s.frame.data[6 + c] * x[2];
      s.other.data[3 * k + c] = f;
      push[1 + c] = i < 0 ? f : f + fc[3 * k + c];
      s.ext.data[3 * k + c] = push[1 + c] + s.body_mass.data[body] * in[4 + c];
      pushes = pushes || push[1 + c] != 0.0;
    }}
  }}
  for (int w = 0; w < s.nwindow; ++w) {{
    const int spare = s.window_adr.data[w + 1] - 1;
    for (int c = 0; c < 3; ++c) {{
      const double away = s.qpos.data[s.qposadr.data[spare] + c] - parked(spare, c);
      if (away > 1.0 || away < -1.0) stale = 1;
    }}
  }}
  s.flags.data[{STALE}] = stale;
  const double* then = s.foreseen.data;
  bool same = true;
  for (int c = 0; c < 7; ++c) same = same && (c == 3 || in[c] == then[c]);
  for (int k = 0; k < 4 * s.nslot; ++k) same = same && pushed[k] == then[pushed - in + k];
  s.flags.data[{FORESEEN}] = same;
  // The geoms in the organ's frame, whether one is near the organ's bounds, and whether one that is
  // has moved too far since the organ fell asleep.
  bool near = bounds[3] <= bounds[0], stirs = near;
  const double margin = 0.5 * s.reach;
  for (int w = 0; w < s.nwindow; ++w) {{
    double* list = tools + w * {1 + MAX_GEOMS * GEOM};
    int count = 0;
    for (int q = s.geom_adr.data[w]; q < s.geom_adr.data[w + 1] && count < {MAX_GEOMS}; ++q) {{
      const int g = s.geom.data[q];
      double* G = list + 1 + {GEOM} * count++;
      const double* R = s.geom_xmat.data + 9 * g;
      for (int c = 0; c < 3; ++c) {{
        G[c] = 0.0;
        for (int k = 0; k < 3; ++k)
          G[c] += s.frame.data[3 * k + c] * (s.geom_xpos.data[3 * g + k] - s.origin.data[k]);
        for (int a = 0; a < 3; ++a) {{
          double e = 0.0;
          for (int k = 0; k < 3; ++k) e += s.frame.data[3 * k + c] * R[3 * k + a];
          G[3 + 3 * a + c] = e;
        }}
        G[13 + c] = s.geom_size.data[3 * g + c];
      }}
      G[12] = s.geom_type.data[g];
      for (int c = 0; c < 6; ++c) G[16 + c] = s.geom_aabb.data[6 * g + c];
      const double r = s.geom_rbound.data[g] + s.reach;
      G[22] = r * r;
      // Boxes apart along an axis of one of them are apart.
      bool apart = false;
      double middle[3];
      for (int c = 0; c < 3; ++c)
        middle[c] = G[c] + G[3 + c] * G[16] + G[6 + c] * G[17] + G[9 + c] * G[18];
      for (int c = 0; c < 3; ++c) {{
        double half = margin;
        for (int a = 0; a < 3; ++a) half += G[19 + a] * (G[3 + 3 * a + c] < 0.0 ? -G[3 + 3 * a + c]
          : G[3 + 3 * a + c]);
        apart = apart || middle[c] + half < bounds[c] || middle[c] - half > bounds[3 + c];
        double at = 0.0, reach = margin + G[19 + c];
        for (int k = 0; k < 3; ++k) {{
          const double e = G[3 + 3 * c + k];
          at += e * (middle[k] - 0.5 * (bounds[k] + bounds[3 + k]));
          reach += 0.5 * (bounds[3 + k] - bounds[k]) * (e < 0.0 ? -e : e);
        }}
        apart = apart || at > reach || at < -reach;
      }}
      if (apart) continue;
      near = true;
      double gone = 0.0, turned = 0.0, centre = 0.0, half = 0.0;
      for (int c = 0; c < {POSE}; ++c) {{
        const double e = G[c] - poses[{POSE} * q + c];
        (c < 3 ? gone : turned) += e * e;
      }}
      for (int c = 0; c < 3; ++c) {{
        centre += G[16 + c] * G[16 + c];
        half += G[19 + c] * G[19 + c];
      }}
      gone = sqrt(gone) + sqrt(turned) * (sqrt(centre) + sqrt(half));
      stirs = stirs || !(gone < leeway[0]);
    }}
    list[0] = count;
  }}
  s.flags.data[{NEAR}] = near;
  const bool asleep = quiet[0] >= {QUIET} && !stirs && !pushes && !changed;
  s.flags.data[{ASLEEP}] = asleep;
  if (!asleep || stale) return;
  // The slots stay where they are; nothing else is done in such a step.
  s.status.data[0] = s.status.data[1] = 0.0f;
  for (int k = 0; k < s.nslot; ++k)
    for (int c = 0; c < 3; ++c)
      if (s.ext.data[3 * k + c] == s.ext.data[3 * k + c] && s.body_awake.data[s.bodyid.data[k]])
        s.qfrc_passive.data[s.dofadr.data[k] + c] -= s.ext.data[3 * k + c];
"""
)
def _gather(s: Slots): ...


@wp.func_native(
  _STATE
  + HEAVIER
  + f"""
  const double ok = out[3] == 0.0 ? 1.0 : 0.0;
  s.flags.data[{PENDING}] = 0;
  for (int k = 0; k < s.nslot; ++k) {{
    const int adr = s.dofadr.data[k];
    const double gain = times[0] > 1.0 && touched(fc + 3 * k) ? times[0] : 1.0;
    for (int c = 0; c < 3; ++c) {{
      const int diagonal = s.massadr.data[3 * k + c];
      const double inertia = gain * (s.body_mass.data[s.bodyid.data[k]] + s.dof_armature.data[adr]);
      if (gain > 1.0) {{
        s.M.data[diagonal] = s.qLD.data[diagonal] = inertia;
        s.qLDiagInv.data[adr + c] = 1.0 / inertia;
      }}
      const double dv = ok != 0.0 ? out[{SUMMARY} + 3 * k + c] : 0.0;
      const double f = inertia * dv / in[0] - s.ext.data[3 * k + c];
      if (f == f) s.qfrc_passive.data[adr + c] += f;
    }}
  }}
"""
)
def _scatter(s: Slots): ...


# How far the tools are from the surface at least, of what the last search found: triangles with a
# corner that it did not are beyond its reach. Distance to convex geoms has slope 1.
_CLEARANCE = f"""
  auto geom_at = [&](int w, int q) -> const double* {{
    return tools + w * {1 + MAX_GEOMS * GEOM} + 1 + {GEOM} * q;
  }};
  auto away = [&](int w, const double* p) -> double {{
    double best = 1e300;
    for (int q = 0; q < (int)tools[w * {1 + MAX_GEOMS * GEOM}]; ++q) {{
      const double* G = geom_at(w, q);
      const double dx = p[0] - G[0], dy = p[1] - G[1], dz = p[2] - G[2];
      {DISTANCE}
      best = dist < best ? dist : best;
    }}
    return best;
  }};
  auto nearest = [&](int w, const double* const* corner, double enough) -> double {{
    double x[3][3], lowest = 1e300, longest = 0.0;
    for (int k = 0; k < 3; ++k) {{
      const int i = (int)corner[k][0];
      for (int c = 0; c < 3; ++c) x[k][c] = s.rest.data[3 * i + c] + corner[k][2 + c];
      lowest = corner[k][1] < lowest ? corner[k][1] : lowest;
    }}
    for (int k = 0; k < 3; ++k) {{
      const double* to = x[(k + 1) % 3];
      double edge = 0.0;
      for (int c = 0; c < 3; ++c) edge += (x[k][c] - to[c]) * (x[k][c] - to[c]);
      longest = edge > longest * longest ? sqrt(edge) : longest;
    }}
    if (lowest - {_CORNER} * longest >= enough) return enough;
    for (int a = 0; a <= {_FINE}; ++a) {{
      for (int b = 0; a + b <= {_FINE}; ++b) {{
        double p[3];
        for (int c = 0; c < 3; ++c)
          p[c] = x[0][c] + (a * (x[1][c] - x[0][c]) + b * (x[2][c] - x[0][c])) / {_FINE};
        const double at = away(w, p);
        lowest = at < lowest ? at : lowest;
      }}
    }}
    return lowest - {_CORNER} * longest / {_FINE};
  }};
  auto clearance = [&]() -> double {{
    double least = in[7] - s.longest;
    for (int w = 0; w < s.nwindow; ++w) {{
      const double* record = number + s.nwindow + (size_t){RECORD} * w * s.most;
      const int count = number[w] < s.most ? (int)number[w] : s.most;
      for (int q = 0; q < count; ++q) s.claim.data[(int)record[{RECORD} * q]] = q;
      for (int q = 0; q < count; ++q) {{
        const int i = (int)record[{RECORD} * q];
        for (int t = s.near_adr.data[i]; t < s.near_adr.data[i + 1]; ++t) {{
          const int* e = s.elem.data + 3 * s.near.data[t];
          const int b = s.claim.data[e[1]], c = s.claim.data[e[2]];
          if (e[0] != i || b < 0 || c < 0) continue;
          const double* corner[3] = {{record + {RECORD} * q, record + {RECORD} * b,
            record + {RECORD} * c}};
          const double at = nearest(w, corner, least);
          least = at < least ? at : least;
        }}
      }}
      for (int q = 0; q < count; ++q) s.claim.data[(int)record[{RECORD} * q]] = -1;
    }}
    return least - s.skin;
  }};
"""


@wp.func_native(
  _STATE
  + _CLEARANCE
  + f"""
  in[3] = in[9] = 0.0;
  s.flags.data[{CHANGED}] = 0;
  if (s.flags.data[{ASLEEP}]) {{
    // Contacts of a window that was left behind wake the organ.
    for (int k = 0; k < s.nslot; ++k)
      for (int c = 0; c < 3 && s.placed.data[k] >= 0; ++c)
        fc[3 * k + c] = s.qfrc_constraint.data[s.dofadr.data[k] + c];
    return;
  }}
  for (int c = 0; c < 6; ++c) bounds[c] = out[5 + c];
  bool touched = false;
  bool calm = quiet[0] < {QUIET} && out[4] < s.slow * s.slow;
  for (int k = 0; k < s.nslot; ++k) {{
    const int i = s.placed.data[k], adr = s.dofadr.data[k], qadr = s.qposadr.data[k];
    double* move = moved + 7 * k;
    move[0] = i;
    for (int c = 0; c < 3; ++c) {{
      const double before = fc[3 * k + c], f = i < 0 ? 0.0 : s.qfrc_constraint.data[adr + c];
      touched = touched || f != 0.0;
      calm = calm && f == 0.0 && pushed[4 * k + 1 + c] == 0.0;
      fc[3 * k + c] = f;
      pushed[4 * k + 1 + c] = in[0] * (f - before);
      if (f != before) s.flags.data[{CHANGED}] = 1;
      if (i < 0) continue;
      move[1 + c] = s.qpos.data[qadr + c] - s.qhome.data[3 * k + c] - s.rest.data[3 * i + c];
      move[4 + c] = s.qvel.data[adr + c];
    }}
  }}
  if (!touched) times[0] = 1.0;
  quiet[0] = calm ? quiet[0] + in[0] : 0.0;
  int mode = 1;
  leeway[0] = 0.0;
  if (quiet[0] >= {QUIET} && s.flags.data[{NEAR}]) {{
    leeway[0] = 0.5 * clearance();
    if (!(leeway[0] > 0.0)) quiet[0] = 0.0;
  }}
  if (quiet[0] >= {QUIET}) {{
    mode = 2;
    for (int w = 0; w < s.nwindow; ++w)
      for (int q = s.geom_adr.data[w]; q < s.geom_adr.data[w + 1]; ++q)
        for (int c = 0; c < {POSE}; ++c)
          poses[{POSE} * q + c] = geom_at(w, q - s.geom_adr.data[w])[c];
    for (int c = 0; c < 3; ++c) tail[2 + c] = in[4 + c];
    for (int k = 0; k < s.nslot; ++k)
      for (int c = 0; c < 3; ++c) moved[7 * k + 4 + c] = 0.0;
  }}
  in[3] = mode;
  in[8] = in[0];
  s.flags.data[{PENDING}] = s.resident ? mode : 0;
"""
)
def _leave(s: Slots): ...


# Picks each window's nodes by the distance to its geoms. Windows whose tools touch the same nodes
# pick as one, the first of them first: a triangle between two windows would touch nothing.
@wp.func_native(
  _STATE
  + _TRIANGLES
  + HEAVIER
  + f"""
  if (s.flags.data[{ASLEEP}]) return;
  s.flags.data[{MISSED_NODES}] = 0;
  bool renewed = false;
  const bool answered = s.flags.data[{ANSWERED}];
  auto moved_to = [&](int k) {{ return answered ? motion + 9 * k : moved + 7 * k + 1; }};
  if (answered) {{
    double acted = 0.0, meant = 0.0, gross = 0.0, whole = 0.0, sum[3] = {{0.0, 0.0, 0.0}};
    for (int k = 0; k < s.nslot; ++k) {{
      double p2 = 0.0, f2 = 0.0;
      for (int c = 0; c < 3 && s.placed.data[k] >= 0; ++c) {{
        const double p = pushed[4 * k + 1 + c], f = fc[3 * k + c];
        acted += p * motion[9 * k + 6 + c];
        sum[c] += p;
        p2 += p * p;
        f2 += f * f;
      }}
      meant += p2 / s.M.data[s.massadr.data[3 * k]];
      gross += sqrt(p2);
      whole += in[0] * sqrt(f2);
    }}
    times[0] = heavier(times[0] > 1.0 ? times[0] : 1.0, acted, meant, sum, gross, whole,
      s.heaviest.data[0]);
  }}
  for (int k = 0; k < s.nslot; ++k) {{
    s.left.data[k] = -1;
    for (int c = 0; c < 3; ++c) s.lagged.data[3 * k + c] = fc[3 * k + c];
    if (s.placed.data[k] >= 0) stand(k, s.placed.data[k], moved_to(k), moved_to(k) + 3);
    else for (int c = 0; c < 3; ++c) s.qvel.data[s.dofadr.data[k] + c] = 0.0;
  }}
  const double* record = number + s.nwindow;
  auto node_at = [&](int q) -> int {{ return (int)record[(size_t){RECORD} * q]; }};
  auto far_at = [&](int q) -> double {{ return record[(size_t){RECORD} * q + 1]; }};
  auto found = [&](int w) -> int {{ return number[w] < s.most ? (int)number[w] : s.most; }};
  auto give_up = [&](int k) {{
    s.left.data[k] = s.placed.data[k];
    slots[k] = -1.0;
    s.placed.data[k] = -1;
    for (int c = 0; c < 3; ++c) fc[3 * k + c] = s.qvel.data[s.dofadr.data[k] + c] = 0.0;
    renewed = true;
  }};
  int group[{MAX_WINDOWS}];
  for (int w = 0; w < s.nwindow; ++w) {{
    group[w] = w;
    for (int q = w * s.most; q < w * s.most + found(w); ++q) {{
      const int i = node_at(q), other = s.claim.data[i];
      if (other < 0 || far_at(q) < far_at(other)) s.claim.data[i] = q;
      if (other < 0 || far_at(q) >= s.touch.data[i] || far_at(other) >= s.touch.data[i]) continue;
      const int a = group[other / s.most], b = group[w], joint = a < b ? a : b;
      for (int v = 0; v <= w; ++v) if (group[v] == a || group[v] == b) group[v] = joint;
    }}
  }}
  for (int w = 0; w < s.nwindow; ++w) {{
    // The last slot stays free, see `triangles`. A patch of n nodes has up to 2 n - 4 triangles.
    const int first = s.window_adr.data[w], room = s.elem_num.data[w] / 2 + 2;
    int many = s.window_adr.data[w + 1] - first - 1;
    if (many > room) many = room;
    int count = 0;
    for (int v = 0; v < s.nwindow; ++v) {{
      for (int q = v * s.most; group[v] == group[w] && q < v * s.most + found(v); ++q) {{
        if (s.claim.data[node_at(q)] != q) continue;
        s.candidate.data[count] = q;
        s.distance.data[count++] = far_at(q);
      }}
    }}
    if (count < 3) continue;
    // The `many` nearest, by quickselect; vertex numbers decide between equals.
    double* far = s.distance.data;
    int* which = s.candidate.data;
    auto before = [&](double d, int p, double e, int q) -> bool {{
      return d < e || (d == e && node_at(p) < node_at(q));
    }};
    if (count > many) {{
      int a = 0, b = count - 1;
      while (a < b) {{
        const double pivot = far[(a + b) / 2];
        const int middle = which[(a + b) / 2];
        int i = a, j = b;
        while (i <= j) {{
          while (before(far[i], which[i], pivot, middle)) ++i;
          while (before(pivot, middle, far[j], which[j])) --j;
          if (i <= j) {{
            const double t = far[i]; far[i] = far[j]; far[j] = t;
            const int n = which[i]; which[i] = which[j]; which[j] = n;
            ++i; --j;
          }}
        }}
        if (many - 1 <= j) b = j;
        else if (many - 1 >= i) a = i;
        else break;
      }}
      for (int q = many; q < count; ++q)
        s.flags.data[{MISSED_NODES}] += far[q] < s.touch.data[node_at(which[q])];
      count = many;
    }}
    // Nodes that stay keep their slot; the others fill the free ones in the order of the mesh.
    for (int q = 0; q < count; ++q) {{
      s.chosen.data[node_at(which[q])] = 1;
      s.claim.data[node_at(which[q])] = -1;
    }}
    for (int k = first; k < first + many; ++k) {{
      const int i = s.placed.data[k];
      if (i >= 0 && s.chosen.data[i]) {{
        s.chosen.data[i] = 0;
        slots[k] = i + 1.0;
      }} else if (i >= 0) {{
        give_up(k);
      }} else {{
        slots[k] = -1.0;
      }}
    }}
    int fresh = 0;
    for (int q = 0; q < count; ++q) {{
      const int r = which[q];
      if (!s.chosen.data[node_at(r)]) continue;
      s.chosen.data[node_at(r)] = 0;
      int p = fresh++;
      for (; p > 0 && node_at(which[p - 1]) > node_at(r); --p) which[p] = which[p - 1];
      which[p] = r;
    }}
    int k = first;
    for (int q = 0; q < fresh; ++q) {{
      const double* r = record + (size_t){RECORD} * which[q];
      while (slots[k] >= 0.0) ++k;
      const int i = (int)r[0], other = s.taken.data[i];
      const double* at = s.resident ? r + 2 : U + 3 * i;
      const double* speed = s.resident ? r + 5 : W + 3 * i;
      if (other >= 0) {{
        // Another window had it: its motion and contact force come along.
        if (s.placed.data[other] == i) give_up(other);
        at = moved_to(other);
        speed = at + 3;
        for (int c = 0; c < 3; ++c) fc[3 * k + c] = s.lagged.data[3 * other + c];
      }}
      slots[k] = i + 1.0;
      s.placed.data[k] = i;
      s.taken.data[i] = k;
      stand(k, i, at, speed);
      renewed = true;
    }}
  }}
  for (int q, w = 0; w < s.nwindow; ++w)
    for (q = w * s.most; q < w * s.most + found(w); ++q) s.claim.data[node_at(q)] = -1;
  for (int k = 0; k < s.nslot; ++k) {{
    const int i = s.left.data[k];
    if (i >= 0 && s.taken.data[i] == k && s.placed.data[k] != i) s.taken.data[i] = -1;
  }}
  if (renewed) triangles();
"""
)
def _choose(s: Slots): ...


@wp.func_native(
  _STATE
  + _TRIANGLES
  + """
  for (int i = 0; i < s.nvert; ++i) s.taken.data[i] = -1;
  for (int k = 0; k < s.nslot; ++k) {
    const int i = node_of(k);
    s.placed.data[k] = i;
    if (i < 0) {
      for (int c = 0; c < 3; ++c) s.qvel.data[s.dofadr.data[k] + c] = 0.0;
      continue;
    }
    s.taken.data[i] = k;
    stand(k, i, U + 3 * i, W + 3 * i);
  }
  triangles();
"""
)
def _place(s: Slots): ...


@wp.func_native(
  _STATE
  + f"""
  double* then = s.foreseen.data;
  for (int c = 0; c < {HEAD} + 7 * s.nslot; ++c) then[c] = in[c];
  then[3] = s.flags.data[{PENDING}];
  then[9] = 0.0;
  for (int k = 0; k < s.nslot; ++k) {{
    double* push = then + {HEAD} + 7 * s.nslot + 4 * k;
    const int i = node_of(k);
    push[0] = i;
    for (int c = 0; c < 3; ++c)
      push[1 + c] = i < 0 ? s.other.data[3 * k + c] : s.other.data[3 * k + c] + fc[3 * k + c];
  }}
"""
)
def _foresee(s: Slots): ...


@wp.kernel(enable_backward=False)
def gather(slots: Slots):
  """Reads what acts on the slots and where the tools are; flags slots that the model lacks.

  Asleep it does what `scatter` does otherwise.
  """
  _gather(slots)


@wp.kernel(enable_backward=False)
def scatter(slots: Slots):
  """Adds the passive force that carries v + dv to the windows' dofs."""
  _scatter(slots)


@wp.kernel(enable_backward=False)
def leave(slots: Slots):
  """Takes the motion of the slots' nodes and their contact force, and says if all is at rest."""
  _leave(slots)


@wp.kernel(enable_backward=False)
def choose(slots: Slots):
  """Gives each window the nodes nearest to its geoms."""
  _choose(slots)


@wp.kernel(enable_backward=False)
def foresee(slots: Slots):
  """Writes what `gather` will if the step and what acts on the slots besides contacts stay."""
  _foresee(slots)


@wp.kernel(enable_backward=False)
def place(slots: Slots):
  """Puts the windows' bodies on the nodes of their slots and rewrites their triangles."""
  _place(slots)
