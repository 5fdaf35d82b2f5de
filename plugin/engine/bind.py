"""Records the graphs of a step over the arrays of one mjModel and one mjData."""

from __future__ import annotations

import numpy as np
import warp as wp
from palpate.tissue import step
from palpate.tissue.body import Body

from . import coupling, declare, graphs, mjstruct, window, window_nodes, window_slots


def bind(w, model: int):
  """Points the graphs at the arrays of `model` and of the workspace's mjData and records them."""
  m = mjstruct.Model.from_address(model)
  device, cpu = w.body.device, wp.get_device("cpu")
  scheme = step.SCHEMES[w.config.integrator]
  side = window if w.organ.windows else coupling
  with graphs.lock:
    declare.check_frame(m, w.organ)
    load(w.body)
    if w.resident:
      w.resident.fetch()
    launches = side.launches(w, model, w.instance)
    near = wp.get_device(launches.side)
    crossing = device != near

    def solve():
      if crossing:
        _cross(w, _IN, to_device=True)
      scheme.step(w.body)
      if crossing:
        _cross(w, _OUT, to_device=False)

    def respond():
      if crossing:
        _cross(w, ("rhs",), to_device=True)
      scheme.respond(w.body)
      if crossing:
        _cross(w, ("sol", "status"), to_device=False)

    w.before = graphs.record(cpu, launches.gather)
    w.solve = graphs.record_all((near, launches.enter), (device, solve), (near, launches.look))
    w.after = graphs.record(cpu, launches.scatter)
    w.leave = graphs.record(cpu, launches.leave)
    w.respond = []
    if scheme.respond:
      w.respond = graphs.record_all(
        (near, launches.push), (device, respond), (near, launches.answer)
      )
    w.end = graphs.record(cpu, launches.end) if launches.end else None
    w.advance = graphs.record(cpu, launches.advance)
    w.place = graphs.record(cpu, launches.place) if launches.place else None
    if w.resident:
      w.resident.foresee = graphs.record(cpu, launches.foresee)
      ahead = graphs.record_all((near, launches.enter_ahead), (device, solve))
      w.resident.begin_graph = ahead[0][1]
      w.resident.rest = graphs.record_all((near, launches.look_only))
  w.model, w.identity = model, mjstruct.Identity(model)
  w.model_step = coupling.option_views(model)["timestep"].numpy().data
  w.time_step = float(m.opt.timestep)
  w.integrator = mjstruct.view(
    model + mjstruct.Model.opt.offset + type(m.opt).integrator.offset, 1, np.int32
  ).data
  w.static = [(view, view.tobytes()) for view in declare.static_places(m, w.organ)]
  if w.turn is not None:
    w.turn.bind(model, w.organ.windows)


# What a solve on another device than MuJoCo's side reads and writes.
_IN = ("step", "disp", "vel", "mass", "force_ext", "dvel_warm")
_OUT = ("dvel", "status")
CROSSING = (*_IN, *_OUT)


def field_of(body: Body, name: str) -> wp.array:
  """Returns an array of a body's state or system."""
  return getattr(body.state if hasattr(body.state, name) else body.system, name)


def _cross(w, fields: tuple[str, ...], to_device: bool):
  for field in fields:
    there, here = field_of(w.body, field), w.host[field]
    if to_device:
      wp.copy(there, here)
    else:
      wp.copy(here, there)


def load(body: Body):
  """Loads the modules of a step on a body's device, compiling them where the cache has none."""
  mine = [module.__name__ for module in (coupling, window_nodes, window_slots)]
  for module in (*step.modules(body), *mine):
    wp.load_module(module, device=body.device)
    wp.load_module(module, device="cpu")
