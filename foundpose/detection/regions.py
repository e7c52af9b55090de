"""Proposals without a segmenter: regions whose patches look alike."""

import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.detection.proposals import Pictures, Proposals, Proposer, pad_proposals
from foundpose.detection.region_tree import RegionTree, region_tree


class RegionProposer(Proposer):
    """Regions of a picture at all scales, by merging neighbouring patches that are alike.

    The directions of the patch descriptors are reduced to their leading principal components in the picture, with the
    patches' places beside them, and merged to a tree (:func:`region_tree`). Of its regions those of a plausible size
    are proposed; of nested ones that hardly differ, the larger.

    Args:
        components: number of principal components.
        position: weight of a patch's place (in patches) beside its descriptor (of standard deviation 1).
        min_patches: of a region.
        max_share: of the picture's patches that a region may have.
        overlap: of nested regions, the smaller is left out if it has more than this share of the
            larger one's patches.
    """

    needs_descriptors = True

    def __init__(
        self,
        components: int = 64,
        position: float = 0.3,
        min_patches: int = 20,
        max_share: float = 0.15,
        overlap: float = 0.75,
    ) -> None:
        super().__init__()
        if components < 1 or min_patches < 1:
            raise ValueError(
                f"components and min_patches must be at least 1, got {components} and {min_patches}"
            )
        for name, share in (("max_share", max_share), ("overlap", overlap)):
            if not 0 < share <= 1:
                raise ValueError(f"{name} must be in (0, 1], got {share}")
        self.components = components
        self.position = position
        self.min_patches = min_patches
        self.max_share = max_share
        self.overlap = overlap

    def forward(self, pictures: Pictures) -> Proposals:
        """Regions of pictures, the largest first; all scores are 1.

        Raises:
            ValueError: the pictures come without descriptors.
        """
        described = pictures.descriptors
        if described is None:
            raise ValueError("RegionProposer needs the descriptors of the pictures (DensePatches)")
        count, _, height, width = described.descriptors.shape
        tree = region_tree(self._features(described.descriptors.detach().float()))
        regions, image = _cells_of(tree, self._chosen(tree, height * width), height * width)
        size = pictures.images.shape[-2:]
        return pad_proposals(
            [
                described.to_masks(regions[image == n].unflatten(1, (height, width)), *size)
                for n in range(count)
            ]
        )

    def _features(self, descriptors: Tensor) -> Tensor:
        """What is compared (N, components + 2, h, w): components of standard deviation 1 together, and places."""
        height, width = descriptors.shape[-2:]
        x = F.normalize(descriptors, dim=1).flatten(2).transpose(1, 2)
        x = x - x.mean(dim=1, keepdim=True)
        vectors = torch.linalg.eigh(x.transpose(1, 2) @ x).eigenvectors[..., -self.components :]
        x = x @ vectors
        x = x / x.flatten(1).std(dim=1).clamp_min(1e-12)[:, None, None]
        rows = torch.arange(height, device=x.device, dtype=x.dtype)[:, None].expand(height, width)
        columns = torch.arange(width, device=x.device, dtype=x.dtype).expand(height, width)
        places = self.position * torch.stack([columns, rows]).expand(len(x), -1, -1, -1)
        return torch.cat([x.transpose(1, 2).unflatten(2, (height, width)), places], dim=1)

    def _chosen(self, tree: RegionTree, cells: int) -> list[int]:
        """The regions that are proposed, from the root down."""
        parent, size = tree.parent.tolist(), tree.size.tolist()
        most = self.max_share * cells
        kept_above = [0] * len(parent)  # size of the nearest proposed region that holds a region
        chosen = []
        for node in range(len(parent) - 1, -1, -1):
            above = kept_above[parent[node]] if parent[node] != node else 0
            kept_above[node] = above
            fits = self.min_patches <= size[node] <= most
            if fits and (above == 0 or size[node] <= self.overlap * above):
                chosen.append(node)
                kept_above[node] = size[node]
        return chosen


def _cells_of(tree: RegionTree, nodes: list[int], cells: int) -> tuple[Tensor, Tensor]:
    """Which cells (P, cells) of its map regions have, and their maps (P,)."""
    device = tree.parent.device
    index = torch.tensor(nodes, dtype=torch.long, device=device)
    place = torch.full((len(tree.parent),), -1, dtype=torch.long, device=device)
    place[index] = torch.arange(len(index), device=device)
    inside = torch.zeros(len(index), cells, dtype=torch.bool, device=device)
    leaves = int((tree.size == 1).sum())
    node = torch.arange(leaves, device=device)
    cell = node % cells
    # All cells go up the tree together, until they are at its root.
    while len(node):
        found = place[node] >= 0
        inside[place[node[found]], cell[found]] = True
        above = tree.parent[node]
        moving = above != node
        node, cell = above[moving], cell[moving]
    return inside, tree.image[index]
