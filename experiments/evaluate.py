"""Poses and scores of a whole BOP dataset: detections in, results.csv, scores.json and timing.json out.

python experiments/evaluate.py data=lmo data.root=/path/to/lmo masks=cnos
python experiments/evaluate.py data=lmo data.root=/path/to/lmo results=submission_lmo-test.csv
python experiments/evaluate.py data=lmo data.root=/path/to/lmo detections=detections.json
"""

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from foundpose.config import clear_errors
from foundpose.evaluation.run import run_evaluation


@hydra.main(version_base="1.3", config_path="../conf", config_name="evaluate")
def main(cfg: DictConfig) -> None:
    """Estimate what is not estimated yet, then write results, scores and times to the run's folder."""
    with clear_errors():
        run_evaluation(cfg, Path(HydraConfig.get().runtime.output_dir))


if __name__ == "__main__":
    main()
