"""What changes of an organ while it runs: configuration keys, and what it is attached to."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy.typing as npt
from palpate.tissue import config as configuration
from palpate.tissue import reading, shape
from palpate.tissue.config import Config
from palpate.tissue.step import SCHEMES

from ..forces import cohesive_bonds, declare_attachments, declare_bonds
from ..forces.attachments import Group
from ..forces.passive import Force
from ..forces.relaxation import Relaxation
from . import contacts, graphs, workspace
from .bind import bind
from .model import mjstruct
from .windows import windowed

if TYPE_CHECKING:
  from .workspace import Workspace


def configure(w: Workspace, model: int, texts: dict[str, str]):
  """Changes configuration keys while running.

  Raises:
    ValueError: a key may not change, or its value is not allowed.
  """
  organ, mesh = w.organ, w.organ.mesh
  arguments = texts, mesh.nelem, mesh.whole.closed, organ.config
  _change(w, model, configuration.change(organ.name, w.config, *arguments))
  w.report.chosen = True


def copy(
  w: Workspace, model: int, other: Workspace, twin: Callable[[Force], tuple[Workspace, Force]]
):
  """Gives a copy of an mjData the configuration of the original, unless it was given one itself.

  Args:
    w: workspace of the copy
    model: the mjModel
    other: workspace of the original
    twin: returns the workspace and force of the copy for a force of the original
  """
  one, two = w.organ, other.organ  # which may have been made for different time steps
  if (one.signature, one.config) != (two.signature, two.config):
    return
  if not w.report.chosen and w.config != other.config:
    _change(w, model, other.config)
  mine, theirs = ([g for g in each.bonds.groups if not g.declared] for each in (w, other))
  if len(mine) != len(theirs) or not all(a.alike(b) for a, b in zip(mine, theirs, strict=True)):
    w.bonds.let_go()
    for group in theirs:
      to, bonds = (None, None) if group.other is None else twin(group.other)
      _put(w, to, dataclasses.replace(group, other=bonds))
  if w.attachments.groups or other.attachments.groups:
    groups = other.attachments.groups
    ends = [None if group.other is None else twin(group.other)[1] for group in groups]
    hold(w, model, [dataclasses.replace(g, other=o) for g, o in zip(groups, ends, strict=True)])


def attach(
  w: Workspace, model: int, vertices: npt.ArrayLike, to: int | Workspace, stiffness: float | None
) -> list[tuple[Any, Group]]:
  """Attaches vertices to a body, or to another organ's vertices nearest to them, where they are.

  Args:
    w: the workspace of the organ
    model: address of the mjModel
    vertices: some vertices
    to: number of the body, or workspace of the other organ
    stiffness: of all together [N/m], None for as firm as a step allows

  Returns:
    what was made, with the workspace that it belongs to

  Raises:
    ValueError: vertices, stiffness or configuration do not allow it.
  """
  vert = declare_attachments.check_vertices(w.host, vertices)
  spaces = [w] if isinstance(to, int) else [w, to]
  for each in spaces:
    workspace.attach(each, model)
    if each.config.resident or not SCHEMES[each.config.integrator].solids:
      raise ValueError(
        f"organ {each.organ.name!r}: resident or integrator='neumann' is set, allowed only without "
        "attachments"
      )
  _find_bodies(w)
  if isinstance(to, int):
    made = [declare_attachments.to_body(w.host, vert, to, stiffness)]
  else:
    ends = w.attachments, to.attachments
    made = list(declare_attachments.to_organ(*ends, vert, stiffness, now=True))
  for each, group in zip(spaces, made, strict=True):
    hold(each, model, [*each.attachments.groups, group])
  return list(zip(spaces, made, strict=True))


def detach(w: Workspace, model: int, groups: list[Group]):
  """Takes attachments away."""
  hold(w, model, [group for group in w.attachments.groups if group not in groups])


def hold(w: Workspace, model: int, groups: list[Group]):
  """Makes these the attachments of an organ."""
  with graphs.lock:
    if w.attachments.put(groups):
      bind(w, model)
  if w.turn is not None:
    windowed.wake(w.host)


def bond(
  w: Workspace,
  model: int,
  to: int | Workspace,
  name: str,
  law: tuple[float, float, float],
  near: float | None,
  vertices: npt.ArrayLike | None,
):
  """Bonds an organ to a body or another organ, where its vertices are.

  Args:
    w: the workspace of the organ
    model: address of the mjModel
    to: number of the body, or workspace of the other organ
    name: what messages call it
    law: stiffness, strength and energy, see `reading.Law`
    near: distance within which vertices are bonded [m], or None for those in `vertices`
    vertices: numbers of vertices, or None

  Raises:
    ValueError: a vertex or a number is not allowed, or the model has no room for bonds.
  """
  organ = w.organ.name
  if not w.config.bonded:
    raise ValueError(f"organ {organ!r}: the key bonds is not set, expected 'none' or more to bond")
  if (near is None) == (vertices is None):
    raise ValueError(f"organ {organ!r}: expected either near or vertices to bond")
  if near is not None and not (math.isfinite(near) and near > 0):
    raise ValueError(f"organ {organ!r}: near is {near}, expected a number > 0 [m]")
  try:
    how = reading.law(*law), near or 0.0, vertices
  except ValueError as error:
    raise ValueError(f"organ {organ!r}: a bond {error}") from None
  for each in [w] if isinstance(to, int) else [w, to]:
    workspace.attach(each, model)
  _find_bodies(w)
  if isinstance(to, int):
    _put(w, None, declare_bonds.to_body(w.host, to, name, *how))
  else:
    _put(w, to, declare_bonds.to_organ(w.bonds, to.bonds, *how))


def _find_bodies(w: Workspace):
  """Brings up to date where bodies are: before a first step, or after one, they are not there."""
  mjstruct.library().mj_kinematics(w.model, w.data)


def _put(w: Workspace, other: Workspace | None, group: cohesive_bonds.Group):
  w.bonds.put(group)
  for each in [w] if other is None else [w, other]:
    with graphs.lock:
      bind(each, each.model)
    if each.turn is not None:
      windowed.wake(each.host)


def _change(w: Workspace, model: int, config: Config):
  workspace.attach(w, model)
  before, w.host.config = w.config, config
  contacts.tell(w, model)
  if w.graphs.resident:
    w.graphs.resident.stop()
  material = any(getattr(before, key) != getattr(config, key) for key in configuration.MATERIAL)
  with graphs.lock:
    if material:
      shape.change(w.body, w.organ.mesh, config, ~w.organ.free)
      w.cuts.forget()
    else:
      shape.renumber(w.body, config, w.organ.mesh.closed or not w.cuts)
    w.forces.of(Relaxation).refresh()
    if any(getattr(before, key) != getattr(config, key) for key in configuration.RECORDED):
      bind(w, model)
    if material:
      workspace.refresh(w)
    else:
      workspace.feel(w, mjstruct.model(model))
  if config.foundation != before.foundation and config.carrier:
    others = [group for group in w.attachments.groups if group.by != "carrier"]
    hold(w, model, [*declare_attachments.carried(w.host), *others])
  if w.turn is not None:
    windowed.wake(w.host)
