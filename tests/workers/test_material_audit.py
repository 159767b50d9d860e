"""Material facts against what the materials were made with."""

from typing import Any

import numpy as np
import pytest

from workers.backend import dr, mi
from workers.material_audit import material_facts, measured_alpha

COLOUR = {"type": "rgb", "value": [0.6, 0.4, 0.2]}


def facts(**description: Any) -> Any:
    return material_facts(mi.load_dict(description))


def bitmap(value: float, channels: int = 1) -> dict[str, Any]:
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(dr.full(mi.TensorXf, value, (4, 4, channels)))}


@pytest.mark.parametrize(
    ("description", "kinds"),
    [
        ({"type": "diffuse"}, ("diffuse",)),
        ({"type": "conductor"}, ("delta",)),
        ({"type": "roughconductor"}, ("glossy",)),
        ({"type": "plastic"}, ("diffuse", "delta")),
        ({"type": "roughplastic"}, ("diffuse", "glossy")),
        ({"type": "dielectric"}, ("delta", "transmissive")),
        ({"type": "thindielectric"}, ("delta", "transmissive")),
        ({"type": "roughdielectric"}, ("glossy", "transmissive")),
        ({"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}, ("diffuse", "cutout")),
        ({"type": "null"}, ("cutout",)),
    ],
)
def test_kinds_are_what_the_material_does_with_light(description: dict[str, Any], kinds: tuple[str, ...]) -> None:
    assert facts(**description).kinds == kinds


def test_emitter_is_emissive_beside_its_own_kind() -> None:
    assert material_facts(mi.load_dict({"type": "diffuse"}), is_emitter=True).kinds == ("diffuse", "emissive")


def test_two_sided_material_names_what_it_wraps() -> None:
    plain = facts(type="roughconductor", alpha=0.1)
    both = facts(type="twosided", nested={"type": "roughconductor", "alpha": 0.1})
    principled = facts(type="twosided", nested={"type": "principled", "base_color": COLOUR})
    assert (plain.two_sided, both.two_sided, principled.two_sided) == (False, True, True)
    assert plain.plugin == both.plugin == "RoughConductor" and principled.plugin == "Principled"


def test_roughness_of_a_parameter_of_principled_and_of_a_texture() -> None:
    plain = facts(type="roughplastic", alpha=0.2).roughness
    assert plain.source == "parameter" and plain.mean == pytest.approx(0.2)
    uneven = facts(type="roughconductor", alpha_u=0.1, alpha_v=0.3).roughness
    assert (uneven.low, uneven.high) == pytest.approx((0.1, 0.3))
    squared = facts(type="principled", base_color=COLOUR, roughness=0.4).roughness
    assert squared.mean == pytest.approx(0.16), "a principled material states the root of alpha"
    checks = {"type": "checkerboard", "color0": 0.1, "color1": 0.5}
    textured = facts(type="roughconductor", alpha=checks)
    assert textured.textured == ("alpha",) and textured.roughness.source == "texture"
    assert (textured.roughness.low, textured.roughness.high) == pytest.approx((0.1, 0.5))
    texels = facts(type="roughconductor", alpha=bitmap(0.3)).roughness
    assert texels.source == "texture" and texels.mean == pytest.approx(0.3)


def test_textures_are_named_through_wrappers() -> None:
    nested = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    assert facts(type="twosided", nested=nested).textured == ("reflectance",)
    assert facts(type="normalmap", normalmap=bitmap(0.5, 3), nested={"type": "diffuse"}).textured == ("normalmap",)
    assert facts(type="diffuse", reflectance=COLOUR).textured == ()


@pytest.mark.parametrize("alpha", [0.02, 0.2, 0.6])
def test_measured_alpha_agrees_with_the_parameter(alpha: float) -> None:
    ggx = mi.load_dict({"type": "roughconductor", "alpha": alpha, "distribution": "ggx"})
    # The median of 4096 samples has a relative standard error near 1 / sqrt(4096) in tan^2, half of it after the root.
    np.testing.assert_allclose(measured_alpha(ggx), alpha, rtol=5 / np.sqrt(4096))


def test_lobe_that_reflects_nothing_measures_as_nothing() -> None:
    assert len(measured_alpha(mi.load_dict({"type": "diffuse"}))) == 0
