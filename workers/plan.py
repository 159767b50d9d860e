"""What a run would do and cost, as a table with reasons."""

from typing import Any

from storage.store import Store
from workers.camera_path import domain_poses
from workers.element_stage import RAYS_PER_POSE
from workers.elements import build_elements
from workers.lobes import LobeClass
from workers.progress import Progress
from workers.run_state import PATH_SEED, RunState
from workers.scene import Scene
from workers.settings import Settings
from workers.surfaces import SurfaceTable
from workers.visibility import domain_hits

PILOT_POSES = 8
BYTES_PER_TEXEL = 12


def plan_rows(scene: Scene, settings: Settings) -> dict[str, Any]:
    """Choices with reasons, and the cost in paths, seconds (from a short calibration) and bytes."""
    from workers.pathtrace import flush, trace

    run = RunState(scene, _NO_STORE, settings, Progress())
    table = run.table
    poses = domain_poses(run.paths, min(PILOT_POSES, settings.cache.domain_poses), PATH_SEED)
    hits = domain_hits(scene.mi_scene, table, poses, settings.width, RAYS_PER_POSE // 4, Progress())
    elements = build_elements(table, hits, settings.cache)
    paths = _paths(settings, elements.num_elements, len(elements.glossy))
    rate = _calibrate(scene, settings, trace, flush)
    cache = settings.cache
    directions = cache.azimuth * cache.polar
    nbytes = BYTES_PER_TEXEL * (elements.num_elements * 2 + len(elements.glossy) * directions)
    rows = [
        _row("surfaces", f"{len(table.shapes)} shapes, {table.num_prims} primitives", _materials(table)),
        _row("elements", f"{elements.num_elements} ({cache.elements})",
             f"seen from {len(poses)} pilot poses, {elements.spacing_px:.2g} px apart; budget {cache.max_elements}"),
        _row("diffuse lobe", f"1 number x {cache.diffuse_spp} spp", "a Lambertian lobe has no direction"),
        _row("directional lobe", f"{len(elements.glossy)} elements x {cache.azimuth}x{cache.polar} x "
             f"{cache.directional_spp} spp", "only glossy and rough transmissive materials"),
        _row("delta surfaces", "followed at query time" if table.lobe_union & LobeClass.DELTA else "none",
             "mirrors and glass have no lobe to cache"),
        _row("training frames", f"{settings.frames.num_train} + {settings.frames.num_validation} at "
             f"{settings.frames.train_spp} spp", "denoised" if settings.frames.denoise_train else "raw"),
        _row("test references", f"{settings.frames.num_test} at {settings.frames.test_spp} spp", "disjoint path"),
        _row("network", f"widths {settings.train.widths}, {settings.train.fusion}",
             f"at most {settings.train.seconds:.0f} s" if settings.train.seconds else "all epochs"),
    ]  # fmt: skip
    seconds = {name: count / rate for name, count in paths.items()}
    total_seconds = sum(seconds.values()) + settings.train.seconds
    rows += [
        _row(f"cost: {name}", f"{seconds[name]:.0f} s", f"{count / 1e6:.0f} M paths at {rate / 1e6:.2f} M paths/s")
        for name, count in paths.items()
    ]
    return {"rows": rows, "cost": {"paths": int(sum(paths.values())), "seconds": total_seconds, "nbytes": nbytes}}


def _row(item: str, choice: str, reason: str) -> dict[str, str]:
    return {"item": item, "choice": choice, "reason": reason}


def _paths(settings: Settings, num_elements: int, num_directional: int) -> dict[str, int]:
    cache, frames = settings.cache, settings.frames
    pixels = settings.width * settings.height
    directions = cache.azimuth * cache.polar * cache.directional_spp
    diffuse = num_elements * cache.diffuse_spp if cache.lobes == "split" else 0
    return {
        "bake": diffuse + num_directional * directions,
        "training frames": (frames.num_train + frames.num_validation) * frames.train_spp * pixels,
        "test references": frames.num_test * frames.test_spp * pixels,
    }


def _calibrate(scene: Scene, settings: Settings, trace: Any, flush: Any) -> float:
    """Paths per second of this machine on this scene."""
    import time

    camera = scene.camera.resized(min(settings.width, 256), min(settings.height, 256))
    trace(scene, camera, 4, 1)
    flush()
    start = time.perf_counter()
    trace(scene, camera, 8, 2)
    flush()
    return 8 * camera.width * camera.height / (time.perf_counter() - start)


def _materials(table: SurfaceTable) -> str:
    counts: dict[str, int] = {}
    for lobe in table.lobes:
        names = [n for n, flag in (("diffuse", LobeClass.DIFFUSE), ("glossy", LobeClass.GLOSSY),
                                   ("delta", LobeClass.DELTA)) if lobe & flag]  # fmt: skip
        kind = "emissive" if lobe & LobeClass.EMITTER else " + ".join(names) or "black"
        counts[kind] = counts.get(kind, 0) + 1
    return ", ".join(f"{count} {kind}" for kind, count in sorted(counts.items()))


_NO_STORE: Store = None  # type: ignore[assignment]  # a plan writes and reads nothing
