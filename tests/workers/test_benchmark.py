"""Benchmarks: what is timed against what, on an untrained network and a tiny bake."""

import dataclasses
import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest
import torch

from models.network import FusionNet, NetworkConfig, network_flops
from models.transfer import Transfer
from storage.store import Store
from workers import benchmark, timing
from workers.bake import run_bake
from workers.direction_grids import directional_cost
from workers.element_stage import run_elements
from workers.errors import WorkerError
from workers.progress import Progress
from workers.query import CHANNELS
from workers.reconstruct import Encoding, Reconstructor
from workers.renderer import FrameRenderer
from workers.run_state import RunState
from workers.scene import load_scene
from workers.settings import Settings

SIZE = (50, 34)  # no multiple of the network's: padding must be counted


class Clock:
    """A clock that only moves when it is told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    return clock


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunState:
    scene = load_scene("tiny", width=32, height=32)
    overrides = {"width": 32, "height": 32, "cache.max_elements": 300, "cache.diffuse_spp": 4}
    settings = Settings.preset_named("tiny").override(overrides)
    store = Store.open(tmp_path_factory.mktemp("benchmark"), create=True)
    state = RunState(scene, store, settings)
    run_bake(state, run_elements(state))
    return state


@pytest.fixture(scope="module")
def renderer(run: RunState) -> FrameRenderer:
    program, _ = benchmark.query_programs(run)
    network = FusionNet(NetworkConfig(widths=(16, 16, 16)))
    torch.nn.init.constant_(network.head.bias, 1e-3)  # one that changes nothing is not computed
    encoding = Encoding(1.0, 10.0, Transfer())
    return FrameRenderer(program, Reconstructor(network, encoding, precision="fp32"))


@pytest.fixture(scope="module")
def times(renderer: FrameRenderer, run: RunState) -> dict[str, Any]:
    _, single = benchmark.query_programs(run)
    return benchmark.frame_times(renderer, single, run.scene, *SIZE, 1)


# ------------------------------------------------- clocks --------------------------------------------------


def test_interleaved_medians_run_all_methods_each_round_right_after_a_run_that_does_not_count(clock: Clock) -> None:
    seconds = {"a": [3.0, 1.0, 2.0], "b": [50.0, 30.0, 40.0]}
    order: list[tuple[int, str]] = []

    def method(name: str) -> Any:
        def work(index: int) -> None:
            is_warm = order[-1:] == [(index, name)]
            order.append((index, name))
            clock.now += seconds[name][index] if is_warm else 1000.0

        return work

    medians = timing.interleaved_medians({n: method(n) for n in seconds}, 3, Progress(), "test")
    assert medians == {"a": 2.0, "b": 40.0}
    assert order == [(index, name) for index in range(3) for name in ("a", "a", "b", "b")]


def test_matmul_rate_counts_a_multiply_add_as_two(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter(range(100))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(ticks)))
    rate = timing.matmul_gflop_per_s(torch.float32, torch.device("cpu"), edge=8)
    assert rate == pytest.approx(2 * 8**3 / 1e9)


def test_matmul_grows_until_it_takes_long_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    edges: list[int] = []

    def seconds(dtype: Any, device: Any, edge: int) -> float:
        edges.append(edge)
        return edge**3 * 1e-9

    monkeypatch.setattr(timing, "_matmul_seconds", seconds)
    assert timing.matmul_gflop_per_s(torch.bfloat16, torch.device("cpu"), edge=4096) == pytest.approx(2.0)
    assert edges == [256, 512]


@pytest.mark.parametrize(("slowdown", "fast"), [(0.5, True), (1.5, True), (300.0, False)])
def test_bf16_is_fast_where_the_machine_computes_in_it(
    monkeypatch: pytest.MonkeyPatch, slowdown: float, fast: bool
) -> None:
    monkeypatch.setattr(timing, "_matmul_seconds", lambda dtype, *_: slowdown if dtype == torch.bfloat16 else 1.0)
    assert timing.bf16_is_fast.__wrapped__(torch.device("cpu")) is fast


def test_other_load_is_what_is_busy_beside_this_process_and_its_children(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = SimpleNamespace(user=100.0, system=10.0, idle=0.0)
    own = SimpleNamespace(seconds=(5.0, 1.0, 0.0, 0.0))
    started: list[SimpleNamespace] = []
    fake = SimpleNamespace(
        Process=lambda: SimpleNamespace(cpu_times=lambda: own.seconds, children=lambda: started),
        NoSuchProcess=psutil.NoSuchProcess,
        cpu_times=lambda: machine,
        cpu_count=lambda: 4,
    )

    def ended() -> None:
        raise psutil.NoSuchProcess(1)

    monkeypatch.setattr(timing, "psutil", fake)
    with timing.other_load() as load:
        clock.now += 10.0
        machine.user, machine.system, machine.idle = 130.0, 15.0, 5.0  # 35 s busy
        own.seconds = (13.0, 3.0, 2.0, 0.0)  # 12 s of them ours, 2 s of those of a child that ended
        started.append(SimpleNamespace(cpu_times=lambda: (2.5, 0.5, 0.0, 0.0), children=list))
        started.append(SimpleNamespace(cpu_times=ended))
    assert load == {"other_cpus": 2.0, "cpus": 4.0}


# ------------------------------------------------ one frame ------------------------------------------------


def test_primary_rays_hit_where_the_query_sees_a_surface(run: RunState) -> None:
    camera = run.scene.camera.resized(*SIZE)
    rays = benchmark.PrimaryRays(run.scene.mi_scene)
    _, single = benchmark.query_programs(run)
    features = single.run(camera).reshape(camera.width * camera.height, -1)
    seen = features[:, CHANNELS["distance"][0]]
    assert (seen > 0).sum() > 100
    for _ in range(2):  # recorded, then replayed
        distance = rays.cast(camera).numpy()
        assert np.allclose(np.where(np.isfinite(distance), distance, 0.0), seen, rtol=1e-3)


def test_query_programs_are_the_runs_own_and_one_ray_a_pixel(run: RunState) -> None:
    own, single = benchmark.query_programs(run)
    assert own.settings == run.settings.query and own.settings.samples == 2
    assert single.settings == dataclasses.replace(own.settings, samples=1)


def test_frame_times_tell_every_part_and_are_json(times: dict[str, Any]) -> None:
    assert set(times["ms"]) == {
        "primary", "query-1x1", "query", "network", "frame", "pt-1",
        "oidn-fast", "oidn-balanced", "oidn-high",
    }  # fmt: skip
    assert all(value > 0 for value in times["ms"].values())
    assert (times["width"], times["height"], times["samples"]) == (*SIZE, 2)
    assert json.loads(json.dumps(times)) == times


def test_frame_ratios_are_those_of_the_times(times: dict[str, Any]) -> None:
    ms = times["ms"]
    assert times["ratios"] == {
        "query-1x1 / primary": ms["query-1x1"] / ms["primary"],
        "query / primary": ms["query"] / ms["primary"],
        "frame / oidn-fast": ms["frame"] / ms["oidn-fast"],
        "frame / oidn-balanced": ms["frame"] / ms["oidn-balanced"],
        "frame / (pt-1 + oidn-fast)": ms["frame"] / (ms["pt-1"] + ms["oidn-fast"]),
    }


def test_network_rate_counts_the_padded_frame(renderer: FrameRenderer, times: dict[str, Any]) -> None:
    config, network = renderer.reconstructor.config, times["network"]
    assert config.size_multiple == 8
    assert network["gflop"] == network_flops(config, 40, 56) / 1e9
    assert network["gflop_per_s"] == pytest.approx(network["gflop"] / times["ms"]["network"] * 1e3)
    assert network["choice"] == "fp32"
    assert network["share"] == network["gflop_per_s"] / network["peak_gflop_per_s"]["fp32"]


def test_measure_scene_names_the_command_where_nothing_was_run(run: RunState, tmp_path: Path) -> None:
    store = Store.open(tmp_path / "empty", create=True)
    store.register_scene(run.scene.digest, {"name": "tiny", "source": "tiny"})
    with pytest.raises(WorkerError, match="lightwell run tiny --store"):
        benchmark.measure_scene(run.scene, store, SIZE, 1, Progress())


# ------------------------------------------------- the bake ------------------------------------------------


def test_spread_batch_takes_everything_that_fits() -> None:
    owners = np.arange(100, 122)
    batch = benchmark.spread_batch(owners, 8, 4, 1 << 20)
    assert np.array_equal(batch.element, owners)
    assert np.array_equal(batch.seed, [0] * 8 + [1] * 8 + [2] * 6)
    assert np.array_equal(batch.place, [*range(8), *range(8), *range(6)])


def test_spread_batch_spreads_whole_units_over_the_scene() -> None:
    batch = benchmark.spread_batch(np.arange(80), 8, 4, 3 * 8 * 4)
    assert np.unique(batch.seed).tolist() == [0, 4, 9]
    assert np.array_equal(batch.element, np.concatenate([np.arange(8) + 8 * unit for unit in (0, 4, 9)]))


def test_spread_batch_holds_a_unit_even_where_it_exceeds_a_launch() -> None:
    assert np.array_equal(benchmark.spread_batch(np.arange(20), 8, 1000, 10).element, np.arange(8))


def test_bake_throughput_counts_the_paths_of_both_lobes_and_of_mitsuba(run: RunState) -> None:
    result = benchmark.bake_throughput(run, 1)
    elements, cache = run_elements(run), run.settings.cache
    paths = dict(result["paths"])
    traced = paths.pop(benchmark.PATH_TRACER)
    num_diffuse = len(elements.diffuse)
    assert paths.pop("diffuse-traced") == num_diffuse * cache.diffuse_spp // 4
    assert paths.pop("diffuse") == num_diffuse * cache.diffuse_spp // 2
    assert sum(paths.values()) == directional_cost(elements, cache)["paths"] > 0
    assert traced == pytest.approx(max(result["paths"].values()), abs=32 * 32 / 2)
    rates = result["paths_per_s"]
    assert result["ratios"] == {name: rates[name] / rates[benchmark.PATH_TRACER] for name in result["paths"]
                                if name != benchmark.PATH_TRACER}  # fmt: skip
    assert json.loads(json.dumps(result)) == result


def test_bake_throughput_of_exitant_caches_has_no_diffuse_lobe(run: RunState) -> None:
    overrides = {"cache.lobes": "exitant", "cache.max_elements": 50, "cache.elements_per_unit": 16}
    exitant = dataclasses.replace(run, settings=run.settings.override(overrides))
    result = benchmark.bake_throughput(exitant, 1, lanes_per_launch=4096)
    cache = exitant.settings.cache
    assert set(result["ratios"]) == {"directional"}
    assert result["paths"]["directional"] % (cache.azimuth * cache.polar * cache.directional_spp) == 0


def test_spread_is_what_single_rounds_stray_from_the_others() -> None:
    rng = np.random.default_rng(1)
    rounds = [list(base * np.exp(rng.normal(0, 0.1, 200))) for base in (1.0, 50.0)]
    assert timing.spread_of(rounds) == pytest.approx(np.exp(1.645 * 0.1) - 1, abs=0.03)  # the normal's 95 % quantile
    assert timing.spread_of([[2.0, 2.0, 2.0]]) == 0.0
    assert timing.spread_of([[1.0, 3.0]], share=0.999) == pytest.approx(2.0, rel=0.01)


def test_spread_of_single_rounds_is_not_known() -> None:
    assert timing.spread_of([[1.0], [7.0]]) == 0.0
