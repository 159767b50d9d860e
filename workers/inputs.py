"""Stage `inputs`: what the network sees of one pose, queried from the caches and kept beside its ground truth."""

import dataclasses
import time

import numpy as np

from storage.frames import decode_frame, encode_frame, health
from storage.store import UnitRef
from workers.bake import bake_refs
from workers.cache_filter import FILTER_VERSION
from workers.camera import Camera
from workers.elements import ElementSet
from workers.normal_maps import NORMAL_MAPS_VERSION
from workers.query import CHANNELS, QueryProgram
from workers.run_state import RunState, camera_params

STAGE = "inputs"
FILE = "inputs.exr"


def inputs_ref(run: RunState, elements: ElementSet, camera: Camera) -> UnitRef:
    """The unit that holds a pose's network inputs."""
    caches = {name: ref.key for name, ref in bake_refs(run, elements).items()}
    cache = run.settings.cache
    params = {
        "camera": camera_params(camera),
        "caches": caches,
        "query": dataclasses.asdict(run.settings.query),
        "demodulate": cache.demodulate,
        "denoise": FILTER_VERSION if cache.denoise else 0,
    }
    if run.table.normal_maps.textures:
        params["normal_maps"] = NORMAL_MAPS_VERSION
    return run.ref(STAGE, params)


def run_inputs(run: RunState, elements: ElementSet, program: QueryProgram, cameras: list[Camera]) -> list[UnitRef]:
    """Queries whatever poses the store lacks."""
    start = time.perf_counter()
    refs = [inputs_ref(run, elements, camera) for camera in cameras]
    missing = [pair for pair in zip(refs, cameras, strict=True) if run.store.committed(pair[0]) is None]
    if not missing:
        return refs
    with run.progress.track("query inputs", len(missing)) as advance:
        for ref, camera in missing:
            query_start = time.perf_counter()
            layers = to_layers(program.run(camera))
            record = {"seconds": time.perf_counter() - query_start, "camera": camera_params(camera),
                      "health": health(layers)}  # fmt: skip
            run.store.commit(ref, {FILE: encode_frame(layers)}, record)
            advance()
    run.seconds[STAGE] = time.perf_counter() - start
    return refs


def to_layers(features: np.ndarray) -> dict[str, np.ndarray]:
    """Splits a query's [height, width, channels] into named layers."""
    return {name: np.ascontiguousarray(features[..., a:b]) for name, (a, b) in CHANNELS.items()}


def load_inputs(run: RunState, ref: UnitRef) -> dict[str, np.ndarray]:
    """Layers of a queried pose, as `to_layers` names them."""
    return decode_frame(run.store.read(ref, FILE))
