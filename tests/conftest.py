"""One place for what every test process sets before torch, Dr.Jit and matplotlib are imported."""

import os

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OMP_NUM_THREADS", "2")
