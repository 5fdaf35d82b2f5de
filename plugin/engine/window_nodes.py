"""Kernels of window coupling over all nodes of an organ, on the device that holds its motion.

What crosses to them is one array, the inbox (numbers of the step, the slots, the tools), and what
comes back is another, the outbox (the slots' dv, what is near the tools, how fast the organ moves).
"""

from __future__ import annotations

from typing import Any

import warp as wp

struct: Any = wp.struct  # type checkers take what wp.struct makes for a value
MAX_WINDOWS = 64  # of an organ
MAX_GEOMS = 32  # of a window
HEAD = 10  # h, its square with damping, floor, mode, gravity (3), reach, h to commit, 1: answered
GEOM = 24  # centre, axes, type, size, bounding box, squared reach of the bounding sphere
SUMMARY = 11  # status (4), squared speed, bounds: lowest and highest corner
RECORD = 8  # vertex, distance, displacement, velocity
LOWEST = -(2**31)
STILL, COMMIT, HALT = 0, 1, 2  # mode: nothing to commit, the last step, it and standing still


@struct
class Nodes:
  """A windowed organ's nodes; doubles in the order of the vertices, in the organ's frame.

  Attributes:
    nvert, nslot, nwindow: counts
    most: candidates of a window that the outbox has room for
    node: where a vertex starts in vectors of slices     (nvert,)
    mass: mass [kg]                                      (nvert,)
    rest: rest position [m]                              (3 nvert,)
    disp, velocity: displacement [m], velocity [m/s]     (3 nvert,) each
    last, before: last change of the velocity, the one before it [m/s]  (3 nvert,) each
    inbox: HEAD numbers, node, displacement and velocity of each slot after the last step, node and
      force of each slot now (after MuJoCo's step the impulse to answer), and the geoms of each
      window: their number and GEOM numbers each
    outbox: SUMMARY numbers, dv of each slot, its displacement, velocity and answer where there was
      one, number of candidates of each window, RECORDs
    count: candidates of each window; 0 between steps    (nwindow,)
    extent: squared speed and bounds as ordered ints; the lowest one between steps  (7,)
    step, pos, vel, force_ext, dvel_warm, dvel, rhs, x, status: see `State`, for one world
  """

  nvert: int
  nslot: int
  nwindow: int
  most: int
  node: wp.array[int]
  mass: wp.array[wp.float64]
  rest: wp.array[wp.float64]
  disp: wp.array[wp.float64]
  velocity: wp.array[wp.float64]
  last: wp.array[wp.float64]
  before: wp.array[wp.float64]
  inbox: wp.array[wp.float64]
  outbox: wp.array[wp.float64]
  count: wp.array[int]
  extent: wp.array[int]
  step: wp.array2d[float]
  pos: wp.array4d[float]
  vel: wp.array4d[float]
  force_ext: wp.array4d[float]
  dvel_warm: wp.array4d[float]
  dvel: wp.array4d[float]
  rhs: wp.array4d[float]
  x: wp.array4d[float]
  status: wp.array2d[float]


def inbox_size(nslot: int, nwindow: int) -> int:
  """Returns the length of the inbox."""
  return HEAD + 11 * nslot + nwindow * (1 + MAX_GEOMS * GEOM)


def outbox_size(nslot: int, nwindow: int, most: int) -> int:
  """Returns the length of the outbox."""
  return SUMMARY + 12 * nslot + nwindow * (1 + most * RECORD)


_BOXES = f"""
#if defined(__CUDA_ARCH__) || defined(__CUDACC_RTC__)
  #define ON_CUDA 1
#else
  #define ON_CUDA 0
#endif
  const double* in = n.inbox.data;
  const double* moved = in + {HEAD};
  const double* pushed = moved + 7 * n.nslot;
  const double* tools = pushed + 4 * n.nslot;
  double* out = n.outbox.data;
  double* motion = out + {SUMMARY} + 3 * n.nslot;
  double* number = motion + 9 * n.nslot;
  const bool answered = in[9] != 0.0;
"""


@wp.func_native(
  _BOXES
  + """
  const int mode = (int)in[3];
  if (mode == 0) return;
  const double h = in[8], ok = n.status.data[3] == 0.0f ? 1.0 : 0.0;
  const double keep = mode == 1 ? 1.0 : 0.0;
  for (int i = tid; i < n.nvert; i += nthread) {
    const float* dv_ = n.dvel.data + n.node.data[i];
    const float* answer = n.x.data + n.node.data[i];
    for (int c = 0; c < 3; ++c) {
      const int j = 3 * i + c;
      const double whole = (double)dv_[8 * c] + (answered ? (double)answer[8 * c] : 0.0);
      const double dv = ok * whole, v = n.velocity.data[j] + dv;
      n.disp.data[j] += h * v;
      n.velocity.data[j] = keep * v;
      n.before.data[j] = keep * n.last.data[j];
      n.last.data[j] = keep * dv;
    }
  }
"""
)
def _commit(tid: int, nthread: int, n: Nodes): ...


@wp.func_native(
  _BOXES
  + """
  if ((int)in[3] == 0 || answered) return;
  for (int k = tid; k < n.nslot; k += nthread) {
    const int i = (int)moved[7 * k];
    for (int c = 0; c < 3 && i >= 0; ++c) {
      n.disp.data[3 * i + c] = moved[7 * k + 1 + c];
      n.velocity.data[3 * i + c] = moved[7 * k + 4 + c];
    }
  }
"""
)
def _move_slots(tid: int, nthread: int, n: Nodes): ...


@wp.func_native(
  _BOXES
  + """
  if (tid == 0) for (int k = 0; k < 3; ++k) n.step.data[k] = (float)in[k];
  float low[3] = {1e30f, 1e30f, 1e30f}, high[3] = {-1e30f, -1e30f, -1e30f}, fastest = 0.0f;
  for (int i = tid; i < n.nvert; i += nthread) {
    const int at = n.node.data[i];
    const double m = n.mass.data[i];
    float speed = 0.0f;
    for (int c = 0; c < 3; ++c) {
      const int j = 3 * i + c;
      const float u = (float)n.disp.data[j], v = (float)n.velocity.data[j];
      const float x = (float)n.rest.data[j] + u;
      n.pos.data[at + 8 * c] = u;
      n.vel.data[at + 8 * c] = v;
      n.dvel_warm.data[at + 8 * c] = (float)(2.0 * n.last.data[j] - n.before.data[j]);
      n.force_ext.data[at + 8 * c] = (float)(m * in[4 + c]);
      speed += v * v;
      low[c] = x < low[c] ? x : low[c];
      high[c] = x > high[c] ? x : high[c];
    }
    fastest = speed > fastest ? speed : fastest;
  }
#if ON_CUDA
  // As ints that are ordered alike: the greatest one does not depend on who comes first.
  float all[7] = {fastest, -low[0], -low[1], -low[2], high[0], high[1], high[2]};
  for (int k = 0; k < 7; ++k) {
    for (int o = 16; o > 0; o >>= 1) {
      const float other = __shfl_xor_sync(0xffffffffu, all[k], o);
      all[k] = other > all[k] ? other : all[k];
    }
    int bits = __float_as_int(all[k]);
    bits ^= (bits >> 31) & 0x7fffffff;
    if ((threadIdx.x & 31) == 0) atomicMax(n.extent.data + k, bits);
  }
#else
  out[4] = (double)fastest;
  for (int c = 0; c < 3; ++c) { out[5 + c] = (double)low[c]; out[8 + c] = (double)high[c]; }
#endif
"""
)
def _enter(tid: int, nthread: int, n: Nodes): ...


@wp.func_native(
  _BOXES
  + """
  for (int k = tid; k < n.nslot; k += nthread) {
    const int i = (int)pushed[4 * k];
    if (i < 0) continue;
    float* f = n.force_ext.data + n.node.data[i];
    for (int c = 0; c < 3; ++c) f[8 * c] += (float)pushed[4 * k + 1 + c];
  }
"""
)
def _push_slots(tid: int, nthread: int, n: Nodes): ...


@wp.func_native(
  _BOXES
  + """
  for (int k = tid; k < n.nslot; k += nthread) {
    const int i = (int)pushed[4 * k];
    if (i < 0) continue;
    float* impulse = n.rhs.data + n.node.data[i];
    for (int c = 0; c < 3; ++c) impulse[8 * c] = (float)pushed[4 * k + 1 + c];
  }
"""
)
def _push_impulses(tid: int, nthread: int, n: Nodes): ...


# Distance of the point d from a geom's centre to the geom; G: centre, axes, type, size, box.
DISTANCE = """
  double l[3];
  for (int c = 0; c < 3; ++c) l[c] = G[3 + c] * dx + G[6 + c] * dy + G[9 + c] * dz;
  const double* s = G + 13;
  const int type = (int)G[12];
  double dist;
  if (type == 2) {
    dist = sqrt(l[0] * l[0] + l[1] * l[1] + l[2] * l[2]) - s[0];
  } else if (type == 3) {
    const double t = l[2] < -s[1] ? l[2] + s[1] : l[2] > s[1] ? l[2] - s[1] : 0.0;
    dist = sqrt(l[0] * l[0] + l[1] * l[1] + t * t) - s[0];
  } else if (type == 4) {
    const double a = l[0] / s[0], b = l[1] / s[1], c = l[2] / s[2];
    const double r = sqrt(a * a + b * b + c * c);
    const double e = sqrt(a * a / (s[0] * s[0]) + b * b / (s[1] * s[1]) + c * c / (s[2] * s[2]));
    dist = e > 1e-12 ? r * (r - 1.0) / e : -s[0];
  } else if (type == 5) {
    const double r = sqrt(l[0] * l[0] + l[1] * l[1]) - s[0];
    const double t = (l[2] < 0.0 ? -l[2] : l[2]) - s[1];
    const double rp = r > 0.0 ? r : 0.0, tp = t > 0.0 ? t : 0.0;
    dist = sqrt(rp * rp + tp * tp) + (r > t ? (r < 0.0 ? r : 0.0) : (t < 0.0 ? t : 0.0));
  } else {
    // Boxes, and the bounding box of a mesh.
    const double* box = G + 16;
    double beyond = 0.0, within = -1e300;
    for (int c = 0; c < 3; ++c) {
      const double at = l[c] - box[c];
      const double e = (at < 0.0 ? -at : at) - box[3 + c];
      if (e > 0.0) beyond += e * e;
      within = e > within ? e : within;
    }
    dist = beyond > 0.0 ? sqrt(beyond) : within;
  }
"""


@wp.func_native(
  _BOXES
  + f"""
  // Before the step has ended: where it will, without what contacts change.
  const double reach = in[7], ok = n.status.data[3] == 0.0f && !answered ? 1.0 : 0.0;
  const double h = answered ? 0.0 : in[0];
  const double* bounds = out + 5;
  for (int w = 0; w < n.nwindow; ++w) {{
    const double* list = tools + w * {1 + MAX_GEOMS * GEOM};
    const int ngeom = (int)list[0];
    double* record = number + n.nwindow + (size_t)w * n.most * {RECORD};
    int count = 0;
#if !ON_CUDA
    bool any = false;
    for (int q = 0; q < ngeom; ++q) {{
      const double* G = list + 1 + {GEOM} * q;
      double away = 0.0;
      for (int c = 0; c < 3; ++c) {{
        const double low = bounds[c] - reach - G[c], high = G[c] - bounds[3 + c] - reach;
        const double e = low > high ? low : high;
        away += e > 0.0 ? e * e : 0.0;
      }}
      any = any || away <= G[22];
    }}
    n.count.data[w] = 0;
    if (!any) continue;
#endif
    for (int i = tid; i < n.nvert && ngeom > 0; i += nthread) {{
      const float* dv_ = n.dvel.data + n.node.data[i];
      double x[3], u[3], v[3];
      for (int c = 0; c < 3; ++c) {{
        const int j = 3 * i + c;
        v[c] = n.velocity.data[j] + ok * (double)dv_[8 * c];
        u[c] = n.disp.data[j] + h * v[c];
        x[c] = n.rest.data[j] + u[c];
      }}
      double best = 1e300;
      for (int q = 0; q < ngeom; ++q) {{
        const double* G = list + 1 + {GEOM} * q;
        const double dx = x[0] - G[0], dy = x[1] - G[1], dz = x[2] - G[2];
        if (dx * dx + dy * dy + dz * dz > G[22]) continue;
        {DISTANCE}
        best = dist < best ? dist : best;
      }}
      if (best > reach) continue;
#if ON_CUDA
      const int at = atomicAdd(n.count.data + w, 1);
#else
      const int at = count++;
#endif
      if (at >= n.most) continue;
      double* r = record + {RECORD} * at;
      r[0] = i;
      r[1] = best;
      for (int c = 0; c < 3; ++c) {{ r[2 + c] = u[c]; r[5 + c] = v[c]; }}
    }}
#if !ON_CUDA
    n.count.data[w] = count;
#endif
  }}
"""
)
def _search(tid: int, nthread: int, n: Nodes): ...


@wp.func_native(
  _BOXES
  + f"""
  for (int k = tid; k < n.nslot; k += nthread) {{
    const int i = (int)pushed[4 * k];
    for (int c = 0; c < 3; ++c)
      out[{SUMMARY} + 3 * k + c] = i < 0 ? 0.0 : (double)n.dvel.data[n.node.data[i] + 8 * c];
    for (int c = 0; c < 3 && i >= 0 && answered; ++c) {{
      motion[9 * k + c] = n.disp.data[3 * i + c];
      motion[9 * k + 3 + c] = n.velocity.data[3 * i + c];
      motion[9 * k + 6 + c] = (double)n.x.data[n.node.data[i] + 8 * c];
    }}
  }}
  if (tid > 0) return;
  for (int k = 0; k < 4; ++k) out[k] = (double)n.status.data[k];
  for (int w = 0; w < n.nwindow; ++w) {{
    number[w] = n.count.data[w];
    n.count.data[w] = 0;
  }}
#if ON_CUDA
  for (int k = 0; k < 7; ++k) {{
    int bits = n.extent.data[k];
    if (bits == {LOWEST}) continue;  // the search is repeated
    n.extent.data[k] = {LOWEST};
    bits ^= (bits >> 31) & 0x7fffffff;
    const double value = (double)__int_as_float(bits);
    out[4 + k] = k > 0 && k < 4 ? -value : value;
  }}
#endif
"""
)
def _report(tid: int, nthread: int, n: Nodes): ...


@wp.kernel(enable_backward=False)
def commit(nthread: int, nodes: Nodes):
  """Ends the last step: disp, velocity, last, before."""
  _commit(wp.tid(), nthread, nodes)


@wp.kernel(enable_backward=False)
def move_slots(nthread: int, nodes: Nodes):
  """Gives the nodes of the slots what contacts made of them in the last step."""
  _move_slots(wp.tid(), nthread, nodes)


@wp.kernel(enable_backward=False)
def enter(nthread: int, nodes: Nodes):
  """Fills the solver's input from the motion, without forces on slots."""
  _enter(wp.tid(), nthread, nodes)


@wp.kernel(enable_backward=False)
def push_slots(nthread: int, nodes: Nodes):
  """Adds the forces on the slots to the solver's input."""
  _push_slots(wp.tid(), nthread, nodes)


@wp.kernel(enable_backward=False)
def push_impulses(nthread: int, nodes: Nodes):
  """Writes the impulses on the slots to the solver's right-hand side, which is zero."""
  _push_impulses(wp.tid(), nthread, nodes)


@wp.kernel(enable_backward=False)
def search(nthread: int, nodes: Nodes):
  """Lists the nodes that will be near each window's geoms, by their distance to the surface."""
  _search(wp.tid(), nthread, nodes)


@wp.kernel(enable_backward=False)
def report(nthread: int, nodes: Nodes):
  """Writes status, dv of the slots and the number of candidates to the outbox."""
  _report(wp.tid(), nthread, nodes)


def launch(kernel, nodes: Nodes, count: int, device):
  """Launches a kernel over `count` items: one thread each on CUDA, one for all on the CPU."""
  nthread = -(-count // 128) * 128 if wp.get_device(device).is_cuda else 1
  wp.launch(kernel, dim=nthread, block_dim=128, inputs=[nthread, nodes], device=device)
