"""A service process for the restart tests: real server, table and store; units that take a moment and are counted.

python service_process.py FOLDER PORT NUM_UNITS
"""

import sys
import time
from pathlib import Path
from typing import Any

import uvicorn

from service.app import create_app
from service.job_runner import JobStopped
from service.jobs.service import Jobs
from service.jobs.submission import Desk
from service.serving import bind
from storage.store import Store, UnitRef

UNIT_S = 0.05


class UnitRunner:
    """Commits units to a real store; a line in `computed` for each one that it computes."""

    def __init__(self, folder: Path, num_units: int) -> None:
        self.folder, self.num_units = folder, num_units

    def run(self, job_id: str, spec: Any, on_event: Any, should_stop: Any) -> dict[str, Any]:
        store, num_new = Store.open(self.folder / "store", create=True), 0
        for index in range(self.num_units):
            ref = UnitRef("d1", "bake", f"{spec.settings['cache']['polar']}-{index}")
            if store.committed(ref) is None:
                time.sleep(UNIT_S)
                store.commit(ref, {"unit": b"x"}, {})
                with (self.folder / "computed").open("a") as file:
                    file.write(f"{ref.key}\n")
                num_new += 1
            progress = {"stage": "bake", "done": index + 1.0, "total": float(self.num_units), "eta_s": None, "note": ""}
            on_event({"kind": "progress", **progress})
            stop = should_stop()
            if stop is not None:
                raise JobStopped(stop)
        return {"evaluation": None, "units": num_new, "set_aside": []}

    def close(self) -> None: ...


class NoScenes:
    """Nothing to render."""

    def scenes(self) -> list[dict[str, Any]]:
        return []

    def warm_up(self) -> None: ...


def read_scene(_: str) -> Any:
    """Imported when a job is submitted, as the service does: Mitsuba is not what a restart waits for."""
    from workers.scene_request import SceneRequest

    return SceneRequest(name="tiny", width=8, height=8)


def main() -> None:
    folder, port, num_units = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    desk = Desk(resolve_scene_source=lambda name: name, read_scene=read_scene)
    jobs = Jobs(f"sqlite:///{folder / 'jobs.sqlite'}", UnitRunner(folder, num_units), desk)
    with bind("127.0.0.1", port) as listener:
        app = create_app("unused", make_backend=NoScenes, jobs=jobs)  # type: ignore[arg-type]
        uvicorn.Server(uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=1)).run(sockets=[listener])


if __name__ == "__main__":
    main()
