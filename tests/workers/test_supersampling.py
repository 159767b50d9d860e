"""Edges of an image: what is one, against the reference's rule, and what is none."""

import numpy as np
import pytest

from workers.backend import mi
from workers.camera import Camera
from workers.query import CHANNELS, NUM_CHANNELS
from workers.query_reference import edge_contrast
from workers.supersampling import edge_pixels, edge_places, grid_places

WIDTH, HEIGHT = 24, 16
CAMERA = Camera.look_at([0, 0, 3], [0, 0, 0], [0, 1, 0], 50.0, WIDTH, HEIGHT)
LOOKS = ("ir", "normal", "albedo", "distance")


def flat() -> dict[str, np.ndarray]:
    """A white wall that fills the picture, two units away."""
    shape = (HEIGHT, WIDTH)
    return {"ir": np.ones((*shape, 3)), "normal": np.broadcast_to([0.0, 0.0, 1.0], (*shape, 3)).copy(),
            "albedo": np.full((*shape, 3), 0.5), "distance": np.full((*shape, 1), 2.0)}  # fmt: skip


def found(looks: dict[str, np.ndarray]) -> np.ndarray:
    """Edges by the device, bool [HEIGHT, WIDTH]."""
    features = np.zeros((HEIGHT, WIDTH, NUM_CHANNELS), np.float32)
    for name in LOOKS:
        features[..., slice(*CHANNELS[name])] = looks[name]
    packed = edge_pixels(mi.Float(features.reshape(-1)), WIDTH, HEIGHT, NUM_CHANNELS).numpy()
    pixels = packed[packed < WIDTH * HEIGHT]
    assert len(np.unique(pixels)) == len(pixels), "no edge comes twice"
    edges = np.zeros(WIDTH * HEIGHT, bool)
    edges[pixels] = True
    return edges.reshape(HEIGHT, WIDTH)


def test_one_smooth_surface_has_no_edges() -> None:
    assert not found(flat()).any()


def test_a_slanted_plane_has_no_edges() -> None:
    looks = flat()
    x = (np.arange(WIDTH) + 0.5) / WIDTH - 0.5
    looks["distance"][:] = (1.0 / (0.5 + 0.4 * x))[None, :, None]  # 1 / z is linear across a plane's image
    assert not found(looks).any()


@pytest.mark.parametrize(
    ("name", "value", "edge"),
    [
        ("ir", (1.0, 1.25, 1.0), False),
        ("ir", (1.0, 1.6, 1.0), True),
        ("albedo", (0.5, 0.5, 0.65), False),
        ("albedo", (0.5, 0.5, 0.75), True),
        ("normal", (0.3, 0.0, 0.954), False),
        ("normal", (0.6, 0.0, 0.8), True),
        ("distance", (2.1,), False),
        ("distance", (4.0,), True),
    ],
)
def test_a_step_is_an_edge_on_both_of_its_sides(name: str, value: tuple[float, ...], edge: bool) -> None:
    looks = flat()
    looks[name][:, 12:] = value
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[:, 11:13] = edge
    np.testing.assert_array_equal(found(looks), expected)


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e6])
def test_radiance_counts_relative_to_itself(scale: float) -> None:
    looks = flat()
    looks["ir"][:, 12:] = 1.6
    looks["ir"] *= scale
    assert found(looks).sum() == 2 * HEIGHT


def test_black_and_nan_are_no_edges() -> None:
    looks = flat()
    looks["ir"][:] = 0.0
    looks["ir"][4, 4] = np.nan
    assert not found(looks).any()


def test_device_agrees_with_the_reference_on_noise() -> None:
    rng = np.random.default_rng(3)
    looks = flat()
    for name, spread in (("ir", 0.08), ("albedo", 0.04), ("normal", 0.08), ("distance", 0.05)):
        looks[name] = looks[name] + spread * rng.standard_normal(looks[name].shape)
    looks["distance"][2:5, 3:9] = 0.0  # misses
    contrast = edge_contrast(looks, CAMERA)
    clear = np.abs(contrast - 1) > 1e-4
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(found(looks)[clear], (contrast > 1)[clear])
    assert 0.1 < (contrast > 1).mean() < 0.99


def test_an_image_of_one_pixel_has_no_edges() -> None:
    features = mi.Float(np.ones(NUM_CHANNELS, np.float32))
    assert (edge_pixels(features, 1, 1, NUM_CHANNELS).numpy() == 1).all()


@pytest.mark.parametrize(("every", "size"), [(1, (256, 256)), (3, (250, 130)), (16, (256, 256)), (40, (320, 180))])
def test_edges_are_spread_evenly_over_the_lanes(every: int, size: tuple[int, int]) -> None:
    width, height = size
    features = np.ones((height, width, NUM_CHANNELS), np.float32)
    columns = np.arange(width) // every % 2  # a step every so many columns
    features[..., 0] += columns
    packed = edge_pixels(mi.Float(features.reshape(-1)), width, height, NUM_CHANNELS).numpy()
    found = packed < width * height
    step = np.diff(columns) != 0
    expected = height * (np.r_[step, False] | np.r_[False, step]).sum()
    assert found.sum() == expected
    halves = [half.sum() for half in np.array_split(found, 2)]
    assert min(halves) > 0.45 * expected


@pytest.mark.parametrize("samples", [2, 3, 4])
def test_places_lie_apart_within_the_pixel(samples: int) -> None:
    grid, around = grid_places(samples), edge_places(samples)
    assert len(grid) == samples**2 and len(around) == (16 if samples == 4 else samples**2 - 1)
    np.testing.assert_allclose(grid.mean(0), 0.5)
    places = np.concatenate([[(0.5, 0.5)], around])
    assert ((places > 0) & (places < 1)).all()
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9.0 * np.eye(len(places))
    assert apart.min() > 0.1
