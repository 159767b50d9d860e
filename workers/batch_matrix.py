"""A batch as it is written: scenes x presets x variations in one YAML file.

scenes: [tabletop, rooms/hall.xml]        # files relative to this one, or names of built-in scenes
presets: [draft, {name: draft, label: wide, settings: {width: 384}}]
variations:
  - name: original                        # changes nothing
  - {name: colours, count: 3, materials: 0.7, light: [0.5, 2.0], light_colour: 0.3, camera: 0.1}
stages: [render]                          # bake, render, train: a later one includes those before
input_spp: [1, 4]                         # noisy frames beside each reference
settings: {frames.num_train: 8}           # for all
resolution: [256, 256]
seed: 0                                   # every variation's seed derives from it
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from storage.keys import canonical_json, seed_from_key
from workers.errors import WorkerError
from workers.settings import Settings
from workers.variation import Variation, join_source

MAX_ITEMS = 100_000
Stage = Literal["bake", "render", "train"]
Label = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,39}$")]


class BatchError(WorkerError, ValueError):
    """A batch cannot be read, or asks for something that does not fit together."""


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PresetRow(_Row):
    """A preset with settings of its own, told apart from others by its label."""

    name: str
    label: Label | None = None
    settings: dict[str, Any] = {}


class VariationRow(_Row):
    """How a scene is varied `count` times; see `workers.variation.Variation` for the ranges."""

    name: Label
    count: int = Field(1, ge=1, le=10_000)
    materials: float = 0.0
    light: float | tuple[float, float] = (1.0, 1.0)
    light_colour: float = 0.0
    camera: float = 0.0

    def variation(self, seed: int) -> Variation:
        return Variation(seed=seed, materials=self.materials, light=self.light,  # type: ignore[arg-type]  # made a pair there
                         light_colour=self.light_colour, camera=self.camera)  # fmt: skip


class Matrix(_Row):
    """The file's content."""

    scenes: list[str] = Field(min_length=1)
    presets: list[str | PresetRow] = Field(default=["draft"], min_length=1)
    variations: list[VariationRow] = Field(default=[VariationRow(name="original", count=1)], min_length=1)
    stages: list[Stage] = Field(default=["render"], min_length=1)
    input_spp: list[Annotated[int, Field(ge=1, le=1_000_000)]] = [1]
    settings: dict[str, Any] = {}
    resolution: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = None
    seed: int = Field(0, ge=0)


@dataclass(frozen=True, kw_only=True)
class BatchItem:
    """One combination.

    Attributes:
        label: scene/preset/variation, unique in its batch.
        base: the scene as the batch names it, without variation.
        scene: what `load_scene` takes.
        preset: label of the preset.
        preset_name: the preset that settings start from.
        overrides: dotted settings over it and over what the scene's own file asks for.
        resolution: (width, height) in pixels; the scene's own where None.
        variation: what is varied, None where nothing is.
        stages: what is to be run.
        input_spp: samples of the noisy frames beside each reference.
        settings: complete settings, in place of preset, scene's wishes and overrides; None: from these.
    """

    label: str
    base: str
    scene: str
    preset: str
    preset_name: str
    overrides: dict[str, Any] = field(default_factory=dict)
    resolution: tuple[int, int] | None = None
    variation: Variation | None = None
    stages: tuple[str, ...] = ("render",)
    input_spp: tuple[int, ...] = (1,)
    settings: Settings | None = None


def read_matrix(path: Path) -> list[BatchItem]:
    """Every combination of a batch file, scene by scene.

    Raises:
        BatchError: broken YAML, an unknown key, a value outside its range, two combinations of one name.
        WorkerError: a preset or a variation is not valid.
    """
    what = f"batch {path.name}"
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = getattr(error, "strerror", None) or getattr(error, "problem", None) or error
        raise BatchError(f"{what} must be readable YAML, got: {reason}") from error
    try:
        matrix = Matrix.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the file"
        raise BatchError(f"{what}: {place} must be valid, got {first['input']!r}; {first['msg'].lower()}") from error
    return expand(matrix, path.parent, what)


def expand(matrix: Matrix, folder: Path, what: str = "batch") -> list[BatchItem]:
    """The combinations of a matrix; scenes that are files are taken relative to `folder`.

    Raises:
        BatchError: no or too many combinations, or two of one name.
    """
    presets = [row if isinstance(row, PresetRow) else PresetRow(name=row) for row in matrix.presets]
    for row in presets:
        Settings.preset_named(row.name).override({**matrix.settings, **row.settings})
    for kind, names in (("scenes", matrix.scenes), ("presets", [row.label or row.name for row in presets]),
                        ("variations", [row.name for row in matrix.variations])):  # fmt: skip
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise BatchError(f"{what}: {kind} must have names of their own, got {twice[0]!r} twice; add a label")
    num_items = len(matrix.scenes) * len(presets) * sum(row.count for row in matrix.variations)
    if num_items > MAX_ITEMS:
        raise BatchError(f"{what} must have at most {MAX_ITEMS} combinations, got {num_items}; split it")
    return [item for scene in matrix.scenes for item in _items_of_scene(matrix, presets, scene, folder, what)]


def _items_of_scene(matrix: Matrix, presets: list[PresetRow], base: str, folder: Path,
                    what: str) -> Iterator[BatchItem]:  # fmt: skip
    file = folder / base
    source = str(file) if file.exists() else base
    for row in matrix.variations:
        for index in range(row.count):
            variation = row.variation(derived_seed(matrix.seed, base, row.name, index))
            if row.count > 1 and not variation.changes_something:
                raise BatchError(f"{what}: variation {row.name} must change something, got {row.count} equal ones")
            variant = row.name if row.count == 1 else f"{row.name}-{index}"
            for preset in presets:
                label = preset.label or preset.name
                yield BatchItem(
                    label=f"{base}/{label}/{variant}", base=base, scene=join_source(source, variation),
                    preset=label, preset_name=preset.name, overrides={**matrix.settings, **preset.settings},
                    resolution=matrix.resolution, variation=variation if variation.changes_something else None,
                    stages=tuple(matrix.stages), input_spp=tuple(sorted(set(matrix.input_spp))),
                )  # fmt: skip


def derived_seed(seed: int, base: str, name: str, index: int) -> int:
    """The seed of one variation, uint32: from the batch's seed, the scene as written, and the variation's name."""
    return seed_from_key(canonical_json(["batch", seed, base, name, index]).decode("ascii"))
