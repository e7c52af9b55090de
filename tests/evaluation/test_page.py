import json
import re

import numpy as np
import torch
from PIL import Image

from foundpose.evaluation.page import thumbnail, write_pictures_report
from foundpose.pipeline.figure import ObjectView
from foundpose.rendering import RaycastRenderer
from foundpose.visualization import REFINED
from tests.pipeline.test_foundpose import SIZE, K, pose_at


def test_pictures_without_truth_are_ordered_by_score_and_those_without_pose_come_first(tmp_path):
    records = [
        {
            "image": f"a/{k}.jpg",
            "mesh": "b/cup.ply",
            "valid": status == "OK",
            "status": status,
            "score": score,
        }
        | {"num_inliers": 9, "num_patches": 90, "t": [0.0, 0.0, 500.0], "time": 1.5}
        for k, (status, score) in enumerate([("OK", 0.9), ("OK", 0.4), ("TOO_FEW_INLIERS", 0.0)])
    ]
    pictures = {k: Image.new("RGB", (8, 8), (k, 0, 0)) for k in range(3)}
    write_pictures_report(tmp_path / "report.html", records, pictures, {2: pictures[2]})
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    cases = json.loads(found[1])
    assert [row["picture"] for row in cases["rows"]] == ["2.jpg", "1.jpg", "0.jpg"]
    assert cases["rows"][0]["distance"] is None
    assert list(cases["figures"]) == ["0"]
    assert len(page) < 100_000  # without charts, plotly is left out


def test_a_thumbnail_shows_the_mask_and_the_contour_around_it(blob, oracle_blob):
    T = pose_at(blob, (180.0, 150.0), 700.0, 1)
    render = RaycastRenderer()(blob, T[None], K[None], SIZE)
    view = ObjectView(oracle_blob, None)
    plain = np.asarray(thumbnail(render.rgb[0], K, render.mask[0], view, [])).astype(int)
    drawn = np.asarray(thumbnail(render.rgb[0], K, render.mask[0], view, [(REFINED, T)])).astype(int)
    assert plain.shape == (96, 96, 3)
    changed = (plain != drawn).any(-1)
    assert 100 < changed.sum() < 800
    # The contour runs around what is seen, and not through it.
    inside = plain.sum(-1) > 60
    assert (changed & inside).sum() < 0.35 * changed.sum()
    whole = thumbnail(render.rgb[0], K, torch.zeros(SIZE, dtype=torch.bool), view, [])
    assert whole.size == (96, 96)
