"""Threads in knots and tangles, and hands that pull them."""

import mujoco
import numpy as np
import palpate
import scipy.spatial
from palpate.tasks.core.scenes import ORGAN, Scene
from palpate.tasks.domains.suturing import drain
from palpate.tasks.metrics import knots
from palpate.tissue.sutures import DIAMETER, SUTURES

RADIUS, YOUNG, DENSITY = 1.125e-4, 8.7e9, 1330.0  # silk 3-0


def lengths(curve):
  """Returns the length of a curve up to each of its points [m]."""
  return np.r_[0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]


def points_at(curve, along):
  """Returns the points of a curve that are so far along it [m]."""
  return np.stack([np.interp(along, lengths(curve), c) for c in curve.T], axis=1)


def resampled(curve, segment):
  """Returns points along a curve, `segment` apart [m]."""
  whole = lengths(curve)[-1]
  return points_at(curve, np.linspace(0, whole, int(whole / segment) + 1))


def with_tails(curve, tail):
  """Returns a curve that goes on straight at both ends."""
  first, last = curve[0] - curve[1], curve[-1] - curve[-2]
  ahead = np.linspace(0, tail, 50)[1:, None]
  first, last = (ahead * (v / np.linalg.norm(v)) for v in (first, last))
  return np.concatenate([(curve[0] + first)[::-1], curve, curve[-1] + last])


def overhand(size, segment, tail):
  """Shastri's polynomial knot, Tohoku Mathematical Journal 44 (1992): an overhand knot."""
  t = np.linspace(-2.1, 2.1, 2001)
  curve = size * np.stack([t**3 - 3 * t, t**4 - 4 * t**2, (t**5 - 10 * t) / 5], axis=1)
  return resampled(with_tails(curve, tail), segment)


def graded(curve, fine, coarse, half, growth=1.15):
  """Returns points along a curve, `fine` apart within `half` of its middle, then up to `coarse`."""
  middle, at, edge = 0.5 * lengths(curve)[-1], [0.0], fine
  while at[-1] < middle:
    edge = min(coarse, edge * growth) if at[-1] > half else edge
    at.append(at[-1] + edge)
  at = np.array(at) * middle / at[-1]
  return points_at(curve, middle + np.r_[-at[:0:-1], at])


def tangle(seed, segment):
  """A random smooth curve, no nearer to itself than it is thick, between straight ends."""
  rng = np.random.RandomState(seed)
  t = np.linspace(0, 1, 1500)[:, None]
  while True:
    k = np.arange(1, 9)
    waves = rng.normal(size=(2, 8, 3)) / k[:, None] ** 0.2
    curve = np.einsum("tk,kc->tc", np.sin(2 * np.pi * t * k), waves[0])
    curve += np.einsum("tk,kc->tc", np.cos(2 * np.pi * t * k), waves[1])
    window = np.minimum(1.0, 8 * np.sin(np.pi * t))
    curve = 0.001 * window * curve + np.array([0.004, 0, 0]) * (t - 0.5)
    ends = np.linspace(0.0, 0.015, 60)[1:, None] * (1, 0, 0)
    curve = np.concatenate([(curve[0] - ends)[::-1], curve, curve[-1] + ends])
    points = resampled(curve, segment)
    if np.linalg.norm(np.diff(points, axis=0), axis=1).min() < RADIUS:
      continue  # it turns more sharply than a thread can
    near = nearest(points) < 2.3 * RADIUS
    if not near and nearest(resampled(curve, RADIUS), between=8) > 1.6 * RADIUS:
      return points


def nearest(points, between=2):
  """Returns how near the middles of edges come that are `between` or more apart [m]."""
  middle = 0.5 * (points[1:] + points[:-1])
  i, j = np.triu_indices(len(middle), between)
  far = np.linalg.norm(middle[i] - middle[j], axis=1)
  return far.min()


def passes(before, after, parts=4):
  """Returns how many pairs of a thread's edges go through each other between two steps.

  Nodes move on straight lines. Edges cross where the volume that they span changes its sign while
  the nearest points of their lines are within both. After a long step this finds too many: the
  thread may have gone round.

  Args:
    before: nodes [m]  (n, 3)
    after: the same nodes a step later [m]  (n, 3)
    parts: of the step, in each of which a pair crosses at most once
  """
  middle = 0.5 * (before[1:] + before[:-1])
  far = np.linalg.norm(np.diff(before, axis=0), axis=1).max()
  far += 2 * np.linalg.norm(after - before, axis=1).max()
  pairs = scipy.spatial.cKDTree(middle).query_pairs(1.1 * far, output_type="ndarray")
  i, j = pairs[pairs[:, 1] - pairs[:, 0] > 1].T

  def spanned(share):
    x = before + share * (after - before)
    d, e, r = x[i + 1] - x[i], x[j + 1] - x[j], x[j] - x[i]
    n = np.cross(d, e)
    with np.errstate(invalid="ignore"):  # parallel
      at = [(np.cross(r, along) * n).sum(axis=1) / (n * n).sum(axis=1) for along in (e, d)]
    return (n * r).sum(axis=1), *at

  crossed, old = np.zeros(len(i), bool), spanned(0.0)
  for share in np.linspace(0.0, 1.0, parts + 1)[1:]:
    new = spanned(share)
    changes = (old[0] > 0) != (new[0] > 0)
    when = old[0] / np.where(changes, old[0] - new[0], 1.0)
    at = np.array([a + when * (b - a) for a, b in zip(old[1:], new[1:], strict=True)])
    crossed |= changes & ((at > 0) & (at < 1)).all(axis=0)
    old = new
  return int(crossed.sum())


def load(points, hands=(), h=1e-3, damping=2.0, **config):
  """Returns a thread, some nodes of which are in hands: 20 g on a slide with a motor each.

  Args:
    points: its nodes [m]  (n, 3)
    hands: of each its node and the direction of its slide
    h: time step [s]
    damping: of the slides [N s/m]
    **config: see `palpate.add_thread`
  """
  spec = mujoco.MjSpec()
  spec.option.gravity, spec.option.timestep = (0, 0, 0), h
  palpate.add_thread(spec, points, "t", **config)
  add_hands(spec, "t", points, hands, damping)
  model = spec.compile()
  data = mujoco.MjData(model)
  return model, data, palpate.Thread(model, data, "t")


def add_hands(spec, thread, points, hands, damping):
  """Adds what holds nodes of a thread, see `load`."""
  for k, (node, way) in enumerate(hands):
    name = f"hand_{k}"
    hand = spec.worldbody.add_body(name=name, pos=points[node])
    hand.add_geom(size=[0.003, 0, 0], mass=0.02, contype=0, conaffinity=0)
    hand.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=way, damping=damping)
    motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_motor()
    spec.add_equality(
      type=mujoco.mjtEq.mjEQ_CONNECT,
      objtype=mujoco.mjtObj.mjOBJ_BODY,
      name1=name,
      name2=f"{thread}_{node}",
      solref=[0.002, 1],
    )


def by_hands(points, force, steps, step=mujoco.mj_step, within=50, **config):
  """Returns a thread whose ends hands have pulled apart, and how it went.

  Their force grows `within` so many steps.

  Returns:
    the thread; whether none of it came before a hand, where an open thread is closed for its knot:
    what goes by a hand changes that, and rightly so; its `passes`
  """
  axis = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])
  model, data, thread = load(points, ((0, -axis), (len(points) - 1, axis)), **config)
  places, clear, through = thread.positions, True, 0
  for k in range(steps):
    data.ctrl[:] = force * min(1.0, k / within)
    step(model, data)
    before, places = places, thread.positions
    through += passes(before, places)
    moved = np.linalg.norm(places - before, axis=1).max()
    for end, way in ((places[0], -axis), (places[-1], axis)):
      ahead = (places - end) @ way
      off = np.linalg.norm(places - end - ahead[:, None] * way, axis=1)
      edge = np.linalg.norm(points[1] - points[0])
      clear &= not ((ahead > edge) & (off < 2 * moved + edge)).any()
  return thread, clear, through


def throws(turns, radius, segment, ear=5e-3, arm=5e-3):
  """Returns a thread tied loosely: two strands in throws one above the other, joined by a bow.

  In a throw of k turns the strands wind about each other by 2 k + 1 half turns. They come out at
  its top, the other way round, and are the strands of the next.

  Args:
    turns: of each throw, negative where left-handed
    radius: of the thread [m]
    segment: length of an edge [m]
    ear: length of the free ends [m]
    arm: how far from the knot the bow begins [m]

  Returns:
    nodes [m] (n, 3), and the nodes at which the bow begins and ends
  """
  wide, pitch, up = 1.6 * radius, 10 * radius, 12.8 * radius
  strands = [], []
  for level, k in enumerate(turns):
    half = 2 * abs(k) + 1
    u = np.linspace(0, 1, 60 * half)
    angle = np.sign(k) * np.pi * half * u
    x, z = 0.5 * pitch * half * (u - 0.5), level * up
    y, high = wide * np.sin(angle), wide * np.cos(angle)
    to_right, to_left = (np.stack([x, s * y, z - s * high], axis=1) for s in (1, -1))
    if level % 2:
      strands[0].append(to_left[::-1])
      strands[1].append(to_right)
    else:
      strands[0].append(to_right)
      strands[1].append(to_left[::-1])
  left, right = (np.concatenate(each) for each in strands)  # by where they begin
  left, right = (
    np.concatenate([each, each[-1:] + ear * np.array([[np.sign(each[-1, 0]), 0, 0.1]])])
    for each in (left, right)
  )
  t = np.linspace(np.pi, 2 * np.pi, 60)
  bow = np.stack([arm * np.cos(t), 0 * t, left[0, 2] + arm * np.sin(t)], axis=1)
  share = np.linspace(0, 1, 20)[1:-1, None]
  joins = [left[:1] + share * (bow[:1] - left[:1]), bow[-1:] + share * (right[:1] - bow[-1:])]
  points = resampled(np.concatenate([left[::-1], joins[0], bow, joins[1], right]), segment)
  return points, *(int(np.linalg.norm(points - at, axis=1).argmin()) for at in bow[[0, -1]])


def masses(thread):
  """Returns the mass of each node of a thread with `refine` [kg], which goes by its length."""
  length = thread.rest_lengths
  own = np.append(length, 0) + np.append(0, length)
  return thread.model.body("t_0").mass[0] * own / own.mean()


def in_four_hands(turns, material="silk", size="3-0", segment=2.5, **config):
  """Returns model, data and a thread with loose `throws`, whose four strands are in hands."""
  radius = 0.5 * DIAMETER[size]
  points, first, last = throws(turns, radius, segment * radius)
  nodes = first, last, 0, len(points) - 1
  hands = [(node, (np.sign(points[node, 0]), 0, 0)) for node in nodes]
  return load(points, hands, damping=20.0, material=material, size=size, strength=0, **config)


def set_knot(model, data, force, steps, step=mujoco.mj_step):
  """Draws all four strands, harder and harder for 200 steps."""
  for k in range(steps):
    data.ctrl[:] = force * min(1.0, k / 200)
    step(model, data)


def drawn(turns):
  """Returns the nodes of a knot that all four strands have drawn tight by 2 N [m]."""
  model, data, thread = in_four_hands(turns)
  set_knot(model, data, 2.0, 240)
  return thread.positions


def pull_ends(model, data, thread, axis, steps, mass):
  """Pulls the ends of a thread apart, up to 0.5 N after 50 steps.

  Args:
    model: with the thread alone
    data: its state
    thread: which
    axis: way of the last end
    steps: how many
    mass: function of the thread to the mass of its nodes, or of each [kg]

  Returns:
    its energy after each step, and by how much more than the work of the pull it grew [J]
  """
  energies, works = [], []
  for k in range(steps):
    pull = 0.5 * min(1.0, k / 50) * axis
    data.qfrc_applied[:3], data.qfrc_applied[-3:] = -pull, pull
    before = data.qpos.copy()
    mujoco.mj_step(model, data)
    works.append(data.qfrc_applied @ (data.qpos - before))
    square = (data.qvel.reshape(-1, 3) ** 2).sum(axis=1)
    energies.append(thread.energy + 0.5 * (mass(thread) * square).sum())
  return np.array(energies), np.diff(energies) - works[1:]


def with_loose_tails(points, random, step=3e-4):
  """Returns a thread whose ends go on, turning at random."""
  tails = []
  for end, way in ((points[0], points[0] - points[1]), (points[-1], points[-1] - points[-2])):
    way, places = way / np.linalg.norm(way), [end]
    for _ in range(random.randint(20, 100)):
      way = way + 0.25 * random.normal(size=3)
      way /= np.linalg.norm(way)
      places.append(places[-1] + step * way)
    tails.append(places[1:])
  return np.concatenate([tails[0][::-1], points, tails[1]])


def sewn(turns, segment):
  """Returns the nodes of a thread through the marks of the drain, with throws on top [m]."""
  knot, first, last = throws(turns, RADIUS, 0.5 * segment, ear=7e-3)
  up = np.array([0, 0, drain.HIGH + 1e-3])
  side = np.sign(knot[first, 0]) * np.array([0.5 * drain.BITE, 0, 0])
  chord = np.linspace(drain.MIDDLE + side, drain.MIDDLE - side, 20)
  return resampled(np.concatenate([knot[:first] + up, chord, knot[last + 1 :] + up]), segment)


def stitch(nodes, window=0, segment=4.5e-4, **thread):
  """Returns a stitch through a slit drain with a square knot on top, its ends in hands.

  Args:
    nodes: of the drain, about
    window: its nodes that instruments can touch at once, 0 for all
    segment: length of the thread's edges [m]
    **thread: see `palpate.add_thread`

  Returns:
    model, data and the thread, of some hundred nodes
  """
  points = sewn((1, -1), segment)
  spec = drain.build(Scene(instrument="knot_pusher", nodes=nodes), points, **thread)
  if window:
    palpate.add_windows(spec, ORGAN, nodes=window)
  ends = [(k, np.sign(points[k, 0]) * np.array([1, 0, 0])) for k in (0, len(points) - 1)]
  add_hands(spec, drain.THREAD, points, ends, 20.0)
  model = spec.compile()
  data = mujoco.MjData(model)
  return model, data, drain.sew(palpate.Organ(model, data, ORGAN), points)


def pull_test(
  turns, material="silk", size="3-0", segment=2.5, set_by=2.0, most=0.8, step=mujoco.mj_step,
  **config,
):  # fmt: skip
  """Ties a knot, draws it tight by all four strands, lets the ends go, and pulls the bow's apart.

  Args:
    turns: see `throws`
    material: of the thread
    size: of the thread
    segment: length of an edge, in radii
    set_by: force that the knot is drawn tight with [N]
    most: of the pull, as a share of the thread's strength
    step: takes a step of a model and its data
    **config: see `palpate.add_thread`

  Returns:
    what held [N], a share of the strength; how far the strands came out of the knot [m]; the thread
  """
  strength = SUTURES[material].strength[size]
  model, data, thread = in_four_hands(turns, material, size, segment, **config)
  at = [model.joint(f"hand_{k}").qposadr[0] for k in (0, 1)]
  set_knot(model, data, set_by, 300, step)
  for k in range(100):
    data.ctrl[2:] = set_by * (1 - k / 100)
    step(model, data)
  data.eq_active[2:] = 0
  start, force, slip = data.qpos[at].sum(), set_by, 0.0
  for k in range(500):
    force = set_by + (most * strength - set_by) * min(1.0, k / 400)
    data.ctrl[:2] = force
    step(model, data)
    slip = data.qpos[at].sum() - start
    if k % 20 == 0 and knots.throws(knots.closed(thread.positions, np.array([1.0, 0, 0]))) == ():
      return force / strength, slip, thread
  return force / strength, slip, thread
