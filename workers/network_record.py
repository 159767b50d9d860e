"""A trained network at rest: weights and what a reader needs to rebuild it, two files of a `train` unit."""

from typing import Any

from torch import Tensor

from models.network import FusionNet, NetworkConfig
from storage.store import Store, UnitRef
from storage.weights import decode_network, encode_network
from workers.reconstruct import Encoding
from workers.run_state import RunState

WEIGHTS_FILE, CONFIG_FILE = "network.safetensors", "network.json"


def network_files(state: dict[str, Tensor], description: dict[str, Any]) -> dict[str, bytes]:
    """The files of a unit; `description` holds "network" (its `NetworkConfig`) and "encoding"."""
    weights, config = encode_network(state, description)
    return {WEIGHTS_FILE: weights, CONFIG_FILE: config}


def load_network(run: RunState, ref: UnitRef) -> tuple[FusionNet, Encoding]:
    """Reads a trained network."""
    return read_network(run.store, ref)


def read_network(store: Store, ref: UnitRef) -> tuple[FusionNet, Encoding]:
    """Reads a trained network; the scene itself is not needed."""
    state, config = decode_network(store.read(ref, WEIGHTS_FILE), store.read(ref, CONFIG_FILE))
    values = config["network"]
    network = FusionNet(NetworkConfig(**{**values, "widths": tuple(values["widths"])}))
    network.load_state_dict(state)
    return network, Encoding.from_json(config["encoding"])
