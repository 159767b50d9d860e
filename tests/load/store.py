"""A store of two small scenes, both run to their end: what the load test serves."""

from pathlib import Path

from storage.store import Store
from workers.pipeline import run_scene
from workers.progress import Progress
from workers.scene import load_scene
from workers.settings import Settings

SCENES = {"tiny": "tiny", "alcove": str(Path(__file__).with_name("alcove.yaml"))}


def prepare(url: str, widths: str = "") -> None:
    """Runs the scenes with the `tiny` preset; what the store has of them is kept (some 15 s the first time).

    Args:
        url: of the store.
        widths: of the network, such as "32,48,64"; default: the `tiny` preset's narrow one.
    """
    settings = Settings.preset_named("tiny").override({"train.widths": widths} if widths else {})
    store = Store.open(url, create=True)
    served = {entry["name"] for entry in store.scenes() if "network" in entry}
    for name in SCENES.keys() - served:
        scene = load_scene(SCENES[name], width=settings.width, height=settings.height)
        run_scene(scene, store, settings, Progress())


if __name__ == "__main__":
    import sys

    prepare(*sys.argv[1:])
