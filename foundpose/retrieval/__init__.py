"""Visual words, bags of words and template retrieval."""

from foundpose.retrieval.base import QueryPatches, RetrievedTemplates, Retriever
from foundpose.retrieval.bow import (
    BowNormalization,
    IdfMode,
    SoftAssignBow,
    WordAssignment,
    inverse_document_frequency,
)
from foundpose.retrieval.object_index import ObjectIndex, RankedObjects
from foundpose.retrieval.retriever import ClsRetriever, EveryTemplate, TemplateRetriever
from foundpose.retrieval.spatial import SpatialReranker
from foundpose.retrieval.votes import PatchVoteRetriever
from foundpose.retrieval.words import VisualWords

__all__ = [
    "BowNormalization",
    "ClsRetriever",
    "EveryTemplate",
    "IdfMode",
    "ObjectIndex",
    "PatchVoteRetriever",
    "QueryPatches",
    "RankedObjects",
    "RetrievedTemplates",
    "Retriever",
    "SoftAssignBow",
    "SpatialReranker",
    "TemplateRetriever",
    "VisualWords",
    "WordAssignment",
    "inverse_document_frequency",
]
