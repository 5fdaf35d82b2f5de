"""`palpate library`: a program in C loads the plugin, and its steps are Python's to the bit."""

import os
import pathlib
import re
import subprocess
import sys
import sysconfig

import mujoco
import numpy as np
import pytest
from palpate.app import cli

PROGRAM = """
#include <mujoco/mujoco.h>
#include <stdio.h>
int main(int argc, char** argv) {
  char error[1000] = "";
  mj_loadPluginLibrary(argv[1]);
  mjModel* m = mj_loadXML(argv[2], NULL, error, sizeof(error));
  if (!m) { fprintf(stderr, "%s", error); return 1; }
  mjData* d = mj_makeData(m);
  d->ctrl[0] = -0.005;
  for (int i = 0; i < 200; i++) mj_step(m, d);
  fwrite(d->qpos, sizeof(mjtNum), m->nq, stdout);
  mj_deleteData(d);
  mj_deleteModel(m);
  return 0;
}
"""
FOLDER = pathlib.Path(mujoco.__file__).parent


@pytest.mark.skipif(
  sys.platform != "linux"
  or not sysconfig.get_config_var("Py_ENABLE_SHARED")
  or not (pathlib.Path(sysconfig.get_paths()["include"]) / "Python.h").exists(),
  reason="needs Linux and the shared library and headers of Python",
)
def test_a_program_in_c_steps_as_python_does(scenes, tmp_path, capsys):
  library, source, program = (tmp_path / name for name in ("libpalpate.so", "main.c", "main"))
  assert cli.main(["library", "-o", str(library)]) == 0
  assert re.search(rf"LD_LIBRARY_PATH={re.escape(str(FOLDER))}", capsys.readouterr().out)
  source.write_text(PROGRAM)
  (mujoco_library,) = FOLDER.glob("libmujoco.so.*")
  words = ["cc", source, f"-I{FOLDER / 'include'}", mujoco_library, "-o", program]
  subprocess.run(words, check=True)
  scene = tmp_path / "scene.xml"
  scene.write_text(scenes.press())
  model = mujoco.MjModel.from_xml_path(str(scene))
  data = mujoco.MjData(model)
  data.ctrl[0] = -0.005
  mujoco.mj_step(model, data, nstep=200)
  environment = os.environ | {"LD_LIBRARY_PATH": str(FOLDER)}
  done = subprocess.run([program, library, scene], capture_output=True, env=environment)
  assert done.returncode == 0, done.stderr
  assert data.ncon and abs(data.qpos[:-1]).max() > 1e-4
  np.testing.assert_array_equal(np.frombuffer(done.stdout), data.qpos)
