"""What every exercise shares: `Physics` answers questions, `Task` decides.

Action, every component in [-1, 1]; each control step (0.02 s) moves the targets of the instrument's
position drives by the action times the rate:

| component | moves the target of | at 1 |
|---|---|---|
| 0 `pitch` | pitch about the trocar | 1 rad/s |
| 1 `yaw` | yaw about the trocar | 1 rad/s |
| 2 `roll` | roll about the shaft | 3 rad/s |
| 3 `insertion` | depth, positive is deeper | 0.12 m/s |
| 4 `jaw` (grasper) | opening of the jaws, not a rate: -1 squeezes closed jaws, 1 is wide open | |
| 4 `report` (palpation) | above 0.5: the inclusion is here | |
| 4 `head` (laparoscope) | turn of the camera against the scope, not a rate: 1 is half a turn | |

An instrument with a wrist has `wrist_pitch` and `wrist_yaw` after the first four, 3 rad/s at 1.

With `input="handle"` the action says where the hand holds the instrument, in place of these, see
`handle`; a spring and a damper pull the tip there, and the hand feels them. With `input="tip"` it
says so of the tip, and inverse kinematics gives the drives their targets.

Observations are in groups to choose from, see `observation` and docs/environments.md.

Reward: a task measures its progress in [-1, 1], 0 at the start, 1 on success, -1 on damage. Some
have a shaping too, which tells the way where the progress does not, such as to open the jaws; its
sum with the progress stays below 1. While a task runs, 0.4 of that sum is its potential phi; in the
end phi is all of the progress. `dense` (the default) pays the change of phi in a step, so that what
is lost costs what it had paid: as part of a potential the shaping leaves the best policy what it is
(Ng, Harada and Russell 1999). It takes a tenth of the step's cost (`task.cost`, see `safety`: force
over the limit, shaft against the organ, damage), until the costs of the episode have taken 0.55.
The rewards of a success add up to 0.45 to 1, those of any other episode to less than 0.4. `sparse`
pays 1 on the step of success and 0 elsewhere.
The domains' formulas of progress use `rules.closeness`: 1 at the goal, 0 at the distance that the
exercise began with, towards -1 far away.

An episode ends with `task.outcome`: `success`, `damage` (a force above the damage limit, of tip or
shaft; the discount is 0 as for success), `missed` (a wrong report), or None when the time limit
ended it.
"""

import collections
import dataclasses
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco as mj
import numpy as np
from dm_env import specs
from palpate.models import situs, trocar

from ..recorder import together
from ..recording import Event, Settings
from . import engine, eyes, observation, randomisation, safety, scenes, stage
from .environment import CONTROL_TIMESTEP
from .eyes import OPENGL
from .handle import ROW
from .instrument import SCOPE, axes, jawed
from .physics import Physics, check_scene
from .randomisation import Ranges
from .rules import DAMAGED, HIDDEN, MISSED, NOW, OUTCOMES, SUCCESS
from .scenes import ORGAN, Scene
from .stage import STATE, Stage

REWARDS = ("dense", "sparse")

# In the dense reward: share of the progress that is paid before the end, price of a unit of cost,
# and most that costs take. Success with all costs pays more than any progress without.
SHARE, PRICE, MOST = 0.4, 0.1, 0.55
SLACK = 1e-6  # what rounding may add to an action
_BACK = 0.008  # by how much the other hand begins farther away: the two would meet [m]


class Task(engine.Task):
  """An exercise on one organ with one instrument; a domain says what progress and success are.

  Attributes:
    name: domain and task, for instance "touch/easy"
    random: everything random comes from here
    control_timestep: between actions [s]
    observed: what is observed
    drawn: what `randomisation` drew for this episode
    outcome: how the episode ended, see the module's head; None while it runs
    progress: see the module's head [-]
    shaping: see the module's head [-]
    best: best progress so far [-]
    cost: of the last control step, see `safety`
    reference_length: of the path that the exercise asks for [m], None for none
    joints: positions that an episode begins with, by joint, beside the instruments'
    bodies: places and orientations that it begins with, by body without joints  (7,)
    threads: places of the nodes that it begins with, by thread  (nnode, 3)
    harm: what costs have taken from the dense reward so far, 0.55 at most [-]
    events: since the last `take_events`
  """

  name = "task"
  rules: Any = None  # see `Rules`
  settles = stage.SETTLES  # see `stage.build` [s]
  slots = 12  # nodes that the instrument touches at once, and some more: slots of a GPU's window
  watch = ("miss", "unintended_contact")
  reference_length: float | None = None
  final: tuple[str, ...] = ()  # components that end the episode above 0.5
  control_timestep = CONTROL_TIMESTEP
  outcome: str | None = None
  events: list[Event]
  targets = 1
  mark_radius = 0.003  # of the pictures' marks [m]
  clearance = (0.03, 0.045)  # from the place of work to the tip, where an episode begins [m]

  def __init__(
    self,
    scene: Scene,
    random: np.random.RandomState | int | None = None,
    *,
    force_limit: float = 1.5,
    damage: float = 3.0,
    spread: float = 0.03,
    jitter: float = 0.0,
    variants: tuple[int | None, ...] | None = None,
    reward: str = "dense",
    observations: Sequence[str] | None = None,
    pixels: Sequence[int] | None = None,
    randomise: Ranges | None = None,
    model: "str | os.PathLike[str] | mj.MjSpec | None" = None,
    organ: str = ORGAN,
    input: str = "drives",
    nodes: int | None = None,
    surroundings: str | None = None,
    renderer: str = OPENGL,
    name: str = "task",
  ):
    """Makes the exercise.

    Args:
      scene: of the exercise
      random: a RandomState, a seed, or None for a seed of the system's
      force_limit: force above it is counted and costs [N]
      damage: the episode fails above it [N]
      spread: radius of the place on the organ that targets are drawn from [m]
      jitter: how far the trocar moves from episode to episode [m]; it also turns, 0.5 deg per mm
      variants: shapes that episodes are drawn from, None is the mean; the scene's alone by default
      reward: `dense` or `sparse`
      observations: groups (`sensors`, `state`), pictures (`pixels`, `depth`, `segmentation`,
        `points`, ...) and names of single observations; the two groups by default
      pixels: height and width of pictures; given without a picture's name, `pixels` is observed
      randomise: ranges of what is drawn anew for each episode, see `randomisation`
      model: a scene of your own, a file or an MjSpec, in place of `scene`: it has the instrument,
        the camera `laparoscope` and the sites `target0`, ... in the world
      organ: name of the organ in it
      input: what an action moves: the instrument's position `drives`, its `handle`, or its `tip`
      nodes: of the organ, in place of the scene's
      surroundings: `abdomen`, `unseen` or `none`, in place of the scene's, see `Scene`
      renderer: what draws pictures: `opengl`, MuJoCo's, or a device, `cpu` or `cuda:0`, as it draws
        those of batches
      name: domain and task, for instance "touch/easy"
    """
    self.name, self.renderer = name, eyes.check(renderer)
    for limit, value in (("force_limit", force_limit), ("damage", damage)):
      if not 0 < value < math.inf:
        raise ValueError(f"{name}: {limit} is {value}, expected a number > 0 [N]")
    if reward not in REWARDS:
      raise ValueError(f"reward is {reward!r}, expected one of {', '.join(REWARDS)}")
    drawn = isinstance(random, np.random.RandomState)
    self.random: Any = random if drawn else np.random.RandomState(random)
    self.scene = chosen = scenes.chosen(scene, input, nodes, surroundings)
    self.force_limit, self.damage, self.organ = float(force_limit), float(damage), organ
    self.spread, self.jitter, self.visualize_reward = spread, jitter, False
    self.variants = (scene.variant,) if variants is None or model is not None else variants
    self.reward, self.prefix, self.second = reward, *chosen.prefixes
    self.observed = observation.choose(observations, pixels)
    self.joints: dict[str, np.ndarray] = {}
    self.bodies: dict[str, np.ndarray] = {}
    self.threads: dict[str, np.ndarray] = {}
    self.ranges, self.drawn = randomisation.check(randomise or {}), dict[str, Any]()
    self._models: dict[int | None, Stage] = {}
    if model is not None:
      own: Any = model if isinstance(model, mj.MjSpec) else mj.MjSpec.from_file(os.fspath(model))
      self._models[self.variants[0]] = self._stage(own.copy())

  # Scene.

  @property
  def jaws(self) -> bool:
    """Whether the instrument has jaws."""
    return jawed(self.prefix)

  @property
  def grips(self) -> bool:
    """Whether the jaws grip tissue: those of an instrument with a wrist hold a needle."""
    return self.jaws and trocar.kind(self.prefix) not in trocar.WRISTED

  @property
  def components(self) -> tuple[str, ...]:
    """Names of the action's components."""
    other = self.second.replace("/", "_")
    names = self.moved(self.prefix) + self.extra
    return names + tuple(other + name for name in (*self.moved(self.second), *self.other) if other)

  def moved(self, prefix: str) -> tuple[str, ...]:
    """Returns the names of those that move an instrument as a whole."""
    return axes(prefix) if self.scene.input == "drives" else ROW

  @property
  def extra(self) -> tuple[str, ...]:
    """Names of those that do not move the instrument as a whole."""
    return ("jaw",) if self.jaws else ("head",) if self.prefix == SCOPE else ()

  @property
  def other(self) -> tuple[str, ...]:
    """Those of the other hand's instrument."""
    return ("jaw",) if jawed(self.second) else ()

  def still(self, hand: int) -> np.ndarray:
    """Returns what leaves jaws or head of a hand's instrument as an episode begins."""
    return np.zeros(len(self.other if hand else self.extra))

  @property
  def initial_action(self) -> tuple[float, ...]:
    """Action that leaves drives, jaws and head as an episode begins  (naction,)."""
    out: list[float] = []
    for hand, prefix in enumerate((self.prefix, self.second) if self.second else (self.prefix,)):
      out += [0.0] * len(self.moved(prefix)) + self.still(hand).tolist()
    return tuple(out)

  def physics(self) -> Physics:
    """Returns the physics of the scene, to make an environment of."""
    model = self.compiled(self.variants[0]).model
    physics = Physics.from_model(engine.wrap(model))
    physics.by_tip = self.scene.input == "tip"
    physics.use(model, self.prefix, self.targets, self.organ, self.second)
    return physics

  def compiled(self, variant: int | None) -> Stage:
    """Returns the stage of a shape."""
    if variant not in self._models:
      self._models[variant] = self._stage(self.dressed(variant))
    return self._models[variant]

  def dressed(self, variant: int | None) -> mj.MjSpec:
    """Returns the scene of a shape, with as many textures of the organ as `randomise` asks for."""
    spec = self.spec(variant)
    if "texture" in self.ranges:
      situs.vary(spec, self.organ, randomisation.TEXTURES)
    return spec

  def spec(self, variant: int | None) -> mj.MjSpec:
    """Returns the scene of a shape, not that of `model`."""
    return scenes.build(self._scene(variant))

  def _stage(self, spec: mj.MjSpec) -> Stage:
    model = stage.compile_spec(spec)
    hands = [prefix for prefix in (self.prefix, self.second) if prefix]
    for prefix in hands:
      check_scene(model, prefix, self.targets, self.organ, self.scene.handle)
    return stage.build(model, hands, self.organ, self.settles)

  def _scene(self, variant: int | None) -> Scene:
    return dataclasses.replace(self.scene, variant=variant, targets=self.targets)

  def place_of_work(self, physics: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Returns the triangles that targets are drawn from, and the middle of that place [m]."""
    return physics.reachable(self.spread)

  # What a domain says.

  def share(self) -> None:
    """Lets many worlds have one scene from now on; what differs in its tissue is `tissue`."""

  def tissue(self) -> Mapping[str, np.ndarray]:
    """Returns what differs in the organ's tissue in this episode, by key of its configuration."""
    return {}

  def choose(self) -> int | None:
    """Draws the shape of an episode."""
    return self.variants[self.random.randint(len(self.variants))]

  def begin(self, physics: Physics) -> None:
    """Draws the targets of an episode."""
    raise NotImplementedError

  def advance(self, physics: Physics) -> float:
    """Returns the progress after a control step; sets `outcome` on success or failure."""
    _, progress, outcome = self.rules.advance(physics, self)
    self.outcome = OUTCOMES[outcome]
    if outcome in (DAMAGED, MISSED):
      self.event(physics, "note", label=self.label(OUTCOMES[outcome]))
    self.show(physics)
    return 1.0 if outcome == SUCCESS else progress

  def show(self, physics: Physics) -> None:
    """Moves the marks of the pictures after a control step."""
    if not self.rules or not self.rules.mark:
      return
    for k in range(self.targets):
      place, look = self.rules.mark(physics, self, k)
      physics.mark(k, place, look != HIDDEN, look == NOW, self.mark_size(k))

  def mark_size(self, k: int) -> float:
    """Returns the radius of a mark [m]."""
    return self.mark_radius

  def harsh(self, physics: Physics) -> bool:
    """Returns whether somebody should step in: what is done now does harm if it goes on."""
    return physics.peak_force > self.force_limit

  def label(self, kind: str) -> str:
    """Returns what an event of the rules is called, see `event`."""
    return ""

  def instruct(self, physics: Physics) -> str:
    """Returns what a person is to do next, in words."""
    return ""

  def observe(self, physics: Physics) -> Mapping[str, np.ndarray]:
    """Returns the domain's own observations."""
    if self.rules is None:
      return {}
    self.rules.observe(physics, self)
    own = self.rules.observed
    return {name: np.array(getattr(self, name), float, ndmin=1) for name in own}

  def recorded(self, physics: Physics) -> Mapping[str, Any]:
    """Returns further columns of a sample, see `Recorder.append`."""
    columns = self.rules.columns if self.rules else {}
    return {name: float(getattr(self, field)) for name, field in columns.items()}

  def arrays(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns the arrays of a control step: action, what hands felt, where a laparoscope went."""
    arrays = {"action": self.action}
    if physics.looked is not None:
      arrays["laparoscope"] = physics.looked
    if self.scene.input != "drives":
      arrays["felt"] = physics.felt()
      if physics.second:
        arrays[f"{self.second.replace('/', '_')}felt"] = physics.second.felt()
    return arrays

  def constants(self, physics: Physics) -> Mapping[str, np.ndarray]:
    """Returns further constants of a recording, see `Recorder.attach`."""
    return {}

  def expert(self, p: Any) -> Iterator[np.ndarray]:
    """Yields the actions of an expert, in the words of `performer.Performer`."""
    raise ValueError(f"{self.name}: no expert is written for it")

  # dm_control's side.

  def initialize_episode(self, physics: Physics) -> None:
    """Draws shape, trocar, pose and targets, and puts the organ at rest."""
    place = self.compiled(self.choose())
    if physics.model.ptr is not place.model:
      physics.use(place.model, self.prefix, self.targets, self.organ, self.second)
    place.restore()
    mj.mj_setState(place.model, physics.data.ptr, place.state, STATE)
    self.drawn = randomisation.apply(self.ranges, self.random, physics, place)
    mj.mj_kinematics(place.model, physics.data.ptr)
    physics.moved()
    limit = self.jitter
    for hand in physics.hands:
      hand.move_port(
        self.random.uniform(-limit, limit, 3), 8.7 * self.random.uniform(-limit, limit, 3)
      )
    self.outcome, self.events = None, []
    self.progress, self.shaping, self.best, self._phi, self._gain = 0.0, 0.0, 0.0, 0.0, 0.0
    self.peak, self._area = 0.0, 0.0
    self.cost, self.harm, self._price = safety.Cost(), 0.0, 0.0
    physics.quiet()
    self._place_instrument(physics)
    self.begin(physics)
    physics.put(self.joints, self.bodies)
    if self.rules and self.rules.begin and not physics.rests:
      self.rules.begin(physics, self)
    self.show(physics)
    self.nodes0 = physics.nodes()
    self.start = physics.tip_pos()

  def _place_instrument(self, physics: Physics) -> None:
    _, center = self.place_of_work(physics)
    for hand in physics.hands:
      back = 0.0 if hand is physics else _BACK
      port = hand.trocar()
      away = (port.pos - center) / np.linalg.norm(port.pos - center)
      aside = self.random.uniform(-0.015, 0.015, 3)
      tip = center + (self.random.uniform(*self.clearance) + back) * away + aside
      joints = trocar.inverse(port, tip)
      pose = np.array([joints[0], joints[1], self.random.uniform(-0.5, 0.5), joints[2]])
      hand.set_joints(np.concatenate([pose, np.zeros(len(port.wrist))]))

  def action_spec(self, physics: Physics) -> specs.BoundedArray:
    """Returns the bounds of the action; the components are at the module's head."""
    names = self.components
    one = np.ones(len(names))
    return specs.BoundedArray(one.shape, float, -one, one, name="\t".join(names))

  def check_action(self, action: Any) -> np.ndarray:
    """Returns the action as float64; ValueError names the component, its value and the bounds."""
    values = np.asarray(getattr(action, "continuous_actions", action), np.float64)
    names = self.components
    if values.shape[-1:] != (len(names),) or values.ndim > 1 + (self.scene.input != "drives"):
      raise ValueError(
        f"{self.name}: action has shape {values.shape}, expected ({len(names)},): "
        + ", ".join(names)
      )
    if not np.abs(values).max(initial=0.0) <= 1 + SLACK:
      wrong = ~(np.abs(values.ravel()) <= 1 + SLACK)
      k = int(wrong.argmax())
      raise ValueError(
        f"{self.name}: action {names[k % len(names)]} is {values.ravel()[k]}, expected a number in "
        "[-1, 1]"
      )
    return values.clip(-1.0, 1.0)

  def before_step(self, action: Any, physics: Physics) -> None:
    """Moves the drives' targets, or tells the handle where to go."""
    self.action = values = self.check_action(action)
    first = 0
    for hand, extra in zip(physics.hands, (self.extra, self.other), strict=False):
      count = len(self.moved(hand.prefix)) + len(extra)
      hand.act(values[..., first : first + count], self.control_timestep)
      first += count
    if self.rules and self.rules.act:
      self.rules.act(physics, self)

  def after_step(self, physics: Physics) -> None:
    """Measures the progress and looks for errors and damage."""
    self.peak = max(self.peak, physics.peak_tissue)
    self.progress = self.advance(physics)
    tip, shaft, around = physics.peak_tissue, physics.peak_shaft, physics.peak_surroundings
    beside, before = {"shaft": shaft, "surroundings": around}, self.cost
    self.cost = safety.Cost(*safety.parts(tip, shaft, around, self.force_limit, self.damage))
    for where, force in beside.items():
      if getattr(self.cost, where) and not getattr(before, where):
        self.event(physics, "unintended_contact", force, label=where)
    if self.cost.damage:
      self.outcome, self.progress = "damage", -1.0
      where = max(beside, key=lambda name: beside[name])
      how = " by the shaft" if where == "shaft" else " on the surroundings"
      how, force = ("", tip) if tip > self.damage else (how, beside[where])
      self.event(physics, "note", label=f"too much force{how}: {force:.2f} N")
    elif self.outcome == "success":
      self.event(physics, "note", label="success")
    self.shaping = self.rules.shaping(physics, self) if self.rules else 0.0
    phi = self.progress
    if self.outcome not in ("success", "damage"):
      phi = SHARE * (phi + self.shaping)
    self._gain, self._phi = phi - self._phi, phi
    self.best = max(self.best, self.progress)
    self._price = min(PRICE * self.cost.total, MOST - self.harm)
    self.harm += self._price

  def get_observation(self, physics: Physics) -> collections.OrderedDict:
    """Returns what was chosen to be observed, see `observation`."""
    return observation.take(self, physics)

  def observation_spec(self, physics: Physics) -> collections.OrderedDict:
    """Returns the specs of what is observed, by name."""
    return observation.spec(self, physics)

  def get_reward(self, physics: Physics) -> float:
    """Returns the reward of the last step, see the module's head."""
    if self.reward == "sparse":
      return float(self.outcome == "success")
    return float(self._gain - self._price)

  def get_termination(self, physics: Physics) -> float | None:
    """Returns the final discount 0 once there is an outcome."""
    return None if self.outcome is None else 0.0

  # Recording.

  def event(self, physics: Physics, kind: str, value: float | None = None, label: str = "") -> None:
    """Reports an event to the recorder, see `Event`."""
    self.events.append(Event(kind, float(physics.time()), value, 0, label))

  def take_events(self) -> list[Event]:
    """Returns the events since the last call."""
    events, self.events = self.events, []
    return events

  def settings(self) -> Settings:
    """Returns the limits that the metrics need."""
    return Settings(
      force_limit=self.force_limit,
      grip_limit=self.force_limit if self.grips else None,
      tip_cutoff=None,  # the simulation's positions are exact
      reference_length=self.reference_length,
      contact_force=0.02,
      local_axis=(0.0, 0.0, -1.0),
    )

  def sample(self, physics: Physics) -> dict[str, Any]:
    """Returns a sample for `Recorder.append`; the forces are those of every step of the physics."""
    forces, strain = physics.forces(), physics.strain(self.nodes0)  # of the main hand
    area = physics.contact_area() if forces["force"].any() else 0.0
    self._area = area if area > 0 else self._area
    own = {
      "area": self._area if forces["force"][-1] > 0 else 0.0,
      "strain": strain() if physics.second else strain,
      **self.recorded(physics),
    }
    hands = [
      {
        "tip_pos": hand.tip_pos(),
        "quat": hand.tip_quat(),
        "visible": float(physics.visible(hand.tip_pos())),
        **hand.forces(),
      }
      for hand in physics.hands
    ]
    return {"time": physics.data.ptr.time} | together(hands[0] | own, *hands[1:])
