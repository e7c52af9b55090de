"""Bags of words of an object's templates."""

import torch
from torch import Tensor

from foundpose.representation.object_representation import ObjectRepresentation
from foundpose.retrieval import IdfMode, SoftAssignBow, WordAssignment
from foundpose.retrieval.bow import inverse_document_frequency, word_counts
from foundpose.retrieval.retriever import normalize_rows


def describe_by_words(
    representation: ObjectRepresentation, bow: SoftAssignBow, idf_mode: IdfMode, batch_size: int = 64
) -> tuple[Tensor, Tensor]:
    """Inverse document frequencies (k,) and L2-normalised bags of words (T, k) of an object's templates."""
    words, valid = [], []
    distance = representation.info.scale("word", "sigma") if bow.sigma == "auto" else None
    for index in torch.arange(representation.num_templates, device=representation.words.device).split(
        batch_size
    ):
        patches = representation.gather_templates(index)
        words.append(bow.assign(patches.descriptors, patches.valid, representation.words, distance))
        valid.append(patches.valid)
    assignment = WordAssignment(*(torch.cat(parts) for parts in zip(*words, strict=True)))
    num_words = len(representation.words)
    idf = inverse_document_frequency(assignment, torch.cat(valid), num_words, idf_mode)
    return idf, normalize_rows(bow.weigh(word_counts(assignment, num_words), idf))
