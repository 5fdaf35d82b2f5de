"""What the kernels read and write: constant `Surface`, changing `State`, both of Warp arrays."""

from __future__ import annotations

import dataclasses

import warp as wp

from .simd import WORDS


@dataclasses.dataclass
class Levels:
  """Coarser meshes of an organ for the multilevel preconditioner; see `multilevel`.

  The nodes of all of them follow one another in `surface`, each level in whole slices. Offsets are
  those of a node's x component in floats, on the finest mesh or among all coarse nodes.

  Attributes:
    nlevel: number of coarse meshes
    nodes: moving nodes of the finest mesh
    threshold: condition number from which the preconditioner is used [-]
    surface: the coarse meshes
    slice_adr: first slice of each level              (nlevel + 1,)
    source: offset of each coarse node on the finest  (coarse slices, 8)
    share: nodes of the finest that one stands for    (coarse slices, 8)
    rate: of each level, the finest first: stiffness of a node times g / mass where g / mass is one
      [N/m], upper and lower end of the smoother's interval, its degree, the finest mesh's nodes for
      one of its own                                  (nlevel + 1, 5)
    down_adr: first row of each slice in `down_node`  (coarse slices + 1,)
    down_node: offset on the next finer mesh          (rows, 8)
    down_weight: what it gives to the coarse node [-] (rows, 8)
    up_adr: first row of each slice in `up_node`, the finest mesh's slices first
                                                      (nslice + coarse slices + 1,)
    up_node: offset on the next coarser mesh          (rows, 8)
    up_weight: share of the coarse node [-]           (rows, 8)
  """

  nlevel: int
  nodes: int
  threshold: float
  surface: Surface
  slice_adr: wp.array
  source: wp.array
  share: wp.array
  rate: wp.array
  down_adr: wp.array
  down_node: wp.array
  down_weight: wp.array
  up_adr: wp.array
  up_node: wp.array
  up_weight: wp.array


@dataclasses.dataclass
class Surface:
  """Constants of one organ on one device; see `simd` for the layout of slices.

  A fan is the ring of neighbours of a node, `width` entries, the last one repeated in front and the
  first one behind: entries [k] and [k + 1] are the k-th triangle of the node.

  Attributes:
    nvert: number of vertices
    nnode: number of nodes, vertices padded to whole slices
    nslice: slices of nodes
    nelemslice: slices of triangles
    nhingeslice: slices of hinges; 0 without bending
    nslot: rows of stiffness blocks
    vert: vertex of each node, -1 for padding            (nnode,)
    node: node of each vertex                            (nvert,)
    slot_adr: first row of stiffness blocks              (nslice + 1,)
    fan_node: offset of each fan entry's node            (nslot + 2 nslice, 8)
    fan_rest: rest vector to each fan entry [m]          (nslot + 2 nslice, 3, 8)
    fan_metric: contravariant rest metric [1/m^2] and mu, lambda' times volume [N m]
                                                         (nslot + nslice, 5, 8)
    fan_spring: constant of the spring that stands for an edge, for `neumann` [N/m]
                                                         (nslot, 8)
    fan_corner: offset of each fan triangle's normal     (nslot + nslice, 8)
    fan_side: offset of its corner force at this node    (nslot + nslice, 8)
    degree: number of neighbours                         (nslice, 8)
    rest: rest position about the centroid [m]           (nslice, 3, 8)
    spring: edge spring constant [N/m]; 0 for membrane
    area: nodal area [m^2]; 0 for padding                (nslice, 8)
    free: 1 for nodes that move, 0 pinned or padding     (nslice, 8)
    elem_node: offset of each corner's node              (nelemslice, 3, 8)
    elem_rest: rest vectors corner 0 -> 1, 0 -> 2 [m]    (nelemslice, 6, 8)
    elem_hinge: hinge opposite each corner               (nelemslice, 3, 8)
    hinge_node: offset of p0, p1, left, right apex       (nhingeslice, 4, 8)
    hinge_rest: rest vectors p0 -> p1, left, right [m]   (nhingeslice, 9, 8)
    hinge_elem: offset of left and right triangle        (nhingeslice, 2, 8)
    hinge_near: the four other hinges of both triangles  (nhingeslice, 4, 8)
    hinge_gain: stiffness to itself and to those [N m]   (nhingeslice, 5, 8)
    hinge_angle0: rest angle 2 sin(theta / 2) [-]        (nhingeslice, 8)
    bend_adr: first row of the bending matrix            (nslice + 1,)
    bend_node: node of each entry                        (rows, 8)
    bend_gain: bending matrix [N/m]                      (rows, 8)
    bend_diag: its diagonal [N/m]                        (nslice, 8)
    foundation: Winkler foundation [Pa/m]
    bulk: volume stiffness [Pa]
    pressure: inside minus outside pressure [Pa]
    volume0: rest volume [m^3]
    damping: Rayleigh coefficient [s]
    iterations: most PCG iterations
    tolerance: relative residual to stop at [-]
    newton: Newton iterations a step
    device: Warp device
    levels: coarser meshes for the multilevel preconditioner, or None
  """

  nvert: int
  nnode: int
  nslice: int
  nelemslice: int
  nhingeslice: int
  nslot: int
  vert: wp.array
  node: wp.array
  slot_adr: wp.array
  fan_node: wp.array
  fan_rest: wp.array
  fan_metric: wp.array
  fan_spring: wp.array
  fan_corner: wp.array
  fan_side: wp.array
  degree: wp.array
  rest: wp.array
  spring: float
  area: wp.array
  free: wp.array
  elem_node: wp.array
  elem_rest: wp.array
  elem_hinge: wp.array
  hinge_node: wp.array
  hinge_rest: wp.array
  hinge_elem: wp.array
  hinge_near: wp.array
  hinge_gain: wp.array
  hinge_angle0: wp.array
  bend_adr: wp.array
  bend_node: wp.array
  bend_gain: wp.array
  bend_diag: wp.array
  foundation: float
  bulk: float
  pressure: float
  volume0: float
  damping: float
  iterations: int
  tolerance: float
  newton: int
  device: wp.Device
  levels: Levels | None = None

  @property
  def has_bending(self) -> bool:
    """Whether bending kernels run."""
    return self.nhingeslice > 0

  @property
  def has_volume(self) -> bool:
    """Whether the area vectors push (volume or pressure)."""
    return self.bulk != 0 or self.pressure != 0


@dataclasses.dataclass
class State:
  """State and work arrays of the organs of `nworld` worlds on one device.

  Attributes:
    nworld: number of worlds
    step: time step h, h^2 + h damping, gravity-scaled floor of the residual, share of h v at which
      the first Newton iteration stands           (nworld, 4)
    pos: displacement from rest [m]                 (nworld, nslice, 3, 8)
    vel: velocity [m/s]                             (nworld, nslice, 3, 8)
    mass: mass [kg]                                 (nworld, nslice, 8)
    force_ext: external and lagged contact force [N](nworld, nslice, 3, 8)
    dvel: change of velocity in this step [m/s]     (nworld, nslice, 3, 8)
    dvel_warm: what those of the last steps lead to, where PCG starts (nworld, nslice, 3, 8)
    change: largest (rate of an edge's ends over its length)^2 [1/s^2]  (nworld,)
    pos_trial: displacement of the present Newton iteration [m]
    vel_trial: velocity of the present Newton iteration [m/s]
    block: off-diagonal 3x3 blocks of A [kg]        (nworld, nslot, 9, 8)
    diag: inertia and foundation on the diagonal [kg](nworld, nslice, 8)
    inverse: inverse of the diagonal blocks [1/kg]  (nworld, nslice, 6, 8)
    rhs: right-hand side [N s]                      (nworld, nslice, 3, 8)
    areavec: area vector of a node, 6 dV/dx [m^2]   (nworld, nslice, 3, 8)
    normal: unit normal of a node                   (nworld, nslice, 3, 8)
    elem_normal: unit normal of a triangle, and the stiffness that its edges add to the matrix
      [N/m]                                         (nworld, nelemslice, 4, 8)
    elem_corner: force on each corner along it [N s](nworld, nelemslice, 3, 8)
    hinge_angle: strain impulse angle of a hinge    (nworld, nhingeslice, 8)
    hinge_half: cos(theta / 2)                      (nworld, nhingeslice, 8)
    hinge_moment: moment impulse [N m s]            (nworld, nhingeslice, 8)
    hinge_rough: what the bending matrix may leave out [N m](nworld, nhingeslice, 8)
    total: volume difference [m^3] and areavec . vel(nworld, 2)
    x: PCG solution [m/s]                           (nworld, nslice, 3, 8)
    r: PCG residual                                 (nworld, nslice, 3, 8)
    p: PCG direction                                (nworld, nslice, 3, 8)
    q: A times direction                            (nworld, nslice, 3, 8)
    z: preconditioned residual                      (nworld, nslice, 3, 8)
    zn: that along the normals, with turns on CUDA  (nworld, nslice, 16)
    quad: z of a node side by side, see simd.py           (nworld, nslice, 12, 8)
    e: as z, between smoothing steps                (nworld, nslice, 3, 8)
    en: that along the normals                      (nworld, nslice, 8)
    t: A times z; smoother's direction and residual (nworld, nslice, 3, 8)
    partial: what the blocks of a world exchange    (nworld, WORDS, 4)
    status: PCG iterations, relative residual, norm of the right-hand side, 1 if not finite
                                                    (nworld, 4)
    coarse: that of the coarser meshes, or None; shares `step`
  """

  nworld: int
  step: wp.array
  pos: wp.array
  vel: wp.array
  mass: wp.array
  force_ext: wp.array
  dvel: wp.array
  dvel_warm: wp.array
  change: wp.array
  pos_trial: wp.array
  vel_trial: wp.array
  block: wp.array
  diag: wp.array
  inverse: wp.array
  rhs: wp.array
  areavec: wp.array
  normal: wp.array
  elem_normal: wp.array
  elem_corner: wp.array
  hinge_angle: wp.array
  hinge_half: wp.array
  hinge_moment: wp.array
  hinge_rough: wp.array
  total: wp.array
  x: wp.array
  r: wp.array
  p: wp.array
  q: wp.array
  z: wp.array
  zn: wp.array
  quad: wp.array
  e: wp.array
  en: wp.array
  t: wp.array
  partial: wp.array
  status: wp.array
  coarse: State | None = None


def make_state(surface: Surface, nworld: int = 1, is_coarse: bool = False) -> State:
  """Returns a zeroed state; everything a step needs is allocated here."""
  s = surface
  vector, scalar = (s.nslice, 3, 8), (s.nslice, 8)
  cycles = is_coarse or s.levels is not None
  bend, elem = (s.nhingeslice, 8), (s.nelemslice if s.has_bending else 0, 3, 8)
  shapes: dict[str, tuple[int, ...]] = {
    "step": (4,),
    "mass": scalar,
    "block": (s.nslot, 9, 8),
    "diag": scalar,
    "inverse": (s.nslice, 6, 8),
    "areavec": vector if s.has_volume or s.has_bending else (0, 3, 8),
    "normal": vector if s.has_bending else (0, 3, 8),
    "elem_normal": (elem[0], 4, 8),
    "elem_corner": elem,
    "hinge_angle": bend,
    "hinge_half": bend,
    "hinge_moment": bend,
    "hinge_rough": bend,
    "change": (),
    "total": (2,),
    "zn": (s.nslice, 16) if s.has_bending else (0, 16),
    "quad": (0 if is_coarse else s.nslice, 12, 8),
    "e": vector if cycles else (0, 3, 8),
    "en": scalar if cycles and s.has_bending else (0, 8),
    "partial": (WORDS, 4),
    "status": (4,),
  }
  arrays = {}
  for field in dataclasses.fields(State)[1:-1]:
    shape = (nworld, *shapes.get(field.name, vector))
    arrays[field.name] = wp.zeros(shape, dtype=float, device=s.device)
  state = State(nworld=nworld, **arrays)
  if s.levels is not None:
    state.coarse = make_state(s.levels.surface, nworld, is_coarse=True)
    state.coarse.step = state.step
  return state
