"""Mitsuba and the stages, one file a stage.

Dr.Jit, Open Image Denoise and torch share the cores of one process but keep pools of their own. By default the
OpenMP threads of torch spin for a while after each operation, which steals the cores from the renderer and makes
a network call after a render several times slower; so they are told to sleep, before torch is first imported.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
