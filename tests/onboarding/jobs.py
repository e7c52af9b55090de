"""What the tests run in processes of their own."""

import os
import signal
from pathlib import Path

import foundpose.onboarding.artefacts
from foundpose.features import CoordinateCode, PcaProjection
from foundpose.geometry import SuperFibonacci
from foundpose.onboarding import ArtefactStore, Onboarder, RepresentationStore
from foundpose.rendering import CoordinateRenderer
from foundpose.retrieval import SoftAssignBow, VisualWords
from foundpose.synthetic import procedural_mesh

SIZE = 210


def small_onboarder(**changes):
    settings = {
        "renderer": CoordinateRenderer(),
        "extractor": CoordinateCode(),
        "viewpoints": SuperFibonacci(10),
        "words": VisualWords(40),
        "bow": SoftAssignBow(),
        "projection": PcaProjection(16),
        "image_size": SIZE,
        "batch_size": 4,
    }
    return Onboarder(**(settings | changes))


def onboard(folder, with_artefacts, barrier, queue):
    """Onboard the blob at the same time as another process does."""
    onboarder = small_onboarder()
    counts = {"renderer": 0, "extractor": 0, "words": 0}

    def count(name):
        def hook(*_):
            counts[name] += 1

        return hook

    for name in counts:
        getattr(onboarder, name).register_forward_pre_hook(count(name))
    mesh = procedural_mesh(3, subdivisions=5)
    artefacts = ArtefactStore(folder / "artefacts") if with_artefacts else None
    store = RepresentationStore(folder / "representations", onboarder, artefacts)
    barrier.wait()
    representation = store.get(mesh, "blob")
    queue.put((counts, float(representation.template_bow.double().sum()), str(store.path(mesh, "blob"))))


def die_while_writing_descriptors(folder):
    module = foundpose.onboarding.artefacts
    save = module.save_file

    def die(tensors, path, metadata):
        save(tensors, path, metadata=metadata)
        if Path(path).parent.name == "descriptors":
            os.truncate(path, os.path.getsize(path) // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    module.save_file = die
    store = RepresentationStore(
        folder / "representations", small_onboarder(), ArtefactStore(folder / "artefacts")
    )
    store.get(procedural_mesh(3, subdivisions=5), "blob")
