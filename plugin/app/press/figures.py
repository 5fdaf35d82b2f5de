"""Pictures of a press: force and displacement over time, and a film of it."""

import pathlib
from collections.abc import Sequence

import mujoco
import numpy as np
from palpate.engine import plugin as engine

from ..console import Interrupt, Progress, need
from ..draw import film
from .probe import Sample

_FORCE, _MOTION, _INK = "#c1442e", "#2f6f9f", "#333333"
# What a frame needs: an organ with windows has its shape in the plugin state.
_SHOWN = mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_PLUGIN


def plot(samples: Sequence[Sample], path: pathlib.Path, title: str):
  """Draws displacement of the node nearest to the probe and contact force against time.

  The two axes of figures 7.6-7.14 in V. Kotamraju's thesis (Simon Fraser University, 2008).
  """
  need("plot", "matplotlib")
  from matplotlib.figure import Figure

  time = np.array([s.time_s for s in samples])
  figure = Figure(figsize=(7.2, 4.0), dpi=150, layout="constrained")
  left = figure.subplots()
  right = left.twinx()
  for phase in ("press", "hold", "release"):
    when = [s.time_s for s in samples if s.phase == phase]
    if when:
      left.axvline(when[0], color="#bbbbbb", lw=0.8, ls=":")
      left.annotate(phase, (when[0], 1), (3, -3), xycoords=("data", "axes fraction"),
                    textcoords="offset points", va="top", fontsize=8, color="#777777")  # fmt: skip
  moved = 1e3 * np.array([s.node_m for s in samples])
  (motion,) = left.plot(time, moved, color=_MOTION, lw=1.8, label="displacement, nearest node")
  (force,) = right.plot(time, [s.force for s in samples], color=_FORCE, lw=1.4, label="force")
  left.set_xlabel("time [s]")
  left.set_ylabel("displacement [mm]", color=_MOTION)
  right.set_ylabel("contact force [N]", color=_FORCE)
  for axes, values in ((left, moved), (right, [s.force for s in samples])):
    axes.set_ylim(0, 1.18 * max(float(np.max(values)), 1e-9))
    axes.spines["top"].set_visible(False)
  left.set_xlim(time[0], time[-1] + 1e-9)
  left.set_title(title, fontsize=10, color=_INK, loc="left")
  left.legend(handles=[motion, force], loc="upper left", bbox_to_anchor=(0, 0.94), frameon=False,
              fontsize=8)  # fmt: skip
  figure.savefig(path)


def snapshot(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
  """Returns what a picture of the scene needs."""
  engine.sync(model, data)
  state = np.empty(mujoco.mj_stateSize(model, _SHOWN))
  mujoco.mj_getState(model, data, state, _SHOWN)
  return state.astype(np.float32)


def picture(model: mujoco.MjModel, data: mujoco.MjData, state: np.ndarray, path: pathlib.Path):
  """Draws a snapshot into a PNG file, without a screen."""
  with film.renderer(model, 1280, 960) as renderer, film.write(path, 1) as write:
    write(frame(model, data, state, renderer))


def shots(
  model: mujoco.MjModel,
  data: mujoco.MjData,
  states: Sequence[np.ndarray],
  path: pathlib.Path,
  rate: int,
  interrupt: Interrupt,
) -> int:
  """Films snapshots, without a screen; returns the number of frames.

  Args:
    model: compiled model
    data: of that model; its positions are changed
    states: snapshot of every frame
    path: file to write, .mp4 or .gif
    rate: frames per second
    interrupt: ends the film early
  """
  progress, frames = Progress(), 0
  with film.renderer(model, 640, 480) as renderer, film.write(path, rate) as write:
    for state in states:
      if interrupt.seen:
        break
      write(frame(model, data, state, renderer))
      frames += 1
      progress.show(f"filming {frames} of {len(states)}")
  progress.clear()
  return frames


def frame(model, data, state: np.ndarray, renderer: mujoco.Renderer) -> np.ndarray:
  """Returns the picture of a snapshot."""
  mujoco.mj_setState(model, data, state.astype(np.float64), _SHOWN)
  engine.place_windows(model, data)
  mujoco.mj_fwdPosition(model, data)
  renderer.update_scene(data, 0 if model.ncam else -1)
  return renderer.render()
