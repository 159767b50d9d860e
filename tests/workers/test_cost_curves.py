"""Cost curves: fits against known powers, rows from stand-ins, and one real sample of `tiny`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from storage.store import Store
from workers.cost_curves import KINDS, QUANTITIES, CurveBudget, fitted, run_cost_curves
from workers.cost_sample import CostRequest, CostSample, measure
from workers.errors import WorkerError
from workers.progress import Progress
from workers.scene import Scene, load_scene
from workers.settings import Settings

SETTINGS = Settings.preset_named("tiny").override(
    {"width": 16, "height": 16, "cache.max_elements": 300, "cache.diffuse_spp": 4, "cache.directional_spp": 1,
     "cache.azimuth": 4, "cache.polar": 2, "cache.elements_per_unit": 32}
)  # fmt: skip


@pytest.fixture(scope="module")
def tiny() -> Scene:
    return load_scene("tiny", width=16, height=16)


def request(target: int, **values: Any) -> CostRequest:
    facts: dict[str, Any] = {
        "source": "tiny", "settings": SETTINGS.to_json(), "frame_size": (24, 20), "sample_paths": 1,
        "memory_nbytes": 2**30,
    }  # fmt: skip
    return CostRequest(target=target, **facts | values)


class Fake:
    """Costs as known powers of the number of triangles; counts its frames."""

    closed: ClassVar[list[int]] = []

    def __init__(self, asked: CostRequest, told: Callable[[str], None]) -> None:
        told("bake")
        n, power = asked.target, 1.0 if asked.settings["cache"]["elements"] == "triangle" else 0.0
        self.asked, self.frames = asked, 0
        self.figures = {
            "target": n, "triangles": n, "rule": "tessellated", "elements": 10 * n**power, "directional_elements": 0,
            "spacing_px": 2.0, "elements_seconds": 1e-3 * n**0.5, "elements_nbytes": 10, "bake_paths": 4 * n**power,
            "bake_seconds": 2 * n**power, "bake_seconds_error": 0.0, "cache_nbytes": 8, "sampled_paths": 2,
            "nbytes": 8 * n**power, "memory_nbytes": None if n > 1000 and power else 100 * n**0.25,
            "peak_resident_nbytes": 1,
        }  # fmt: skip

    def frame(self, index: int = 0) -> None:
        assert self.figures["memory_nbytes"] is not None
        self.frames += 1

    def close(self) -> None:
        self.closed.append(self.asked.target)


def exponents(result: dict[str, Any]) -> dict[tuple[str, str], Any]:
    return {(fit["kind"], fit["quantity"]): fit["exponent"] for fit in result["exponents"]}


def test_curves_of_known_powers(tiny: Scene) -> None:
    Fake.closed.clear()
    budget = CurveBudget(triangles=(10_000, 100, 1000), repeats=2)
    result = run_cost_curves(tiny, SETTINGS, budget, Progress(), Fake)
    assert [(row["kind"], row["target"]) for row in result["rows"]] == [
        (kind, target) for target in (100, 1000, 10_000) for kind in KINDS
    ]
    found = exponents(result)
    assert found["lattice", "bake_paths"] == pytest.approx(0.0, abs=1e-9)
    assert found["triangle", "bake_seconds"] == pytest.approx(1.0)
    assert found["lattice", "elements_seconds"] == pytest.approx(0.5)
    assert found["triangle", "memory_nbytes"] == pytest.approx(0.25)  # of the two that fit
    assert [row["query_ms"] is None for row in result["rows"]] == [False] * 5 + [True]
    assert any("triangle at 10,000" in note for note in result["notes"])
    assert len(Fake.closed) == 6


def test_samples_are_closed_where_one_refuses(tiny: Scene) -> None:
    class Refusing(Fake):
        def __init__(self, asked: CostRequest, told: Callable[[str], None]) -> None:
            if asked.target == 1000:
                raise WorkerError("too many")
            super().__init__(asked, told)

    Fake.closed.clear()
    with pytest.raises(WorkerError, match="too many"):
        run_cost_curves(tiny, SETTINGS, CurveBudget(triangles=(100, 1000)), Progress(), Refusing)
    assert Fake.closed == [100, 100]


def test_fit_tells_its_error() -> None:
    rng = np.random.default_rng(3)
    counts = np.geomspace(10, 1e6, 12)
    rows: list[dict[str, Any]] = [{"kind": "a", "triangles": n, **dict.fromkeys(QUANTITIES)} for n in counts]
    for row in rows:
        row["bake_seconds"] = row["triangles"] ** 0.8 * np.exp(rng.normal(0, 0.2))
    fits = {fit["quantity"]: fit for fit in fitted(rows)}
    fit = fits["bake_seconds"]
    assert abs(fit["exponent"] - 0.8) < 3 * fit["standard_error"] < 0.2 and fit["points"] == 12
    assert fits["query_ms"]["exponent"] is None and fits["query_ms"]["points"] == 0
    two = {fit["quantity"]: fit for fit in fitted(rows[:2])}["bake_seconds"]
    assert two["exponent"] is not None and two["standard_error"] is None


@pytest.mark.parametrize("values", [{"triangles": (100,)}, {"triangles": (0, 5)}, {"repeats": 0}, {"sample_paths": 0}])
def test_budget_that_is_none_is_refused(values: dict[str, Any]) -> None:
    with pytest.raises(WorkerError):
        CurveBudget(**values)


def test_sample_measures_what_it_says(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "store", create=True)
    program, camera, figures = measure(request(1000), store)
    assert program is not None and program.run(camera).shape[:2] == (20, 24)
    assert figures["rule"] == "tessellated" and 700 < figures["triangles"] < 1300
    assert 0 < figures["elements"] <= 300
    assert figures["bake_paths"] == (1 + 2) * figures["diffuse_elements"] + 8 * figures["directional_elements"]
    assert 0 < figures["sampled_paths"] <= figures["bake_paths"]
    for name in ("elements_seconds", "bake_seconds", "nbytes", "memory_nbytes", "peak_resident_nbytes"):
        assert figures[name] > 0


@pytest.mark.slow
def test_scaled_sample_agrees_with_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = measure(request(400, sample_paths=10**9), Store.open(tmp_path / "a", create=True))[2]
    monkeypatch.setattr("workers.cost_sample.LANES_PER_LAUNCH", 1)  # one unit a launch
    asked = request(400, memory_nbytes=1)
    program, _, part = measure(asked, Store.open(tmp_path / "b", create=True))
    assert whole["sampled_paths"] == whole["bake_paths"] == part["bake_paths"] > part["sampled_paths"]
    assert whole["bake_seconds_error"] == 0.0 < part["bake_seconds_error"]
    assert part["cache_nbytes"] == pytest.approx(whole["cache_nbytes"], rel=0.35)
    assert program is None and part["memory_nbytes"] is None  # too large to be opened


@pytest.mark.slow
def test_sample_in_a_process_of_its_own() -> None:
    steps: list[str] = []
    sample = CostSample(request(400), steps.append)
    sample.frame()
    sample.close()
    assert steps == ["scene", "elements", "bake diffuse", "bake directional", "query"]
    assert sample.figures["elements"] > 0
    with pytest.raises(WorkerError, match="SceneError"):
        CostSample(request(400, source="nowhere.xml"))
