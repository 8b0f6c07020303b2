"""Run a module on one core: ``python -m benchmarks.speed.pinned CORE MODULE ARGUMENT...``.

The core is chosen before anything is imported: XLA, OpenCV and BLAS make as many threads as they find cores.
"""

import os
import runpy
import sys

if __name__ == "__main__":
    core, module, *arguments = sys.argv[1:]
    os.sched_setaffinity(0, {int(core)})
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
