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


class UnknownJobError(ServiceError, LookupError):
    """No job has this id."""


class JobStateError(ServiceError, ValueError):
    """What was asked cannot happen in the state that the job is in."""


class JobRequestError(ServiceError, ValueError):
    """A submission asks for what no job can do."""


class IdempotencyError(ServiceError, ValueError):
    """An Idempotency-Key came back with another request than it came with first."""


class NotReadyError(ServiceError, LookupError):
    """The job exists; what was asked of it does not yet."""


class JobDatabaseError(ServiceError, OSError):
    """The job database cannot be reached or is not ours."""


class LeaseLostError(ServiceError, RuntimeError):
    """Another process runs the job now; what this one has to say about it no longer counts."""


class UnreachableTargetError(ServiceError, OSError):
    """No service answers at an address."""


class RequestRefusedError(ServiceError, ValueError):
    """A service answered a request of ours with an error."""


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


class BusyError(ServiceError, RuntimeError):
    """More was asked at once than the service takes; asking again later helps.

    Attributes:
        retry_after_s: whole seconds after which a client may ask again, at least 1.
    """

    def __init__(self, message: str, retry_after_s: int = 5) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s


class StoppingError(BusyError):
    """The service is on its way out; another instance, or the next one, has to answer."""


class ClientGoneError(ServiceError, ConnectionError):
    """The client closed its connection before it was answered."""


class AccessError(ServiceError, ValueError):
    """The service would be open to others, or its secrets cannot be used as given."""


class BundleError(ServiceError, ValueError):
    """A bundle is refused: something in it breaks a rule.

    Args:
        entry: what breaks it: a file of the bundle, or "bundle" for the archive as a whole.
        rule: the rule, as "must ...".
        got: what was found instead, with a remedy where there is one.
    """

    def __init__(self, entry: str, rule: str, got: str) -> None:
        super().__init__(f"{entry} {rule}, got {got}")
        self.entry, self.rule = entry, rule

    @property
    def members(self) -> dict[str, str]:
        """What the problem document holds besides its detail."""
        return {"entry": self.entry, "rule": self.rule}


class HostileBundleError(BundleError):
    """Something in a bundle reaches out of it, or is built to exhaust who opens it."""


class BundleTooLargeError(BundleError):
    """More bytes or files than this service takes."""


class UnsupportedUploadError(ServiceError, ValueError):
    """The upload is neither a zip nor a form with one."""


class UnknownBundleError(ServiceError, LookupError):
    """No bundle has this id, or it has no such scene file."""


class BundleInUseError(ServiceError, ValueError):
    """A bundle that jobs still read cannot be deleted."""


class BundleStorageError(ServiceError, OSError):
    """The disk does not take the bundle (full, not writable)."""
