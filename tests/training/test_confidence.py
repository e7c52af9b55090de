import json

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from foundpose import FoundPose, MatchAndSolve
from foundpose.features import CoordinateCode
from foundpose.geometry import PerspectiveCrop, project_points, transform_points
from foundpose.matching import PatchMatcher
from foundpose.pipeline import PoseConfidence
from foundpose.pnp import RansacPnp
from foundpose.rendering import CoordinateRenderer, RaycastRenderer
from foundpose.rendering.coordinates import render_coordinate_image
from foundpose.retrieval import SoftAssignBow, TemplateRetriever
from foundpose.synthetic import SyntheticScene, procedural_mesh
from foundpose.training import ConfidencePictures, collect_evidence
from tests.experiments.test_apps import SMALL, run_app


def test_pictures_vary_in_size_and_have_their_camera(blob):
    pictures = ConfidencePictures(heights=(60, 300), hidden=(0.0, 0.3), mask_error=2)
    renderer = RaycastRenderer(supersampling=1)
    sides = []
    for seed in range(6):
        scene = pictures.draw(blob, [], seed, renderer)
        assert scene.image.shape == (3, 480, 640)
        rows, columns = torch.nonzero(scene.mask, as_tuple=True)
        pixels, _ = project_points(transform_points(scene.T_camera_from_model, blob.vertices), scene.K)
        low, high = pixels.amin(0), pixels.amax(0)
        # What is left of the silhouette lies in the projection's box, but for the mask's error.
        assert low[0] - 3 <= columns.min() <= columns.max() <= high[0] + 3
        assert low[1] - 3 <= rows.min() <= rows.max() <= high[1] + 3
        sides.append(float((high - low).max()))
        assert torch.equal(pictures.draw(blob, [], seed, renderer).image, scene.image)
    assert max(sides) > 1.5 * min(sides)


def test_some_pictures_show_another_object(blob):
    pictures = ConfidencePictures(absent=0.5)
    other = procedural_mesh(9, subdivisions=3)
    scenes = [pictures.draw(blob, [other], seed, RaycastRenderer(supersampling=1)) for seed in range(8)]
    absent = [bool(scene.T_camera_from_model.isnan().any()) for scene in scenes]
    assert 0 < sum(absent) < 8


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"heights": (500, 400)}, "heights must be"),
        ({"hidden": (0.2, 1.0)}, "hidden must be"),
        ({"absent": 1.0}, "absent within 0 and 1, got 2 and 1.0"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        ConfidencePictures(**settings)


def test_evidence_and_what_is_right(blob, oracle_blob):
    """Of two pictures of true coordinates one has a wrong truth, and one none at all."""
    pipeline = FoundPose(
        PerspectiveCrop(),
        CoordinateCode(),
        TemplateRetriever(SoftAssignBow()),
        MatchAndSolve(PatchMatcher(), RansacPnp()),
        confidence=PoseConfidence({}, 0.0),
    ).eval()
    scene = ConfidencePictures(heights=(300, 300)).draw(blob, [], 1, RaycastRenderer(supersampling=1))
    renderer = CoordinateRenderer()
    T, camera = scene.T_camera_from_model, scene.K
    image = render_coordinate_image(renderer, [blob], [T], camera, (480, 640))
    mask = renderer(blob, T[None], camera[None], (480, 640)).mask[0]
    true = SyntheticScene(image, camera, mask, T)
    aside = T.clone()
    aside[0, 3] += 0.2 * T[2, 3]
    scenes = [
        true,
        true._replace(T_camera_from_model=aside),
        true._replace(T_camera_from_model=T * torch.nan),
    ]
    evidence, right = collect_evidence(pipeline, oracle_blob, blob, iter(scenes), batch_size=2)
    assert right.tolist() == [True, False, False]
    assert bool((evidence.inliers > 0.8).all())
    pipeline.confidence = None
    with pytest.raises(ValueError, match="no confidence"):
        collect_evidence(pipeline, oracle_blob, blob, iter(scenes))


def test_a_share_that_is_none_is_refused_before_the_work(tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit):
        run_app(monkeypatch, "train_confidence", "share_right=2", f"hydra.run.dir={tmp_path / 'run'}")
    assert "share_right must be between 0 and 1, or null, got 2" in capsys.readouterr().err
    assert not (tmp_path / "run" / "evidence").exists()


@pytest.mark.slow
def test_the_app_fits_and_its_numbers_can_be_used(tmp_path, monkeypatch, capsys):
    """Two procedural objects in true coordinates, some absent; what is there already is not made again."""
    arguments = [
        "experiment=oracle",
        *SMALL,
        "meshes=2",
        "pictures_per_mesh=8",
        "scene_renderer._target_=foundpose.rendering.CoordinateRenderer",
        "~scene_renderer.ambient",
        *(f"pictures_drawn.light.{name}=[1,1]" for name in ("ambient", "brightness", "gain")),
        "pictures_drawn.light.noise=[0,0]",
        "pictures_drawn.absent=0.4",
        "pictures_drawn.heights=[300,400]",
        f"representations={tmp_path / 'representations'}",
        f"hydra.run.dir={tmp_path / 'run'}",
    ]
    run_app(monkeypatch, "train_confidence", *arguments)
    said = capsys.readouterr().out
    assert "each object's by a fit to the others:" in said
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert 0 < results["right"] < 1
    written = sorted((tmp_path / "run" / "evidence").iterdir())
    times = [path.stat().st_mtime_ns for path in written]
    assert len(written) == 2
    run_app(monkeypatch, "train_confidence", *arguments)
    assert [path.stat().st_mtime_ns for path in written] == times
    node = OmegaConf.load(tmp_path / "run" / "confidence" / "fitted.yaml")
    assert isinstance(instantiate(node), PoseConfidence)
