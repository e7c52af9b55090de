"""Visual words, bags of words and template retrieval."""

from foundpose.retrieval.base import QueryPatches, RetrievedTemplates, TemplateIndex
from foundpose.retrieval.bow import IdfMode, SoftAssignBow, WordAssignment, inverse_document_frequency
from foundpose.retrieval.kmeans import KMeansResult, kmeans
from foundpose.retrieval.retriever import TemplateRetriever
from foundpose.retrieval.words import VisualWords

__all__ = [
    "IdfMode",
    "KMeansResult",
    "QueryPatches",
    "RetrievedTemplates",
    "SoftAssignBow",
    "TemplateIndex",
    "TemplateRetriever",
    "VisualWords",
    "WordAssignment",
    "inverse_document_frequency",
    "kmeans",
]
