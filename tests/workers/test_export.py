"""ONNX export: the file computes what PyTorch does at any size, says what it is, and is refused where it does not."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

onnx = pytest.importorskip("onnx", reason="the onnx extra is not installed")
ort = pytest.importorskip("onnxruntime", reason="the onnx extra is not installed")

from models.network import FusionNet, NetworkConfig  # noqa: E402
from models.transfer import Transfer  # noqa: E402
from storage.frames import encode_frame  # noqa: E402
from storage.layout import UnitRef  # noqa: E402
from storage.store import Store  # noqa: E402
from storage.weights import encode_network  # noqa: E402
from workers import export as export_module  # noqa: E402
from workers.export import Exported, ExportError, difference, export_network, export_scene  # noqa: E402
from workers.inputs import to_layers  # noqa: E402
from workers.query import NUM_CHANNELS  # noqa: E402
from workers.reconstruct import Encoding, FrameModule  # noqa: E402

ENCODING = Encoding(0.7, 5.0, Transfer())
FACTS = {"scene": "tiny", "scene_digest": "d1", "network_key": "k1", "trained_size": [32, 32]}


def network(**config: Any) -> FusionNet:
    """A small network whose residual is not zero."""
    torch.manual_seed(0)
    net = FusionNet(NetworkConfig(widths=(16, 16, 16), **config)).eval()
    torch.nn.init.normal_(net.head.weight, std=0.05)
    return net


def features(height: int = 24, width: int = 32, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    frame = rng.uniform(-1, 1, (height, width, NUM_CHANNELS)).astype(np.float32)
    frame[..., :3] = rng.lognormal(0, 2, (height, width, 3))
    frame[..., 9] = rng.uniform(0, 20, (height, width))
    return frame


@pytest.fixture(scope="module")
def exported() -> Exported:
    return export_network(network(), ENCODING, [features()], FACTS)


@pytest.mark.parametrize("size", [(24, 32), (37, 51), (2, 9), (64, 128)])
def test_file_computes_what_pytorch_does_at_any_size(exported: Exported, size: tuple[int, int]) -> None:
    frame = features(*size, seed=1)
    session = ort.InferenceSession(exported.data, providers=["CPUExecutionProvider"])
    (radiance,) = session.run(["radiance"], {"features": frame})
    with torch.inference_mode():
        expected = FrameModule(network(), ENCODING)(torch.from_numpy(frame)).numpy()
    assert radiance.shape == (*size, 3) and radiance.dtype == np.float32
    assert difference(radiance, expected, ENCODING.exposure) < 1e-4
    assert difference(radiance, frame[..., :3], ENCODING.exposure) > 1e-3, "the network does something"


def test_file_says_what_it_is(exported: Exported) -> None:
    model = onnx.load_from_string(exported.data)
    session = ort.InferenceSession(exported.data, providers=["CPUExecutionProvider"])
    (inputs,), (outputs,) = session.get_inputs(), session.get_outputs()
    assert (inputs.name, inputs.shape) == ("features", ["height", "width", NUM_CHANNELS])
    assert (outputs.name, outputs.shape) == ("radiance", ["height", "width", 3])
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert metadata == {**metadata, **exported.metadata}
    assert metadata["lightwell.scene_digest"] == "d1"
    assert json.loads(metadata["lightwell.exposure"]) == 0.7
    assert json.loads(metadata["lightwell.distance_scale"]) == 5.0
    assert json.loads(metadata["lightwell.transfer"]) == {"curve": "mu-law", "mu": 16.0}
    assert json.loads(metadata["lightwell.input_channels"])["ir"] == [0, 3]
    assert float(metadata["lightwell.measured_error"]) == pytest.approx(exported.error, rel=0.01)
    assert exported.num_pixels == 24 * 32 + 21 * 27


def test_paper_exact_network_with_log_transfer_can_be_exported() -> None:
    config = {"unshuffle": 1, "residual": False, "fusion": "concatenate"}
    result = export_network(network(**config), Encoding(2.0, 1.0, Transfer(curve="log1p")), [features()], FACTS)
    assert 0 < result.error < 1e-4


def test_file_that_is_off_is_refused(monkeypatch: pytest.MonkeyPatch, exported: Exported) -> None:
    model = onnx.load_from_string(exported.data)
    weights = [tensor for tensor in model.graph.initializer if tensor.dims and np.prod(tensor.dims) > 100]
    damaged = onnx.numpy_helper.to_array(weights[0]).copy()
    damaged *= 1.05
    weights[0].CopyFrom(onnx.numpy_helper.from_array(damaged, weights[0].name))
    monkeypatch.setattr(export_module, "_to_onnx", lambda module: model)
    with pytest.raises(ExportError, match=r"within 0\.0001 of PyTorch in exposed radiance, got"):
        export_network(network(), ENCODING, [features()], FACTS)


def test_tolerance_that_nothing_meets_is_refused(monkeypatch: pytest.MonkeyPatch, exported: Exported) -> None:
    monkeypatch.setattr(export_module, "_to_onnx", lambda module: onnx.load_from_string(exported.data))
    with pytest.raises(ExportError, match="raise --tolerance"):
        export_network(network(), ENCODING, [features()], FACTS, tolerance=0.0)


def test_difference_is_infinite_where_only_one_is_finite() -> None:
    good, bad = np.ones((1, 2, 3)), np.array([[[1, 1, 1], [1, np.nan, 1]]])
    assert difference(good, bad, 1.0) == difference(bad, good, 1.0) == float("inf")
    assert difference(bad, bad, 1.0) == 0.0
    assert difference(good[:, :1], good, 1.0) == float("inf")
    assert difference(np.full((1, 1, 3), 2e4), np.full((1, 1, 3), 1e4), 1.0) == pytest.approx(1.0, rel=1e-3)


def fill(store: Store, *, with_inputs: bool = True) -> None:
    """A store as a run leaves it, as far as an export looks."""
    config = {"network": {"ir_channels": 3, "gbuffer_channels": 7, "widths": (16, 16, 16), "fusion": "fuse",
                          "unshuffle": 2, "residual": True}, "encoding": ENCODING.to_json()}  # fmt: skip
    weights, description = encode_network(network().state_dict(), config)
    store.commit(UnitRef("d1", "train", "k1"), {"network.safetensors": weights, "network.json": description}, {})
    for index in range(6 if with_inputs else 0):
        frame = encode_frame(to_layers(features(seed=index)))
        store.commit(UnitRef("d1", "inputs", f"i{index}"), {"inputs.exr": frame}, {})
    store.register_scene("d1", {"name": "tiny", "source": "tiny", "network": "k1", "width": 32, "height": 24})


def test_scene_of_a_store_is_exported_without_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exported: Exported
) -> None:
    monkeypatch.setattr(export_module, "_to_onnx", lambda module: onnx.load_from_string(exported.data))
    store = Store.open(tmp_path, create=True)
    fill(store)
    result = export_scene(store, "tiny")
    assert result.num_pixels == 4 * (24 * 32 + 21 * 27), "four of the queried poses, each at two sizes"
    assert json.loads(result.metadata["lightwell.trained_size"]) == [32, 24]


def test_scene_that_cannot_be_checked_is_refused(tmp_path: Path) -> None:
    store = Store.open(tmp_path, create=True)
    store.register_scene("d2", {"name": "hall", "source": "hall.xml"})
    with pytest.raises(ExportError, match="must have a trained network"):
        export_scene(store, "hall")
    fill(store, with_inputs=False)
    with pytest.raises(ExportError, match="must have queried features"):
        export_scene(store, "tiny")
