"""Primary rays of a pinhole camera, and the chain of delta bounces behind them.

The camera is passed as device memory, so one compiled program serves every pose.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from workers.backend import dr, mi
from workers.camera import Camera
from workers.lobes import context

# The first random number of a BSDF picks its lobe: 0 the first (reflection), close to 1 the last (transmission).
FIRST_LOBE = 0.0
LAST_LOBE = 0.999999


@dataclass
class DeviceCamera:
    """A camera in device memory: rows of to_world (x, y, z, origin as columns), tan of half the field of view."""

    right: "mi.Vector3f" = None
    up: "mi.Vector3f" = None
    forward: "mi.Vector3f" = None
    origin: "mi.Point3f" = None
    tan_half_width: "mi.Float" = None
    tan_half_height: "mi.Float" = None

    DRJIT_STRUCT: ClassVar[dict] = {
        "right": mi.Vector3f, "up": mi.Vector3f, "forward": mi.Vector3f, "origin": mi.Point3f,
        "tan_half_width": mi.Float, "tan_half_height": mi.Float,
    }  # fmt: skip

    @classmethod
    def upload(cls, camera: Camera) -> "DeviceCamera":
        tan_width = float(np.tan(np.radians(camera.fov_deg) / 2))
        columns = camera.to_world[:3].T.astype(np.float32)
        vectors = [mi.Vector3f(*(float(x) for x in column)) for column in columns]
        device = cls(
            -vectors[0], vectors[1], vectors[2], mi.Point3f(vectors[3]),
            mi.Float(tan_width), mi.Float(tan_width * camera.height / camera.width),
        )  # fmt: skip
        dr.make_opaque(device)
        return device

    def ray(self, x: "mi.Float", y: "mi.Float", width: int, height: int) -> "mi.Ray3f":
        """Ray through pixel coordinates (x, y): (0, 0) is the top left corner, (width, height) the opposite."""
        sx = (2 * x / width - 1) * self.tan_half_width
        sy = (1 - 2 * y / height) * self.tan_half_height
        return mi.Ray3f(self.origin, dr.normalize(self.right * sx + self.up * sy + self.forward))


@dataclass
class DeltaLobe:
    """One delta lobe at a hit: local direction, f cos / pdf, probability of the lobe, whether it exists."""

    wo: "mi.Vector3f"
    weight: "mi.Color3f"
    pdf: "mi.Float"
    valid: "mi.Bool"


def delta_lobes(bsdf: "mi.BSDFPtr", si: "mi.SurfaceInteraction3f", active: "mi.Bool") -> tuple[DeltaLobe, DeltaLobe]:
    """The delta lobes of a material without any randomness: (transmission or the only one, reflection).

    The second is invalid where the material has a single delta lobe.
    """
    ctx = context(int(mi.BSDFFlags.Delta))
    last, last_weight = bsdf.sample(ctx, si, mi.Float(LAST_LOBE), mi.Point2f(0.5), active)
    first, first_weight = bsdf.sample(ctx, si, mi.Float(FIRST_LOBE), mi.Point2f(0.5), active)
    # A nested material may ignore the context (principled does) and answer with a rough sample.
    last_valid, first_valid = (
        active & (sample.pdf > 0) & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta) for sample in (last, first)
    )
    distinct = first_valid & (~last_valid | (first.sampled_type != last.sampled_type))
    return (
        DeltaLobe(last.wo, last_weight, last.pdf, last_valid),
        DeltaLobe(first.wo, first_weight, first.pdf, distinct),
    )


def dominant_lobe(a: DeltaLobe, b: DeltaLobe) -> "tuple[mi.Vector3f, mi.Color3f, mi.Bool]":
    """Follows the likelier lobe and lets it carry the energy of both: (local direction, weight, valid)."""
    p_a, p_b = dr.select(a.valid, a.pdf, 0.0), dr.select(b.valid, b.pdf, 0.0)
    take_a = p_a >= p_b
    weight = dr.select(take_a, a.weight, b.weight) * (p_a + p_b)
    return dr.select(take_a, a.wo, b.wo), weight, a.valid | b.valid
