"""One figure that tells how a pose came about."""

from pathlib import Path
from typing import NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from foundpose.geometry import project_points, transform_points
from foundpose.pipeline.results import Correspondences, PoseEstimates, PoseStatus
from foundpose.rendering import Mesh, Renderer
from foundpose.representation import ObjectRepresentation
from foundpose.utils.files import write_atomically
from foundpose.visualization.overlay import COARSE, REFINED, TRUTH, Color, draw_axes, draw_contour

_MOST_LINES = 60
_MOST_TEMPLATES = 7


class ShownObject(NamedTuple):
    """An object of a figure.

    Attributes:
        mesh: its mesh.
        representation: made of the mesh.
        renderer: draws contours and templates.
    """

    mesh: Mesh
    representation: ObjectRepresentation
    renderer: Renderer


@torch.no_grad()
def save_estimate_figure(
    path: str | Path,
    image: Tensor,
    K: Tensor,
    estimates: PoseEstimates,
    index: int,
    shown: ShownObject,
    T_true: Tensor | None = None,
) -> None:
    """Write a figure: pose on the picture and closer, crop, retrieved templates, matches of the best template.

    Contours are red (truth), blue (coarse pose) and green (refined).

    Args:
        path: a picture file.
        image: (3, H, W) the photograph.
        K: (3, 3) its intrinsics.
        estimates: a batch of estimates.
        index: which estimate to show.
        shown: the object it belongs to.
        T_true: (4, 4) true pose, or None.
    """
    e = estimates
    mesh, representation, renderer = shown
    templates = e.templates.index[index].cpu()
    best = int(e.best[index])
    views = renderer(
        mesh,
        representation.T_template_from_model[templates].float().cpu(),
        representation.K_template[templates].float().cpu(),
        (representation.info.image_size, representation.info.image_size),
    ).rgb
    status = PoseStatus(int(e.status[index]))
    poses: list[tuple[str, Color, Tensor]] = []
    if bool(e.valid[index]):
        poses = [] if T_true is None else [("truth", TRUTH, T_true)]
        poses.append(("coarse", COARSE, e.T_coarse[index].cpu()))
        if e.refined is not None:
            poses.append(("refined", REFINED, e.T_camera_from_model[index].cpu()))
    drawn = image
    for _, color, T in poses:
        size = (int(image.shape[1]), int(image.shape[2]))
        drawn = draw_contour(
            drawn, renderer(mesh, T[None].float(), K[None].float(), size).mask[0].to(image.device), color
        )

    figure = Figure(figsize=(14, 11), layout="constrained")
    grid = figure.add_gridspec(3, 1, height_ratios=[5.3, 2.6, 5])
    top, middle, bottom = (figure.add_subfigure(grid[row, 0]) for row in range(3))
    left, middle_top, right = top.subplots(1, 3, width_ratios=[image.shape[2] / image.shape[1], 1, 1])
    if poses:
        drawn = draw_axes(drawn, poses[-1][2], K, length=0.5 * mesh.diameter)
        lines = [Line2D([], [], color=color, linewidth=3, label=name) for name, color, _ in poses]
        middle_top.legend(handles=lines, loc="upper right", fontsize=9, framealpha=0.8)
    _show(left, drawn, f"{representation.info.name}: {status.name}, {int(e.num_inliers[index])} inliers")
    _show(middle_top, drawn, "the same, closer (axes of the model: x red, y green, z blue)")
    if poses:
        _look_closer(middle_top, K, mesh, [T for _, _, T in poses])
    crop = draw_contour(
        e.crops.images[index].cpu(), e.crops.masks[index].cpu() > 0.5, (1.0, 1.0, 1.0), width=1
    )
    _show(right, crop, "crop, outline of the mask white")
    middle.suptitle("retrieved templates: their similarity, and inliers of their poses", fontsize=9)
    ranks = sorted({*range(min(len(templates), _MOST_TEMPLATES)), best})
    for rank, axes in zip(ranks, middle.subplots(1, len(ranks), squeeze=False)[0], strict=True):
        inliers = int(e.hypotheses.num_inliers[index, rank])
        similarity = float(e.templates.similarity[index, rank])
        _show(axes, views[rank], f"{similarity:.2f}, {inliers} inliers" + (" (best)" if rank == best else ""))
    if e.correspondences is not None:
        _show_matches(bottom.subplots(1, 1), e, e.correspondences, index, views[best])
    write_atomically(Path(path), lambda temporary: figure.savefig(temporary, dpi=70))


def _look_closer(axes: Axes, K: Tensor, mesh: Mesh, poses: list[Tensor]) -> None:
    """Show of a picture only the square in which an object lies under its poses."""
    pixels = torch.cat(
        [project_points(transform_points(T.float(), mesh.vertices), K.float().cpu())[0] for T in poses]
    )
    low, high = pixels.amin(dim=0), pixels.amax(dim=0)
    (u, v), half = ((low + high) / 2).tolist(), 0.6 * float((high - low).max())
    axes.set_xlim(u - half, u + half)
    axes.set_ylim(v + half, v - half)


def _show_matches(
    axes: Axes, e: PoseEstimates, matches: Correspondences, index: int, template: Tensor
) -> None:
    """Crop and template side by side, joined by the inlier matches."""
    size = template.shape[-1]
    _show(
        axes,
        torch.cat([e.crops.images[index].cpu(), template], dim=-1),
        "inlier matches of the best template",
    )
    best = int(e.best[index])
    inliers = torch.nonzero(e.hypotheses.inliers[index, best].cpu()).flatten()
    inliers = inliers[:: max(1, len(inliers) // _MOST_LINES)]
    start = matches.points_image[index].cpu()[inliers]
    end = matches.pixels_template[index, best].cpu()[inliers] + torch.tensor([float(size), 0.0])
    lines = torch.stack([start, end], dim=1).numpy()
    hues = torch.linspace(0, 1, max(len(lines), 1)).numpy()
    axes.add_collection(LineCollection(list(lines), array=hues, cmap="hsv", linewidths=0.8))


def _show(axes: Axes, image: Tensor, title: str) -> None:
    axes.imshow(image.clamp(0, 1).permute(1, 2, 0).numpy())
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()
