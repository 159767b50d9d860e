"""Finds the trunks of ST-LPIPS (Ghildyal and Liu, "Shift-tolerant Perceptual Similarity Metric", ECCV 2022).

The package `stlpips_pytorch` (BSD-2) ships them, but importing it needs torchvision; its files are read as
data.
"""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

from storage.errors import WeightsError

_PACKAGE = "stlpips_pytorch"
_VERSION_FOLDER = "vST0.0"


def find_stlpips(trunks: Sequence[str] = ("vgg", "alex")) -> dict[str, dict[str, Tensor]] | None:
    """Reads the weights of ST-LPIPS.

    Args:
        trunks: which of "vgg" (VGG16) and "alex" (AlexNet) to read.

    Returns:
        Trunk to its flat state dict on the CPU, with the package's own names (`net.slice1.0.weight`,
        `lin0.model.1.weight`, `scaling_layer.shift`); None where the package or these trunks are not
        installed.

    Raises:
        WeightsError: a file is there but unreadable.
    """
    spec = find_spec(_PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        return None
    folder = Path(next(iter(spec.submodule_search_locations))) / "weights" / _VERSION_FOLDER
    files = {trunk: folder / f"{trunk}_shift_tolerant.pth" for trunk in trunks}
    return {trunk: _read(file) for trunk, file in files.items() if file.is_file()} or None


def _read(file: Path) -> dict[str, Tensor]:
    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # zip, pickle and torch each have their own
        raise WeightsError(f"{file} must be a torch state dict, got: {error}; reinstall {_PACKAGE}") from error
