// A plugin library for programs in C and C++: the Python that has Palpate, inside of the program.
#define _GNU_SOURCE
#include <Python.h>
#include <dlfcn.h>
#include <stdio.h>

// MuJoCo loads the library before it compiles a model, so the plugin is registered in time.
__attribute__((constructor)) static void load(void) {
  if (Py_IsInitialized()) return;  // in Python `import palpate` registers it
  // Modules of Python expect its symbols to be global.
  Dl_info python;
  if (dladdr((void*)Py_Initialize, &python)) {
    dlopen(python.dli_fname, RTLD_LAZY | RTLD_GLOBAL | RTLD_NOLOAD);
  }
  PyConfig config;
  PyConfig_InitPythonConfig(&config);
  config.install_signal_handlers = 0;  // those are the program's
  PyStatus status = PyConfig_SetBytesString(&config, &config.program_name, PALPATE_PYTHON);
  if (!PyStatus_Exception(status)) status = Py_InitializeFromConfig(&config);
  PyConfig_Clear(&config);
  if (PyStatus_Exception(status)) {
    fprintf(stderr, "palpate: Python does not start: %s\n", status.err_msg);
    return;
  }
  if (PyRun_SimpleString("import palpate")) {
    fprintf(stderr, "palpate: %s cannot import it, see above\n", PALPATE_PYTHON);
  }
  PyEval_SaveThread();  // so that any thread of the program can step
}
