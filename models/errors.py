"""Errors of the models package: one root, each also a fitting builtin."""


class ModelError(Exception):
    """Root of every error that `models` raises on purpose."""


class ConfigError(ModelError, ValueError):
    """A configuration value is outside what it may be."""


class ShapeError(ModelError, ValueError):
    """A tensor or image has the wrong shape for what it is given to."""


class WeightsError(ModelError, ValueError):
    """A set of trained weights is not the one the network needs."""


class MetricError(ModelError, ValueError):
    """A metric was asked about values on which it has no meaning."""
