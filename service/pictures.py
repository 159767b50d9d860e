"""Encoded frames: each is rendered and encoded once for all who ask at the same time, within a bound.

    request -> recent? -> bound -> render (one thread) -> finite? -> encode (its own threads) -> recent

Frames do not depend on who asks: scene, network, pose, lens and size decide them, so pictures made lately are
kept and sent again. A renderer that is opened anew may choose another precision of the network (within 50 dB of
fp32, `workers/reconstruct.py`), so entity tags are weak.
"""

import asyncio
import hashlib
import json
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from cachetools import LRUCache

from service import images
from service.errors import BusyError, NonFiniteFrameError, StoppingError
from service.frame_choice import Demand
from service.metrics import FrameMetrics
from service.rendering import FrameKey, Rendered, RenderThread, scene_key
from service.single_flight import SingleFlight
from service.version import package_version

if TYPE_CHECKING:
    from workers.camera import Camera

DEFAULT_QUEUE_LIMIT = 64
DEFAULT_RECENT_NBYTES = 32 * 2**20
NUM_ENCODERS = 2
FIRST_GUESS_S = 0.5
"""Seconds that a frame is thought to take before one was measured."""
RECENT_WEIGHT = 0.1
"""Of the newest frame, in the running mean of seconds."""
MAX_RETRY_AFTER_S = 120
NO_DEMAND = Demand()
ENTRY_NBYTES = 2048
"""Of a remembered picture beside its content: key, camera, numbers."""


@dataclass(frozen=True)
class Picture:
    """A frame as it is sent.

    Attributes:
        content: the file's bytes.
        media_type: which kind of file, one of `images.MEDIA_TYPES`.
        etag: weak entity tag.
        seconds: of each step, when it was made; empty where it was remembered.
        coverage: share of radiance lookups that baked elements answered.
        exposure: the scene's.
        source: "rendered" for this request, "shared" with another one, or "recent".
    """

    content: bytes
    media_type: str
    etag: str
    seconds: dict[str, float]
    coverage: float
    exposure: float
    source: Literal["rendered", "shared", "recent"] = "rendered"


@dataclass(frozen=True)
class PictureKey:
    """A frame and the kind of file."""

    frame: FrameKey
    media_type: str

    @property
    def etag(self) -> str:
        """The same in every process of this version."""
        scene, camera, point = self.frame.scene, self.frame.camera, self.frame.point
        parts: list[Any] = [package_version(), scene.digest, scene.network, camera.to_json(), self.media_type]
        parts += [] if point is None else [point.overrides, point.network, point.precision, point.scale]
        return f'W/"{hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]}"'


class Pictures:
    """Makes, shares, remembers and counts pictures. Belongs to one event loop.

    Args:
        rendering: the render thread.
        metrics: counts.
        queue_limit: pictures under way at most, waiting, rendered or encoded.
        recent_nbytes: memory of pictures that are sent again.
    """

    def __init__(
        self, rendering: RenderThread, metrics: FrameMetrics, *, queue_limit: int = DEFAULT_QUEUE_LIMIT,
        recent_nbytes: int = DEFAULT_RECENT_NBYTES,
    ) -> None:  # fmt: skip
        self.rendering, self.metrics, self.queue_limit = rendering, metrics, queue_limit
        self._frames: SingleFlight[FrameKey, Rendered] = SingleFlight()
        self._pictures: SingleFlight[PictureKey, Picture] = SingleFlight()
        self._recent: LRUCache[PictureKey, Picture] = LRUCache(recent_nbytes, _nbytes)
        self._encoders = ThreadPoolExecutor(NUM_ENCODERS, thread_name_prefix="lightwell-encode")
        self._frame_s = FIRST_GUESS_S
        self.is_stopping = False

    def __len__(self) -> int:
        """Pictures under way."""
        return len(self._pictures)

    def show(self) -> None:
        """Adds to the metrics what is read when somebody asks: queue, open scenes, their memory."""
        scenes, watch = self.rendering.scenes, self.metrics.watch
        watch("lightwell_frames_under_way", "Frames waiting, rendered or encoded now", lambda: len(self))
        watch("lightwell_frames_under_way_limit", "More are answered 503", lambda: self.queue_limit)
        watch("lightwell_queue_depth", "Frames that wait for the render thread", lambda: self.rendering.num_waiting)
        watch("lightwell_open_scenes", "Scenes open now", lambda: len(scenes))
        watch("lightwell_open_scenes_bytes", "Memory of the open scenes", lambda: scenes.nbytes)
        watch("lightwell_open_scenes_limit_bytes", "Memory that open scenes may take", lambda: scenes.budget_nbytes)
        watch("lightwell_recent_frames_bytes", "Memory of pictures kept", lambda: self._recent.currsize)
        self.metrics.watch_total("lightwell_scenes_opened", "Scenes opened", lambda: scenes.num_opened)
        self.metrics.watch_total("lightwell_scenes_closed", "Scenes closed to make room", lambda: scenes.num_closed)

    async def key(self, scene: str, camera: "Camera", media_type: str, demand: Demand = NO_DEMAND) -> PictureKey:
        """What was asked for.

        Raises:
            UnknownSceneError, AmbiguousSceneError: no scene, or several.
            NoOperatingPointsError, UnreachableTargetError: no measured point meets the demand.
        """
        entry = await self.rendering.catalogue.resolve(scene)
        point = await self.rendering.choose(entry["digest"], demand, camera)
        return PictureKey(FrameKey(scene_key(entry), camera, point), media_type)

    async def get(self, key: PictureKey) -> Picture:
        """The picture: remembered, shared or made.

        Raises:
            BusyError: too many pictures are under way.
            StoppingError: the service is shutting down.
            NonFiniteFrameError: the frame holds NaN or infinity.
            SceneTooLargeError, StorageError, WorkerError, ModelError: the scene cannot be opened or rendered.
        """
        recent = self._recent.get(key)
        if recent is not None:
            return replace(recent, seconds={}, source="recent")
        shared = key in self._pictures
        if not shared:
            self._admit()
        try:
            picture = await self._pictures.run(key, lambda: self._make(key))
        except asyncio.CancelledError:
            if self.is_stopping:
                raise self._stopping() from None
            raise
        return replace(picture, source="shared") if shared else picture

    def stop(self) -> None:
        """Takes no more requests; what is under way goes on."""
        self.is_stopping = True

    async def drain(self, timeout_s: float) -> None:
        """Waits until nothing is under way, at most `timeout_s` seconds."""
        self.stop()
        deadline_s = time.monotonic() + timeout_s
        while len(self) and time.monotonic() < deadline_s:
            await asyncio.sleep(0.02)

    def close(self) -> None:
        """Ends the encoders' threads."""
        self._encoders.shutdown(wait=True, cancel_futures=True)

    @property
    def retry_after_s(self) -> int:
        """Whole seconds until what is under way now will be done, from the running mean of frames' seconds."""
        return min(max(1, math.ceil(len(self) * self._frame_s)), MAX_RETRY_AFTER_S)

    def _admit(self) -> None:
        if self.is_stopping:
            raise self._stopping()
        if len(self) >= self.queue_limit:
            self.metrics.rejected.labels("queue_full").inc()
            raise BusyError(
                f"frames under way must be at most {self.queue_limit}, and so many are; ask again after "
                f"{self.retry_after_s} s",
                self.retry_after_s,
            )

    def _stopping(self) -> StoppingError:
        self.metrics.rejected.labels("stopping").inc()
        return StoppingError("the service is shutting down; ask again later", self.retry_after_s)

    async def _make(self, key: PictureKey) -> Picture:
        rendered = await self._frames.run(key.frame, lambda: self._render(key.frame))
        frame = rendered.frame
        start_s = time.perf_counter()
        content = await asyncio.get_running_loop().run_in_executor(
            self._encoders, images.encode, frame.radiance, frame.exposure, key.media_type
        )
        encode_s = time.perf_counter() - start_s
        self.metrics.observe_steps({"encode": encode_s})
        picture = Picture(
            content, key.media_type, key.etag, rendered.seconds | {"encode": encode_s}, frame.coverage, frame.exposure
        )
        if _nbytes(picture) <= self._recent.maxsize:
            self._recent[key] = picture
        return picture

    async def _render(self, key: FrameKey) -> Rendered:
        rendered = await self.rendering.render(key)
        self.metrics.renders.inc()
        self.metrics.observe_steps(rendered.seconds)
        busy_s = sum(seconds for step, seconds in rendered.seconds.items() if step != "queue")
        self._frame_s += RECENT_WEIGHT * (busy_s - self._frame_s)
        if rendered.frame.non_finite:
            self._refuse(rendered.frame.non_finite, rendered.frame.radiance.size)
        return rendered

    def _refuse(self, non_finite: int, size: int) -> None:
        """NaN or infinity is neither sent nor painted over: the client learns how much of the frame is lost."""
        self.metrics.non_finite_frames.inc()
        self.metrics.non_finite_values.inc(non_finite)
        raise NonFiniteFrameError(
            f"frame must be finite, got {non_finite} of {size} values NaN or infinite; move the camera, "
            "and look for NaN in the scene's textures and materials",
            non_finite,
        )


def _nbytes(picture: Picture) -> int:
    return len(picture.content) + ENTRY_NBYTES
