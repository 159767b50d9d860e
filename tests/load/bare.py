"""What a frame costs without the service: `FrameRenderer` alone, in a process of its own.

    python -m tests.load.bare STORE 320x180

Reads a number of seconds a line; answers each with JSON: the seconds of each frame rendered meanwhile, scenes in turn,
and the process' CPU seconds. So it can take turns with what it is compared with.
"""

import argparse
import json
import sys
import time

import workers  # noqa: F401  # thread policy, before anything imports torch
from storage.store import Store
from tests.load.poses import poses
from tests.load.store import SCENES
from workers.camera import Camera
from workers.renderer import FrameRenderer

WARM_FRAMES = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store")
    parser.add_argument("size")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    store = Store.open(options.store)
    renderers = [FrameRenderer.open(store, name) for name in SCENES]
    views = poses(0, 1)

    def render_all() -> list[float]:
        body = next(views)
        look = body["camera"]["look_at"]
        camera = Camera.look_at(look["origin"], look["target"], [0, 1, 0], body["fov_deg"], width, height)
        times = []
        for renderer in renderers:
            start_s = time.perf_counter()
            renderer.render(camera)
            times.append(time.perf_counter() - start_s)
        return times

    for _ in range(WARM_FRAMES):
        render_all()
    for line in sys.stdin:
        end_s, cpu_s, times = time.perf_counter() + float(line), time.process_time(), []
        while time.perf_counter() < end_s:
            times += render_all()
        print(json.dumps({"seconds": times, "cpu_s": time.process_time() - cpu_s}), flush=True)


if __name__ == "__main__":
    main()
