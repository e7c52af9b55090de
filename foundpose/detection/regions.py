"""Proposals without a segmenter: regions whose patches look alike."""

import torch
import torch.nn.functional as F
from torch import Tensor

from foundpose.detection.proposals import Pictures, Proposals, Proposer, mask_overlaps, pad_proposals
from foundpose.detection.region_tree import RegionTree, region_tree


class RegionProposer(Proposer):
    """Regions of a picture at all scales, by merging neighbouring patches that are alike.

    The directions of the patch descriptors are reduced to their leading principal components in the picture, with the
    patches' places beside them, and merged to a tree (:func:`region_tree`). Of its regions those of a plausible size
    are proposed; of nested ones that hardly differ, the larger. Of pictures described at several scales, each scale
    has its tree, and a region that an earlier one has as well is proposed once.

    Args:
        components: number of principal components.
        position: weight of a patch's place (in patches) beside its descriptor (of standard deviation 1).
        min_patches: of a region, at the first scale; at others so many as have the same area.
        max_share: of the picture's patches that a region may have.
        overlap: of nested regions, the smaller is left out if it has more than this share of the
            larger one's patches; of regions of two scales, the later one above this intersection over union.
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
        """Regions of pictures; all scores are 1.

        Raises:
            ValueError: the pictures come without descriptors.
        """
        if pictures.descriptors is None:
            raise ValueError("RegionProposer needs the descriptors of the pictures (DensePatches)")
        size = pictures.images.shape[-2:]
        found: list[Tensor] = []
        for described in pictures.descriptors:
            count, _, height, width = described.descriptors.shape
            finer = (pictures.descriptors[0].stride / described.stride) ** 2
            tree = region_tree(self._features(described.descriptors.detach().float()))
            nodes = self._chosen(tree, height * width, round(self.min_patches * finer))
            regions, image = _cells_of(tree, nodes, height * width)
            cells = [regions[image == n].unflatten(1, (height, width)) for n in range(count)]
            masks = [described.to_masks(part, *size) for part in cells]
            found = [self._joined(*pair) for pair in zip(found, masks, strict=True)] if found else masks
        return pad_proposals(found)

    def _joined(self, masks: Tensor, more: Tensor) -> Tensor:
        """Masks (P, H, W) and those of another scale (Q, H, W) that are not among them."""
        overlaps = mask_overlaps(torch.cat([masks, more]))[len(masks) :, : len(masks)]
        return torch.cat([masks, more[~(overlaps > self.overlap).any(dim=1)]])

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

    def _chosen(self, tree: RegionTree, cells: int, fewest: int) -> list[int]:
        """The regions that are proposed, from the root down."""
        parent, size = tree.parent.tolist(), tree.size.tolist()
        most = self.max_share * cells
        kept_above = [0] * len(parent)  # size of the nearest proposed region that holds a region
        chosen = []
        for node in range(len(parent) - 1, -1, -1):
            above = kept_above[parent[node]] if parent[node] != node else 0
            kept_above[node] = above
            fits = fewest <= size[node] <= most
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
