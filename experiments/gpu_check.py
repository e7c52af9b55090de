"""Run once on a machine with a GPU, unattended, for less than eight minutes: all that only a GPU can tell.

python experiments/gpu_check.py
python experiments/gpu_check.py quick=true device=cpu   # a rehearsal: everything small
"""

import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from benchmarking.gpu import run_part, run_parts, write_page
from foundpose.config import clear_errors


@hydra.main(version_base="1.3", config_path="../conf", config_name="gpu_check")
def main(cfg: DictConfig) -> None:
    """Run each part in a process of its own, and write ``gpu_check.json`` and ``gpu_check.md``; exit status 1 unless
    all parts ran through and all limits were kept."""
    run = HydraConfig.get()
    folder = Path(run.runtime.output_dir)
    with clear_errors():
        if cfg.part is not None:
            run_part(cfg, folder)
            return
        parts = run_parts(cfg, Path(__file__), list(run.overrides.task), folder)
        text, passed = write_page(cfg, parts, folder)
    print(f"\n{text}\n{folder / 'gpu_check.md'}")
    sys.exit(0 if passed else 1)


if __name__ == "__main__":
    main()
