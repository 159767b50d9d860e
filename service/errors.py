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


class NonFiniteFrameError(ServiceError, ArithmeticError):
    """A frame holds NaN or infinity; such pixels are never served.

    Attributes:
        non_finite: how many values.
    """

    def __init__(self, message: str, non_finite: int) -> None:
        super().__init__(message)
        self.non_finite = non_finite


class SceneTooLargeError(ServiceError, MemoryError):
    """A scene alone needs more memory than all open scenes may take."""


class BusyError(ServiceError):
    """The service takes no more work for now.

    Attributes:
        retry_after_s: whole seconds after which a client may ask again, at least 1.
    """

    def __init__(self, message: str, retry_after_s: int) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class StoppingError(BusyError):
    """The service is on its way out; another instance, or the next one, has to answer."""


class ClientGoneError(ServiceError, ConnectionError):
    """The client closed its connection before it was answered."""
