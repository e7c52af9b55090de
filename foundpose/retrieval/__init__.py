"""Visual words, bags of words and template retrieval."""
