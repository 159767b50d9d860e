"""The trade of `tiny`, swept, kept and rendered from."""

import numpy as np
import pytest

from storage.store import Store
from workers.operating_points import FrameDemand, choose
from workers.operating_table import load_table
from workers.point_renderer import PointRenderer
from workers.progress import Progress
from workers.scene import load_scene
from workers.settings import Settings
from workers.tradeoff import COSTS, run_tradeoff
from workers.tradeoff_variants import TradeoffBudget

SIZE = 32
BUDGET = TradeoffBudget(network_seconds=0.5, sizes=((48, 40),), repeats=1, spp=(1,), paper=False)


@pytest.mark.slow
def test_sweep_of_tiny_gives_points_that_render(tmp_path):
    scene = load_scene("tiny", width=SIZE, height=SIZE)
    store = Store.open(tmp_path / "store", create=True)
    settings = Settings.preset_named("tiny").override(
        {"width": SIZE, "height": SIZE, "cache.max_elements": 300, "cache.diffuse_spp": 16}
    )
    table = run_tradeoff(scene, store, settings, Progress(), BUDGET)
    rows = {row["name"]: row for row in table.result["rows"]}
    assert {"ours", "fp32", "1x1 query", "half scale", "no network", "1/4 elements"} <= set(rows)
    assert {"ir+oidn", "pt-1", "pt-1+oidn-fast"} <= set(rows)
    for row in rows.values():
        assert row["non_finite"] == 0 and row["ms"] > 0 and np.isfinite(row["psnr"])
        assert set(row["pareto"]) == set(COSTS)
    assert rows["1/4 elements"]["nbytes"] < rows["ours"]["nbytes"]
    assert {(t["width"], t["height"]) for t in rows["ours"]["times"]} == {(SIZE, SIZE), (48, 40)}
    assert any("psnr" in row["pareto"]["ms"] for row in rows.values() if row["kind"] == "ours")
    assert load_table(store, scene.digest) == table
    assert store.verify() == []

    renderer = PointRenderer.open(store, "tiny", warm_up=False)
    camera = scene.camera.resized(47, 33)  # odd: half scale pads
    for point in table.points:
        frame = renderer.render(camera, point)
        assert frame.radiance.shape == (33, 47, 3) and frame.non_finite == 0
        assert frame.exposure == table.result["exposure"]
    choice = choose(table.points, FrameDemand(quality="best"), SIZE, SIZE)
    assert choice.point.psnr == max(point.psnr for point in table.points)

    before = {ref: store.committed(ref)["created_unix_s"] for stage in ("train", "render", "inputs", "elements")
              for ref in store.units(scene.digest, stage)}  # fmt: skip
    run_tradeoff(scene, store, settings, Progress(), BUDGET)
    assert before == {ref: store.committed(ref)["created_unix_s"] for ref in before}  # all of it reused
