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
