"""Scenes that a job may name where no folder of scenes is configured: those that come with the package."""

from service.errors import UnknownSceneError

BUILTIN_SCENES = ("tabletop", "tiny")


def resolve_builtin_scene(name: str) -> str:
    """The source of a built-in scene, for `workers.scene.load_scene`.

    Raises:
        UnknownSceneError: it is none.
    """
    if name not in BUILTIN_SCENES:
        raise UnknownSceneError(f"scene must be one that this service has ({', '.join(BUILTIN_SCENES)}), got {name!r}")
    return f"builtin:{name}"
