"""The frames of one combination: for each pose of both camera paths a reference, and noisy frames beside it."""

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
        rendered = [rendered_spp(run, spp) for spp in (*input_spp, reference_spp)]
        if rendered != sorted(set(rendered)):
            raise BatchError(
                f"input_spp must rise, and stay below the references' {rendered[-1]} of part {part}, got "
                f"{rendered[:-1]} (each is rounded up to a multiple of frames.passes); leave some out"
            )
        for index, camera in enumerate(getattr(run.paths, part)):
            for spp, role in [*((spp, "input") for spp in input_spp), (reference_spp, "reference")]:
                units.append(FrameUnit(part, index, role, camera, spp, render_ref(run, camera, spp)))
    return units


def rendered_spp(run: RunState, spp: int) -> int:
    """Samples that the render stage takes where `spp` are asked for: equal passes, rounded up."""
    passes = min(run.settings.frames.passes, spp)
    return -(-spp // passes) * passes


def render_frames(run: RunState, units: list[FrameUnit]) -> None:
    """Renders whatever the store lacks, by the same stage as any run."""
    batches: dict[tuple[str, int], list[Camera]] = {}
    for unit in units:
        batches.setdefault((unit.part, unit.spp), []).append(unit.camera)
    for (part, spp), cameras in batches.items():
        run_render(run, cameras, spp, f"render {part} frames, {spp} spp")
