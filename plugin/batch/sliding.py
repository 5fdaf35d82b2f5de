"""Contacts that slide stay closed, as `keep_closed` of native/weights.h has it on the CPU.

That widens the gap of a contact by D mu |v| over its stiffness, D the damping of its rows. A gap is
in the normal's reference acceleration as stiffness times gap, and a row of friction has -D v there:
so what the gap adds follows from those rows.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
import warp as wp
from mujoco_warp._src.types import vec5


@wp.kernel(enable_backward=False)
def keep_closed(
  start: wp.array[int],
  many: int,
  paired: bool,
  dim: wp.array[int],
  friction: wp.array[vec5],
  address: wp.array2d[int],
  aref: wp.array2d[float],
):
  """Takes the parting of an organ's sliding contacts off their reference accelerations.

  Args:
    start: the organ's first contact
    many: its contacts in a world
    paired: whether the cone is a pyramid
    dim: rows of a contact, or pairs of them and one
    friction: its friction
    address: its rows, -1 for none
    aref: reference acceleration of the rows [m/s^2]
  """
  world, k = wp.tid()
  c = start[0] + world * many + k
  n = dim[c]
  if n < 2 or address[c, 0] < 0:
    return
  rows = wp.where(paired, 2 * (n - 1), n)
  for r in range(rows):
    if address[c, r] < 0:  # there was no room
      return
  square = float(0.0)  # noqa: UP018 - a variable to Warp
  for r in range(n - 1):
    if paired:
      v = 0.5 * (aref[world, address[c, 2 * r]] - aref[world, address[c, 2 * r + 1]])
      square += v * v
    else:
      v = friction[c][r] * aref[world, address[c, r + 1]]
      square += v * v
  for r in range(wp.where(paired, rows, 1)):
    row = address[c, r]
    aref[world, row] = aref[world, row] - wp.sqrt(square)


@wp.kernel(enable_backward=False)
def press(
  start: wp.array[int],
  many: int,
  paired: bool,
  dim: wp.array[int],
  geom: wp.array[wp.vec2i],
  frame: wp.array[wp.mat33],
  address: wp.array2d[int],
  force: wp.array2d[float],
  out_geom: wp.array2d[int],
  out_normal: wp.array2d[wp.vec3],
  out_force: wp.array2d[float],
):
  """Writes the geoms, normals and normal forces of an organ's contacts; see `keep_closed`."""
  world, k = wp.tid()
  c = start[0] + world * many + k
  out_geom[world, k] = -1
  if geom[c][0] < 0 or address[c, 0] < 0:
    out_force[world, k] = 0.0
    return
  rows = wp.where(paired and dim[c] > 1, 2 * (dim[c] - 1), 1)
  total = float(0.0)  # noqa: UP018 - a variable to Warp
  for r in range(rows):
    if address[c, r] >= 0:
      total += force[world, address[c, r]]
  out_geom[world, k] = geom[c][0]
  out_normal[world, k] = wp.vec3(frame[c][0, 0], frame[c][0, 1], frame[c][0, 2])
  out_force[world, k] = total
