"""Records the graphs of a step over the arrays of one mjModel and one mjData."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from palpate.tissue import step
from palpate.tissue.body import Body

from . import contacts, coupling, graphs, nodal, penetration
from .coupling import Phases
from .model import declare, mjstruct, shared
from .windows import declare_windows, nodes, proxies, windowed

if TYPE_CHECKING:
  from .workspace import Workspace


def bind(w: Workspace, model: int):
  """Points the graphs at the arrays of `model` and of the workspace's mjData and records them."""
  m = mjstruct.model(model)
  device, cpu = w.body.device, wp.get_device("cpu")
  scheme = step.SCHEMES[w.config.integrator]
  with graphs.lock:
    declare.check_frame(m, w.organ)
    load(w.body)
    if w.graphs.resident:
      w.graphs.resident.fetch()
    w.host.bind(model)
    if w.organ.windows:
      w.views = w.views or windowed.scratch(w.host)
      does = windowed.Phases(w.host, w.views, w.share)
    else:
      does = nodal.Phases(w.host, w.share)
    w.graphs.phases, w.graphs.resident = does, does.resident
    if w.organ.windows or w.cuts:
      w.triangles = shared.of(model, w.data)
      w.triangles.join(model)
      w.cuts.bind(model, w.triangles, w.plugin_state)
      if w.turn is not None:
        w.turn.bind(model, w.triangles, w.organ.window)
    near = wp.get_device(does.side)
    crossing = device != near

    before, part = _before(w, model), functools.partial
    w.forces.bind()

    def solve():
      if crossing:
        _cross(w, _IN, to_device=True)
      w.host.send_springs()
      scheme.step(w.body)
      if crossing:
        _cross(w, _OUT, to_device=False)

    def respond():
      assert scheme.respond is not None  # recorded only then
      if crossing:
        _cross(w, ("rhs", "expected"), to_device=True)
      scheme.respond(w.body)
      if crossing:
        _cross(w, ("sol", "status", "ratio"), to_device=False)

    # As few graphs as may be: a launch costs a small organ a hundredth of its step.
    after = [] if w.graphs.resident else [(cpu, part(_scatter, w, does))]
    w.graphs.before = graphs.record(cpu, before)
    enter = (near, part(_enter, w, does))
    w.graphs.solve = graphs.record_all(enter, (device, solve), (near, does.look), *after)
    w.graphs.after = graphs.record(cpu, does.scatter) if w.graphs.resident else None
    w.graphs.leave = graphs.record(cpu, does.leave)
    answer = (near, does.push), (device, respond), (near, does.answer)
    w.graphs.respond = graphs.record_all(*answer) if scheme.respond else []
    w.graphs.end = graphs.record(cpu, part(_advance, w, does, ends=True))
    w.graphs.advance = graphs.record(cpu, part(_advance, w, does, ends=False))
    w.graphs.place = graphs.record(cpu, does.place) if w.organ.windows else None
    if w.graphs.resident:
      w.graphs.resident.foresee = graphs.record(cpu, does.foresee)
      ahead = graphs.record_all((near, does.enter_ahead), (device, solve))
      w.graphs.resident.begin_graph = ahead[0][1]
      w.graphs.resident.rest = graphs.record_all((near, does.look_ahead))
  _watch(w, model)


# Phases of a coupling, with what acts on the organ beside it.


def _enter(w: Workspace, does: Phases):
  does.enter()
  if w.host.springs is not None:
    w.host.springs.zero_()
  w.forces.enter()


def _scatter(w: Workspace, does: Phases):
  does.scatter()
  w.forces.act()
  if w.needles:
    w.host.open_contacts()


def _advance(w: Workspace, does: Phases, ends: bool):
  w.forces.end()
  if ends:
    does.end()
  does.advance()


def _watch(w: Workspace, model: int):
  """Notes what of a model a step looks at, and what it was."""
  m = mjstruct.model(model)
  organ = w.organ
  if organ.windows:
    tree = m.body_treeid[organ.windows.body[0]]
    w.seen.policy = m.tree_sleep_policy[tree:].data
    w.seen.counts = m.flex_vertnum[organ.flex :].data
  w.seen.identity = mjstruct.Identity(model)
  option = model + mjstruct.Model.opt.offset
  w.seen.model_step = mjstruct.view(option + type(m.opt).timestep.offset, 1).data
  w.seen.time_step = float(m.opt.timestep)
  w.seen.integrator = mjstruct.view(option + type(m.opt).integrator.offset, 1, np.int32).data
  w.seen.static = [(view, view.tobytes()) for view in declare.static_places(m, w.organ)]


def _before(w: Workspace, model: int):
  """Returns what launches a step's work before the solve."""
  touched = _touched(w, model)
  m = mjstruct.model(model)
  tools = penetration.speeds(m, w.data, w.organ, np.asarray(w.report.flags))

  def launch():
    contacts.launch(touched)
    if tools.ntool:
      penetration.find_fast.launch("cpu", 1, 1, 0, tools)
    w.graphs.phases.gather()

  return launch


def _touched(w: Workspace, model: int) -> contacts.Weights:
  """Returns what contacts with the organs of the model get weights by.

  With all of them, since one that looks for contacts again has those of the others found again.
  """
  contacts.tell(w, model)
  flexes = declare_windows.touching(model, w.seen.instance)
  out = contacts.make(model, w.data, flexes, w.report.flags)
  out.mine.numpy()[w.organ.flexes] = 2
  w.views["mine"], w.host.lift = out.mine, contacts.lift.command(out)
  return out


# What a solve on another device than MuJoCo's side reads and writes.
_IN = ("step", "disp", "vel", "mass", "force_ext", "dvel_warm")
_OUT = ("dvel", "status")


def _cross(w: Workspace, fields: tuple[str, ...], to_device: bool):
  theirs = coupling.on_body(w.body)
  for field in fields:
    there, here = theirs[field], w.host.arrays[field]
    if to_device:
      wp.copy(there, here)
    else:
      wp.copy(here, there)


def load(body: Body):
  """Loads the modules of a step on a body's device, compiling them where the cache has none."""
  there = [*step.kernels(body), nodes.commit]
  for kernel in there:
    kernel.load(body.device)
  for kernel in (*there, nodal.gather, proxies.gather, contacts.weigh, penetration.find_fast):
    kernel.load(wp.get_device("cpu"))
