"""Writes the moving picture of the README, a film with fewer frames.

palpate exercise dissect/easy --film dissect.mp4 --size 1280x960
python docs/drawing/moving_picture.py dissect.mp4 docs/pictures/dissect_easy.webp
"""

import sys

import imageio.v2 as imageio
from PIL import Image

source, target = sys.argv[1:]
with imageio.get_reader(source) as film:
  step = 2
  delay = 1000 * step / film.get_meta_data()["fps"]  # [ms]
  first, *rest = [Image.fromarray(frame) for k, frame in enumerate(film) if k % step == 0]
delays = [delay] * len(rest) + [1000]  # the end stays for a second
first.save(
  target, save_all=True, append_images=rest, duration=[*map(round, delays)], loop=0, quality=40
)
