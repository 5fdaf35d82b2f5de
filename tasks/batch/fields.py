"""What every vectorised exercise has of its worlds: one line a field, a row a world.

Sizes are named: nworld worlds, nvert nodes, nelem triangles, naction components of an action, naxis
axes of the instrument.
"""

import warp as wp
from palpate.batch.needles import HOLES
from palpate.tasks.core.physics import COARSE, NEAR
from palpate.tasks.core.rules import OUTCOMES
from palpate.tissue.types import Array, doubles, floats, ints, struct

flags = Array(wp.bool, ("nworld",))
VIEWS = 8  # in which the throw of a thread is looked for


@struct
class Common:
  """Scene and state; of the other hand's instrument, where there is one, what is an instrument's.

  `outcome` is a number of `OUTCOMES`.
  """

  # The scene.
  world: int  # that a thread works on
  dt: float  # of a control step [s]
  limit: int  # steps of an episode
  force_limit: float  # [N]
  damage: float  # [N]
  sparse: int  # whether rewards are
  depth: float  # from the trocar to the tip when every joint is zero [m]
  first: int  # its first component of an action
  jaw: int  # actuator, -1 without jaws
  fifth: int  # actuator of jaws or of a camera's head, -1 without
  head: int  # joint of a camera's head in qpos, -1 without
  optics: float  # angle between shaft and view of a laparoscope [rad]
  opening: int  # first of the two joints of the jaws in qpos
  qposadr: ints("naxis")  # of pitch, yaw, roll, insertion, and a wrist's pitch and yaw
  dofadr: ints("naxis")
  drive: ints("naxis")  # actuators
  low: floats("ncontrol")  # of the controls, that of jaws or head last
  high: floats("ncontrol")
  wrist: floats(2)  # see `Trocar`; zeros without one [m]
  move: floats("naxis")  # what an action of 1 adds to the drives' targets [rad, m]
  sensoradr: ints(4)  # of tip and shaft force, force on the left and right jaw
  needle: int  # first number of the free body `needle` in qpos, -1 without
  scrape: int  # first number of the sensor `scrape`, -1 without
  around: int  # first number of the sensors of that on what is around, -1 where nothing is
  elem: ints("nelem", 3)
  coarse: ints(COARSE)  # nodes of `surface`
  coarse0: Array(wp.vec3, (COARSE,))
  # The batch's.
  qpos: floats("nworld", "nq")
  qvel: floats("nworld", "nv")
  ctrl: floats("nworld", "nu")
  sensordata: floats("nworld", "nsensordata")
  sensor_steps: floats("nworld", "nstep", "nsensordata")  # in each step of the physics
  sensor_mean: floats("nworld", "nsensordata")
  failures: ints("nworld")
  xpos: floats("nworld", "nvert", 3)
  applied: floats("nworld", "napplied", 3)  # force on each vertex, see `rules.apply` [N]
  # Of jaws, and of points that the organ may hide.
  side: floats("nside")  # of a geom, see `Jaws`
  inner: floats("nworld", 2)  # force of the jaws' inner faces [N]
  eye: floats("nworld", 3)  # of the laparoscope [m]
  disc: Array(wp.vec3, ("nworld", "nspot"))  # [m]
  behind: Array(wp.bool, ("nworld", "nspot"))  # whether the organ hides them
  # Of bonds.
  bond_vert: ints("nbond")  # vertex of each
  bond_share: doubles("nbond")  # of their area
  bond_damage: floats("nworld", "nbond")  # 1 where it is free
  bond_force: floats("nworld", "nbond", 3)  # on the organ [N]
  bond_stretch: floats("nworld", "nbond", 3)  # of the strands, from bed to organ [m]
  bond_loss: floats("nworld", "nbond")  # that an action adds to the damage
  # Of what cuts the organ, see `palpate.batch.cutting.fracture.Cutters`.
  cutter_inside: floats("nworld", "ncutter")
  cutter_length: floats("nworld", "ncutter")  # [m]
  cutter_seat: floats("nworld", "ncutter", 3)  # [m]
  piece_count: ints("nworld")
  # Of needles that go through it, see `palpate.batch.needles.Needles`.
  needle_force: floats("nworld", "nneedle", 3)  # [N]
  hole_count: ints("nworld", "nneedle")
  hole_rest: floats("nworld", "nneedle", HOLES, 3)  # [m]
  hole_along: floats("nworld", "nneedle", HOLES)  # [m]
  hole_torn: floats("nworld", "nneedle", HOLES)  # [m]
  # Of the thread, and of what jaws hold of it, see `rules.hold`.
  tension: floats("nworld", "nedge")  # of each edge [N]
  strand: floats("nworld", "nnode", 3)  # where the nodes are [m]
  broken: doubles("nworld", "nnode")  # 1 where an edge has broken
  held_node: ints("nhand", "nworld")  # -1 for none
  held_place: floats("nhand", "nworld", 3)  # in the body that holds it [m]
  held_firm: Array(wp.bool, ("nhand", "nworld"))
  held_tip: Array(wp.vec3, ("nhand",))  # the tip in that body [m]
  views: Array(wp.mat33, (VIEWS,))  # frames that the thread is seen in
  crossing: floats("nworld", "ncrossing", 3)  # over and under, along the thread; its sign
  relation: doubles("nworld", "ncrossing", "ncrossing")  # scratch
  # Of the needle, see `rules.fasten` and `rules.put_away`.
  fastened: flags  # whether it is on its thread
  gone: flags  # whether it is put somewhere
  away: floats("nworld", 7)  # where [m], and its orientation, w x y z
  # Of the other hand.
  other_tip_pos: floats("nworld", 3)
  other_tip_quat: floats("nworld", 4)
  other_tissue_force: floats("nworld", 3)
  other_gripper: floats("nworld", 4)
  # Of an instrument that the exercise itself moves.
  guided_tip_pos: floats("nworld", 3)
  guided_drive: ints(4)
  # Drawn for an episode.
  body_pos: floats("nworld", 3)  # of the trocar in the world [m]
  body_quat: floats("nworld", 4)  # w x y z
  pose: floats("nworld", "naxis")  # joints at the start
  reference: floats("nworld")  # length of the path that it asks for, 0 where it asks for none [m]
  # State.
  action: floats("nworld", "naction")
  begun: flags  # an episode begins
  step: ints("nworld")  # control steps of the episode
  failed: ints("nworld")  # the batch's failures at the start of the episode
  outcome: ints("nworld")
  harm: floats("nworld")  # what costs have taken
  paid: floats("nworld")  # of the progress, in the dense reward
  reward: floats("nworld")
  success: flags
  cost: floats("nworld")  # and its parts, see `safety`
  cost_force: floats("nworld")
  cost_shaft: floats("nworld")
  cost_surroundings: floats("nworld")
  cost_damage: floats("nworld")
  tissue_peak: floats("nworld")  # largest force of a control step, see `Instrument` [N]
  shaft_peak: floats("nworld")
  around_peak: floats("nworld")
  errors: ints("nworld")  # misses, drops, contacts of the shaft
  targets: ints("nworld")  # that were reached
  missed_by: floats("nworld")  # sum of the distances from these [m]
  grasps: ints("nworld")
  slips: ints("nworld")  # grasps that were lost in closed jaws
  terminated: flags
  truncated: flags
  # Observed.
  joints: floats("nworld", "naxis")
  joint_vel: floats("nworld", "naxis")
  drive_error: floats("nworld", "naxis")
  tip_pos: floats("nworld", 3)
  tip_quat: floats("nworld", 4)
  tip_vel: floats("nworld", 3)
  contact_force: floats("nworld", 3)
  tissue_force: floats("nworld", 3)
  shaft_force: floats("nworld", 3)
  peak_force: floats("nworld", 1)
  gripper: floats("nworld", 4)
  camera_head: floats("nworld", 1)
  nodes_near: floats("nworld", NEAR, 3)
  surface: floats("nworld", COARSE, 3)
  progress: floats("nworld", 1)


RUNNING, SUCCESS, DAMAGED, MISSED = (wp.constant(k) for k in range(len(OUTCOMES)))
# Common by the names of the observations and of Gymnasium's information, where those differ.
OBSERVED = {"drive": "drive_error"}
INFO = {name: name for name in (
  "success", "outcome", "progress", "peak_force", "cost", "cost_force", "cost_shaft",
  "cost_surroundings", "cost_damage",
)} | {"shaft_force": "shaft_peak", "surroundings_force": "around_peak"}  # fmt: skip
