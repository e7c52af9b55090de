"""6D pose of unseen objects from one RGB image: FoundPose (ECCV 2024) as differentiable, batched modules."""

__version__ = "0.1.0"
