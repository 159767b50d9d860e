"""The frames of one combination: a reference for each pose of both camera paths, noisy ones of the same pose beside it."""

from dataclasses import dataclass

from storage.store import UnitRef
from workers.batch_matrix import BatchError
from workers.camera import Camera
from workers.render import render_ref, run_render
from workers.run_state import RunState

PARTS = ("train", "validation", "test")
PATH_OF_PART = {"train": "A", "validation": "A", "test": "B"}


@dataclass(frozen=True)
class FrameUnit:
    """One frame that a dataset is made from.

    Attributes:
        part: part of the camera paths: "train" and "validation" are of path A, "test" is path B.
        index: place in that part.
        role: "reference" or "input".
        camera: the pose.
        spp: samples a pixel that were asked for.
        ref: the unit in the store.
    """

    part: str
    index: int
    role: str
    camera: Camera
    spp: int
    ref: UnitRef


def frame_units(run: RunState, input_spp: tuple[int, ...]) -> list[FrameUnit]:
    """All frames of a run, pose by pose, each pose's reference last.

    Raises:
        BatchError: a noisy frame has no fewer samples than its reference.
    """
    units = []
    for part in PARTS:
        reference_spp = run.settings.frames.test_spp if part == "test" else run.settings.frames.train_spp
        if input_spp and max(input_spp) >= reference_spp:
            raise BatchError(
                f"input_spp must be below the samples of the references ({reference_spp} of part {part}), "
                f"got {max(input_spp)}; leave it out or raise frames.train_spp and frames.test_spp"
            )
        for index, camera in enumerate(getattr(run.paths, part)):
            for spp, role in [*((spp, "input") for spp in input_spp), (reference_spp, "reference")]:
                units.append(FrameUnit(part, index, role, camera, spp, render_ref(run, camera, spp)))
    return units


def render_frames(run: RunState, units: list[FrameUnit]) -> None:
    """Renders whatever the store lacks, by the same stage as any run."""
    batches: dict[tuple[str, int], list[Camera]] = {}
    for unit in units:
        batches.setdefault((unit.part, unit.spp), []).append(unit.camera)
    for (part, spp), cameras in batches.items():
        run_render(run, cameras, spp, f"render {part} frames, {spp} spp")
