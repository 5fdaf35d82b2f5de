"""A compiled scene with its organ at rest: what every episode in it begins from."""

import copy
import dataclasses
import hashlib
import operator
import warnings
from collections.abc import Sequence

import mujoco as mj
import numpy as np
from palpate import Organ
from palpate.models import handle, trocar
from palpate.tissue.config import Config

STATE = mj.mjtState.mjSTATE_INTEGRATION
SETTLES = 3.0  # how long an organ is waited for [s]
# It is at rest when its fastest node is slower than so much [m/s]; it is looked at so often [s].
_STILL, _LOOK = 1e-7, 0.1
_KEPT = 64  # states at rest that a process keeps
_AT_REST: dict[tuple, tuple[np.ndarray, Config, dict[str, np.ndarray]]] = {}
# What an episode may change in the model.
_CHANGED = (
  "body_pos", "body_quat", "cam_fovy", "cam_pos", "cam_quat", "eq_data", "eq_obj2id", "eq_solimp",
  "eq_solref", "flex_friction", "flex_matid", "flex_rgba", "geom_friction", "light_ambient",
  "light_diffuse", "light_dir", "light_pos", "light_specular", "mat_rgba", "skin_matid",
  "skin_rgba", "vis.headlight.ambient", "vis.headlight.diffuse", "vis.headlight.specular",
)  # fmt: skip


@dataclasses.dataclass(eq=False)
class Stage:
  """A scene to play in.

  Attributes:
    model: compiled
    state: in which the organ rests under its weight and the instrument is out of the way
    config: of the organ, as compiled
    nominal: what episodes may change of the model, as compiled
  """

  model: mj.MjModel
  state: np.ndarray
  config: Config
  nominal: dict[str, np.ndarray]

  def restore(self) -> None:
    """Undoes what an episode has changed in the model."""
    for name, value in self.nominal.items():
      operator.attrgetter(name)(self.model)[:] = value


def compile_spec(spec: mj.MjSpec) -> mj.MjModel:
  """Returns the model of a scene."""
  with warnings.catch_warnings():  # the plugin's passive forces are unknown to the compiler
    warnings.filterwarnings("ignore", ".*has no equality constraints or passive forces")
    return spec.compile()


def build(model: mj.MjModel, hands: Sequence[str], organ: str, settles: float = SETTLES) -> Stage:
  """Returns the stage of a model, with an organ and the instruments of these prefixes.

  It is waited for the organ to come to rest, but no longer than `settles` [s]. A process waits once
  for those of equal models.
  """
  asked = _digest(model), tuple(hands), organ, settles
  if asked not in _AT_REST:
    data = mj.MjData(model)
    tissue = Organ(model, data, organ)
    settle(tissue, hands, settles)
    state = np.empty(mj.mj_stateSize(model, STATE))
    mj.mj_getState(model, data, state, STATE)
    nominal = {name: operator.attrgetter(name)(model).copy() for name in _CHANGED}
    if tissue.config.tetrahedra:  # from a file, which is no part of the model
      return Stage(model, state, tissue.config, nominal)
    if len(_AT_REST) >= _KEPT:
      del _AT_REST[next(iter(_AT_REST))]
    _AT_REST[asked] = state, tissue.config, nominal
  state, config, nominal = _AT_REST[asked]
  return Stage(model, state.copy(), config, nominal)


def _digest(model: mj.MjModel) -> bytes:
  """Returns what equal models have in common."""
  plain = copy.copy(model)
  plain.flexedge_invweight0[:] = 0  # the compiler leaves one of them to chance
  content = np.empty(mj.mj_sizeModel(plain), np.uint8)
  mj.mj_saveModel(plain, None, content)
  return hashlib.blake2b(content.data).digest()


def settle(organ: Organ, hands: Sequence[str], most: float = SETTLES) -> None:
  """Lets the organ come to rest under its weight, instruments withdrawn; time starts anew."""
  model, data = organ.model, organ.data
  for prefix in hands:
    name = f"{prefix}insertion"
    low = model.joint(name).range[0]
    data.qpos[model.joint(name).qposadr[0]] = low
    held = handle.find(model, data, prefix)
    if held is None:
      data.ctrl[model.actuator(name).id] = low
    else:
      port = trocar.trocar(model, prefix)
      held.move(trocar.forward(port, (0.0, 0.0, low)))
  for _ in range(round(most / _LOOK)):
    mj.mj_step(model, data, round(_LOOK / model.opt.timestep))
    if np.linalg.norm(organ.xvel, axis=1).max() < _STILL:
      break
  data.qvel[:] = 0
  data.qacc_warmstart[:] = 0
  data.time = 0
