"""Fit the probability that a pose is right to rendered pictures of objects.

python experiments/train_confidence.py extractor=dinov2_vits14_wheel
python experiments/train_confidence.py extractor=dinov2_vits14_wheel meshes=[a.ply,b.ply,c.ply]
python experiments/estimate.py --config-dir outputs/train_confidence confidence=fitted …
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from foundpose.config import Method, build_method, claim_run_folder, clear_errors
from foundpose.pipeline import PoseConfidence, PoseEvidence, fit_confidence, reliability
from foundpose.rendering import Mesh
from foundpose.synthetic import SyntheticScene
from foundpose.training import ConfidencePictures, collect_evidence
from foundpose.training.meshes import meshes_to_train_on
from foundpose.utils.files import write_json, write_text
from foundpose.utils.progress import ProgressBars, track

# Procedural objects are numbered from here.
OBJECTS = 3001


@hydra.main(version_base="1.3", config_path="../conf", config_name="train_confidence")
def main(cfg: DictConfig) -> None:
    """Write the calibration, the evidence that it was fitted to, and how it does on objects left out."""
    with clear_errors():
        run(cfg, Path(HydraConfig.get().runtime.output_dir))


def run(cfg: DictConfig, output: Path) -> None:
    """What :func:`main` does, in a folder; objects whose evidence is there already are not looked at again."""
    share = cfg.share_right
    if share is not None and not (isinstance(share, int | float) and 0 < share < 1):
        raise ValueError(f"share_right must be between 0 and 1, or null, got {share}")
    meshes = meshes_to_train_on(cfg.meshes, OBJECTS, "meshes")
    if len(meshes) < 2:
        raise ValueError(f"meshes must be at least 2, so that one can be left out; got {len(meshes)}")
    claim_run_folder(output, cfg)
    method = build_method(cfg)
    method.pipeline.confidence = PoseConfidence({}, 0.0)  # collects the evidence
    found = [evidence_of(cfg, method, meshes, place, output) for place in range(len(meshes))]

    left_out = torch.cat(
        [
            fit(cfg, [part for k, part in enumerate(found) if k != place])(found[place][0])
            for place in range(len(found))
        ]
    )
    right = torch.cat([part[1] for part in found])
    measured = reliability(left_out, right)
    confidence = fit(cfg, found, share)
    write_confidence(output / "confidence" / "fitted.yaml", confidence)
    write_json(
        output / "results.json", {"right": float(right.float().mean()), "left_out": measured.to_json()}
    )
    print(f"{len(right)} poses of {len(meshes)} objects, {float(right.float().mean()):.0%} of them right")
    print("each object's by a fit to the others:")
    print(measured.table())
    print(confidence)
    print(f"use it with: --config-dir {output} confidence=fitted")


def fit(
    cfg: DictConfig, found: Sequence[tuple[PoseEvidence, Tensor]], share_right: float | None = None
) -> PoseConfidence:
    """Fit to the evidence of several objects."""
    evidence, right = zip(*found, strict=True)
    return fit_confidence(
        PoseEvidence(*map(torch.cat, zip(*evidence, strict=True))), torch.cat(right), cfg.decay, share_right
    )


def evidence_of(
    cfg: DictConfig, method: Method, meshes: Sequence[Mesh], place: int, output: Path
) -> tuple[PoseEvidence, Tensor]:
    """What speaks for the poses of one object, and which are right; kept in ``evidence/``."""
    mesh = meshes[place]
    name = f"object-{mesh.checksum[:12]}"
    path = output / "evidence" / f"{name}.json"
    if not path.is_file():
        representation = method.store.get(mesh, name, ProgressBars(name)).to(cfg.device)
        others = [other for other in meshes if other is not mesh]
        scenes = draw(cfg, mesh, others, cfg.seed + place * cfg.pictures_per_mesh)
        evidence, right = collect_evidence(method.pipeline, representation, mesh, scenes, cfg.batch_size)
        columns = {field: getattr(evidence, field).tolist() for field in PoseEvidence._fields}
        write_json(path, columns | {"right": right.tolist()})
    content = json.loads(path.read_text())
    return (
        PoseEvidence(*(torch.tensor(content[field]) for field in PoseEvidence._fields)),
        torch.tensor(content["right"], dtype=torch.bool),
    )


def draw(cfg: DictConfig, mesh: Mesh, others: Sequence[Mesh], first_seed: int) -> Iterator[SyntheticScene]:
    """Pictures of one object."""
    pictures: ConfidencePictures = instantiate(cfg.pictures_drawn)
    renderer = instantiate(cfg.scene_renderer)
    for number in track(range(cfg.pictures_per_mesh), "pictures"):
        scene = pictures.draw(mesh, others, first_seed + number, renderer)
        if scene is not None:
            yield scene


def write_confidence(path: Path, confidence: PoseConfidence) -> None:
    """Write an option of the config group ``confidence``."""
    weights = dict(zip(PoseEvidence._fields, (round(w, 4) for w in confidence.weight.tolist()), strict=True))
    node: dict[str, Any] = {
        "_target_": "foundpose.pipeline.PoseConfidence",
        "weights": weights,
        "bias": round(float(confidence.bias), 4),
    }
    write_text(path, OmegaConf.to_yaml(OmegaConf.create(node)))


if __name__ == "__main__":
    main()
