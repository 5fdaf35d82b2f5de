"""`palpate library`: builds a plugin library for programs in C and C++, which holds this Python.

The program calls what `import palpate` registers, so MJCF and results are the same to the bit.
"""

import argparse
import json
import pathlib
import shlex
import subprocess
import sys
import sysconfig

from palpate import register

from .console import CommandError, output


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.add_argument(
    "-o", "--out", metavar="FILE", default="libpalpate.so", help="the library (%(default)s)"
  )


def main(args: argparse.Namespace) -> int:
  """Compiles the library and says how a program loads it."""
  if sys.platform != "linux":
    raise CommandError(f"library: this is {sys.platform}, tried on Linux alone", code=1)
  find = sysconfig.get_config_var
  if not find("Py_ENABLE_SHARED"):
    raise CommandError(f"library: {sys.executable} is not built as a shared library", code=1)
  register()
  import mujoco

  out = output("out", args.out, (".so",))
  folder = find("LIBDIR")
  words = [
    *shlex.split(find("CC")), "-shared", "-fPIC", "-O2", "-o", str(out),
    str(pathlib.Path(__file__).with_name("library.c")), f"-I{sysconfig.get_paths()['include']}",
    f"-DPALPATE_PYTHON={json.dumps(sys.executable)}",
    f"-L{folder}", f"-Wl,-rpath,{folder}", f"-lpython{find('LDVERSION')}",
  ]  # fmt: skip
  try:
    done = subprocess.run(words, capture_output=True, text=True)
  except FileNotFoundError:
    raise CommandError(f"library: no compiler {words[0]!r}, expected one of C", code=1) from None
  if done.returncode:
    raise CommandError(f"library: {done.stderr.strip() or 'the compiler failed'}", code=1)
  print(f"{out}: load it by mj_loadPluginLibrary, or put it in the folder `mujoco_plugin` beside "
        "the program")  # fmt: skip
  print("The program must run with the libmujoco of this Python:")
  print(f"  LD_LIBRARY_PATH={shlex.quote(str(pathlib.Path(mujoco.__file__).parent))} PROGRAM")
  return 0
