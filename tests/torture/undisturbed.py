"""The tiny job in one process that nobody disturbs: STORE SETTINGS(json)."""

import json
import os
import sys

from workers.thread_policy import ThreadPolicy

if __name__ == "__main__":
    policy = ThreadPolicy()  # the workers' own: torch's sums depend on the number of threads
    os.environ.update(policy.environment)
    policy.apply("train")
    from tests.torture.tiny_job import run_in_process, tiny_spec

    run_in_process(tiny_spec(**json.loads(sys.argv[2])), sys.argv[1])
