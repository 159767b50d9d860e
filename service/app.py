"""The HTTP service: frames of the scenes of one store, and how it fares.

Routes are in service/routes_*.py; errors are problem documents (service/problems.py). Frames are rendered one
after the other on one thread (service/rendering.py); jobs run beside them (service/jobs). Who may ask, and how much, is
in service/auth.py and service/request_limits.py.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import FastAPI

from service.auth import add_access_control
from service.bundle_archive import ArchiveLimits
from service.bundle_rules import SceneLimits
from service.bundles import BundleStore
from service.config import ServiceConfig
from service.failures import known_errors, one_line
from service.metrics import Counts, FrameMetrics, job_metrics
from service.pictures import DEFAULT_QUEUE_LIMIT, DEFAULT_RECENT_NBYTES, Pictures
from service.problems import add_problem_handlers
from service.redaction import register_secrets
from service.rendering import Backend, RenderThread, StoreBackend
from service.request_limits import add_body_limit
from service.routes_bundles import FORM_OVERHEAD_NBYTES, UPLOAD_PATH, add_bundle_routes
from service.routes_frames import add_frame_routes
from service.routes_health import Readiness, add_health_routes
from service.routes_tradeoff import add_tradeoff_routes, store_tables
from service.scene_cache import DEFAULT_MEMORY_NBYTES
from service.schemas import DEFAULT_MAX_PIXELS
from service.serving import is_loopback
from service.version import package_version
from storage.errors import StoreNotFoundError
from storage.store import Store

if TYPE_CHECKING:
    from service.jobs.service import Jobs

DRAIN_S = 30.0
"""So long frames under way are waited for at shutdown."""
log = logging.getLogger("lightwell.service")


def create_app(
    store_url: str,
    *,
    make_backend: Callable[[], Backend] | None = None,
    max_pixels: int = DEFAULT_MAX_PIXELS,
    jobs: "Jobs | None" = None,
    queue_limit: int = DEFAULT_QUEUE_LIMIT,
    memory_nbytes: int = DEFAULT_MEMORY_NBYTES,
    recent_nbytes: int = DEFAULT_RECENT_NBYTES,
    preload: Sequence[str] = (),
    config: ServiceConfig | None = None,
) -> FastAPI:
    """The service over one store.

    Args:
        store_url: a folder or fsspec URL that holds a store.
        make_backend: what opens scenes instead of the store; called on the render thread.
        max_pixels: the largest frame that is answered.
        jobs: jobs that the service runs; the app starts and closes them.
        queue_limit: frames under way at most; more are answered 503.
        memory_nbytes: of all open scenes together.
        recent_nbytes: of pictures kept to be sent again.
        preload: scenes opened before the service is ready.
        config: adds bundles, access control and limits of request bodies, and decides `max_pixels`, `queue_limit` and
            `memory_nbytes`.

    Returns:
        The app; `app.state` has `registry` (of /metrics), `readiness` and `pictures`.
    """
    if config is not None:
        max_pixels, queue_limit, memory_nbytes = config.max_pixels, config.queue_limit, config.memory_limit
    rendering = RenderThread(
        make_backend or (lambda: StoreBackend(store_url, compile=config is not None and config.compile)),
        budget_nbytes=memory_nbytes,
        preload=preload,
    )
    metrics, readiness = FrameMetrics(), Readiness()
    pictures = Pictures(rendering, metrics, queue_limit=queue_limit, recent_nbytes=recent_nbytes)
    pictures.show()

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        warming = None
        try:
            await rendering.start()
            if jobs is not None:
                await asyncio.to_thread(jobs.start)
            warming = asyncio.create_task(_warm_up(rendering, readiness))
            yield
            readiness.stopping()
            await pictures.drain(DRAIN_S)
        finally:
            if jobs is not None:
                await asyncio.to_thread(jobs.close)
            pictures.stop()
            if warming is not None:
                warming.cancel()
            rendering.close()
            pictures.close()

    app = FastAPI(
        title="Lightwell",
        version=package_version(),
        description="Globally lit frames of a 3D scene for any camera pose.",
        lifespan=lifespan,
    )
    app.state.registry, app.state.readiness, app.state.pictures = metrics.registry, readiness, pictures
    add_problem_handlers(app)
    add_health_routes(app, readiness, metrics.registry)
    add_frame_routes(app, pictures, max_pixels=max_pixels)
    if jobs is not None:
        from service.routes_jobs import add_job_routes

        add_job_routes(app, jobs, store_url)
        _show_jobs(metrics, jobs)
    if config is not None:
        _add_configured(app, config, jobs, store_url)
    add_tradeoff_routes(app, rendering.catalogue.resolve, store_tables(store_url))
    return app


def _show_jobs(metrics: FrameMetrics, jobs: "Jobs") -> None:
    totals = jobs.unit_totals
    by_stage: dict[str, Counts] = {} if totals is None else {
        "units_by_stage": lambda: dict(totals.units), "seconds_by_stage": lambda: dict(totals.seconds),
        "set_aside_by_stage": lambda: dict(totals.set_aside),
    }  # fmt: skip
    job_metrics(
        metrics.registry, lambda: {state.value: n for state, n in jobs.table.counts().items()}, **by_stage
    )  # fmt: skip


async def _warm_up(rendering: RenderThread, readiness: Readiness) -> None:
    """Frames that come meanwhile wait behind it; what fails is told by /readyz and the log."""
    try:
        await rendering.warm_up()
    except known_errors() as error:
        log.error("warm-up: %s", one_line(error))
        readiness.failed(f"the warm-up failed: {one_line(error)}")
    except Exception:  # a fault of ours: said as well, for a service that stays "starting" tells nobody why
        log.exception("warm-up")
        readiness.failed("the warm-up failed, see the service's log")
    else:
        readiness.ready()


def _is_served(store_url: str, folder: Path) -> bool:
    """Whether a scene of the store lies in the folder: opening it reads its files again."""
    try:
        entries = Store.open(store_url).scenes()
    except StoreNotFoundError:
        return False
    absolute = folder.resolve()  # as entries have it; the service may have been given a relative folder
    return any(Path(str(entry.get("source", ""))).is_relative_to(absolute) for entry in entries)


def _add_configured(app: FastAPI, config: ServiceConfig, jobs: "Jobs | None", store_url: str) -> None:
    """Bundles, then what stands before every route: limits, and outermost who may ask."""
    register_secrets(config.secrets())
    bundles = bundle_store(config)

    def in_use(bundle_id: str) -> bool:
        return (jobs is not None and jobs.uses(bundle_id)) or _is_served(store_url, bundles.folder / bundle_id)

    add_bundle_routes(app, bundles, config.upload_max_nbytes, in_use)
    add_body_limit(
        app, config.body_max_nbytes, {UPLOAD_PATH: config.upload_max_nbytes + FORM_OVERHEAD_NBYTES}
    )  # fmt: skip
    token = config.token.get_secret_value() if config.token is not None else None
    add_access_control(app, token, local_only=is_loopback(config.host))


def bundle_store(config: ServiceConfig) -> BundleStore:
    """The uploaded bundles of a configuration."""
    return BundleStore(
        config.bundles_path,
        ArchiveLimits(
            max_nbytes=config.upload_max_unpacked_nbytes,
            max_files=config.upload_max_files,
            max_ratio=config.upload_max_ratio,
        ),
        SceneLimits(max_pixels=config.max_pixels, max_spp=config.max_spp, max_depth=config.max_depth),
    )
