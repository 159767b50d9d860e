"""Networks and checkpoints at rest: safetensors beside readable JSON, and torch files loaded as data only."""

import io
import json
from collections.abc import Mapping
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from storage.errors import WeightsError
from storage.keys import plain
from storage.markers import sha256_hex

_CHECKSUM = "weights_sha256"


def encode_network(state_dict: Mapping[str, Tensor], config: Mapping[str, Any]) -> tuple[bytes, bytes]:
    """Encodes a trained network.

    Args:
        state_dict: name to tensor, on any device; bit-exact at rest.
        config: JSON-like: network configuration, transfer functions, metrics. Tuples come back as lists.

    Returns:
        The safetensors file and the JSON file; the JSON carries the SHA-256 of the weights it belongs to.

    Raises:
        WeightsError: there are no tensors.
        CanonicalError: the configuration has no JSON form.
    """
    if not state_dict:
        raise WeightsError("state_dict must hold at least one tensor, got none; pass net.state_dict()")
    weights = save({name: tensor.detach().cpu().contiguous().clone() for name, tensor in state_dict.items()})
    described = {"config": plain(dict(config), "config"), _CHECKSUM: sha256_hex(weights)}
    return weights, json.dumps(described, indent=1, sort_keys=True).encode()


def decode_network(weights: bytes, config: bytes) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Decodes what `encode_network` gave.

    Returns:
        State dict on the CPU and the configuration.

    Raises:
        WeightsError: either file is damaged, or they do not belong together.
    """
    try:
        described = json.loads(config)
        if described[_CHECKSUM] != sha256_hex(weights):
            raise WeightsError("weights must match the SHA-256 in their JSON, got others; fetch both files of one run")
        return load(weights), described["config"]
    except (ValueError, KeyError, TypeError, SafetensorError) as error:
        if isinstance(error, WeightsError):
            raise
        raise WeightsError(f"network must be safetensors and JSON of ours, got: {error}; train it again") from error


def encode_checkpoint(obj: Any) -> bytes:
    """Encodes the state of a training run: tensors, numbers, strings, lists, tuples and dicts of them.

    The bytes are read back once, so a checkpoint that could not be resumed fails here and not after a crash.

    Raises:
        WeightsError: it holds something else (a numpy array, a module, a dataclass).
    """
    stream = io.BytesIO()
    try:
        torch.save(obj, stream)
    except Exception as error:  # pickle raises AttributeError, TypeError, PicklingError, ...
        raise WeightsError(f"checkpoint must be plain data and tensors, got: {error}; use state_dict()") from error
    data = stream.getvalue()
    decode_checkpoint(data)
    return data


def decode_checkpoint(data: bytes) -> Any:
    """Decodes a checkpoint as data, on the CPU; no code of it is run.

    Raises:
        WeightsError: the bytes are damaged, or hold more than plain data.
    """
    try:
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # zip, pickle and torch each have their own
        message = str(error).partition("\n")[0]
        raise WeightsError(
            f"checkpoint must be plain data and tensors, got: {message}; save state_dict() of each part, "
            "or start from the checkpoint before"
        ) from error
