"""Training of an adapter by the poses that its descriptors lead to."""
