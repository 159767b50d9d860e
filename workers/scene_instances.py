"""Instances written out: caches belong to one place, so every instance of a shape group becomes shapes of its own.

Done on Mitsuba's parsed node list, before anything is built. Each instance costs the memory of its meshes again, which
is why their number is bounded. Materials stay shared.
"""

from typing import Any

import numpy as np

from workers.backend import mi
from workers.errors import SceneError

MAX_EXPANDED_SHAPES = 20_000
_Reference = mi.Properties.ResolvedReference


def expand_instances(state: Any, what: str) -> list[str]:
    """Replaces instances by copies of what their groups hold, in place; returns a note where there were any.

    Args:
        state: parsed scene whose references are resolved (`scene_nodes.parse_state`).
        what: names the scene in messages.

    Raises:
        SceneError: an instance without a shape group, a group in a group, or more copies than
            `MAX_EXPANDED_SHAPES`.
    """
    root = state.root.props
    instances = []
    for key, value in list(root.items()):
        if isinstance(value, _Reference):
            plugin = state.nodes[value.index()].props.plugin_name()
            if plugin in ("instance", "shapegroup"):
                del root[key]
            if plugin == "instance":
                instances.append(value.index())
    count = 0
    for number, index in enumerate(instances):
        members = _members(state, index, what)
        count += len(members)
        if count > MAX_EXPANDED_SHAPES:
            raise SceneError(
                f"{what}: instances must stand for at most {MAX_EXPANDED_SHAPES} shapes together, got {len(instances)} "
                f"instances of more; merge the shapes of a group into one mesh or keep fewer instances"
            )
        for member in members:
            name = f"instance-{number:05d}-{state.nodes[member].props.id() or member}"
            root[name] = _Reference(_placed_copy(state, member, _matrix(state.nodes[index].props), name))
    if not instances:
        return []
    return [f"{len(instances)} instances were written out as {count} shapes: each has caches of its own"]


def _members(state: Any, instance: int, what: str) -> list[int]:
    """Nodes of the shapes in an instance's group."""
    groups = [index for index in _referenced(state, instance) if _plugin(state, index) == "shapegroup"]
    if len(groups) != 1:
        raise SceneError(f"{what}: an instance must refer to one shapegroup, got {len(groups)}; add a <ref> to one")
    members = [index for index in _referenced(state, groups[0]) if state.nodes[index].type == mi.ObjectType.Shape]
    nested = next((index for index in members if _plugin(state, index) in ("instance", "shapegroup")), None)
    if nested is not None:
        raise SceneError(f"{what}: a shapegroup must hold plain shapes, got {_plugin(state, nested)}; write it out")
    return members


def _placed_copy(state: Any, member: int, outer: np.ndarray, name: str) -> int:
    """Appends a shape moved by an instance's transform; returns the new node's index."""
    copy = mi.parser.SceneNode(state.nodes[member])
    copy.props.set_id(name)
    copy.props["to_world"] = mi.ScalarTransform4d((outer @ _matrix(copy.props)).tolist())
    state.nodes.append(copy)
    return len(state.nodes) - 1


def _referenced(state: Any, index: int) -> list[int]:
    props = state.nodes[index].props
    return [value.index() for _, value in props.items() if isinstance(value, _Reference)]


def _plugin(state: Any, index: int) -> str:
    return str(state.nodes[index].props.plugin_name())


def _matrix(props: Any) -> np.ndarray:
    """`to_world`, float64 [4, 4]; the identity where there is none."""
    if "to_world" not in props:
        return np.eye(4)
    return np.array(props["to_world"].matrix, dtype=np.float64).reshape(4, 4)
