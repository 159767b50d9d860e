"""The process behind `lightwell worker`: a Dask nanny with one worker process, for as long as it is wanted.

The scheduler may go away and come back; the process waits for it, as everything it did is in the store.
"""

import asyncio
import logging
import os
import signal

from service.cluster import DASK_CONFIG, gpu_resources
from workers.thread_policy import ThreadPolicy

log = logging.getLogger("lightwell.worker")
SECONDS_BETWEEN_TRIES = 1.0
DEATH_TIMEOUT_SECONDS = 20


def run_worker(scheduler: str, *, threads: ThreadPolicy, name: str | None, memory_limit: str, folder: str) -> None:
    """Works for a scheduler until SIGINT or SIGTERM.

    Args:
        scheduler: its address, "tcp://host:8786".
        threads: of the worker process.
        name: by which the engine tells workers apart; host and process id by default.
        memory_limit: bytes as Dask reads them ("auto", "8 GiB"); the process is replaced above 0.95 of it.
        folder: for Dask's own scratch files.
    """
    import dask

    os.environ.update(threads.environment)
    with dask.config.set(DASK_CONFIG):
        asyncio.run(_serve(scheduler, name or f"{os.uname().nodename}-{os.getpid()}", memory_limit, folder, threads))


async def _serve(scheduler: str, name: str, memory_limit: str, folder: str, threads: ThreadPolicy) -> None:
    from distributed import Nanny

    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    while not stopped.is_set():
        try:
            async with Nanny(
                scheduler, nthreads=1, name=name, memory_limit=memory_limit, local_directory=folder,
                resources=gpu_resources(), env=threads.environment, death_timeout=DEATH_TIMEOUT_SECONDS,
            ) as nanny:  # fmt: skip
                print(f"worker {name} works for {scheduler}", flush=True)
                ended = asyncio.ensure_future(nanny.finished())
                asked = asyncio.ensure_future(stopped.wait())
                await asyncio.wait([ended, asked], return_when=asyncio.FIRST_COMPLETED)
                asked.cancel()
        except Exception as error:  # of a scheduler that is not there: many kinds
            log.warning("worker %s: %s must answer, got %s; trying again", name, scheduler, type(error).__name__)
        if not stopped.is_set():
            await asyncio.sleep(SECONDS_BETWEEN_TRIES)
