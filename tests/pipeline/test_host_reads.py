"""The stages do not wait for the device, but where they ask whether to go on."""

import traceback
import warnings
from collections import Counter
from pathlib import Path

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import foundpose
from benchmarking import ScriptedExtractor, Workload, WorkloadSizes, make_workload
from foundpose import FoundPose, MatchAndSolve
from foundpose.geometry import PerspectiveCrop
from foundpose.matching import PatchMatcher
from foundpose.pnp import RansacPnp
from foundpose.refinement import FeaturemetricRefiner
from foundpose.retrieval import SoftAssignBow, TemplateRetriever

SIZES = WorkloadSizes(templates=40, patches=80, components=32, channels=48, words=64, batch_size=4, images=2)
PACKAGE = Path(foundpose.__file__).parent
# Whether a loop goes on, and how many patches the largest crop has.
MAY_READ = {
    "optimization/levenberg_marquardt.py:levenberg_marquardt",
    "pnp/sampling.py:sample_hypotheses",
    "pnp/local_optimization.py:_climb",
    "pipeline/query.py:select_query_patches",
}
READS = {"_local_scalar_dense", "nonzero", "masked_select", "equal", "is_nonzero", "_unique2"}
# Which crop shows which object is known there already.
ON_THE_HOST = {f"representation/groups.py:{name}" for name in ("__init__", "<listcomp>")}


class HostReads(TorchDispatchMode):
    """Counts operations whose result the host must know, by the function of the package that asks."""

    def __init__(self) -> None:
        super().__init__()
        self.places: Counter[str] = Counter()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function._schema.name.split("::")[1]
        # A mask used as an index is searched for its true entries.
        by_mask = name.startswith("index") and any(
            isinstance(t, torch.Tensor) and t.dtype == torch.bool
            for t in (args[1] if len(args) > 1 and isinstance(args[1], list | tuple) else [])
        )
        if name in READS or by_mask:
            self.places[_caller()] += 1
        return function(*args, **(kwargs or {}))


def _caller() -> str:
    frames = [f for f in traceback.extract_stack() if Path(f.filename).is_relative_to(PACKAGE)]
    last = frames[-1]
    return f"{Path(last.filename).relative_to(PACKAGE).as_posix()}:{last.name}"


def pipeline(workload: Workload) -> FoundPose:
    return FoundPose(
        PerspectiveCrop(workload.sizes.crop_size, workload.sizes.fill),
        ScriptedExtractor(workload.sizes, workload.features),
        TemplateRetriever(SoftAssignBow()),
        MatchAndSolve(PatchMatcher(), RansacPnp()),
        FeaturemetricRefiner(),
        "all",
    )


def run(method: FoundPose, workload: Workload):
    with torch.no_grad():
        return method(
            workload.images,
            workload.K,
            workload.representation,
            workload.masks,
            image_index=workload.image_index.cpu(),
        )


def test_only_loops_ask_whether_to_go_on() -> None:
    workload = make_workload(SIZES)
    method = pipeline(workload)
    run(method, workload)  # settings are looked at once for each object
    with HostReads() as reads:
        estimates = run(method, workload)
    assert estimates.valid.all()
    assert set(reads.places) - ON_THE_HOST == MAY_READ
    assert reads.places["pipeline/query.py:select_query_patches"] == 1


def test_the_counter_sees_reads() -> None:
    with HostReads() as reads:
        foundpose.geometry.boxes_from_masks(torch.ones(1, 4, 4))
        assert not reads.places
        x = torch.arange(3.0)
        foundpose.retrieval.bow.assign_words(x[None, :, None], x[None] > 0, x[:, None], 1.0, 1)
        assert not reads.places
        foundpose.clustering.kmeans(torch.randn(20, 2), 3)
    assert reads.places


@pytest.mark.gpu
def test_a_gpu_is_waited_for_in_the_same_places_only() -> None:
    workload = make_workload(SIZES, "cuda")
    method = pipeline(workload).cuda()
    run(method, workload)
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run(method, workload)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    waits = [w for w in caught if "synchronizing CUDA operation" in str(w.message)]
    lines = Counter(f"{w.filename}:{w.lineno}" for w in waits)
    files = {Path(w.filename).resolve() for w in waits}
    allowed = {PACKAGE / place.split(":")[0] for place in MAY_READ}
    # Which levels of a picture's pyramid are needed; and matrix routines check their own success.
    allowed |= {PACKAGE / "geometry/warp.py", PACKAGE / "geometry/cameras.py", PACKAGE / "geometry/crop.py"}
    assert {f.resolve() for f in files} <= {f.resolve() for f in allowed}, lines
