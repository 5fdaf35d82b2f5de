"""What the tissue of each world is made of, and what follows from it for tools."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from palpate.engine import contacts
from palpate.engine.model import inertia
from palpate.tissue import body as bodies
from palpate.tissue import shape
from palpate.tissue.body import Body
from palpate.tissue.config import Config
from palpate.tissue.types import NUMBERS

from .lumps import Lumps
from .patch import GRADES, Patch

if TYPE_CHECKING:
  from ..worlds import Worlds
  from .organ import Organ

_PLAIN = ("foundation", "bulk", "pressure", "damping", "tolerance", "iterations", "stiffness")
# What may change: numbers of the tissue, what its moduli follow from, and what else.
MODULI = ("young", "young_scale", "poisson", "thickness")
KEYS = (*_PLAIN, *MODULI, "mass", "friction")
_LIGHTEST, _HEAVIEST = 0.25, 4.0  # times the compiled mass


@wp.kernel(enable_backward=False)
def weigh(p: Patch, world: wp.array[int], scale: wp.array[float]):
  """Gives some worlds multiples of the masses at first."""
  k, i = wp.tid()
  w = world[k]
  m = p.mesh[w]
  mass = p.share[m, i] * p.mass[p.source[m, i]]
  p.solve.mass[w, i // 8, i % 8] = wp.where(mass > wp.float64(0.0), scale[k] * float(mass), 1.0)


class Material:
  """What an organ's worlds are made of.

  Args:
    organ: the organ in all worlds
    batch: these worlds
    touch: how it touches tools
    pressed: its contacts
  """

  def __init__(self, organ: "Organ", batch: "Worlds", touch, pressed):
    config, nworld = organ.config, batch.nworld
    self._organ, self.batch, self._touch, self._pressed = organ, batch, touch, pressed
    self._young = np.broadcast_to(config.young, (organ.declared.mesh.nelem,))
    full = {"scale": 1.0, "poisson": config.poisson, "thickness": config.thickness, "mass": 1.0,
            "young": float(np.mean(config.young))}  # fmt: skip
    self._worlds = {name: np.full(nworld, value) for name, value in full.items()}
    self._most = np.ones(nworld)  # greatest factor of a triangle
    self._lumps: Lumps | None = None
    self._graded = False
    self._hardest = 1 + self._squeeze(config.poisson)  # of a world that the step is for

  def change(self, worlds: np.ndarray, rows: dict[str, np.ndarray]):
    """Changes worlds; `rows` has a value of each key for each of them."""
    if not len(worlds):
      return
    own, rows = self._worlds, dict(rows)
    if "friction" in rows:
      self._put(self._touch.rough, worlds, rows.pop("friction"))
    if "mass" in rows:
      self._weigh(worlds, rows["mass"] / self._organ.declared.mass.sum())
    if "young" in rows or "young_scale" in rows:
      self._stiffen(worlds, rows)
    for key in ("poisson", "thickness"):
      if key in rows:
        own[key][worlds] = rows[key]
    numbers = {key: values for key, values in rows.items() if key in _PLAIN}
    if rows.keys() - numbers.keys():
      numbers |= self._moduli(worlds)
      self._grade()
    plan, inside = self._organ.body.plan, ("bulk", "pressure")
    if plan and not plan.volumes and any(np.any(rows[key]) for key in inside if key in rows):
      self._organ.enclose()
      self.batch.record()
    number = self._organ.body.tissue.number.numpy()
    for key, values in numbers.items():
      number[worlds, NUMBERS.index(key)] = values
    if self._organ.topology:
      self._organ.topology.renumber(worlds, number, numbers)
    self._organ.body.tissue.number.assign(number)
    self._firm_up(worlds, number[worlds])

  @property
  def thickness(self) -> np.ndarray:
    """Thickness of the wall of each world [m]."""
    return self._worlds["thickness"]

  def _put(self, array: wp.array, worlds: np.ndarray, values: np.ndarray):
    whole = array.numpy()
    whole[worlds] = values
    array.assign(whole)

  def _firm_up(self, worlds: np.ndarray, number: np.ndarray):
    """Lets contacts be as firm as the tissue of these worlds asks for."""
    organ, own = self._organ, self._worlds
    config = dataclasses.replace(
      organ.config,
      young=own["young"][None, worlds],
      **{key: own[key][worlds] for key in ("poisson", "thickness")},
      **{key: number[:, NUMBERS.index(key)] for key in ("foundation", "stiffness")},
    )
    tissue = contacts.tissue_of(self.batch.model, organ.declared, config, own["mass"][worlds])
    self._put(self._pressed.tissue, worlds, tissue)

  def _moduli(self, worlds: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the scales of mu, lambda' and the plate's rigidity."""
    config = self._organ.config
    scale, nu, thick = (self._worlds[key][worlds] for key in ("scale", "poisson", "thickness"))
    thick, nu0 = thick / config.thickness, config.poisson
    squeeze, squeeze0 = self._squeeze(nu), self._squeeze(nu0)
    if squeeze0 == 0 and squeeze.any():
      raise ValueError(
        f"organ {self._organ.name!r}: poisson was compiled as 0, which cannot change in a batch "
        "on a GPU"
      )
    # The plate of a solid is its skin's, which stays.
    plate = {} if self._organ.body.is_solid else {"plate": scale * thick**3}
    return plate | {
      "shear": scale * thick * (1 + nu0) / (1 + nu),
      "lame": scale * thick * (squeeze / squeeze0 if squeeze0 else 1.0),
    }

  def _squeeze(self, nu):
    """Returns lambda, or lambda' of a shell, over Young's modulus."""
    return nu / ((1 + nu) * (1 - 2 * nu) if self._organ.body.is_solid else 1 - nu**2)

  def _stiffen(self, worlds: np.ndarray, rows: dict[str, np.ndarray]):
    """Takes Young's modulus, of the whole or of each triangle."""
    scale, factor = rows.get("young_scale"), np.ones((len(worlds), 1))
    if "young" in rows:
      factor = np.atleast_2d(rows["young"].T).T / self._young  # (worlds, nelem)
      if (factor == factor[:, :1]).all():
        scale, factor = factor[:, 0], np.ones((len(worlds), 1))
    scale = np.ones(len(worlds)) if scale is None else scale
    self._worlds["scale"][worlds] = scale
    self._worlds["young"][worlds] = scale * np.mean(self._young * factor, axis=1)
    self._most[worlds] = factor.max(axis=1)
    first, topology = self._lumps is None, self._organ.topology
    if first and factor.shape[1] == 1:
      return
    if self._lumps is None:
      self._lumps = Lumps(self._organ.declared, self._organ.body)
      self._organ.patch.lump = self._lumps.node
    self._lumps.put(worlds, factor)
    if topology:
      young = np.broadcast_to(self._young * factor, (len(worlds), self._young.size))
      topology.stiffen(worlds, young)
    if first:
      self.batch.record()

  def _weigh(self, worlds: np.ndarray, scale: np.ndarray):
    if not (_LIGHTEST <= scale.min() and scale.max() <= _HEAVIEST):
      whole = float(self._organ.declared.mass.sum())
      raise ValueError(
        f"organ {self._organ.name!r}: mass is in [{whole * scale.min():g}, "
        f"{whole * scale.max():g}], expected [{_LIGHTEST * whole:g}, {_HEAVIEST * whole:g}]"
      )
    self._worlds["mass"][worlds] = scale
    organ, mass = self._organ, self._organ.body.state.mass
    self._put(organ.patch.mass_scale, worlds, scale)
    at = wp.array(worlds, dtype=int, device=mass.device)
    factor = wp.array(scale, dtype=float, device=mass.device)
    dim = (len(worlds), organ.patch.nnode)
    wp.launch(weigh, dim=dim, inputs=[organ.patch, at, factor], device=mass.device)

  def _grade(self):
    """Lets tools meet the inertia of the worlds' tissue."""
    own, organ = self._worlds, self._organ
    scale = own["scale"] * own["thickness"] / organ.config.thickness
    low, high = scale.min(), (scale * self._most).max()
    if low < 0.999 * GRADES[0] or high > 1.001 * GRADES[-1]:
      raise ValueError(
        f"organ {organ.name!r}: young times thickness is in [{low:g}, {high:g}] times the "
        f"compiled one, expected [{GRADES[0]:g}, {GRADES[-1]:g}]"
      )
    self._find_inertia()
    organ.patch.grade.assign(np.log2(scale / own["mass"] / GRADES[0]).astype(np.float32))
    most, nu = scale * self._most, own["poisson"]
    hard = most * (1 + self._squeeze(nu))
    if hard.max() > self._hardest:
      self._hardest, k = hard.max(), int(np.argmax(hard))
      self._follow(*self._scaled(float(most[k]), float(nu[k])))

  def _follow(self, body: Body, config: Config):
    """Lets the step be one for the stiffest world."""
    organ, m = self._organ, self.batch.model
    newton = max(organ.body.newton, inertia.iterations(m, organ.space.organ, config))
    stiff = bool(organ.patch.stiff)
    if not stiff and organ.responds:
      nodal = organ.space.inertia(m._address)
      stiff = inertia.stiffness(m, organ.space.organ, body, config, nodal)[0]
    if (newton, stiff) != (organ.body.newton, bool(organ.patch.stiff)):
      organ.body.newton, organ.patch.stiff = newton, int(stiff)
      self.batch.record()

  def _find_inertia(self):
    """Fills the effective inertia at each of GRADES, once."""
    organ, w, m = self._organ, self._organ.space, self.batch.model
    if self._graded or not organ.spreads:
      return
    flex = w.organ.windows.flex if w.organ.windows else w.organ.flex
    mass = inertia.masses(m, w.organ)
    table, node = organ.patch.inertia.numpy(), organ.body.shape.node.numpy()
    for k, grade in enumerate(GRADES):
      found = inertia.of_nodes(m, w.organ, *self._scaled(float(grade)), mass, flex)
      table[k, node] = np.where(organ.declared.free, found, table[k, node])
    organ.patch.inertia.assign(table)
    self._graded = True

  def _scaled(self, scale: float, poisson: float | None = None) -> tuple[Body, Config]:
    """Returns the organ of one world with multiples of the moduli, and its configuration."""
    organ, config = self._organ.declared, self._organ.config
    config = dataclasses.replace(
      config,
      young=tuple(scale * young for young in config.young),
      poisson=config.poisson if poisson is None else poisson,
    )
    body = bodies.worlds(self._organ.space.body)
    shape.change(body, organ.mesh, config, ~organ.free)
    return body, config
