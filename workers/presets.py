"""What each preset changes of the settings' defaults, by dotted key."""

from typing import Any

PRESET_OVERRIDES: dict[str, dict[str, Any]] = {
    "draft": {},
    "balanced": {
        "cache.max_elements": 150_000, "cache.diffuse_spp": 4096, "cache.directional_spp": 4,
        "frames.num_train": 72, "frames.num_validation": 8, "frames.num_test": 12, "frames.train_spp": 256,
        "frames.test_spp": 4096, "train.seconds": 3600.0, "train.epochs": 1000, "train.widths": (32, 48, 64),
        "plan.noise": 0.03,
    },
    "reference": {
        "cache.max_elements": 400_000, "cache.diffuse_spp": 16_384, "cache.directional_spp": 32,
        "frames.num_train": 90, "frames.num_validation": 10, "frames.num_test": 200, "frames.train_spp": 4000,
        "frames.denoise_train": False, "frames.test_spp": 4000, "train.seconds": 0.0, "train.epochs": 1000,
        "train.widths": (48, 64, 96), "plan.noise": 0.015,
    },
    "demo": {
        "width": 256, "height": 256, "cache.max_elements": 40_000, "cache.diffuse_spp": 512,
        "frames.num_train": 24, "frames.num_validation": 3, "frames.num_test": 4, "frames.train_spp": 64,
        "frames.test_spp": 512, "train.seconds": 120.0,
    },
    "tiny": {
        "width": 64, "height": 64, "cache.max_elements": 1500, "cache.domain_poses": 4, "cache.diffuse_spp": 64,
        "cache.azimuth": 16, "cache.polar": 4, "cache.directional_spp": 4, "frames.num_train": 4,
        "frames.num_validation": 1, "frames.num_test": 2, "frames.train_spp": 32, "frames.test_spp": 64,
        "frames.passes": 2, "train.epochs": 3, "train.seconds": 20.0, "train.batch": 2, "train.crop": 32,
        "train.widths": (16, 16, 16), "evaluation.spp": (1,), "evaluation.timing_repeats": 2,
        "evaluation.compile": False,
    },
}  # fmt: skip
