"""The service's part in the kill test: submits one job and writes how far it is, until it is killed or done."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from service.engine import DaskRunner
from service.job_runner import JobFailed
from tests.service.fake_stages import fake_execute, fake_spec
from tests.torture.tiny_job import tiny_spec

DONE, FAILED = 0, 3


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", required=True)
    parser.add_argument("--scheduler", required=True)
    parser.add_argument("--status", type=Path, required=True, help="a JSON line for each event")
    parser.add_argument("--fake", type=Path, help="folder of stages that answer at once")
    parser.add_argument("--settings", type=json.loads, default={})
    arguments = parser.parse_args()
    with arguments.status.open("a") as status:

        def write(event: dict[str, Any]) -> None:
            event.pop("png", None)
            status.write(json.dumps({"at": time.time(), **event}) + "\n")
            status.flush()

        more: dict[str, Any] = {"executor": fake_execute} if arguments.fake else {}
        spec = fake_spec(arguments.fake, **arguments.settings) if arguments.fake else tiny_spec(**arguments.settings)
        runner = DaskRunner(arguments.store, scheduler=arguments.scheduler, **more)
        try:
            result = runner.run("torture", spec, write, lambda: None)
        except JobFailed as error:
            write({"kind": "failed", "text": str(error)})
            return FAILED
        finally:
            runner.close()
        write({"kind": "done", "set_aside": result["set_aside"], "evaluation": bool(result["evaluation"])})
        return DONE


if __name__ == "__main__":
    sys.exit(main())
