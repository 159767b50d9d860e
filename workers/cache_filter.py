"""Denoising of the diffuse caches: neighbouring elements share light, so they share samples.

A joint-bilateral average over the nearest elements of the same shape: place and normal decide, guarded by the measured
variance, so that a shadow's edge is kept where it stands out of the noise (the range weight of non-local means with
known variance, Rousselle et al. 2012, with one value for a patch). `workers/directional_filter.py` is its counterpart.
"""

import numpy as np
from scipy.spatial import cKDTree

from workers.elements import ElementSet

# Part of the keys of what is made from filtered caches; raise it whenever the filter's result changes.
FILTER_VERSION = 5
NUM_NEIGHBOURS = 24
PASSES = 2
NORMAL_POWER = 16
RANGE_STRENGTH = 4.0
SIGMA_SPACINGS = 1.6
# Differences below this share of the values are no edge, whatever the measured variance says.
FLOOR_SHARE = 1e-6
TINY = np.finfo(np.float64).tiny
# A neighbour further than this many median spacings is no neighbour.
MAX_SPACINGS = 3.0


def filter_diffuse(elements: ElementSet, mean: np.ndarray, standard_error: np.ndarray) -> np.ndarray:
    """Denoised diffuse lobe.

    Args:
        elements: where the values sit.
        mean: float32 [n, 3], linear radiance.
        standard_error: of `mean`, float32 [n, 3].

    Returns:
        float32 [n, 3].
    """
    index, weight = neighbours(elements, np.arange(elements.num_elements), SIGMA_SPACINGS)
    variance = np.mean(standard_error.astype(np.float64) ** 2, axis=1)
    values = mean.astype(np.float64)
    for _ in range(PASSES):
        values, variance = _filter_once(values, variance, index, weight)
    return values.astype(np.float32)


def _filter_once(
    values: np.ndarray, variance: np.ndarray, index: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One pass: filtered values [n, 3] and the variance [n] that is left in them.

    An element's own estimate of variance is noisy (a firefly raises both), so it is pooled over the neighbourhood.
    Weights by inverse variance would be biased for the same reason: where few paths find the light, the elements
    that missed it look the surest.
    """
    pooled = np.sum(weight * variance[index], axis=1) / np.sum(weight, axis=1)
    difference = np.mean((values[index] - values[:, None]) ** 2, axis=2)
    noise = pooled[index] + pooled[:, None]
    # Relative: an absolute floor would swallow the edges of a scene lit by 1e-8.
    floor = FLOOR_SHARE**2 * np.mean(values[index] ** 2 + values[:, None] ** 2, axis=2) + TINY
    total = weight * np.exp(-np.maximum(difference - noise, 0.0) / (RANGE_STRENGTH * noise + floor))
    total /= total.sum(axis=1, keepdims=True)
    return np.einsum("nk,nkc->nc", total, values[index]), np.sum(total**2 * variance[index], axis=1)


def element_spacing(elements: ElementSet, members: np.ndarray) -> np.ndarray:
    """Median distance of each member to its nearest ones, float64 [n]."""
    position = elements.position[members].astype(np.float64)
    distance, _ = cKDTree(position).query(position, k=min(5, len(members)), workers=2)
    return _median_distance(distance.reshape(len(members), -1))


def _median_distance(distance: np.ndarray) -> np.ndarray:
    """From the distances of the nearest members (itself first), [n, k]."""
    return np.maximum(np.median(distance[:, 1:5], axis=1) if distance.shape[1] > 4 else distance[:, -1], 1e-30)


def neighbours(
    elements: ElementSet, members: np.ndarray, sigma_spacings: float, spacing: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Nearest members of each member (itself first) and their weights; int64, float64 [n, k]."""
    position, normal = elements.position[members].astype(np.float64), elements.normal[members].astype(np.float64)
    shape, side = elements.shape[members], elements.side[members]
    k = min(NUM_NEIGHBOURS, len(members))
    distance, index = cKDTree(position).query(position, k=k, workers=2)
    distance, index = distance.reshape(len(members), k), index.reshape(len(members), k)
    spacing = _median_distance(distance) if spacing is None else spacing
    weight = np.exp(-0.5 * (distance / (sigma_spacings * spacing[:, None])) ** 2)
    weight *= np.maximum(np.einsum("nkc,nc->nk", normal[index], normal), 0.0) ** NORMAL_POWER
    weight *= (shape[index] == shape[:, None]) & (side[index] == side[:, None])
    weight *= distance <= MAX_SPACINGS * spacing[:, None]
    weight[:, 0] = np.maximum(weight[:, 0], 1e-6)
    return index, weight
