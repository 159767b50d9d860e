"""Frames of a scene at its operating points."""

import time
from dataclasses import replace

from workers.camera import Camera
from workers.errors import OperatingPointError
from workers.operating_points import OperatingPoint
from workers.operating_table import OperatingTable, load_table
from workers.point_parts import PointParts, derived_run
from workers.renderer import Frame, FrameRenderer, make_frame
from workers.settings import Settings


class PointRenderer(FrameRenderer):
    """The scene's published run, and its operating points."""

    _parts: PointParts | None = None
    _table: OperatingTable | None = None

    @property
    def nbytes(self) -> int:
        """Memory that the open scene holds, bytes: the published run and the parts of the points opened so far."""
        return self.run_nbytes + (0 if self._parts is None else self._parts.nbytes)

    def fit(self, nbytes: int) -> None:
        """Drops parts of points, those used longest ago first, until all is within `nbytes` or none is left."""
        if self._parts is not None:
            self._parts.fit(nbytes - self.run_nbytes)

    def render(self, camera: Camera, point: OperatingPoint | None = None) -> Frame:
        """Makes the frame of a camera, as the published run does where no point is given.

        The first frame of a point loads its caches and network, and the first of a size compiles its query. Both
        take seconds and neither can be predicted, so the frame is then made once more, and the seconds before that
        are its "prepare" step: "query" and "network" are what the point was measured to take.

        Raises:
            NoOperatingPointsError, OperatingPointError: the store has no such point (any more).
            StorageError: a part of it is missing.
        """
        if point is None:
            return super().render(camera)
        start = time.perf_counter()
        opened = self._parts_of(point).open(point)
        exposure = self.reconstructor.encoding.exposure
        frame = make_frame(opened.program, opened.reconstruct, exposure, camera)
        size = (camera.width, camera.height)
        if opened.has_met(size):
            return frame
        opened.meet(size)
        prepared = time.perf_counter() - start
        frame = make_frame(opened.program, opened.reconstruct, exposure, camera)
        return replace(frame, seconds={"prepare": prepared, **frame.seconds})

    def _parts_of(self, point: OperatingPoint) -> PointParts:
        """The parts of the table that has the point; a table that was measured again replaces the old one."""
        if self.run is None:
            raise OperatingPointError("a renderer must come from PointRenderer.open to know its operating points")
        if self._parts is None or self._table is None or point not in self._table.points:
            table = load_table(self.run.store, self.run.scene.digest)
            if point not in table.points:
                raise OperatingPointError(
                    f"operating point must be one that the store has, got {point.name!r} as it was measured before; "
                    "choose again"
                )
            self._table = table
            self._parts = PointParts(derived_run(self.run, Settings.from_json(table.base)))
        return self._parts
