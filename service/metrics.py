"""What the service counts, for Prometheus: one registry an app, so that two apps in a process do not mix.

Names begin with `lightwell_`; times are seconds, sizes bytes. Process memory and CPU come from prometheus-client's
own process collector (`process_resident_memory_bytes`, ...).
"""

import logging
from collections.abc import Callable, Iterable, Mapping

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
STEPS = ("queue", "open", "query", "network", "encode")
log = logging.getLogger("lightwell.service")


def make_registry() -> CollectorRegistry:
    """A registry of its own that already tells the process' memory, CPU seconds and open files (on Linux)."""
    registry = CollectorRegistry(auto_describe=True)
    ProcessCollector(registry=registry)
    return registry


class FrameMetrics:
    """Counters of the frame endpoint; `registry` is what /metrics shows."""

    def __init__(self, registry: CollectorRegistry | None = None) -> None:
        self.registry = registry or make_registry()
        self.answered = Counter(
            "lightwell_frames", "Frames sent, by where they came from: rendered for this request, shared with one "
            "that asked for the same at the same time, or remembered from a recent one", ["source"],
            registry=self.registry,
        )  # fmt: skip
        for source in ("rendered", "shared", "recent"):
            self.answered.labels(source)
        self.rejected = Counter(
            "lightwell_frames_rejected", "Frame requests answered 503", ["reason"], registry=self.registry
        )
        for reason in ("queue_full", "stopping"):
            self.rejected.labels(reason)
        self.abandoned = Counter(
            "lightwell_frames_abandoned", "Frame requests whose client went away before the answer",
            registry=self.registry,
        )  # fmt: skip
        self.renders = Counter("lightwell_renders", "Frames that the render thread finished", registry=self.registry)
        self.non_finite_values = Counter(
            "lightwell_non_finite_values", "NaN or infinite values in frames; such frames are not served",
            registry=self.registry,
        )  # fmt: skip
        self.non_finite_frames = Counter(
            "lightwell_non_finite_frames", "Frames refused for NaN or infinite values", registry=self.registry
        )
        self.request_seconds = Histogram(
            "lightwell_frame_seconds", "From a frame request's arrival to its answer", buckets=SECONDS,
            registry=self.registry,
        )  # fmt: skip
        self.step_seconds = Histogram(
            "lightwell_frame_step_seconds", "Seconds of each step of a rendered frame", ["step"], buckets=SECONDS,
            registry=self.registry,
        )  # fmt: skip
        for step in STEPS:
            self.step_seconds.labels(step)

    def observe_steps(self, seconds: Mapping[str, float]) -> None:
        """Adds the seconds of each step, by the names in `STEPS`."""
        for step, duration_s in seconds.items():
            self.step_seconds.labels(step).observe(duration_s)

    def watch(self, name: str, text: str, read: Callable[[], float]) -> None:
        """Shows a number that is read whenever somebody asks."""
        Gauge(name, text, registry=self.registry).set_function(read)

    def watch_total(self, name: str, text: str, read: Callable[[], float]) -> None:
        """The same for a number that only grows."""
        self.registry.register(_ReadTotal(name, text, read))


class _ReadTotal(Collector):
    def __init__(self, name: str, text: str, read: Callable[[], float]) -> None:
        self._name, self._text, self._read = name, text, read

    def collect(self) -> Iterable[Metric]:
        yield CounterMetricFamily(self._name, self._text, value=self._read())


Counts = Callable[[], Mapping[str, float]]


def job_metrics(
    registry: CollectorRegistry, count_by_state: Counts, *, units_by_stage: Counts | None = None,
    seconds_by_stage: Counts | None = None, set_aside_by_stage: Counts | None = None,
) -> None:  # fmt: skip
    """Shows jobs by state and, where given, units, seconds and set-aside units by stage.

    Args:
        registry: the app's (`app.state.registry`).
        count_by_state: read at every scrape, on a worker thread; a state without jobs may be left out.
        units_by_stage: units computed since the service started.
        seconds_by_stage: worker seconds spent on them.
        set_aside_by_stage: units given up since the service started.
    """
    registry.register(_JobCollector(count_by_state, units_by_stage, seconds_by_stage, set_aside_by_stage))


class _JobCollector(Collector):
    """A source that fails leaves its metric out, with a line in the log: the others must still be seen."""

    def __init__(self, by_state: Counts, units: Counts | None, seconds: Counts | None, aside: Counts | None) -> None:
        self._jobs = GaugeMetricFamily, "lightwell_jobs", "Jobs by state", "state", by_state
        self._totals = [
            (CounterMetricFamily, name, text, "stage", read)
            for name, text, read in (
                ("lightwell_units", "Units computed since the service started", units),
                ("lightwell_stage_seconds", "Worker seconds spent on units", seconds),
                ("lightwell_units_set_aside", "Units given up since the service started", aside),
            )
            if read is not None
        ]

    def describe(self) -> Iterable[Metric]:
        """Names only: registering must not ask the jobs' database."""
        return [family(name, text, labels=[label]) for family, name, text, label, _ in (self._jobs, *self._totals)]

    def collect(self) -> Iterable[Metric]:
        for family, name, text, label, read in (self._jobs, *self._totals):
            metric = family(name, text, labels=[label])
            try:
                counts = read()
            except Exception as error:
                log.warning("metric %s cannot be read: %s: %s", name, type(error).__name__, error)
                continue
            for value, count in sorted(counts.items()):
                metric.add_metric([value], count)
            yield metric
