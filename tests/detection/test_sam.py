from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.detection import Pictures, SamProposer
from foundpose.features.pretrained import IMAGENET_MEAN, IMAGENET_STD
from foundpose.features.weights import WeightsNotFoundError
from tests.detection.conftest import PICTURE, K

VISION = {"hidden_size": 16, "num_attention_heads": 2, "num_hidden_layers": 1, "mlp_dim": 16}
SAM = {"vision_config": VISION | {"global_attn_indexes": [], "initializer_range": 0.02}}
SAM2 = {
    "vision_config": {
        "backbone_config": {
            "model_type": "sam2_hiera_det_model",
            "blocks_per_stage": [1, 1, 1, 1],
            "global_attention_blocks": [],
            "embed_dim_per_stage": [8, 16, 32, 64],
            "num_attention_heads_per_stage": [1, 2, 4, 8],
            "hidden_size": 8,
        },
        "backbone_channel_list": [64, 32, 16, 8],
    }
}
ALL = {"min_quality": -100.0, "min_stability": 0.0, "overlap": 1.0, "min_pixels": 0, "max_proposals": 1000}


def proposer(variant: str, points: int = 2, **changes: float) -> SamProposer:
    config = SAM2 if variant.startswith("sam2") else SAM
    return SamProposer(
        variant, "random", seed=0, config=config, points=points, points_per_batch=3, **changes
    ).eval()


def masks_of(ours: SamProposer, image: Tensor) -> tuple[Tensor, Tensor]:
    """Masks and scores of one picture."""
    proposals = ours(Pictures(image[None], K[None]))
    return proposals.masks[0], proposals.score[0]


@pytest.fixture(scope="module")
def image() -> Tensor:
    return torch.rand(3, *PICTURE, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("variant", ["sam_vitb", "sam2_tiny"])
def test_masks_are_those_of_the_points(variant: str, image: Tensor) -> None:
    """The network asked for one point at a time, and its logits brought to the picture as its authors do."""
    ours = proposer(variant, **ALL)
    masks, quality = masks_of(ours, image)
    assert masks.shape == (12, *PICTURE)
    inside = (1024, 1024) if variant.startswith("sam2") else (768, 1024)
    resized = F.interpolate(image[None], inside, mode="bilinear", antialias=True)
    mean, std = (torch.tensor(x)[:, None, None] for x in (IMAGENET_MEAN, IMAGENET_STD))
    square = F.pad((resized - mean) / std, (0, 0, 0, 1024 - inside[0]))
    expected = []
    with torch.no_grad():
        for row in range(2):
            for column in range(2):
                point = torch.tensor([[[[(column + 0.5) / 2 * inside[1], (row + 0.5) / 2 * inside[0]]]]])
                said = ours.model(pixel_values=square, input_points=point)
                for logits, value in zip(said.pred_masks[0, 0], said.iou_scores[0, 0], strict=True):
                    large = F.interpolate(logits[None, None], (1024, 1024), mode="bilinear")[
                        ..., : inside[0], :
                    ]
                    mask = F.interpolate(large, PICTURE, mode="bilinear")[0, 0] > 0
                    expected.append((float(value.clamp(0, 1)), mask))
    assert sorted(quality.tolist()) == pytest.approx(sorted(value for value, _ in expected), abs=1e-4)
    for _, mask in expected:
        assert max(float((mask == m).float().mean()) for m in masks) > 0.999


def test_uncertain_and_double_masks_are_dropped(image: Tensor) -> None:
    everything, quality = masks_of(proposer("sam_vitb", **ALL), image)
    middle = float(quality[3])
    better, kept = masks_of(proposer("sam_vitb", **(ALL | {"min_quality": middle})), image)
    assert len(better) == int((quality >= middle).sum())
    assert float(kept.min()) >= middle
    fewer, _ = masks_of(proposer("sam_vitb", **(ALL | {"overlap": 0.5})), image)
    assert 0 < len(fewer) < len(everything)
    best, score = masks_of(proposer("sam_vitb", **(ALL | {"max_proposals": 3})), image)
    assert len(best) == 3
    assert torch.equal(score, quality[:3])


def test_pictures_without_masks(image: Tensor) -> None:
    proposals = proposer("sam_vitb", min_quality=2.0)(
        Pictures(image.expand(2, -1, -1, -1), K.expand(2, 3, 3))
    )
    assert proposals.masks.shape == (2, 0, *PICTURE)


@pytest.mark.parametrize("variant", ["sam_vitb", "sam2_tiny"])
def test_weights_of_a_folder(variant: str, image: Tensor, tmp_path: Path) -> None:
    random = proposer(variant, points=1, **ALL)
    random.model.save_pretrained(tmp_path)
    loaded = SamProposer(variant, tmp_path, points=1, **ALL).eval()
    torch.testing.assert_close(masks_of(loaded, image)[1], masks_of(random, image)[1])


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(WeightsNotFoundError, match="hf download facebook/sam-vit-huge"):
        SamProposer(weights=tmp_path)
    with pytest.raises(ValueError, match="variant must be one of"):
        SamProposer("sam3")
    with pytest.raises(ValueError, match="goes with a seed"):
        SamProposer(weights="random")
    with pytest.raises(ValueError, match="points must be at least 1"):
        SamProposer(weights="random", seed=0, points=0)
