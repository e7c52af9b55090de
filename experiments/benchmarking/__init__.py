"""Speed and memory of every stage, on workloads of any size."""

from benchmarking.measure import Measurement, MeasureSettings
from benchmarking.scripted import ScriptedExtractor
from benchmarking.sizes import WorkloadSizes
from benchmarking.workload import Workload, make_workload, subset, with_crops

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
