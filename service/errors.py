"""Errors of the service: one root, and one class for each way in which a request can be wrong."""


class ServiceError(Exception):
    """Root of everything that this package raises on purpose."""


class OptionError(ServiceError, ValueError):
    """An option of the command line cannot be used as given."""


class UnknownSceneError(ServiceError, LookupError):
    """No scene of that name or digest can be served from this store."""


class AmbiguousSceneError(ServiceError, LookupError):
    """Several scenes of the store bear the name that was asked for."""


class NotAcceptableError(ServiceError, ValueError):
    """The client accepts none of the picture formats."""


class FrameTooLargeError(ServiceError, ValueError):
    """More pixels were asked for than this service answers at once."""
