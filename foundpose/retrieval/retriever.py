"""Retrieval of the templates that look most like a crop, by one descriptor for each; or of all."""

from foundpose.representation import ObjectRepresentation
from foundpose.retrieval.base import (
    QueryPatches,
    RetrievedTemplates,
    Retriever,
    normalize_rows,
    select_templates,
)
from foundpose.retrieval.bow import SoftAssignBow
from foundpose.utils.settings import identity


class TemplateRetriever(Retriever):
    """Retrieves templates by the cosine similarity of bag-of-words descriptors.

    Args:
        bow: the descriptor; use the one that made the templates' descriptors.
        num_templates: number h of templates per crop.

    Source: paper, "Retrieving similar templates".
    """

    def __init__(self, bow: SoftAssignBow, num_templates: int = 5) -> None:
        super().__init__(num_templates)
        self.bow = bow

    def forward(self, query: QueryPatches, index: ObjectRepresentation) -> RetrievedTemplates:
        """Rank the templates of one object for a batch of crops.

        Args:
            query: patches of B crops.
            index: words, idf and templates of the object.

        Returns:
            The h most similar templates of each crop; a crop without valid patches has none.

        Raises:
            ValueError: If the shapes of query and index do not fit.

        Differentiable w.r.t. ``query.descriptors``, ``index.words``, ``index.idf`` and ``index.template_bow``
        through ``similarity``; the choice of templates is constant, and so is the choice of nearest words.
        ``template_bow`` is taken as given: it does not follow words and idf.
        """
        if index.template_bow.ndim != 2 or index.template_bow.shape[1] != index.words.shape[0]:
            raise ValueError(
                f"template_bow must have shape (T, {index.words.shape[0]}), got {tuple(index.template_bow.shape)}"
            )
        distance = index.info.scale("word", "sigma") if self.bow.sigma == "auto" else None
        vectors = self.bow(query.descriptors, query.valid, index.words, index.idf, distance)
        similarity = normalize_rows(vectors) @ index.template_bow.T
        return select_templates(similarity, query.valid.any(dim=1), self.num_templates)

    def onboarding_settings(self) -> dict[str, str]:
        """The bag of words: its settings shape the templates' descriptors."""
        return {"bow": identity(self.bow)}


class ClsRetriever(Retriever):
    """Retrieves templates by the cosine similarity of the extractor's global (cls) tokens.

    The token sees the background too: ``PerspectiveCrop(background="black")`` hides it, as templates have none.

    Args:
        num_templates: number h of templates per crop.

    Source: paper, "Template retrieval", and Table 2, rows 8 and 9.
    """

    def forward(self, query: QueryPatches, index: ObjectRepresentation) -> RetrievedTemplates:
        """Rank the templates of one object for a batch of crops.

        Args:
            query: global descriptors of B crops.
            index: global descriptors of the object's templates.

        Returns:
            The h most similar templates of each crop; a crop without valid patches has none, as no other retriever
            has any for it.

        Raises:
            ValueError: the extractor or the object has no global descriptors, or they differ in length.

        Differentiable w.r.t. ``query.cls`` and ``index.template_cls`` through ``similarity``; the choice of templates
        is constant.
        """
        if query.cls is None or index.template_cls is None:
            whose = "the extractor gives" if query.cls is None else "the object's templates have"
            raise ValueError(
                f"{whose} no cls token: retrieve by bags of words or patch votes (retrieval=bag_of_words or "
                "retrieval=patch_votes), or use a vision transformer that has a cls token"
            )
        templates = index.template_cls.to(query.cls)
        if templates.ndim != 2 or query.cls.ndim != 2 or templates.shape[1] != query.cls.shape[1]:
            raise ValueError(
                "query.cls and template_cls must have shapes (B, C) and (T, C), got "
                f"{tuple(query.cls.shape)} and {tuple(templates.shape)}"
            )
        similarity = normalize_rows(query.cls) @ normalize_rows(templates).T
        return select_templates(similarity, query.valid.any(dim=1), self.num_templates)


class EveryTemplate(Retriever):
    """All templates of an object, in their order, for stages that look at each.

    Args:
        num_templates: number h of templates per crop; what an object has fewer is not valid.
    """

    def forward(self, query: QueryPatches, index: ObjectRepresentation) -> RetrievedTemplates:
        """The first h templates for each of B crops with valid patches, all with similarity 0."""
        similarity = index.T_template_from_model.new_zeros(len(query.valid), len(index.T_template_from_model))
        return select_templates(similarity, query.valid.any(dim=1), self.num_templates)
