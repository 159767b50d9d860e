"""OpenEXR files for tests to read. Not by Mitsuba: its writer hangs now and then, on a semaphore of its threads."""

from pathlib import Path

import numpy as np
import OpenEXR


def write_exr(path: Path, rgb: np.ndarray) -> None:
    """Writes float32 [height, width, 3]."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": rgb}, num_threads=0).write(str(path))
