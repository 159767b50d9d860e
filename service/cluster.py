"""The Dask cluster that an engine uses: one of its own on this machine, or a scheduler that is there already."""

import contextlib
import logging
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from service.errors import ServiceError
from workers.thread_policy import ThreadPolicy

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

log = logging.getLogger("lightwell.engine")

CONNECT_SECONDS = 5.0
PRELOAD = "service.worker_preload"

# Of every process of ours that takes part in a cluster.
DASK_CONFIG: dict[str, Any] = {
    # A unit whose worker died comes back to the engine, which counts attempts, on other workers where there are some.
    "distributed.scheduler.allowed-failures": 0,
    # A worker holds the unit that it runs and no other: one that dies takes nothing else with it.
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.scheduler.work-stealing": False,
    # A long kernel may keep a process from answering.
    "distributed.scheduler.worker-ttl": "30 minutes",
    # Results are keys: Dask's own memory control could only pause a worker for ever. Recycling does that work.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.admin.tick.limit": "1h",
    "distributed.worker.preload": [PRELOAD],
    # These would leak OMP_NUM_THREADS=1 into the service's own process; see workers/thread_policy.py.
    "distributed.nanny.pre-spawn-environ": {},
}

NO_DASHBOARD = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}


class SchedulerError(ServiceError, OSError):
    """No scheduler answers at the address."""


class Cluster:
    """Workers, and a client that is connected again whenever the scheduler comes back.

    Args:
        scheduler: address of one that is there ("tcp://host:8786"); None starts a cluster of processes here.
        num_workers: processes of the own cluster.
        threads: of each of its processes; by default they share the cores, and training takes all of them.
        on_event: told of what units send (see `service.unit_task.TOPIC`), on Dask's own thread.
    """

    def __init__(
        self, scheduler: str | None, num_workers: int, threads: ThreadPolicy | None,
        on_event: Callable[[dict[str, Any]], None],
    ) -> None:  # fmt: skip
        self._address, self._on_event = scheduler, on_event
        self._own: LocalCluster | None = None
        self._client: Client | None = None
        self.allowed_failures = 0
        if scheduler is None:
            cores = os.cpu_count() or 1
            self._start(num_workers, threads or ThreadPolicy(max(1, cores // num_workers), cores))

    def _start(self, num_workers: int, threads: ThreadPolicy) -> None:
        import dask
        from distributed import LocalCluster

        environment = threads.environment
        with dask.config.set(DASK_CONFIG):
            self._own = LocalCluster(
                n_workers=num_workers, threads_per_worker=1, processes=True, scheduler_kwargs=NO_DASHBOARD,
                env=environment, resources=gpu_resources(), silence_logs=logging.CRITICAL,
            )  # fmt: skip
            self._address = self._own.scheduler_address

    def client(self) -> "Client":
        """The client, connected.

        Raises:
            SchedulerError: no scheduler answers.
        """
        from distributed import Client

        if self._client is not None and self._client.status == "running":
            return self._client
        self.drop_client()
        try:
            client = Client(self._address, timeout=CONNECT_SECONDS, set_as_default=False, name="lightwell")
            client.subscribe_topic(_topic(), lambda event: self._on_event(event[1]))
            self.allowed_failures = int(client.run_on_scheduler(_allowed_failures))
        except (OSError, TimeoutError) as error:
            raise SchedulerError(
                f"scheduler must answer at {self._address}, got {type(error).__name__}; start it, or check the address"
            ) from error
        self._client = client
        return client

    def drop_client(self) -> None:
        """Ends the connection; the next call of `client` makes a new one."""
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(Exception):  # of a scheduler that is gone
                client.close(timeout=1)

    def workers(self) -> dict[str, dict[str, Any]]:
        """Address to {"name", "nthreads", "resources", ...} of each connected worker.

        Raises:
            SchedulerError: no scheduler answers.
        """
        client = self.client()
        try:
            return dict(client.scheduler_info()["workers"])
        except (OSError, TimeoutError) as error:
            self.drop_client()
            raise SchedulerError(f"scheduler must answer at {self._address}, got {type(error).__name__}") from error

    def restart_worker(self, address: str) -> None:
        """Replaces a worker's process; nothing happens where it is gone already."""
        with contextlib.suppress(Exception):
            self.client().restart_workers([address], timeout=20, raise_for_error=False)

    def close(self) -> None:
        """Ends the own cluster's processes; one that was there already goes on."""
        self.drop_client()
        if self._own is not None:
            self._own.close(timeout=10)


def gpu_resources() -> dict[str, float]:
    """{"gpu": 1} where training could use one; asked of the driver, so that torch need not be imported."""
    return {"gpu": 1.0} if os.path.exists("/proc/driver/nvidia/version") else {}


def _topic() -> str:
    from service.unit_task import TOPIC

    return TOPIC


def _allowed_failures(dask_scheduler: Any) -> int:
    return int(dask_scheduler.allowed_failures)
