"""Settings that every test needs before anything heavy is imported."""

import importlib.util
import os
import sys
from pathlib import Path

# One thread: sums keep their order, and workers that run side by side do not fight for the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Without a screen MuJoCo tries GLFW first and dies; EGL renders on the CPU as well.
os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("MPLBACKEND", "Agg")
# Kernels run on CPU tensors. It must be set before Triton is imported, by whatever imports it.
os.environ.setdefault("TRITON_INTERPRET", "1")

import hypothesis
import torch

torch.set_num_threads(1)

# `make sanitize` tests a compiled module of its own, in place of the installed one.
if folder := os.environ.get("OFFBEAT_TEST_CPU"):
    (library,) = Path(folder).glob("_cpu*.so")
    spec = importlib.util.spec_from_file_location("offbeat.kernels._cpu", library)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules[spec.name] = module

# `ci` draws the same examples every time; HYPOTHESIS_PROFILE=explore looks for new ones.
hypothesis.settings.register_profile("ci", derandomize=True, deadline=None, database=None)
hypothesis.settings.register_profile("explore", deadline=None, max_examples=1000)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))
