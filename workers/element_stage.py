"""Stage `elements`: which cache elements the camera domain needs, kept as one unit."""

import dataclasses
import io
import time

import numpy as np

from storage.store import UnitRef
from workers.camera_path import domain_poses
from workers.elements import ELEMENTS_VERSION, ElementSet, build_elements
from workers.lattice import PatchTable
from workers.run_state import PATH_SEED, RunState, camera_params
from workers.visibility import domain_hits

STAGE = "elements"
FILE = "elements.npz"
RAYS_PER_POSE = 256 * 256
_KEYED = ("elements", "lobes", "max_elements", "min_spacing_px", "domain_poses", "max_edge_fraction")


def elements_ref(run: RunState) -> UnitRef:
    """The unit that holds the element set of a run."""
    cache = dataclasses.asdict(run.settings.cache)
    path = [camera_params(camera) for camera in run.paths.train + run.paths.validation]
    domain = {"radius": run.paths.domain_radius, "angle_deg": run.paths.domain_angle_deg}
    params = {name: cache[name] for name in _KEYED} | {"path": path, "domain": domain, "version": ELEMENTS_VERSION}
    return run.ref(STAGE, params)


def run_elements(run: RunState) -> ElementSet:
    """Builds the element set, or reads it where the store has it."""
    ref = elements_ref(run)
    if run.store.committed(ref) is not None:
        return load_elements(run.store.read(ref, FILE))
    start = time.perf_counter()
    poses = domain_poses(run.paths, run.settings.cache.domain_poses, PATH_SEED)
    hits = domain_hits(run.scene.mi_scene, run.table, poses, run.settings.width, RAYS_PER_POSE, run.progress)
    elements = build_elements(run.table, hits, run.settings.cache)
    seconds = time.perf_counter() - start
    record = {
        "seconds": seconds, "num_elements": elements.num_elements, "num_directional": len(elements.glossy),
        "num_points": elements.patches.num_points, "spacing_px": elements.spacing_px,
    }  # fmt: skip
    run.store.commit(ref, {FILE: save_elements(elements)}, record)
    run.seconds[STAGE] = seconds
    return elements


def save_elements(elements: ElementSet) -> bytes:
    """An element set as npz bytes."""
    arrays = {f.name: getattr(elements, f.name) for f in dataclasses.fields(elements) if f.name != "patches"}
    patches = {f"patches_{f.name}": getattr(elements.patches, f.name) for f in dataclasses.fields(PatchTable)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays, **patches)
    return buffer.getvalue()


def load_elements(data: bytes) -> ElementSet:
    """Inverse of `save_elements`."""
    with np.load(io.BytesIO(data)) as archive:
        names = [f.name for f in dataclasses.fields(PatchTable)]
        patches = PatchTable(**{name: archive[f"patches_{name}"] for name in names})
        values = {f.name: archive[f.name] for f in dataclasses.fields(ElementSet) if f.name != "patches"}
    values["spacing_px"] = float(values["spacing_px"])
    return ElementSet(patches=patches, **values)
