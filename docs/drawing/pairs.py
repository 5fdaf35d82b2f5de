# mujoco ships its bindings without type stubs:
# pyright: reportAttributeAccessIssue=false
"""Draws MuJoCo's pictures of exercises beside those of a batch's camera, and how well they agree.

python docs/drawing/pairs.py

Experts act for some seconds; then both draw the same state. Pairs go to docs/pictures, and the
table between the page's two comments is written anew.
"""

import pathlib
import re

import imageio.v3 as imageio
import mujoco
import numpy as np
import palpate.batch
from palpate.tasks import suite
from palpate.tasks.core import performer, scenes

PAGE = pathlib.Path(__file__).parents[1] / "pixels.md"
SIZE = 640  # [pixels]
# Exercises, and for how long their experts act [s].
SHOWN = {"grasp/easy": 4.0, "cut/easy": 8.0, "dissect/easy": 6.0, "trace/easy": 3.0}
_NEAR = 1e-3  # of depth [m]


def rendered(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, np.ndarray]:
  """Returns what MuJoCo's renderer draws."""
  flag = mujoco.mjtRndFlag
  with mujoco.Renderer(model, SIZE, SIZE) as renderer:
    renderer.update_scene(data, scenes.CAMERA)
    out = {"pixels": renderer.render().copy()}
    flags = renderer.scene.flags
    flags[flag.mjRND_SKYBOX], flags[flag.mjRND_SEGMENT] = 0, 1
    renderer.enable_depth_rendering()
    out["depth"] = renderer.render().copy()
    renderer.disable_depth_rendering()
    flags[flag.mjRND_SKYBOX], flags[flag.mjRND_SEGMENT] = 1, 0
    renderer.enable_segmentation_rendering()
    return out | {"segmentation": renderer.render().copy()}


def pair(name: str, seconds: float) -> tuple[np.ndarray, str]:
  """Returns MuJoCo's picture beside the camera's, and a row of the table."""
  env = suite.load(*name.split("/"), task_kwargs={"random": 0})
  act, step = performer.make(env), env.reset()
  while not step.last() and env.physics.time() < seconds:
    step = env.step(act(step))
  model, data = env.physics.model.ptr, env.physics.data.ptr
  batch = palpate.batch.make(model, 1, "cpu")
  batch.set_state(0, data)
  seen = batch.camera(scenes.CAMERA, SIZE, SIZE, ("pixels", "depth", "segmentation")).draw()
  found, expected = {k: v.numpy()[0] for k, v in seen.items()}, rendered(model, data)
  same = (found["segmentation"] == expected["segmentation"]).all(axis=-1).mean()
  near = (np.abs(found["depth"] - expected["depth"]) < _NEAR).mean()
  off = np.abs(found["pixels"].astype(float) - expected["pixels"]).mean()
  row = f"| `{name}` | {100 * same:.2f} % | {100 * near:.2f} % | {off:.1f} of 255 |"
  return np.concatenate([expected["pixels"], found["pixels"]], axis=1), row


rows = [
  "| exercise | segmentation agrees | depth within 1 mm | colour differs by |", "|---|---|---|---|",
]  # fmt: skip
for name, seconds in SHOWN.items():
  picture, row = pair(name, seconds)
  path = PAGE.parent / "pictures" / f"pair_{name.replace('/', '_')}.webp"
  imageio.imwrite(path, picture, quality=90)
  rows.append(row)
text, table = PAGE.read_text(encoding="utf-8"), "\n".join(rows)
between = re.compile(r"(<!-- pairs -->\n).*?(<!-- end -->)", re.DOTALL)
text = between.sub(rf"\g<1>{table}\n\g<2>", text)
PAGE.write_text(text, encoding="utf-8")
print(table)
