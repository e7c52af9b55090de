"""Ablations: rows of the paper's tables and sweeps, each set of settings evaluated once.

python experiments/ablate.py experiment=table2_row03 data=lmo
python experiments/ablate.py -m sweep=words extractor=dense_sift data=lmo
python experiments/ablate.py -m sweep=table2 data=lmo,tless,tudl launcher=slurm
"""

import os
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from ablation import run_once
from foundpose.config import clear_errors

# A launcher's workers start anew, on other machines too, and must find what lies beside this file.
_PATHS = [str(Path(__file__).resolve().parent), os.environ.get("PYTHONPATH")]
os.environ["PYTHONPATH"] = os.pathsep.join(path for path in _PATHS if path)


@hydra.main(version_base="1.3", config_path="../conf", config_name="ablate")
def main(cfg: DictConfig) -> None:
    """Evaluate one set of settings; the report over all runs follows when the last one is done."""
    hydra_config = HydraConfig.get()
    with clear_errors():
        if not cfg.report_only:
            run_once(cfg, hydra_config.runtime.choices.get("experiment"), hydra_config.overrides.task)


if __name__ == "__main__":
    main()
