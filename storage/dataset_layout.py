"""Where things lie in a dataset folder, by the names that Open Image Denoise's training tools read.

manifest.json                                       everything about every frame
<split>/<group>_<spp>spp.<feature>.exr              a noisy frame: hdr (linear radiance), alb, nrm
<split>/<group>_ref.<feature>.exr                   its reference: also err, the standard error of hdr
<split>/<group>.json                                {"exposure": e}, which their infer.py shows frames with

Their tools group what differs only behind the last "_" (a number, a number with "spp", or "ref"), take the last name of
a sorted group as the target and the others as inputs, and look for the splits "train" and "valid". So a group's own
name has neither "_" nor ".": `tiny_0004.hdr.exr` would be read as 4 samples a pixel of the frame "tiny".
"""

import re

from storage.errors import PathNameError

MANIFEST = "manifest.json"
SPLITS = ("train", "valid", "test")
REFERENCE = "ref"
FEATURES = ("hdr", "alb", "nrm", "err")
SPP_DIGITS = 6  # zero-padded, so that names sort by samples

_GROUP = re.compile(r"[a-z0-9][a-z0-9-]{0,159}")


def group_name(*parts: str) -> str:
    """Joins the parts of a group's name by "-".

    Raises:
        PathNameError: a character other than a-z, 0-9 and "-", or more than 160 of them.
    """
    name = "-".join(parts)
    if _GROUP.fullmatch(name) is None:
        raise PathNameError(
            f"frame group must be 1 to 160 letters a-z, digits and '-', got {name!r}; rename the scene or the preset"
        )
    return name


def image_name(group: str, spp: int | None) -> str:
    """Name of one image of a group, without folder and feature; `spp` None is the reference."""
    if spp is not None and not 0 < spp < 10**SPP_DIGITS:
        raise PathNameError(f"samples of a noisy frame must be 1 to {10**SPP_DIGITS - 1}, got {spp}")
    return f"{group}_{REFERENCE}" if spp is None else f"{group}_{spp:0{SPP_DIGITS}d}spp"


def feature_file(split: str, image: str, feature: str) -> str:
    """Path of one feature of an image, relative to the dataset."""
    _check("split", split, SPLITS)
    _check("feature", feature, FEATURES)
    return f"{split}/{image}.{feature}.exr"


def exposure_file(split: str, group: str) -> str:
    """Path of a group's metadata, relative to the dataset."""
    _check("split", split, SPLITS)
    return f"{split}/{group}.json"


def _check(what: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise PathNameError(f"{what} must be one of {', '.join(known)}, got {value!r}")
