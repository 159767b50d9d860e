"""One job from its spec to its result: which units are ready, what became of them, how far it is.

Nothing of a job's state is kept here for later: it is derived from the store each time, so a job that is run again goes
on where it was, whoever ran it before.
"""

import dataclasses
import hashlib
import json
import queue
import time
from collections.abc import Callable, Collection
from typing import Any

from service.block_run import BlockRun
from service.job_runner import Event, JobFailed, JobStopped, Stop
from service.outcome import json_values
from service.unit_board import UnitBoard
from service.unit_request import Listener, Outcome
from storage.caches import marked_units
from storage.layout import UnitRef
from storage.store import Store
from workers.job_spec import JobSpec
from workers.units import (
    CENSUS,
    Block,
    Census,
    Inventory,
    Unit,
    blocks_after_census,
    blocks_after_inventory,
    by_priority,
)

POLL_SECONDS = 0.2
SECONDS_BETWEEN_PROGRESS = 0.5
SECONDS_BETWEEN_PREVIEWS = 3.0
AHEAD = 2  # units asked for, by slot
EVALUATION_STAGE, RESULT_FILE, REPORT_FILE = "evaluation", "evaluation.json", "report.html"
STORE_STAGES = {"seal": "bake"}  # where a stage's units lie, if not under its own name


class JobRun:
    """Runs one job on a board; `run` may be called once."""

    def __init__(
        self, board: UnitBoard, store: Store, spec: JobSpec, on_event: Callable[[Event], None],
        should_stop: Callable[[], Stop | None],
    ) -> None:  # fmt: skip
        self._board, self._store, self._spec = board, store, spec
        self._on_event, self._should_stop = on_event, should_stop
        self._listener = Listener()
        self._runs: dict[str, BlockRun] = {}
        self._owner: dict[str, BlockRun] = {}
        self._set_aside: list[dict[str, Any]] = []
        self._answers: dict[str, Any] = {}
        self._previewed_s = -SECONDS_BETWEEN_PREVIEWS
        self._add([CENSUS])

    def run(self) -> dict[str, Any]:
        """See `service.job_runner.JobRunner.run`."""
        try:
            while True:
                if (stop := self._should_stop()) is not None:
                    raise JobStopped(stop)
                self._ask()
                if not self._owner:
                    break
                self._listen()
            return self._result()
        finally:
            self._board.withdraw(self._listener)

    # ------------------------------------------------ what is ready --------------------------------------------------

    @property
    def _census(self) -> Census:
        return Census.from_json(self._answers["census"])

    def _add(self, blocks: list[Block]) -> None:
        runs = [*self._runs.values(), *(BlockRun(block) for block in blocks)]
        self._runs = {run.block.name: run for run in sorted(runs, key=lambda run: by_priority(run.block))}

    def _ask(self) -> None:
        """Asks for units until enough are in flight or nothing else is ready."""
        while self._ask_once():
            pass

    def _ask_once(self) -> bool:
        """Goes through the blocks once; whether one ended, as what the store has whole does: others may be ready."""
        one_ended = False
        for run in list(self._runs.values()):
            if run.exhausted or not self._ready(run.block):
                continue
            if run.pending is None:
                run.open(self._done(run.block))
            while len(self._owner) < AHEAD * max(self._board.slots, 1):
                unit = run.next_unit()
                if unit is None:
                    self._tell_progress(run, now=True)
                    one_ended |= run.ended
                    break
                self._request(run, unit)
        return one_ended

    def _request(self, run: BlockRun, unit: Unit) -> None:
        if unit.stage in ("train", "evaluate"):
            unit = dataclasses.replace(unit, without=self._lost_frames(run.block))
        identity = self._identity(unit)
        run.flying[identity] = (unit, 0.0)
        self._owner[identity] = run
        self._board.request(identity, unit, self._spec, self._listener)

    def _identity(self, unit: Unit) -> str:
        """One text for the same work of any job: the store's key, or a hash of the spec where there is none yet."""
        what = unit.key
        if not what:
            content = [self._spec.canonical, self._spec.last_stage, unit.without]
            what = hashlib.sha256(json.dumps(content).encode()).hexdigest()[:32]
        return f"{unit.stage}-{what}-{unit.first}-{unit.count}"

    def _ready(self, block: Block) -> bool:
        return not self._blocked(block) and all(need in self._runs and self._runs[need].ended for need in block.needs)

    def _blocked(self, block: Block) -> bool:
        """Whether something that the block cannot do without was set aside."""
        for need in block.needs:
            run = self._runs.get(need)
            if run is None:
                continue
            whole = not run.block.by_frame or (run.block.part != "validation" and len(run.lost) == run.block.total)
            if (run.lost and whole) or self._blocked(run.block):
                return True
        return False

    def _lost_frames(self, block: Block) -> tuple[str, ...]:
        """Frames that were set aside, of everything that a block needs, directly or not."""
        names: set[str] = set()
        for need in block.needs:
            run = self._runs[need]
            names |= {f"{run.block.part}/{index}" for index in run.lost if run.block.by_frame}
            names |= set(self._lost_frames(run.block))
        return tuple(sorted(names))

    def _done(self, block: Block) -> Collection[int]:
        """Members of a block that the store has."""
        if block.keys == ("",):
            return ()
        stage = STORE_STAGES.get(block.stage, block.stage)
        refs = [UnitRef(self._census.digest, stage, key) for key in block.keys]
        if block.stage == "bake":
            return range(block.total) if self._store.committed(refs[0]) else marked_units(self._store, refs[0])
        return {index for index, ref in enumerate(refs) if self._store.committed(ref) is not None}

    # ------------------------------------------------ what became of it ----------------------------------------------

    def _listen(self) -> None:
        try:
            outcome = self._listener.outcomes.get(timeout=POLL_SECONDS)
        except queue.Empty:
            return
        run = self._owner.get(outcome.identity)
        if outcome.kind == "message":
            self._on_event({"kind": "message", "text": outcome.note})
        elif run is not None:
            getattr(self, f"_on_{outcome.kind}")(run, outcome)

    def _on_progress(self, run: BlockRun, outcome: Outcome) -> None:
        unit, _ = run.flying[outcome.identity]
        share = min(outcome.done / outcome.total, 1.0) if outcome.total > 0 else 0.0
        run.flying[outcome.identity] = (unit, share)
        run.note = outcome.note
        self._tell_progress(run)

    def _on_done(self, run: BlockRun, outcome: Outcome) -> None:
        unit = self._land(run, outcome)
        run.computed = min(run.computed + unit.count, run.block.total - run.found)
        self._answers[unit.stage] = outcome.answer
        if unit.stage == "census":
            self._add(blocks_after_census(self._census, self._spec.last_stage))
        elif unit.stage == "inventory":
            inventory = Inventory.from_json(outcome.answer)
            self._add(blocks_after_inventory(self._census, inventory, self._spec.last_stage))
        elif unit.stage == "render":
            self._preview(unit)
        self._tell_progress(run)

    def _on_retry(self, run: BlockRun, outcome: Outcome) -> None:
        unit, _ = run.flying[outcome.identity]
        run.flying[outcome.identity] = (unit, 0.0)
        self._on_event({"kind": "retry", "unit": unit.name, "reason": outcome.reason, "attempt": outcome.attempts})

    def _on_set_aside(self, run: BlockRun, outcome: Outcome) -> None:
        unit = self._land(run, outcome)
        run.lost += range(unit.first, unit.first + unit.count)
        entry = {"unit": unit.name, "reason": outcome.reason, "attempts": outcome.attempts}
        self._set_aside.append(entry)
        self._on_event({"kind": "set_aside", **entry})

    def _land(self, run: BlockRun, outcome: Outcome) -> Unit:
        del self._owner[outcome.identity]
        return run.flying.pop(outcome.identity)[0]

    # ---------------------------------------------------- what is said ------------------------------------------------

    def _tell_progress(self, run: BlockRun, *, now: bool = False) -> None:
        last = run.ended or run.exhausted
        if now or last or time.monotonic() - run.told_s >= SECONDS_BETWEEN_PROGRESS:
            run.told_s = time.monotonic()
            self._on_event(run.progress())

    def _preview(self, unit: Unit) -> None:
        """The frame that was rendered last, now and then."""
        if time.monotonic() - self._previewed_s < SECONDS_BETWEEN_PREVIEWS:
            return
        from service.preview import preview_png

        png = preview_png(self._store, UnitRef(self._census.digest, "render", unit.key))
        self._previewed_s = time.monotonic()
        if png is not None:
            self._on_event({"kind": "preview", "png": png})

    def _result(self) -> dict[str, Any]:
        """Scores and counts of a job that ended.

        Raises:
            JobFailed: what was set aside leaves it without what was asked for.
        """
        blocked = [name for name, run in self._runs.items() if self._blocked(run.block)]
        fatal = [name for name, run in self._runs.items() if run.lost and not run.block.by_frame and name != "evaluate"]
        if blocked or fatal:
            reasons = "; ".join(f"{entry['unit']}: {entry['reason']}" for entry in self._set_aside)
            rest = f" and {', '.join(blocked)} could not be run without" if blocked else ""
            raise JobFailed(
                f"every unit must succeed within {self._set_aside[0]['attempts']} attempts, got set aside: "
                f"{reasons}{rest}; everything else is kept, mend the cause and retry the job"
            )
        if idle := [name for name, run in self._runs.items() if not run.ended]:
            raise RuntimeError(f"{', '.join(idle)} never became ready: the blocks' needs contradict each other")
        evaluation_key = self._answers.get("evaluate")
        evaluation = None
        if evaluation_key is not None:
            ref = UnitRef(self._census.digest, EVALUATION_STAGE, evaluation_key)
            evaluation = json_values(json.loads(self._store.read(ref, RESULT_FILE)))
            if REPORT_FILE in (self._store.committed(ref) or {}).get("files", {}):
                self._on_event({"kind": "report", "html": self._store.read(ref, REPORT_FILE).decode()})
        return {
            "evaluation": evaluation, "units": sum(run.computed for run in self._runs.values()),
            "planned_units": sum(run.block.total for run in self._runs.values()), "set_aside": self._set_aside,
            "scene": self._census.digest, "network_key": self._answers.get("train"), "evaluation_key": evaluation_key,
        }  # fmt: skip
