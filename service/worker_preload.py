"""First thing that a worker process imports: thread policy and LLVM are settled before torch or Dr.Jit are loaded.

Dask runs it by `distributed.worker.preload`; importing it is what counts.
"""

import os

import workers  # noqa: F401  # sleeping OpenMP threads
from workers.thread_policy import ThreadPolicy

_policy = ThreadPolicy.from_environment()
if _policy is not None:
    os.environ.update(_policy.environment)


def dask_setup(worker: object) -> None:
    """Nothing more is needed: `workers.backend` selects LLVM when the first unit imports it."""
    del worker
