"""Draws the pictures of the home page: each exercise after its expert has worked for some time.

python docs/drawing/cards.py            # all
python docs/drawing/cards.py grasp cut  # those with one of these words in their name
"""

import pathlib
import sys

import imageio.v3 as imageio
import mujoco
from palpate import tasks
from palpate.tasks.core import performer

FOLDER = pathlib.Path(__file__).parents[2] / "plugin/app/live/page/static/cards"
SIZE, SECONDS = (250, 400), 1.0
# Levels that begin alike are drawn where their last throw waits over the others.
LATER = {"suture_extracorporeal_standard": 2.3, "suture_extracorporeal_hard": 4.3}
LATER |= {"suture_knot_easy": 4.0, "suture_knot_standard": 6.0}
LATER |= {"suture_stitch_easy": 5.0, "suture_stitch_standard": 25.0}

for domain, task in tasks.ALL_TASKS:
  name = f"{domain}_{task}"
  if len(sys.argv) > 1 and not any(word in name for word in sys.argv[1:]):
    continue
  env = tasks.load(domain, task, task_kwargs={"random": 0})
  timestep, act = env.reset(), performer.make(env)
  while env.physics.time() < LATER.get(name, SECONDS) and not timestep.last():
    timestep = env.step(act(timestep))
  with mujoco.Renderer(env.physics.model.ptr, *SIZE) as renderer:
    renderer.update_scene(env.physics.data.ptr, "laparoscope")
    imageio.imwrite(FOLDER / f"{name}.webp", renderer.render(), quality=75)
  print(name, flush=True)
