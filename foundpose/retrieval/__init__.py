"""Visual words, bags of words and template retrieval."""

from foundpose.retrieval.base import QueryPatches, RetrievedTemplates, Retriever, TemplateIndex
from foundpose.retrieval.bow import IdfMode, SoftAssignBow, WordAssignment, inverse_document_frequency
from foundpose.retrieval.kmeans import KMeansResult, kmeans
from foundpose.retrieval.retriever import ClsRetriever, TemplateRetriever
from foundpose.retrieval.votes import PatchVoteRetriever
from foundpose.retrieval.words import VisualWords

__all__ = [
    "ClsRetriever",
    "IdfMode",
    "KMeansResult",
    "PatchVoteRetriever",
    "QueryPatches",
    "RetrievedTemplates",
    "Retriever",
    "SoftAssignBow",
    "TemplateIndex",
    "TemplateRetriever",
    "VisualWords",
    "WordAssignment",
    "inverse_document_frequency",
    "kmeans",
]
