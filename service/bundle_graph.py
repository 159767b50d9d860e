"""References between the plugins of a scene: all resolved, none in a circle, none deeper than a stack."""

from service.errors import BundleError, HostileBundleError

MAX_CHAIN = 256  # Mitsuba follows references by recursion


def check_references(where: str, ids: dict[str, int], aliases: list[tuple[str, str, str]],
                     references: list[tuple[str, int, str]], edges: list[list[int]]) -> None:  # fmt: skip
    """Judge the graph of a scene.

    Args:
        where: the scene's file.
        ids: number of the plugin that bears an id.
        aliases: (place, id, second name of the same plugin), in the order of the file.
        references: (place, number of the plugin that refers, id).
        edges: numbers of the plugins inside each plugin; the references are added.

    Raises:
        BundleError: an id that nothing bears.
        HostileBundleError: a circle, or a chain longer than `MAX_CHAIN`.
    """
    known = dict(ids)
    for place, id_, other in aliases:
        if id_ not in known or other in known:
            raise BundleError(place, "must give a new name to an id above it", f"{id_[:60]!a}, {other[:60]!a}")
        known[other] = known[id_]
    for place, node, id_ in references:
        if id_ not in known:
            raise BundleError(place, "must refer to an id of the scene", ascii(id_[:60]))
        edges[node].append(known[id_])
    _check_depth(where, edges)


def _check_depth(where: str, edges: list[list[int]]) -> None:
    """Depth-first without recursion; `depth` is the longest chain below a plugin, 0 while it is open."""
    depth: dict[int, int] = {}
    for start in range(len(edges)):
        stack = [] if start in depth else [(start, iter(edges[start]))]
        if stack:
            depth[start] = 0
        while stack:
            node, rest = stack[-1]
            child = next(rest, None)
            if child is None:
                depth[node] = 1 + max((depth[below] for below in edges[node]), default=0)
                if depth[node] > MAX_CHAIN:
                    raise HostileBundleError(where, f"must not refer over {MAX_CHAIN} plugins deep", "more")
                stack.pop()
            elif child not in depth:
                depth[child] = 0
                stack.append((child, iter(edges[child])))
            elif depth[child] == 0:
                raise HostileBundleError(where, "must not refer in a circle", "one")
