"""How many threads each library of one process gets: set once, on purpose.

Dr.Jit, torch and OpenMP keep pools of their own, and Dask would set OMP_NUM_THREADS=1 behind everyone's back. Units
that run many at once (bake, render) get few threads each; training and evaluation run alone and get more.
"""

import os
from dataclasses import dataclass

from workers.errors import WorkerError

VARIABLE = "LIGHTWELL_WORKER_THREADS"
WIDE_STAGES = ("train", "evaluate")


@dataclass(frozen=True)
class ThreadPolicy:
    """Threads of a worker process.

    Attributes:
        narrow: for the stages whose units run side by side.
        wide: for `WIDE_STAGES`. Sums of torch depend on it: compare bytes only between equal ones.

    Raises:
        WorkerError: a number below 1.
    """

    narrow: int = 1
    wide: int = 1

    def __post_init__(self) -> None:
        if self.narrow < 1 or self.wide < 1:
            raise WorkerError(f"threads must be at least 1, got {self.narrow} and {self.wide}")

    @property
    def environment(self) -> dict[str, str]:
        """Variables that a process must have before it imports torch or Dr.Jit."""
        threads = str(self.wide)
        return {VARIABLE: f"{self.narrow},{self.wide}", "OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads,
                "OPENBLAS_NUM_THREADS": str(self.narrow), "OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "10000",
                "MPLBACKEND": "Agg"}  # fmt: skip

    @classmethod
    def from_environment(cls) -> "ThreadPolicy | None":
        """The policy that this process was started with; None where nobody set one."""
        text = os.environ.get(VARIABLE)
        if text is None:
            return None
        narrow, _, wide = text.partition(",")
        return cls(int(narrow), int(wide))

    def apply(self, stage: str) -> None:
        """Gives a stage its threads. Imports Dr.Jit and torch."""
        import torch

        from workers.backend import set_num_threads

        threads = self.wide if stage in WIDE_STAGES else self.narrow
        set_num_threads(threads)
        torch.set_num_threads(threads)
