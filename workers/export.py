"""The trained network of a scene as one ONNX file, transfer functions included, checked against PyTorch.

    features  float32 [height, width, channels], what a query gives (metadata: lightwell.input_channels)
    radiance  float32 [height, width, 3], linear scene radiance, Rec. 709 primaries

Height and width are free: sizes that the network cannot take are padded inside and cut again. What the file does not
hold is the query: features come from `QueryProgram`, or from a renderer that makes the same channels. Weights and
arithmetic are float32; the frame endpoint may have chosen bfloat16.
"""

import io
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from models.network import FusionNet
from storage.frames import decode_frame
from storage.store import Store, UnitRef
from workers.errors import WorkerError
from workers.inputs import FILE as INPUTS_FILE
from workers.inputs import STAGE as INPUTS_STAGE
from workers.network_record import read_network
from workers.query import CHANNELS, NUM_CHANNELS
from workers.reconstruct import Encoding, FrameModule
from workers.train import STAGE as TRAIN_STAGE

DEFAULT_TOLERANCE = 1e-4
OPSET = 18
INPUT, OUTPUT = "features", "radiance"
MAX_EDGE_PX = 16384
NUM_CHECKED = 4  # queried poses that the file is checked on
_EXAMPLE_EDGES_PX = (40, 56)
_PACKAGES = ("torch", "onnx", "onnxscript", "onnxruntime")


class ExportError(WorkerError, RuntimeError):
    """A network cannot be exported, or the file does not compute what PyTorch does."""


@dataclass(frozen=True)
class Exported:
    """An ONNX file and what it was measured to be.

    Attributes:
        data: the file.
        metadata: what the file says of itself.
        error: largest difference to PyTorch, see `difference`.
        num_pixels: pixels that were compared.
    """

    data: bytes
    metadata: dict[str, str]
    error: float
    num_pixels: int


class ExportModule(nn.Module):
    """Features of any size to radiance; the same as `FrameModule`, in operations that ONNX has for free sizes."""

    def __init__(self, network: FusionNet, encoding: Encoding) -> None:
        super().__init__()
        self.network, self.encoding = network, encoding

    def forward(self, features: Tensor) -> Tensor:
        """[height, width, NUM_CHANNELS] to linear radiance [height, width, 3], both float32."""
        height, width = features.shape[:2]
        multiple = self.network.config.size_multiple
        rows, columns = (
            torch.arange((edge + multiple - 1) // multiple * multiple).clamp(max=edge - 1) for edge in (height, width)
        )
        padded = features.index_select(0, rows).index_select(1, columns)
        output = self.network(*self.encoding.inputs(padded[None]))[..., :height, :width]
        return self.encoding.radiance(output)[0].permute(1, 2, 0)


def export_scene(store: Store, scene_name: str, *, tolerance: float = DEFAULT_TOLERANCE) -> Exported:
    """Exports the network that a scene is served from.

    Args:
        store: where the run lies.
        scene_name: name or digest of the scene.
        tolerance: largest `difference` to PyTorch on features that were queried from this scene.

    Raises:
        ExportError: the scene has no network or no queried features, a package is missing, or the file is off by more
            than the tolerance.
        StorageError: there is no such scene, or a unit is damaged.
    """
    entry = store.find_scene(scene_name)
    if "network" not in entry:
        raise ExportError(
            f"scene {entry['name']!r} must have a trained network in {store.url}, got none; "
            f"run: lightwell run {entry.get('source', 'SCENE')} --store {store.url}"
        )
    network, encoding = read_network(store, UnitRef(entry["digest"], TRAIN_STAGE, entry["network"]))
    features = list(queried_features(store, entry["digest"]))
    if not features:
        raise ExportError(f"scene {entry['name']!r} must have queried features to check the file on, got none in the "
                          f"store; run: lightwell run {entry.get('source', 'SCENE')} --store {store.url}")  # fmt: skip
    facts = {"scene": entry["name"], "scene_digest": entry["digest"], "network_key": entry["network"],
             "trained_size": [entry["width"], entry["height"]]}  # fmt: skip
    return export_network(network, encoding, features, facts, tolerance=tolerance)


def export_network(network: FusionNet, encoding: Encoding, features: list[np.ndarray], facts: dict[str, Any], *,
                   tolerance: float = DEFAULT_TOLERANCE) -> Exported:  # fmt: skip
    """Exports a network and checks the file on features, float32 [height, width, NUM_CHANNELS] each.

    Raises:
        ExportError: a package is missing, the exporter failed, or the file is off by more than the tolerance.
    """
    network = network.float().cpu().eval()
    model = _to_onnx(ExportModule(network, encoding).eval())
    error, num_pixels = _compare(model.SerializeToString(), FrameModule(network, encoding), encoding, features)
    if not error <= tolerance:
        raise ExportError(
            f"exported network must be within {tolerance:g} of PyTorch in exposed radiance, got {error:.3g} on "
            f"{num_pixels} pixels; raise --tolerance, or report this network"
        )
    metadata = _metadata(network, encoding, facts) | {
        "lightwell.tolerance": f"{tolerance:g}", "lightwell.measured_error": f"{error:.3g}",
        "lightwell.checked_pixels": str(num_pixels),
    }  # fmt: skip
    for key, value in metadata.items():
        model.metadata_props.add(key=key, value=value)
    return Exported(model.SerializeToString(), metadata, error, num_pixels)


def difference(radiance: np.ndarray, expected: np.ndarray, exposure: float) -> float:
    """Largest |e a - e b| / (1 + e |b|): absolute up to display white, relative above; infinite where NaN or
    infinity differ."""
    a, b = (np.asarray(image, np.float64) * exposure for image in (radiance, expected))
    if a.shape != b.shape or not np.array_equal(np.isfinite(a), np.isfinite(b)):
        return float("inf")
    finite = np.isfinite(b)
    return float(np.max(np.abs(a - b)[finite] / (1 + np.abs(b[finite])), initial=0.0))


def queried_features(store: Store, digest: str) -> Iterator[np.ndarray]:
    """Network inputs that runs of this scene queried, a few of them, float32 [height, width, NUM_CHANNELS]."""
    refs = store.units(digest, INPUTS_STAGE)
    for index in np.unique(np.linspace(0, len(refs) - 1, min(NUM_CHECKED, len(refs))).round().astype(int)):
        layers = decode_frame(store.read(refs[index], INPUTS_FILE))
        height, width = layers["ir"].shape[:2]
        features = np.zeros((height, width, NUM_CHANNELS), np.float32)
        for name, (a, b) in CHANNELS.items():
            features[..., a:b] = layers[name]
        yield features


def _to_onnx(module: nn.Module) -> Any:
    """The module as an ONNX model with free height and width."""
    try:
        import onnx
        import onnxscript  # noqa: F401  # torch's exporter is written in it
    except ImportError as error:
        raise ExportError(f"export must find onnx and onnxscript, got: {error}; pip install lightwell[onnx]") from error
    sizes = {axis: torch.export.Dim(name, min=2, max=MAX_EDGE_PX) for axis, name in enumerate(("height", "width"))}
    example = torch.zeros(*_EXAMPLE_EDGES_PX, NUM_CHANNELS)
    try:
        with _quiet_exporter():
            program = torch.onnx.export(
                module, (example,), dynamo=True, dynamic_shapes={INPUT: sizes}, input_names=[INPUT],
                output_names=[OUTPUT], opset_version=OPSET, verbose=False, optimize=True,
            )  # fmt: skip
    except Exception as error:  # torch's exporter has dozens of its own
        message = str(error).strip().partition("\n")[0]
        raise ExportError(f"network must be one that torch can export to ONNX, got: {message}") from error
    assert program is not None  # None is of the older exporter
    model = onnx.load(io.BytesIO(program.model_proto.SerializeToString()))
    # The exporter names the output's axes by its own arithmetic, Min(height, 8*((height + 7)//8)).
    for axis, name in enumerate(("height", "width")):
        model.graph.output[0].type.tensor_type.shape.dim[axis].dim_param = name
    onnx.checker.check_model(model)
    return model


@contextmanager
def _quiet_exporter() -> Iterator[None]:
    """Keeps the exporter's remarks about itself (torchvision is not there, a deprecated call) off the terminal."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _compare(data: bytes, module: FrameModule, encoding: Encoding, features: list[np.ndarray]) -> tuple[float, int]:
    """(largest difference, pixels compared) between onnxruntime and PyTorch, at the features' size and an odd one."""
    try:
        import onnxruntime
    except ImportError as error:
        raise ExportError(f"export must find onnxruntime to check the file, got: {error}; "
                          "pip install lightwell[onnx]") from error  # fmt: skip
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    largest, num_pixels = 0.0, 0
    for frame in features:
        for part in (frame, frame[: max(2, frame.shape[0] - 3), : max(2, frame.shape[1] - 5)]):
            part = np.ascontiguousarray(part)
            with torch.inference_mode():
                expected = module(torch.from_numpy(part)).numpy()
            (radiance,) = session.run([OUTPUT], {INPUT: part})
            largest = max(largest, difference(radiance, expected, encoding.exposure))
            num_pixels += part.shape[0] * part.shape[1]
    return largest, num_pixels


def _metadata(network: FusionNet, encoding: Encoding, facts: dict[str, Any]) -> dict[str, str]:
    packages = {name: version(name) for name in _PACKAGES}
    values = {
        **facts, "input_channels": {name: list(span) for name, span in CHANNELS.items()},
        "input_layout": f"{INPUT}: float32 [height, width, {NUM_CHANNELS}], row 0 on top; ir is linear scene radiance, "
        "normal is in world space, distance in scene units",
        "output_layout": f"{OUTPUT}: float32 [height, width, 3], linear scene radiance, Rec. 709 primaries",
        "exposure": encoding.exposure, "distance_scale": encoding.distance_scale,
        "transfer": {"curve": encoding.transfer.curve, "mu": encoding.transfer.mu},
        "size_multiple": network.config.size_multiple, "packages": packages,
    }  # fmt: skip
    return {f"lightwell.{name}": value if isinstance(value, str) else json.dumps(value)
            for name, value in values.items()}  # fmt: skip
