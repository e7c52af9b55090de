"""Speed and memory of every stage, on workloads of any size."""

from foundpose.benchmark.workload import ScriptedExtractor, Workload, WorkloadSizes, make_workload, subset

__all__ = ["ScriptedExtractor", "Workload", "WorkloadSizes", "make_workload", "subset"]
