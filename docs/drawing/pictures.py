"""Draws the pages' pictures anew, each by the command that stands beside it.

python docs/drawing/pictures.py            # all
python docs/drawing/pictures.py grasp cut  # those with one of these words in their path
"""

import pathlib
import re
import shlex
import subprocess
import sys

FOLDER = pathlib.Path(__file__).parents[1]
COMMAND = r"`(?:palpate (render [^`]+)|python (docs/[^`]+))`"
PICTURE = re.compile(r"!\[[^]]*\]\(([^)]+)\)\s*\|?\s*" + COMMAND)

for page in ("gallery.md", "pixels.md"):
  for path, command, script in PICTURE.findall((FOLDER / page).read_text(encoding="utf-8")):
    if len(sys.argv) > 1 and not any(word in path for word in sys.argv[1:]):
      continue
    words = ["-m", "palpate", *shlex.split(command)] if command else [script]
    if command:
      words[words.index("-o") + 1] = str((FOLDER / path).resolve())
    subprocess.run([sys.executable, *words], check=True, cwd=FOLDER.parent)
