"""A small network that sees crop and rendering and says how the pose should move."""

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from foundpose.refinement.pose_update import IDENTITY_UPDATE, UPDATE_SIZE
from foundpose.utils.files import check_weights, read_weights, save_weights

SCHEMA_VERSION = 1
_HEADER = "foundpose_update_network"
# What an output of one unit means: a tenth of the picture's side, a tenth of the depth, 0.3 in a column.
_UNITS = (0.1, 0.1, 0.1, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3)
_GROUP = 8  # channels that are normalised together
_PATCH = 2  # side of the patches that are compared, in cells
_DARK = 0.3  # contrast, summed over a patch, below which patches look like nothing
_SHARPNESS = 12.0  # of the softmax over displacements, before it is trained


class UpdateNetwork(nn.Module):
    """Predicts pose updates from where patches of the rendering are found again in the crop.

    The pictures are divided into a grid of cells. Each cell's patch of the rendering is compared, by normalised
    cross-correlation, with the crop's patches up to ``reach`` cells away, which needs no training, resists changes of
    light and works for objects never seen. What is trained is small: two strided convolutions on both pictures, and
    a few on the correlations, the displacement that they favour and those features, down to a vector and the update.
    Before it is trained it predicts that nothing should move, exactly.

    Args:
        width: channels of the first convolution, a multiple of 8; the others have up to three times as many.
        grid: cells along a side. The pictures' side must be a multiple of it.
        reach: farthest displacement that is looked at, in cells.
        hidden: width of the layer before the output.
        seed: of the random weights; the output layer's are zero.
        weights: file of a trained network of the same sizes; None for an untrained one.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a size out of range, a file that is no network's, one of other sizes, or one that is damaged.

    Source: the update is CosyPose's (Labbé et al., ECCV 2020); correlation of local patches as in Dosovitskiy et al.,
    "FlowNet", ICCV 2015. The network is our own.
    """

    def __init__(
        self,
        width: int = 32,
        grid: int = 16,
        reach: int = 4,
        hidden: int = 256,
        seed: int = 0,
        weights: str | Path | None = None,
    ) -> None:
        super().__init__()
        if width < _GROUP or width % _GROUP:
            raise ValueError(f"width must be a positive multiple of {_GROUP}, got {width}")
        if grid < 4 or grid % 4 or not 1 <= reach < grid or hidden < 1:
            raise ValueError(
                "grid must be a positive multiple of 4, reach between 1 and grid - 1 and hidden at least 1, "
                f"got {grid}, {reach} and {hidden}"
            )
        self.settings = {"width": width, "grid": grid, "reach": reach, "hidden": hidden}
        self.grid = grid
        inner, last, displacements = 2 * width, 3 * width, (2 * reach + 1) ** 2
        self.features = nn.Sequential(_layer(6, width, 5, 2), _layer(width, inner, 3, 2))
        self.sharpness = nn.Parameter(torch.tensor(_SHARPNESS))
        # Correlations, their softmax, its peak, the mean displacement, features and the cells' positions.
        self.decoder = nn.Sequential(
            _layer(2 * displacements + 3 + inner + 2, inner, 1, 1),
            _layer(inner, inner, 3, 1),
            _layer(inner, last, 3, 2),
            _layer(last, last, 3, 2),
            nn.Flatten(),
            nn.Linear(last * (grid // 4) ** 2, hidden),
            nn.GELU(),
        )
        self.output = nn.Linear(hidden, UPDATE_SIZE)
        index, inside, offsets = _neighbourhood(grid, reach)
        cells = (torch.arange(grid) + 0.5) / grid * 2.0 - 1.0
        v, u = torch.meshgrid(cells, cells, indexing="ij")
        for name, value in {
            "index": index,
            "inside": inside,
            "offsets": offsets / reach,
            "position": torch.stack([u, v]),
            "identity": torch.tensor(IDENTITY_UPDATE),
            "units": torch.tensor(_UNITS),
        }.items():
            self.register_buffer(name, value, persistent=False)
        self._draw(seed)
        if weights is not None:
            self.load_state_dict(_read(Path(weights), self))

    index: Tensor
    inside: Tensor
    offsets: Tensor
    position: Tensor
    identity: Tensor
    units: Tensor

    def forward(self, pictures: Tensor) -> Tensor:
        """Predict updates.

        Args:
            pictures: (M, 6, s, s) RGB of the crop and RGB of the rendering, in [0, 1].

        Returns:
            (M, 9) as :func:`foundpose.refinement.apply_update` takes them.

        Raises:
            ValueError: another shape, or a side that cannot be divided into the grid's cells.

        Differentiable w.r.t. ``pictures`` and the parameters.
        """
        side = pictures.shape[-1]
        if pictures.dim() != 4 or pictures.shape[1] != 6 or pictures.shape[-2] != side or side % self.grid:
            raise ValueError(
                f"pictures must have shape (M, 6, s, s) with s a multiple of {self.grid}, "
                f"got {tuple(pictures.shape)}"
            )
        correlation = local_correlation(pictures[:, :3], pictures[:, 3:], self.index, self.inside, self.grid)
        match = (self.sharpness * correlation).softmax(dim=-1)
        # The factors bring all inputs to about unit size.
        found = torch.cat(
            [4.0 * correlation, 8.0 * match, 2.0 * match.amax(-1, keepdim=True), 2.0 * match @ self.offsets],
            dim=-1,
        )
        cells = [
            found.transpose(1, 2).unflatten(2, (self.grid, self.grid)),
            F.adaptive_avg_pool2d(self.features(2.0 * pictures - 1.0), self.grid),
            self.position.expand(len(pictures), -1, -1, -1),
        ]
        raw = self.output(self.decoder(torch.cat(cells, dim=1)))
        units = torch.cat([side * self.units[:2], self.units[2:]])
        return self.identity + units * raw

    def _draw(self, seed: int) -> None:
        """Random weights from a generator of their own: equal settings make equal networks."""
        generator = torch.Generator().manual_seed(seed)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                fan_in = module.weight[0].numel()
                with torch.no_grad():
                    module.weight.normal_(0.0, (2.0 / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        nn.init.zeros_(self.output.weight)

    def save(self, path: str | Path) -> None:
        """Write sizes and weights as one safetensors file, whole or not at all."""
        save_weights(Path(path), self, _HEADER, {"schema_version": SCHEMA_VERSION, **self.settings})

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return ", ".join(f"{name}={value}" for name, value in self.settings.items())


def local_correlation(crops: Tensor, renderings: Tensor, index: Tensor, inside: Tensor, grid: int) -> Tensor:
    """Normalised cross-correlation of patches of renderings with patches of crops in their neighbourhood.

    Args:
        crops: (M, 3, s, s) with s a multiple of ``grid``.
        renderings: (M, 3, s, s).
        index: (grid², D) the crop's cells that each cell of the rendering is compared with.
        inside: (grid², D) bool, the cell is one of the grid's.
        grid: cells along a side.

    Returns:
        (M, grid², D) in [-1, 1]; 0 where a patch shows nothing, and outside the grid.

    Differentiable w.r.t. both pictures.
    """
    stride = crops.shape[-1] // grid
    padding = (_PATCH - 1) * stride // 2
    size = stride + 2 * padding
    pictures = F.pad(torch.cat([crops, renderings]), 4 * (padding,), mode="replicate")
    patches = F.unfold(pictures, size, stride=stride)
    patches = patches.unflatten(1, (3, size * size))
    # A shade is light, the pattern in it is the object's.
    patches = (patches - patches.mean(2, keepdim=True)).flatten(1, 2)
    contrast = (patches.square().sum(1, keepdim=True) + 1e-12).sqrt()
    crop, rendering = (patches / (contrast + _DARK)).chunk(2)
    return (rendering.transpose(1, 2) @ crop).gather(2, index.expand(len(crop), -1, -1)) * inside


def _neighbourhood(grid: int, reach: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cells (grid², D) within ``reach`` of each cell, which of them exist, and their offsets (D, 2) as (u, v)."""
    row, column = torch.meshgrid(torch.arange(grid), torch.arange(grid), indexing="ij")
    step = torch.arange(-reach, reach + 1)
    dv, du = (x.flatten() for x in torch.meshgrid(step, step, indexing="ij"))
    rows, columns = row.flatten()[:, None] + dv, column.flatten()[:, None] + du
    inside = (rows >= 0) & (rows < grid) & (columns >= 0) & (columns < grid)
    index = rows.clamp(0, grid - 1) * grid + columns.clamp(0, grid - 1)
    return index, inside, torch.stack([du, dv], dim=-1).float()


def _layer(channels_in: int, channels_out: int, kernel: int, stride: int) -> nn.Sequential:
    """Convolution, normalisation over groups of channels (so that no sample sees another), GELU."""
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, kernel, stride=stride, padding=kernel // 2, bias=False),
        nn.GroupNorm(channels_out // _GROUP, channels_out),
        nn.GELU(),
    )


def _read(path: Path, network: UpdateNetwork) -> dict[str, Tensor]:
    """Weights of a file, checked against the network that they are for."""
    hint = "train one with experiments/train_refiner.py"
    facts, tensors = read_weights(path, _HEADER, SCHEMA_VERSION, "refiner network", hint)
    if facts != network.settings:
        raise ValueError(
            f"{path} holds a network with {facts}, the settings here are {network.settings}; use those of the file"
        )
    check_weights(path, tensors, network)
    return tensors
