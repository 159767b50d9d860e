"""The main job on `tiny`: every stage, resumed, damaged, and asked over HTTP for a frame."""

import io
import json
import time
import zipfile

import numpy as np
import pytest
import torch
from fastapi.testclient import TestClient
from PIL import Image

from models.network import FusionNet
from service.app import create_app
from service.jobs.dataset import pack_apart
from service.jobs.planner import plan_apart
from storage.caches import CacheSet
from storage.frames import decode_frame
from storage.store import Store
from workers.bake import bake_refs, bake_units, run_bake
from workers.element_stage import run_elements
from workers.errors import SceneError, WorkerError
from workers.pipeline import evaluate_scene, published_settings, run_scene
from workers.progress import Progress
from workers.reconstruct import Reconstructor
from workers.renderer import FrameRenderer, renderable_scenes
from workers.run_state import RunState
from workers.scene import load_scene
from workers.settings import Settings, SettingsError
from workers.timing import bf16_is_fast
from workers.train import train_ref
from workers.trainer import Trainer
from workers.training_data import load_dataset

SIZE = 64
CAMERA = {"look_at": {"origin": [0.0, 1.0, 2.4], "target": [0.0, 0.7, 0.0], "up": [0, 1, 0]}}


@pytest.fixture(scope="module")
def scene():
    return load_scene("tiny", width=SIZE, height=SIZE)


@pytest.fixture(scope="module")
def settings():
    return Settings.preset_named("tiny")


@pytest.fixture(scope="module")
def prepared(scene, settings, tmp_path_factory):
    """(store, evaluation) after one whole run."""
    store = Store.open(tmp_path_factory.mktemp("store"), create=True)
    return store, run_scene(scene, store, settings, Progress())


def test_run_result_has_every_method_and_finite_scores(prepared):
    _, evaluation = prepared
    rows = {row["name"]: row for row in evaluation.result["rows"]}
    assert {"ours", "ir", "ir+oidn", "pt-1", "pt-1+oidn-fast", "pt-1+oidn-high"} <= set(rows)
    for row in rows.values():
        assert row["non_finite"] == 0
        assert row["ms"] > 0
        assert np.isfinite([row[key] for key in ("psnr", "ssim", "flip", "relmse", "temporal")]).all()
    assert {stage["name"] for stage in evaluation.result["stages"]} >= {"elements", "bake diffuse", "train", "evaluate"}
    assert evaluation.result["cache_nbytes"] > 0
    assert evaluation.result["network_nbytes"] > 0


def test_run_ir_is_closer_to_the_reference_than_one_path(prepared):
    rows = {row["name"]: row for row in prepared[1].result["rows"]}
    assert rows["ir"]["psnr"] > rows["pt-1"]["psnr"] + 5.0
    assert rows["ours"]["psnr"] > rows["pt-1"]["psnr"] + 5.0


def test_run_again_computes_nothing(prepared, scene, settings):
    store, _ = prepared
    before = {ref: store.committed(ref)["created_unix_s"] for stage in ("elements", "render", "inputs", "train")
              for ref in store.units(scene.digest, stage)}  # fmt: skip
    start = time.perf_counter()
    run = RunState(scene, store, settings)
    elements = run_elements(run)
    run_bake(run, elements)
    assert "bake" not in run.seconds
    evaluate_scene(scene, store, settings, Progress())
    assert time.perf_counter() - start < 60
    after = {ref: store.committed(ref)["created_unix_s"] for ref in before}
    assert after == before


def test_evaluation_follows_what_it_is_asked_for(prepared, scene, settings):
    store, _ = prepared
    assert published_settings(scene, store) == settings
    asked = settings.override({"evaluation.spp": (2,), "evaluation.qualities": ("fast",)})
    names = {row["name"] for row in evaluate_scene(scene, store, asked, Progress()).result["rows"]}
    assert names == {"ours", "ir", "ir+oidn", "pt-2", "pt-2+oidn-fast"}
    with pytest.raises(WorkerError, match="must be run with these settings"):
        evaluate_scene(scene, store, settings.override({"cache.diffuse_spp": 32}), Progress())


def test_bake_of_a_lost_unit_is_bit_identical(prepared, scene, settings):
    store, _ = prepared
    run = RunState(scene, store, settings)
    elements = run_elements(run)
    for ref in bake_refs(run, elements).values():
        caches = CacheSet.open(store, ref)
        before = caches.load()
        store_files = caches.unit_record(0)
        caches.discard_unit(0)
        _rebake(run, elements, ref)
        after = CacheSet.open(store, ref).load()
        for name in before:
            np.testing.assert_array_equal(after[name], before[name])
        assert CacheSet.open(store, ref).unit_record(0)["rows_sha256"] == store_files["rows_sha256"]


def _rebake(run, elements, ref):
    name = next(name for name, found in bake_refs(run, elements).items() if found == ref)
    bake_units(run, elements, name, range(1))


def _trainer(prepared, scene, settings, overrides):
    """A trainer on the prepared run's frames, and a function that makes another one of the same unit."""
    from workers.inputs import inputs_ref
    from workers.render import render_ref

    store, _ = prepared
    run = RunState(scene, store, settings.override(overrides))
    elements = run_elements(run)
    inputs = [inputs_ref(run, elements, camera) for camera in run.paths.train]
    renders = [render_ref(run, camera, run.settings.frames.train_spp) for camera in run.paths.train]
    dataset = load_dataset(run, inputs, renders)
    ref = train_ref(run, inputs, renders)
    return Trainer(run, ref, dataset, None), lambda: Trainer(run, ref, dataset, None)


def test_trainer_resumes_with_the_identical_next_loss(prepared, scene, settings, tmp_path):
    first, again = _trainer(prepared, scene, settings, {"train.seconds": 0.0, "train.epochs": 2})
    first.num_steps = 10
    for _ in range(3):
        first.train_step()
    first.save_checkpoint()
    expected = [first.train_step()["total"] for _ in range(2)]
    resumed = again()
    assert resumed.step == 3
    assert [resumed.train_step()["total"] for _ in range(2)] == expected


def test_gradients_are_clipped_at_what_is_usual(prepared, scene, settings):
    trainer, _ = _trainer(prepared, scene, settings, {"train.clip_quantile": 0.5, "train.clip_norm": 0.5})
    assert [trainer._clip_at(norm) for norm in (0.1, 0.3, 0.2)] == pytest.approx([0.1, 0.2, 0.2])
    assert [trainer._clip_at(1e6) for _ in range(9)][-1] == 0.5
    trainer.norms.clear()
    trainer.norms.extend([1e-9] * 500)  # what is usual is hardly anything: a step moves the optimizer's mean as much
    trainer.num_steps = 10
    trainer.train_step()
    means = [state["exp_avg"] for state in trainer.optimizer.state.values()]
    assert 0 < float(torch.stack([mean.norm() for mean in means]).norm()) <= 1.01e-10


def test_no_epochs_train_a_network_that_hands_on_the_caches(prepared, scene, settings):
    trainer, _ = _trainer(prepared, scene, settings, {"train.epochs": 0})
    trainer.fit()
    assert (trainer.step, len(trainer.curve)) == (0, 1)
    network = FusionNet(trainer.config)
    network.load_state_dict(trainer.best_state())
    assert Reconstructor(network, trainer.encoding).hands_on
    with pytest.raises(SettingsError, match=r"train\.epochs"):
        settings.override({"train.epochs": 0, "train.residual": False})


@pytest.mark.parametrize(("probed_s", "later_s"), [(1.0, 0.1), (0.1, 0.3)])
def test_trainer_keeps_its_seconds_where_the_probe_was_wrong(prepared, scene, settings, monkeypatch, probed_s, later_s):
    from workers import trainer as module

    budget_s, clock = 60.0, {"now": 0.0}
    monkeypatch.setattr(module.time, "perf_counter", lambda: clock["now"])
    trainer, _ = _trainer(prepared, scene, settings, {"train.seconds": budget_s, "train.epochs": 1_000_000})
    probed = module.PROBE_STEPS + 1
    taken = []

    def step() -> dict[str, float]:
        is_probe = len(taken) < probed * (2 if bf16_is_fast(trainer.device) else 1)
        clock["now"] += probed_s if is_probe else later_s
        taken.append(is_probe)
        trainer.step += 1
        return {"total": 0.0}

    monkeypatch.setattr(trainer, "train_step", step)
    trainer.fit()
    assert trainer.step == trainer.num_steps
    assert trainer.step * later_s == pytest.approx(budget_s, rel=0.02)


def test_frames_of_a_job_are_packed_by_a_process_of_its_own(prepared, settings, tmp_path):
    store, _ = prepared
    spec = {"scene": "tiny", "settings": settings.to_json(), "stages": ["bake", "render"]}
    pack_apart(store.url, spec, tmp_path / "dataset.zip")
    with zipfile.ZipFile(tmp_path / "dataset.zip") as file:
        manifest = json.loads(file.read("manifest.json"))
        assert len(manifest["frames"]) == 7 and manifest["splits"] == {"train": 4, "valid": 1, "test": 2}
        assert len([name for name in file.namelist() if name.endswith(".hdr.exr")]) == 7
    assert [path.name for path in tmp_path.iterdir()] == ["dataset.zip"]
    with pytest.raises(WorkerError, match="must be rendered"):
        other = settings.override({"frames.train_spp": 16}).to_json()
        pack_apart(store.url, spec | {"settings": other}, tmp_path / "other.zip")


def test_plan_is_made_by_a_process_of_its_own(settings):
    plan = plan_apart("tiny", settings)
    assert plan["cost"]["paths"] > 0 and plan["rows"]
    with pytest.raises(SceneError, match=r"got 'nowhere\.xml'"):
        plan_apart("nowhere.xml", settings)


def test_renderer_answers_a_pose_far_outside_the_domain(prepared, scene):
    from workers.camera import Camera

    renderer = FrameRenderer.open(prepared[0], scene.digest)
    bounds = scene.bounds_centre
    camera = Camera.look_at(bounds + np.array([0.05, 0.3, -0.1]), bounds, [1, 0, 0], 100.0, 48, 40)
    frame = renderer.render(camera)
    assert frame.radiance.shape == (40, 48, 3)
    assert frame.non_finite == 0
    assert 0.0 <= frame.coverage <= 1.0
    assert frame.radiance.max() > 0


def test_service_answers_a_frame_in_every_format(prepared, scene):
    store, _ = prepared
    assert [entry["name"] for entry in renderable_scenes(store)] == ["tiny"]
    direct = FrameRenderer.open(store, "tiny").render(_camera(scene))
    body = {"camera": {"to_world": scene.camera.to_world.tolist()}, "fov_deg": scene.camera.fov_deg,
            "width": SIZE, "height": SIZE}  # fmt: skip
    with TestClient(create_app(store.url)) as client:
        listed = client.get("/v1/scenes")
        assert listed.status_code == 200
        png = client.post("/v1/scenes/tiny/frame", json=body, headers={"Accept": "image/png"})
        exr = client.post("/v1/scenes/tiny/frame", json=body, headers={"Accept": "image/x-exr"})
    assert png.status_code == 200, png.text
    assert all(name in png.headers["Server-Timing"] for name in ("query;dur=", "network;dur=", "encode;dur="))
    assert Image.open(io.BytesIO(png.content)).size == (SIZE, SIZE)
    assert exr.status_code == 200
    radiance = decode_frame(exr.content)["radiance"]
    # fp32 or bf16 is chosen by measured time, anew in each process' renderer.
    np.testing.assert_allclose(radiance, direct.radiance, rtol=0.05, atol=0.02 * float(direct.radiance.max()))


def _camera(scene):
    return scene.camera.resized(SIZE, SIZE)
