"""Pictures a second of batches' cameras, control steps a second with pixels, and mujoco_warp's.

    palpate bench pictures --device cuda:0

`camera` draws the laparoscope's picture of an exercise in its abdomen in every world, what moved
brought up to date before: bodies, organs' vertices and normals. `exercise` takes
control steps of the vectorised exercise with random actions, with and without `pixels`.
`mujoco_warp` is its renderer on the same device, of the same surroundings as meshes and of the
organ's skin as a flex, beside a tool of 14 shapes; its trees are refitted before each picture.
On CUDA work is replayed from a graph. `export` observes `pixels`, `depth` and `segmentation` of the
single environment after a control step, as `palpate export` does, with each renderer by turns:
OpenGL where there is one, and Palpate's on the processor and on CUDA; a second is of the median.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import pathlib
import time
import warnings

import mujoco
import mujoco_warp as mjw
import numpy as np
import palpate.batch
import warp as wp
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate.tasks import suite
from palpate.tasks.batch.vector import Exercises
from palpate.tasks.core import scenes

REPEATS = 10
STEPS = 40  # control steps of a renderer
EXPORTED = ["pixels", "depth", "segmentation"]
_NUMBERS = {"observations": ["sensors"]}
_MESH, _TEXTURE = mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtTexture.mjTEXTURE_2D
_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)


def spec_of(task: str) -> mujoco.MjSpec:
  """Returns the scene of an exercise."""
  found = suite.load(*task.split("/"), task_kwargs={"random": 0}).task
  return found.spec(found.variants[0])


def clock(work, device) -> float:
  """Returns what work takes, replayed on CUDA [s]."""
  work()
  again = work
  if device.is_cuda:
    with wp.ScopedCapture(device) as capture:
      work()
    again = lambda: wp.capture_launch(capture.graph)  # noqa: E731
    again()
  wp.synchronize_device(device)
  start = time.perf_counter()
  for _ in range(REPEATS):
    again()
  wp.synchronize_device(device)
  return (time.perf_counter() - start) / REPEATS


def draw(task: str, nworld: int, size: int, device: str) -> list[dict]:
  """Returns what pictures of a camera take."""
  batch = palpate.batch.make(spec_of(task), nworld, device)
  free = batch.device.free_memory if batch.device.is_cuda else 0
  camera = batch.camera(scenes.CAMERA, size, size)
  camera.draw()
  used = (free - batch.device.free_memory) / nworld if batch.device.is_cuda else float("nan")
  taken = clock(camera.launch, batch.device)
  return [{"rate": nworld / taken, "world_kB": used / 1e3}]


def act(task: str, nworld: int, size: int, device: str) -> list[dict]:
  """Returns what control steps take, with pixels where these have a size."""
  seen = {"observations": ["sensors", "pixels"], "pixels": (size, size)}
  output = "torch" if "cuda" in device else "numpy"
  env = Exercises(nworld, task, device=device, output=output, **(seen if size else _NUMBERS))
  env.reset(seed=0)
  actions = np.random.RandomState(0).uniform(-0.3, 0.3, (4, *env.action_space.shape))
  rows = [wp.array(each, dtype=float, device=env.device) for each in actions]
  if output == "torch":
    rows = [wp.to_torch(row) for row in rows]
  for row in rows:
    env.step(row)
  start = time.perf_counter()
  for k in range(2 * REPEATS):
    env.step(rows[k % len(rows)])
  wp.synchronize_device(env.device)
  taken = (time.perf_counter() - start) / (2 * REPEATS)
  return [{"rate": nworld / taken, "world_kB": float("nan")}]


def flexed(model: mujoco.MjModel, vert: np.ndarray, face: np.ndarray) -> mujoco.MjModel:
  """Returns a scene that mujoco_warp draws: skins as meshes, the organ's as a flex, and a tool."""
  spec, head = mujoco.MjSpec(), model.vis.headlight
  spec.stat.extent, own = model.stat.extent, spec.visual.headlight
  spec.visual.map.znear, spec.visual.map.zfar = model.vis.map.znear, model.vis.map.zfar
  own.ambient, own.diffuse, own.specular = head.ambient, head.diffuse, head.specular
  for k in np.flatnonzero(model.tex_type == _TEXTURE):
    shape = model.tex_height[k], model.tex_width[k], model.tex_nchannel[k]
    data = model.tex_data[model.tex_adr[k] : model.tex_adr[k] + np.prod(shape)]
    spec.add_texture(
      name=f"t{k}", type=_TEXTURE, height=shape[0], width=shape[1], nchannel=shape[2], data=data
    )
  for k in range(model.nmat):
    made = spec.add_material(
      name=f"m{k}", rgba=model.mat_rgba[k], specular=model.mat_specular[k],
      shininess=model.mat_shininess[k],
    )  # fmt: skip
    if model.mat_texid[k, _RGB] >= 0:
      roles = list(made.textures)
      roles[_RGB] = f"t{model.mat_texid[k, _RGB]}"
      made.textures, made.texrepeat = roles, model.mat_texrepeat[k]
  world = spec.worldbody
  for k in range(model.nskin):
    if mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SKIN, k) == f"{scenes.ORGAN}_skin":
      continue
    rows = slice(model.skin_vertadr[k], model.skin_vertadr[k] + model.skin_vertnum[k])
    faces = slice(model.skin_faceadr[k], model.skin_faceadr[k] + model.skin_facenum[k])
    start = model.skin_texcoordadr[k]
    spec.add_mesh(
      name=f"s{k}", uservert=model.skin_vert[rows].ravel(), userface=model.skin_face[faces].ravel(),
      usertexcoord=model.skin_texcoord[start : start + model.skin_vertnum[k]].ravel(),
      inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )  # fmt: skip
    world.add_geom(
      type=_MESH, meshname=f"s{k}", material=f"m{model.skin_matid[k]}", contype=0, conaffinity=0
    )
  eye = model.camera(scenes.CAMERA)
  world.add_camera(name=scenes.CAMERA, pos=eye.pos, quat=eye.quat, fovy=float(eye.fovy[0]))
  for k in range(model.nlight):
    world.add_light(
      pos=model.light_pos[k], dir=model.light_dir[k], type=int(model.light_type[k]),
      cutoff=model.light_cutoff[k], exponent=model.light_exponent[k], castshadow=False,
      attenuation=model.light_attenuation[k], ambient=model.light_ambient[k],
      diffuse=model.light_diffuse[k], specular=model.light_specular[k],
    )  # fmt: skip
  world.add_body(name="organ")
  tool = world.add_body(name="tool", pos=[0.03, 0.05, 0.09])
  tool.add_freejoint()
  for k in range(14):
    tool.add_geom(
      type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.0025, 0.005, 0], pos=[0, 0, 0.01 * k],
      contype=0, conaffinity=0,
    )  # fmt: skip
  flex = spec.add_flex(name="organ", dim=2, radius=1e-4, rgba=[0.6, 0.2, 0.2, 1])
  # mujoco_warp has no flex on one body alone: a vertex is another's.
  vert[-1] -= tool.pos
  flex.vert, flex.elem = vert.ravel(), face.ravel()
  flex.vertbody = ["organ"] * (len(vert) - 1) + ["tool"]
  flex.contype = flex.conaffinity = 0
  with warnings.catch_warnings():
    warnings.filterwarnings("ignore", ".*has no equality constraints or passive forces")
    return spec.compile()


def peer(task: str, nworld: int, size: int, device: str) -> list[dict]:
  """Returns what pictures of mujoco_warp's renderer take."""
  batch = palpate.batch.make(spec_of(task), 1, "cpu")
  vert, face = batch.camera(scenes.CAMERA, size, size).skin(scenes.ORGAN)
  model = flexed(batch.model, vert, face)
  target = wp.get_device("cpu" if "cpu" in device else device)
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  with wp.ScopedDevice(target):
    m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=nworld, nconmax=4, njmax=4)
    context = mjw.create_render_context(model, nworld, (size, size), True, False, False)

    def work():
      mjw.refit_bvh(m, d, context)
      mjw.render(m, d, context)

    return [{"rate": nworld / clock(work, target), "world_kB": float("nan")}]


def export(task: str, nworld: int, size: int, device: str) -> list[dict]:
  """Returns what pictures of the single environment take, a row a renderer."""
  envs = {}
  for renderer in ("opengl", "cpu", *([device] if "cuda" in device else [])):
    options = {"random": 0, "observations": EXPORTED, "pixels": (size, size), "renderer": renderer}
    env = suite.load(*task.split("/"), task_kwargs=options)
    with contextlib.suppress(Exception):  # without OpenGL each backend has an error of its own
      env.reset()
      envs[renderer] = env
  random, times = np.random.RandomState(0), collections.defaultdict(list)
  for _ in range(STEPS):
    action = random.uniform(-0.3, 0.3, next(iter(envs.values())).action_spec().shape)
    for renderer, env in envs.items():
      if env.step(action).last():
        env.reset()
      start = time.perf_counter()
      env.task.get_observation(env.physics)
      times[renderer].append(time.perf_counter() - start)
  return [
    {"device": renderer, "rate": 1.0 / np.median(taken), "world_kB": float("nan")}
    for renderer, taken in times.items()
  ]


KINDS = {"camera": draw, "exercise": act, "mujoco_warp": peer, "export": export}


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--device", default="warp-cpu", help="warp-cpu or cuda:0 (%(default)s)")
  add("--tasks", nargs="+", default=["touch/easy", "grasp/easy"])
  add("--kinds", nargs="+", choices=KINDS, default=[*KINDS], help="what to time (all)")
  add("--worlds", type=int, help="2 on the CPU, 4096 on CUDA")
  add("--sizes", type=int, nargs="+", default=[64, 84, 128], help="of pictures (%(default)s)")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a kind, exercise and size; 0 is without pictures."""
  n = args.worlds or (4096 if "cuda" in args.device else 2)
  named = [("camera", task, size) for task in args.tasks for size in args.sizes]
  named += [("mujoco_warp", args.tasks[0], size) for size in args.sizes]
  named += [("exercise", task, size) for task in args.tasks for size in (84, 0)]
  named += [("export", args.tasks[0], size) for size in (84, 240)]
  cases = [
    {"case": f"{kind}-{task}-{size}", "kind": kind, "task": task, "size": size}
    | {"nworld": 1 if kind == "export" else n, "device": args.device}
    for kind, task, size in named
    if kind in args.kinds
  ]
  return [cases[:1] if args.short else cases]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the rows of a case."""
  named = {name: case[name] for name in ("task", "nworld", "size", "device")}
  return [{"kind": case["kind"], **named, **row} for row in KINDS[case["kind"]](**named)]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""

  def of(kind: str, size: int) -> list[Row]:
    return [r for r in rows if r["kind"] == kind and r["size"] == size]

  out = [f"`{r['task']}` at 84 x 84: {r['rate']:,.0f} pictures a second" for r in of("camera", 84)]
  out = out[:1] + [f"mujoco_warp's renderer {r['rate']:,.0f}" for r in of("mujoco_warp", 84)]
  lines = ["; ".join(out)]
  acted = [f"`{r['task']}` {r['rate']:,.0f}" for r in of("exercise", 84)]
  lines += [f"Control steps a second with `pixels` of 84 x 84: {', '.join(acted)}"] if acted else []
  ratios = []
  for size in sorted({r["size"] for r in rows if r["kind"] == "export"}):
    first, *others = of("export", size)
    ratios += [
      f"{r['device']} {r['rate'] / first['rate']:.1f} times {first['device']} at {size} x {size}"
      for r in others
    ]
  lines += [f"Pictures a second of `palpate export`: {', '.join(ratios)}"] if ratios else []
  return [f"{line}." for line in lines if line]


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page."""
  head = ["what", "exercise", "drawn by", "worlds", "size", "a second", "a world takes"]
  lines = plots.table(
    head,
    [
      [r["kind"], r["task"], r["device"], r["nworld"], r["size"] or "none", f"{r['rate']:,.0f}",
       "" if np.isnan(r["world_kB"]) else f"{r['world_kB']:.0f} kB"]
      for r in rows
    ],
  )  # fmt: skip
  title = "Pictures in many worlds"
  shown = [r for r in rows if r["kind"] in ("camera", "mujoco_warp")]
  names = [f"{r['kind']} {r['task']} {r['size']}" for r in shown]
  rates = {"": [r["rate"] for r in shown]}
  picture = plots.bars(path.with_suffix(".png"), title, names, rates, "pictures a second")
  return results.Page(title, finding(rows), lines, [picture])


BENCH = Bench("pictures", stages, run, report=report, arguments=arguments, file="pictures")
