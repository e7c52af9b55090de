"""Speed and memory of every stage, on workloads of any size."""

from foundpose.benchmark.measure import Measurement, MeasureSettings
from foundpose.benchmark.scripted import ScriptedExtractor
from foundpose.benchmark.sizes import WorkloadSizes
from foundpose.benchmark.workload import Workload, make_workload, subset, with_crops

__all__ = [
    "MeasureSettings",
    "Measurement",
    "ScriptedExtractor",
    "Workload",
    "WorkloadSizes",
    "make_workload",
    "subset",
    "with_crops",
]
