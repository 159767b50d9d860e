"""Normal maps at the pixel: what a normal-mapped surface shows the network besides its caches.

A cache element lies at one place of the map, and elements are further apart than its details; without the pixel's own
normal the network could not tell where a bump is. Read from the material's parameters, as Mitsuba gives the perturbed
frame to nobody. Bump maps are not read: their parameters do not tell their texture.
"""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from workers.backend import dr, mi

NORMAL_MAPS_VERSION = 1  # part of the keys of inputs that show them
# Wrappers that hand their own directions on to what they wrap; behind the first side of a two-sided material.
_MAP = re.compile(r"(?:(?:brdf_0|nested_bsdf)\.)*normalmap\.data")


class NormalMaps:
    """The normal maps of some shapes, in their order.

    Attributes:
        textures: one a material with such a map.
    """

    def __init__(self, shapes: "Sequence[mi.Shape]") -> None:
        self.textures: list[mi.Texture] = []
        number_of_bsdf: dict[int, int] = {}
        numbers = np.zeros(max(len(shapes), 1), np.uint32)  # 0: none
        for index, shape in enumerate(shapes):
            bsdf = shape.bsdf()
            pointer = int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0])
            if pointer not in number_of_bsdf:
                texture = _texture(bsdf)
                self.textures += [] if texture is None else [texture]
                number_of_bsdf[pointer] = 0 if texture is None else len(self.textures)
            numbers[index] = number_of_bsdf[pointer]
        self.numbers = mi.UInt32(numbers)

    def normal(self, si: "mi.SurfaceInteraction3f", shape: "mi.UInt32", active: "mi.Bool") -> "mi.Normal3f":
        """Unit shading normal as the material turns it, in world space, on the side of `si.sh_frame.n`.

        Args:
            si: where.
            shape: index of the shape there.
        """
        local = mi.Vector3f(0, 0, dr.full(mi.Float, 1.0, dr.width(si)))
        number = dr.gather(mi.UInt32, self.numbers, shape, active)

        def mapped(turned):
            for index, texture in enumerate(self.textures):
                here = active & (number == index + 1)
                turned = dr.select(here, dr.fma(mi.Vector3f(texture.eval_3(si, here)), 2, -1), turned)
            # Behind, a two-sided material takes directions mirrored at the surface.
            turned.x, turned.y = (dr.select(si.wi.z < 0, -value, value) for value in (turned.x, turned.y))
            return (turned,)

        (local,) = dr.if_stmt((local,), number != 0, mapped, lambda same: (same,))
        length = dr.norm(local)
        usable = dr.isfinite(length) & (length > 0)
        return mi.Normal3f(si.to_world(dr.select(usable, local / length, mi.Vector3f(0, 0, 1))))


def _texture(bsdf: "mi.BSDF") -> "mi.Texture | None":
    """The normal map of a material as a texture of its own; None where it has none or hides it."""
    parameters: Any = mi.traverse(bsdf)
    for key in parameters.keys():  # noqa: SIM118  # iterated, it yields pairs
        if _MAP.fullmatch(key):
            data = np.array(parameters[key], np.float32)
            to_uv = np.array(parameters[key.removesuffix("data") + "to_uv"].matrix, np.float64).reshape(3, 3)
            matrix = np.eye(4)
            matrix[np.ix_((0, 1, 3), (0, 1, 3))] = to_uv
            return mi.load_dict(
                {"type": "bitmap", "raw": True, "data": mi.TensorXf(data), "to_uv": mi.ScalarTransform4f(matrix)}
            )
    return None
