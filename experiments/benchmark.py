"""Speed and memory of every stage of inference and onboarding, beside an extractor and other implementations.

python experiments/benchmark.py
python experiments/benchmark.py quick=true
python experiments/benchmark.py quick=true compare=docs/benchmarks/0.1.0-quick.json
python experiments/benchmark.py device=cuda batch_sizes=[1,32] extractor=dinov2 precision=fp16
"""

import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from benchmarking.comparison import compare, describe, read_benchmark
from benchmarking.report import write_report
from benchmarking.run import run_benchmark
from foundpose.config import clear_errors
from foundpose.utils.progress import ProgressBars


@hydra.main(version_base="1.3", config_path="../conf", config_name="benchmark")
def main(cfg: DictConfig) -> None:
    """Measure, write ``benchmark.json``, ``benchmark.md`` and ``plots/``, and print the tables."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    with clear_errors():
        earlier = None
        if cfg.compare is not None:
            settings: Any = OmegaConf.to_container(cfg, resolve=True)
            earlier = read_benchmark(Path(cfg.compare), settings)
        result = run_benchmark(cfg, folder, ProgressBars())
        print(f"\n{write_report(result, folder)}\n{folder / 'benchmark.json'}")
    if earlier is not None:
        changes = compare(earlier, result.as_json())
        print(describe(changes, earlier, result.as_json()))
        if any(change.slower for change in changes):
            sys.exit(1)


if __name__ == "__main__":
    main()
