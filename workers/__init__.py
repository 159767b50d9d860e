"""Mitsuba and the stages, one file a stage.

Dr.Jit (whose threads Open Image Denoise computes on) and torch share the cores of one process but keep pools of
their own, and each pool's idle threads spin for a while in case more work comes: they steal the cores from whoever
computes next. So torch's OpenMP threads are told, before torch is first imported, to spin only as long as the gap
between two layers, and Dr.Jit's threads are sent home while a network runs (`workers.backend.pool_at_rest`).
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "10000")
