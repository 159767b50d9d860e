"""Units in flight: each one once, however many jobs want it; attempts counted, failures set aside.

One thread owns the Dask client. Jobs ask for units and are told how they ended through a queue of their own. Where the
scheduler goes away everything in flight is asked for again when it is back: the store knows what was done.
"""

import collections
import logging
import queue
import threading
import time
from typing import TYPE_CHECKING, Any

from service.cluster import Cluster, SchedulerError
from service.unit_request import Listener, Outcome, UnitRequest, UnitTotals
from service.unit_task import Executor, Recycling, UnitError, run_unit
from workers.errors import StoppedError
from workers.job_spec import JobSpec
from workers.thread_policy import ThreadPolicy
from workers.units import Unit

if TYPE_CHECKING:
    from distributed import Future

log = logging.getLogger("lightwell.engine")

MAX_ATTEMPTS = 3
MAX_DEATHS_NEARBY = 12  # of workers that held a unit but had not said that they began it
SECONDS_TO_LEAVE = 4.0  # for a unit that nobody wants; Dask then gives its process as long again before it is killed
TICK_SECONDS = 0.5
_ANSWERED = ("census", "inventory", "train", "evaluate")  # stages whose answer somebody reads; the others' is the store
_GPU_STAGE = "train"


class UnitBoard:
    """Asks a cluster for units on behalf of jobs.

    Args:
        store_url: where units go.
        executor: does their work, on the workers.
        scheduler, num_workers, threads: see `Cluster`.
        recycling: when worker processes are replaced.
    """

    def __init__(
        self, store_url: str, executor: Executor, *, scheduler: str | None, num_workers: int,
        threads: ThreadPolicy | None, recycling: Recycling,
    ) -> None:  # fmt: skip
        self._store_url, self._executor, self._recycling = store_url, executor, recycling
        self._inbox: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._entries: dict[str, UnitRequest] = {}
        self._keys: dict[str, UnitRequest] = {}
        self._waiting: collections.deque[UnitRequest] = collections.deque()
        self._leaving: dict[str, tuple[str, float]] = {}
        self.totals = UnitTotals()
        self._connected = True
        self._slots, self._has_gpu = num_workers, False
        self._closed = threading.Event()
        self._cluster = Cluster(scheduler, num_workers, threads, lambda event: self._inbox.put(("event", event)))
        self._cluster.client()
        self._thread = threading.Thread(target=self._work, name="lightwell-units", daemon=True)
        self._thread.start()

    # ------------------------------------------- asked by the jobs' threads -------------------------------------------

    @property
    def slots(self) -> int:
        """Units that the connected workers run at once."""
        return self._slots

    def request(self, identity: str, unit: Unit, spec: JobSpec, listener: Listener) -> None:
        """Wants a unit; where somebody else wants it too, it is computed once for both."""
        with self._lock:
            entry = self._entries.get(identity)
            if entry is not None:
                entry.listeners.add(listener)
                return
            entry = self._entries[identity] = UnitRequest(identity, unit, spec, {listener})
        self._inbox.put(("wait", entry))

    def withdraw(self, listener: Listener) -> None:
        """Wants nothing any more. Units that nobody else wants end after their pass."""
        with self._lock:
            wanted = [entry for entry in self._entries.values() if listener in entry.listeners]
            for entry in wanted:
                entry.listeners.discard(listener)
                if not entry.listeners:
                    del self._entries[entry.identity]
                    self._inbox.put(("release", entry))

    def close(self) -> None:
        """Ends the cluster where it is our own, else what runs there for us."""
        self._closed.set()
        self._inbox.put(("wake",))
        self._thread.join(timeout=15)
        self._cluster.close()

    # ------------------------------------------------ the board's thread ----------------------------------------------

    def _work(self) -> None:
        next_tick = 0.0
        while not self._closed.is_set():
            try:
                item = self._inbox.get(timeout=TICK_SECONDS)
            except queue.Empty:
                item = ("wake",)
            try:
                self._handle(item)
                self._fill()
                if time.monotonic() >= next_tick:
                    next_tick = time.monotonic() + TICK_SECONDS
                    self._tick()
            except SchedulerError as error:
                self._lose_scheduler(str(error))
            except Exception:  # a bug or Dask's: the board must outlive it, or every job hangs
                log.exception("engine: %s could not be handled", item[0])

    def _handle(self, item: tuple[Any, ...]) -> None:
        match item:
            case ("wait", entry):
                self._waiting.append(entry)
            case ("release", entry):
                self._release(entry)
            case ("ended", entry, future):
                if entry.future is future and entry.listeners:
                    self._settle(entry, future)
            case ("event", event):
                self._note(event)

    def _fill(self) -> None:
        """Hands out as many units as there are slots: one that waits here is behind no other on a busy worker."""
        while self._waiting and len(self._keys) < self._slots:
            entry = self._waiting[0]
            if entry.listeners and entry.future is None:
                self._submit(entry)
            self._waiting.popleft()

    def _submit(self, entry: UnitRequest) -> None:
        client = self._cluster.client()
        # The same for every service that wants it, so that one scheduler runs it once; another after each attempt.
        key = f"{entry.identity}#{len(entry.failures) + entry.deaths_nearby}"
        workers = self._cluster.workers() if entry.failed_on else {}
        others = [address for address, worker in workers.items() if str(worker["name"]) not in entry.failed_on]
        resources = {"gpu": 1} if self._has_gpu and entry.unit.stage == _GPU_STAGE else None
        arguments = (self._executor, entry.unit, entry.spec, self._store_url, key, self._recycling)
        preferred = {"workers": others, "allow_other_workers": True} if others else {}
        entry.key, entry.worker, entry.address, entry.began_s = key, None, None, time.monotonic()
        self._keys[key] = entry
        entry.future = client.submit(run_unit, *arguments, key=key, resources=resources, pure=False, **preferred)
        entry.future.add_done_callback(lambda future: self._inbox.put(("ended", entry, future)))

    def _settle(self, entry: UnitRequest, future: "Future") -> None:
        """A future has ended one way or another."""
        if future.status == "finished":
            answer = None
            if entry.unit.stage in _ANSWERED:
                try:
                    answer = future.result(timeout=30)
                except Exception as error:  # its worker went away with it
                    log.info("engine: the answer of %s is lost (%s); asking again", entry.identity, error)
                    self._again(entry)
                    return
            self._finish(entry, Outcome(entry.identity, "done", answer))
        elif future.status == "error":
            self._fail(entry, future.exception(timeout=30))
        else:  # cancelled or lost: the scheduler went away
            self._again(entry)

    def _fail(self, entry: UnitRequest, error: BaseException) -> None:
        from distributed import KilledWorker

        if isinstance(error, StoppedError):  # another service stopped wanting it just as we began to
            self._again(entry)
            return
        worker = entry.worker
        if isinstance(error, KilledWorker):
            worker = str(error.last_worker.name)
            if entry.worker is None and entry.deaths_nearby < MAX_DEATHS_NEARBY:
                entry.deaths_nearby += 1
                self._again(entry)
                return
            reasons = [f"its worker process died ({worker})"] * (1 + self._cluster.allowed_failures)
        else:
            reasons = [str(error) if isinstance(error, UnitError) else f"{type(error).__name__}: {error}"]
        entry.failures += reasons
        if worker is not None:
            entry.failed_on.add(worker)
        attempts, reason = len(entry.failures), entry.failures[-1]
        log.warning("engine: %s failed, attempt %d: %s", entry.identity, attempts, reason)
        if attempts >= MAX_ATTEMPTS:
            self._finish(entry, Outcome(entry.identity, "set_aside", reason=reason, attempts=attempts))
            return
        entry.tell(Outcome(entry.identity, "retry", reason=reason, attempts=attempts))
        self._again(entry)

    def _again(self, entry: UnitRequest) -> None:
        self._let_go(entry)
        self._waiting.append(entry)

    def _finish(self, entry: UnitRequest, outcome: Outcome) -> None:
        self.totals.add(entry.unit, time.monotonic() - entry.began_s, done=outcome.kind == "done")
        with self._lock:
            if self._entries.get(entry.identity) is entry:
                del self._entries[entry.identity]
            entry.tell(outcome)
        self._let_go(entry)

    def _let_go(self, entry: UnitRequest) -> None:
        self._keys.pop(entry.key, None)
        future, entry.future = entry.future, None
        if future is not None:
            future.release()

    def _release(self, entry: UnitRequest) -> None:
        if entry.future is not None and entry.address is not None:
            self._leaving[entry.key] = (entry.address, time.monotonic() + SECONDS_TO_LEAVE)
        self._let_go(entry)

    def _note(self, event: dict[str, Any]) -> None:
        if event["kind"] == "ended":
            self._leaving.pop(event["key"], None)
        entry = self._keys.get(event["key"])
        if entry is None:
            return
        if event["kind"] == "began":
            entry.worker, entry.address, entry.began_s = event["name"], event["address"], time.monotonic()
        elif event["kind"] == "progress":
            values = {name: event[name] for name in ("done", "total", "note")}
            entry.tell(Outcome(entry.identity, "progress", **values))
        elif event["kind"] == "message":
            entry.tell(Outcome(entry.identity, "message", note=event["text"]))

    # ------------------------------------------------ the cluster ----------------------------------------------------

    def _tick(self) -> None:
        workers = self._cluster.workers()
        if not self._connected:
            self._connected = True
            self._say("the scheduler is back: what was in flight is asked for again")
            for entry in list(self._keys.values()):
                self._again(entry)
        slots = sum(int(worker["nthreads"]) for worker in workers.values())
        if slots == 0 and self._slots:
            self._say("no worker is connected: waiting for one")
        self._slots = slots
        self._has_gpu = any("gpu" in worker["resources"] for worker in workers.values())
        for key, (address, deadline) in list(self._leaving.items()):
            if time.monotonic() > deadline:
                del self._leaving[key]
                if not self._still_wanted(key, address):
                    log.warning("engine: %s did not end within %g s; replacing its process", key, SECONDS_TO_LEAVE)
                    threading.Thread(target=self._cluster.restart_worker, args=(address,), daemon=True).start()

    def _still_wanted(self, key: str, address: str) -> bool:
        """Whether another service's job wants a unit that ours let go of."""
        return key in self._cluster.client().processing([address]).get(address, ())

    def _lose_scheduler(self, reason: str) -> None:
        if self._connected:
            self._connected = False
            self._leaving.clear()
            self._say(f"{reason}; waiting for it")
        time.sleep(TICK_SECONDS)

    def _say(self, text: str) -> None:
        log.warning("engine: %s", text)
        with self._lock:
            listeners = {listener for entry in self._entries.values() for listener in entry.listeners}
        for listener in listeners:
            listener.outcomes.put(Outcome("", "message", note=text))
