"""Look at a picture, mask, mesh and intrinsics of your own and say what they are, before anything expensive runs.

python experiments/check.py image=photo.jpg mesh=cup.ply mask=mask.png intrinsics=[fx,fy,cx,cy]
"""

import math
import warnings
from pathlib import Path

import hydra
import torch
import torch.nn.functional as F
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from PIL import Image
from torch import Tensor

from estimate import read_intrinsics, read_region, read_view
from foundpose.bop import read_image
from foundpose.config import clear_errors
from foundpose.geometry import PerspectiveCrop, boxes_from_masks
from foundpose.rendering import Mesh, RaycastRenderer, load_mesh
from foundpose.rendering.silhouettes import SilhouetteFit, fit_silhouette
from foundpose.utils.files import write_atomically
from foundpose.visualization.overlay import COARSE, TRUTH, draw_contour, to_pil

# The best of 300 silhouettes overlaps the mask of an object that is seen whole by this much, one of which a part is
# hidden by this much. (An ellipse overlaps its box by 0.79.)
GOOD, POOR = 0.8, 0.65


@hydra.main(version_base="1.3", config_path="../conf", config_name="check")
def main(cfg: DictConfig) -> None:
    """Print a line for each file, and write a picture to the run's folder."""
    with clear_errors():
        check(cfg, Path(HydraConfig.get().runtime.output_dir))


def check(cfg: DictConfig, output: Path) -> None:
    """Say what each file is, as far as they are given, and how they go together."""
    names = ("image", "mesh", "mask", "box", "intrinsics")
    if all(cfg[name] is None for name in names):
        raise ValueError("give image=…, mesh=…, mask=… (or box=…) and intrinsics=…, or some of them")
    mesh = None
    if cfg.mesh is not None:
        mesh = load_mesh(cfg.mesh, cfg.color)
        print(f"mesh       {describe_mesh(mesh, str(cfg.mesh))}")
    if cfg.image is None:
        return
    image = read_image(cfg.image, cfg.background)
    size = (int(image.shape[1]), int(image.shape[2]))
    print(f"picture    {describe_picture(image, str(cfg.image))}")
    if cfg.intrinsics is not None:
        camera = read_intrinsics(cfg, size)
        print(
            f"camera     {describe_camera(camera.K, size)}, {len(camera.distortion) or 'no'} distortion coefficients"
        )
    if cfg.mask is not None or cfg.box is not None:
        mask = read_region(cfg, size)
        print(f"mask       {describe_mask(mask)}")
    if mesh is None or cfg.intrinsics is None or (cfg.mask is None and cfg.box is None):
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # said above
        image, K, mask = read_view(cfg)
    crops = PerspectiveCrop(size=96, fill=0.7)(image[None], K[None], mask[None])
    if not bool(crops.valid[0]):
        raise ValueError("the mask is too small for a crop: its box is less than 2 pixels wide and high")
    fit = fit_silhouette(mesh, crops)
    print(f"fit        {describe_fit(fit) if cfg.box is None else describe_distance(fit)}")
    path = output / "check.png"
    picture = draw(image, mask, K, mesh, fit, crops.images[0])
    write_atomically(path, picture.save)
    print(
        f"written to {path}: mask red, the silhouette that is most like it blue; no pose has been estimated"
    )


def describe_picture(image: Tensor, path: str) -> str:
    """Size, orientation and brightness of a picture."""
    with Image.open(path) as file:
        turned = file.getexif().get(0x0112, 1)
        kind = f"{file.format}, {file.mode}"
    how = "" if turned == 1 else f", turned as its EXIF orientation {turned} says"
    dark = f", brightness {float(image.mean()):.2f}"
    return f"{path}: {image.shape[2]}x{image.shape[1]} px ({kind}){how}{dark}"


def describe_camera(K: Tensor, size: tuple[int, int]) -> str:
    """Focal lengths, field of view and principal point."""
    height, width = size
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    across, down = (math.degrees(2 * math.atan(0.5 * n / f)) for n, f in ((width, fx), (height, fy)))
    off = math.hypot(cx - (width - 1) / 2, cy - (height - 1) / 2)
    return (
        f"fx {fx:.5g}, fy {fy:.5g} px: field of view {across:.0f}° x {down:.0f}°; principal point "
        f"({cx:.1f}, {cy:.1f}), {off:.0f} px from the centre"
    )


def describe_mask(mask: Tensor) -> str:
    """Share and box of a mask."""
    left, top, right, bottom = boxes_from_masks(mask[None])[0][0].tolist()
    share = float(mask.float().mean())
    return (
        f"{int(mask.sum())} px, {share:.2%} of the picture; box {right - left:.0f}x{bottom - top:.0f} px at "
        f"({left + 0.5:.0f}, {top + 0.5:.0f})"
    )


def describe_mesh(mesh: Mesh, path: str) -> str:
    """Size, unit and colours of a mesh."""
    colors = "no colours (light grey; color=[r,g,b] gives it one)"
    if mesh.texture is not None:
        colors = f"a texture of {mesh.texture.shape[2]}x{mesh.texture.shape[1]} px"
    elif mesh.vertex_colors is not None:
        mean = ", ".join(f"{value:.2f}" for value in mesh.vertex_colors.mean(dim=0).tolist())
        colors = f"colours of its surface (on average {mean})"
    extent = " x ".join(f"{value:.4g}" for value in (mesh.bounds[1] - mesh.bounds[0]).tolist())
    d = mesh.diameter
    unit = f"in metres it is {d:.3g} m large, in millimetres {d / 10:.3g} cm"
    if 3 <= d <= 5000:
        unit = f"likely in millimetres: {d / 10:.3g} cm large (in metres, {d:.3g} m)"
    elif 0.003 <= d < 3:
        unit = f"likely in metres: {100 * d:.3g} cm large (in millimetres, {d:.2g} mm)"
    return (
        f"{path}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, {colors}; extent {extent}, "
        f"diameter {d:.4g}, {unit}; poses come out in its unit"
    )


def describe_distance(fit: SilhouetteFit) -> str:
    """Distance at which the object fills the box."""
    return f"the object would be {fit.nearest:.4g} to {fit.farthest:.4g} mesh units away"


def describe_fit(fit: SilhouetteFit) -> str:
    """Distance that the mask implies, and whether its shape is the object's."""
    verdict = "the mask has the shape of the object"
    if fit.overlap < POOR:
        verdict = "the mask has NOT the shape of the object from any side: is it another's, inverted, a box?"
    elif fit.overlap < GOOD:
        verdict = "the mask has roughly the shape of the object, or a part of it is hidden"
    return f"{describe_distance(fit)}; {verdict} (the silhouette that is most like it overlaps by {fit.overlap:.0%})"


def draw(image: Tensor, mask: Tensor, K: Tensor, mesh: Mesh, fit: SilhouetteFit, crop: Tensor) -> Image.Image:
    """The picture with mask and silhouette, and beside it the crop above the object as it would look."""
    size = (int(image.shape[1]), int(image.shape[2]))
    view = RaycastRenderer()(mesh, fit.T_camera_from_model[None], K[None], size)
    width = max(1, round(max(size) / 400))
    drawn = draw_contour(draw_contour(image, view.mask[0], COARSE, width), mask, TRUTH, width)
    crops = PerspectiveCrop(size=240, fill=0.7)
    both = torch.stack([drawn, view.rgb[0].to(drawn)])
    close = crops(both, K[None].expand(2, 3, 3), mask[None].expand(2, -1, -1)).images
    side = torch.cat(list(close), dim=1)
    whole = F.interpolate(drawn[None], scale_factor=480 / size[0], mode="area")[0][:, :480]
    return to_pil(torch.cat([F.pad(whole, (0, 0, 0, 480 - whole.shape[1])), side], dim=2))


if __name__ == "__main__":
    main()
