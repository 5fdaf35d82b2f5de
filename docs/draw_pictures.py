"""Draws the gallery's pictures anew, each by the command that stands beside it on the page.

python docs/draw_pictures.py            # all
python docs/draw_pictures.py grasp cut  # those with one of these words in their path
"""

import pathlib
import re
import shlex
import subprocess
import sys

PAGE = pathlib.Path(__file__).with_name("gallery.md")
PICTURE = re.compile(r"!\[[^]]*\]\(([^)]+)\)\s*\|?\s*`palpate (render [^`]+)`")

for path, command in PICTURE.findall(PAGE.read_text(encoding="utf-8")):
  if len(sys.argv) > 1 and not any(word in path for word in sys.argv[1:]):
    continue
  words = shlex.split(command)
  words[words.index("-o") + 1] = str((PAGE.parent / path).resolve())
  subprocess.run([sys.executable, "-m", "palpate", *words], check=True, cwd=PAGE.parents[1])
